//! Tests libraries of earlier versions, which are in the repository: they are opened, read,
//! upgraded, and extended.
//!
//! `tests/fixtures/make.sh` describes how they were made.

use coseg::Library;
use coseg::library::NewShape;
use coseg::mesh::Format;
use coseg::store::catalog::CATALOG_FORMAT;
use coseg::store::{Store, StoreError};
use std::path::{Path, PathBuf};

const FORMATS: [u32; 4] = [1, 2, 3, 4];

fn fixture(format: u32) -> PathBuf {
    let folder = format!("tests/fixtures/library-format-{format}");
    Path::new(env!("CARGO_MANIFEST_DIR")).join(folder)
}

fn copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap() {
        let (from, name) = entry.map(|e| (e.path(), e.file_name())).unwrap();
        if from.is_dir() {
            copy(&from, &to.join(name));
        } else {
            std::fs::copy(&from, to.join(name)).unwrap();
        }
    }
}

/// A copy that may be changed.
fn opened(format: u32) -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let library = dir.path().join("library");
    copy(&fixture(format), &library);
    (dir, library)
}

fn set_format(library: &Path, format: u32) {
    let connection = rusqlite::Connection::open(library.join("catalog.db")).unwrap();
    connection
        .pragma_update(None, "user_version", format)
        .unwrap();
}

fn format_of(library: &Path) -> u32 {
    let connection = rusqlite::Connection::open(library.join("catalog.db")).unwrap();
    connection
        .pragma_query_value(None, "user_version", |row| row.get(0))
        .unwrap()
}

/// The answers to all requests for a shape, as text.
fn answers(library: &Library) -> String {
    let mut text = String::new();
    for shape in ["a", "b", "c"] {
        let labels = library.labels("boxes", shape, None).unwrap();
        let of = |labels: &[i32]| {
            labels
                .iter()
                .map(i32::to_string)
                .collect::<Vec<_>>()
                .join(" ")
        };
        text.push_str(&format!("{shape}: {}\n", of(&labels.labels)));
    }
    for event in library.events_since("boxes", 0, 1_000).unwrap() {
        let kind = serde_json::to_value(&event.kind).unwrap();
        let name = kind.as_object().map_or(kind.to_string(), |o| {
            o.keys().next().cloned().unwrap_or_default()
        });
        text.push_str(&format!("{} {}\n", event.sequence, name.trim_matches('"')));
    }
    text
}

#[test]
fn an_old_library_opens_is_read_and_goes_on() {
    for format in FORMATS {
        let (_dir, path) = opened(format);
        assert_eq!(format_of(&path), format);
        let library = Library::open(&path).unwrap();
        let expected = fixture(format).with_extension("txt");
        let expected = std::fs::read_to_string(expected).unwrap();
        assert_eq!(answers(&library), expected, "format {format}");
        // Features of this version work on it.
        library.name_label("boxes", 0, "side", None).unwrap();
        library.undo("boxes", None).unwrap();
        let shape = NewShape {
            name: "new".into(),
            bytes: crate::harness::skittle(1).into(),
            format: Format::Off,
            replace: false,
        };
        library.add("boxes", shape).unwrap();
        drop(library);
        assert_eq!(format_of(&path), CATALOG_FORMAT);
        assert_eq!(Library::check(&path).unwrap(), [], "format {format}");
    }
}

#[test]
fn a_library_of_a_later_version_is_refused_and_left_as_it_is() {
    let later = CATALOG_FORMAT + 1;
    let (dir, path) = opened(2);
    set_format(&path, later);
    let before = std::fs::read(path.join("catalog.db")).unwrap();
    let refused = Store::open(&path).err().expect("refused");
    assert!(
        matches!(refused, StoreError::Version { found, .. } if found == later),
        "{refused}"
    );
    let home = crate::harness::Home { dir };
    let (status, printed) = home.spawn(&[], &[]).ended();
    assert!(!status.success());
    let message = format!("has store format {later}, this version reads {CATALOG_FORMAT}");
    assert!(printed.iter().any(|l| l.contains(&message)), "{printed:?}");
    assert_eq!(std::fs::read(path.join("catalog.db")).unwrap(), before);
}

/// Writes the fixture of the present format to the folder in `COSEG_TEST_FIXTURE`; see
/// `tests/fixtures/make.sh`.
#[test]
#[ignore = "writes a fixture"]
fn make_fixture() {
    let folder = std::env::var("COSEG_TEST_FIXTURE").unwrap();
    let path = Path::new(&folder);
    let library = Library::open(path).unwrap();
    let spec = coseg::library::CollectionSpec {
        name: "boxes".into(),
        n_parts: Some(2),
        working_faces: 200,
        ..Default::default()
    };
    library.create_collection(&spec, None).unwrap();
    for (variant, name) in ["a", "b", "c"].into_iter().enumerate() {
        let shape = NewShape {
            name: name.into(),
            bytes: crate::harness::skittle(variant as u32).into(),
            format: Format::Off,
            replace: false,
        };
        library.add("boxes", shape).unwrap();
    }
    std::fs::write(path.with_extension("txt"), answers(&library)).unwrap();
    drop(library);
    // Everything is in one file.
    rusqlite::Connection::open(path.join("catalog.db"))
        .unwrap()
        .execute_batch("PRAGMA wal_checkpoint(TRUNCATE)")
        .unwrap();
}
