//! Splits a stiffness and a mass into connected components, each in standard form.

use super::SpectrumError;
use crate::linalg::basis::Basis;
use crate::linalg::ldlt::{Analysis, Factor, Inertia, LdltError, SymmetricSparse};
use crate::linalg::panel::{Row, WIDTH};
use pulp::Arch;

/// A row sum of W below this share of the row's absolute sum is rounding of an exact zero.
const ROW_SUM_ROUNDING: f64 = 1e-13;

/// Stored entries of W that differ from their mirror image by more than this share of the larger
/// diagonal entry are an error of the caller.
const ASYMMETRY: f64 = 1e-10;

/// A shift that hits a pivot exactly is moved by this share.
const NUDGE: f64 = 1e-9;

/// One connected component of W, in elimination order: `S = A^{-1/2} W A^{-1/2}`.
pub(super) struct Component {
    /// The vertex of each row.
    pub(super) vertices: Vec<u32>,
    /// W in input units.
    pub(super) stiffness: SymmetricSparse,
    /// S.
    pub(super) standard: SymmetricSparse,
    /// `1 / √a`.
    pub(super) inverse_sqrt_mass: Vec<f64>,
    /// Row sums of W; exactly zero where they are rounding.
    row_sums: Vec<f64>,
    /// `Σ a`.
    pub(super) area: f64,
    /// Whether the constant function is in the null space of W.
    pub(super) has_null_vector: bool,
    pub(super) analysis: Analysis,
}

impl Component {
    /// Rows.
    pub(super) fn n(&self) -> usize {
        self.vertices.len()
    }

    /// Puts the unit null vector of S into the first column.
    pub(super) fn set_null_vector(&self, vectors: &mut Basis) {
        let scale = self.area.sqrt();
        let rows = vectors.rows_of_mut(0).flatten();
        for (row, x) in rows.zip(&self.inverse_sqrt_mass) {
            row.0[0] = 1.0 / (x * scale);
        }
    }

    /// Factorises `S - shift I`; moves the shift up a little where it hits a pivot exactly.
    pub(super) fn factor(&self, shift: f64) -> Result<(Factor, f64), LdltError> {
        off_pivots(shift, |at| Factor::new(&self.analysis, &self.standard, at))
    }

    /// Counts the eigenvalues of S below `shift`, which moves as for [`Component::factor`]. The
    /// bound on the perturbation need not be sharp once it is below `enough`.
    pub(super) fn inertia(&self, shift: f64, enough: f64) -> Result<(Inertia, f64), LdltError> {
        off_pivots(shift, |at| {
            Inertia::new(&self.analysis, &self.standard, at, enough)
        })
    }

    /// Whether the lowest vertex among the entries of largest magnitude, `most`, of an eigenvector
    /// of W has a negative entry. `vectors` are those of S.
    pub(super) fn first_extreme_is_negative(
        &self,
        vectors: &Basis,
        pair: usize,
        most: f64,
    ) -> bool {
        let rows = vectors.rows_of(pair / WIDTH).flatten();
        let entries = rows.zip(&self.inverse_sqrt_mass);
        let entries = entries.map(|(row, s)| row.0[pair % WIDTH] * s);
        let extreme = entries.zip(&self.vertices).filter(|(x, _)| x.abs() == most);
        extreme
            .min_by_key(|(_, v)| **v)
            .is_some_and(|(x, _)| x < 0.0)
    }

    /// Measures the unit vectors of panel `j`.
    pub(super) fn rayleigh(&self, vectors: &Basis, j: usize, scratch: &mut Scratch) -> Measured {
        vectors.copy_panel(j, &mut scratch.x);
        self.measure(scratch)
    }

