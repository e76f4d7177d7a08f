//! Tests input files of every format, labels in every format, and files found in the wild.

use crate::harness::{Home, SKITTLE_FACES, json, messy_files, skittle, stdout};
use coseg::library::{CollectionSpec, LibraryError, NewShape};
use coseg::mesh::write::{self, Labelling};
use coseg::mesh::{Format, ParsedMesh, parse};
use coseg::{Library, synth};
use std::collections::BTreeMap;
use std::path::Path;

fn read(path: impl AsRef<Path>) -> Vec<u8> {
    let path = path.as_ref();
    std::fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// Labels that nobody named.
fn labelling(labels: &[i32]) -> Labelling<'_> {
    static UNNAMED: BTreeMap<i32, write::LabelStyle> = BTreeMap::new();
    Labelling {
        labels,
        confidence: None,
        styles: &UNNAMED,
    }
}

/// The same skittle in every format, by file name.
fn in_every_format() -> Vec<(&'static str, Vec<u8>)> {
    let text = skittle(1);
    let mesh = parse(text.as_bytes(), Format::Off).unwrap();
    let (vertices, faces) = (&mesh.vertices, &mesh.triangles);
    let labels = vec![0; faces.len()];
    let labelling = labelling(&labels);
    let obj = write::obj(vertices, faces, &labelling, "none.mtl");
    let ply = write::ply(vertices, faces, &vec![[0; 3]; faces.len()], &labels);
    let glb = write::glb("g", vertices, faces, &labelling, None);
    let mut stl = vec![0; 80];
    stl.extend_from_slice(&(faces.len() as u32).to_le_bytes());
    for face in faces {
        stl.extend_from_slice(&[0; 12]);
        let numbers = face.iter().flat_map(|&v| vertices[v as usize]);
        stl.extend(numbers.flat_map(|x| (x as f32).to_le_bytes()));
        stl.extend_from_slice(&[0; 2]);
    }
    vec![
        ("a.off", text.into_bytes()),
        ("b.obj", obj.into_bytes()),
        ("c.ply", ply),
        ("d.stl", stl),
        ("e.glb", glb),
    ]
}

#[test]
fn every_format_comes_in_and_goes_out_with_its_labels() {
    let home = Home::new();
    let folder = home.path("meshes");
    std::fs::create_dir(&folder).unwrap();
    for (name, bytes) in in_every_format() {
        std::fs::write(folder.join(name), bytes).unwrap();
    }
    let _daemon = home.start();
    let folder = folder.display().to_string();
    let added = json(&home.coseg(&["add", &folder, "--parts", "2", "--json"]), 0);
    assert_eq!(added["n_added"], 5, "{added}");
    let out = home.path("out");
    let directory = out.display().to_string();
    for format in ["labels", "seg", "npy", "json", "ply", "obj", "glb", "usda"] {
        stdout(
            &home.coseg(&["export", "--format", format, "--out", &directory]),
            0,
        );
    }
    for name in ["a", "b", "c", "d", "e"] {
        let labels: Vec<i32> = stdout(&home.coseg(&["labels", name]), 0)
            .lines()
            .map(|l| l.parse().unwrap())
            .collect();
        assert_eq!(labels.len(), SKITTLE_FACES);
        assert!(labels.iter().any(|l| *l != labels[0]), "{name}: {labels:?}");
        let file = |ending: &str| read(out.join(format!("{name}{ending}")));
        assert_eq!(file(".seg"), file(".labels.txt"));
        assert_eq!(file(".seg"), write::seg(&labels).into_bytes());
        assert_eq!(file(".labels.npy"), write::npy(&labels));
        let value: serde_json::Value = serde_json::from_slice(&file(".labels.json")).unwrap();
        assert_eq!(value["labels"], serde_json::json!(labels));
        assert_eq!(value["names"]["-1"], "unlabelled");

        // The meshes have the faces of the file, in its order, except for GLB.
        let original = home.path("meshes").join(match name {
            "a" => "a.off",
            "b" => "b.obj",
            "c" => "c.ply",
            "d" => "d.stl",
            _ => "e.glb",
        });
        let format = Format::from_name(&original.to_string_lossy()).unwrap();
        let whole = parse(&read(original), format).unwrap();
        assert_eq!(parse(&file(".ply"), Format::Ply).unwrap(), whole, "{name}");
        // The label is at the end of a face's record.
        let ply = file(".ply");
        let records = &ply[ply.len() - 20 * SKITTLE_FACES..];
        let of_records = records
            .chunks(20)
            .map(|r| i32::from_le_bytes(r[16..].try_into().unwrap()));
        assert!(of_records.eq(labels.iter().copied()));
        assert_eq!(labels_of_obj(&file(".obj"), &whole), labels, "{name}");
        assert_eq!(labels_of_glb(&file(".glb"), &whole), labels, "{name}");
        let usda = String::from_utf8(file(".usda")).unwrap();
        let listed: Vec<String> = labels.iter().map(i32::to_string).collect();
        let line = format!("int[] primvars:coseg:label = [{}] (", listed.join(", "));
        assert!(usda.contains(&line));
    }
}

