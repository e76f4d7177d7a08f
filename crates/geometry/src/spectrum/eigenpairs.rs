//! Combines solved components into one spectrum. Rows of its eigenvectors are copied straight out
//! of the solver's memory.

use super::component::Component;
use super::connected::Pairs;
use super::{Certificate, Options, Spectrum, SpectrumError, solve};
use crate::linalg::basis::Basis;
use crate::linalg::panel::{Row, WIDTH};
use nalgebra::DMatrix;
use rayon::iter::{IndexedParallelIterator, IntoParallelIterator, ParallelIterator};
use rayon::slice::ParallelSliceMut;

/// A tiny eigenvalue of either sign counts as zero below this share of the largest one.
const ZERO: f64 = 1e-12;

/// Eigenvalues below minus this share of the largest one are too negative for rounding.
const NEGATIVE: f64 = 1e-6;

/// Rows that a thread copies at a time.
const ROWS: usize = 512;

/// The smallest eigenpairs of `W φ = λ A φ`, with the eigenvectors Φ `(n, k)` in the memory in
/// which they were computed. [`Eigenpairs::rows`] writes rows of them to their destination, without
/// a second copy.
#[derive(Debug)]
pub struct Eigenpairs {
    /// `(k,)`, ascending, not negative.
    pub eigenvalues: Vec<f64>,
    /// `‖W φ - λ A φ‖` in the norm of `A⁻¹`, `(k,)`.
    pub residuals: Vec<f64>,
    /// The proof that no eigenvalue is missing.
    pub certificate: Certificate,
    parts: Vec<Part>,
    /// The part and row of each vertex.
    places: Vec<(u32, u32)>,
    parallel: bool,
}

/// The eigenvectors of a component.
#[derive(Debug)]
struct Part {
    vectors: Basis,
    vertices: Vec<u32>,
    inverse_sqrt_mass: Vec<f64>,
    panels: Vec<Panel>,
}

/// The destination of the columns of a panel.
#[derive(Debug)]
struct Panel {
    /// Index of the panel in the component's vectors.
    source: usize,
    /// The first `n` columns are columns `first..first + n` of Φ; the others are in `scattered`.
    first: usize,
    n: usize,
    /// (column of the panel, column of Φ), for columns that are not consecutive.
    scattered: Vec<(usize, usize)>,
    /// The factors 1, or -1 where the canonical sign is the opposite.
    signs: [f64; WIDTH],
}

impl Eigenpairs {
    /// Like [`Spectrum::smallest`], but leaves the eigenvectors in the solver's memory.
    ///
    /// ```
    /// use coseg_geometry::mesh::icosphere;
    /// use coseg_geometry::operators::{Operator, laplacian};
    /// use coseg_geometry::spectrum::{Eigenpairs, Options};
    ///
    /// let sphere = laplacian(&icosphere(3), &[], Operator::Tufted)?;
    /// let pairs = Eigenpairs::smallest(&sphere.stiffness, &sphere.mass, 4, &Options::default())?;
    /// assert_eq!((pairs.n(), pairs.k()), (642, 4));
    /// // The first eigenvector is constant, 1 / √area.
    /// let mut rows = [0.0; 8];
    /// pairs.rows(10, &mut rows); // vertices 10 and 11
    /// let area: f64 = sphere.mass.iter().sum();
    /// assert!((rows[0] - area.powf(-0.5)).abs() < 1e-9 && (rows[4] - rows[0]).abs() < 1e-9);
    /// # Ok::<_, Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// See [`SpectrumError`].
    pub fn smallest(
        stiffness: &sprs::CsMat<f64>,
        mass: &[f64],
        k: usize,
        options: &Options,
    ) -> Result<Self, SpectrumError> {
        let (parts, solved) = solve(stiffness, mass, k, options)?;
        Self::assemble(parts, solved, k, options.threads > 1)
    }

    /// Vertices.
    pub fn n(&self) -> usize {
        self.places.len()
    }

    /// Pairs.
    pub fn k(&self) -> usize {
        self.eigenvalues.len()
    }

