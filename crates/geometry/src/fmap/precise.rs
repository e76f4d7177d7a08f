//! Computes a map to points inside triangles from a functional map (Ezuz and Ben-Chen 2017,
//! *Deblurring and Denoising of Maps between Shapes*).
//!
//! Triangles of shape 1 are triangles in the embedding too. Each row of shape 2 is mapped to the
//! nearest point of the triangles around the nearest vertex and around its neighbours. On triangles
//! smaller than the resolution of the map, that is the nearest point of all.

use super::basis::{Basis, product_transposed};
use crate::linalg::nearest::nearest_rows;

/// A point of shape 1 for each vertex of shape 2.
#[derive(Debug, Clone, PartialEq)]
pub struct PreciseMap {
    /// Face of shape 1 `(n2,)`.
    pub face: Vec<u32>,
    /// Barycentric coordinates there `(n2, 3)`, not negative, of sum 1.
    pub barycentric: Vec<[f32; 3]>,
}

impl PreciseMap {
    /// Interpolates values `(n1, dim)` at the vertices of shape 1 with these faces linearly inside
    /// the faces: values `(n2, dim)` on shape 2.
    ///
    /// ```
    /// use coseg_geometry::fmap::precise::PreciseMap;
    ///
    /// // One vertex of shape 2, mapped to the middle of an edge.
    /// let map = PreciseMap { face: vec![0], barycentric: vec![[0.5, 0.5, 0.0]] };
    /// assert_eq!(map.pulled_back(&[[0, 1, 2]], &[2.0, 4.0, 9.0], 1), [3.0]);
    /// ```
    pub fn pulled_back(&self, faces: &[[u32; 3]], values: &[f32], dim: usize) -> Vec<f32> {
        let mut out = Vec::with_capacity(self.face.len() * dim);
        for (f, b) in self.face.iter().zip(&self.barycentric) {
            let corners = faces[*f as usize].map(|v| v as usize * dim);
            let at = |c: usize| (0..3).map(|i| b[i] * values[corners[i] + c]).sum::<f32>();
            out.extend((0..dim).map(at));
        }
        out
    }
}

/// The precise map of `c_12 (k2, k1)`: for each vertex of shape 2 a point in a face of shape 1,
/// whose `faces` are given. O(n1 n2 k2).
///
/// ```
/// use coseg_geometry::fmap::precise::precise;
/// use coseg_geometry::{SpectralMesh, mesh::icosphere, operators::Operator, spectrum::Options};
///
/// let sphere = SpectralMesh::new(icosphere(2), Operator::Tufted, 4, &Options::default())?;
/// let identity = [1.0, 0., 0., 0., 0., 1.0, 0., 0., 0., 0., 1.0, 0., 0., 0., 0., 1.0];
/// let basis = sphere.basis();
/// let map = precise(&basis, &basis, &sphere.mesh.faces, &identity, 4);
/// // Each vertex comes to lie where it is: in a corner of a face.
/// let x: Vec<f32> = sphere.mesh.vertices.iter().map(|p| p[0] as f32).collect();
/// let there = map.pulled_back(&sphere.mesh.faces, &x, 1);
/// assert!(there.iter().zip(&x).all(|(a, b)| (a - b).abs() < 1e-4));
/// # Ok::<_, coseg_geometry::SpectralMeshError>(())
/// ```
///
/// # Panics
/// If there is no face, or a vertex has none.
pub fn precise(
    one: &Basis<'_>,
    two: &Basis<'_>,
    faces: &[[u32; 3]],
    c_12: &[f32],
    k1: usize,
) -> PreciseMap {
    let k2 = c_12.len() / k1;
    let targets = product_transposed(&one.leading(k1), c_12, one.n_vertices(), k1, k2);
    let queries = two.leading(k2);
    let nearest = nearest_rows(&queries, &targets, k2);
    let mut around = vec![Vec::new(); one.n_vertices()];
    for (f, face) in faces.iter().enumerate() {
        for v in face {
            around[*v as usize].push(f as u32);
        }
    }
    let row = |v: u32| &targets[v as usize * k2..(v as usize + 1) * k2];
    let mut map = PreciseMap {
        face: Vec::with_capacity(nearest.len()),
        barycentric: Vec::with_capacity(nearest.len()),
    };
    let mut tried: Vec<u32> = Vec::new();
    for (query, &v) in queries.chunks_exact(k2).zip(&nearest) {
        tried.clear();
        for f in &around[v as usize] {
            for w in faces[*f as usize] {
                tried.extend(&around[w as usize]);
            }
        }
        tried.sort_unstable();
        tried.dedup();
        let mut best = (f32::INFINITY, 0, [1.0, 0.0, 0.0]);
        for &f in &tried {
            let (distance, b) = nearest_in_triangle(query, faces[f as usize].map(row));
            if distance < best.0 {
                best = (distance, f, b);
            }
        }
        assert!(!tried.is_empty(), "vertex {v} has no face");
        map.face.push(best.1);
        map.barycentric.push(best.2);
    }
    map
}

