//! Parts of many shapes become one affinity graph: it links similar parts of different shapes, and
//! touching parts of one shape.

use crate::linalg::lanczos_top::largest_eigenpairs;
use nalgebra::DMatrix;
use sprs::{CsMat, TriMat};

/// Number of nearest rows in each other shape that a row is linked to.
const N_NEAREST: usize = 2;

/// Rows of several shapes, one shape after the other: `values (n, dim)`, and the index of the first
/// row of each shape.
pub(super) struct Rows<'a> {
    pub(super) values: &'a [f64],
    pub(super) dim: usize,
    /// `(n_shapes + 1,)`.
    pub(super) offsets: &'a [usize],
}

/// Computes the symmetric affinity between rows of different shapes. Each row is linked to its two
/// nearest in every other shape with `exp(−D² / √(sᵢ sⱼ))`, where `sᵢ` is the median D² of i's
/// links (self-tuning: Zelnik-Manor and Perona 2004). Of the two directions of a link the stronger
/// counts.
pub(super) fn inter_shape(rows: &Rows<'_>) -> CsMat<f64> {
    let n = *rows.offsets.last().unwrap_or(&0);
    let mut links: Vec<(usize, usize, f64)> = Vec::new();
    let n_shapes = rows.offsets.len().saturating_sub(1);
    let block = |s: usize| {
        let (a, b) = (rows.offsets[s], rows.offsets[s + 1]);
        DMatrix::from_column_slice(rows.dim, b - a, &rows.values[a * rows.dim..b * rows.dim])
    };
    let blocks: Vec<DMatrix<f64>> = (0..n_shapes).map(block).collect();
    let norms: Vec<Vec<f64>> = blocks
        .iter()
        .map(|b| b.column_iter().map(|c| c.norm_squared()).collect())
        .collect();
    for a in 0..n_shapes {
        let transposed = blocks[a].transpose();
        for b in (0..n_shapes).filter(|&b| b != a) {
            let product = &transposed * &blocks[b];
            for i in 0..product.nrows() {
                let mut nearest = [(f64::INFINITY, usize::MAX); N_NEAREST];
                for j in 0..product.ncols() {
                    let d = (norms[a][i] + norms[b][j] - 2.0 * product[(i, j)]).max(0.0);
                    if d < nearest[N_NEAREST - 1].0 {
                        nearest[N_NEAREST - 1] = (d, j);
                        nearest.sort_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)));
                    }
                }
                for (d, j) in nearest.into_iter().filter(|x| x.1 != usize::MAX) {
                    links.push((rows.offsets[a] + i, rows.offsets[b] + j, d));
                }
            }
        }
    }
    let mut scale = vec![0.0; n];
    let mut of_row: Vec<Vec<f64>> = vec![Vec::new(); n];
    for &(i, _, d) in &links {
        of_row[i].push(d);
    }
    for (s, d) in scale.iter_mut().zip(&mut of_row) {
        d.sort_by(f64::total_cmp);
        if !d.is_empty() {
            *s = (d[(d.len() - 1) / 2] + d[d.len() / 2]) / 2.0;
        }
    }
    let mut strongest = std::collections::BTreeMap::<(usize, usize), f64>::new();
    for (i, j, d) in links {
        let w = (-d / ((scale[i] * scale[j]).sqrt() + 1e-12)).exp();
        let entry = strongest.entry((i.min(j), i.max(j))).or_default();
        *entry = entry.max(w);
    }
    symmetric(n, strongest.into_iter().map(|((i, j), w)| (i, j, w)))
}

/// Builds a symmetric matrix from its upper entries.
pub(super) fn symmetric(n: usize, upper: impl Iterator<Item = (usize, usize, f64)>) -> CsMat<f64> {
    let mut t = TriMat::new((n, n));
    for (i, j, w) in upper {
        t.add_triplet(i, j, w);
        if i != j {
            t.add_triplet(j, i, w);
        }
    }
    t.to_csr()
}

