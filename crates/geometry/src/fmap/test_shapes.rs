//! Shapes with known spectra and maps.

use super::basis::Basis;

/// A closed curve of equal edges with its Fourier basis.
pub(super) struct Curve {
    pub(super) eigenvalues: Vec<f64>,
    pub(super) eigenvectors: Vec<f32>,
    pub(super) mass: Vec<f32>,
}

impl Curve {
    pub(super) fn basis(&self) -> Basis<'_> {
        Basis {
            eigenvalues: &self.eigenvalues,
            eigenvectors: &self.eigenvectors,
            n_eigenvectors: self.eigenvalues.len(),
            mass: &self.mass,
        }
    }
}

/// A cycle of `n` vertices with 11 eigenpairs; vertex v lies where vertex `v + turn` of the
/// unturned cycle lies.
pub(super) fn cycle(n: usize, turn: usize) -> Curve {
    let k = 11;
    let angle = |v: usize| 2.0 * std::f64::consts::PI * ((v + turn) % n) as f64 / n as f64;
    let wave = |v: usize, j: usize| match j {
        0 => 1.0,
        j if j % 2 == 1 => 2f64.sqrt() * (angle(v) * j.div_ceil(2) as f64).cos(),
        j => 2f64.sqrt() * (angle(v) * (j / 2) as f64).sin(),
    };
    Curve {
        eigenvalues: (0..k)
            .map(|j: usize| (j.div_ceil(2) as f64).powi(2))
            .collect(),
        eigenvectors: (0..n)
            .flat_map(|v| (0..k).map(move |j| wave(v, j) as f32))
            .collect(),
        mass: vec![1.0 / n as f32; n],
    }
}
