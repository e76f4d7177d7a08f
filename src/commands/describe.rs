//! `coseg describe`: the pure stage without a daemon.

use super::session::print_line;
use super::{CommandError, Outcome};
use crate::cli::Global;
use clap::Args;
use coseg::descriptors::{hks, hks_times};
use coseg::library::report_to_json;
use coseg::mesh::{self, CleanReport, Format, TriMesh};
use coseg::operators::Laplacian;
use coseg::pipeline::{DescribeError, N_HKS_TIMES, Params, describe, spectrum_of};
use coseg::spectrum::Certificate;
use coseg::store::write_description;
use safetensors::tensor::{Dtype, TensorView, serialize};
use serde_json::{Value, json};
use std::cell::RefCell;
use std::collections::HashMap;
use std::fs;
use std::path::PathBuf;
use std::time::Instant;

/// `coseg describe`
#[derive(Debug, Args)]
pub(crate) struct Describe {
    /// A mesh file (.obj, .off, .ply, .stl, .glb, .gltf)
    pub(crate) mesh: PathBuf,
    /// Write the arrays to this safetensors file
    #[arg(long, short, value_name = "FILE")]
    pub(crate) out: Option<PathBuf>,
    /// Eigenpairs [default: 300, or a quarter of the vertices if that is fewer]
    #[arg(long, value_name = "K", value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) k: Option<u32>,
    /// Which Laplacian
    #[arg(long, value_name = "OPERATOR", default_value = "tufted")]
    pub(crate) operator: crate::cli::Operator,
    /// Only operator, spectrum and heat kernel signature, at input resolution and in double precision;
    /// the file then also holds stiffness (CSR) and mass
    #[arg(long)]
    pub(crate) full: bool,
    /// Faces of the working resolution
    #[arg(long, value_name = "N", conflicts_with = "full")]
    pub(crate) working_faces: Option<u32>,
    /// Threads; the result does not depend on it
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=256))]
    pub(crate) threads: u32,
    /// Print the milliseconds of each stage, with --full also of each part of the solver
    #[arg(long)]
    pub(crate) timings: bool,
}

/// Milliseconds by stage, in the order in which stages were first entered. What a stage `a.b` takes
/// counts for `a` too; one that is entered again goes on counting.
#[derive(Default)]
struct Laps(RefCell<Running>);

#[derive(Default)]
struct Running {
    laps: Vec<(String, f64)>,
    /// The lap that runs, and the one within it, each with when it was entered.
    open: Vec<(usize, Instant)>,
}

impl Laps {
    /// Ends the stages that `name` is not within, and begins this one.
    fn enter(&self, name: &str) -> bool {
        let running = &mut *self.0.borrow_mut();
        let now = Instant::now();
        let whole = name.split_once('.').map_or(name, |(whole, _)| whole);
        let within = running
            .open
            .first()
            .is_some_and(|(at, _)| running.laps[*at].0 == whole);
        running.close(usize::from(within), now);
        if !within {
            running.begin(whole, now);
        }
        if name != whole {
            running.begin(name, now);
        }
        true
    }

    fn finish(self) -> Vec<(String, f64)> {
        let mut running = self.0.into_inner();
        running.close(0, Instant::now());
        running.laps
    }
}

impl Running {
    /// Ends all open laps but the first `keep`.
    fn close(&mut self, keep: usize, now: Instant) {
        while self.open.len() > keep {
            if let Some((at, since)) = self.open.pop() {
                self.laps[at].1 += now.duration_since(since).as_secs_f64() * 1e3;
            }
        }
    }

    fn begin(&mut self, name: &str, now: Instant) {
        let known = self.laps.iter().position(|lap| lap.0 == name);
        let at = known.unwrap_or_else(|| {
            self.laps.push((name.to_owned(), 0.0));
            self.laps.len() - 1
        });
        self.open.push((at, now));
    }
}

/// What there is to print.
struct Summary {
    area: f64,
    n_vertices: usize,
    n_faces: usize,
    eigenvalues: Vec<f64>,
    report: CleanReport,
    /// Largest residual relative to its bound, and the proof of completeness; at input resolution only.
    spectrum: Option<(f64, Certificate)>,
}

