//! Labelled polygons become Wavefront OBJ text with one group for each part instance.
//!
//! An OBJ that was read keeps everything it holds ([`labelled_obj`]): its statements stay as they
//! are, and only its faces are put in other groups. Polygons are grouped, so that comments say
//! which ones a group has: `# label 2` and `# faces 0-12 15`, counted from 0 in the order of the
//! input.

use super::attributes::Kind;
use super::labelling::{runs, unique_names};
use super::{Attributes, LabelStyle, Labelling, Materials, append, line};
use crate::mesh::parse::text::words;
use crate::mesh::parse::{as_utf8, obj as reader};
use crate::mesh::{Format, Instances, ParseError, instances, parse};
use std::collections::BTreeMap;

/// Columns of a comment: some readers have a limit for lines.
const WIDTH: usize = 100;

/// What the comments of a group begin with.
const OWN_COMMENTS: [&[u8]; 2] = [b"# label ", b"# faces "];

/// Names end at white space in OBJ and MTL.
fn spelled(name: &str) -> String {
    name.replace(char::is_whitespace, "_")
}

/// Names of the groups of part instances, by instance.
fn group_names(labelling: &Labelling<'_>, found: &Instances) -> Vec<String> {
    let names = labelling.names(spelled);
    let instances = found.labels.iter().zip(&found.numbers);
    instances
        .map(|(label, number)| format!("{}.{number:03}", names[label]))
        .collect()
}

/// Comments with the label and the polygons of a group.
fn comments(out: &mut String, label: i32, polygons: &[u32]) {
    line(out, format_args!("# label {label}"));
    let mut text = String::from("# faces");
    for (first, count) in runs(polygons) {
        let run = match count {
            1 => format!(" {first}"),
            _ => format!(" {first}-{}", first as usize + count - 1),
        };
        if text.len() + run.len() > WIDTH {
            line(out, format_args!("{text}"));
            text = String::from("# faces");
        }
        text.push_str(&run);
    }
    line(out, format_args!("{text}"));
}

/// Wavefront OBJ text: a group for each part instance, such as `leg.001`, with the material of its
/// label. `material_file` is the name of a file with the text of [`mtl`].
///
/// ```
/// use coseg_geometry::mesh::write::{self, Labelling, LabelStyle};
///
/// let vertices = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
/// let leg = LabelStyle { name: "leg".into(), colour: [255, 0, 0] };
/// let styles = [(7, leg)].into();
/// let labelling = Labelling { labels: &[7], confidence: None, styles: &styles };
/// let text = write::obj(&vertices, &[[0, 1, 2]], &labelling, "parts.mtl");
/// assert!(text.starts_with("mtllib parts.mtl\nv 0 0 0\n"));
/// assert!(text.ends_with("g leg.001\n# label 7\n# faces 0\nusemtl leg\nf 1 2 3\n"));
/// ```
///
/// # Panics
/// If there is not one label per polygon.
pub fn obj<P: AsRef<[u32]>>(
    vertices: &[[f64; 3]],
    polygons: &[P],
    labelling: &Labelling<'_>,
    material_file: &str,
) -> String {
    let none = (&Attributes::default(), None);
    obj_with(vertices, polygons, labelling, material_file, none)
}

/// Names in `material_file` of the materials of [`Attributes`], by index.
pub type OwnNames<'a> = &'a [String];

