//! Writes labelled polygons as a binary glTF 2.0 file: a primitive and a named material for each
//! label.
//!
//! All primitives share one list of positions. Triangles are grouped by label; each primitive lists
//! its polygons of the input in its `extras`, as first and count of each run of consecutive ones.
//! The triangles of a polygon are those of [`Triangulator`], on which its label was computed.

use super::{append, by_label, runs};
use crate::mesh::Triangulator;
use std::fmt::Write as _;

/// Sizes beyond which single precision would overflow or lose digits.
const MIN_SIZE: f64 = 1e-30;
const MAX_SIZE: f64 = 1e30;

/// Positions in single precision, and their inverse transform: a translation and a factor.
struct Placed {
    positions: Vec<[f32; 3]>,
    translation: [f64; 3],
    factor: f64,
}

/// Moves a mesh whose coordinates are not exact in single precision to the origin, where most
/// digits survive. Positions that are not finite, which no polygon uses, become 0.
fn place(vertices: &[[f64; 3]]) -> Placed {
    let finite = || vertices.iter().filter(|v| v.iter().all(|x| x.is_finite()));
    let exact = finite().flatten().all(|&x| f64::from(x as f32) == x);
    let (mut translation, mut factor) = ([0.0; 3], 1.0);
    if !exact {
        let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for v in finite() {
            low = std::array::from_fn(|i| low[i].min(v[i]));
            high = std::array::from_fn(|i| high[i].max(v[i]));
        }
        translation = std::array::from_fn(|i| low[i] + 0.5 * (high[i] - low[i]));
        let size = (0..3).fold(0.0, |s: f64, i| s.max(high[i] - low[i]));
        if size > 0.0 && !(MIN_SIZE..=MAX_SIZE).contains(&size) {
            factor = size;
        }
    }
    let position = |v: &[f64; 3]| -> [f32; 3] {
        let p: [f32; 3] = std::array::from_fn(|i| ((v[i] - translation[i]) / factor) as f32);
        if p.iter().all(|x| x.is_finite()) {
            p
        } else {
            [0.0; 3]
        }
    };
    Placed {
        positions: vertices.iter().map(position).collect(),
        translation,
        factor,
    }
}

/// Text as a JSON string.
fn quoted(text: &str) -> String {
    let mut out = String::from("\"");
    for c in text.chars() {
        match c {
            '"' | '\\' => out.extend(['\\', c]),
            c if c.is_control() => append(&mut out, format_args!("\\u{:04x}", c as u32)),
            c => out.push(c),
        }
    }
    out.push('"');
    out
}

/// An sRGB component as linear light, which glTF requires.
fn linear(c: u8) -> f64 {
    let x = f64::from(c) / 255.0;
    if x <= 0.04045 {
        x / 12.92
    } else {
        ((x + 0.055) / 1.055).powf(2.4)
    }
}

/// The rotation from a coordinate axis to +Y, which is up in glTF, as x, y, z, w.
fn upright(up: [f64; 3]) -> [f64; 4] {
    use std::f64::consts::FRAC_1_SQRT_2 as H;
    match up.map(|x| x as i8) {
        [1, 0, 0] => [0.0, 0.0, H, H],
        [-1, 0, 0] => [0.0, 0.0, -H, H],
        [0, -1, 0] => [1.0, 0.0, 0.0, 0.0],
        [0, 0, 1] => [-H, 0.0, 0.0, H],
        [0, 0, -1] => [H, 0.0, 0.0, H],
        _ => [0.0, 0.0, 0.0, 1.0],
    }
}

