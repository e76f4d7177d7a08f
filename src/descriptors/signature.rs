//! The face descriptors and the spectrum of a shape become one vector, by which similar shapes are found.

use super::{FaceDescriptors, shape_dna};
use crate::mesh::{FaceGeometry, TriMesh};

/// Quantiles of each column over the area.
const QUANTILES: [f64; 3] = [0.1, 0.5, 0.9];
/// Eigenvalues of the ShapeDNA part.
pub const N_SHAPE_DNA: usize = 20;

/// Signature `(4 n + 20,)` of a shape whose face descriptors have n columns: their means over the area,
/// then their 0.1, 0.5 and 0.9 quantiles over the area, then 20 logarithms of eigenvalues. Nothing is
/// standardised or weighted: that needs the other shapes. O(m n log m).
pub fn signature(mesh: &TriMesh, face: &FaceDescriptors, eigenvalues: &[f64]) -> Vec<f32> {
    let areas = FaceGeometry::new(mesh).areas;
    let total: f64 = areas.iter().sum();
    let n = face.n;
    let mut result = vec![0.0; n * (1 + QUANTILES.len())];
    let mut column: Vec<(f32, f64)> = Vec::with_capacity(areas.len());
    for j in 0..n {
        column.clear();
        column.extend(
            face.data
                .chunks_exact(n)
                .map(|row| row[j])
                .zip(areas.iter().copied()),
        );
        let sum: f64 = column.iter().map(|&(x, area)| f64::from(x) * area).sum();
        result[j] = (sum / total) as f32;
        column.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
        let mut below = 0.0;
        let mut at = 0;
        for (i, q) in QUANTILES.iter().enumerate() {
            while at + 1 < column.len() && below + column[at].1 < q * total {
                below += column[at].1;
                at += 1;
            }
            result[(i + 1) * n + j] = column.get(at).map_or(0.0, |c| c.0);
        }
    }
    result.extend(shape_dna(eigenvalues, N_SHAPE_DNA));
    result
}

#[cfg(test)]
mod tests {
    use super::{N_SHAPE_DNA, signature};
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
}