pub(crate) fn run(args: &Describe, global: &Global) -> Outcome {
    let path = args.mesh.display().to_string();
    let file = |source| CommandError::File {
        path: path.clone(),
        source,
    };
    let Some(format) = Format::from_name(&path) else {
        return Err(CommandError::Usage(format!(
            "{path}: the extension is none of {}",
            Format::EXTENSIONS
        )));
    };
    let bytes = fs::read(&args.mesh).map_err(file)?;
    let defaults = Params::default();
    let params = Params {
        operator: args.operator.to_domain(),
        working_faces: args.working_faces.unwrap_or(defaults.working_faces),
        n_eigenpairs: args.k.unwrap_or(defaults.n_eigenpairs),
        only_meaningful: args.k.is_none(),
        threads: args.threads,
    };
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(args.threads as usize)
        .build();
    let pool = pool.map_err(|e| CommandError::Failed(format!("cannot start threads: {e}")))?;
    let (summary, arrays, laps) = pool.install(|| {
        let laps = Laps::default();
        let (summary, arrays) = if args.full {
            full(&bytes, format, &params, &laps, args.out.is_some())
        } else {
            proxy(&bytes, format, &params, &laps)
        }
        .map_err(|e| CommandError::Failed(format!("{path}: {e}")))?;
        Ok::<_, CommandError>((summary, arrays, laps.finish()))
    })?;
    if let Some(out) = &args.out {
        let source = |source| CommandError::File {
            path: out.display().to_string(),
            source,
        };
        fs::write(out, arrays).map_err(source)?;
    }
    print(args, global, &summary, &laps)?;
    Ok(true)
}

fn proxy(
    bytes: &[u8],
    format: Format,
    params: &Params,
    laps: &Laps,
) -> Result<(Summary, Vec<u8>), String> {
    let d = describe(bytes, format, params, &|name| laps.enter(name)).map_err(|e| e.to_string())?;
    laps.enter("write");
    let arrays = write_description(&d, &params_json(params)).map_err(|e| e.to_string())?;
    let summary = Summary {
        area: d.area,
        n_vertices: d.vertices.len(),
        n_faces: d.faces.len(),
        eigenvalues: d.eigenvalues,
        report: d.report,
        spectrum: None,
    };
    Ok((summary, arrays))
}

/// The spectrum at input resolution, with everything in double precision.
fn full(
    bytes: &[u8],
    format: Format,
    params: &Params,
    laps: &Laps,
    write: bool,
) -> Result<(Summary, Vec<u8>), String> {
    let text = |e: &dyn std::fmt::Display| e.to_string();
    laps.enter("parse");
    let parsed = mesh::parse(bytes, format).map_err(|e| text(&e))?;
    laps.enter("clean");
    let cleaned = mesh::clean(&parsed).map_err(|e| text(&e))?;
    let bridges = mesh::bridges(&cleaned.mesh);
    let stage = |name: &str| laps.enter(name);
    let found = spectrum_of(&cleaned.mesh, &bridges, params, &stage)
        .map_err(|e: DescribeError| e.to_string())?;
    let values = &found.spectrum.eigenvalues;
    let arrays = if write {
        laps.enter("hks");
        let hks = hks(
            values,
            &found.spectrum.eigenvectors,
            &hks_times(values, N_HKS_TIMES),
        );
        laps.enter("write");
        let vectors = found.spectrum.eigenvectors.transpose();
        let hks: Vec<f64> = hks.into_iter().map(f64::from).collect();
        full_arrays(
            &cleaned.mesh,
            &cleaned.face_of_polygon,
            &found.operator,
            values,
            vectors.as_slice(),
            &hks,
        )?
    } else {
        Vec::new()
    };
    let least = values.iter().copied().find(|v| *v > 0.0).unwrap_or(1.0);
    let relative = found
        .spectrum
        .residuals
        .iter()
        .zip(values)
        .map(|(r, v)| r / v.max(least));
    let summary = Summary {
        area: cleaned.area,
        n_vertices: cleaned.mesh.vertices.len(),
        n_faces: cleaned.mesh.faces.len(),
        spectrum: Some((relative.fold(0.0, f64::max), found.spectrum.certificate)),
        eigenvalues: found.spectrum.eigenvalues,
        report: cleaned.report,
    };
    Ok((summary, arrays))
}

