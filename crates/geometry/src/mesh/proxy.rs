//! Computes a mesh of working resolution from a clean mesh, with a map back. All later stages use
//! this proxy.
//!
//! Finer meshes are simplified by quadric edge collapse (Garland and Heckbert 1997, by meshopt,
//! whose regularisation keeps angles usable for cotangents); coarser ones, and huge faces, are
//! subdivided. Vertices are rounded to single precision, in which they are stored, so that a fresh
//! proxy and a stored one give the same results.

use super::clean::{corner_word, is_degenerate, normalize};
use super::refine::refine;
use super::{Bvh, FaceGeometry, Search, TriMesh, dot, scale, sub};
use meshopt::{SimplifyOptions, VertexDataAdapter};

/// A mesh is simplified when it has more faces than this times the working resolution.
const EXCESS: f64 = 1.15;
/// Below this many faces a mesh is subdivided up to `REFINED_FACES`: descriptors and patches need
/// samples.
const MIN_FACES: usize = 600;
const REFINED_FACES: usize = 1_000;
/// An edge longer than this times the edge of `working_faces` equal triangles is halved.
const LONG_EDGE: f64 = 6.0;
/// Results with more faces than this times the working resolution are simplified more aggressively.
const TOO_FINE: f64 = 1.5;
/// Triangles lower than this fraction of their longest edge may not survive single precision.
const MIN_HEIGHT: f64 = 1e-6;
/// Of two equally distant faces, one whose normal is opposite counts as this much farther, in mean
/// edges.
const OPPOSITE: f64 = 1.0;

/// A mesh at working resolution with the map from the cleaned mesh.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Proxy {
    /// Centred, total area 1 (to single precision), every vertex used and every face with an area.
    pub mesh: TriMesh,
    /// For each face of the cleaned mesh its proxy face `(m,)`.
    pub face_map: Vec<u32>,
    /// Where the origin of the proxy is in the cleaned mesh: `proxy = (cleaned − center) · factor`.
    pub center: [f64; 3],
    /// The scale between the two.
    pub factor: f64,
}

/// A mesh of about `working_faces` faces for a cleaned one, which must have a face.
///
/// Each cleaned face maps to the proxy face nearest to its centroid. A face with an opposite normal
/// counts as farther, so that the two sides of a thin wall are not confused. Components may vanish
/// when there are too many; their faces map to the nearest ones that stay. O(m log m).
///
/// ```
/// use coseg_geometry::mesh::{Format, clean, icosphere, parse, proxy, write};
///
/// let sphere = write::off(&icosphere(4));
/// let cleaned = clean(&parse(sphere.as_bytes(), Format::Off)?)?;
/// let proxy = proxy(&cleaned.mesh, 1_000);
/// assert_eq!(cleaned.mesh.faces.len(), 5_120);
/// assert!((900..=1_150).contains(&proxy.mesh.faces.len()));
/// // The way back: the proxy face of each of the 5,120.
/// assert_eq!(proxy.face_map.len(), 5_120);
/// # Ok::<_, Box<dyn std::error::Error>>(())
/// ```
pub fn proxy(cleaned: &TriMesh, working_faces: u32) -> Proxy {
    let working = working_faces.max(4) as usize;
    let n = cleaned.faces.len();
    let mut mesh = cleaned.clone();
    let simplified = n as f64 > EXCESS * working as f64;
    if simplified {
        mesh.faces = simplify(cleaned, working);
        compact(&mut mesh);
    }
    let n_coarse = mesh.faces.len();
    let few = n_coarse < MIN_FACES.min(working);
    let edge = (4.0 / 3.0_f64.sqrt() / working as f64).sqrt();
    let most = (EXCESS * working as f64) as usize;
    refine(&mut mesh, |longest, n_faces| {
        (few && n_faces < REFINED_FACES.min(working))
            || (longest > LONG_EDGE * edge && n_faces < most)
    });
    let changed = simplified || mesh.faces.len() != n_coarse;

    let (_, center, factor) = normalize(&mut mesh);
    let n_exact = mesh.faces.len();
    let Some(rounded) = round(&mesh) else {
        // The whole mesh is thinner than the resolution of single precision.
        return Proxy {
            mesh: cleaned.clone(),
            face_map: (0..n as u32).collect(),
            center: [0.0; 3],
            factor: 1.0,
        };
    };
    let face_map = if changed || rounded.faces.len() != n_exact {
        face_map(cleaned, center, factor, &rounded)
    } else {
        (0..n as u32).collect()
    };
    Proxy {
        mesh: rounded,
        face_map,
        center,
        factor,
    }
}

