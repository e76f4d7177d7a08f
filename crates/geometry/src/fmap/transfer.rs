//! Transfers functions and labels on one shape to another.

use super::basis::{Basis, product};

/// Transfers values `(n1, dim)` at the vertices of shape 1 to values `(n2, dim)` at those of shape
/// 2, vertex by vertex: `values[p2p_21]`.
///
/// ```
/// use coseg_geometry::fmap::transfer::pulled_back;
///
/// // Vertices 0 and 1 of shape 2 correspond to vertex 2 of shape 1.
/// assert_eq!(pulled_back(&[2, 2, 0], &["head", "arm", "foot"], 1), ["foot", "foot", "head"]);
/// ```
///
/// # Panics
/// If the map names a vertex that does not exist.
pub fn pulled_back<T: Copy>(p2p_21: &[u32], values: &[T], dim: usize) -> Vec<T> {
    let mut out = Vec::with_capacity(p2p_21.len() * dim);
    for &t in p2p_21 {
        out.extend_from_slice(&values[t as usize * dim..(t as usize + 1) * dim]);
    }
    out
}

/// Transfers values `(n1, dim)` as functions: projects them onto the first `k1` eigenfunctions,
/// maps them by `c_12 (k2, k1)`, and evaluates the result `(n2, dim)`. The result is smooth and
/// lacks detail that the basis does not represent.
///
/// ```
/// use coseg_geometry::fmap::transfer::transferred;
/// use coseg_geometry::{SpectralMesh, mesh::icosphere, operators::Operator, spectrum::Options};
///
/// let sphere = SpectralMesh::new(icosphere(3), Operator::Tufted, 4, &Options::default())?;
/// let height: Vec<f32> = sphere.mesh.vertices.iter().map(|p| p[2] as f32).collect();
/// // The point reflection turns height over.
/// let c = [1.0, 0., 0., 0., 0., -1.0, 0., 0., 0., 0., -1.0, 0., 0., 0., 0., -1.0];
/// let found = transferred(&sphere.basis(), &sphere.basis(), &c, 4, &height, 1);
/// assert!(found.iter().zip(&height).all(|(x, z)| (x + z).abs() < 0.01));
/// # Ok::<_, coseg_geometry::SpectralMeshError>(())
/// ```
///
/// # Panics
/// If there are fewer than `k1` or `k2` eigenvectors.
pub fn transferred(
    one: &Basis<'_>,
    two: &Basis<'_>,
    c_12: &[f32],
    k1: usize,
    values: &[f32],
    dim: usize,
) -> Vec<f32> {
    let k2 = c_12.len() / k1.max(1);
    let coefficients = one.project(values, dim, k1);
    let mapped = product(c_12, &coefficients, k2, k1, dim);
    product(&two.leading(k2), &mapped, two.n_vertices(), k2, dim)
}

/// Transfers values at faces `(m1, dim)` of shape 1, which has `n_1` vertices, to values at faces
/// `(m2, dim)` of shape 2: for each face, the mean over its corners of the mean over the faces
/// around the matched vertices. Labels and other classes are transferred as indicators. `matched
/// (n2,)` marks vertices with a counterpart; a face with fewer than two such corners gets NaN.
///
/// ```
/// use coseg_geometry::fmap::transfer::faces_to_faces;
///
/// let (faces, identity) = ([[0, 1, 2], [2, 1, 3]], [0, 1, 2, 3]);
/// let found = faces_to_faces(&faces, &faces, 4, &identity, &[true; 4], &[0.0, 1.0], 1);
/// // Corners 1 and 2 are shared, and have the mean of both faces.
/// assert!((found[0] - 1.0 / 3.0).abs() < 1e-6 && (found[1] - 2.0 / 3.0).abs() < 1e-6);
/// let matched = [true, false, false, true];
/// let nothing = faces_to_faces(&faces, &faces, 4, &identity, &matched, &[0.0, 1.0], 1);
/// assert!(nothing.iter().all(|x| x.is_nan()));
/// ```
pub fn faces_to_faces(
    faces_1: &[[u32; 3]],
    faces_2: &[[u32; 3]],
    n_1: usize,
    p2p_21: &[u32],
    matched: &[bool],
    values: &[f32],
    dim: usize,
) -> Vec<f32> {
    let mut at_vertices = vec![0.0f32; n_1 * dim];
    let mut count = vec![0u32; n_1];
    for (face, row) in faces_1.iter().zip(values.chunks_exact(dim.max(1))) {
        for v in face {
            let v = *v as usize;
            count[v] += 1;
            for (sum, x) in at_vertices[v * dim..(v + 1) * dim].iter_mut().zip(row) {
                *sum += x;
            }
        }
    }
    for (row, n) in at_vertices.chunks_exact_mut(dim.max(1)).zip(&count) {
        row.iter_mut().for_each(|x| *x /= (*n).max(1) as f32);
    }
    let mut out = Vec::with_capacity(faces_2.len() * dim);
    for face in faces_2 {
        let corners = face.iter().filter(|v| matched[**v as usize]);
        let corners: Vec<usize> = corners
            .map(|v| p2p_21[*v as usize] as usize * dim)
            .collect();
        if corners.len() < 2 {
            out.extend(std::iter::repeat_n(f32::NAN, dim));
            continue;
        }
        let n = corners.len() as f32;
        out.extend((0..dim).map(|c| corners.iter().map(|at| at_vertices[at + c]).sum::<f32>() / n));
    }
    out
}

