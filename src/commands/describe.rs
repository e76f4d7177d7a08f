//! `coseg describe` runs the pure description stage on one mesh, without a daemon.

use super::describe_full::{Signatures, full};
use super::session::print_line;
use super::show::found;
use super::{CommandError, Outcome};
use crate::cli::Global;
use clap::Args;
use coseg::ipc::convert::clean_report;
use coseg::library::report_to_json;
use coseg::mesh::{CleanReport, Format};
use coseg::pipeline::{Params, describe};
use coseg::spectrum::Certificate;
use coseg::store::DescriptionFile;
use serde_json::{Value, json};
use std::cell::RefCell;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// `coseg describe`
#[derive(Debug, Args)]
pub(crate) struct Describe {
    /// A mesh file (.obj, .off, .ply, .stl, .glb, .gltf with its .bin beside it)
    pub(crate) mesh: PathBuf,
    /// Write the arrays to this safetensors file
    #[arg(long, short, value_name = "FILE")]
    pub(crate) out: Option<PathBuf>,
    /// Number of eigenpairs [default: 300, or a quarter of the vertices if that is fewer]
    #[arg(long, value_name = "K", value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) k: Option<u32>,
    /// The Laplacian
    #[arg(long, value_name = "OPERATOR", default_value = "tufted")]
    pub(crate) operator: crate::cli::Operator,
    /// Compute only operator, spectrum and heat kernel signature, at input resolution and in double
    /// precision; the file then also contains stiffness (CSR) and mass
    #[arg(long)]
    pub(crate) full: bool,
    /// Number of faces of the working resolution
    #[arg(long, value_name = "N", conflicts_with = "full")]
    pub(crate) working_faces: Option<u32>,
    /// Number of threads; the result does not depend on it
    #[arg(
        long,
        value_name = "N",
        default_value_t = 1,
        value_parser = clap::value_parser!(u32).range(1..=256)
    )]
    pub(crate) threads: u32,
    /// Print the milliseconds of each stage; with --full also of each step of the solver
    #[arg(long)]
    pub(crate) timings: bool,
}

/// Milliseconds of each stage, in the order in which stages were first entered. The time of a stage
/// `a.b` counts for `a` too, and repeated stages add up.
#[derive(Default)]
pub(super) struct Laps(RefCell<Running>);

#[derive(Default)]
struct Running {
    laps: Vec<(String, f64)>,
    /// The running stages, outermost first, each with the time of entry.
    open: Vec<(usize, Instant)>,
}

impl Laps {
    /// Ends the stages that do not contain `name`, and begins this one.
    pub(super) fn enter(&self, name: &str) -> bool {
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
    /// Ends all running stages but the first `keep`.
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

/// The parameters of a description.
pub(super) struct Task<'a> {
    /// The file's bytes and their format.
    pub(super) mesh: (&'a [u8], Format),
    pub(super) params: &'a Params,
    /// The times of the stages.
    pub(super) laps: &'a Laps,
    /// The destination of the arrays.
    pub(super) out: Option<&'a Path>,
}

/// The results to print.
pub(super) struct Summary {
    pub(super) area: f64,
    pub(super) n_vertices: usize,
    pub(super) n_faces: usize,
    pub(super) eigenvalues: Vec<f64>,
    pub(super) report: CleanReport,
    /// Largest residual relative to its bound, and the certificate of completeness; at input
    /// resolution only.
    pub(super) spectrum: Option<(f64, Certificate)>,
    /// The cost of computing signatures; at input resolution, where they are written.
    pub(super) signatures: Option<Signatures>,
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
    let bytes = super::mesh_file::read(&args.mesh, format).map_err(file)?;
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
    let (summary, laps) = pool.install(|| {
        let laps = Laps::default();
        let task = Task {
            mesh: (&bytes, format),
            params: &params,
            laps: &laps,
            out: args.out.as_deref(),
        };
        let summary = if args.full { full(&task) } else { proxy(&task) };
        let summary = summary.map_err(|e| e.of(&path))?;
        Ok::<_, CommandError>((summary, laps.finish()))
    })?;
    print(args, global, &summary, &laps)?;
    Ok(true)
}

/// The failure of a mesh, or of the output file.
pub(super) enum Trouble {
    Mesh(String),
    Out(std::path::PathBuf, std::io::Error),
}

impl Trouble {
    pub(super) fn mesh(error: impl std::fmt::Display) -> Self {
        Self::Mesh(error.to_string())
    }

    fn of(self, mesh: &str) -> CommandError {
        match self {
            Self::Mesh(why) => CommandError::Failed(format!("{mesh}: {why}")),
            Self::Out(path, source) => CommandError::File {
                path: path.display().to_string(),
                source,
            },
        }
    }
}

fn proxy(task: &Task<'_>) -> Result<Summary, Trouble> {
    let Task {
        mesh: (bytes, format),
        params,
        laps,
        out,
    } = *task;
    let described = describe(bytes, format, params, &|name| laps.enter(name));
    let d = described.map_err(Trouble::mesh)?;
    if let Some(out) = out {
        laps.enter("write");
        let params = params_json(params);
        let array_file = DescriptionFile::new(&d, &params).map_err(Trouble::mesh)?;
        let trouble = |e| Trouble::Out(out.to_owned(), e);
        let mut file = fs::File::create(out).map_err(trouble)?;
        for piece in array_file.pieces() {
            file.write_all(piece).map_err(trouble)?;
        }
    }
    Ok(Summary {
        area: d.area,
        n_vertices: d.vertices.len(),
        n_faces: d.faces.len(),
        eigenvalues: d.eigenvalues,
        report: d.report,
        spectrum: None,
        signatures: None,
    })
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
                "proved": certificate.proved(),
                "growth": certificate.growth,
                "n_components": certificate.n_components,
                "n_krylov": certificate.n_krylov,
                "n_polish": certificate.n_polish,
                "n_repair": certificate.n_repair,
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
    print_line(&format!("mesh: {}", found(&clean_report(&summary.report))))?;
    if let Some((_, certificate)) = &summary.spectrum {
        print_line(&proof(certificate))?;
    }
    if args.timings {
        for (name, ms) in laps {
            let rates = match &summary.signatures {
                Some(signatures) if name == "signatures" => signatures.rates(*ms),
                _ => String::new(),
            };
            print_line(&format!("{name:>20} {ms:10.2} ms{rates}"))?;
        }
    }
    Ok(())
}

/// The certificate of completeness as a sentence.
fn proof(certificate: &Certificate) -> String {
    let Certificate {
        tau,
        count,
        margin,
        perturbation,
        ..
    } = certificate;
    if tau.is_infinite() {
        return format!("complete: all {count} eigenvalues");
    }
    let counted = format!("{count} eigenvalues below {tau:.6} by inertia, and as many found");
    match certificate.proved() {
        true => format!(
            "complete, proved: {counted}; rounding moves them by {perturbation:.1e} at most, the \
             margin is {margin:.1e}"
        ),
        false => format!(
            "complete, counted but not proved: {counted}; in the worst case rounding moves them \
             by {perturbation:.1e}, more than the margin of {margin:.1e}"
        ),
    }
}