/// The faces of a mesh after simplification to about `target`; at least one, each with an area.
fn simplify(mesh: &TriMesh, target: usize) -> Vec<[u32; 3]> {
    let positions: Vec<[f32; 3]> = mesh.vertices.iter().map(|p| p.map(|x| x as f32)).collect();
    let bytes = bytemuck::cast_slice(&positions);
    let vertices = VertexDataAdapter::new(bytes, size_of::<[f32; 3]>(), 0)
        .expect("invariant: the bytes are whole vertices");
    let welded = weld(&positions, &mesh.faces);
    let indices = welded.as_flattened();
    let limit = TOO_FINE * target as f64;
    let sound = |indices: Vec<u32>| -> Vec<[u32; 3]> {
        let (faces, _) = indices.as_chunks::<3>();
        let flat = |f: &[u32; 3]| is_degenerate(f.map(|v| mesh.vertices[v as usize]), MIN_HEIGHT);
        faces.iter().copied().filter(|f| !flat(f)).collect()
    };
    let attempt = |options: SimplifyOptions| {
        sound(meshopt::simplify(
            indices,
            &vertices,
            3 * target,
            1.0,
            options,
            None,
        ))
    };
    let mut best = attempt(SimplifyOptions::Regularize);
    if best.len() as f64 > limit || best.is_empty() {
        // The mesh has many small components or non-manifold vertices, so the smallest components
        // are dropped.
        let pruned = attempt(SimplifyOptions::Regularize | SimplifyOptions::Prune);
        if !pruned.is_empty() {
            best = pruned;
        }
    }
    if best.len() as f64 > limit {
        let sloppy = sound(meshopt::simplify_sloppy(
            indices,
            &vertices,
            3 * target,
            1.0,
            None,
        ));
        // Clustering of vertices can overshoot; results below half of the target are rejected.
        if 2 * sloppy.len() > target {
            best = sloppy;
        }
    }
    if best.is_empty() {
        mesh.faces.clone()
    } else {
        best
    }
}

/// The faces between distinct positions, without those that coincide or collapse: simplification
/// treats vertices at one position as a seam and does not move them.
fn weld(positions: &[[f32; 3]], faces: &[[u32; 3]]) -> Vec<[u32; 3]> {
    // As in cleaning, each word holds the whole sort key.
    let mut order: Vec<u128> = (0_u32..)
        .zip(positions)
        .map(|(v, p)| {
            let bits = p.map(|x| (x + 0.0).to_bits()).into_iter().chain([v]);
            bits.fold(0, |word, x| word << 32 | u128::from(x))
        })
        .collect();
    order.sort_unstable();
    let mut first: Vec<u32> = (0..positions.len() as u32).collect();
    for same in order.chunk_by(|a, b| a >> 32 == b >> 32) {
        for &word in same {
            first[word as u32 as usize] = same[0] as u32;
        }
    }
    let renamed: Vec<[u32; 3]> = faces
        .iter()
        .map(|f| f.map(|v| first[v as usize]))
        .filter(|&[a, b, c]| a != b && b != c && c != a)
        .collect();
    let mut words: Vec<u128> = (0_u128..)
        .zip(&renamed)
        .map(|(f, &corners)| corner_word(corners) << 32 | f)
        .collect();
    words.sort_unstable();
    let mut kept: Vec<u32> = words
        .chunk_by(|a, b| a >> 32 == b >> 32)
        .map(|same| same[0] as u32)
        .collect();
    kept.sort_unstable();
    kept.iter().map(|&f| renamed[f as usize]).collect()
}

