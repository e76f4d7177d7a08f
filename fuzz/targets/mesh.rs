//! Bytes of a mesh file, in the format that `COSEG_FUZZ_FORMAT` names: parsed or refused, and
//! cleaned or refused.
#![no_main]

use coseg::mesh::{self, Format};
use libfuzzer_sys::fuzz_target;
use std::sync::LazyLock;

static FORMAT: LazyLock<Format> = LazyLock::new(|| {
    let name = std::env::var("COSEG_FUZZ_FORMAT").expect("COSEG_FUZZ_FORMAT is set");
    let found = Format::ALL.into_iter().find(|f| f.name() == name);
    found.unwrap_or_else(|| panic!("no format is named {name:?}"))
});

fuzz_target!(|bytes: &[u8]| {
    let Ok(parsed) = mesh::parse(bytes, *FORMAT) else {
        return;
    };
    // What is promised of a mesh that was parsed.
    assert!(!parsed.triangles.is_empty());
    let n = parsed.vertices.len();
    assert!(parsed.triangles.iter().flatten().all(|&v| (v as usize) < n));
    if let Ok(cleaned) = mesh::clean(&parsed) {
        assert_eq!(cleaned.face_of_polygon.len(), parsed.n_polygons);
        let shells = mesh::outer_shells(cleaned);
        let n_faces = shells.mesh.faces.len();
        assert!(shells.face_of_polygon.iter().all(|&f| (f as usize) < n_faces));
    }
});
