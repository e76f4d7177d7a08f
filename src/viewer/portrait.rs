//! Shapes become packs that the page draws: meshes with labels, functions on them, and maps between
//! them.

use super::pack::Pack;
use crate::correspondence::parts;
use crate::descriptors::hks_times;
use crate::ipc::frames::{FrameError, FrameReader};
use crate::ipc::wire;
use crate::mesh::{Format, ParsedMesh, parse};
use crate::pipeline::DescriptionView;
use crate::segmentation::Surface;
use bytes::Bytes;
use serde_json::{Value, json};

/// Maximum number of triangles of a mesh that the page gets; beyond it, the page gets the proxy
/// only.
pub const MAX_SURFACE_TRIANGLES: usize = 200_000;
/// Number of eigenfunctions that are shown, after the constant one.
const N_EIGENFUNCTIONS: usize = 24;
/// Number of times at which the heat kernel signature is shown.
const N_TIMES: usize = 25;

/// The reason why a shape cannot be drawn.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)]
pub enum PortraitError {
    #[error("shape {shape:?} has {found} triangles, the limit of the viewer is {limit}")]
    TooLarge {
        shape: String,
        found: usize,
        limit: usize,
    },
    #[error("shape {shape:?} cannot be read any more: {message}")]
    Unreadable { shape: String, message: String },
}

/// Returns labels as positions in a palette, and the palette of the labels that occur.
fn palette(labels: &[i32]) -> (Vec<i32>, Vec<u32>) {
    let mut ids = labels.to_vec();
    ids.sort_unstable();
    ids.dedup();
    let index = |l: &i32| {
        ids.binary_search(l)
            .expect("invariant: every label is there") as u32
    };
    let indices = labels.iter().map(index).collect();
    (ids, indices)
}

/// Packs the proxy of a shape with the label and the part of each face; -1: unlabelled.
pub fn proxy(
    pack: &mut Pack,
    name: &str,
    version: u64,
    view: &DescriptionView<'_>,
    labels: &[i32],
) -> Value {
    let surface = Surface::new(&view.mesh());
    let ids: Vec<u32> = labels.iter().map(|&l| l as u32).collect();
    let pieces = parts(&surface, &ids);
    let (palette, indices) = palette(labels);
    let m = view.faces.len();
    json!({
        "name": name,
        "version": version,
        "kind": "proxy",
        "positions": pack.words(view.vertices.as_flattened(), 3),
        "faces": pack.integers(view.faces.as_flattened(), &[m, 3]),
        "palette": palette,
        "labels": pack.integers(&indices, &[m]),
        "parts": pack.integers(&pieces.part_of_face, &[m]),
    })
}

/// Packs the mesh that was sent with the labels of its polygons; -1: unlabelled.
pub fn surface(
    pack: &mut Pack,
    name: &str,
    version: u64,
    (bytes, format): (&[u8], Format),
    labels: &[i32],
) -> Result<Value, PortraitError> {
    let unreadable = |message: String| PortraitError::Unreadable {
        shape: name.to_owned(),
        message,
    };
    let mesh = parse(bytes, format).map_err(|e| unreadable(e.to_string()))?;
    let found = mesh.triangles.len();
    if found > MAX_SURFACE_TRIANGLES {
        return Err(PortraitError::TooLarge {
            shape: name.to_owned(),
            found,
            limit: MAX_SURFACE_TRIANGLES,
        });
    }
    if mesh.n_polygons != labels.len() {
        let (n, has) = (mesh.n_polygons, labels.len());
        return Err(unreadable(format!(
            "it has {n} polygons, but {has} labels, by an earlier release: add it \
             again with --replace"
        )));
    }
    let (positions, triangles) = used(&mesh);
    let of_triangle: Vec<i32> = mesh
        .polygon_of_triangle
        .iter()
        .map(|&p| labels[p as usize])
        .collect();
    let (palette, indices) = palette(&of_triangle);
    Ok(json!({
        "name": name,
        "version": version,
        "kind": "surface",
        "n_polygons": mesh.n_polygons,
        "positions": pack.words(&positions, 3),
        "faces": pack.integers(&triangles, &[found, 3]),
        "palette": palette,
        "labels": pack.integers(&indices, &[found]),
        "polygons": pack.integers(&mesh.polygon_of_triangle, &[found]),
    }))
}

/// Returns the vertices that triangles use, relative to the first of them, and the triangles.
/// Single precision does not resolve positions far from the origin.
fn used(mesh: &ParsedMesh) -> (Vec<f32>, Vec<u32>) {
    let mut index = vec![u32::MAX; mesh.vertices.len()];
    let (mut positions, mut triangles) = (Vec::new(), Vec::new());
    let origin = mesh.vertices[mesh.triangles[0][0] as usize];
    for &v in mesh.triangles.as_flattened() {
        let slot = &mut index[v as usize];
        if *slot == u32::MAX {
            *slot = (positions.len() / 3) as u32;
            let p = mesh.vertices[v as usize];
            positions.extend([0, 1, 2].map(|i| (p[i] - origin[i]) as f32));
        }
        triangles.push(*slot);
    }
    (positions, triangles)
}

/// Packs the first eigenfunctions and the heat kernel signature on the proxy.
pub fn functions(pack: &mut Pack, name: &str, view: &DescriptionView<'_>) -> Value {
    let n = view.vertices.len();
    let k = view.n_eigenvectors;
    let shown: Vec<usize> = (1..k.min(N_EIGENFUNCTIONS + 1)).collect();
    let columns = |values: &[f32], width: usize, wanted: &[usize]| -> Vec<f32> {
        let rows = values.chunks_exact(width.max(1));
        rows.flat_map(|row| wanted.iter().map(|&i| row[i]))
            .collect()
    };
    let eigenvectors = columns(view.eigenvectors, k, &shown);
    let eigenvalues: Vec<f64> = shown.iter().map(|&i| view.eigenvalues[i]).collect();
    let n_times = view.hks.len() / n.max(1);
    let picked: Vec<usize> = (0..N_TIMES.min(n_times))
        .map(|i| i * (n_times - 1) / (N_TIMES.min(n_times).max(2) - 1))
        .collect();
    let all_times = hks_times(view.eigenvalues, n_times);
    let times: Vec<f64> = picked.iter().map(|&i| all_times[i]).collect();
    let hks = columns(view.hks, n_times, &picked);
    json!({
        "name": name,
        "kind": "functions",
        "eigenvalues": eigenvalues,
        "eigenvectors": pack.octets(&eigenvectors, shown.len()),
        "times": times,
        "hks": pack.octets(&hks, picked.len()),
    })
}

/// Packs a functional map with its pointwise map, from the daemon's reply.
///
/// # Errors
/// The reply's arrays do not have the sizes that it states.
pub fn map(
    from: &str,
    to: &str,
    reply: &wire::GetFunctionalMapReply,
    frames: &[Bytes],
) -> Result<Vec<u8>, FrameError> {
    let reader = FrameReader::new(frames);
    let (c_12, shape) = reader.f32_array(reply.c_12.as_ref(), "c_12")?;
    let (p2p_21, _) = reader.u32_array(reply.p2p_21.as_ref(), "p2p_21")?;
    let mut pack = Pack::default();
    let mut c_12 = pack.octets(&c_12, 1);
    c_12["shape"] = json!(shape);
    let header = json!({
        "from": from,
        "to": to,
        "c_12": c_12,
        "p2p_21": pack.integers(&p2p_21, &[p2p_21.len()]),
        "quality": reply.quality.as_ref().map(crate::ipc::json::quality),
    });
    Ok(pack.finish(&header))
}
