//! The bytes of one mesh become its description: a pure function of bytes and parameters.

use crate::description::{Description, Params};
use crate::descriptors::{self, PointKernels};
use crate::mesh::{self, CleanError, DualGraph, Format, ParseError, ParsedMesh, TriMesh};
use crate::operators::{Laplacian, LaplacianError, laplacian};
use crate::segmentation::patches;
use crate::spectrum::{self, Eigenpairs, Progress, SpectrumError};

/// Part of the name of every description: raised when the same bytes would give other arrays.
pub const ALGORITHM_VERSION: u32 = 4;
/// Also part of the name, where the first release read the same bytes as other triangles: raised
/// when only such files are read in another way, so that the descriptions of all others keep their
/// names.
pub const READING_VERSION: u32 = 2;
/// Heat kernel signature times.
pub const N_HKS_TIMES: usize = 100;
/// Eigenvectors that are kept; all eigenvalues are.
const MAX_EIGENVECTORS: usize = 100;
/// Eigenpairs on meshes so small that a quarter of their vertices is fewer.
const MIN_EIGENPAIRS: usize = 4;
/// Vertices whose eigenvectors are copied and used together: few enough to stay in the cache.
const BATCH: usize = 48;
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
#[derive(Debug)]
pub struct MeshSpectrum {
    /// Eigenpairs, scaled to area 1.
    pub spectrum: Eigenpairs,
    /// What it is the spectrum of.
    pub operator: Laplacian,
}

/// Describes a mesh file. `stage` is told the name of each stage as it begins; when it returns
/// false the work stops with [`DescribeError::Cancelled`].
///
/// # Errors
/// Bytes that are no mesh, a mesh without area, a spectrum that cannot be proved complete.
pub fn describe(
    bytes: &[u8],
    format: Format,
    params: &Params,
    stage: &dyn Fn(&str) -> bool,
) -> Result<Description, DescribeError> {
    entered(stage, "parse")?;
    describe_parsed(&mesh::parse(bytes, format)?, params, stage)
}

/// As [`describe`], of a mesh that has been read.
///
/// ```
/// use coseg_geometry::describe::describe_parsed;
/// use coseg_geometry::description::Params;
/// use coseg_geometry::mesh::{ParsedMesh, icosphere};
///
/// let sphere = icosphere(3);
/// let parsed = ParsedMesh {
///     n_polygons: sphere.faces.len(),
///     polygon_of_triangle: (0..sphere.faces.len() as u32).collect(),
///     vertices: sphere.vertices,
///     triangles: sphere.faces,
///     ..ParsedMesh::default()
/// };
/// let found = describe_parsed(&parsed, &Params::default(), &|_| true)?;
/// assert_eq!(found.face_map.len(), 1280);
/// # Ok::<_, coseg_geometry::describe::DescribeError>(())
/// ```
///
/// # Errors
/// As [`describe`], except for the bytes.
pub fn describe_parsed(
    parsed: &ParsedMesh,
    params: &Params,
    stage: &dyn Fn(&str) -> bool,
) -> Result<Description, DescribeError> {
    let enter = |name| entered(stage, name);
    enter("clean")?;
    let cleaned = mesh::outer_shells(mesh::clean(parsed)?);
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
    let values = &found.spectrum.eigenvalues;
    let points = point_arrays(&found.spectrum);
    let face = descriptors::face_descriptors(&proxy_mesh, &bridges, &dual, &points.face_kernels);
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
    Ok(Description {
        area: cleaned.area,
        report,
        faces: proxy_mesh.faces,
        mass: found.operator.mass.iter().map(|m| *m as f32).collect(),
        eigenvalues: values.clone(),
        eigenvectors: points.eigenvectors,
        n_eigenvectors: points.n_eigenvectors,
        hks: points.hks,
        n_descriptors: face.n,
        face_descriptors: face.data,
        patches,
        face_map,
        polygon_area: cleaned.polygon_area.iter().map(|a| *a as f32).collect(),
        signature,
        vertices,
    })
}

fn entered(stage: &dyn Fn(&str) -> bool, name: &'static str) -> Result<(), DescribeError> {
    if stage(name) {
        Ok(())
    } else {
        Err(DescribeError::Cancelled(name))
    }
}

/// The spectrum of a mesh of area 1, with the stages `laplacian` and `spectrum`, and within the
/// latter those of the solver: `spectrum.factor`, `spectrum.iterate` and so on, over and over.
///
/// # Errors
/// As [`laplacian`] and [`Eigenpairs::smallest`].
pub fn spectrum_of(
    mesh: &TriMesh,
    bridges: &[mesh::Bridge],
    params: &Params,
    stage: &dyn Fn(&str) -> bool,
) -> Result<MeshSpectrum, DescribeError> {
    entered(stage, "laplacian")?;
    let operator = laplacian(mesh, bridges, params.operator)?;
    entered(stage, "spectrum")?;
    let part = |progress: &Progress| stage(&format!("spectrum.{}", progress.stage));
    let options = spectrum::Options {
        progress: Some(&part),
        threads: params.threads as usize,
        ..spectrum::Options::default()
    };
    let n = mesh.vertices.len();
    let mut k = params.n_eigenpairs as usize;
    if params.only_meaningful {
        k = k.min(n / 4).max(MIN_EIGENPAIRS.min(n));
    }
    let spectrum = Eigenpairs::smallest(&operator.stiffness, &operator.mass, k, &options)?;
    Ok(MeshSpectrum { spectrum, operator })
}

/// What is computed of each vertex from its row of eigenvectors.
struct PointArrays {
    /// The first of them `(n, n_eigenvectors)`, row-major.
    eigenvectors: Vec<f32>,
    n_eigenvectors: usize,
    hks: Vec<f32>,
    face_kernels: Vec<f64>,
}

/// One pass over the eigenvectors, from where the solver left them to what is kept.
fn point_arrays(pairs: &Eigenpairs) -> PointArrays {
    let (n, k) = (pairs.n(), pairs.k());
    let times = descriptors::hks_times(&pairs.eigenvalues, N_HKS_TIMES);
    let heat = PointKernels::new(&pairs.eigenvalues, &times, 0);
    let of_faces = descriptors::face_kernels(&pairs.eigenvalues);
    let n_eigenvectors = k.min(MAX_EIGENVECTORS);
    let mut arrays = PointArrays {
        eigenvectors: Vec::with_capacity(n * n_eigenvectors),
        n_eigenvectors,
        hks: Vec::with_capacity(n * N_HKS_TIMES),
        face_kernels: vec![0.0; n * of_faces.n_columns()],
    };
    let mut rows = vec![0.0; BATCH * k];
    let mut hks = vec![0.0; BATCH * N_HKS_TIMES];
    for first in (0..n).step_by(BATCH) {
        let count = BATCH.min(n - first);
        let rows = &mut rows[..count * k];
        pairs.rows(first, rows);
        for row in rows.chunks_exact(k) {
            let kept = row[..n_eigenvectors].iter().map(|x| *x as f32);
            arrays.eigenvectors.extend(kept);
        }
        let hks = &mut hks[..count * N_HKS_TIMES];
        heat.of_rows(rows, k, hks);
        arrays.hks.extend(hks.iter().map(|x| *x as f32));
        let width = of_faces.n_columns();
        let out = &mut arrays.face_kernels[first * width..][..count * width];
        of_faces.of_rows(rows, k, out);
    }
    arrays
}