/// Labels by the comments of the groups that faces are in; the faces must be the original's.
fn labels_of_obj(bytes: &[u8], original: &ParsedMesh) -> Vec<i32> {
    let (found, polygons) = (parse(bytes, Format::Obj).unwrap(), original.polygons());
    assert_eq!(found.vertices, original.vertices);
    let mut faces = found.polygons().into_iter();
    let mut labels = vec![i32::MIN; original.n_polygons];
    let (mut label, mut n_groups) = (i32::MIN, 0);
    for line in std::str::from_utf8(bytes).unwrap().lines() {
        n_groups += usize::from(line.starts_with("g "));
        if let Some(text) = line.strip_prefix("# label ") {
            label = text.parse().unwrap();
        }
        for run in line
            .strip_prefix("# faces ")
            .into_iter()
            .flat_map(|l| l.split(' '))
        {
            let (first, last) = run.split_once('-').unwrap_or((run, run));
            for face in first.parse::<usize>().unwrap()..=last.parse().unwrap() {
                labels[face] = label;
                assert_eq!(faces.next().as_ref(), Some(&polygons[face]));
            }
        }
    }
    assert_eq!(faces.next(), None);
    assert_eq!(n_groups, instances_of(original, &labels).len());
    labels
}

/// The names of the part instances.
fn instances_of(mesh: &ParsedMesh, labels: &[i32]) -> Vec<String> {
    let objects = vec![0; labels.len()];
    let found = coseg::mesh::instances(&mesh.vertices, &mesh.polygons(), labels, &objects);
    let pairs = found.labels.iter().zip(&found.numbers);
    pairs
        .map(|(label, n)| format!("label_{label}.{n:03}"))
        .collect()
}

/// Labels by what a GLB's primitives say of the polygons they have; their triangles must be the
/// original's.
fn labels_of_glb(bytes: &[u8], original: &ParsedMesh) -> Vec<i32> {
    let n_json = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    let root: serde_json::Value = serde_json::from_slice(&bytes[20..20 + n_json]).unwrap();
    let found = parse(bytes, Format::Gltf).unwrap();
    let place = |mesh: &ParsedMesh, t: [u32; 3]| t.map(|v| mesh.vertices[v as usize]);
    let mut labels = vec![i32::MIN; original.n_polygons];
    let mut triangles = found.triangles.iter();
    for mesh in root["meshes"].as_array().unwrap() {
        let extras = &mesh["primitives"][0]["extras"];
        let label = extras["label"].as_i64().unwrap() as i32;
        let runs: Vec<usize> = serde_json::from_value(extras["polygons"].clone()).unwrap();
        for polygon in runs.chunks(2).flat_map(|run| run[0]..run[0] + run[1]) {
            labels[polygon] = label;
            let (one, other) = (*triangles.next().unwrap(), original.triangles[polygon]);
            let pairs = place(&found, one).into_iter().zip(place(original, other));
            for (a, b) in pairs.flat_map(|(a, b)| a.into_iter().zip(b)) {
                assert!((a - b).abs() <= 1e-6 * b.abs().max(1.0), "{a} {b}");
            }
        }
    }
    assert_eq!(triangles.next(), None);
    let nodes = root["nodes"].as_array().unwrap();
    let with_meshes = nodes.iter().filter(|node| !node["mesh"].is_null());
    let mut names: Vec<&str> = with_meshes.map(|n| n["name"].as_str().unwrap()).collect();
    names.sort_unstable();
    let mut expected = instances_of(original, &labels);
    expected.sort_unstable();
    assert_eq!(names, expected);
    labels
}

