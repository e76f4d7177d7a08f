//! Reads the parts of the JSON of a glTF file that determine its triangles.
//!
//! Everything else is skipped, whatever it holds: animations, materials, cameras, skins, `extras`,
//! extensions, attributes other than positions. So a file is never refused for a part that is not
//! needed. Transforms are read in double precision: in single precision, parts of an assembly that
//! lies far from the origin would lose their relative positions.

use super::super::{ParseError, shown};
use super::fault;
use nalgebra::{Matrix4, Quaternion, Translation3, UnitQuaternion, Vector3};
use serde::de::{Error, IgnoredAny, Unexpected, Visitor};
use serde::{Deserialize, Deserializer};
use std::fmt;

/// The largest number of objects in the JSON; each takes many times as much memory as in the file.
const MAX_OBJECTS: usize = 1_000_000;
/// Prefixes of required extensions that do not affect triangles.
const HARMLESS: [&str; 20] = [
    "ADOBE_materials_",
    "CESIUM_primitive_outline",
    "EXT_lights_",
    "EXT_mesh_features",
    "EXT_mesh_manifold",
    "EXT_meshopt_compression",
    "EXT_structural_metadata",
    "EXT_texture_",
    "KHR_animation_pointer",
    "KHR_audio_",
    "KHR_interactivity",
    "KHR_lights_",
    "KHR_materials_",
    "KHR_mesh_quantization",
    "KHR_meshopt_compression",
    "KHR_physics_",
    "KHR_techniques_webgl",
    "KHR_texture_",
    "KHR_xmp",
    "MSFT_texture_",
];

/// An index, a count or a code. JSON has one kind of number, so `3.0` is accepted too.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Whole(pub(super) usize);

impl<'de> Deserialize<'de> for Whole {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Numbers;
        impl Visitor<'_> for Numbers {
            type Value = Whole;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a whole number from 0 on")
            }

            fn visit_u64<E: Error>(self, value: u64) -> Result<Whole, E> {
                usize::try_from(value)
                    .map(Whole)
                    .map_err(|_| E::invalid_value(Unexpected::Unsigned(value), &self))
            }

            fn visit_f64<E: Error>(self, value: f64) -> Result<Whole, E> {
                // Beyond 2^53 a double no longer distinguishes whole numbers.
                if value.fract() == 0.0 && (0.0..=9_007_199_254_740_992.0).contains(&value) {
                    return self.visit_u64(value as u64);
                }
                Err(E::invalid_value(Unexpected::Float(value), &self))
            }
        }
        deserializer.deserialize_any(Numbers)
    }
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Document {
    asset: Asset,
    #[serde(default)]
    extensions_required: Vec<String>,
    pub(super) scene: Option<Whole>,
    #[serde(default)]
    pub(super) scenes: Vec<Scene>,
    #[serde(default)]
    pub(super) nodes: Vec<Node>,
    #[serde(default)]
    pub(super) meshes: Vec<Mesh>,
    #[serde(default)]
    pub(super) accessors: Vec<Accessor>,
    #[serde(default)]
    pub(super) buffer_views: Vec<View>,
    #[serde(default)]
    pub(super) buffers: Vec<Buffer>,
}

#[derive(Deserialize)]
struct Asset {
    version: String,
}

#[derive(Deserialize)]
pub(super) struct Scene {
    #[serde(default)]
    pub(super) nodes: Vec<Whole>,
}

#[derive(Deserialize)]
pub(super) struct Node {
    pub(super) mesh: Option<Whole>,
    #[serde(default)]
    pub(super) children: Vec<Whole>,
    /// Column-major; replaces the other three.
    matrix: Option<Box<[f64; 16]>>,
    translation: Option<Box<[f64; 3]>>,
    /// Unit quaternion x, y, z, w.
    rotation: Option<Box<[f64; 4]>>,
    scale: Option<Box<[f64; 3]>>,
}

impl Node {
    pub(super) fn transform(&self) -> Matrix4<f64> {
        if let Some(columns) = &self.matrix {
            return Matrix4::from_column_slice(&columns[..]);
        }
        let three = |v: &Option<Box<[f64; 3]>>, or: f64| v.as_deref().copied().unwrap_or([or; 3]);
        // The quaternion is not normalised: one of another length scales.
        let rotation = self.rotation.as_deref().copied();
        let rotation = Quaternion::from(rotation.unwrap_or([0.0, 0.0, 0.0, 1.0]));
        Translation3::from(three(&self.translation, 0.0)).to_homogeneous()
            * UnitQuaternion::new_unchecked(rotation).to_homogeneous()
            * Matrix4::new_nonuniform_scaling(&Vector3::from(three(&self.scale, 1.0)))
    }
}

#[derive(Deserialize)]
pub(super) struct Mesh {
    #[serde(default)]
    pub(super) primitives: Vec<Primitive>,
}

#[derive(Deserialize)]
pub(super) struct Primitive {
    #[serde(default)]
    attributes: Attributes,
    pub(super) indices: Option<Whole>,
    mode: Option<Whole>,
    extensions: Option<PrimitiveExtensions>,
}

#[derive(Default, Deserialize)]
struct Attributes {
    #[serde(rename = "POSITION")]
    positions: Option<Whole>,
}