    /// Writes rows of Φ to `out`, row-major, from vertex `first` on; the length of `out` divided by
    /// k is the number of rows. `ΦᵀAΦ = I`; in each column the entry of largest magnitude (the
    /// first such) is positive.
    ///
    /// ```
    /// use coseg_geometry::mesh::icosphere;
    /// use coseg_geometry::operators::{Operator, laplacian};
    /// use coseg_geometry::spectrum::{Eigenpairs, Options};
    ///
    /// let sphere = laplacian(&icosphere(2), &[], Operator::Tufted)?;
    /// let pairs = Eigenpairs::smallest(&sphere.stiffness, &sphere.mass, 4, &Options::default())?;
    /// let mut two = [0.0; 2 * 4];
    /// pairs.rows(20, &mut two);
    /// assert_eq!(two, pairs.all_rows()[20 * 4..22 * 4]);
    /// # Ok::<_, Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Panics
    /// If `out` has room for rows beyond the last.
    pub fn rows(&self, first: usize, out: &mut [f64]) {
        let rows = out.chunks_exact_mut(self.k());
        for (&(part, at), row) in self.places[first..first + rows.len()].iter().zip(rows) {
            let part = &self.parts[part as usize];
            if self.parts.len() > 1 {
                row.fill(0.0);
            }
            let scale = part.inverse_sqrt_mass[at as usize];
            let mut panels = part.vectors.row(at as usize).enumerate();
            for panel in &part.panels {
                let Some((_, x)) = panels.find(|(p, _)| *p == panel.source) else {
                    unreachable!("panels are listed in ascending order")
                };
                let mut scaled = x.0;
                for (x, sign) in scaled.iter_mut().zip(&panel.signs) {
                    *x *= sign * scale;
                }
                row[panel.first..panel.first + panel.n].copy_from_slice(&scaled[..panel.n]);
                for &(from, to) in &panel.scattered {
                    row[to] = scaled[from];
                }
            }
        }
    }

    /// All rows of Φ `(n, k)`, row-major.
    ///
    /// ```
    /// use coseg_geometry::mesh::icosphere;
    /// use coseg_geometry::operators::{Operator, laplacian};
    /// use coseg_geometry::spectrum::{Eigenpairs, Options};
    ///
    /// let sphere = laplacian(&icosphere(3), &[], Operator::Tufted)?;
    /// let pairs = Eigenpairs::smallest(&sphere.stiffness, &sphere.mass, 4, &Options::default())?;
    /// let rows = pairs.all_rows();
    /// let weighted = rows.chunks_exact(4).zip(&sphere.mass);
    /// let norm: f64 = weighted.map(|(row, m)| m * row[2] * row[2]).sum();
    /// assert!((norm - 1.0).abs() < 1e-9); // mass-orthonormal
    /// # Ok::<_, Box<dyn std::error::Error>>(())
    /// ```
    pub fn all_rows(&self) -> Vec<f64> {
        let width = ROWS * self.k();
        let mut out = vec![0.0; self.n() * self.k()];
        let write = |(i, out): (usize, &mut [f64])| self.rows(i * ROWS, out);
        if self.parallel {
            out.par_chunks_mut(width).enumerate().for_each(write);
        } else {
            out.chunks_mut(width).enumerate().for_each(write);
        }
        out
    }

    /// Φ as one matrix; the solver's memory is freed.
    ///
    /// ```
    /// use coseg_geometry::mesh::icosphere;
    /// use coseg_geometry::operators::{Operator, laplacian};
    /// use coseg_geometry::spectrum::{Eigenpairs, Options};
    ///
    /// let sphere = laplacian(&icosphere(2), &[], Operator::Tufted)?;
    /// let pairs = Eigenpairs::smallest(&sphere.stiffness, &sphere.mass, 4, &Options::default())?;
    /// assert_eq!(pairs.into_spectrum().eigenvectors.shape(), (162, 4));
    /// # Ok::<_, Box<dyn std::error::Error>>(())
    /// ```
    pub fn into_spectrum(self) -> Spectrum {
        let (n, k) = (self.n(), self.k());
        let mut flat = vec![0.0; n * k];
        let mut columns: Vec<_> = flat.chunks_exact_mut(n).map(Some).collect();
        let mut tasks = Vec::new();
        for part in &self.parts {
            for panel in &part.panels {
                let pairs = panel.pairs().map(|(from, to)| {
                    let column = columns[to].take();
                    (from, column.expect("invariant: a column has one source"))
                });
                tasks.push((part, panel, pairs.collect::<Vec<_>>()));
            }
        }
        let by_vertex: Vec<_> = self.parts.iter().map(Part::rows_by_vertex).collect();
        let write =
            |rows: &mut Vec<Row>,
             (part, panel, mut columns): (&Part, &Panel, Vec<(usize, &mut [f64])>)| {
                part.vectors.copy_panel(panel.source, rows);
                let first = part.vertices[0] as usize;
                let order = &by_vertex[self.places[first].0 as usize];
                for &(vertex, row) in order {
                    let scale = part.inverse_sqrt_mass[row as usize];
                    let x = &rows[row as usize].0;
                    for (from, column) in &mut columns {
                        column[vertex as usize] = x[*from] * (panel.signs[*from] * scale);
                    }
                }
            };
        if self.parallel {
            tasks.into_par_iter().for_each_init(Vec::new, write);
        } else {
            let mut rows = Vec::new();
            tasks.into_iter().for_each(|task| write(&mut rows, task));
        }
        Spectrum {
            eigenvalues: self.eigenvalues,
            eigenvectors: DMatrix::from_vec(n, k, flat),
            residuals: self.residuals,
            certificate: self.certificate,
        }
    }

