//! Tests that unreferenced files are removed soon, and needed ones never.

use super::{add_shape, collection_id};
use coseg::store::rows::{NewJobItem, ObjectKind};
use coseg::store::{Digest, Store, StoreError};
use std::fs::File;
use std::path::Path;
use std::time::Duration;

fn n_files(library: &Path) -> usize {
    let folders = ["objects", "originals"].map(|f| library.join(f));
    let prefixes = folders
        .iter()
        .flat_map(|f| std::fs::read_dir(f).expect("a folder"));
    prefixes
        .map(|p| std::fs::read_dir(p.expect("an entry").path()).expect("a folder"))
        .map(Iterator::count)
        .sum()
}

fn remove(store: &Store, name: &str) {
    let id = collection_id(store, "chairs");
    let row = store.catalog().read(|r| r.shape_by_name(id, name));
    let row = row.expect("readable").expect("there");
    let removed = store.catalog().write(|tx| {
        // Its job, which the helper leaves queued.
        for item in tx.queued_items()? {
            tx.set_item(
                item.job,
                item.index,
                coseg::store::ItemStatus::Cancelled,
                None,
            )?;
        }
        tx.delete_shape(row.id)
    });
    removed.expect("removed");
}

#[test]
fn space_of_removed_shapes_comes_back_when_nobody_needs_it() {
    let dir = tempfile::tempdir().expect("a folder");
    let store = Store::open(dir.path()).expect("opens");
    for n in 0..3 {
        add_shape(&store, "chairs", &format!("s{n}"), n).expect("added");
    }
    assert_eq!(store.release_unreferenced().expect("looked"), 0);
    assert_eq!(store.reclaim(Duration::ZERO).expect("looked"), [""; 0]);
    assert_eq!(n_files(dir.path()), 6);
    remove(&store, "s1");
    assert_eq!(store.release_unreferenced().expect("released"), 2);
    // Not while a reader that found the rows may be about to open them.
    let hour = Duration::from_secs(3_600);
    assert_eq!(store.reclaim(hour).expect("looked"), [""; 0]);
    // Nor while any process makes a copy.
    let reading = File::open(dir.path().join("objects")).expect("opens");
    rustix::fs::flock(&reading, rustix::fs::FlockOperation::LockShared).expect("locked");
    assert_eq!(store.reclaim(Duration::ZERO).expect("looked"), [""; 0]);
    drop(reading);
    assert_eq!(store.reclaim(Duration::ZERO).expect("removed").len(), 2);
    assert_eq!(n_files(dir.path()), 4);
    assert_eq!(store.reclaim(Duration::ZERO).expect("looked"), [""; 0]);
}

/// The same bytes are added again during their removal.
#[test]
fn a_file_that_is_about_to_be_named_again_stays() {
    let dir = tempfile::tempdir().expect("a folder");
    let store = Store::open(dir.path()).expect("opens");
    add_shape(&store, "chairs", "a", 0).expect("added");
    let bytes = b"OFF chairs a 0";
    let find = || {
        let row = store
            .catalog()
            .read(|r| r.object(ObjectKind::Original, &Digest::of(bytes)));
        row.expect("readable")
    };
    let before = find().expect("there");
    remove(&store, "a");
    assert_eq!(store.release_unreferenced().expect("released"), 2);
    assert_eq!(find(), None);
    // Two writers find it; one commits, one gives up.
    let (first, second) = (
        store.objects().put_original(bytes).expect("stored"),
        store.objects().put_original(bytes).expect("stored"),
    );
    assert_eq!(first.file, before.file);
    drop(second);
    let removed = store.reclaim(Duration::ZERO).expect("removed");
    assert!(!removed.contains(&before.file), "{removed:?}");
    let committed: Result<_, StoreError> = store.catalog().write(|tx| {
        tx.insert_object(&first)?;
        let item = NewJobItem {
            name: "again".into(),
            original_digest: first.digest,
            format: "off".into(),
            replace: false,
        };
        tx.insert_job("chairs", 1, &[item])
    });
    committed.expect("committed");
    drop(first);
    assert_eq!(store.release_unreferenced().expect("looked"), 0);
    assert_eq!(store.reclaim(Duration::ZERO).expect("looked"), [""; 0]);
    let row = find().expect("there");
    assert_eq!(store.objects().original(&row).expect("whole"), bytes);
}

#[test]
fn what_was_put_and_never_committed_goes_too() {
    let dir = tempfile::tempdir().expect("a folder");
    let store = Store::open(dir.path()).expect("opens");
    let kept = store.objects().put_original(b"refused").expect("stored");
    assert_eq!(store.reclaim(Duration::ZERO).expect("looked"), [""; 0]);
    let file = kept.file.clone();
    drop(kept);
    assert_eq!(store.reclaim(Duration::ZERO).expect("removed"), [file]);
    assert_eq!(n_files(dir.path()), 0);
}
