//! Tests that a catalog with a missing, cut, older or foreign log is refused, never opened as a
//! smaller library.

use super::add_shape;
use coseg::Library;
use coseg::store::check::check;
use coseg::store::{Store, StoreError};
use std::fs;
use std::path::{Path, PathBuf};

const CATALOG: &str = "catalog.db";
const LOG: &str = "catalog.db-wal";
const INDEX: &str = "catalog.db-shm";
const WITNESS: &str = "catalog.commits";

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).expect("made");
    for entry in fs::read_dir(from).expect("a folder") {
        let entry = entry.expect("an entry");
        let target = to.join(entry.file_name());
        if entry.path().is_dir() {
            copy(&entry.path(), &target);
        } else {
            fs::copy(entry.path(), target).expect("copied");
        }
    }
}

/// The files of a library of two shapes, of four, and of six after a clean stop in between: the log
/// contains the last two.
struct Images {
    dir: tempfile::TempDir,
}

impl Images {
    fn make() -> Self {
        let images = Self {
            dir: tempfile::tempdir().expect("a folder"),
        };
        let library = images.dir.path().join("library");
        let mut store = Store::open(&library).expect("opens");
        for n in 0..6_u32 {
            if n == 4 {
                drop(store);
                let log = fs::metadata(library.join(LOG)).map_or(0, |m| m.len());
                assert_eq!(log, 0, "a clean stop leaves nothing in the log");
                store = Store::open(&library).expect("opens");
            }
            add_shape(&store, "chairs", &format!("s{n}"), n).expect("added");
            if n % 2 == 1 {
                copy(&library, &images.dir.path().join(format!("{}", n + 1)));
            }
        }
        images
    }

    fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    /// A library for damaging.
    fn fresh(&self, n: u32) -> PathBuf {
        let library = self.path("damaged");
        let _ = fs::remove_dir_all(&library);
        copy(&self.path(&n.to_string()), &library);
        library
    }
}

fn remove(library: &Path, files: &[&str]) {
    for file in files {
        fs::remove_file(library.join(file)).expect("removed");
    }
}

fn take(library: &Path, from: &Path, files: &[&str]) {
    for file in files {
        fs::copy(from.join(file), library.join(file)).expect("copied");
    }
}

fn damage(library: &Path) -> Vec<String> {
    let findings = check(library).expect("runs");
    let damage = findings.into_iter().filter(|f| f.damage);
    damage
        .map(|f| format!("{}: {}", f.location, f.message))
        .collect()
}

fn names(library: &Path) -> Vec<String> {
    let store = Store::open(library).expect("opens");
    let shapes = store.catalog().read(|r| {
        let Some(collection) = r.collection("chairs")? else {
            return Ok(Vec::new());
        };
        r.shapes(collection.id, 0, usize::MAX, None)
    });
    let shapes: Result<_, StoreError> = shapes;
    shapes
        .expect("readable")
        .into_iter()
        .map(|shape| shape.name)
        .collect()
}

#[test]
fn what_a_process_left_that_ended_opens() {
    let images = Images::make();
    for n in [2, 4, 6] {
        let library = images.fresh(n);
        assert_eq!(damage(&library), [""; 0]);
        let expected: Vec<_> = (0..n).map(|i| format!("s{i}")).collect();
        assert_eq!(names(&library), expected);
        // The same again, after a clean end.
        assert_eq!(names(&library), expected);
        // Once closed, it is one file: the rest of the log may be deleted.
        for file in [LOG, INDEX] {
            let _ = fs::remove_file(library.join(file));
        }
        assert_eq!(names(&library), expected);
    }
}

