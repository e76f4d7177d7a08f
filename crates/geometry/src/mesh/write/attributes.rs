//! What a glTF or OBJ file says of its surface beside positions: texture coordinates, normals,
//! colours and materials, for files in other formats.
//!
//! Attributes that are damaged, or of a kind that glTF does not allow, are left out: the reader
//! does not look at them either.

use super::glb::to_srgb;
use super::gltf::index;
use super::obj::Statements;
use super::obj_glb::Tables;
use crate::mesh::parse::gltf::{Span, container, spans, with_vectors};
use crate::mesh::parse::{as_utf8, obj as reader};
use crate::mesh::{Format, ParseError, ParsedMesh, parse};
use nalgebra::Vector3;
use serde_json::Value;
use std::collections::BTreeMap;

/// The index of none.
const NONE: u32 = u32::MAX;

/// A material of a file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OwnMaterial {
    /// Its name; `material_2` if it has none.
    pub name: String,
    /// Its diffuse sRGB colour, if the file says it.
    pub colour: Option<[u8; 3]>,
}

/// Attributes of the corners and polygons of a file. Without any by default.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Attributes {
    /// Texture coordinates; the second counts from the bottom of the image, as in OBJ.
    pub texture: Vec<[f32; 2]>,
    /// Normals of length 1.
    pub normals: Vec<[f32; 3]>,
    /// sRGB colours, 0 to 1.
    pub colours: Vec<[f32; 3]>,
    /// The materials that polygons have.
    pub materials: Vec<OwnMaterial>,
    /// For each corner its texture coordinates, normal and colour.
    corners: Vec<[u32; 3]>,
    /// Where the corners of each polygon begin.
    starts: Vec<usize>,
    material_of: Vec<u32>,
}

/// The three kinds of attributes of corners.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Kind {
    Texture,
    Normal,
    Colour,
}

impl Attributes {
    /// Those of a file. OFF, STL and PLY files have none here.
    ///
    /// ```
    /// use coseg_geometry::mesh::{Format, write::Attributes};
    ///
    /// let file = b"v 0 0 0 1 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0.25\nusemtl oak\nf 1/1 2/1 3/1\n";
    /// let found = Attributes::of(file, Format::Obj)?;
    /// assert_eq!(found.texture, [[0.0, 0.25]]);
    /// assert_eq!(found.colours[0], [1.0, 0.0, 0.0]);
    /// assert_eq!(found.materials[0].name, "oak");
    /// # Ok::<_, coseg_geometry::mesh::ParseError>(())
    /// ```
    ///
    /// # Errors
    /// If the file cannot be read.
    pub fn of(bytes: &[u8], format: Format) -> Result<Self, ParseError> {
        match format {
            Format::Gltf => Self::of_gltf(bytes),
            Format::Obj => Self::of_obj(bytes),
            _ => Ok(Self::default()),
        }
    }

    fn of_obj(bytes: &[u8]) -> Result<Self, ParseError> {
        let bytes = as_utf8(bytes);
        let mesh = parse(&bytes, Format::Obj)?;
        let statements = Statements::of(&bytes)?;
        let tables = Tables::of(&statements.kept)?;
        let states = statements.objects().states;
        let mut found = Self {
            // As the file counts them again.
            texture: tables.texture.iter().map(|[u, v]| [*u, 1.0 - v]).collect(),
            normals: tables
                .normals
                .iter()
                .map(|n| n.unwrap_or([0.0; 3]))
                .collect(),
            colours: tables.colours.clone(),
            ..Self::default()
        };
        let mut known: BTreeMap<&[u8], u32> = BTreeMap::new();
        for (polygon, (element, state)) in mesh.polygons().iter().zip(&statements.faces) {
            let material = states[*state as usize].material.as_slice();
            let index = if material.is_empty() {
                NONE
            } else {
                *known.entry(material).or_insert_with(|| {
                    let name = String::from_utf8_lossy(material).into_owned();
                    found.materials.push(OwnMaterial { name, colour: None });
                    found.materials.len() as u32 - 1
                })
            };
            found.begin(index);
            for (vertex, texture, normal) in tables.corners(element, polygon) {
                let colour = Some(vertex).filter(|v| (*v as usize) < tables.colours.len());
                let corner = [texture, normal, colour].map(|index| index.unwrap_or(NONE));
                found.corners.push(corner);
            }
        }
        Ok(found)
    }

