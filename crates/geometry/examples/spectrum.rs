//! Computes the smallest eigenvalues of a mesh: `spectrum [FILE [K]]`; without a file, of a sphere.

use coseg_geometry::mesh::{self, Format, TriMesh};
use coseg_geometry::{SpectralMesh, operators::Operator, spectrum::Options};
use std::error::Error;

fn main() -> Result<(), Box<dyn Error>> {
    let mut args = std::env::args().skip(1);
    let mesh = match args.next() {
        Some(path) => {
            let format = Format::from_name(&path).ok_or("the file's extension names no format")?;
            let parsed = mesh::parse(&std::fs::read(&path)?, format)?;
            TriMesh {
                vertices: parsed.vertices,
                faces: parsed.triangles,
            }
        }
        None => mesh::icosphere(4),
    };
    let k = args.next().map_or(Ok(100), |k| k.parse())?;
    let found = SpectralMesh::new(mesh, Operator::Tufted, k, &Options::default())?;
    let spectrum = &found.spectrum;
    let worst = spectrum.residuals.iter().copied().fold(0.0, f64::max);
    println!(
        "{} vertices, {} eigenvalues, all of them: {}, largest residual {worst:.1e}",
        found.mesh.vertices.len(),
        spectrum.eigenvalues.len(),
        spectrum.certificate.proved(),
    );
    for (i, value) in spectrum.eigenvalues.iter().enumerate().take(10) {
        println!("{i:4} {value:12.6}");
    }
    Ok(())
}
