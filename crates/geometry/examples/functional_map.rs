//! Computes a functional map between two meshes: `functional_map [ONE TWO]`; without files, between
//! a lumpy sphere and the same one turned and stretched.

use coseg_geometry::fmap::{EstimateOptions, point_maps};
use coseg_geometry::mesh::{self, Format, TriMesh};
use coseg_geometry::{SpectralMesh, operators::Operator, spectrum::Options};
use std::error::Error;

fn read(path: &str) -> Result<TriMesh, Box<dyn Error>> {
    let format = Format::from_name(path).ok_or("the file's extension names no format")?;
    let parsed = mesh::parse(&std::fs::read(path)?, format)?;
    Ok(TriMesh {
        vertices: parsed.vertices,
        faces: parsed.triangles,
    })
}

/// A sphere with a head, two arms and a foot.
fn lumpy(stretch: f64) -> TriMesh {
    let mut mesh = mesh::icosphere(4);
    let lumps = [
        ([0.0, 0.0, 1.0], 0.8),
        ([1.0, 0.0, 0.2], 0.5),
        ([-0.9, 0.3, 0.0], 0.4),
    ];
    for v in &mut mesh.vertices {
        let at = *v;
        let grown: f64 = lumps
            .iter()
            .map(|(p, height)| {
                let d: f64 = (0..3).map(|i| (at[i] - p[i]) * (at[i] - p[i])).sum();
                height * (-6.0 * d).exp()
            })
            .sum();
        *v = at.map(|x| x * (1.0 + grown));
        v[2] *= stretch;
    }
    mesh
}

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let (one, two) = match args.as_slice() {
        [] => (lumpy(1.0), lumpy(1.2)),
        [one, two] => (read(one)?, read(two)?),
        _ => return Err("name two meshes, or none".into()),
    };
    let of = |mesh| SpectralMesh::new(mesh, Operator::Tufted, 100, &Options::default());
    let (one, two) = (of(one)?, of(two)?);
    let options = EstimateOptions::default();
    let maps = point_maps(
        &one.point_shape(&options),
        &two.point_shape(&options),
        &[],
        &options,
    );
    let map = maps.first().ok_or("no map was found")?;
    println!(
        "c_12 is {k} x {k}, orientation {:+.2}, expected error {:.4}",
        map.orientation,
        map.expected_error,
        k = map.k,
    );
    for (vertex, image) in map.p2p_21.iter().enumerate().take(5) {
        println!("vertex {vertex} of the second mesh goes to vertex {image} of the first");
    }
    Ok(())
}
