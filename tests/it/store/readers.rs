//! Tests readers beside a writer, and files that are not catalogs.

use super::{add_shape, collection_id, opened};
use coseg::store::{Store, StoreError};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;
use std::time::Duration;

type Result<T> = std::result::Result<T, StoreError>;

/// A reader that began before a commit keeps seeing the old state, and neither waits for the other.
#[test]
fn readers_neither_wait_nor_see_half() -> Result<()> {
    let (_dir, store) = opened();
    add_shape(&store, "chairs", "s0", 0)?;
    let id = collection_id(&store, "chairs");
    let (in_transaction, wait_for_transaction) = mpsc::channel();
    let (read, wait_for_read) = mpsc::channel();
    let writing = &store;
    std::thread::scope(|scope| {
        scope.spawn(move || {
            writing.catalog().write(|tx| -> Result<()> {
                tx.set_state(id, b"new")?;
                in_transaction.send(()).expect("the reader waits");
                // The reader must get its answer while this transaction is open.
                wait_for_read
                    .recv_timeout(Duration::from_secs(60))
                    .expect("the reader answers");
                Ok(())
            })
        });
        wait_for_transaction.recv().expect("the writer began");
        let state = store
            .catalog()
            .read(|r| r.collection_by_id(id))
            .expect("readable");
        assert_eq!(state.expect("there").state, b"state");
        read.send(()).expect("the writer waits");
    });
    store.catalog().read(|r| -> Result<()> {
        assert_eq!(r.collection_by_id(id)?.expect("there").state, b"new");
        // A commit in the middle of this read is not seen by it.
        store.catalog().write(|tx| tx.set_state(id, b"newer"))?;
        assert_eq!(r.collection_by_id(id)?.expect("there").state, b"new");
        Ok(())
    })
}

#[test]
fn many_readers_beside_a_writer_see_whole_commits() -> Result<()> {
    let (_dir, store) = opened();
    add_shape(&store, "chairs", "s0", 0)?;
    let id = collection_id(&store, "chairs");
    let done = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let readers: Vec<_> = (0..6)
            .map(|_| {
                scope.spawn(|| {
                    let mut n_reads = 0;
                    while n_reads == 0 || !done.load(Ordering::Relaxed) {
                        store
                            .catalog()
                            .read(|r| -> Result<()> {
                                let collection = r.collection_by_id(id)?.expect("there");
                                let n_events = r.events_since("chairs", 0, usize::MAX)?.len();
                                assert_eq!(collection.sequence, n_events as u64);
                                assert_eq!(collection.next_ordinal, r.n_shapes(id)? + 1);
                                Ok(())
                            })
                            .expect("readable");
                        n_reads += 1;
                    }
                })
            })
            .collect();
        for seed in 1..40 {
            add_shape(&store, "chairs", &format!("s{seed}"), seed).expect("added");
        }
        done.store(true, Ordering::Relaxed);
        for reader in readers {
            reader.join().expect("no reader failed");
        }
    });
    Ok(())
}

#[test]
fn catalogs_of_older_formats_are_brought_to_this_one() -> Result<()> {
    let (_dir, store) = opened();
    let library = store.dir().to_path_buf();
    drop(store);
    let catalog = library.join("catalog.db");
    let format = || -> u32 {
        let connection = rusqlite::Connection::open(&catalog).expect("opens");
        connection
            .pragma_query_value(None, "user_version", |row| row.get(0))
            .expect("a number")
    };
    let old = |sql: &str| {
        rusqlite::Connection::open(&catalog)
            .expect("opens")
            .execute_batch(sql)
            .expect("runs");
    };
    let since_6 = "DROP TABLE links;";
    let since_5 = "DROP TABLE candidates; DROP TABLE proposals;";
    let since_4 = "DROP TABLE reviews; DROP TABLE passed_parts;";
    let since_3 = "DROP TABLE point_maps; DROP TABLE map_confidence;";
    let since_2 = "DROP TABLE labels_before; DROP TABLE corrections; DROP TABLE pins;";
    for (dropped, of_format) in [
        (since_6.to_owned(), 5),
        (format!("{since_6} {since_5}"), 4),
        (format!("{since_6} {since_5} {since_4}"), 3),
        (format!("{since_6} {since_5} {since_4} {since_3}"), 2),
        (
            format!("{since_6} {since_5} {since_4} {since_3} {since_2}"),
            1,
        ),
    ] {
        old(&format!("{dropped} PRAGMA user_version = {of_format}"));
        drop(Store::open(&library)?);
        assert_eq!(format(), 6, "from format {of_format}");
    }
    let store = Store::open(&library)?;
    let new = coseg::store::NewCollection {
        name: "old".into(),
        ..Default::default()
    };
    let left = store.catalog().write(|tx| {
        let id = tx.insert_collection(&new)?;
        tx.insert_correction(id, "name", "{}", b"before")?;
        tx.n_corrections(id)
    })?;
    assert_eq!(left, 1);
    Ok(())
}

#[test]
fn newer_and_foreign_catalogs_are_refused() -> Result<()> {
    let (dir, store) = opened();
    let library = store.dir().to_path_buf();
    drop(store);
    let catalog = library.join("catalog.db");
    let change = |sql: &str| {
        let connection = rusqlite::Connection::open(&catalog).expect("opens");
        connection.execute_batch(sql).expect("runs");
    };
    change("PRAGMA user_version = 7");
    let newer = Store::open(&library).err().expect("refused");
    assert!(
        matches!(
            newer,
            StoreError::Version {
                found: 7,
                supported: 6,
                ..
            }
        ),
        "{newer}"
    );
    change("PRAGMA user_version = 4; PRAGMA application_id = 7");
    assert!(Store::open(&library).err().expect("refused").is_damage());
    let other = dir.path().join("other");
    std::fs::create_dir(&other).expect("created");
    std::fs::write(
        other.join("catalog.db"),
        "not a database, but long enough to have a header ".repeat(9),
    )
    .expect("written");
    assert!(Store::open(&other).err().expect("refused").is_damage());
    Ok(())
}
