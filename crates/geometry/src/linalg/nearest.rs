//! Finds nearest rows in 20 to 200 dimensions by blocked matrix products.
//!
//! k-d trees degrade above a dozen dimensions. One GEMM per block does not, and never holds more
//! than a block of the distance matrix.

use faer::linalg::matmul::matmul;
use faer::{Accum, Mat, MatRef, Par};

const BLOCK: usize = 256;

/// For each row of `queries (q, dim)` the index of the nearest row of `targets (t, dim)` in the
/// Euclidean norm, both row-major; ties go to the lowest index. Costs `2 q t dim` flops.
///
/// ```
/// use coseg_geometry::linalg::nearest::nearest_rows;
///
/// let targets = [0.0, 0.0, 1.0, 0.0, 0.0, 1.0];
/// assert_eq!(nearest_rows(&[0.9, 0.2, -3.0, -3.0], &targets, 2), [1, 0]);
/// ```
///
/// # Panics
/// If `targets` is empty or a length is not a multiple of `dim`.
pub fn nearest_rows(queries: &[f32], targets: &[f32], dim: usize) -> Vec<u32> {
    let mut nearest = vec![0u32; queries.len() / dim.max(1)];
    let mut best = vec![f32::INFINITY; nearest.len()];
    let target_norms = half_norms(targets, dim);
    products(queries, targets, dim, |q, t0, column| {
        let (at, value) = least(column, &target_norms[t0..t0 + column.len()]);
        if value < best[q] {
            best[q] = value;
            nearest[q] = (t0 + at) as u32;
        }
    });
    nearest
}

/// Like [`nearest_rows`], in both directions for the cost of one: the nearest target of each query
/// `(q,)` and the nearest query of each target `(t,)`.
///
/// ```
/// use coseg_geometry::linalg::nearest::nearest_both;
///
/// let (of_query, of_target) = nearest_both(&[0.0, 10.0], &[9.0, 6.0, 1.0], 1);
/// assert_eq!(of_query, [2, 0]);
/// assert_eq!(of_target, [1, 1, 0]);
/// ```
///
/// # Panics
/// If one side is empty or a length is not a multiple of `dim`.
pub fn nearest_both(queries: &[f32], targets: &[f32], dim: usize) -> (Vec<u32>, Vec<u32>) {
    assert!(!queries.is_empty(), "nearest_both needs at least one query");
    let (query_norms, target_norms) = (half_norms(queries, dim), half_norms(targets, dim));
    let mut of_query = vec![0u32; query_norms.len()];
    let mut best_of_query = vec![f32::INFINITY; query_norms.len()];
    let mut of_target = vec![0u32; target_norms.len()];
    let mut best_of_target = vec![f32::INFINITY; target_norms.len()];
    products(queries, targets, dim, |q, t0, column| {
        let (at, value) = least(column, &target_norms[t0..t0 + column.len()]);
        if value < best_of_query[q] {
            best_of_query[q] = value;
            of_query[q] = (t0 + at) as u32;
        }
        let best = &mut best_of_target[t0..t0 + column.len()];
        let at = &mut of_target[t0..t0 + column.len()];
        for ((b, at), p) in best.iter_mut().zip(at).zip(column) {
            let value = query_norms[q] - p;
            let less = value < *b;
            *b = if less { value } else { *b };
            *at = if less { q as u32 } else { *at };
        }
    });
    (of_query, of_target)
}

