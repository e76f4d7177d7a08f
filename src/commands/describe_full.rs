//! `coseg describe --full` computes operator, spectrum and signatures at input resolution, in
//! double precision.

use super::describe::{Laps, Summary, Task, Trouble};
use coseg::descriptors::{PointKernels, gps_scales, hks_times, null_space, shape_dna};
use coseg::mesh::{self, Cleaned};
use coseg::pipeline::{MeshSpectrum, N_HKS_TIMES, spectrum_of};
use coseg::store::ArrayStream;
use safetensors::tensor::Dtype;
use std::io;
use std::path::Path;

/// Number of energies of the wave kernel signature.
const N_ENERGIES: usize = 100;
/// Maximum number of columns of the global point signature.
const MAX_GPS: usize = 60;
/// Number of vertices whose rows are copied and used together: few enough to stay in the cache.
const BATCH: usize = 48;

/// The cost of computing signatures.
pub(super) struct Signatures {
    /// Bytes of eigenvectors that were read.
    bytes: f64,
    flops: f64,
}

impl Signatures {
    /// The rates as text, for a computation of `ms` milliseconds.
    pub(super) fn rates(&self, ms: f64) -> String {
        let per_second = |x: f64| x / (1e6 * ms.max(1e-6));
        format!(
            "  ({:.1} GB/s of eigenvectors, {:.1} GFlop/s)",
            per_second(self.bytes),
            per_second(self.flops)
        )
    }
}

/// Computes the spectrum at input resolution. Arrays for `out` are written while they are copied
/// out of the solver.
pub(super) fn full(task: &Task<'_>) -> Result<Summary, Trouble> {
    let Task {
        mesh: (bytes, format),
        params,
        laps,
        out,
    } = *task;
    laps.enter("parse");
    let parsed = mesh::parse(bytes, format).map_err(Trouble::mesh)?;
    laps.enter("clean");
    let mut cleaned = mesh::clean(&parsed).map_err(Trouble::mesh)?;
    let bridges = mesh::bridges(&cleaned.mesh);
    cleaned.report.n_bridges = bridges.len();
    let stage = |name: &str| laps.enter(name);
    let found = spectrum_of(&cleaned.mesh, &bridges, params, &stage).map_err(Trouble::mesh)?;
    let signatures = match out {
        Some(path) => {
            let written = write(&cleaned, &found, laps, path);
            Some(written.map_err(|e| Trouble::Out(path.to_owned(), e))?)
        }
        None => {
            // The eigenvectors become an array in memory, like those of other libraries, so that
            // the times are comparable.
            laps.enter("spectrum.assemble");
            std::hint::black_box(found.spectrum.all_rows());
            None
        }
    };
    let pairs = found.spectrum;
    let least = pairs.eigenvalues.iter().copied().find(|v| *v > 0.0);
    let least = least.unwrap_or(1.0);
    let both = pairs.residuals.iter().zip(&pairs.eigenvalues);
    let relative = both.map(|(r, v)| r / v.max(least));
    Ok(Summary {
        area: cleaned.area,
        n_vertices: cleaned.mesh.vertices.len(),
        n_faces: cleaned.mesh.faces.len(),
        spectrum: Some((relative.fold(0.0, f64::max), pairs.certificate)),
        eigenvalues: pairs.eigenvalues,
        report: cleaned.report,
        signatures,
    })
}

/// Writes the file. Rows of eigenvectors are copied a few at a time; while they are in the cache,
/// all signatures of their vertices are computed and written.
fn write(
    cleaned: &Cleaned,
    found: &MeshSpectrum,
    laps: &Laps,
    path: &Path,
) -> io::Result<Signatures> {
    laps.enter("write");
    let (pairs, operator, mesh) = (&found.spectrum, &found.operator, &cleaned.mesh);
    let (n, k) = (pairs.n(), pairs.k());
    let values = &pairs.eigenvalues;
    let skip = null_space(values);
    let n_gps = (k - skip).min(MAX_GPS);
    let matrix = &operator.stiffness;
    let indptr: Vec<u32> = matrix.proper_indptr().iter().map(|&i| i as u32).collect();
    let indices: Vec<u32> = matrix.indices().iter().map(|&i| i as u32).collect();
    let n_polygons = cleaned.face_of_polygon.len();
    let arrays = [
        ("vertices", Dtype::F64, vec![n, 3]),
        ("faces", Dtype::U32, vec![mesh.faces.len(), 3]),
        ("stiffness_indptr", Dtype::U32, vec![n + 1]),
        ("stiffness_indices", Dtype::U32, vec![indices.len()]),
        ("stiffness_data", Dtype::F64, vec![indices.len()]),
        ("mass", Dtype::F64, vec![n]),
        ("eigenvalues", Dtype::F64, vec![k]),
        ("eigenvectors", Dtype::F64, vec![n, k]),
        ("hks", Dtype::F64, vec![n, N_HKS_TIMES]),
        ("wks", Dtype::F64, vec![n, N_ENERGIES]),
        ("gps", Dtype::F64, vec![n, n_gps]),
        ("shape_dna", Dtype::F32, vec![k - skip]),
        ("face_map", Dtype::U32, vec![n_polygons]),
    ];
    let file = ArrayStream::create(path, &arrays)?;
    let at = |name: &str| {
        let found = arrays.iter().position(|a| a.0 == name);
        found.expect("invariant: the name is in the list")
    };
    file.write(at("vertices"), 0, mesh.vertices.as_flattened())?;
    file.write(at("faces"), 0, mesh.faces.as_flattened())?;
    file.write(at("stiffness_indptr"), 0, &indptr)?;
    file.write(at("stiffness_indices"), 0, &indices)?;
    file.write(at("stiffness_data"), 0, matrix.data())?;
    file.write(at("mass"), 0, &operator.mass)?;
    file.write(at("eigenvalues"), 0, values)?;
    file.write(at("shape_dna"), 0, &shape_dna(values, k - skip))?;
    file.write(at("face_map"), 0, &cleaned.face_of_polygon)?;

    laps.enter("signatures");
    let kernels = PointKernels::new(values, &hks_times(values, N_HKS_TIMES), N_ENERGIES);
    let scales = gps_scales(values, n_gps);
    let width = kernels.n_columns();
    let mut rows = vec![0.0; BATCH * k];
    let mut both = vec![0.0; BATCH * width];
    let (mut hks, mut wks, mut gps) = (Vec::new(), Vec::new(), Vec::new());
    for first in (0..n).step_by(BATCH) {
        let count = BATCH.min(n - first);
        let (rows, both) = (&mut rows[..count * k], &mut both[..count * width]);
        laps.enter("rows");
        pairs.rows(first, rows);
        laps.enter("signatures");
        kernels.of_rows(rows, k, both);
        hks.clear();
        wks.clear();
        gps.clear();
        for (row, both) in rows.chunks_exact(k).zip(both.chunks_exact(width)) {
            let (heat, wave) = both.split_at(kernels.n_times());
            hks.extend_from_slice(heat);
            wks.extend_from_slice(wave);
            gps.extend(row[skip..].iter().zip(&scales).map(|(x, s)| x * s));
        }
        laps.enter("write");
        file.write(at("eigenvectors"), first * k, rows)?;
        file.write(at("hks"), first * N_HKS_TIMES, &hks)?;
        file.write(at("wks"), first * N_ENERGIES, &wks)?;
        file.write(at("gps"), first * n_gps, &gps)?;
    }
    Ok(Signatures {
        bytes: (n * k * size_of::<f64>()) as f64,
        flops: (n * kernels.flops()) as f64,
    })
}
