//! The bytes of an array file, without a digest to catch what is wrong with them: opened or
//! refused, and safe to index.
#![no_main]

use coseg::store::mapped::MappedDescription;
use libfuzzer_sys::fuzz_target;
use std::sync::LazyLock;

// Memory is a file too.
static PATH: LazyLock<std::path::PathBuf> =
    LazyLock::new(|| format!("/dev/shm/coseg-fuzz-{}", std::process::id()).into());

fuzz_target!(|bytes: &[u8]| {
    std::fs::write(&*PATH, bytes).expect("written");
    let Ok(mapped) = MappedDescription::open(&PATH, bytes.len() as u64, None) else {
        return;
    };
    let view = mapped.view();
    let n = view.vertices.len();
    assert!(view.faces.iter().flatten().all(|&v| (v as usize) < n));
    assert!(view.face_map.iter().all(|&f| (f as usize) < view.faces.len()));
    assert_eq!(view.eigenvectors.len(), n * view.n_eigenvectors);
    let _ = mapped.to_description();
});