/// Like [`obj`], with the texture coordinates, normals and colours of another file. Faces have
/// their own materials under the given names; without names, or a material, that of their label.
/// Colours are of vertices here (`v x y z r g b`), so there are none if a vertex has two.
///
/// # Panics
/// If there is not one label per polygon, and one name per material.
pub fn obj_with<P: AsRef<[u32]>>(
    vertices: &[[f64; 3]],
    polygons: &[P],
    labelling: &Labelling<'_>,
    material_file: &str,
    (attributes, own): (&Attributes, Option<OwnNames<'_>>),
) -> String {
    let found = instances(
        vertices,
        polygons,
        labelling.labels,
        &vec![0; polygons.len()],
    );
    let (names, materials) = (group_names(labelling, &found), labelling.names(spelled));
    let mut out = String::with_capacity(60 * vertices.len() + 20 * polygons.len());
    line(&mut out, format_args!("mtllib {material_file}"));
    tables(&mut out, vertices, polygons, attributes);
    let mut members: Vec<Vec<u32>> = vec![Vec::new(); names.len()];
    for (polygon, &instance) in (0..).zip(&found.of_polygon) {
        members[instance as usize].push(polygon);
    }
    for ((name, label), members) in names.iter().zip(&found.labels).zip(&members) {
        line(&mut out, format_args!("g {name}"));
        comments(&mut out, *label, members);
        let mut set = "";
        for &polygon in members {
            let named = own.zip(attributes.material(polygon));
            let material = named.map_or(materials[label].as_str(), |(own, i)| own[i].as_str());
            if material != set {
                line(&mut out, format_args!("usemtl {material}"));
                set = material;
            }
            face(
                &mut out,
                polygon,
                polygons[polygon as usize].as_ref(),
                attributes,
            );
        }
    }
    out
}

/// Positions, with their colours if they have them, texture coordinates and normals.
fn tables<P: AsRef<[u32]>>(
    out: &mut String,
    vertices: &[[f64; 3]],
    polygons: &[P],
    attributes: &Attributes,
) {
    let values = &attributes.colours;
    let colours = attributes.of_vertices(polygons, vertices.len(), Kind::Colour, values);
    for (i, [x, y, z]) in vertices.iter().enumerate() {
        append(out, format_args!("v {x} {y} {z}"));
        if let Some(colours) = &colours {
            // Every vertex has a colour, or readers expect none.
            let [r, g, b] = colours[i].map_or([1.0; 3], |at| values[at as usize]);
            append(out, format_args!(" {r} {g} {b}"));
        }
        out.push('\n');
    }
    for [u, v] in &attributes.texture {
        line(out, format_args!("vt {u} {v}"));
    }
    for [x, y, z] in &attributes.normals {
        line(out, format_args!("vn {x} {y} {z}"));
    }
}

/// A face: OBJ counts from 1, and u64 holds the successor of every u32.
fn face(out: &mut String, polygon: u32, corners: &[u32], attributes: &Attributes) {
    out.push('f');
    for (i, corner) in corners.iter().enumerate() {
        let index = |kind| {
            attributes
                .corner(polygon, i, kind)
                .map(|at| u64::from(at) + 1)
        };
        let vertex = u64::from(*corner) + 1;
        match (index(Kind::Texture), index(Kind::Normal)) {
            (None, None) => append(out, format_args!(" {vertex}")),
            (Some(texture), None) => append(out, format_args!(" {vertex}/{texture}")),
            (None, Some(normal)) => append(out, format_args!(" {vertex}//{normal}")),
            (Some(texture), Some(normal)) => {
                append(out, format_args!(" {vertex}/{texture}/{normal}"));
            }
        }
    }
    out.push('\n');
}

/// Materials for [`obj`] and [`labelled_obj`], as MTL text: a name and a diffuse sRGB colour each.
///
/// ```
/// use coseg_geometry::mesh::write::{LabelStyle, mtl};
///
/// let leg = LabelStyle { name: "leg".into(), colour: [255, 0, 0] };
/// assert_eq!(mtl(&[(7, leg)].into()), "newmtl leg\nKd 1.0000 0.0000 0.0000\n");
/// ```
pub fn mtl(styles: &BTreeMap<i32, LabelStyle>) -> String {
    let named = unique_names(styles.iter().map(|(&l, s)| (l, s.clone())), spelled);
    let mut out = String::new();
    for (label, name) in named {
        out.push_str(&mtl_entry(&name, styles[&label].colour));
    }
    out
}

/// A material of MTL text: a name without white space, and a diffuse sRGB colour.
///
/// ```
/// let entry = coseg_geometry::mesh::write::mtl_entry("oak", [255, 0, 0]);
/// assert_eq!(entry, "newmtl oak\nKd 1.0000 0.0000 0.0000\n");
/// ```
pub fn mtl_entry(name: &str, colour: [u8; 3]) -> String {
    let [r, g, b] = colour.map(|c| f64::from(c) / 255.0);
    format!("newmtl {name}\nKd {r:.4} {g:.4} {b:.4}\n")
}

/// What statements before an element set for it; as in the file, empty where nothing is set.
#[derive(Debug, Clone, Default, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct State {
    object: Vec<u8>,
    group: Vec<u8>,
    pub(super) material: Vec<u8>,
    smoothing: Vec<u8>,
}

/// The statements of a file, sorted by what becomes of them.
#[derive(Default)]
pub(super) struct Statements {
    /// All that is neither an element nor the state of one, in order.
    pub(super) kept: Vec<u8>,
    /// Faces, and lines and points, each with the index of its state.
    pub(super) faces: Vec<(Vec<u8>, u32)>,
    others: Vec<(Vec<u8>, u32)>,
    states: BTreeMap<State, u32>,
    state: State,
    /// Positions, texture coordinates and normals so far.
    counts: [i64; 3],
}

impl Statements {
    pub(super) fn of(bytes: &[u8]) -> Result<Self, ParseError> {
        let mut found = Self::default();
        reader::statements(bytes, |statement, whole, _| {
            found.push(statement, whole);
            Ok(())
        })?;
        Ok(found)
    }

