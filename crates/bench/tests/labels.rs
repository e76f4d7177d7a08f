//! Tests the figures of `coseg-bench labels` on generated shapes.

use coseg::mesh::write::off;
use coseg::synth::{Family, Options, family};
use serde_json::Value;
use std::path::Path;
use std::process::Command;

/// Pliers with their true labels, as the bench reads them.
fn write_category(folder: &Path, count: u32) -> std::io::Result<()> {
    std::fs::create_dir(folder)?;
    let options = Options {
        n_faces: 600,
        rotate: false,
    };
    for shape in family(Family::Pliers, 5, count, &options) {
        let path = folder.join(format!("{}.off", shape.name));
        std::fs::write(path, off(&shape.mesh))?;
        let labels: String = shape.labels.iter().map(|l| format!("{l}\n")).collect();
        let path = folder.join(format!("{}.labels.txt", shape.name));
        std::fs::write(path, labels)?;
    }
    Ok(())
}

#[test]
fn figures_come_as_json_for_each_category() {
    let data = tempfile::tempdir().unwrap();
    write_category(&data.path().join("pliers"), 6).unwrap();
    let done = Command::new(env!("CARGO_BIN_EXE_coseg-bench"))
        .args(["labels", "--orders", "1", "--exemplars", "0,1"])
        .args(["--no-baselines", "--json", "--data"])
        .arg(data.path())
        .output()
        .unwrap();
    let words = String::from_utf8_lossy(&done.stderr);
    assert!(done.status.success(), "{words}");
    let found: Value = serde_json::from_slice(&done.stdout).unwrap();
    let category = &found["categories"][0];
    assert_eq!(category["category"], "pliers");
    assert_eq!(category["n_shapes"], 6);
    assert_eq!(category["with_exemplars"].as_array().unwrap().len(), 1);
    let accuracy = category["accuracy"].as_f64().unwrap();
    assert!((0.5..=1.0).contains(&accuracy), "{accuracy}");
}

#[test]
fn a_folder_without_labels_is_a_usage_error_that_names_it() {
    let data = tempfile::tempdir().unwrap();
    let done = Command::new(env!("CARGO_BIN_EXE_coseg-bench"))
        .args(["labels", "--data"])
        .arg(data.path())
        .output()
        .unwrap();
    let words = String::from_utf8_lossy(&done.stderr);
    assert_eq!(done.status.code(), Some(2), "{words}");
    assert!(words.contains(".labels.txt"), "{words}");
}