/// A binary glTF file of one mesh, called `name`. `material` returns the name and sRGB colour of a
/// label. If the coordinate axis `up` is not +Y, a node around the mesh turns it there.
///
/// ```
/// use coseg_geometry::mesh::{Format, icosphere, parse, write};
///
/// let sphere = icosphere(1);
/// let labels = vec![0; sphere.faces.len()];
/// let material = |label| (format!("part-{label}"), [200, 80, 40]);
/// let file = write::glb("ball", &sphere.vertices, &sphere.faces, &labels, None, material);
/// assert_eq!(parse(&file, Format::Gltf)?.n_polygons, sphere.faces.len());
/// # Ok::<_, coseg_geometry::mesh::ParseError>(())
/// ```
///
/// # Panics
/// If there is not one label per polygon, or a polygon has no corners.
pub fn glb<P: AsRef<[u32]>>(
    name: &str,
    vertices: &[[f64; 3]],
    polygons: &[P],
    labels: &[i32],
    up: Option<[f64; 3]>,
    material: impl Fn(i32) -> (String, [u8; 3]),
) -> Vec<u8> {
    assert_eq!(polygons.len(), labels.len(), "one label per polygon");
    let placed = place(vertices);
    let mut binary: Vec<u8> = Vec::with_capacity(12 * (vertices.len() + 2 * polygons.len()));
    let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
    for p in &placed.positions {
        low = std::array::from_fn(|i| low[i].min(p[i]));
        high = std::array::from_fn(|i| high[i].max(p[i]));
        binary.extend(p.iter().flat_map(|x| x.to_le_bytes()));
    }
    let triple = |t: [f64; 3]| format!("[{:?},{:?},{:?}]", t[0], t[1], t[2]);
    let mut views = format!(
        "{{\"buffer\":0,\"byteLength\":{},\"target\":34962}}",
        binary.len()
    );
    let mut accessors = format!(
        "{{\"bufferView\":0,\"componentType\":5126,\"count\":{},\"type\":\"VEC3\",\
         \"min\":{},\"max\":{}}}",
        vertices.len(),
        triple(low.map(f64::from)),
        triple(high.map(f64::from)),
    );
    let (mut primitives, mut materials) = (String::new(), String::new());
    let mut triangulator = Triangulator::default();
    for (i, (label, members)) in by_label(labels).into_iter().enumerate() {
        let start = binary.len();
        for &polygon in &members {
            let corners = polygons[polygon as usize].as_ref();
            triangulator.triangulate(vertices, corners, |triangle| {
                binary.extend(triangle.iter().flat_map(|v| v.to_le_bytes()));
            });
        }
        let n_bytes = binary.len() - start;
        append(
            &mut views,
            format_args!(
                ",{{\"buffer\":0,\"byteOffset\":{start},\"byteLength\":{n_bytes},\"target\":34963}}"
            ),
        );
        append(
            &mut accessors,
            format_args!(
                ",{{\"bufferView\":{},\"componentType\":5125,\"count\":{},\"type\":\"SCALAR\"}}",
                i + 1,
                n_bytes / 4
            ),
        );
        let comma = if i > 0 { "," } else { "" };
        let mut runs_text = String::new();
        for (first, count) in runs(&members) {
            let comma = if runs_text.is_empty() { "" } else { "," };
            append(&mut runs_text, format_args!("{comma}{first},{count}"));
        }
        append(
            &mut primitives,
            format_args!(
                "{comma}{{\"attributes\":{{\"POSITION\":0}},\"indices\":{},\"material\":{i},\
                 \"extras\":{{\"label\":{label},\"polygons\":[{runs_text}]}}}}",
                i + 1
            ),
        );
        let (name, colour) = material(label);
        let [r, g, b] = colour.map(linear);
        append(
            &mut materials,
            format_args!(
                "{comma}{{\"name\":{},\"doubleSided\":true,\
                 \"pbrMetallicRoughness\":{{\"baseColorFactor\":\
                 [{r:.6},{g:.6},{b:.6},1.0],\"metallicFactor\":0.0,\"roughnessFactor\":0.8}}}}",
                quoted(&name)
            ),
        );
    }
    let mut node = format!("{{\"name\":{},\"mesh\":0", quoted(name));
    if placed.translation != [0.0; 3] {
        append(
            &mut node,
            format_args!(",\"translation\":{}", triple(placed.translation)),
        );
    }
    if placed.factor != 1.0 {
        append(
            &mut node,
            format_args!(",\"scale\":{}", triple([placed.factor; 3])),
        );
    }
    node.push('}');
    if let Some(up) = up.filter(|up| *up != [0.0, 1.0, 0.0]) {
        let [x, y, z, w] = upright(up);
        let name = quoted(&format!("{name} upright"));
        node = format!(
            "{{\"name\":{name},\"rotation\":[{x:?},{y:?},{z:?},{w:?}],\"children\":[1]}},{node}"
        );
    }
    let mut json = String::new();
    let _ = write!(
        json,
        "{{\"asset\":{{\"version\":\"2.0\",\"generator\":\"coseg\"}},\
         \"scene\":0,\"scenes\":[{{\"nodes\":[0]}}],\
         \"nodes\":[{node}],\"meshes\":[{{\"name\":{},\"primitives\":[{primitives}]}}],\
         \"materials\":[{materials}],\"accessors\":[{accessors}],\"bufferViews\":[{views}],\
         \"buffers\":[{{\"byteLength\":{}}}]}}",
        quoted(name),
        binary.len(),
    );
    glb_of(json, binary)
}