/// Drops vertices that no face uses; returns for each vertex its new index, `u32::MAX` for a
/// dropped one.
pub(super) fn compact(mesh: &mut TriMesh) -> Vec<u32> {
    let mut new = vec![u32::MAX; mesh.vertices.len()];
    let mut vertices = Vec::new();
    for v in mesh.faces.as_flattened_mut() {
        let slot = &mut new[*v as usize];
        if *slot == u32::MAX {
            *slot = vertices.len() as u32;
            vertices.push(mesh.vertices[*v as usize]);
        }
        *v = *slot;
    }
    mesh.vertices = vertices;
    new
}

/// The mesh in single precision, without the faces that vanish in it; `None` when all do.
fn round(mesh: &TriMesh) -> Option<TriMesh> {
    let mut result = mesh.clone();
    for p in &mut result.vertices {
        *p = p.map(|x| f64::from(x as f32));
    }
    let corners = |mesh: &TriMesh, f: &[u32; 3]| f.map(|v| mesh.vertices[v as usize]);
    let before = result.faces.len();
    let faces = std::mem::take(&mut result.faces);
    result.faces = faces
        .into_iter()
        .filter(|f| !is_degenerate(corners(&result, f), MIN_HEIGHT))
        .collect();
    if result.faces.len() != before {
        compact(&mut result);
    }
    (!result.faces.is_empty()).then_some(result)
}

/// The proxy face of each cleaned face; `center` and `factor` transform cleaned coordinates to
/// those of the proxy.
fn face_map(cleaned: &TriMesh, center: [f64; 3], factor: f64, proxy: &TriMesh) -> Vec<u32> {
    let from = FaceGeometry::new(cleaned);
    let to = FaceGeometry::new(proxy);
    let tree = Bvh::new(proxy);
    // Edge of an equilateral triangle of the mean area.
    let mean_edge = (4.0 / 3.0_f64.sqrt() / proxy.faces.len() as f64).sqrt();
    let mut hint = 0_u32;
    let mut search = Search::default();
    let mut result = Vec::with_capacity(cleaned.faces.len());
    for (centroid, normal) in from.centroids.iter().zip(&from.normals) {
        let point = scale(sub(*centroid, center), factor);
        let extra = |face: u32| {
            0.5 * OPPOSITE * mean_edge * (1.0 - dot(*normal, to.normals[face as usize])).max(0.0)
        };
        // Neighbours in the file are mostly neighbours in space, so the last answer bounds this
        // search.
        let bound = tree.distance_to(hint, point) + extra(hint);
        let limit = bound * (1.0 + 1e-9) + f64::MIN_POSITIVE;
        hint = tree
            .nearest(&mut search, point, limit, extra)
            .map_or(hint, |(face, _)| face);
        result.push(hint);
    }
    result
}

#[cfg(test)]
mod tests {
    use super::proxy;
    use crate::mesh::{FaceGeometry, TriMesh, clean, distance, dot, zoo};

    /// Total area after rounding to single precision.
    const SINGLE: f64 = 1e-6;

    fn check(name: &str, mesh: &TriMesh, working: u32) {
        let p = proxy(mesh, working);
        let geometry = FaceGeometry::new(&p.mesh);
        let area: f64 = geometry.areas.iter().sum();
        assert!((area - 1.0).abs() < SINGLE, "{name}: area {area}");
        assert!(geometry.areas.iter().all(|&a| a > 0.0), "{name}");
        let mut used = vec![false; p.mesh.vertices.len()];
        for &v in p.mesh.faces.iter().flatten() {
            used[v as usize] = true;
        }
        assert!(used.iter().all(|&u| u), "{name}");
        assert_eq!(p.face_map.len(), mesh.faces.len(), "{name}");
        let m = p.mesh.faces.len();
        assert!(p.face_map.iter().all(|&f| (f as usize) < m), "{name}");
        assert!(
            m as f64 <= 1.6 * f64::from(working),
            "{name}: {m} faces for {working}"
        );
        for x in p.mesh.vertices.iter().flatten() {
            assert_eq!(*x, f64::from(*x as f32), "{name}: not single precision");
        }
    }

