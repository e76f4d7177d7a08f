//! The bytes of one mesh become its description: a pure function of bytes and parameters.

use super::{Description, Params};
use crate::descriptors;
use crate::mesh::{self, CleanError, DualGraph, Format, ParseError, TriMesh};
use crate::operators::{Laplacian, LaplacianError, laplacian};
use crate::segmentation::patches;
use crate::spectrum::{self, Spectrum, SpectrumError};
use nalgebra::DMatrix;

/// Part of the name of every description: raised when the same bytes would give other arrays.
pub const ALGORITHM_VERSION: u32 = 2;
/// Heat kernel signature times.
pub const N_HKS_TIMES: usize = 100;
/// Eigenvectors that are kept; all eigenvalues are.
const MAX_EIGENVECTORS: usize = 100;
/// Eigenpairs on meshes so small that a quarter of their vertices is fewer.
const MIN_EIGENPAIRS: usize = 4;
/// Patches of the over-segmentation.
const N_PATCHES: usize = 80;

/// Why a shape could not be described.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)]
pub enum DescribeError {
    #[error(transparent)]
    Parse(#[from] ParseError),
    #[error(transparent)]
    Clean(#[from] CleanError),
    #[error(transparent)]
    Laplacian(#[from] LaplacianError),
    #[error(transparent)]
    Spectrum(#[from] SpectrumError),
    #[error("stopped in stage {0:?}")]
    Cancelled(&'static str),
}

/// The spectrum of a mesh with what was asked of it.
#[derive(Debug, Clone)]
pub struct MeshSpectrum {
    /// Eigenpairs, scaled to area 1.
    pub spectrum: Spectrum,
    /// What it is the spectrum of.
    pub operator: Laplacian,
}

/// Describes a mesh. `stage` is told the name of each stage as it begins; when it returns false the work stops
/// with [`DescribeError::Cancelled`].
///
/// # Errors
/// Bytes that are no mesh, a mesh without area, a spectrum that cannot be proved complete.
pub fn describe(
    bytes: &[u8],
    format: Format,
    params: &Params,
    stage: &dyn Fn(&str) -> bool,
) -> Result<Description, DescribeError> {
    let enter = |name: &'static str| {
        if stage(name) {
            Ok(())
        } else {
            Err(DescribeError::Cancelled(name))
        }
    };
    enter("parse")?;
    let parsed = mesh::parse(bytes, format)?;
    enter("clean")?;
    let cleaned = mesh::clean(&parsed)?;
    enter("proxy")?;
    let proxy = mesh::proxy(&cleaned.mesh, params.working_faces);
    // What is stored is f32: everything below is computed from exactly that.
    let vertices: Vec<[f32; 3]> = proxy
        .mesh
        .vertices
        .iter()
        .map(|v| v.map(|x| x as f32))
        .collect();
    let proxy_mesh = TriMesh {
        vertices: vertices.iter().map(|v| v.map(f64::from)).collect(),
        faces: proxy.mesh.faces,
    };
    let bridges = mesh::bridges(&proxy_mesh);
    let whole = |name: &str| stage(name.split_once('.').map_or(name, |(whole, _)| whole));
    let found = spectrum_of(&proxy_mesh, &bridges, params, &whole)?;
    enter("descriptors")?;
    let dual = DualGraph::new(&proxy_mesh, &bridges);
    let (values, vectors) = (&found.spectrum.eigenvalues, &found.spectrum.eigenvectors);
    let times = descriptors::hks_times(values, N_HKS_TIMES);
    let hks = descriptors::hks(values, vectors, &times);
    let face = descriptors::face_descriptors(&proxy_mesh, &bridges, &dual, values, vectors);
    enter("patches")?;
    let patches = patches(&proxy_mesh, &dual, face.farthest_start, N_PATCHES);
    let signature = descriptors::signature(&proxy_mesh, &face, values);

    let face_map: Vec<u32> = cleaned
        .face_of_polygon
        .iter()
        .map(|f| proxy.face_map[*f as usize])
        .collect();
    let mut report = cleaned.report;
    report.n_proxy_faces = proxy_mesh.faces.len();
    report.n_proxy_vertices = vertices.len();
    report.n_bridges = bridges.len();
    let n_eigenvectors = vectors.ncols().min(MAX_EIGENVECTORS);
    Ok(Description {
        area: cleaned.area,
        report,
        faces: proxy_mesh.faces,
        mass: found.operator.mass.iter().map(|m| *m as f32).collect(),
        eigenvalues: values.clone(),
        eigenvectors: row_major(vectors, n_eigenvectors),
        n_eigenvectors,
        hks,
        n_descriptors: face.n,
        face_descriptors: face.data,
        patches,
        face_map,
        polygon_area: cleaned.polygon_area.iter().map(|a| *a as f32).collect(),
        signature,
        vertices,
    })
}

/// The spectrum of a mesh of area 1, with the stages `laplacian` and `spectrum`, and within the latter
/// those of the solver: `spectrum.factor`, `spectrum.iterate` and so on, over and over.
///
/// # Errors
/// As [`laplacian`] and [`Spectrum::smallest`].
pub fn spectrum_of(
    mesh: &TriMesh,
    bridges: &[mesh::Bridge],
    params: &Params,
    stage: &dyn Fn(&str) -> bool,
) -> Result<MeshSpectrum, DescribeError> {
    if !stage("laplacian") {
        return Err(DescribeError::Cancelled("laplacian"));
    }
    let operator = laplacian(mesh, bridges, params.operator)?;
    if !stage("spectrum") {
        return Err(DescribeError::Cancelled("spectrum"));
    }
    let part = |name: &str| stage(&format!("spectrum.{name}"));
    let options = spectrum::Options {
        stage: Some(&part),
        threads: params.threads as usize,
        ..spectrum::Options::default()
    };
    let n = mesh.vertices.len();
    let mut k = params.n_eigenpairs as usize;
    if params.only_meaningful {
        k = k.min(n / 4).max(MIN_EIGENPAIRS.min(n));
    }
    let spectrum = Spectrum::smallest(&operator.stiffness, &operator.mass, k, &options)?;
    Ok(MeshSpectrum { spectrum, operator })
}

/// The first `n` columns, row-major, in single precision.
fn row_major(vectors: &DMatrix<f64>, n: usize) -> Vec<f32> {
    let mut out = Vec::with_capacity(vectors.nrows() * n);
    for v in 0..vectors.nrows() {
        out.extend((0..n).map(|j| vectors[(v, j)] as f32));
    }
    out
}