/// Returns the row sums.
pub(super) fn degrees(matrix: &CsMat<f64>) -> Vec<f64> {
    matrix
        .outer_iterator()
        .map(|row| row.data().iter().sum())
        .collect()
}

/// Returns `D^{-1/2} M D^{-1/2}`.
fn normalised(matrix: &CsMat<f64>) -> CsMat<f64> {
    let roots: Vec<f64> = degrees(matrix)
        .iter()
        .map(|d| 1.0 / d.max(1e-12).sqrt())
        .collect();
    let mut out = matrix.clone();
    for (i, mut row) in out.outer_iterator_mut().enumerate() {
        for (j, w) in row.iter_mut() {
            *w *= roots[i] * roots[j];
        }
    }
    out
}

/// Returns `(1 − α) N(inter) + α N(intra)`, where N is the symmetric normalisation.
pub(super) fn combine(inter: &CsMat<f64>, intra: &CsMat<f64>, alpha: f64) -> CsMat<f64> {
    let a = normalised(inter).map(|w| (1.0 - alpha) * w);
    let b = normalised(intra).map(|w| alpha * w);
    &a + &b
}

/// Returns eigenvalues (descending) and eigenvectors `(n, k)` of the normalised graph, and its
/// degrees.
pub(super) fn embedding(graph: &CsMat<f64>, k: usize) -> (Vec<f64>, DMatrix<f64>, Vec<f64>) {
    let (values, vectors) = largest_eigenpairs(&normalised(graph), k);
    (values, vectors, degrees(graph))
}

/// Returns the first `width` eigenvectors with rows scaled to length 1 (Ng, Jordan and Weiss 2001).
pub(super) fn row_normalised(basis: &DMatrix<f64>, width: usize) -> Vec<f64> {
    let mut out = Vec::with_capacity(basis.nrows() * width);
    for row in basis.row_iter() {
        let norm = row.columns(0, width).norm().max(1e-9);
        out.extend(row.iter().take(width).map(|x| x / norm));
    }
    out
}

/// Returns diffusion coordinates after three steps, without the constant one (Coifman and Lafon
/// 2006).
pub(super) fn diffusion(
    values: &[f64],
    basis: &DMatrix<f64>,
    degrees: &[f64],
    width: usize,
) -> Vec<f64> {
    let mut out = Vec::with_capacity(basis.nrows() * (width - 1));
    for (row, degree) in basis.row_iter().zip(degrees) {
        out.extend(
            (1..width).map(|c| row[c] / degree.sqrt().max(1e-12) * values[c].max(0.0).powi(3)),
        );
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn links_join_like_rows_of_different_shapes_only() {
        // Two shapes of three parts each; part q of both lies near 10 q.
        let values = [0.0, 10.0, 20.0, 0.5, 10.5, 20.5];
        let graph = inter_shape(&Rows {
            values: &values,
            dim: 1,
            offsets: &[0, 3, 6],
        });
        for (&w, (i, j)) in &graph {
            assert_ne!(i / 3, j / 3, "a link within one shape");
            assert_eq!(w, *graph.get(j, i).unwrap());
        }
        for q in 0..3 {
            let own = graph.get(q, q + 3).copied().unwrap();
            assert!(graph.outer_view(q).unwrap().iter().all(|(_, w)| *w <= own));
        }
    }

    #[test]
    fn the_normalised_graph_has_top_eigenvalue_one() {
        let values: Vec<f64> = (0..40)
            .map(|i| f64::from(i % 10) + 0.01 * f64::from(i))
            .collect();
        let graph = inter_shape(&Rows {
            values: &values,
            dim: 1,
            offsets: &[0, 10, 20, 30, 40],
        });
        let (top, ..) = embedding(&graph, 3);
        assert!((top[0] - 1.0).abs() < 1e-9 && top[2] <= top[1]);
    }
}