/// A file of a JSON and a binary chunk, each padded to four bytes.
///
/// ```
/// let json = "{\"asset\":{\"version\":\"2.0\"}}".to_string();
/// let file = coseg_geometry::mesh::write::glb_of(json, vec![1, 2, 3]);
/// assert!(file.starts_with(b"glTF"));
/// // The header says how long the file is.
/// assert_eq!(file[8..12], (file.len() as u32).to_le_bytes());
/// ```
pub fn glb_of(mut json: String, mut binary: Vec<u8>) -> Vec<u8> {
    binary.resize(binary.len().next_multiple_of(4), 0);
    while !json.len().is_multiple_of(4) {
        json.push(' ');
    }
    let length = 12 + 8 + json.len() + 8 + binary.len();
    let mut out = Vec::with_capacity(length);
    out.extend_from_slice(b"glTF");
    for word in [2, length, json.len()] {
        out.extend_from_slice(&(word as u32).to_le_bytes());
    }
    out.extend_from_slice(b"JSON");
    out.extend_from_slice(json.as_bytes());
    out.extend_from_slice(&(binary.len() as u32).to_le_bytes());
    out.extend_from_slice(b"BIN\0");
    out.extend_from_slice(&binary);
    out
}

#[cfg(test)]
mod tests {
    use super::glb;
    use crate::mesh::{Format, cross, dot, parse};

    fn material(label: i32) -> (String, [u8; 3]) {
        (format!("label \"{label}\""), [255, 128, 0])
    }

    #[test]
    fn our_own_reader_finds_the_triangles_by_label_and_the_runs_say_which_they_are() {
        let vertices = [[0.0; 3], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.5]];
        let polygons = [
            vec![0, 1, 2, 3],
            vec![0, 1, 2],
            vec![1, 2, 3],
            vec![3, 2, 1],
        ];
        let bytes = glb("a", &vertices, &polygons, &[7, -1, 7, 7], None, material);
        assert_eq!(bytes.len() % 4, 0);
        let mesh = parse(&bytes, Format::Gltf).unwrap();
        assert_eq!(mesh.vertices, vertices);
        let expected = [[0, 1, 2], [0, 1, 2], [0, 2, 3], [1, 2, 3], [3, 2, 1]];
        assert_eq!(mesh.triangles, expected);
        let text = String::from_utf8_lossy(&bytes).into_owned();
        assert!(text.contains("{\"label\":-1,\"polygons\":[1,1]}"), "{text}");
        assert!(
            text.contains("{\"label\":7,\"polygons\":[0,1,2,2]}"),
            "{text}"
        );
        assert!(text.contains("\"name\":\"label \\\"7\\\"\""), "{text}");
    }

    #[test]
    fn whatever_axis_is_up_becomes_the_second() {
        for k in 0..3 {
            for sign in [1.0, -1.0] {
                let mut up = [0.0; 3];
                up[k] = sign;
                // The axis itself, and a triangle that distinguishes turning from mirroring.
                let vertices = [up, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
                let bytes = glb("a", &vertices, &[[1, 2, 3]], &[0], Some(up), material);
                let found = parse(&bytes, Format::Gltf).unwrap().vertices;
                let close = |a: f64, b: f64| (a - b).abs() < 1e-12;
                assert!(close(found[0][1], 1.0), "{up:?}: {:?}", found[0]);
                let [a, b, c] = [1, 2, 3].map(|v| found[v]);
                assert!(close(dot(a, cross(b, c)), 1.0), "{up:?} is mirrored");
                let has_node = String::from_utf8_lossy(&bytes).contains("\"rotation\"");
                assert_eq!(has_node, up != [0.0, 1.0, 0.0]);
            }
        }
    }

    #[test]
    fn digits_survive_far_from_the_origin_and_at_absurd_sizes() {
        for (offset, size) in [(500_000.125, 0.001), (0.0, 1e100), (1e-90, 1e-100)] {
            let at = |x: f64, y: f64| [offset + x * size, offset + y * size, offset];
            let vertices = [at(0.1, 0.2), at(1.3, 0.0), at(0.7, 1.1), [f64::NAN; 3]];
            let bytes = glb("a", &vertices, &[[0, 1, 2]], &[0], None, material);
            let mesh = parse(&bytes, Format::Gltf).unwrap();
            for (found, wanted) in mesh.vertices.iter().zip(&vertices).take(3) {
                for i in 0..3 {
                    assert!(
                        (found[i] - wanted[i]).abs() <= 1e-6 * size,
                        "{found:?} {wanted:?}"
                    );
                }
            }
        }
    }
}
