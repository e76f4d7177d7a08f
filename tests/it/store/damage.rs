//! Tests that damage is found, named, and never served as data; orphans are not damage.

use super::{PARAMS, add_shape, collection_id, description};
use coseg::store::check::check;
use coseg::store::objects::ORPHAN_AGE;
use coseg::store::rows::ObjectKind;
use coseg::store::{Digest, Store, StoreError};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

fn library() -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().expect("a folder");
    let library = dir.path().join("library");
    let store = Store::open(&library).expect("opens");
    for seed in 0..3 {
        add_shape(&store, "chairs", &format!("s{seed}"), seed).expect("added");
    }
    (dir, library)
}

fn damage(library: &Path) -> Vec<String> {
    let findings = check(library).expect("runs");
    findings
        .into_iter()
        .filter(|f| f.damage)
        .map(|f| format!("{}: {}", f.location, f.message))
        .collect()
}

fn object_files(library: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for folder in ["objects", "originals"] {
        for prefix in std::fs::read_dir(library.join(folder)).expect("a folder") {
            let prefix = prefix.expect("an entry").path();
            for file in std::fs::read_dir(prefix).expect("a folder") {
                files.push(file.expect("an entry").path());
            }
        }
    }
    files.sort();
    files
}

#[test]
fn a_whole_library_has_no_findings() {
    let (_dir, library) = library();
    assert_eq!(check(&library).expect("runs"), []);
    let store = Store::open(&library).expect("opens");
    assert_eq!(check(&library).expect("runs beside the holder"), []);
    let id = collection_id(&store, "chairs");
    let shape = store
        .catalog()
        .read(|r| r.shape_by_name(id, "s1"))
        .expect("readable");
    store
        .catalog()
        .write(|tx| tx.delete_shape(shape.expect("there").id))
        .expect("deleted");
    assert_eq!(check(&library).expect("runs"), []);
    let missing = check(Path::new("/nonexistent/library"));
    assert!(matches!(missing, Err(StoreError::Io { .. })), "{missing:?}");
}

#[test]
fn every_damaged_object_file_is_named() {
    let (_dir, library) = library();
    for file in object_files(&library) {
        let good = std::fs::read(&file).expect("readable");
        let name = file
            .strip_prefix(&library)
            .expect("inside")
            .display()
            .to_string();
        let mut variants: Vec<Vec<u8>> = Vec::new();
        for at in (0..good.len()).step_by(good.len() / 40 + 1) {
            let mut flipped = good.clone();
            flipped[at] ^= 0x10;
            variants.push(flipped);
            variants.push(good[..at].to_vec());
            let mut zeroed = good.clone();
            let end = good.len().min(at + 4096);
            zeroed[at..end].fill(0);
            variants.push(zeroed);
        }
        variants.push([good.as_slice(), b" "].concat());
        variants.retain(|variant| *variant != good);
        for (at, variant) in variants.iter().enumerate() {
            std::fs::write(&file, variant).expect("written");
            let found = damage(&library);
            assert_eq!(found.len(), 1, "variant {at} of {name}: {found:?}");
            assert!(found[0].starts_with(&name), "{found:?}");
        }
        std::fs::remove_file(&file).expect("removed");
        assert!(damage(&library)[0].starts_with(&name));
        std::fs::write(&file, &good).expect("written");
        assert_eq!(damage(&library), [""; 0]);
    }
}

#[test]
fn swapped_files_are_named() {
    let (_dir, library) = library();
    let files = object_files(&library);
    let (a, b) = (&files[0], &files[1]);
    let swap = library.join("tmp/swap");
    std::fs::rename(a, &swap).expect("renamed");
    std::fs::rename(b, a).expect("renamed");
    std::fs::rename(&swap, b).expect("renamed");
    assert_eq!(damage(&library).len(), 2);
}

#[test]
fn damaged_files_are_never_served_and_the_rest_is() {
    let (_dir, library) = library();
    let store = Store::open(&library).expect("opens");
    let id = collection_id(&store, "chairs");
    let refs = store
        .catalog()
        .read(|r| r.descriptions(id))
        .expect("readable");
    let path = library.join(&refs[1].object.file);
    let mut bytes = std::fs::read(&path).expect("readable");
    let last = bytes.len() - 1;
    bytes[last] ^= 1;
    std::fs::write(&path, &bytes).expect("written");
    let error = store
        .objects()
        .open_description(&refs[1].object)
        .expect_err("refused");
    assert!(error.is_damage(), "{error}");
    assert!(error.to_string().contains(&refs[1].object.file), "{error}");
    for whole in [&refs[0], &refs[2]] {
        store
            .objects()
            .open_description(&whole.object)
            .expect("whole");
    }
    // Describing again repairs it: the good bytes get a name of their own beside the bad ones.
    let again = store
        .objects()
        .put_description(refs[1].object.digest, &description(21, 1), PARAMS);
    let again = again.expect("stored");
    assert_ne!(again.file, refs[1].object.file);
    store
        .catalog()
        .write(|tx| tx.insert_object(&again))
        .expect("committed");
    let mapped = store.objects().open_description(&again).expect("whole");
    assert_eq!(mapped.to_description(), description(21, 1));
    assert_eq!(damage(&library), [""; 0]);
}

