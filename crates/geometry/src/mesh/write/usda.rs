//! Writes labelled polygons as a text file of Universal Scene Description: a mesh with a
//! `GeomSubset` and a material for each label.

use super::{append, by_label};

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

/// Writes a `.usda` file of one mesh, called `name` as far as USD allows. `material` returns the
/// name and sRGB colour of a label. Faces keep their order; `primvars:label` has the label of each.
/// The stage has the coordinate axis `up`, if it is known, and interprets a unit as a metre, like
/// glTF.
///
/// ```
/// use coseg_geometry::mesh::{icosphere, write};
///
/// let sphere = icosphere(0);
/// let labels = vec![3; sphere.faces.len()];
/// let material = |label| (format!("part-{label}"), [200, 80, 40]);
/// let text = write::usda("ball", &sphere.vertices, &sphere.faces, &labels, None, material);
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
    labels: &[i32],
    up: Option<[f64; 3]>,
    material: impl Fn(i32) -> (String, [u8; 3]),
) -> String {
    assert_eq!(polygons.len(), labels.len(), "one label per polygon");
    let root = identifier(name);
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
    let (up_axis, turn) = upright(up);
    let mut out = format!(
        "#usda 1.0\n(\n    defaultPrim = \"{root}\"\n    metersPerUnit = 1\n{up_axis})\n\n\
         def Xform \"{root}\"\n{{\n"
    );
    if let Some((operation, _)) = turn.split_once(' ') {
        append(
            &mut out,
            format_args!(
                "    double xformOp:{turn}\n    uniform token[] xformOpOrder = \
                 [\"xformOp:{operation}\"]\n\n"
            ),
        );
    }
    out.push_str("    def Mesh \"mesh\"\n    {\n");
    let counts = polygons.iter().map(|p| p.as_ref().len());
    let corners = polygons.iter().flat_map(|p| p.as_ref());
    out.push_str("        float3[] extent = ");
    list(&mut out, [point(&low), point(&high)]);
    out.push_str("\n        int[] faceVertexCounts = ");
    list(&mut out, counts);
    out.push_str("\n        int[] faceVertexIndices = ");
    list(&mut out, corners);
    out.push_str("\n        point3f[] points = ");
    list(&mut out, vertices.iter().map(point));
    out.push_str("\n        int[] primvars:label = ");
    list(&mut out, labels);
    out.push_str(
        " (\n            interpolation = \"uniform\"\n        )\n        uniform token \
         subdivisionScheme = \"none\"\n        uniform token subsetFamily:materialBind:familyType \
         = \"partition\"\n",
    );
    let mut materials = String::new();
    for (label, members) in by_label(labels) {
        let (name, colour) = material(label);
        let name = identifier(&name);
        append(
            &mut out,
            format_args!(
                "\n        def GeomSubset \"{name}\" (\n            prepend apiSchemas = \
                 [\"MaterialBindingAPI\"]\n        )\n        {{\n            uniform token \
                 elementType = \"face\"\n            \
                 uniform token familyName = \"materialBind\"\n            int[] indices = "
            ),
        );
        list(&mut out, members);
        append(
            &mut out,
            format_args!(
                "\n            rel material:binding = </{root}/Materials/{name}>\n            \
                 custom int label = {label}\n        }}\n"
            ),
        );
        let [r, g, b] = colour.map(|c| f64::from(c) / 255.0);
        append(
            &mut materials,
            format_args!(
                "\n        def Material \"{name}\"\n        {{\n            \
                 token outputs:surface.connect = \
                 </{root}/Materials/{name}/Surface.outputs:surface>\n\n            \
                 def Shader \"Surface\"\n            {{\n                uniform token info:id \
                 = \"UsdPreviewSurface\"\n                \
                 color3f inputs:diffuseColor = ({r:.4}, {g:.4}, {b:.4})\n                \
                 token outputs:surface\n            }}\n        }}\n"
            ),
        );
    }
    append(
        &mut out,
        format_args!("    }}\n\n    def Scope \"Materials\"\n    {{{materials}    }}\n}}\n"),
    );
    out
}

#[cfg(test)]
mod tests {
    use super::usda;

    #[test]
    fn faces_keep_their_order_and_each_label_has_a_subset() {
        let vertices = [[0.0; 3], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 1e-7]];
        let polygons = [vec![0, 1, 2, 3], vec![0, 1, 2], vec![1, 2, 3]];
        let material = |label: i32| (format!("label {label}"), [255, 0, 51]);
        let text = usda("7 chair", &vertices, &polygons, &[2, -1, 2], None, material);
        for line in [
            "    defaultPrim = \"_7_chair\"",
            "        int[] faceVertexCounts = [4, 3, 3]",
            "        int[] faceVertexIndices = [0, 1, 2, 3, 0, 1, 2, 1, 2, 3]",
            "        int[] primvars:label = [2, -1, 2] (",
            "        def GeomSubset \"label_2\" (",
            "        def GeomSubset \"label__1\" (",
            "            int[] indices = [0, 2]",
            "            rel material:binding = </_7_chair/Materials/label_2>",
            "                color3f inputs:diffuseColor = (1.0000, 0.0000, 0.2000)",
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
            let text = usda("a", &vertices, &polygons, &[2, -1, 2], Some(up), material);
            for line in lines {
                assert!(text.lines().any(|l| l == line), "{line:?} in\n{text}");
            }
            assert_eq!(text.contains("xformOpOrder"), up[0] != 0.0);
        }
    }
}