/// The label of each face of shape 2 `(m2,)` that most of the faces around the vertices matched to
/// its corners have; the lowest on ties; −1 without counterpart (see [`faces_to_faces`]).
///
/// ```
/// use coseg_geometry::fmap::transfer::labels_to_faces;
///
/// // A strip of four triangles, mapped onto itself the other way round.
/// let faces = [[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4]];
/// let turned = [5, 4, 3, 2, 1, 0];
/// let found = labels_to_faces(&faces, &faces, 6, &turned, &[true; 6], &[7, 7, 2, 2]);
/// assert_eq!(found, [2, 2, 7, 7]);
/// ```
pub fn labels_to_faces(
    faces_1: &[[u32; 3]],
    faces_2: &[[u32; 3]],
    n_1: usize,
    p2p_21: &[u32],
    matched: &[bool],
    labels: &[i32],
) -> Vec<i32> {
    let mut kinds = labels.to_vec();
    kinds.sort_unstable();
    kinds.dedup();
    let dim = kinds.len();
    let indicators: Vec<f32> = labels
        .iter()
        .flat_map(|l| kinds.iter().map(move |k| f32::from(u8::from(k == l))))
        .collect();
    let votes = faces_to_faces(faces_1, faces_2, n_1, p2p_21, matched, &indicators, dim);
    let most = |row: &[f32]| {
        if row[0].is_nan() {
            return -1;
        }
        let mut best = 0;
        for (i, x) in row.iter().enumerate() {
            if *x > row[best] {
                best = i;
            }
        }
        kinds[best]
    };
    votes.chunks_exact(dim.max(1)).map(most).collect()
}

#[cfg(test)]
mod tests {
    use super::super::convert::functional;
    use super::super::test_shapes::cycle;
    use super::{faces_to_faces, labels_to_faces, pulled_back, transferred};

    #[test]
    fn both_ways_transfer_a_smooth_function() {
        let (a, b) = (cycle(120, 0), cycle(120, 40));
        let p2p: Vec<u32> = (0..120).map(|v| (v + 40) % 120).collect();
        let c = functional(&a.basis(), &b.basis(), &p2p, 11, 11);
        let f: Vec<f32> = (0..120).map(|v| a.eigenvectors[v * 11 + 3] - 2.0).collect();
        let sharp = pulled_back(&p2p, &f, 1);
        let smooth = transferred(&a.basis(), &b.basis(), &c, 11, &f, 1);
        for v in 0..120 {
            assert_eq!(sharp[v], f[(v + 40) % 120]);
            assert!((smooth[v] - sharp[v]).abs() < 1e-3);
        }
    }

    #[test]
    fn faces_take_what_is_around_the_matched_corners() {
        // A strip of four triangles is mapped onto itself in reverse.
        let faces = [[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4]];
        let p2p = [5, 4, 3, 2, 1, 0];
        let labels = [7, 7, 2, 2];
        assert_eq!(
            labels_to_faces(&faces, &faces, 6, &p2p, &[true; 6], &labels),
            [2, 2, 7, 7]
        );
        let ones = [1.0, 1.0, 1.0, 1.0];
        let transferred = faces_to_faces(&faces, &faces, 6, &p2p, &[true; 6], &ones, 1);
        assert!(transferred.iter().all(|x| (x - 1.0).abs() < 1e-6));
        // One end of the strip has no counterpart.
        let matched = [false, false, true, true, true, true];
        assert_eq!(
            labels_to_faces(&faces, &faces, 6, &p2p, &matched, &labels),
            [-1, 2, 7, 7]
        );
        let transferred = faces_to_faces(&faces, &faces, 6, &p2p, &matched, &ones, 1);
        assert!(transferred[0].is_nan() && transferred[1..].iter().all(|x| (x - 1.0).abs() < 1e-6));
    }
}
