//! Computes one vector from the face descriptors and the spectrum of a shape; similar shapes have
//! similar vectors.

use super::{FaceDescriptors, shape_dna};
use crate::mesh::{FaceGeometry, TriMesh};

/// Quantiles of each column over the area.
const QUANTILES: [f64; 3] = [0.1, 0.5, 0.9];
/// Eigenvalues of the ShapeDNA part.
pub const N_SHAPE_DNA: usize = 20;

/// Signature `(4 n + 20,)` of a shape whose face descriptors have n columns: their means over the
/// area, then their 0.1, 0.5 and 0.9 quantiles over the area, then 20 logarithms of eigenvalues.
/// Nothing is standardised or weighted here, since that needs the other shapes. O(m n log m).
///
/// ```
/// use coseg_geometry::descriptors::{FaceDescriptors, signature};
/// use coseg_geometry::mesh::icosphere;
///
/// let sphere = icosphere(2);
/// let constant = vec![7.0; sphere.faces.len()];
/// let face = FaceDescriptors { data: constant, n: 1, farthest_start: 0 };
/// let found = signature(&sphere, &face, &[0.0, 1.0]);
/// assert_eq!(found.len(), 4 + 20);
/// assert!((found[0] - 7.0).abs() < 1e-5); // the mean
/// assert_eq!(found[1..4], [7.0; 3]); // the quantiles
/// ```
pub fn signature(mesh: &TriMesh, face: &FaceDescriptors, eigenvalues: &[f64]) -> Vec<f32> {
    let areas = FaceGeometry::new(mesh).areas;
    let total: f64 = areas.iter().sum();
    let n = face.n;
    let mut result = vec![0.0; n * (1 + QUANTILES.len())];
    // Packs a value and its face into one word, which sorts faster than a pair.
    let mut column: Vec<u64> = Vec::with_capacity(areas.len());
    for j in 0..n {
        column.clear();
        let mut sum = 0.0;
        for ((f, row), area) in (0_u64..).zip(face.data.chunks_exact(n)).zip(&areas) {
            sum += f64::from(row[j]) * area;
            column.push(u64::from(order_bits(row[j])) << 32 | f);
        }
        result[j] = (sum / total) as f32;
        column.sort_unstable();
        let face_at = |at: usize| column[at] as u32 as usize;
        let mut below = 0.0;
        let mut at = 0;
        for (i, q) in QUANTILES.iter().enumerate() {
            while at + 1 < column.len() && below + areas[face_at(at)] < q * total {
                below += areas[face_at(at)];
                at += 1;
            }
            if at < column.len() {
                result[(i + 1) * n + j] = face.data[face_at(at) * n + j];
            }
        }
    }
    result.extend(shape_dna(eigenvalues, N_SHAPE_DNA));
    result
}

/// Maps a float to bits that have the same order as the numbers.
fn order_bits(x: f32) -> u32 {
    let bits = x.to_bits();
    if bits >> 31 == 0 {
        bits | 1 << 31
    } else {
        !bits
    }
}

#[cfg(test)]
mod tests {
    use super::{N_SHAPE_DNA, order_bits, signature};
    use crate::descriptors::FaceDescriptors;
    use crate::mesh::zoo;

    #[test]
    fn means_and_quantiles_are_over_the_area() {
        // Ten columns of two equal triangles; one column counts the columns, one is constant.
        let mesh = zoo::grid(10, 1);
        let data = (0..20).flat_map(|f| [(f / 2) as f32, 7.0]).collect();
        let face = FaceDescriptors {
            data,
            n: 2,
            farthest_start: 0,
        };
        let values: Vec<f64> = (0..30).map(f64::from).collect();
        let s = signature(&mesh, &face, &values);
        assert_eq!(s.len(), 8 + N_SHAPE_DNA);
        assert_eq!(s[..8], [4.5, 7.0, 0.0, 7.0, 4.0, 7.0, 8.0, 7.0]);
        assert_eq!(s[8..10], [0.0, 2.0_f32.ln()]);
    }

    #[test]
    fn bits_are_ordered_as_numbers_are() {
        let ascending = [
            f32::NEG_INFINITY,
            -2.0,
            -1e-30,
            -0.0,
            0.0,
            1e-40,
            3.0,
            f32::INFINITY,
        ];
        assert!(
            ascending
                .windows(2)
                .all(|w| order_bits(w[0]) < order_bits(w[1]))
        );
    }
}