    fn push(&mut self, statement: &[u8], whole: &[u8]) {
        let keyword = words(statement).next().unwrap_or_default();
        let rest = || {
            let text = statement.trim_ascii();
            text[keyword.len()..].trim_ascii().to_vec()
        };
        match keyword {
            b"f" | b"fo" | b"l" | b"p" => {
                let n = self.states.len() as u32;
                let state = *self.states.entry(self.state.clone()).or_insert(n);
                let is_face = keyword.starts_with(b"f");
                let keyword = if is_face { b"f" } else { keyword };
                let element = (self.element(keyword, statement), state);
                if is_face {
                    &mut self.faces
                } else {
                    &mut self.others
                }
                .push(element);
            }
            b"o" => self.state.object = rest(),
            b"g" => self.state.group = rest(),
            b"usemtl" => self.state.material = rest(),
            b"s" => self.state.smoothing = rest(),
            _ => {
                let kind = [b"v".as_slice(), b"vt", b"vn"];
                if let Some(kind) = kind.iter().position(|k| *k == keyword) {
                    self.counts[kind] += 1;
                }
                let whole = whole.trim_ascii_end();
                // The comments of an earlier export are about its groups.
                if !whole.is_empty() && !OWN_COMMENTS.iter().any(|own| whole.starts_with(own)) {
                    self.kept.extend_from_slice(whole);
                    self.kept.push(b'\n');
                }
            }
        }
    }

    pub(super) fn objects(&self) -> Objects<'_> {
        let mut states: Vec<&State> = vec![&self.state; self.states.len()];
        for (state, &index) in &self.states {
            states[index as usize] = state;
        }
        let are_named = states.iter().any(|state| !state.object.is_empty());
        let (mut names, mut known) = (Vec::new(), BTreeMap::new());
        let mut object = |element: &(Vec<u8>, u32)| {
            let state = states[element.1 as usize];
            let name = if are_named {
                &state.object
            } else {
                &state.group
            };
            *known.entry(name).or_insert_with(|| {
                names.push(name.clone());
                names.len() as u32 - 1
            })
        };
        let of_faces = self.faces.iter().map(&mut object).collect();
        let of_others = self.others.iter().map(&mut object).collect();
        Objects {
            are_named,
            names,
            of_faces,
            of_others,
            states,
        }
    }

    /// Faces by object, part instance and second group, and by what else has to be set for them.
    fn order(&self, objects: &Objects<'_>, found: &Instances) -> Vec<u32> {
        let mut order: Vec<u32> = (0..self.faces.len() as u32).collect();
        order.sort_by_key(|&face| {
            let i = face as usize;
            let state = objects.states[self.faces[i].1 as usize];
            let group = objects.are_named.then_some(&state.group);
            let place = (objects.of_faces[i], found.of_polygon[i], group);
            (place, &state.material, &state.smoothing, face)
        });
        order
    }

    /// An element with indices that count from the first of their kind, since it changes its place.
    fn element(&self, keyword: &[u8], statement: &[u8]) -> Vec<u8> {
        let mut out = keyword.to_vec();
        for word in words(statement).skip(1) {
            out.push(b' ');
            for (kind, index) in word.split(|&b| b == b'/').enumerate() {
                if kind > 0 {
                    out.push(b'/');
                }
                let relative = std::str::from_utf8(index).ok();
                let relative = relative
                    .and_then(|i| i.parse::<i64>().ok())
                    .filter(|i| *i < 0);
                match relative.zip(self.counts.get(kind)) {
                    Some((relative, count)) => {
                        out.extend_from_slice((count + 1 + relative).to_string().as_bytes());
                    }
                    None => out.extend_from_slice(index),
                }
            }
        }
        out
    }
}