fn library() -> (tempfile::TempDir, Library) {
    let folder = tempfile::tempdir().unwrap();
    let library = Library::open(folder.path()).unwrap();
    let spec = CollectionSpec {
        name: "all".into(),
        n_parts: Some(3),
        ..CollectionSpec::default()
    };
    library.create_collection(&spec, None).unwrap();
    (folder, library)
}

fn add(library: &Library, name: &str, bytes: Vec<u8>, format: Format) -> Result<(), LibraryError> {
    let shape = NewShape {
        name: name.into(),
        bytes,
        format,
        replace: false,
    };
    library.add("all", shape).map(|_| ())
}

#[test]
fn every_messy_file_is_labelled_or_refused_with_a_reason() {
    let Some(paths) = messy_files() else {
        return;
    };
    let (_folder, library) = library();
    let mut n_labelled = 0;
    for (i, path) in paths.iter().enumerate() {
        let file = path.file_name().unwrap().to_string_lossy();
        let format = Format::from_name(&file).unwrap_or_else(|| panic!("{file} is no mesh"));
        let name = format!("{i}");
        match add(&library, &name, read(path), format) {
            Ok(()) => {
                n_labelled += 1;
                let labels = library.labels("all", &name, None).unwrap().labels;
                let n = parse(&read(path), format).unwrap().n_polygons;
                assert_eq!(labels.len(), n, "{file}");
                assert!(
                    labels.iter().all(|l| *l >= 0),
                    "{file} has unlabelled faces"
                );
                let report = library.shape("all", &name).unwrap().report;
                println!("{file}: labelled, {report:?}");
            }
            Err(LibraryError::Refused(why)) => println!("{file}: refused, {}", why.message),
            Err(e) => panic!("{file}: {e}"),
        }
    }
    // All existing faces can be labelled.
    assert_eq!(n_labelled, paths.len());
}

/// A chair of loose, closed pieces is one shape: the pieces are joined for the analysis, reported,
/// and labelled like those of a chair in one piece.
#[test]
fn a_chair_of_loose_pieces_is_one_shape() {
    let (_folder, library) = library();
    let pieces = |shift: f64| {
        let boards: [([f64; 3], [f64; 3]); 8] = [
            ([0.0, 0.0, 0.0], [0.1, 1.0, 0.1]),
            ([0.9, 0.0, 0.0], [1.0, 1.0, 0.1]),
            ([0.0, 0.0, 0.9], [0.1, 1.0, 1.0]),
            ([0.9, 0.0, 0.9], [1.0, 1.0, 1.0]),
            ([0.0, 1.01, 0.0], [1.0, 1.1, 1.0]),
            ([0.0, 1.11, 0.0], [0.1, 2.0, 0.1]),
            ([0.9, 1.11, 0.0], [1.0, 2.0, 0.1]),
            ([0.0, 1.6, 0.11], [1.0, 1.9 + shift, 0.2]),
        ];
        let mut text = String::new();
        for (low, high) in boards {
            for i in 0..8 {
                let p: [f64; 3] =
                    std::array::from_fn(|k| if i >> k & 1 == 1 { high[k] } else { low[k] });
                text.push_str(&format!("v {} {} {}\n", p[0], p[1], p[2]));
            }
            for quad in [
                "-8 -6 -5 -7",
                "-4 -3 -1 -2",
                "-8 -7 -3 -4",
                "-6 -2 -1 -5",
                "-8 -4 -2 -6",
                "-7 -5 -1 -3",
            ] {
                text.push_str(&format!("f {quad}\n"));
            }
        }
        text
    };
    for i in 0..6 {
        let text = pieces(0.02 * f64::from(i));
        add(
            &library,
            &format!("chair {i}"),
            text.into_bytes(),
            Format::Obj,
        )
        .unwrap();
    }
    for i in 0..6 {
        let shape = library.shape("all", &format!("chair {i}")).unwrap();
        assert_eq!(shape.report.n_components, 8);
        assert!(shape.report.n_bridges >= 7);
        let labels = library.labels("all", &shape.name, None).unwrap().labels;
        assert_eq!(labels.len(), 8 * 6);
        // The four legs have equal labels; a board has one label.
        for piece in labels.chunks(6) {
            let most = piece.iter().filter(|l| **l == piece[0]).count();
            assert!(most >= 5, "{labels:?}");
        }
        assert!(
            labels[..24].iter().filter(|l| **l == labels[0]).count() >= 20,
            "{labels:?}"
        );
        assert_ne!(labels[0], labels[24], "leg and seat: {labels:?}");
    }
}

