//! Computes operators with which a map must commute from functions, in a spectral basis.

use nalgebra::DMatrix;

/// Multiplication by f `(n,)`: `Φᵀ A diag(f) Φ (k, k)` of eigenvectors `(n, k)`, mass `(n,)`
/// (Nogneng and Ovsjanikov 2017).
///
/// ```
/// use coseg_geometry::fmap::operators::multiplication;
/// use nalgebra::DMatrix;
///
/// // Multiplication by 3 is three times the identity in an orthonormal basis.
/// let basis = DMatrix::from_row_slice(2, 2, &[1.0, 1.0, 1.0, -1.0]);
/// let found = multiplication(&basis, &[0.5, 0.5], &[3.0, 3.0]);
/// assert_eq!(found, DMatrix::identity(2, 2) * 3.0);
/// ```
///
/// # Panics
/// If lengths differ.
pub fn multiplication(eigenvectors: &DMatrix<f64>, mass: &[f64], f: &[f64]) -> DMatrix<f64> {
    assert_eq!(
        (mass.len(), f.len()),
        (eigenvectors.nrows(), eigenvectors.nrows())
    );
    let mut weighted = eigenvectors.clone();
    for (v, mut row) in weighted.row_iter_mut().enumerate() {
        row *= mass[v] * f[v];
    }
    eigenvectors.transpose() * weighted
}

/// Crossing with the gradient of f `(n,)`: g becomes `n · (∇f × ∇g)`, `(k, k)` in the eigenvectors
/// `(n, k)` of the mesh with these faces. Its sign changes with the orientation of the surface (Ren
/// et al. 2018). O(m k²).
///
/// On a triangle the integral of that times ψ is
/// `½ [(f₁ − f₀)(g₂ − g₀) − (f₂ − f₀)(g₁ − g₀)] (ψ₀ + ψ₁ + ψ₂)/3`.
///
/// ```
/// use coseg_geometry::fmap::operators::crossing;
/// use nalgebra::DMatrix;
///
/// // On a triangle f = x, g = y: n · (∇f × ∇g) is 1, and its integral the area.
/// let basis = DMatrix::from_column_slice(3, 2, &[1.0, 1.0, 1.0, 0.0, 0.0, 1.0]); // 1 and y
/// let found = crossing(&[[0, 1, 2]], &basis, &[0.0, 1.0, 0.0]);
/// assert!((found[(0, 1)] - 0.5).abs() < 1e-12);
/// ```
///
/// # Panics
/// If lengths differ or a face names a vertex that does not exist.
pub fn crossing(faces: &[[u32; 3]], eigenvectors: &DMatrix<f64>, f: &[f64]) -> DMatrix<f64> {
    assert_eq!(f.len(), eigenvectors.nrows());
    let k = eigenvectors.ncols();
    let rows = eigenvectors.transpose();
    let (mut centres, mut turned) = (
        DMatrix::zeros(k, faces.len()),
        DMatrix::zeros(k, faces.len()),
    );
    for (t, face) in faces.iter().enumerate() {
        let [a, b, c] = face.map(|v| v as usize);
        let (u, w) = (f[b] - f[a], f[c] - f[a]);
        for j in 0..k {
            let [ga, gb, gc] = [rows[(j, a)], rows[(j, b)], rows[(j, c)]];
            centres[(j, t)] = (ga + gb + gc) / 6.0;
            turned[(j, t)] = u * (gc - ga) - w * (gb - ga);
        }
    }
    centres * turned.transpose()
}

#[cfg(test)]
mod tests {
    use super::{crossing, multiplication};
    use nalgebra::DMatrix;

    /// A square of two triangles.
    const FACES: [[u32; 3]; 2] = [[0, 1, 2], [0, 2, 3]];

    #[test]
    fn crossing_is_the_jacobian() {
        // On the unit square, f = x and g = y give n · (∇f × ∇g) = 1; its integral is the area.
        let x = [0.0, 1.0, 1.0, 0.0];
        let basis = DMatrix::from_column_slice(4, 2, &[1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 1.0, 1.0]);
        let m = crossing(&FACES, &basis, &x);
        assert!((m[(0, 1)] - 1.0).abs() < 1e-12 && m[(0, 0)].abs() < 1e-12);
        let reversed = FACES.map(|[a, b, c]| [a, c, b]);
        assert_eq!(crossing(&reversed, &basis, &x), -m);
    }

    #[test]
    fn multiplication_by_one_is_the_gram_matrix() {
        let basis = DMatrix::from_fn(4, 3, |i, j| (i * j) as f64 + 1.0);
        let m = multiplication(&basis, &[0.25; 4], &[1.0; 4]);
        assert!((m - basis.transpose() * &basis * 0.25).norm() < 1e-12);
    }
}
