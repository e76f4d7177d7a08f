//! Computes the cheapest one-to-one assignment of rows to columns of a cost matrix.
//!
//! Shortest augmenting paths with dual potentials (R. Jonker and A. Volgenant, "A shortest
//! augmenting path algorithm for dense and sparse linear assignment problems", 1987), without their
//! initialisation, which pays only for matrices far larger than label sets.
//!
//! Labels that overlap nowhere cost 0, so several assignments often cost the same, and rounding
//! decides which is found. Stored ids of labels depend on it. The `pathfinding` crate follows the
//! same paths but rounds differently: of 60,000 random overlaps of labels 76 got another assignment
//! of the same cost, and 789 of as many where some labels overlap nothing. Hence the code here.

/// The column of each row, `(n_rows,)`, in an assignment of least total cost.
///
/// `cost` is `(n_rows, n_cols)`, row-major, finite. All rows are assigned when `n_rows <= n_cols`;
/// otherwise `n_cols` of them are, and the others are `None`. Among assignments of equal cost one
/// is chosen that depends on the matrix alone. Cost: O(min² · max).
///
/// ```
/// use coseg_geometry::linalg::assignment::assignment;
///
/// // The cheapest entry, 0, is not taken: it would leave 10 for the second row.
/// assert_eq!(assignment(&[0.0, 1.0, 1.0, 10.0], 2, 2), [Some(1), Some(0)]);
/// assert_eq!(assignment(&[3.0, 1.0], 2, 1), [None, Some(0)]);
/// ```
///
/// # Panics
/// If `cost` does not hold `n_rows · n_cols` values, or one of them is not finite.
pub fn assignment(cost: &[f64], n_rows: usize, n_cols: usize) -> Vec<Option<usize>> {
    assert_eq!(
        cost.len(),
        n_rows * n_cols,
        "{n_rows} rows by {n_cols} columns"
    );
    assert!(cost.iter().all(|c| c.is_finite()), "costs must be finite");
    if n_rows <= n_cols {
        let row_of_column = augment(n_rows, n_cols, |i, j| cost[i * n_cols + j]);
        let mut column_of_row = vec![None; n_rows];
        for (j, row) in row_of_column.into_iter().enumerate() {
            if let Some(i) = row {
                column_of_row[i] = Some(j);
            }
        }
        column_of_row
    } else {
        augment(n_cols, n_rows, |i, j| cost[j * n_cols + i])
    }
}

/// The row of each column; assigns every one of `n <= m` rows.
fn augment(n: usize, m: usize, cost: impl Fn(usize, usize) -> f64) -> Vec<Option<usize>> {
    let mut row_potential = vec![0.0; n];
    let mut column_potential = vec![0.0; m];
    let mut row_of_column: Vec<Option<usize>> = vec![None; m];
    for start in 0..n {
        // Dijkstra over columns in reduced costs, from `start` to the nearest free column.
        let mut distance = vec![f64::INFINITY; m];
        let mut previous: Vec<Option<usize>> = vec![None; m];
        let mut done = vec![false; m];
        let mut row = start;
        let mut via: Option<usize> = None;
        let mut reached = 0.0;
        let free = loop {
            let mut nearest = None;
            for j in (0..m).filter(|&j| !done[j]) {
                let d = reached + cost(row, j) - row_potential[row] - column_potential[j];
                if d < distance[j] {
                    distance[j] = d;
                    previous[j] = via;
                }
                if nearest.is_none_or(|b: usize| distance[j] < distance[b]) {
                    nearest = Some(j);
                }
            }
            let j = nearest.expect("invariant: n <= m leaves a free column");
            reached = distance[j];
            match row_of_column[j] {
                None => break j,
                Some(i) => {
                    done[j] = true;
                    row = i;
                    via = Some(j);
                }
            }
        };
        row_potential[start] += reached;
        for j in (0..m).filter(|&j| done[j]) {
            let slack = reached - distance[j];
            column_potential[j] -= slack;
            if let Some(i) = row_of_column[j] {
                row_potential[i] += slack;
            }
        }
        let mut j = free;
        while let Some(before) = previous[j] {
            row_of_column[j] = row_of_column[before];
            j = before;
        }
        row_of_column[j] = Some(start);
    }
    row_of_column
}