#[derive(Deserialize)]
struct PrimitiveExtensions {
    #[serde(rename = "KHR_draco_mesh_compression")]
    draco: Option<IgnoredAny>,
}

impl Primitive {
    /// The accessor of positions; without one the primitive has no triangles.
    pub(super) fn positions(&self) -> Option<Whole> {
        self.attributes.positions
    }

    pub(super) fn mode(&self) -> usize {
        self.mode.map_or(4, |mode| mode.0)
    }

    pub(super) fn is_draco(&self) -> bool {
        self.extensions.as_ref().is_some_and(|e| e.draco.is_some())
    }
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Accessor {
    pub(super) buffer_view: Option<Whole>,
    #[serde(default)]
    pub(super) byte_offset: Whole,
    pub(super) component_type: Whole,
    #[serde(default)]
    pub(super) normalized: bool,
    pub(super) count: Whole,
    #[serde(rename = "type")]
    pub(super) dimensions: String,
    pub(super) sparse: Option<Box<Sparse>>,
}

#[derive(Deserialize)]
pub(super) struct Sparse {
    pub(super) count: Whole,
    pub(super) indices: SparsePart,
    pub(super) values: SparsePart,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct SparsePart {
    pub(super) buffer_view: Whole,
    #[serde(default)]
    pub(super) byte_offset: Whole,
    /// For indices only.
    #[serde(default)]
    pub(super) component_type: Whole,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct View {
    pub(super) buffer: Whole,
    #[serde(default)]
    pub(super) byte_offset: Whole,
    pub(super) byte_length: Whole,
    pub(super) byte_stride: Option<Whole>,
    extensions: Option<Box<ViewExtensions>>,
}

#[derive(Deserialize)]
struct ViewExtensions {
    #[serde(rename = "EXT_meshopt_compression", alias = "KHR_meshopt_compression")]
    meshopt: Option<Compressed>,
}

/// The range of a view that is compressed by meshopt.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Compressed {
    pub(super) buffer: Whole,
    #[serde(default)]
    pub(super) byte_offset: Whole,
    pub(super) byte_length: Whole,
    pub(super) byte_stride: Whole,
    pub(super) count: Whole,
    pub(super) mode: String,
    #[serde(default)]
    pub(super) filter: Option<String>,
}

impl View {
    pub(super) fn compressed(&self) -> Option<&Compressed> {
        self.extensions.as_ref()?.meshopt.as_ref()
    }
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Buffer {
    pub(super) byte_length: Whole,
    pub(super) uri: Option<String>,
}

/// The entry of a list at an index, which `location` names.
pub(super) fn named<'a, T>(
    list: &'a [T],
    index: Whole,
    what: &str,
    location: impl fmt::Display,
) -> Result<&'a T, ParseError> {
    list.get(index.0).ok_or_else(|| {
        let why = format!("names {what} {}, but the file has {}", index.0, list.len());
        fault(location, why)
    })
}

impl Document {
    pub(super) fn read(text: &[u8]) -> Result<Self, ParseError> {
        let no_json = |error: serde_json::Error| ParseError::Json {
            reason: error.to_string(),
        };
        // Most files have few braces, so this cheap test suffices for them.
        if text.iter().filter(|&&b| b == b'{').count() > MAX_OBJECTS {
            let extent: Extent = serde_json::from_slice(text).map_err(no_json)?;
            let n_objects = extent.n_objects();
            if n_objects > MAX_OBJECTS {
                return Err(fault(
                    "the JSON",
                    format_args!(
                        "has {n_objects} nodes, meshes, primitives, accessors, buffers and views, \
                         but at most {MAX_OBJECTS} are read"
                    ),
                ));
            }
        }
        let document: Self = serde_json::from_slice(text).map_err(no_json)?;
        let version = &document.asset.version;
        if !version.starts_with("2.") {
            return Err(ParseError::Unsupported {
                what: format!("glTF {}", shown(version.as_bytes())),
                instead: "only glTF 2.0",
            });
        }
        let harmless = |name: &str| HARMLESS.iter().any(|known| name.starts_with(known));
        let unknown = document.extensions_required.iter().find(|e| !harmless(e));
        match unknown {
            None => Ok(document),
            Some(name) => Err(ParseError::Unsupported {
                what: format!("a file that requires {}", shown(name.as_bytes())),
                instead: "export it without that extension",
            }),
        }
    }
}

/// The lengths of the lists, without their entries.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase", default)]
#[derive(Default)]
struct Extent {
    scenes: Vec<IgnoredAny>,
    nodes: Vec<IgnoredAny>,
    meshes: Vec<MeshExtent>,
    accessors: Vec<IgnoredAny>,
    buffer_views: Vec<IgnoredAny>,
    buffers: Vec<IgnoredAny>,
}

#[derive(Deserialize)]
struct MeshExtent {
    #[serde(default)]
    primitives: Vec<IgnoredAny>,
}

impl Extent {
    fn n_objects(&self) -> usize {
        let lists = [
            &self.scenes,
            &self.nodes,
            &self.accessors,
            &self.buffer_views,
            &self.buffers,
        ];
        let of_meshes = self.meshes.iter().map(|mesh| 1 + mesh.primitives.len());
        lists.iter().map(|list| list.len()).chain(of_meshes).sum()
    }
}