#[test]
fn a_log_that_does_not_hold_what_was_acknowledged_is_refused() {
    let images = Images::make();
    let other = tempfile::tempdir().expect("a folder");
    let other_image = other.path().join("image");
    {
        let store = Store::open(&other.path().join("library")).expect("opens");
        for n in 0..6 {
            add_shape(&store, "chairs", &format!("other{n}"), 40 + n).expect("added");
        }
        copy(&other.path().join("library"), &other_image);
    }
    let cut = |n: u32, share: u64| {
        let library = images.fresh(n);
        let path = library.join(LOG);
        let length = fs::metadata(&path).expect("there").len();
        let log = fs::File::options().write(true).open(path).expect("opens");
        log.set_len(length * share / 100).expect("cut");
        library
    };
    /// The damage, the error message, and the number of shapes with which a repair can continue.
    type Case<'a> = (&'a str, Box<dyn Fn() -> PathBuf + 'a>, &'a str, Option<u32>);
    let removed = |files: &'static [&'static str]| {
        let images = &images;
        Box::new(move || {
            let library = images.fresh(6);
            remove(&library, files);
            library
        })
    };
    let taken = |from: PathBuf, files: &'static [&'static str]| {
        let images = &images;
        Box::new(move || {
            let library = images.fresh(6);
            remove(&library, &[INDEX]);
            take(&library, &from, files);
            library
        })
    };
    let (two, four) = (images.path("2"), images.path("4"));
    let cases: Vec<Case<'_>> = vec![
        (
            "deleted",
            removed(&[LOG, INDEX]),
            "that were acknowledged",
            Some(4),
        ),
        (
            "cut to nothing",
            Box::new(|| cut(6, 0)),
            "that were acknowledged",
            Some(4),
        ),
        (
            "cut in the middle",
            Box::new(|| cut(6, 60)),
            "that were acknowledged",
            None,
        ),
        (
            "cut at its end",
            Box::new(|| cut(6, 99)),
            "that were acknowledged",
            None,
        ),
        (
            "cut, all of it in the log",
            Box::new(|| cut(4, 50)),
            "that were acknowledged",
            None,
        ),
        (
            "of before",
            taken(four.clone(), &[LOG]),
            "that were acknowledged",
            None,
        ),
        (
            "another's",
            taken(other_image.clone(), &[LOG]),
            "another catalog",
            Some(4),
        ),
        (
            "older file",
            taken(two.clone(), &[CATALOG]),
            "an older file",
            Some(0),
        ),
        (
            "older both",
            taken(four, &[CATALOG, LOG]),
            "an older file",
            Some(0),
        ),
        (
            "another's both",
            taken(other_image, &[CATALOG, LOG]),
            "another library",
            None,
        ),
        (
            "no catalog",
            removed(&[CATALOG, LOG, INDEX]),
            "the catalog is missing",
            None,
        ),
        (
            "no catalog, but a log",
            removed(&[CATALOG]),
            "the catalog is missing",
            None,
        ),
    ];
    for (what, make, says, goes_on_with) in cases {
        let library = make();
        let state = |file: &str| fs::read(library.join(file)).ok();
        let before = [CATALOG, LOG, WITNESS].map(state);
        match Store::open(&library) {
            Err(StoreError::Damaged { message, .. }) => {
                assert!(message.contains(says), "{what}: {message}");
                assert!(message.contains("check --repair"), "{what}: {message}");
            }
            Err(other) => panic!("{what}: {other}"),
            Ok(_) => panic!("{what}: opened"),
        }
        assert!(
            before == [CATALOG, LOG, WITNESS].map(state),
            "{what}: it was changed"
        );
        let found = damage(&library);
        assert!(found.iter().any(|f| f.contains(says)), "{what}: {found:?}");
        let copied = Library::copy(&library, &images.path("copy"), false);
        assert!(copied.is_err(), "{what}: copied");
        let Some(n) = goes_on_with else { continue };
        let lost = format!(
            "originals: {} shapes are in the store and not in the catalog",
            6 - n
        );
        // If the log belongs to another catalog, their combined contents are meaningless.
        if says == "that were acknowledged" {
            assert!(found.contains(&lost), "{what}: {found:?}");
        }
        let repaired = Library::repair(&library).unwrap_or_else(|e| panic!("{what}: {e}"));
        assert!(
            !repaired.left.iter().any(|f| f.damage),
            "{what}: {:?}",
            repaired.left
        );
        println!("{what}: {:?}", repaired.done);
        let kept = repaired
            .done
            .iter()
            .filter(|d| d.contains("can be added again"));
        assert_eq!(kept.count() as u32, 6 - n, "{what}");
        let expected: Vec<_> = (0..n).map(|i| format!("s{i}")).collect();
        assert_eq!(names(&library), expected, "{what}");
        assert!(library.join("quarantine/catalog-1.db").exists(), "{what}");
    }
}

#[test]
fn a_catalog_without_a_witness_opens_and_gets_one() {
    let images = Images::make();
    let library = images.fresh(6);
    remove(&library, &[WITNESS]);
    assert_eq!(damage(&library), [""; 0]);
    assert_eq!(names(&library).len(), 6);
    assert!(library.join(WITNESS).exists());
    // An unreadable witness is reported, and rewritten.
    fs::write(library.join(WITNESS), "coseg-commits 1 x").expect("written");
    let found = damage(&library);
    assert_eq!(found.len(), 1, "{found:?}");
    assert!(found[0].starts_with(WITNESS), "{found:?}");
    assert_eq!(names(&library).len(), 6);
    assert_eq!(damage(&library), [""; 0]);
    // Without a witness, a library that lost its log looks like a new one; its object files do not.
    let library = images.fresh(4);
    remove(&library, &[WITNESS, LOG, INDEX]);
    let findings = check(&library).expect("runs");
    let says = "4 shapes are in the store and not in the catalog";
    assert!(
        findings.iter().any(|f| f.message.contains(says)),
        "{findings:?}"
    );
}
