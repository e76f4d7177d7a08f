//! Writes labelled polygons as a text file of Universal Scene Description: a mesh with a
//! `GeomSubset` and a material for each label.

use super::glb::linear;
use super::labelling::by_label;
use super::{LabelStyle, Labelling, append};
use crate::mesh::{Instances, instances};
use std::collections::{BTreeMap, BTreeSet};

/// The family of subsets that hold labels.
const PARTS: &str = "coseg:parts";

/// A name in the syntax of USD: letters, digits and underscores, no digit first.
fn identifier(name: &str) -> String {
    let valid = |c: char| if c.is_ascii_alphanumeric() { c } else { '_' };
    let mut out: String = name.chars().map(valid).collect();
    if !out.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_') {
        out.insert(0, '_');
    }
    out
}

fn list<T: std::fmt::Display>(out: &mut String, values: impl IntoIterator<Item = T>) {
    let mut first = true;
    out.push('[');
    for value in values {
        let comma = if std::mem::replace(&mut first, false) {
            ""
        } else {
            ", "
        };
        append(out, format_args!("{comma}{value}"));
    }
    out.push(']');
}

/// The up axis of a stage, and the rotation of its root for a mesh with another axis: USD has Y and
/// Z only.
fn upright(up: Option<[f64; 3]>) -> (&'static str, &'static str) {
    const Y: &str = "    upAxis = \"Y\"\n";
    match up.map(|up| up.map(|x| x as i8)) {
        None => ("", ""),
        Some([0, 0, 1]) => ("    upAxis = \"Z\"\n", ""),
        Some([1, 0, 0]) => (Y, "rotateZ = 90"),
        Some([-1, 0, 0]) => (Y, "rotateZ = -90"),
        Some([0, -1, 0]) => (Y, "rotateX = 180"),
        Some([0, 0, -1]) => (Y, "rotateX = 90"),
        Some(_) => (Y, ""),
    }
}

/// Writes a `.usda` file of one mesh, called `name` as far as USD allows. Faces keep their order.
/// As primvars of faces it has `coseg:label`, `coseg:instance` (the number of the part among those
/// of its label, from 1) and, where it is known, `coseg:confidence`. Its subsets are those of a
/// family `coseg:parts`, one for each label with `coseg:label` and `coseg:name` (with
/// `each_instance` one for each part instance, with `coseg:instance`), and of a family
/// `materialBind`, one for each label's material. The stage has the coordinate axis `up`, if it is
/// known, and interprets a unit as a metre, like glTF.
///
/// ```
/// use coseg_geometry::mesh::icosphere;
/// use coseg_geometry::mesh::write::{self, Labelling};
///
/// let sphere = icosphere(0);
/// let (labels, styles) = (vec![3; sphere.faces.len()], Default::default());
/// let labelling = Labelling { labels: &labels, confidence: None, styles: &styles };
/// let text = write::usda("ball", &sphere.vertices, &sphere.faces, &labelling, None, false);
/// assert!(text.starts_with("#usda 1.0"));
/// assert!(text.contains("def Xform \"ball\""));
/// ```
///
/// # Panics
/// If there is not one label per polygon.
pub fn usda<P: AsRef<[u32]>>(
    name: &str,
    vertices: &[[f64; 3]],
    polygons: &[P],
    labelling: &Labelling<'_>,
    up: Option<[f64; 3]>,
    each_instance: bool,
) -> String {
    let root = identifier(name);
    let (up_axis, turn) = upright(up);
    let mut out = format!(
        "#usda 1.0\n(\n    defaultPrim = \"{root}\"\n    metersPerUnit = 1\n{up_axis})\n\n\
         def Xform \"{root}\"\n{{\n"
    );
    if let Some((operation, _)) = turn.split_once(' ') {
        append(
            &mut out,
            format_args!(
                "    double xformOp:{turn}\n    \
                 uniform token[] xformOpOrder = [\"xformOp:{operation}\"]\n\n"
            ),
        );
    }
    out.push_str("    def Mesh \"mesh\"\n    {\n");
    surface(&mut out, vertices, polygons);
    let objects = vec![0; polygons.len()];
    let found = instances(vertices, polygons, labelling.labels, &objects);
    let instance = found.of_polygon.iter().map(|&i| found.numbers[i as usize]);
    primvar(&mut out, "int[]", "label", labelling.labels);
    primvar(&mut out, "int[]", "instance", instance);
    if let Some(confidence) = labelling.confidence {
        primvar(&mut out, "float[]", "confidence", confidence);
    }
    out.push_str(
        "        uniform token subdivisionScheme = \"none\"\n        \
         uniform token subsetFamily:coseg:parts:familyType = \"partition\"\n        \
         uniform token subsetFamily:materialBind:familyType = \"partition\"\n",
    );
    let materials = subsets(&mut out, &root, labelling, &found, each_instance);
    append(
        &mut out,
        format_args!("    }}\n\n    def Scope \"Materials\"\n    {{{materials}    }}\n}}\n"),
    );
    out
}

