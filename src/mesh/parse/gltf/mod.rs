//! glTF 2.0, as JSON or in one binary file (GLB): the triangles of its default scene.
//!
//! Faces come in this order: nodes depth first, a node's mesh before its children, both in the order of
//! the file; a mesh's primitives in order; a primitive's triangles in order. Each triangle is a face. A
//! mesh that several nodes place is read once for each. Points and lines are no faces; skins and morph
//! targets are not applied. Nothing outside the file is read.

mod buffers;
mod json;

use super::{ParseError, Polygons, shown};
use crate::mesh::{ParsedMesh, add, cross, dot, scale};
use buffers::Buffers;
use json::{Node, Primitive, Root};
use std::collections::BTreeMap;

const MAGIC: &[u8] = b"glTF";
const JSON_CHUNK: &[u8] = b"JSON";
const BINARY_CHUNK: &[u8] = b"BIN\0";
/// Vertices and corners that a scene may place beyond one for each two bytes of its file: nodes that place
/// one mesh again and again could make a small file as large as they like.
const ALLOWANCE: u64 = 1 << 16;
/// Required extensions that leave triangles where they are; integer positions are read.
const HARMLESS: [&str; 8] = [
    "KHR_materials_",
    "KHR_texture_",
    "EXT_texture_",
    "MSFT_texture_",
    "KHR_lights_",
    "KHR_xmp",
    "KHR_mesh_quantization",
    "KHR_animation_pointer",
];
/// Kinds of primitives that are made of triangles.
const TRIANGLES: u32 = 4;
const STRIP: u32 = 5;
const FAN: u32 = 6;

fn fault(place: std::fmt::Arguments<'_>, why: std::fmt::Arguments<'_>) -> ParseError {
    ParseError::Gltf {
        place: place.to_string(),
        why: why.to_string(),
    }
}

/// The JSON and the binary chunk of a file of either kind.
fn container(bytes: &[u8]) -> Result<(&[u8], Option<&[u8]>), ParseError> {
    if !bytes.starts_with(MAGIC) {
        let text = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
        return if text.trim_ascii_start().starts_with(b"{") {
            Ok((text, None))
        } else {
            Err(ParseError::BadHeader {
                found: shown(&bytes[..bytes.len().min(8)]),
                format: "a glTF",
            })
        };
    }
    let word = |at: usize| {
        let bytes = bytes.get(at..at + 4)?;
        Some(u32::from_le_bytes(bytes.try_into().ok()?))
    };
    let cut = || {
        fault(
            format_args!("the file"),
            format_args!(
                "has {} bytes, which is fewer than its header declares",
                bytes.len()
            ),
        )
    };
    let version = word(4).ok_or_else(cut)?;
    if version != 2 {
        return Err(ParseError::Unsupported {
            what: format!("glTF {version}"),
            instead: "only glTF 2.0",
        });
    }
    let length = word(8).ok_or_else(cut)? as usize;
    let (mut at, mut json, mut binary) = (12, None, None);
    if length > bytes.len() || length < at {
        return Err(cut());
    }
    while at + 8 <= length {
        let size = word(at).ok_or_else(cut)? as usize;
        let kind = &bytes[at + 4..at + 8];
        let end = (at + 8).checked_add(size).filter(|&end| end <= length);
        let chunk = &bytes[at + 8..end.ok_or_else(cut)?];
        if json.is_none() && kind == JSON_CHUNK {
            json = Some(chunk);
        } else if binary.is_none() && kind == BINARY_CHUNK {
            binary = Some(chunk);
        }
        at += 8 + size;
    }
    let json = json.ok_or(ParseError::Missing { what: "JSON chunk" })?;
    Ok((json, binary))
}

/// An affine map: three columns of a linear map, and a translation.
#[derive(Debug, Clone, Copy)]
struct Affine([[f64; 3]; 4]);