/// Labels are returned for each polygon, and the known parts of a generated shape survive in every
/// format.
#[test]
fn a_made_shape_reads_the_same_in_every_format() {
    let options = synth::Options {
        n_faces: 1_000,
        rotate: false,
    };
    let shape = &synth::family(synth::Family::Chair, 1, 1, &options)[0];
    let labels: Vec<i32> = shape.labels.iter().map(|&l| l as i32).collect();
    let (vertices, faces) = (&shape.mesh.vertices, &shape.mesh.faces);
    let off = parse(write::off(&shape.mesh).as_bytes(), Format::Off).unwrap();
    let text = write::obj(vertices, faces, &labelling(&labels), "m.mtl");
    assert_eq!(labels_of_obj(text.as_bytes(), &off), labels);
    let glb = write::glb("chair", vertices, faces, &labelling(&labels), None);
    assert_eq!(labels_of_glb(&glb, &off), labels);
}

/// A prism over a C; the caps begin at a corner whose fan leaves them. By hand: 2 x 7 for the caps,
/// 16 for the walls.
fn concave_prism() -> String {
    let c = ["0 0", "3 0", "3 1", "1 1", "1 2", "3 2", "3 3", "0 3"];
    let mut text = String::new();
    for z in ["0", "1"] {
        for xy in c {
            text.push_str(&format!("v {xy} {z}\n"));
        }
    }
    text.push_str("f 1 8 7 6 5 4 3 2\nf 9 10 11 12 13 14 15 16\n");
    for i in 1..=8 {
        let next = i % 8 + 1;
        text.push_str(&format!("f {i} {next} {} {}\n", next + 8, i + 8));
    }
    text
}

#[test]
fn faces_that_are_concave_have_their_area_and_one_label() {
    let (_folder, library) = library();
    let bytes = || concave_prism().into_bytes();
    add(&library, "c", bytes(), Format::Obj).unwrap();
    let shape = library.shape("all", "c").unwrap();
    assert!((shape.area - 30.0).abs() < 1e-9, "{}", shape.area);
    assert_eq!(shape.report.n_polygons, 10);
    assert_eq!(shape.report.n_triangles, 28);
    assert_eq!(shape.report.n_concave_polygons, 2);
    assert_eq!(shape.report.n_nonplanar_polygons, 0);
    assert_eq!(shape.report.n_boundary_edges, 0);
    assert_eq!(library.labels("all", "c", None).unwrap().labels.len(), 10);
    // The same file twice is no other shape, even when it replaces itself.
    let again = NewShape {
        name: "c".into(),
        bytes: bytes(),
        format: Format::Obj,
        replace: true,
    };
    let placed = library.add("all", again).unwrap();
    assert_eq!(placed.outcome, coseg::library::Outcome::Unchanged);
}