/// Writes the subsets of both families, and returns the materials that one of them binds.
fn subsets(
    out: &mut String,
    root: &str,
    labelling: &Labelling<'_>,
    found: &Instances,
    each_instance: bool,
) -> String {
    let mut materials = String::new();
    let names = labelling.names(identifier);
    let mut taken: BTreeSet<String> = names.values().cloned().collect();
    let mut free = |mut name: String| {
        while !taken.insert(name.clone()) {
            name.push('_');
        }
        name
    };
    let members = by_label(labelling.labels);
    for (label, members) in &members {
        let LabelStyle {
            name: shown,
            colour,
        } = labelling.style(*label);
        let name = &names[label];
        let about = format!(
            "            custom int coseg:label = {label}\n            \
             custom string coseg:name = {}\n",
            quoted(&shown)
        );
        materials.push_str(&material(root, name, colour));
        if !each_instance {
            subset(out, name, PARTS, members, ("", &about));
            continue;
        }
        let mut pieces: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
        for &face in members {
            let number = found.numbers[found.of_polygon[face as usize] as usize];
            pieces.entry(number).or_default().push(face);
        }
        for (number, faces) in pieces {
            let name = free(format!("{name}_{number:03}"));
            let about = format!("{about}            custom int coseg:instance = {number}\n");
            subset(out, &name, PARTS, &faces, ("", &about));
        }
    }
    // A subset is of one family, so each label has a second one to bind its material.
    for (label, members) in &members {
        let name = &names[label];
        let binding = format!("            rel material:binding = </{root}/Materials/{name}>\n");
        let api = " (\n            prepend apiSchemas = [\"MaterialBindingAPI\"]\n        )";
        let bound = free(format!("{name}_material"));
        subset(out, &bound, "materialBind", members, (api, &binding));
    }
    materials
}

/// The material of a label; colours of materials are linear.
fn material(root: &str, name: &str, colour: [u8; 3]) -> String {
    let [r, g, b] = colour.map(linear);
    format!(
        "\n        def Material \"{name}\"\n        {{\n            \
         token outputs:surface.connect = \
         </{root}/Materials/{name}/Surface.outputs:surface>\n\n            \
         def Shader \"Surface\"\n            {{\n                \
         uniform token info:id = \"UsdPreviewSurface\"\n                \
         color3f inputs:diffuseColor = ({r:.4}, {g:.4}, {b:.4})\n                \
         token outputs:surface\n            }}\n        }}\n"
    )
}

/// Points, faces and extent of a mesh.
fn surface<P: AsRef<[u32]>>(out: &mut String, vertices: &[[f64; 3]], polygons: &[P]) {
    let number = |x: f64| if x.is_finite() { x } else { 0.0 };
    let point = |v: &[f64; 3]| {
        let [x, y, z] = v.map(number);
        format!("({x:?}, {y:?}, {z:?})")
    };
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for v in vertices {
        low = std::array::from_fn(|i| low[i].min(number(v[i])));
        high = std::array::from_fn(|i| high[i].max(number(v[i])));
    }
    let counts = polygons.iter().map(|p| p.as_ref().len());
    let corners = polygons.iter().flat_map(|p| p.as_ref());
    out.push_str("        float3[] extent = ");
    list(out, [point(&low), point(&high)]);
    out.push_str("\n        int[] faceVertexCounts = ");
    list(out, counts);
    out.push_str("\n        int[] faceVertexIndices = ");
    list(out, corners);
    out.push_str("\n        point3f[] points = ");
    list(out, vertices.iter().map(point));
    out.push('\n');
}

/// A value for each face.
fn primvar<T: std::fmt::Display>(
    out: &mut String,
    kind: &str,
    name: &str,
    values: impl IntoIterator<Item = T>,
) {
    append(out, format_args!("        {kind} primvars:coseg:{name} = "));
    list(out, values);
    out.push_str(" (\n            interpolation = \"uniform\"\n        )\n");
}

/// A subset of faces, with its API schemas `api` and its further properties `more`.
fn subset(out: &mut String, name: &str, family: &str, faces: &[u32], (api, more): (&str, &str)) {
    append(
        out,
        format_args!(
            "\n        def GeomSubset \"{name}\"{api}\n        {{\n            \
             uniform token elementType = \"face\"\n            \
             uniform token familyName = \"{family}\"\n            int[] indices = "
        ),
    );
    list(out, faces);
    append(out, format_args!("\n{more}        }}\n"));
}