    /// Rayleigh quotients λ, residuals `S x - λ x` and extreme entries of `A^{-1/2} x` of the unit
    /// vectors in `scratch.x`. W is applied to differences along edges, so that large weights of
    /// sliver triangles do not amplify the rounding of a sum that cancels.
    pub(super) fn measure(&self, scratch: &mut Scratch) -> Measured {
        let Scratch { x, phi, residuals } = scratch;
        phi.clear();
        residuals.clear();
        Arch::new().dispatch(|| {
            let mut least = [f64::INFINITY; WIDTH];
            let mut most = [f64::NEG_INFINITY; WIDTH];
            for (row, s) in x.iter().zip(&self.inverse_sqrt_mass) {
                let row = row.0.map(|v| v * s);
                for ((low, high), v) in least.iter_mut().zip(&mut most).zip(row) {
                    *low = if v < *low { v } else { *low };
                    *high = if v > *high { v } else { *high };
                }
                phi.push(Row(row));
            }
            let mut quotients = [0.0; WIDTH];
            for (i, x) in x[..self.n()].iter().enumerate() {
                let (columns, values) = self.stiffness.row(i);
                let own = phi[i].0;
                let mut image = own.map(|v| v * self.row_sums[i]);
                for (&c, &w) in columns.iter().zip(values) {
                    for ((a, o), p) in image.iter_mut().zip(&own).zip(&phi[c as usize].0) {
                        *a += w * (p - o);
                    }
                }
                for ((q, a), v) in quotients.iter_mut().zip(&mut image).zip(&x.0) {
                    *a *= self.inverse_sqrt_mass[i];
                    *q += *a * v;
                }
                residuals.push(Row(image));
            }
            let mut sums = [0.0; WIDTH];
            for (image, x) in residuals.iter_mut().zip(&*x) {
                let entries = sums.iter_mut().zip(&mut image.0).zip(&x.0).zip(&quotients);
                for (((s, a), v), l) in entries {
                    *a -= l * v;
                    *s += *a * *a;
                }
            }
            residuals.resize(x.len(), Row::ZERO);
            Measured {
                quotients,
                residuals: sums.map(f64::sqrt),
                extremes: std::array::from_fn(|i| (least[i], most[i])),
            }
        })
    }
}

/// The measurements of the columns of a panel, see [`Component::measure`].
pub(super) struct Measured {
    pub(super) quotients: [f64; WIDTH],
    pub(super) residuals: [f64; WIDTH],
    /// (least, most)
    pub(super) extremes: [(f64, f64); WIDTH],
}

/// Calls `factorise` at `shift`, or a little above it where that hits a pivot exactly.
fn off_pivots<T>(
    shift: f64,
    factorise: impl Fn(f64) -> Result<T, LdltError>,
) -> Result<(T, f64), LdltError> {
    let mut moved = shift;
    for attempt in 1..=8 {
        match factorise(moved) {
            Err(LdltError::ZeroPivot { .. }) if attempt < 8 => {
                moved = shift + f64::from(attempt) * NUDGE * shift.abs();
            }
            other => return other.map(|found| (found, moved)),
        }
    }
    unreachable!("the last attempt returns")
}

/// Scratch memory of [`Component::measure`], reused for one panel after the other.
#[derive(Default)]
pub(super) struct Scratch {
    /// The panel.
    pub(super) x: Vec<Row>,
    phi: Vec<Row>,
    /// Its residuals.
    pub(super) residuals: Vec<Row>,
}

/// Checks both matrices.
pub(super) fn validate(stiffness: &sprs::CsMat<f64>, mass: &[f64]) -> Result<(), SpectrumError> {
    let (rows, columns) = stiffness.shape();
    if rows != columns {
        return Err(SpectrumError::NotSquare { rows, columns });
    }
    if mass.len() != rows {
        return Err(SpectrumError::MassLength {
            n_mass: mass.len(),
            n: rows,
        });
    }
    if let Some((vertex, &value)) = mass
        .iter()
        .enumerate()
        .find(|(_, m)| !m.is_normal() || **m < 0.0)
    {
        return Err(SpectrumError::Mass { vertex, value });
    }
    let diagonal: Vec<f64> = (0..rows)
        .map(|i| stiffness.get(i, i).copied().unwrap_or(0.0).abs())
        .collect();
    let view = |i: usize| {
        let row = stiffness.outer_view(i);
        row.expect("invariant: i is below the size of W")
    };
    // Entries above the diagonal come in the order in which their mirror images need them.
    let mut waiting: Vec<usize> = (0..rows)
        .map(|i| view(i).indices().partition_point(|&c| c <= i))
        .collect();
    let check = |row: usize, column: usize, value: f64, mirror: f64| {
        let scale = diagonal[row].max(diagonal[column]);
        if (value - mirror).abs() > ASYMMETRY * scale {
            return Err(SpectrumError::NotSymmetric {
                row,
                column,
                value,
                mirror,
            });
        }
        Ok(())
    };
    for row in 0..rows {
        for (column, &value) in view(row).iter() {
            if !value.is_finite() {
                return Err(SpectrumError::Stiffness { row, column, value });
            }
            if column >= row {
                continue;
            }
            let above = view(column);
            let (columns, values) = (above.indices(), above.data());
            let at = &mut waiting[column];
            while columns.get(*at).is_some_and(|&c| c < row) {
                check(column, columns[*at], values[*at], 0.0)?;
                *at += 1;
            }
            if columns.get(*at) == Some(&row) {
                check(row, column, value, values[*at])?;
                *at += 1;
            } else {
                check(row, column, value, 0.0)?;
            }
        }
    }
    for (row, &at) in waiting.iter().enumerate() {
        let rest = view(row);
        for (&column, &value) in rest.indices()[at..].iter().zip(&rest.data()[at..]) {
            check(row, column, value, 0.0)?;
        }
    }
    Ok(())
}

