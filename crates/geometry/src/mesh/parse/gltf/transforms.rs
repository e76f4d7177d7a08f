//! The transforms of a glTF file's nodes in double precision, which `gltf` reads in single: parts of an
//! assembly that lies far from the origin would lose their places against each other.

use gltf::json::{self, deserialize};
use nalgebra::{Matrix4, Quaternion, Translation3, Vector3};
use serde::Deserialize;

#[derive(Deserialize)]
struct Nodes {
    #[serde(default)]
    nodes: Vec<Transform>,
}

#[derive(Deserialize)]
struct Transform {
    /// Column-major; in the place of the other three.
    matrix: Option<[f64; 16]>,
    translation: Option<[f64; 3]>,
    /// Unit quaternion x, y, z, w.
    rotation: Option<[f64; 4]>,
    scale: Option<[f64; 3]>,
}

/// The transform of each node, by its index.
pub(super) fn read(text: &[u8]) -> Result<Vec<Matrix4<f64>>, json::Error> {
    let file: Nodes = deserialize::from_slice(text)?;
    Ok(file.nodes.iter().map(matrix).collect())
}

fn matrix(node: &Transform) -> Matrix4<f64> {
    if let Some(columns) = &node.matrix {
        return Matrix4::from_column_slice(columns);
    }
    let translation = Translation3::from(node.translation.unwrap_or([0.0; 3]));
    // As written, not made a unit: a rotation that is none scales.
    let rotation = Quaternion::from(node.rotation.unwrap_or([0.0, 0.0, 0.0, 1.0]));
    let scale = Vector3::from(node.scale.unwrap_or([1.0; 3]));
    let rotation = nalgebra::UnitQuaternion::new_unchecked(rotation);
    translation.to_homogeneous()
        * rotation.to_homogeneous()
        * Matrix4::new_nonuniform_scaling(&scale)
}