/// An OBJ file with its faces in one group for each part instance, and everything else as it is:
/// texture coordinates, normals, colours, comments, materials, smoothing groups. The file's objects
/// stay, and bound part instances; without objects its groups take their place, and beside objects
/// they are second names of the groups. Faces without a material, or all for
/// [`Materials::Labels`], have that of their label from `material_file`.
///
/// ```
/// use coseg_geometry::mesh::write::{self, Labelling, Materials};
///
/// let file = b"o box\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl wood\nf 1/1 2/1 -1/-1\n";
/// let styles = Default::default();
/// let labelling = Labelling { labels: &[2], confidence: None, styles: &styles };
/// let found = write::labelled_obj(file, &labelling, Materials::Own, "labels.mtl")?;
/// let text = String::from_utf8_lossy(&found);
/// assert!(text.contains("vt 0 0\no box\ng label_2.001\n"));
/// assert!(text.ends_with("usemtl wood\nf 1/1 2/1 3/1\n"));
/// # Ok::<_, coseg_geometry::mesh::ParseError>(())
/// ```
///
/// # Errors
/// If the file cannot be read.
///
/// # Panics
/// If there is not one label per face.
pub fn labelled_obj(
    bytes: &[u8],
    labelling: &Labelling<'_>,
    materials: Materials,
    material_file: &str,
) -> Result<Vec<u8>, ParseError> {
    let bytes = as_utf8(bytes);
    let mesh = parse(&bytes, Format::Obj)?;
    let statements = Statements::of(&bytes)?;
    let objects = statements.objects();
    let found = instances(
        &mesh.vertices,
        &mesh.polygons(),
        labelling.labels,
        &objects.of_faces,
    );
    let mut writer = Writer {
        out: format!("mtllib {material_file}\n").into_bytes(),
        groups: group_names(labelling, &found),
        label_materials: labelling.names(spelled),
        materials,
        set: State::default(),
    };
    writer.out.extend_from_slice(&statements.kept);
    let faces = statements.order(&objects, &found);
    let mut others: Vec<usize> = (0..objects.of_others.len()).collect();
    others.sort_by_key(|&i| objects.of_others[i]);
    let (mut faces, mut others) = (faces.as_slice(), others.as_slice());
    for (object, name) in (0u32..).zip(&objects.names) {
        let of_object;
        let end = faces.partition_point(|&f| objects.of_faces[f as usize] <= object);
        (of_object, faces) = faces.split_at(end);
        let unlabelled;
        let end = others.partition_point(|&i| objects.of_others[i] <= object);
        (unlabelled, others) = others.split_at(end);
        writer.object(name, objects.are_named || !name.is_empty());
        let group = |face: u32| {
            let state = objects.states[statements.faces[face as usize].1 as usize];
            let more = objects.are_named.then_some(state.group.as_slice());
            (found.of_polygon[face as usize], more.unwrap_or_default())
        };
        for members in of_object.chunk_by(|a, b| group(*a) == group(*b)) {
            let (instance, more) = group(members[0]);
            let label = found.labels[instance as usize];
            writer.group(instance, label, more, members);
            for &face in members {
                let (element, state) = &statements.faces[face as usize];
                writer.state(Some(label), objects.states[*state as usize]);
                writer.line(element);
            }
        }
        for &i in unlabelled {
            let (element, state) = &statements.others[i];
            writer.state(None, objects.states[*state as usize]);
            writer.line(element);
        }
    }
    Ok(writer.out)
}

/// The objects of a file, in the order of their first elements.
pub(super) struct Objects<'a> {
    /// Whether the file has objects of its own; otherwise its groups are objects.
    are_named: bool,
    pub(super) names: Vec<Vec<u8>>,
    pub(super) of_faces: Vec<u32>,
    of_others: Vec<u32>,
    /// States by index.
    pub(super) states: Vec<&'a State>,
}

struct Writer {
    out: Vec<u8>,
    groups: Vec<String>,
    label_materials: BTreeMap<i32, String>,
    materials: Materials,
    /// What was written last of a material and a smoothing group.
    set: State,
}

impl Writer {
    fn line(&mut self, text: &[u8]) {
        self.out.extend_from_slice(text);
        self.out.push(b'\n');
    }

    fn statement(&mut self, keyword: &str, argument: &[u8]) {
        self.line(&[keyword.as_bytes(), argument].join(&b' '));
    }

    fn object(&mut self, name: &[u8], is_named: bool) {
        if is_named {
            self.statement("o", name);
        }
    }

    fn group(&mut self, instance: u32, label: i32, more: &[u8], members: &[u32]) {
        let mut name = self.groups[instance as usize].clone().into_bytes();
        if !more.is_empty() {
            name.push(b' ');
            name.extend_from_slice(more);
        }
        self.statement("g", &name);
        let mut text = String::new();
        comments(&mut text, label, members);
        self.out.extend_from_slice(text.as_bytes());
    }

    /// Sets what an element needs and is not set. Lines and points have no label.
    fn state(&mut self, label: Option<i32>, state: &State) {
        let of_label = label.map(|label| self.label_materials[&label].clone().into_bytes());
        let own = Some(state.material.clone()).filter(|m| !m.is_empty());
        let material = match self.materials {
            Materials::Own => own.or(of_label),
            Materials::Labels => of_label.or(own),
        };
        if let Some(material) = material.filter(|m| *m != self.set.material) {
            self.statement("usemtl", &material);
            self.set.material = material;
        }
        if state.smoothing != self.set.smoothing {
            let off = b"off".to_vec();
            let smoothing = Some(state.smoothing.clone()).filter(|s| !s.is_empty());
            self.statement("s", &smoothing.unwrap_or(off));
            self.set.smoothing.clone_from(&state.smoothing);
        }
    }
}

#[cfg(test)]
mod tests;