/// Flips one bit at many places of the catalog's file: each is found, or changes no answer. Nothing
/// panics, and all data that are read equal those that were written.
#[test]
fn a_damaged_catalog_is_found_or_harmless() {
    let (_dir, library) = library();
    let catalog = library.join("catalog.db");
    // Everything is in one file, without a log.
    let connection = rusqlite::Connection::open(&catalog).expect("opens");
    connection
        .execute_batch("PRAGMA wal_checkpoint(TRUNCATE)")
        .expect("runs");
    drop(connection);
    let good = std::fs::read(&catalog).expect("readable");
    let whole = dump(&library).expect("whole");
    let (mut n_found, mut n_hidden) = (0, 0);
    for step in 0..600 {
        let at = (step * 7_919 + 13) * 31 % good.len();
        let mut bad = good.clone();
        bad[at] ^= 1 << (step % 8);
        // Every tenth time it writes a block of zeros instead.
        if step % 10 == 0 {
            let begin = at / 4096 * 4096;
            let end = good.len().min(begin + 4096);
            bad[begin..end].fill(0);
        }
        std::fs::write(&catalog, &bad).expect("written");
        let found = check(&library).map(|findings| findings.iter().any(|f| f.damage));
        if matches!(found, Ok(false)) {
            let same = dump(&library).expect("nothing was found");
            assert_eq!(same, whole, "byte {at} changed an answer unnoticed");
        } else {
            n_found += 1;
            // Each answer is right or a typed error, never wrong. A row behind a broken index may
            // seem to be missing, but no write is based on that: writes are refused.
            if let Ok(answers) = dump(&library) {
                let wrong = answers
                    .iter()
                    .any(|line| !whole.contains(line) && line != "None");
                assert!(!wrong, "byte {at}: {answers:?}");
                let refused = Store::open(&library)
                    .expect("opens")
                    .health()
                    .read_only()
                    .is_some();
                assert!(refused || answers == whole, "byte {at}");
                n_hidden += usize::from(answers != whole);
            }
        }
    }
    println!("{n_hidden} damaged catalogs hid a row from a reader");
    println!("{n_found} of 600 changes were found, the others were harmless");
    assert!(n_found > 100, "{n_found}");
    for end in (0..good.len()).step_by(4096) {
        std::fs::write(&catalog, &good[..end]).expect("written");
        if end > 0 {
            assert_ne!(damage(&library), [""; 0], "cut at {end}");
        }
    }
}

/// The answers to all queries of the catalog by a library, as lines.
fn dump(library: &Path) -> Result<Vec<String>, StoreError> {
    let store = Store::open(library)?;
    store.catalog().read(|r| {
        let mut lines = vec![format!("id {}", r.library_id()?)];
        for collection in r.collections()? {
            lines.push(format!("{collection:?} {:?}", r.model(collection.id)?));
            for label in r.labels(collection.id)? {
                lines.push(format!("{} {label:?}", collection.id));
            }
            for event in r.events_since(&collection.name, 0, usize::MAX)? {
                lines.push(format!("{} {event:?}", collection.id));
            }
            for shape in r.shapes(collection.id, 0, usize::MAX, None)? {
                lines.push(format!("{shape:?} {:?}", r.newest_labels(shape.id)?));
                lines.push(format!("{} {:?}", shape.id, r.signature(shape.id)?));
                lines.push(format!("{} {:?}", shape.id, r.stats(shape.id)?));
                for map in r.maps_into(shape.id)? {
                    lines.push(format!("{map:?}"));
                }
                for kind in [ObjectKind::Original, ObjectKind::Description] {
                    let digest = match kind {
                        ObjectKind::Original => shape.content_digest,
                        ObjectKind::Description => shape.description_digest,
                    };
                    lines.push(format!("{:?}", r.object(kind, &digest)?));
                }
                let request = r.request("client", &format!("{}-{}", collection.id, shape.name))?;
                lines.push(format!("{request:?}"));
            }
        }
        for item in r.queued_items()? {
            lines.push(format!("{item:?}"));
        }
        Ok(lines)
    })
}