impl Affine {
    const IDENTITY: Self = Self([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0; 3]]);

    fn of(node: &Node) -> Self {
        if let Some(m) = &node.matrix {
            return Self(std::array::from_fn(|c| {
                std::array::from_fn(|r| m[4 * c + r])
            }));
        }
        let [x, y, z, w] = node.rotation.as_ref().map_or([0.0, 0.0, 0.0, 1.0], |r| **r);
        let [sx, sy, sz] = node.scale.as_ref().map_or([1.0; 3], |s| **s);
        let columns = [
            [
                1.0 - 2.0 * (y * y + z * z),
                2.0 * (x * y + z * w),
                2.0 * (x * z - y * w),
            ],
            [
                2.0 * (x * y - z * w),
                1.0 - 2.0 * (x * x + z * z),
                2.0 * (y * z + x * w),
            ],
            [
                2.0 * (x * z + y * w),
                2.0 * (y * z - x * w),
                1.0 - 2.0 * (x * x + y * y),
            ],
        ];
        Self([
            scale(columns[0], sx),
            scale(columns[1], sy),
            scale(columns[2], sz),
            node.translation.as_ref().map_or([0.0; 3], |t| **t),
        ])
    }

    fn direction(&self, [x, y, z]: [f64; 3]) -> [f64; 3] {
        add(
            add(scale(self.0[0], x), scale(self.0[1], y)),
            scale(self.0[2], z),
        )
    }

    fn point(&self, p: [f64; 3]) -> [f64; 3] {
        add(self.direction(p), self.0[3])
    }

    /// First `inner`, then this.
    fn after(&self, inner: &Self) -> Self {
        let [a, b, c, t] = inner.0;
        Self([
            self.direction(a),
            self.direction(b),
            self.direction(c),
            self.point(t),
        ])
    }

    /// Whether left and right are exchanged, so that faces turn inside out.
    fn mirrors(&self) -> bool {
        dot(cross(self.0[0], self.0[1]), self.0[2]) < 0.0
    }
}

/// The scene as it is put together.
struct Scene<'a> {
    buffers: Buffers<'a>,
    polygons: Polygons,
    /// Vertices and corners placed, and how many may be.
    n_placed: u64,
    limit: u64,
}

impl Scene<'_> {
    fn place(&mut self, n: u64) -> Result<(), ParseError> {
        self.n_placed = self.n_placed.saturating_add(n);
        if self.n_placed > self.limit {
            return Err(fault(
                format_args!("the scene"),
                format_args!(
                    "places more than {} vertices and corners, more than a file of its size may: its \
                     nodes repeat the same mesh",
                    self.limit
                ),
            ));
        }
        Ok(())
    }

    /// Adds a mesh's primitives; `bases` holds where the positions of each accessor begin, once placed.
    fn primitive(
        &mut self,
        primitive: &Primitive,
        transform: &Affine,
        bases: &mut BTreeMap<u32, u32>,
    ) -> Result<(), ParseError> {
        let mode = primitive.mode.unwrap_or(TRIANGLES);
        let Some(accessor) = primitive.attributes.position else {
            return Ok(());
        };
        if ![TRIANGLES, STRIP, FAN].contains(&mode) {
            return Ok(());
        }
        let n_vertices = self.buffers.accessor(accessor)?.count;
        let base = match bases.get(&accessor) {
            Some(base) => *base,
            None => {
                self.place(n_vertices)?;
                let base = self.polygons.mesh.vertices.len() as u32;
                let positions = self.buffers.positions(accessor)?;
                let placed = positions.into_iter().map(|p| transform.point(p));
                self.polygons.mesh.vertices.extend(placed);
                bases.insert(accessor, base);
                base
            }
        };
        let n_corners = match primitive.indices {
            Some(indices) => self.buffers.accessor(indices)?.count,
            None => n_vertices,
        };
        self.place(n_corners)?;
        let corners: Vec<u32> = match primitive.indices {
            Some(indices) => self.buffers.indices(indices)?,
            None => (0..n_vertices as u32).collect(),
        };
        if mode == TRIANGLES && !corners.len().is_multiple_of(3) {
            return Err(fault(
                format_args!("a primitive of triangles"),
                format_args!("has {} corners, which is no multiple of 3", corners.len()),
            ));
        }
        let n_triangles = match mode {
            TRIANGLES => corners.len() / 3,
            _ => corners.len().saturating_sub(2),
        };
        let mirrors = transform.mirrors();
        for i in 0..n_triangles {
            let [a, mut b, mut c] = match mode {
                TRIANGLES => [corners[3 * i], corners[3 * i + 1], corners[3 * i + 2]],
                STRIP => [corners[i], corners[i + 1 + i % 2], corners[i + 2 - i % 2]],
                _ => [corners[i + 1], corners[i + 2], corners[0]],
            };
            if mirrors {
                std::mem::swap(&mut b, &mut c);
            }
            if let Some(beyond) = [a, b, c].into_iter().find(|&v| u64::from(v) >= n_vertices) {
                return Err(ParseError::VertexOutOfRange {
                    face: self.polygons.mesh.n_polygons,
                    vertex: beyond.into(),
                    n_vertices: n_vertices as usize,
                });
            }
            self.polygons.push(&[a + base, b + base, c + base])?;
        }
        Ok(())
    }
}