/// Statements that programs interpret differently are read as their writers intended, and the
/// report lists them.
#[test]
fn odd_spellings_are_read_and_told() {
    let (_folder, library) = library();
    let cube = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1\n\
                f 4 3 2 1\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\n";
    let parsed = parse(cube.as_bytes(), Format::Obj).unwrap();
    let mut stl = String::from("solid a cube\n");
    for t in &parsed.triangles {
        let corners = t.map(|v| parsed.vertices[v as usize]);
        let vertex = |[x, y, z]: [f64; 3]| format!("vertex {x} {y} {z}");
        let [a, b, c] = corners.map(vertex);
        stl.push_str(&format!(
            "facet normal 0 0 0 outer loop {a} {b} {c} endloop endfacet\n"
        ));
    }
    stl.push_str("endsolid a cube\n");
    let comment = cube.replace("f 2 3 7 6", "# textures in D:\\maps\\\nf 2 3 7 6");
    let wide: Vec<u8> = cube.encode_utf16().flat_map(u16::to_le_bytes).collect();
    let unread = format!("{cube}l 1 2\ncurv 0 1 1 2 3 4\n");
    for (name, text, format, n_faces, tolerated, n_unread) in [
        (
            "fo",
            cube.replace("f 4 1", "fo 4 1").into_bytes(),
            Format::Obj,
            6,
            1,
            0,
        ),
        ("comment", comment.into_bytes(), Format::Obj, 6, 1, 0),
        (
            "cr",
            cube.replace('\n', "\r").into_bytes(),
            Format::Obj,
            6,
            0,
            0,
        ),
        ("wide", wide, Format::Obj, 6, 0, 0),
        ("unread", unread.into_bytes(), Format::Obj, 6, 0, 2),
        ("stl", stl.into_bytes(), Format::Stl, 12, 12 * 6, 0),
    ] {
        add(&library, name, text, format).unwrap_or_else(|e| panic!("{name}: {e}"));
        let report = library.shape("all", name).unwrap().report;
        let n = library.labels("all", name, None).unwrap().labels.len();
        assert_eq!(n, n_faces, "{name}");
        assert_eq!(report.n_tolerated_statements, tolerated, "{name}");
        assert_eq!(report.n_unread_statements, n_unread, "{name}");
    }
}