#[test]
fn rows_that_contradict_each_other_are_named() {
    let (_dir, library) = library();
    let change = |sql: &str| {
        let connection = rusqlite::Connection::open(library.join("catalog.db")).expect("opens");
        // As a program without knowledge of sums and references would do.
        connection
            .execute_batch("PRAGMA foreign_keys = OFF")
            .expect("runs");
        for table in ["shapes", "events", "label_versions", "objects", "streams"] {
            connection
                .execute_batch(&format!("DROP TRIGGER IF EXISTS {table}_updated"))
                .expect("runs");
        }
        connection.execute_batch(sql).expect("runs");
    };
    for (sql, place) in [
        ("UPDATE shapes SET n_polygons = 7 WHERE id = 1", "shapes 1"),
        (
            "UPDATE label_versions SET polygon_labels = x'00' WHERE shape_id = 2",
            "label_versions 2, 1",
        ),
        ("DELETE FROM label_versions WHERE shape_id = 3", "shapes 3"),
        (
            "DELETE FROM events WHERE sequence = 2",
            "events of \"chairs\"",
        ),
        (
            "DELETE FROM shape_signatures WHERE shape_id = 2",
            "shapes 2: no signature",
        ),
        ("DELETE FROM collections", "shapes rowid 1"),
    ] {
        change(sql);
        let found = damage(&library);
        assert!(
            found.iter().any(|f| f.starts_with(place)),
            "{sql}: {found:?}"
        );
    }
    // People cannot change a row by accident, because they do not maintain the sum.
    let connection = rusqlite::Connection::open(library.join("catalog.db")).expect("opens");
    let refused = connection.execute("UPDATE labels SET name = 'leg'", []);
    assert!(
        refused
            .expect_err("no such function")
            .to_string()
            .contains("row_sum")
    );
}

#[test]
fn what_another_process_left_is_named_and_swept_after_a_day_not_before() {
    let (_dir, library) = library();
    let store = Store::open(&library).expect("opens");
    let old = library.join("objects/ab");
    std::fs::create_dir_all(&old).expect("created");
    let old = old.join("abandoned.safetensors");
    std::fs::write(&old, "x").expect("written");
    let two_days_ago = SystemTime::now() - Duration::from_secs(2 * 86_400);
    let set_old = |path: &Path| {
        let file = std::fs::File::options()
            .write(true)
            .open(path)
            .expect("opens");
        file.set_modified(two_days_ago).expect("set");
    };
    set_old(&old);
    std::fs::write(library.join("tmp/1-1"), "fresh").expect("written");
    // Stored by this process, old by the file's own clock: still about to be committed.
    let pending = store.objects().put_original(b"pending").expect("stored");
    let file = pending.file.clone();
    set_old(&library.join(&file));
    let findings = check(&library).expect("runs");
    assert_eq!(findings.len(), 3, "{findings:?}");
    assert!(findings.iter().all(|f| !f.damage), "{findings:?}");

    let swept = store.sweep_orphans(ORPHAN_AGE).expect("swept");
    assert_eq!(swept, ["objects/ab/abandoned.safetensors"]);
    store
        .catalog()
        .write(|tx| tx.insert_object(&pending))
        .expect("committed");
    assert_eq!(
        store.objects().original(&pending).expect("whole"),
        b"pending"
    );

    // Nothing refers to it, so its row is deleted now; its file is removed a day later if the
    // process ends first.
    drop(pending);
    assert_eq!(store.sweep_orphans(ORPHAN_AGE).expect("swept"), [""; 0]);
    let row = store
        .catalog()
        .read(|r| r.object(ObjectKind::Original, &Digest::of(b"pending")));
    assert_eq!(row.expect("readable"), None);
    assert!(library.join(&file).exists());
    let n_needed = object_files(&library).len() - 1;
    drop(store);
    let store = Store::open(&library).expect("opens");
    assert!(library.join(&file).exists(), "never swept at start");
    assert_eq!(store.sweep_orphans(ORPHAN_AGE).expect("swept"), [file]);
    assert_eq!(
        store.sweep_orphans(Duration::ZERO).expect("swept"),
        ["tmp/1-1"]
    );
    assert_eq!(object_files(&library).len(), n_needed);
    assert_eq!(check(&library).expect("runs"), []);
}

#[test]
fn what_shapes_and_queued_items_need_is_not_swept() {
    let (_dir, library) = library();
    let store = Store::open(&library).expect("opens");
    let id = collection_id(&store, "chairs");
    store
        .catalog()
        .write(|tx| tx.delete_collection(id))
        .expect("deleted");
    // Its items are still queued: the originals stay, the descriptions are removed.
    let swept = store.sweep_orphans(Duration::ZERO).expect("swept");
    assert_eq!(swept.len(), 3);
    assert!(
        swept.iter().all(|file| file.starts_with("objects/")),
        "{swept:?}"
    );
    for item in store
        .catalog()
        .read(|r| r.queued_items())
        .expect("readable")
    {
        let digest = item.item.original_digest;
        let row = store
            .catalog()
            .read(|r| r.object(ObjectKind::Original, &digest));
        store
            .objects()
            .original(&row.expect("readable").expect("there"))
            .expect("whole");
    }
    assert_eq!(check(&library).expect("runs"), []);
}