/// Like [`nearest_rows`], but targets are in cells `(t,)`, each with a centre that is a target, and
/// only the `n_probed` cells with the nearest centres are searched (all, if there are no more). The
/// result is nearly exact where cells are small; it costs `2 q (cells + n_probed t / cells) dim`
/// flops.
///
/// ```
/// use coseg_geometry::linalg::nearest::nearest_in_cells;
///
/// // Two cells about targets 1 and 4; only the nearer one is searched.
/// let targets = [0.0, 1.0, 2.0, 10.0, 11.0, 12.0];
/// let cell = [0, 0, 0, 1, 1, 1];
/// assert_eq!(nearest_in_cells(&[2.2, 9.0], &targets, 1, &[1, 4], &cell, 1), [2, 3]);
/// ```
///
/// # Panics
/// If `targets` is empty, a length is not a multiple of `dim` or a centre or cell does not exist.
pub fn nearest_in_cells(
    queries: &[f32],
    targets: &[f32],
    dim: usize,
    centres: &[u32],
    cell: &[u32],
    n_probed: usize,
) -> Vec<u32> {
    if centres.len() <= n_probed {
        return nearest_rows(queries, targets, dim);
    }
    let n_cells = centres.len();
    let mut offsets = vec![0usize; n_cells + 1];
    for c in cell {
        offsets[*c as usize + 1] += 1;
    }
    for c in 0..n_cells {
        offsets[c + 1] += offsets[c];
    }
    let mut next = offsets.clone();
    let mut members = vec![0u32; cell.len()];
    for (t, c) in cell.iter().enumerate() {
        members[next[*c as usize]] = t as u32;
        next[*c as usize] += 1;
    }
    let row = |t: u32| &targets[t as usize * dim..(t as usize + 1) * dim];
    let grouped: Vec<f32> = members
        .iter()
        .flat_map(|&t| row(t).iter().copied())
        .collect();
    let centre_rows: Vec<f32> = centres
        .iter()
        .flat_map(|&t| row(t).iter().copied())
        .collect();
    let centre_norms = half_norms(&centre_rows, dim);
    let norms = half_norms(&grouped, dim);
    let n_queries = queries.len() / dim;
    // The nearest cells of each query, by insertion: their number is small.
    let mut cells = vec![(f32::INFINITY, u32::MAX); n_queries * n_probed];
    products(queries, &centre_rows, dim, |q, c0, column| {
        let probed = &mut cells[q * n_probed..(q + 1) * n_probed];
        let norms = &centre_norms[c0..c0 + column.len()];
        for (block, (p, norms)) in column.chunks(8).zip(norms.chunks(8)).enumerate() {
            let mut values = [f32::INFINITY; 8];
            for ((value, norm), p) in values.iter_mut().zip(norms).zip(p) {
                *value = norm - p;
            }
            let last = probed[n_probed - 1].0;
            if !values.map(|value| value < last).contains(&true) {
                continue;
            }
            for (i, &value) in values.iter().enumerate() {
                let mut at = n_probed;
                while at > 0 && value < probed[at - 1].0 {
                    if at < n_probed {
                        probed[at] = probed[at - 1];
                    }
                    at -= 1;
                }
                if at < n_probed {
                    probed[at] = (value, (c0 + 8 * block + i) as u32);
                }
            }
        }
    });
    // All queries that probe a cell form one product.
    let mut asking = vec![Vec::new(); n_cells];
    for (at, (_, c)) in cells.iter().enumerate() {
        asking[*c as usize].push(at / n_probed);
    }
    let mut nearest = vec![(f32::INFINITY, u32::MAX); n_queries];
    let mut rows = Vec::new();
    for (c, asking) in asking.iter().enumerate() {
        let (from, to) = (offsets[c], offsets[c + 1]);
        if from == to {
            continue;
        }
        rows.clear();
        for q in asking {
            rows.extend_from_slice(&queries[q * dim..(q + 1) * dim]);
        }
        products(
            &rows,
            &grouped[from * dim..to * dim],
            dim,
            |i, t0, column| {
                let t0 = from + t0;
                let (at, value) = least(column, &norms[t0..t0 + column.len()]);
                let (best, member) = (&mut nearest[asking[i]], members[t0 + at]);
                if value < best.0 || (value == best.0 && member < best.1) {
                    *best = (value, member);
                }
            },
        );
    }
    nearest.into_iter().map(|(_, member)| member).collect()
}

fn half_norms(rows: &[f32], dim: usize) -> Vec<f32> {
    let rows = rows.chunks_exact(dim.max(1));
    rows.map(|t| 0.5 * t.iter().map(|x| x * x).sum::<f32>())
        .collect()
}

/// Calls `visit(query, first target, products with the targets from there)`, block by block.
/// Queries ascend within a block of targets, and blocks of targets ascend for a query.
fn products(
    queries: &[f32],
    targets: &[f32],
    dim: usize,
    mut visit: impl FnMut(usize, usize, &[f32]),
) {
    assert!(dim > 0 && queries.len().is_multiple_of(dim) && targets.len().is_multiple_of(dim));
    let (n_queries, n_targets) = (queries.len() / dim, targets.len() / dim);
    assert!(
        n_targets > 0,
        "the nearest of no rows: at least one target is needed"
    );
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
                visit(q0 + j, t0, column.as_slice());
            }
        }
    }
}

/// Index and value of the least `half_norm − product`; ties go to the lowest index.
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
            let back = nearest_rows(&targets, &queries, dim);
            assert_eq!(
                nearest_both(&queries, &targets, dim),
                (found.clone(), back),
                "{q}x{t}x{dim}"
            );
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