/// The nodes a scene begins with: of the default scene, the first one, or all that are nobody's children.
fn roots(root: &Root<'_>) -> Result<Vec<u32>, ParseError> {
    let scenes = &root.scenes.0;
    if let Some(scene) = root.scene
        && scene >= scenes.len()
    {
        return Err(fault(
            format_args!("the file"),
            format_args!("names scene {scene}, but has {}", scenes.len()),
        ));
    }
    if let Some(scene) = scenes.get(root.scene.unwrap_or(0)) {
        return Ok(scene.nodes.0.clone());
    }
    let mut is_child = vec![false; root.nodes.0.len()];
    for child in root.nodes.0.iter().flat_map(|node| &node.children.0) {
        if let Some(is_child) = is_child.get_mut(*child as usize) {
            *is_child = true;
        }
    }
    Ok((0..is_child.len() as u32)
        .filter(|&i| !is_child[i as usize])
        .collect())
}

pub(super) fn parse(bytes: &[u8]) -> Result<ParsedMesh, ParseError> {
    let (json, binary) = container(bytes)?;
    let root = json::read(json)?;
    let harmless = |name: &str| HARMLESS.iter().any(|known| name.starts_with(known));
    if let Some(name) = root
        .extensions_required
        .0
        .iter()
        .find(|name| !harmless(name))
    {
        return Err(ParseError::Unsupported {
            what: format!("a file that requires {}", shown(name.as_bytes())),
            instead: "export it without that extension",
        });
    }
    let mut scene = Scene {
        buffers: Buffers::new(&root, binary),
        polygons: Polygons::new(Vec::new()),
        n_placed: 0,
        limit: ALLOWANCE + bytes.len() as u64 / 2,
    };
    let (nodes, meshes) = (&root.nodes.0, &root.meshes.0);
    let mut seen = vec![false; nodes.len()];
    let mut todo: Vec<(u32, Affine)> = Vec::new();
    todo.extend(
        roots(&root)?
            .into_iter()
            .rev()
            .map(|i| (i, Affine::IDENTITY)),
    );
    while let Some((index, outer)) = todo.pop() {
        let Some(node) = nodes.get(index as usize) else {
            return Err(fault(
                format_args!("the scene"),
                format_args!("names node {index}, but the file has {}", nodes.len()),
            ));
        };
        if std::mem::replace(&mut seen[index as usize], true) {
            return Err(fault(
                format_args!("node {index}"),
                format_args!("is reached twice, but nodes must form a tree"),
            ));
        }
        let transform = outer.after(&Affine::of(node));
        if let Some(mesh) = node.mesh {
            let found = meshes.get(mesh as usize).ok_or_else(|| {
                fault(
                    format_args!("node {index}"),
                    format_args!("names mesh {mesh}, but the file has {}", meshes.len()),
                )
            })?;
            let mut bases = BTreeMap::new();
            for primitive in &found.primitives.0 {
                scene.primitive(primitive, &transform, &mut bases)?;
            }
        }
        todo.extend(
            node.children
                .0
                .iter()
                .rev()
                .map(|&child| (child, transform)),
        );
    }
    scene.polygons.finish()
}