    fn assemble(
        parts: Vec<Component>,
        solved: Vec<Pairs>,
        k: usize,
        parallel: bool,
    ) -> Result<Self, SpectrumError> {
        // (value, component, index in it): ties go to the earlier component.
        let mut order: Vec<(f64, usize, usize)> = solved
            .iter()
            .enumerate()
            .flat_map(|(c, s)| s.values.iter().enumerate().map(move |(i, &v)| (v, c, i)))
            .collect();
        order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)).then(a.2.cmp(&b.2)));
        let certificate = certificate(&solved, &order);
        let largest = order[k - 1].0.abs();
        let mut eigenvalues = Vec::with_capacity(k);
        let mut residuals = Vec::with_capacity(k);
        let mut columns: Vec<Vec<(usize, usize)>> = vec![Vec::new(); solved.len()];
        for (to, &(value, c, i)) in order[..k].iter().enumerate() {
            if value < -NEGATIVE * largest {
                return Err(SpectrumError::NotSemidefinite {
                    count: 1,
                    below: value,
                });
            }
            eigenvalues.push(if value < ZERO * largest { 0.0 } else { value });
            residuals.push(solved[c].residuals[i]);
            columns[c].push((i, to));
        }
        // Measured values of a cluster may be in another order than the pairs.
        columns.iter_mut().for_each(|c| c.sort_unstable());
        let n = parts.iter().map(Component::n).sum();
        let mut places = vec![(0, 0); n];
        let mut out = Vec::with_capacity(parts.len());
        for (c, ((component, pairs), columns)) in
            parts.into_iter().zip(solved).zip(&columns).enumerate()
        {
            for (row, &vertex) in component.vertices.iter().enumerate() {
                places[vertex as usize] = (c as u32, row as u32);
            }
            let groups = columns.chunk_by(|a, b| a.0 / WIDTH == b.0 / WIDTH);
            out.push(Part {
                panels: groups
                    .map(|group| Panel::new(group, &component, &pairs))
                    .collect(),
                vectors: pairs.vectors,
                vertices: component.vertices,
                inverse_sqrt_mass: component.inverse_sqrt_mass,
            });
        }
        Ok(Self {
            eigenvalues,
            residuals,
            certificate,
            parts: out,
            places,
            parallel,
        })
    }
}

/// The certificate of the whole spectrum: the lowest limit applies to all, and so does the largest
/// bound.
fn certificate(solved: &[Pairs], order: &[(f64, usize, usize)]) -> Certificate {
    let tightest = solved
        .iter()
        .min_by(|a, b| a.limit.total_cmp(&b.limit))
        .expect("invariant: k >= 1, so there is a component");
    let tau = tightest.limit;
    // The component nearest to failing its proof determines these figures.
    let weakest = solved
        .iter()
        .max_by(|a, b| (a.perturbation / a.margin).total_cmp(&(b.perturbation / b.margin)))
        .expect("invariant: k >= 1, so there is a component");
    Certificate {
        tau,
        count: order.iter().filter(|o| o.0 < tau).count(),
        margin: weakest.margin,
        perturbation: weakest.perturbation,
        growth: solved.iter().map(|s| s.growth).fold(1.0, f64::max),
        n_components: solved.len(),
        n_krylov: solved.iter().map(|s| s.n_krylov).max().unwrap_or(0),
        n_polish: solved.iter().map(|s| s.n_polish).sum(),
        n_repair: solved.iter().map(|s| s.n_repair).sum(),
    }
}

impl Part {
    /// (vertex, row) in ascending order of the vertices.
    fn rows_by_vertex(&self) -> Vec<(u32, u32)> {
        let rows = self.vertices.iter().zip(0..);
        let mut out: Vec<_> = rows.map(|(&v, row)| (v, row)).collect();
        out.sort_unstable();
        out
    }
}

impl Panel {
    /// `columns`: (pair of the component, column of Φ), all in one panel.
    fn new(columns: &[(usize, usize)], component: &Component, pairs: &Pairs) -> Self {
        let source = columns[0].0 / WIDTH;
        let mut signs = [1.0; WIDTH];
        for &(pair, _) in columns {
            let (least, most) = pairs.extremes[pair];
            let negative = if most == -least {
                component.first_extreme_is_negative(&pairs.vectors, pair, most)
            } else {
                -least > most
            };
            if negative {
                signs[pair % WIDTH] = -1.0;
            }
        }
        let first = columns[0].1;
        let mut places = columns.iter().enumerate();
        let in_order = places.all(|(i, c)| *c == (source * WIDTH + i, first + i));
        let scattered = match in_order {
            true => Vec::new(),
            false => columns.iter().map(|&(p, to)| (p % WIDTH, to)).collect(),
        };
        Self {
            source,
            first,
            n: if in_order { columns.len() } else { 0 },
            scattered,
            signs,
        }
    }

    /// (column of the panel, column of Φ)
    fn pairs(&self) -> impl Iterator<Item = (usize, usize)> {
        let in_order = (0..self.n).map(|i| (i, self.first + i));
        in_order.chain(self.scattered.iter().copied())
    }
}
