//! Tests the seeds of `fuzz/run.sh` and its earlier findings.

use coseg::mesh::{self, Format};
use coseg::store::mapped::{MappedDescription, write_description};
use std::panic::catch_unwind;
use std::path::{Path, PathBuf};

const OBJ: &str = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf -1 -2 -4\n";
const OFF: &str = "OFF\n4 4 6\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 1 2 3\n3 0 3 2\n";
const PLY: &str = "ply\nformat ascii 1.0\ncomment x\nelement vertex 3\nproperty float x\n\
    property float y\nproperty float z\nproperty uchar red\nelement face 1\n\
    property list uchar int vertex_indices\nend_header\n\
    0 0 0 1\n1 0 0 2\n0 1 0 3\n3 0 1 2\n";
const STL: &str = "solid x\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\n\
    vertex 0 1 0\nendloop\nendfacet\nendsolid x\n";
const GLTF: &str = r#"{"asset":{"version":"2.0"},"scene":0,"scenes":[{"nodes":[0]}],
    "nodes":[{"mesh":0,
    "children":[1],"scale":[1,2,1]},{"matrix":[1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1],"mesh":0}],
    "meshes":[{"primitives":[{"attributes":{"POSITION":0},"mode":4}]}],
    "accessors":[{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3",
        "min":[0,0,0],"max":[1,1,0]}],
    "bufferViews":[{"buffer":0,"byteLength":36,"byteOffset":0}],"buffers":[{"byteLength":36,"uri":
    "data:application/octet-stream;base64,AAAAAAAAAAAAAAAAAACAPwAAAAAAAAAAAAAAAAAAgD8AAAAA"}]}"#;

/// A small file of each supported format; PLY and STL also binary, glTF also in one file.
fn meshes() -> Vec<(Format, Vec<u8>)> {
    let header = PLY.replace("ascii", "binary_little_endian");
    let (header, _) = header.split_at(header.find("0 0 0 1").unwrap());
    let mut ply = header.as_bytes().to_vec();
    let mut stl = vec![b' '; 80];
    stl.extend(1_u32.to_le_bytes());
    stl.extend([0; 12]);
    for corner in [[0.0_f32, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]] {
        let bytes: Vec<u8> = corner.iter().flat_map(|x| x.to_le_bytes()).collect();
        stl.extend(&bytes);
        ply.extend(&bytes);
        ply.push(9);
    }
    stl.extend([0; 2]);
    ply.push(3);
    ply.extend([0_u32, 1, 2].iter().flat_map(|i| i.to_le_bytes()));
    let mut json = GLTF.replace('\n', " ").into_bytes();
    json.resize(json.len().next_multiple_of(4), b' ');
    let mut glb = b"glTF".to_vec();
    for n in [2, 20 + json.len() as u32, json.len() as u32, 0x4E4F_534A] {
        glb.extend(n.to_le_bytes());
    }
    glb.extend(json);
    vec![
        (Format::Obj, OBJ.into()),
        (Format::Off, OFF.into()),
        (Format::Ply, PLY.into()),
        (Format::Ply, ply),
        (Format::Stl, STL.into()),
        (Format::Stl, stl),
        (Format::Gltf, GLTF.into()),
        (Format::Gltf, glb),
    ]
}

#[test]
fn what_fuzzing_begins_with_is_read() {
    for (format, bytes) in meshes() {
        let parsed = mesh::parse(&bytes, format);
        let parsed = parsed.unwrap_or_else(|e| panic!("{}: {e}", format.name()));
        assert!(!parsed.triangles.is_empty());
    }
}

fn files(folder: &Path) -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir(folder) else {
        return Vec::new();
    };
    let mut files: Vec<_> = entries.map(|e| e.unwrap().path()).collect();
    files.sort();
    files
}

/// Inputs found by fuzzing, and all truncations of damaged headers.
#[test]
fn what_fuzzing_found_stays_mended() {
    let kept = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/kept");
    let whole = |what: &str, run: &(dyn Fn() + std::panic::RefUnwindSafe)| {
        catch_unwind(run).unwrap_or_else(|_| panic!("{what} panics"));
    };
    for format in Format::ALL {
        for file in files(&kept.join(format.name())) {
            let bytes = std::fs::read(&file).unwrap();
            whole(&file.display().to_string(), &|| {
                if let Ok(parsed) = mesh::parse(&bytes, format) {
                    let _ = mesh::clean(&parsed);
                }
            });
        }
    }
    let good = write_description(&crate::store::description(6, 1), "{}").unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("arrays");
    let open = |bytes: &[u8]| {
        std::fs::write(&path, bytes).unwrap();
        MappedDescription::open(&path, bytes.len() as u64, None).map(|m| m.to_description())
    };
    assert!(open(&good).is_ok());
    for file in files(&kept.join("arrays")) {
        let bytes = std::fs::read(&file).unwrap();
        whole(&file.display().to_string(), &|| drop(open(&bytes)));
    }
    for end in (0..good.len()).step_by(7) {
        assert!(open(&good[..end]).is_err(), "cut at {end}");
    }
}

/// Writes the seeds of fuzzing into the folder in `COSEG_TEST_SEEDS`.
#[test]
#[ignore = "writes files for fuzz/run.sh"]
fn write_seeds() {
    let into = PathBuf::from(std::env::var_os("COSEG_TEST_SEEDS").unwrap());
    let put = |target: &str, name: &str, bytes: &[u8]| {
        let folder = into.join(target);
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::write(folder.join(name), bytes).unwrap();
    };
    for (i, (format, bytes)) in meshes().iter().enumerate() {
        put(format.name(), &i.to_string(), bytes);
    }
    for hostile in crate::hostile::corpus() {
        if hostile.bytes.len() < 4_096 {
            put(
                hostile.format.name(),
                &hostile.name.replace('/', "-"),
                &hostile.bytes,
            );
        }
    }
    let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden");
    for file in files(&golden) {
        let name = file.file_name().unwrap().to_str().unwrap().to_owned();
        if name.ends_with(".request.bin") {
            put("request", &name, &std::fs::read(&file).unwrap());
        }
    }
    let good = write_description(&crate::store::description(6, 1), "{}").unwrap();
    put("arrays", "good", &good);
}