/// Squared distance to the nearest point of a triangle in any dimension, and its barycentric
/// coordinates (after Ericson 2005, *Real-Time Collision Detection*, section 5.1.5, which needs dot
/// products only).
pub(crate) fn nearest_in_triangle(p: &[f32], [a, b, c]: [&[f32]; 3]) -> (f32, [f32; 3]) {
    let (mut d1, mut d2, mut bb, mut bc, mut cc) = (0.0f64, 0.0f64, 0.0f64, 0.0f64, 0.0f64);
    for i in 0..p.len() {
        let (u, w, q) = (
            f64::from(b[i] - a[i]),
            f64::from(c[i] - a[i]),
            f64::from(p[i] - a[i]),
        );
        d1 += u * q;
        d2 += w * q;
        bb += u * u;
        bc += u * w;
        cc += w * w;
    }
    let (d3, d4, d5, d6) = (d1 - bb, d2 - bc, d1 - bc, d2 - cc);
    let clamp = |x: f64| {
        if x.is_finite() {
            x.clamp(0.0, 1.0)
        } else {
            0.0
        }
    };
    let (va, vb, vc) = (d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2);
    let weights = if d1 <= 0.0 && d2 <= 0.0 {
        [1.0, 0.0, 0.0]
    } else if d3 >= 0.0 && d4 <= d3 {
        [0.0, 1.0, 0.0]
    } else if d6 >= 0.0 && d5 <= d6 {
        [0.0, 0.0, 1.0]
    } else if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        let t = clamp(d1 / (d1 - d3));
        [1.0 - t, t, 0.0]
    } else if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        let t = clamp(d2 / (d2 - d6));
        [1.0 - t, 0.0, t]
    } else if va <= 0.0 && d4 >= d3 && d5 >= d6 {
        let t = clamp((d4 - d3) / ((d4 - d3) + (d5 - d6)));
        [0.0, 1.0 - t, t]
    } else {
        let sum = va + vb + vc;
        let (v, w) = (clamp(vb / sum), clamp(vc / sum));
        [(1.0 - v - w).max(0.0), v, w]
    };
    let weights = weights.map(|w| w as f32);
    let distance = (0..p.len())
        .map(|i| (p[i] - weights[0] * a[i] - weights[1] * b[i] - weights[2] * c[i]).powi(2))
        .sum();
    (distance, weights)
}

#[cfg(test)]
mod tests {
    use super::nearest_in_triangle;
    use rand::{Rng, SeedableRng};

    #[test]
    fn no_point_of_the_triangle_is_nearer() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(8);
        let mut inside = 0;
        for _ in 0..300 {
            let mut point =
                || -> Vec<f32> { (0..5).map(|_| rng.random_range(-1.0..1.0)).collect() };
            let (a, b, c, p) = (point(), point(), point(), point());
            let (distance, w) = nearest_in_triangle(&p, [&a, &b, &c]);
            assert!(w.iter().all(|x| *x >= 0.0) && (w.iter().sum::<f32>() - 1.0).abs() < 1e-5);
            inside += usize::from(w.iter().all(|x| *x > 0.0));
            for i in 0..=20 {
                for j in 0..=20 - i {
                    let (u, v) = (i as f32 / 20.0, j as f32 / 20.0);
                    let other: f32 = (0..5)
                        .map(|x| (p[x] - (1.0 - u - v) * a[x] - u * b[x] - v * c[x]).powi(2))
                        .sum();
                    assert!(distance <= other + 1e-5);
                }
            }
        }
        assert!(inside > 20);
    }
}