    #[test]
    fn every_mesh_of_the_zoo_comes_to_working_resolution() {
        for (name, mesh) in zoo::clean_meshes() {
            for working in [200, 2_500] {
                check(name, &mesh, working);
            }
        }
    }

    #[test]
    fn a_fine_sphere_becomes_a_coarse_one_with_good_angles() {
        let fine = clean(&zoo::parsed(&zoo::sphere(5))).unwrap().mesh;
        let p = proxy(&fine, 2_500);
        assert!(
            (2_000..=2_875).contains(&p.mesh.faces.len()),
            "{}",
            p.mesh.faces.len()
        );
        let mut smallest = Vec::new();
        for f in 0..p.mesh.faces.len() {
            let [a, b, c] = p.mesh.corners(f);
            let (x, y, z) = (distance(b, c), distance(c, a), distance(a, b));
            let angle = |o: f64, s: f64, t: f64| ((s * s + t * t - o * o) / (2.0 * s * t)).acos();
            smallest.push(
                angle(x, y, z)
                    .min(angle(y, z, x))
                    .min(angle(z, x, y))
                    .to_degrees(),
            );
        }
        let mean = smallest.iter().sum::<f64>() / smallest.len() as f64;
        assert!(mean > 30.0, "mean smallest angle {mean}");
        let (from, to) = (FaceGeometry::new(&fine), FaceGeometry::new(&p.mesh));
        for (f, &g) in p.face_map.iter().enumerate() {
            let d = distance(from.centroids[f], to.centroids[g as usize]);
            assert!(d < 0.06, "face {f} is {d} from its proxy face");
        }
    }

    #[test]
    fn a_mesh_of_the_right_size_is_kept_face_by_face() {
        let mesh = clean(&zoo::parsed(&zoo::sphere(3))).unwrap().mesh;
        let p = proxy(&mesh, 1_280);
        assert_eq!(p.mesh.faces, mesh.faces);
        assert!(p.face_map.iter().enumerate().all(|(i, &f)| f == i as u32));
    }

    #[test]
    fn a_coarse_mesh_is_cut_and_its_faces_map_into_themselves() {
        let mesh = clean(&zoo::parsed(&zoo::cube())).unwrap().mesh;
        let p = proxy(&mesh, 2_500);
        assert!(
            (1_000..1_010).contains(&p.mesh.faces.len()),
            "{}",
            p.mesh.faces.len()
        );
        let (from, to) = (FaceGeometry::new(&mesh), FaceGeometry::new(&p.mesh));
        for (f, &g) in p.face_map.iter().enumerate() {
            assert!(dot(from.normals[f], to.normals[g as usize]) > 0.999);
        }
    }

    #[test]
    fn the_sides_of_a_thin_plate_stay_apart() {
        let mut plate = zoo::thin_plate();
        crate::mesh::refine::refine(&mut plate, |_, n| n < 6_000);
        let mesh = clean(&zoo::parsed(&plate)).unwrap().mesh;
        let p = proxy(&mesh, 1_000);
        assert!(p.mesh.faces.len() < 1_200);
        let (from, to) = (FaceGeometry::new(&mesh), FaceGeometry::new(&p.mesh));
        for (f, &g) in p.face_map.iter().enumerate() {
            if from.normals[f][2].abs() > 0.9 {
                assert!(
                    dot(from.normals[f], to.normals[g as usize]) > 0.5,
                    "face {f} changed sides"
                );
            }
        }
    }

    #[test]
    fn thousands_of_crumbs_still_come_down_to_size() {
        let crumbs: Vec<TriMesh> = (0..1_400)
            .map(|i| {
                let (x, y) = (f64::from(i % 40), f64::from(i / 40));
                zoo::moved(&zoo::scaled(&zoo::sphere(1), 0.2), [x, y, 0.0])
            })
            .collect();
        let mesh = clean(&zoo::parsed(&zoo::union(&crumbs))).unwrap().mesh;
        check("crumbs", &mesh, 2_500);
    }
}