#[test]
fn a_file_that_is_no_mesh_is_named_whatever_its_suffix_says() {
    let (_folder, library) = library();
    for (bytes, what) in [
        (&b"PK\x03\x04\x14\0\0\0\x08\0chair.obj"[..], "a ZIP archive"),
        (b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR", "a PNG picture"),
        (b"\xff\xd8\xff\xe0\0\x10JFIF", "a JPEG picture"),
        (b"%PDF-1.7\n%\xe2\xe3", "a PDF document"),
        (b"\x1f\x8b\x08\0\0\0\0\0", "a gzip file"),
    ] {
        for format in Format::ALL {
            let Err(LibraryError::Refused(why)) = add(&library, "x", bytes.to_vec(), format) else {
                panic!("{what} as {format:?} is taken");
            };
            assert!(why.message.contains(what), "{}", why.message);
        }
    }
}

/// A box as OBJ whose vertices come after `n` others.
fn box_obj(low: [f64; 3], high: [f64; 3], n: usize) -> String {
    let mut text = String::new();
    for i in 0..8 {
        let p: [f64; 3] = std::array::from_fn(|k| if i >> k & 1 == 1 { high[k] } else { low[k] });
        text.push_str(&format!("v {} {} {}\n", p[0], p[1], p[2]));
    }
    for quad in [
        [1, 3, 4, 2],
        [5, 6, 8, 7],
        [1, 2, 6, 5],
        [3, 7, 8, 4],
        [1, 5, 7, 3],
        [2, 4, 8, 6],
    ] {
        let corners: Vec<String> = quad.iter().map(|v| (n + v).to_string()).collect();
        text.push_str(&format!("f {}\n", corners.join(" ")));
    }
    text
}

#[test]
fn exports_say_which_way_is_up() {
    let home = Home::new();
    let mesh = home.path("box.obj");
    std::fs::write(&mesh, box_obj([0.0; 3], [1.0, 2.0, 5.0], 0)).unwrap();
    let mesh = mesh.display().to_string();
    let _daemon = home.start();
    let out = home.path("out");
    let directory = out.display().to_string();
    for (up, axis, turned) in [
        ("+z", "Z", true),
        ("+y", "Y", false),
        ("unknown", "", false),
    ] {
        let name = format!("up{axis}");
        let add = [
            "add",
            &mesh,
            "--collection",
            &name,
            "--parts",
            "2",
            "--up",
            up,
        ];
        stdout(&home.coseg(&add), 0);
        for format in ["glb", "usda"] {
            let export = [
                "export",
                "--collection",
                &name,
                "--format",
                format,
                "--out",
                &directory,
            ];
            stdout(&home.coseg(&export), 0);
        }
        let usda = String::from_utf8(read(out.join("box.usda"))).unwrap();
        assert_eq!(
            usda.contains(&format!("upAxis = \"{axis}\"")),
            !axis.is_empty(),
            "{usda}"
        );
        assert!(usda.contains("metersPerUnit = 1"));
        let found = parse(&read(out.join("box.glb")), Format::Gltf).unwrap();
        let highest = found.vertices.iter().map(|v| v[1]).fold(0.0, f64::max);
        let expected = if turned { 5.0 } else { 2.0 };
        assert!((highest - expected).abs() < 1e-6, "{up}: {highest}");
    }
}

#[test]
fn a_full_description_counts_its_virtual_edges() {
    let home = Home::new();
    let mesh = home.path("boxes.obj");
    let text = box_obj([0.0; 3], [1.0; 3], 0) + &box_obj([3.0, 0.0, 0.0], [4.0, 1.0, 1.0], 8);
    std::fs::write(&mesh, text).unwrap();
    let mesh = mesh.display().to_string();
    let full = [
        "describe",
        &mesh,
        "--full",
        "--operator",
        "cotan",
        "--k",
        "4",
    ];
    let found = json(&home.coseg(&[&full[..], &["--json"]].concat()), 0);
    assert!(
        found["report"]["n_bridges"].as_u64().unwrap() > 0,
        "{found}"
    );
    let eigenvalues: Vec<f64> = serde_json::from_value(found["eigenvalues"].clone()).unwrap();
    assert!(eigenvalues[1] > 0.0, "they are one domain: {eigenvalues:?}");
    let text = stdout(&home.coseg(&full), 0);
    assert!(
        text.contains("mesh: 2 components, 2 virtual edges between components"),
        "{text}"
    );
}

#[test]
fn a_gltf_is_packed_with_the_buffers_beside_it() {
    let home = Home::new();
    let folder = home.path("scene");
    std::fs::create_dir(&folder).unwrap();
    let mesh = parse(skittle(1).as_bytes(), Format::Off).unwrap();
    let coordinates = mesh.vertices.iter().flatten();
    let mut bytes: Vec<u8> = coordinates
        .flat_map(|x| (*x as f32).to_le_bytes())
        .collect();
    let n_positions = bytes.len();
    bytes.extend(
        mesh.triangles
            .iter()
            .flatten()
            .flat_map(|v| v.to_le_bytes()),
    );
    let gltf = serde_json::json!({
        "asset": { "version": "2.0" }, "scenes": [{ "nodes": [0] }], "nodes": [{ "mesh": 0 }],
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0 }, "indices": 1 }] }],
        "accessors": [
            {
                "bufferView": 0, "componentType": 5126, "count": mesh.vertices.len(),
                "type": "VEC3"
            },
            {
                "bufferView": 1, "componentType": 5125, "count": 3 * mesh.triangles.len(),
                "type": "SCALAR"
            },
        ],
        "bufferViews": [
            { "buffer": 0, "byteLength": n_positions },
            { "buffer": 0, "byteOffset": n_positions, "byteLength": bytes.len() - n_positions },
        ],
        "buffers": [{ "byteLength": bytes.len(), "uri": "a%20skittle.bin" }],
    });
    let path = folder.join("skittle.gltf");
    std::fs::write(&path, gltf.to_string()).unwrap();
    let [path, folder_name] = [&path, &folder].map(|p| p.display().to_string());
    let _daemon = home.start();
    let missing = json(&home.coseg(&["add", &path, "--parts", "2", "--json"]), 1);
    let why = missing["shapes"][0]["error"]["message"].as_str().unwrap();
    assert!(
        why.ends_with(
            "buffer 0 is in \"a%20skittle.bin\", but the folder of the file has no file \
                       of that name"
        ),
        "{why}"
    );
    std::fs::write(folder.join("a skittle.bin"), bytes).unwrap();
    // The buffer is not a mesh file of the folder, and is skipped silently.
    let output = home.coseg(&["add", &folder_name, "--parts", "2"]);
    stdout(&output, 0);
    assert!(!String::from_utf8_lossy(&output.stderr).contains("skipped"));
    assert_eq!(
        stdout(&home.coseg(&["labels", "skittle"]), 0)
            .lines()
            .count(),
        SKITTLE_FACES
    );
    let described = json(&home.coseg(&["describe", &path, "--json"]), 0);
    assert_eq!(described["report"]["n_polygons"], SKITTLE_FACES);
}