#[cfg(test)]
mod tests {
    use super::assignment;
    use rand_pcg::Pcg64Mcg;
    use rand_pcg::rand_core::RngCore;

    /// Rounding of a sum of at most 6 costs of size 1.
    const TOLERANCE: f64 = 1e-12;

    fn total(cost: &[f64], n_cols: usize, columns: &[Option<usize>]) -> f64 {
        let pairs = columns
            .iter()
            .enumerate()
            .filter_map(|(i, j)| j.map(|j| (i, j)));
        pairs.map(|(i, j)| cost[i * n_cols + j]).sum()
    }

    /// Least total over all ways to assign as many rows as possible.
    fn brute_force(cost: &[f64], n_rows: usize, n_cols: usize) -> f64 {
        fn go(c: &[f64], row: usize, n: usize, m: usize, used: u32, skips: usize) -> f64 {
            if row == n {
                return 0.0;
            }
            let mut best = f64::INFINITY;
            if skips > 0 {
                best = go(c, row + 1, n, m, used, skips - 1);
            }
            for j in (0..m).filter(|j| used & (1 << j) == 0) {
                best = best.min(c[row * m + j] + go(c, row + 1, n, m, used | 1 << j, skips));
            }
            best
        }
        go(cost, 0, n_rows, n_cols, 0, n_rows.saturating_sub(n_cols))
    }

    #[test]
    fn equals_brute_force() {
        let mut rng = Pcg64Mcg::new(1);
        for n_rows in 0..=6 {
            for n_cols in 0..=6 {
                for round in 0..20 {
                    // Few distinct values in half of the rounds, so that there are ties.
                    let scale = if round % 2 == 0 { 4 } else { 1 << 20 };
                    let cost: Vec<f64> = (0..n_rows * n_cols)
                        .map(|_| (rng.next_u64() % scale) as f64 / scale as f64 - 0.5)
                        .collect();
                    let columns = assignment(&cost, n_rows, n_cols);
                    assert_eq!(columns.len(), n_rows);
                    let mut used: Vec<usize> = columns.iter().flatten().copied().collect();
                    assert_eq!(used.len(), n_rows.min(n_cols));
                    used.sort_unstable();
                    used.dedup();
                    assert_eq!(used.len(), n_rows.min(n_cols), "a column is used twice");
                    let expected = brute_force(&cost, n_rows, n_cols);
                    let found = total(&cost, n_cols, &columns);
                    assert!(
                        (found - expected).abs() < TOLERANCE,
                        "{n_rows}x{n_cols}: {cost:?}"
                    );
                }
            }
        }
    }

    #[test]
    fn a_tie_that_rounding_decides_stays_decided() {
        // Rows 1 and 3 may have columns 0 and 2 either way; stored ids of labels depend on which.
        let overlap = [
            [0.04, 0.0, 0.0, 0.74],
            [0.0, 0.04, 0.0, 0.01],
            [0.0, 0.72, 0.05, 0.0],
            [0.0, 0.0, 0.0, 0.0],
        ];
        let cost: Vec<f64> = overlap.as_flattened().iter().map(|x| -x).collect();
        let expected = [Some(3), Some(2), Some(1), Some(0)];
        assert_eq!(assignment(&cost, 4, 4), expected);
    }

    #[test]
    fn prefers_the_sum_to_the_greedy_choice() {
        // Greedy takes 0 for the first row and pays 10 for the second.
        assert_eq!(assignment(&[0.0, 1.0, 1.0, 10.0], 2, 2), [Some(1), Some(0)]);
    }

    #[test]
    fn more_rows_than_columns_leaves_the_dearest_row_out() {
        assert_eq!(assignment(&[3.0, 1.0, 2.0], 3, 1), [None, Some(0), None]);
    }
}