/// Text as a string of USD.
fn quoted(text: &str) -> String {
    let mut out = String::from("\"");
    for c in text.chars() {
        match c {
            '"' | '\\' => out.extend(['\\', c]),
            '\n' => out.push_str("\\n"),
            c if c.is_control() => out.push(' '),
            c => out.push(c),
        }
    }
    out.push('"');
    out
}

#[cfg(test)]
mod tests {
    use super::super::{LabelStyle, Labelling};
    use super::usda;

    #[test]
    fn each_part_instance_has_a_subset_on_request() {
        let vertices: Vec<[f64; 3]> = (0..10)
            .map(|i| [f64::from(i % 3), f64::from(i * i), 0.0])
            .collect();
        let polygons = [[0, 1, 2], [3, 4, 5], [1, 2, 6], [7, 8, 9]];
        let named = |name: &str| LabelStyle {
            name: name.to_owned(),
            colour: [0; 3],
        };
        let styles = [(2, named("leg")), (3, named("leg_001"))].into();
        let labelling = Labelling {
            labels: &[2, 2, 2, 3],
            confidence: None,
            styles: &styles,
        };
        let text = usda("a", &vertices, &polygons, &labelling, None, true);
        for part in [
            "def GeomSubset \"leg_001_\"",
            "def GeomSubset \"leg_002\"",
            "def GeomSubset \"leg_001_001\"",
            "def GeomSubset \"leg_material\" (",
            "            int[] indices = [0, 2]\n            \
             custom int coseg:label = 2\n            \
             custom string coseg:name = \"leg\"\n            custom int coseg:instance = 1\n",
            "            int[] indices = [0, 1, 2]\n            rel material:binding",
        ] {
            assert!(text.contains(part), "{part:?} in\n{text}");
        }
        let family = "familyName = \"coseg:parts\"";
        assert_eq!(text.matches(family).count(), 3);
    }

    #[test]
    fn faces_keep_their_order_and_each_label_has_a_subset() {
        let vertices = [[0.0; 3], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 1e-7]];
        let polygons = [vec![0, 1, 2, 3], vec![0, 1, 2], vec![1, 2, 3]];
        let part = LabelStyle {
            name: "big \"part\"".to_owned(),
            colour: [255, 0, 51],
        };
        let styles = [(2, part)].into();
        let labelling = Labelling {
            labels: &[2, -1, 2],
            confidence: Some(&[0.5, 1.0, 0.25]),
            styles: &styles,
        };
        let text = usda("7 chair", &vertices, &polygons, &labelling, None, false);
        for line in [
            "    defaultPrim = \"_7_chair\"",
            "        int[] faceVertexCounts = [4, 3, 3]",
            "        int[] faceVertexIndices = [0, 1, 2, 3, 0, 1, 2, 1, 2, 3]",
            "        int[] primvars:coseg:label = [2, -1, 2] (",
            "        int[] primvars:coseg:instance = [1, 1, 1] (",
            "        float[] primvars:coseg:confidence = [0.5, 1, 0.25] (",
            "        def GeomSubset \"big__part_\"",
            "            custom string coseg:name = \"big \\\"part\\\"\"",
            "        def GeomSubset \"unlabelled\"",
            "            int[] indices = [0, 2]",
            "        def GeomSubset \"big__part__material\" (",
            "            rel material:binding = </_7_chair/Materials/big__part_>",
            "                color3f inputs:diffuseColor = (1.0000, 0.0000, 0.0331)",
        ] {
            assert!(text.lines().any(|l| l == line), "{line:?} in\n{text}");
        }
        assert_eq!(text.matches('{').count(), text.matches('}').count());
        assert!(
            !text.contains("upAxis") && !text.contains("xformOp"),
            "{text}"
        );
        for (up, lines) in [
            (
                [0.0, 1.0, 0.0],
                ["    upAxis = \"Y\"", "    metersPerUnit = 1"],
            ),
            (
                [0.0, 0.0, 1.0],
                ["    upAxis = \"Z\"", "    metersPerUnit = 1"],
            ),
            (
                [-1.0, 0.0, 0.0],
                ["    upAxis = \"Y\"", "    double xformOp:rotateZ = -90"],
            ),
        ] {
            let text = usda("a", &vertices, &polygons, &labelling, Some(up), false);
            for line in lines {
                assert!(text.lines().any(|l| l == line), "{line:?} in\n{text}");
            }
            assert_eq!(text.contains("xformOpOrder"), up[0] != 0.0);
        }
    }
}