/// Splits W into its connected components, in the order of their first vertices.
pub(super) fn components(
    stiffness: &sprs::CsMat<f64>,
    mass: &[f64],
) -> Result<Vec<Component>, SpectrumError> {
    let n = mass.len();
    const UNSEEN: u32 = u32::MAX;
    let mut component_of = vec![UNSEEN; n];
    let mut members: Vec<Vec<u32>> = Vec::new();
    let mut stack = Vec::new();
    for first in 0..n {
        if component_of[first] != UNSEEN {
            continue;
        }
        let id = members.len() as u32;
        let mut vertices = Vec::new();
        component_of[first] = id;
        stack.push(first);
        while let Some(v) = stack.pop() {
            vertices.push(v as u32);
            let row = stiffness
                .outer_view(v)
                .expect("invariant: v is below the size of W");
            for (u, &w) in row.iter() {
                if w != 0.0 && component_of[u] == UNSEEN {
                    component_of[u] = id;
                    stack.push(u);
                }
            }
        }
        vertices.sort_unstable();
        members.push(vertices);
    }
    let mut local = vec![0u32; n];
    members
        .iter()
        .map(|vertices| {
            for (i, &v) in vertices.iter().enumerate() {
                local[v as usize] = i as u32;
            }
            component(stiffness, mass, vertices, &local)
        })
        .collect()
}

fn component(
    stiffness: &sprs::CsMat<f64>,
    mass: &[f64],
    vertices: &[u32],
    local: &[u32],
) -> Result<Component, SpectrumError> {
    let mut w = SymmetricSparse {
        row_starts: vec![0],
        columns: Vec::new(),
        values: Vec::new(),
    };
    for (i, &v) in vertices.iter().enumerate() {
        let row = stiffness
            .outer_view(v as usize)
            .expect("invariant: v is below the size of W");
        let mut diagonal_seen = false;
        for (u, &value) in row.iter() {
            if value == 0.0 && u != v as usize {
                continue;
            }
            let column = local[u];
            if !diagonal_seen && column as usize > i {
                w.columns.push(i as u32);
                w.values.push(0.0);
                diagonal_seen = true;
            }
            diagonal_seen |= column as usize == i;
            w.columns.push(column);
            w.values.push(value);
        }
        if !diagonal_seen {
            w.columns.push(i as u32);
            w.values.push(0.0);
        }
        w.row_starts.push(w.columns.len());
    }
    let analysis = Analysis::new(&w)?;
    let stiffness = w.permuted(&analysis.order);
    let vertices: Vec<u32> = analysis
        .order
        .iter()
        .map(|&i| vertices[i as usize])
        .collect();
    let inverse_sqrt_mass: Vec<f64> = vertices
        .iter()
        .map(|&v| 1.0 / mass[v as usize].sqrt())
        .collect();
    let mut standard = stiffness.clone();
    let mut row_sums = Vec::with_capacity(vertices.len());
    for i in 0..vertices.len() {
        let range = stiffness.row_starts[i]..stiffness.row_starts[i + 1];
        for p in range.clone() {
            let j = stiffness.columns[p] as usize;
            standard.values[p] *= inverse_sqrt_mass[i] * inverse_sqrt_mass[j];
        }
        let (_, values) = stiffness.row(i);
        let sum: f64 = values.iter().sum();
        let absolute: f64 = values.iter().map(|x| x.abs()).sum();
        row_sums.push(if sum.abs() <= ROW_SUM_ROUNDING * absolute {
            0.0
        } else {
            sum
        });
    }
    Ok(Component {
        area: vertices.iter().map(|&v| mass[v as usize]).sum(),
        has_null_vector: row_sums.iter().all(|&s| s == 0.0),
        vertices,
        stiffness,
        standard,
        inverse_sqrt_mass,
        row_sums,
        analysis,
    })
}