/// An inner wall has the labels of the wall around it, and is excluded from the findings.
#[test]
fn an_inner_wall_has_the_labels_of_the_one_around_it() {
    let options = synth::Options {
        n_faces: 2_000,
        rotate: false,
    };
    let (_other, single) = library();
    let (_folder, library) = library();
    for (i, shape) in synth::family(synth::Family::Chair, 3, 3, &options)
        .iter()
        .enumerate()
    {
        let (outer, name) = (&shape.mesh, format!("chair {i}"));
        add(&single, &name, write::off(outer).into_bytes(), Format::Off).unwrap();
        let mut normals = vec![[0.0; 3]; outer.vertices.len()];
        for face in &outer.faces {
            let [a, b, c] = face.map(|v| outer.vertices[v as usize]);
            let side = |p: [f64; 3]| -> [f64; 3] { std::array::from_fn(|k| p[k] - a[k]) };
            let (u, v) = (side(b), side(c));
            let normal = [
                u[1] * v[2] - u[2] * v[1],
                u[2] * v[0] - u[0] * v[2],
                u[0] * v[1] - u[1] * v[0],
            ];
            for v in face {
                let sum = &mut normals[*v as usize];
                *sum = std::array::from_fn(|k| sum[k] + normal[k]);
            }
        }
        let mut walls = outer.clone();
        for (p, n) in outer.vertices.iter().zip(&normals) {
            let length = n.iter().map(|x| x * x).sum::<f64>().sqrt();
            walls
                .vertices
                .push(std::array::from_fn(|k| p[k] - 2e-3 * n[k] / length));
        }
        let n = outer.vertices.len() as u32;
        walls
            .faces
            .extend(outer.faces.iter().map(|[a, b, c]| [a + n, c + n, b + n]));
        add(
            &library,
            &name,
            write::off(&walls).into_bytes(),
            Format::Off,
        )
        .unwrap();
    }
    for i in 0..3 {
        let name = format!("chair {i}");
        let report = library.shape("all", &name).unwrap().report;
        assert_eq!((report.n_components, report.n_inner_walls), (2, 1));
        assert_eq!(2 * report.n_inner_triangles, report.n_triangles);
        let labels = library.labels("all", &name, None).unwrap().labels;
        let (outer, inner) = labels.split_at(labels.len() / 2);
        let same = outer.iter().zip(inner).filter(|(a, b)| a == b).count();
        assert!(
            same as f64 > 0.97 * outer.len() as f64,
            "{same} of {}",
            outer.len()
        );
        // The outer wall has the same labels as alone, except for rounding at boundaries.
        let alone = single.labels("all", &name, None).unwrap().labels;
        let same = outer.iter().zip(&alone).filter(|(a, b)| a == b).count();
        assert!(
            same as f64 > 0.97 * alone.len() as f64,
            "{same} of {}",
            alone.len()
        );
    }
}