    fn of_gltf(bytes: &[u8]) -> Result<Self, ParseError> {
        let bytes = as_utf8(bytes);
        let (mesh, spans) = spans(&bytes)?;
        let (text, _) = container(&bytes)?;
        let root: Value = serde_json::from_slice(text).map_err(|error| ParseError::Json {
            reason: error.to_string(),
        })?;
        with_vectors(&bytes, |vectors| {
            let mut reading = Reading {
                found: Self::default(),
                vectors,
                root: &root,
                tables: BTreeMap::new(),
                materials: BTreeMap::new(),
            };
            for span in &spans {
                reading.span(&mesh, span);
            }
            reading.found
        })
    }

    /// Begins the next polygon, whose corners follow.
    fn begin(&mut self, material: u32) {
        self.starts.push(self.corners.len());
        self.material_of.push(material);
    }

    /// The material of a polygon, by index.
    pub(super) fn material(&self, polygon: u32) -> Option<usize> {
        let index = self.material_of.get(polygon as usize)?;
        (*index != NONE).then_some(*index as usize)
    }

    /// An attribute of a corner of a polygon, by index.
    pub(super) fn corner(&self, polygon: u32, corner: usize, kind: Kind) -> Option<u32> {
        let start = self.starts.get(polygon as usize)?;
        let index = self.corners.get(start + corner)?[kind as usize];
        (index != NONE).then_some(index)
    }

    /// The attribute of each vertex `(n,)`, by index, where all of its corners have the same;
    /// `None` if a vertex has two, or no vertex has any.
    pub(super) fn of_vertices<P: AsRef<[u32]>, const N: usize>(
        &self,
        polygons: &[P],
        n_vertices: usize,
        kind: Kind,
        values: &[[f32; N]],
    ) -> Option<Vec<Option<u32>>> {
        let mut found: Vec<Option<u32>> = vec![None; n_vertices];
        for (polygon, corners) in (0..).zip(polygons) {
            for (i, &vertex) in corners.as_ref().iter().enumerate() {
                let Some(index) = self.corner(polygon, i, kind) else {
                    continue;
                };
                let known = &mut found[vertex as usize];
                match known {
                    Some(other) if values[*other as usize] != values[index as usize] => {
                        return None;
                    }
                    Some(_) => {}
                    None => *known = Some(index),
                }
            }
        }
        found.iter().any(Option::is_some).then_some(found)
    }
}

/// The attributes of a glTF file while it is read.
struct Reading<'a> {
    found: Attributes,
    vectors: &'a dyn Fn(usize, usize) -> Option<Vec<[f64; 4]>>,
    root: &'a Value,
    /// Where the values of an accessor begin, for each node that places it; `NONE`: it has none.
    tables: BTreeMap<(Option<usize>, usize, Kind), u32>,
    materials: BTreeMap<usize, u32>,
}

