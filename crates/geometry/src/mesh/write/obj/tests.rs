use super::super::{LabelStyle, Labelling, Materials};
use super::{labelled_obj, mtl, obj};
use crate::mesh::{Format, parse};
use std::collections::BTreeMap;

fn styles() -> BTreeMap<i32, LabelStyle> {
    let named = |name: &str, colour| LabelStyle {
        name: name.to_owned(),
        colour,
    };
    [
        (4, named("long leg", [255, 0, 51])),
        (5, named("seat", [0; 3])),
    ]
    .into()
}

fn labelled(file: &str, labels: &[i32], materials: Materials) -> String {
    let styles = styles();
    let labelling = Labelling {
        labels,
        confidence: None,
        styles: &styles,
    };
    let out = labelled_obj(file.as_bytes(), &labelling, materials, "a.mtl").unwrap();
    String::from_utf8(out).unwrap()
}

/// Two unit squares side by side, and one apart.
const SQUARES: &str = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 2 0 0\nv 2 1 0\n\
    v 5 0 0\nv 6 0 0\nv 6 1 0\nv 5 1 0\n";

#[test]
fn there_is_one_group_for_each_part_instance() {
    let mesh = parse(
        format!("{SQUARES}f 1 2 3 4\nf 7 8 9 10\nf 2 5 6\nf 2 6 3\n").as_bytes(),
        Format::Obj,
    )
    .unwrap();
    let styles = styles();
    let labelling = Labelling {
        labels: &[4, 4, -1, 4],
        confidence: None,
        styles: &styles,
    };
    let text = obj(&mesh.vertices, &mesh.polygons(), &labelling, "a.mtl");
    let rest: Vec<&str> = text.lines().filter(|l| !l.starts_with("v ")).collect();
    let expected = [
        "mtllib a.mtl",
        "g unlabelled.001",
        "# label -1",
        "# faces 2",
        "usemtl unlabelled",
        "f 2 5 6",
        "g long_leg.001",
        "# label 4",
        "# faces 0 3",
        "usemtl long_leg",
        "f 1 2 3 4",
        "f 2 6 3",
        "g long_leg.002",
        "# label 4",
        "# faces 1",
        "usemtl long_leg",
        "f 7 8 9 10",
    ];
    assert_eq!(rest, expected);
    let expected =
        "newmtl long_leg\nKd 1.0000 0.0000 0.2000\nnewmtl seat\nKd 0.0000 0.0000 0.0000\n";
    assert_eq!(mtl(&styles), expected);
    let read = parse(text.as_bytes(), Format::Obj).unwrap();
    assert_eq!(read.vertices, mesh.vertices);
    let mut triangles = read.triangles.clone();
    triangles.sort_unstable();
    let mut expected = mesh.triangles.clone();
    expected.sort_unstable();
    assert_eq!(triangles, expected);
}

#[test]
fn what_an_obj_holds_stays_as_it_is() {
    let file = format!(
        "# made by hand\n# faces 0-3\nmtllib own.mtl\n\
         o body\n{SQUARES}vt 0 0\nvt 1 1\nvn 0 0 1\nfoo 1 2\n\
         g left\ns 1\nusemtl red\nf -10/-2/-1 -9/1/1 3/2/1 4//1\n\
         g right\nusemtl blue\nf 2 5 6 3\nl 1 -1\n\
         o other\nf 7 8 \\\n 9 10\n"
    );
    let expected = format!(
        "mtllib a.mtl\n# made by hand\nmtllib own.mtl\n{SQUARES}vt 0 0\nvt 1 1\nvn 0 0 1\nfoo 1 2\n\
         o body\n\
         g long_leg.001 left\n# label 4\n# faces 0\nusemtl red\ns 1\nf 1/1/1 2/1/1 3/2/1 4//1\n\
         g long_leg.001 right\n# label 4\n# faces 1\nusemtl blue\nf 2 5 6 3\nl 1 10\n\
         o other\n\
         g long_leg.002 right\n# label 4\n# faces 2\nf 7 8 9 10\n"
    );
    assert_eq!(labelled(&file, &[4, 4, 4], Materials::Own), expected);
}

#[test]
fn groups_are_objects_where_there_are_none_and_labels_lend_materials() {
    let file = format!("{SQUARES}g a\nf 1 2 3 4\ng b\nf 2 5 6 3\ng a\nusemtl red\nf 7 8 9 10\n");
    let own = labelled(&file, &[5, 5, 4], Materials::Own);
    let expected = "o a\n\
        g long_leg.001\n# label 4\n# faces 2\nusemtl red\nf 7 8 9 10\n\
        g seat.001\n# label 5\n# faces 0\nusemtl seat\nf 1 2 3 4\n\
        o b\n\
        g seat.002\n# label 5\n# faces 1\nf 2 5 6 3\n";
    assert_eq!(own.split_once("v 5 1 0\n").unwrap().1, expected);
    let painted = labelled(&file, &[5, 5, 4], Materials::Labels);
    assert!(
        painted.contains("# faces 2\nusemtl long_leg\nf 7"),
        "{painted}"
    );
}

#[test]
fn comments_are_folded() {
    let mut file = String::from("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n");
    let mut labels = Vec::new();
    for i in 0..200 {
        file.push_str("f 1 2 3\n");
        labels.push(4 + i % 2);
    }
    let text = labelled(&file, &labels, Materials::Own);
    assert!(text.lines().all(|l| l.len() <= super::WIDTH));
    let faces: Vec<&str> = text
        .lines()
        .filter_map(|l| l.strip_prefix("# faces "))
        .flat_map(|l| l.split(' '))
        .collect();
    assert_eq!(faces.len(), 200);
    assert_eq!((faces[1], faces[199]), ("2", "199"));
}
