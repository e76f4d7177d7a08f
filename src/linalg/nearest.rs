//! Nearest rows in 20 to 200 dimensions, by blocked matrix products.
//!
//! k-d trees degrade above a dozen dimensions; one GEMM per block does not, and never holds more than
//! a block of the distance matrix.

use faer::linalg::matmul::matmul;
use faer::{Accum, Mat, MatRef, Par};

const BLOCK: usize = 256;

/// For each row of `queries (q, dim)` the index of the nearest row of `targets (t, dim)` in the
/// Euclidean norm, both row-major; ties go to the lowest index. Costs `2 q t dim` flops.
///
/// # Panics
/// If `targets` is empty or a length is not a multiple of `dim`.
pub fn nearest_rows(queries: &[f32], targets: &[f32], dim: usize) -> Vec<u32> {
    assert!(dim > 0 && queries.len().is_multiple_of(dim) && targets.len().is_multiple_of(dim));
    let n_targets = targets.len() / dim;
    assert!(n_targets > 0, "nearest_rows needs at least one target");
    let n_queries = queries.len() / dim;
    let half_norms: Vec<f32> = targets
        .chunks_exact(dim)
        .map(|t| 0.5 * t.iter().map(|x| x * x).sum::<f32>())
        .collect();
    let mut nearest = vec![0u32; n_queries];
    let mut best = vec![f32::INFINITY; n_queries];
    // Column q of the product holds query q against a block of targets: contiguous for the scan.
    let mut product = Mat::<f32>::zeros(BLOCK.min(n_targets), BLOCK.min(n_queries.max(1)));
    for q0 in (0..n_queries).step_by(BLOCK) {
        let nq = BLOCK.min(n_queries - q0);
        let q = MatRef::from_row_major_slice(&queries[q0 * dim..(q0 + nq) * dim], nq, dim);
        for t0 in (0..n_targets).step_by(BLOCK) {
            let nt = BLOCK.min(n_targets - t0);
            let t = MatRef::from_row_major_slice(&targets[t0 * dim..(t0 + nt) * dim], nt, dim);
            let mut block = product.as_mut().submatrix_mut(0, 0, nt, nq);
            matmul(
                block.as_mut(),
                Accum::Replace,
                t,
                q.transpose(),
                1.0f32,
                Par::Seq,
            );
            for j in 0..nq {
                let column = block.as_ref().col(j);
                let Some(column) = column.try_as_col_major() else {
                    unreachable!("owned columns")
                };
                let (at, value) = least(column.as_slice(), &half_norms[t0..t0 + nt]);
                if value < best[q0 + j] {
                    best[q0 + j] = value;
                    nearest[q0 + j] = (t0 + at) as u32;
                }
            }
        }
    }
    nearest
}

/// Index and value of the least `half_norm − product`; the lowest index on ties.
fn least(product: &[f32], half_norms: &[f32]) -> (usize, f32) {
    // Eight independent lanes let the compiler keep the scan in vector registers.
    let mut value = [f32::INFINITY; 8];
    let mut at = [0u32; 8];
    let whole = product.len() / 8 * 8;
    for base in (0..whole).step_by(8) {
        for lane in 0..8 {
            let v = half_norms[base + lane] - product[base + lane];
            let less = v < value[lane];
            value[lane] = if less { v } else { value[lane] };
            at[lane] = if less { base as u32 } else { at[lane] };
        }
    }
    let mut best = (0usize, f32::INFINITY);
    for lane in 0..8 {
        let i = at[lane] as usize + lane;
        if value[lane] < best.1 || (value[lane] == best.1 && i < best.0) {
            best = (i, value[lane]);
        }
    }
    for i in whole..product.len() {
        let v = half_norms[i] - product[i];
        if v < best.1 {
            best = (i, v);
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};

    #[test]
    fn agrees_with_the_definition() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(1);
        for (q, t, dim) in [(1, 1, 1), (5, 700, 3), (300, 259, 40), (257, 513, 111)] {
            let queries: Vec<f32> = (0..q * dim).map(|_| rng.random_range(-1.0..1.0)).collect();
            let targets: Vec<f32> = (0..t * dim).map(|_| rng.random_range(-1.0..1.0)).collect();
            let found = nearest_rows(&queries, &targets, dim);
            for (i, &f) in found.iter().enumerate() {
                let distance = |j: usize| -> f32 {
                    (0..dim)
                        .map(|c| (queries[i * dim + c] - targets[j * dim + c]).powi(2))
                        .sum()
                };
                let least = (0..t).map(distance).fold(f32::INFINITY, f32::min);
                assert!(
                    distance(f as usize) <= least + 1e-4,
                    "row {i} of {q}x{t}x{dim}"
                );
            }
        }
    }

    #[test]
    fn ties_go_to_the_lowest_index() {
        let targets = vec![1.0f32; 2 * 600];
        assert_eq!(nearest_rows(&[1.0, 1.0, 0.0, 0.0], &targets, 2), vec![0, 0]);
    }
}