impl Reading<'_> {
    fn span(&mut self, mesh: &ParsedMesh, span: &Span) {
        let primitive = &self.root["meshes"][span.mesh]["primitives"][span.primitive];
        let attributes = &primitive["attributes"];
        let count = index(&attributes["POSITION"])
            .and_then(|positions| index(&self.root["accessors"][positions]["count"]));
        let bases = [
            ("TEXCOORD_0", Kind::Texture),
            ("NORMAL", Kind::Normal),
            ("COLOR_0", Kind::Colour),
        ]
        .map(|(name, kind)| match index(&attributes[name]).zip(count) {
            Some((accessor, count)) => self.table(span, accessor, count, kind),
            None => NONE,
        });
        let material = index(&primitive["material"]).map_or(NONE, |index| self.material(index));
        for polygon in span.polygons.clone() {
            self.found.begin(material);
            for vertex in mesh.triangles[polygon] {
                let at = vertex - span.first_vertex;
                let corner = bases.map(|base| if base == NONE { NONE } else { base + at });
                self.found.corners.push(corner);
            }
        }
    }

    /// Where the values of an accessor begin in what was found.
    fn table(&mut self, span: &Span, accessor: usize, count: usize, kind: Kind) -> u32 {
        let key = (span.node, accessor, kind);
        if let Some(base) = self.tables.get(&key) {
            return *base;
        }
        let values = (self.vectors)(accessor, count).unwrap_or_default();
        let found = &mut self.found;
        let base = match kind {
            Kind::Texture => append(&mut found.texture, &values, |[u, v, ..]| {
                [u as f32, (1.0 - v) as f32]
            }),
            Kind::Normal => {
                let linear = span.transform.fixed_view::<3, 3>(0, 0).into_owned();
                // Of a transform that flattens the mesh there is none.
                let turned = linear.try_inverse().map(|inverse| inverse.transpose());
                let values = if turned.is_some() {
                    values.as_slice()
                } else {
                    &[]
                };
                append(&mut found.normals, values, |[x, y, z, _]| {
                    let normal = turned.unwrap_or_default() * Vector3::new(x, y, z);
                    let length = normal.norm();
                    let unit = if length > 0.0 {
                        normal / length
                    } else {
                        normal
                    };
                    [unit.x as f32, unit.y as f32, unit.z as f32]
                })
            }
            Kind::Colour => append(&mut found.colours, &values, |[r, g, b, _]| {
                [r, g, b].map(|x| to_srgb(x.clamp(0.0, 1.0)) as f32)
            }),
        };
        self.tables.insert(key, base);
        base
    }

    fn material(&mut self, index: usize) -> u32 {
        if let Some(known) = self.materials.get(&index) {
            return *known;
        }
        let material = &self.root["materials"][index];
        let name = material["name"].as_str().filter(|name| !name.is_empty());
        let factor = &material["pbrMetallicRoughness"]["baseColorFactor"];
        let part = |i: usize| match factor {
            // The colour of a material that does not say it.
            Value::Null => 1.0,
            factor => factor[i].as_f64().unwrap_or(1.0).clamp(0.0, 1.0),
        };
        let colour = [0, 1, 2].map(|i| (255.0 * to_srgb(part(i))).round() as u8);
        self.found.materials.push(OwnMaterial {
            name: name.map_or_else(|| format!("material_{index}"), str::to_owned),
            colour: Some(colour),
        });
        let known = self.found.materials.len() as u32 - 1;
        self.materials.insert(index, known);
        known
    }
}

/// Adds values to a table, and returns where they begin; `NONE` if one is no number, or there are
/// none.
fn append<const N: usize>(
    table: &mut Vec<[f32; N]>,
    values: &[[f64; 4]],
    value: impl Fn([f64; 4]) -> [f32; N],
) -> u32 {
    let base = table.len();
    table.extend(values.iter().map(|v| value(*v)));
    let is_number = table[base..].iter().flatten().all(|x| x.is_finite());
    if values.is_empty() || !is_number {
        table.truncate(base);
        return NONE;
    }
    base as u32
}

/// The colours of the vertices of an OBJ file, `v x y z r g b`, from 0 to 1; empty without any.
/// Vertices without one are white. Numbers above 1 are taken as 0 to 255 in the whole file.
pub(super) fn colours_of_obj(bytes: &[u8]) -> Result<Vec<[f32; 3]>, ParseError> {
    let (mut colours, mut largest, mut any) = (Vec::new(), 1.0_f64, false);
    reader::statements(bytes, |statement, _, _| {
        let mut words = crate::mesh::parse::text::words(statement);
        if words.next() != Some(b"v") {
            return Ok(());
        }
        let numbers: Vec<f64> = words
            .skip(3)
            .map_while(|word| std::str::from_utf8(word).ok()?.parse().ok())
            .filter(|x: &f64| x.is_finite())
            .collect();
        let colour = match numbers.as_slice() {
            [r, g, b, ..] => {
                any = true;
                largest = numbers[..3].iter().fold(largest, |m, x| m.max(*x));
                Some([*r, *g, *b])
            }
            _ => None,
        };
        colours.push(colour);
        Ok(())
    })?;
    if !any {
        return Ok(Vec::new());
    }
    let scale = if largest > 1.0 { 255.0 } else { 1.0 };
    let of = |colour: Option<[f64; 3]>| match colour {
        Some(colour) => colour.map(|x| (x / scale).clamp(0.0, 1.0) as f32),
        None => [1.0; 3],
    };
    Ok(colours.into_iter().map(of).collect())
}

#[cfg(test)]
mod tests;
