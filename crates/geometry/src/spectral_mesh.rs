//! Computes the Laplacian and the spectrum of a triangle mesh scaled to area 1, at full resolution.
//!
//! A functional map between two meshes needs these of each; [`crate::fmap::point_maps`] computes
//! the map.

use crate::fmap::{Basis, EstimateOptions, PointShape};
use crate::mesh::{Bridge, FaceGeometry, TriMesh, bridges};
use crate::operators::{Laplacian, LaplacianError, Operator, laplacian};
use crate::spectrum::{Options, Spectrum, SpectrumError};

/// A mesh of area 1 with the smallest eigenpairs of its Laplacian.
#[derive(Debug, Clone)]
pub struct SpectralMesh {
    /// Vertices `(n, 3)` and faces `(m, 3)`, scaled to area 1 about the origin.
    pub mesh: TriMesh,
    /// Virtual edges that join the components of the mesh.
    pub bridges: Vec<Bridge>,
    /// Stiffness W `(n, n)` and lumped mass `(n,)`.
    pub laplacian: Laplacian,
    /// Eigenvalues `(k,)` and mass-orthonormal eigenvectors `(n, k)`, with the certificate.
    pub spectrum: Spectrum,
    // In the layout of functional maps: row-major, in single precision.
    vertices: Vec<[f32; 3]>,
    eigenvectors: Vec<f32>,
    mass: Vec<f32>,
}

/// Why a mesh has no spectrum.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)]
pub enum SpectralMeshError {
    #[error("the mesh has no area")]
    NoArea,
    #[error(transparent)]
    Laplacian(#[from] LaplacianError),
    #[error(transparent)]
    Spectrum(#[from] SpectrumError),
}

impl SpectralMesh {
    /// Scales `mesh` to area 1 and computes the `k` smallest eigenpairs of its Laplacian
    /// (all of them if it has fewer vertices than `k`). The cost is about `n k²`.
    ///
    /// The mesh keeps its vertices; use [`crate::mesh::clean`] first if it may have defects.
    ///
    /// ```
    /// use coseg_geometry::mesh::icosphere;
    /// use coseg_geometry::operators::Operator;
    /// use coseg_geometry::spectrum::Options;
    /// use coseg_geometry::SpectralMesh;
    ///
    /// let sphere = SpectralMesh::new(icosphere(3), Operator::Tufted, 9, &Options::default())?;
    /// assert!(sphere.spectrum.certificate.proved());
    /// // A sphere of area 1 has the eigenvalues 4π l (l + 1), 2 l + 1 times each.
    /// let exact = 4.0 * std::f64::consts::PI * 2.0;
    /// assert!((sphere.spectrum.eigenvalues[1] / exact - 1.0).abs() < 0.02);
    /// # Ok::<_, coseg_geometry::SpectralMeshError>(())
    /// ```
    ///
    /// # Errors
    /// If the mesh has no area, or its spectrum cannot be proved complete.
    pub fn new(
        mut mesh: TriMesh,
        operator: Operator,
        k: usize,
        options: &Options<'_>,
    ) -> Result<Self, SpectralMeshError> {
        let area: f64 = FaceGeometry::new(&mesh).areas.iter().sum();
        let scale = area.sqrt().recip();
        if !scale.is_finite() || scale <= 0.0 {
            return Err(SpectralMeshError::NoArea);
        }
        for vertex in &mut mesh.vertices {
            *vertex = vertex.map(|x| x * scale);
        }
        let bridges = bridges(&mesh);
        let laplacian = laplacian(&mesh, &bridges, operator)?;
        let k = k.min(mesh.vertices.len());
        let spectrum = Spectrum::smallest(&laplacian.stiffness, &laplacian.mass, k, options)?;
        let to_single = |v: &[f64; 3]| v.map(|x| x as f32);
        Ok(Self {
            vertices: mesh.vertices.iter().map(to_single).collect(),
            eigenvectors: spectrum
                .eigenvectors
                .transpose()
                .iter()
                .map(|x| *x as f32)
                .collect(),
            mass: laplacian.mass.iter().map(|m| *m as f32).collect(),
            mesh,
            bridges,
            laplacian,
            spectrum,
        })
    }

    /// The data that all maps from or to this mesh share: samples, probe functions and the
    /// orientation.
    ///
    /// ```
    /// use coseg_geometry::fmap::{EstimateOptions, point_maps};
    /// use coseg_geometry::mesh::{TriMesh, icosphere};
    /// use coseg_geometry::operators::Operator;
    /// use coseg_geometry::spectrum::Options;
    /// use coseg_geometry::SpectralMesh;
    ///
    /// // An egg and the same egg turned: no two of its points are alike but by reflection.
    /// let mut egg = icosphere(3);
    /// for [x, y, z] in &mut egg.vertices {
    ///     *x *= 1.0 + 0.3 * *z;
    ///     *y *= 1.5;
    ///     *z *= 2.2;
    /// }
    /// let vertices = egg.vertices.iter().map(|[x, y, z]| [*z, *x, *y]).collect();
    /// let turned = TriMesh { vertices, faces: egg.faces.clone() };
    /// let of = |mesh| SpectralMesh::new(mesh, Operator::Tufted, 60, &Options::default());
    /// let (one, two) = (of(egg)?, of(turned)?);
    ///
    /// let options = EstimateOptions::default();
    /// let (from, to) = (one.point_shape(&options), two.point_shape(&options));
    /// let maps = point_maps(&from, &to, &[], &options);
    /// // For each vertex of shape 2 a vertex of shape 1.
    /// assert_eq!(maps[0].p2p_21.len(), two.mesh.vertices.len());
    /// # Ok::<_, coseg_geometry::SpectralMeshError>(())
    /// ```
    pub fn point_shape(&self, options: &EstimateOptions) -> PointShape<'_> {
        PointShape::new(&self.vertices, &self.mesh.faces, self.basis(), options)
    }

    /// The spectrum in the form that functional maps take: row-major, in single precision, total
    /// mass 1.
    ///
    /// ```
    /// use coseg_geometry::{SpectralMesh, mesh::icosphere, operators::Operator, spectrum::Options};
    ///
    /// let sphere = SpectralMesh::new(icosphere(2), Operator::Tufted, 4, &Options::default())?;
    /// // The constant function 2 has one coefficient.
    /// let coefficients = sphere.basis().project(&[2.0; 162], 1, 4);
    /// assert!((coefficients[0].abs() - 2.0).abs() < 1e-4);
    /// assert!(coefficients[1..].iter().all(|c| c.abs() < 1e-4));
    /// # Ok::<_, coseg_geometry::SpectralMeshError>(())
    /// ```
    pub fn basis(&self) -> Basis<'_> {
        Basis {
            eigenvalues: &self.spectrum.eigenvalues,
            eigenvectors: &self.eigenvectors,
            n_eigenvectors: self.spectrum.eigenvalues.len(),
            mass: &self.mass,
        }
    }
}