fn full_arrays(
    mesh: &TriMesh,
    face_map: &[u32],
    operator: &Laplacian,
    eigenvalues: &[f64],
    eigenvectors: &[f64],
    hks: &[f64],
) -> Result<Vec<u8>, String> {
    let (n, k) = (operator.mass.len(), eigenvalues.len());
    let matrix = &operator.stiffness;
    let indptr: Vec<u32> = matrix.proper_indptr().iter().map(|&i| i as u32).collect();
    let indices: Vec<u32> = matrix.indices().iter().map(|&i| i as u32).collect();
    let nnz = indices.len();
    let doubles = |x: &[f64]| x.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    let words = |x: &[u32]| x.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    let arrays = [
        (
            "vertices",
            Dtype::F64,
            vec![n, 3],
            doubles(mesh.vertices.as_flattened()),
        ),
        (
            "faces",
            Dtype::U32,
            vec![mesh.faces.len(), 3],
            words(mesh.faces.as_flattened()),
        ),
        ("stiffness_indptr", Dtype::U32, vec![n + 1], words(&indptr)),
        ("stiffness_indices", Dtype::U32, vec![nnz], words(&indices)),
        (
            "stiffness_data",
            Dtype::F64,
            vec![nnz],
            doubles(matrix.data()),
        ),
        ("mass", Dtype::F64, vec![n], doubles(&operator.mass)),
        ("eigenvalues", Dtype::F64, vec![k], doubles(eigenvalues)),
        (
            "eigenvectors",
            Dtype::F64,
            vec![n, k],
            doubles(eigenvectors),
        ),
        ("hks", Dtype::F64, vec![n, N_HKS_TIMES], doubles(hks)),
        (
            "face_map",
            Dtype::U32,
            vec![face_map.len()],
            words(face_map),
        ),
    ];
    let mut views = Vec::new();
    for (name, dtype, shape, bytes) in &arrays {
        let view = TensorView::new(*dtype, shape.clone(), bytes).map_err(|e| e.to_string())?;
        views.push((*name, view));
    }
    serialize(views, None::<HashMap<String, String>>).map_err(|e| e.to_string())
}

fn params_json(params: &Params) -> String {
    json!({
        "operator": crate::cli::Operator::name(params.operator),
        "working_faces": params.working_faces,
        "n_eigenpairs": params.n_eigenpairs,
    })
    .to_string()
}

fn print(
    args: &Describe,
    global: &Global,
    summary: &Summary,
    laps: &[(String, f64)],
) -> Result<(), CommandError> {
    if global.json {
        let timings: serde_json::Map<String, Value> = laps
            .iter()
            .map(|(name, ms)| (name.clone(), json!(ms)))
            .collect();
        let mut value = json!({
            "mesh": args.mesh.display().to_string(),
            "operator": crate::cli::Operator::name(args.operator.to_domain()),
            "full": args.full,
            "area": summary.area,
            "n_vertices": summary.n_vertices,
            "n_faces": summary.n_faces,
            "k": summary.eigenvalues.len(),
            "eigenvalues": summary.eigenvalues,
            "timings_ms": timings,
            "report": report_to_json(&summary.report),
        });
        if let Some((residual, certificate)) = &summary.spectrum {
            value["max_relative_residual"] = json!(residual);
            value["certificate"] = json!({
                "tau": certificate.tau,
                "count": certificate.count,
                "margin": certificate.margin,
                "perturbation": certificate.perturbation,
                "n_components": certificate.n_components,
            });
        }
        return print_line(&value.to_string());
    }
    let last = summary.eigenvalues.last().copied().unwrap_or(0.0);
    print_line(&format!(
        "{}: {} vertices, {} faces, area {:.6}; {} eigenvalues up to {last:.3} (area 1)",
        args.mesh.display(),
        summary.n_vertices,
        summary.n_faces,
        summary.area,
        summary.eigenvalues.len(),
    ))?;
    if args.timings {
        for (name, ms) in laps {
            print_line(&format!("{name:>20} {ms:10.2} ms"))?;
        }
    }
    Ok(())
}
