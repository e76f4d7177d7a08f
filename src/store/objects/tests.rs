//! Tests object files under faults and crashes at every operation.

use super::*;
use crate::store::faulty::{EIO, ENOSPC, Fault, MemDisk};

/// The contents of the tests: two digests share a folder, and one content occurs twice.
fn contents() -> Vec<Vec<u8>> {
    let mut contents: Vec<Vec<u8>> = (0..9_u8)
        .map(|i| vec![i; usize::from(i) * 40 + 1].repeat(3))
        .collect();
    let prefix = |bytes: &[u8]| Digest::of(bytes).0[0];
    let neighbour = (0_u32..)
        .map(|i| i.to_le_bytes().to_vec())
        .find(|bytes| prefix(bytes) == prefix(&contents[4]))
        .expect("one in 256");
    contents.push(neighbour);
    contents.push(contents[2].clone());
    contents
}

fn opened(disk: &Arc<MemDisk>) -> Result<Objects, StoreError> {
    Objects::open(
        Arc::clone(disk) as Arc<dyn Disk>,
        Path::new("/l"),
        Health::default(),
    )
}

fn whole(disk: &MemDisk, row: &ObjectRow, bytes: &[u8]) -> bool {
    read_original(disk, Path::new("/l"), row).is_ok_and(|read| read == bytes)
}

#[test]
fn what_was_put_survives_a_crash_at_every_operation() {
    let disk = Arc::new(MemDisk::new());
    let objects = opened(&disk).expect("opens");
    let acknowledged: Vec<_> = contents()
        .into_iter()
        .map(|bytes| {
            let row = objects.put_original(&bytes).expect("stored");
            (disk.n_logged(), row, bytes)
        })
        .collect();
    let mut n_images = 0;
    for n_logged in 0..=disk.n_logged() {
        for seed in 0..40 {
            n_images += 1;
            let image = Arc::new(disk.after_crash(n_logged, seed));
            for (at, row, bytes) in &acknowledged {
                let there = whole(&image, row, bytes);
                assert!(
                    there || *at > n_logged,
                    "{} lost at {n_logged}, {seed}",
                    row.file
                );
                // A file with a final name is complete, whether acknowledged or not.
                assert!(there || !image.exists(&Path::new("/l").join(&row.file)));
            }
            // The store opens without help, and repeating all operations gives the same result.
            let objects = opened(&image).expect("opens");
            for (_, row, bytes) in &acknowledged {
                assert_eq!(*objects.put_original(bytes).expect("stored"), **row);
            }
            let again = image.after_crash(image.n_logged(), 0);
            let survivors = acknowledged.iter().filter(|(at, ..)| *at > n_logged);
            for (_, row, bytes) in survivors {
                // The second log begins at the image, so it contains only the repeated writes.
                assert!(whole(&image, row, bytes));
                let in_second = again.exists(&Path::new("/l").join(&row.file));
                assert!(!in_second || whole(&again, row, bytes));
            }
        }
    }
    println!("{n_images} crash images");
    assert!(n_images >= 2_000, "{n_images}");
}

/// Stores everything with a fault at operation `fault.at`, then again without the fault.
fn run_with(fault: Fault) {
    let disk = Arc::new(MemDisk::new());
    disk.set_fault(Some(fault));
    let mut acknowledged = Vec::new();
    let mut stopped = false;
    let opened_at_once = opened(&disk);
    if let Ok(objects) = &opened_at_once {
        for bytes in contents() {
            match objects.put_original(&bytes) {
                Ok(row) => {
                    assert!(!stopped, "{fault:?}: a write after a failed sync");
                    acknowledged.push((row, bytes));
                }
                Err(StoreError::ReadOnly { .. }) => {
                    assert_eq!(fault.errno, EIO, "{fault:?}: a full disk passes");
                    stopped = true;
                }
                Err(StoreError::NoSpace { .. }) => assert_eq!(fault.errno, ENOSPC, "{fault:?}"),
                Err(StoreError::Io { source, .. }) => {
                    assert_eq!(source.raw_os_error(), Some(fault.errno), "{fault:?}");
                }
                Err(error) => panic!("{fault:?}: {error}"),
            }
        }
        assert_eq!(stopped, objects.health.read_only().is_some());
    }
    assert_eq!(disk.n_retried_syncs(), 0, "{fault:?}");
    let worst = disk.after_crash(disk.n_logged(), 0);
    for (row, bytes) in &acknowledged {
        assert!(whole(&worst, row, bytes), "{fault:?}: {} lost", row.file);
    }
    disk.set_fault(None);
    let objects = match opened_at_once {
        Ok(objects) => objects,
        Err(_) => {
            disk.restart();
            opened(&disk).expect("opens once the fault is gone")
        }
    };
    for (row, bytes) in &acknowledged {
        assert_eq!(
            objects.original(row).expect("reads are served"),
            *bytes,
            "{fault:?}"
        );
    }
    for bytes in contents() {
        match objects.put_original(&bytes) {
            Ok(row) => assert!(whole(&disk, &row, &bytes), "{fault:?}"),
            Err(error) => {
                assert!(stopped, "{fault:?}: does not recover: {error}");
                assert!(matches!(error, StoreError::ReadOnly { .. }), "{error}");
            }
        }
    }
    assert_eq!(disk.n_retried_syncs(), 0, "{fault:?}");
    // A new process does not inherit the fault that stopped the previous one.
    disk.restart();
    let next = opened(&disk).expect("opens");
    for bytes in contents() {
        let row = next.put_original(&bytes).expect("stored");
        assert!(whole(&disk, &row, &bytes), "{fault:?}");
    }
}

#[test]
fn every_operation_may_fail_once_or_for_ever() {
    let disk = Arc::new(MemDisk::new());
    let objects = opened(&disk).expect("opens");
    for bytes in contents() {
        objects.put_original(&bytes).expect("stored");
    }
    let n_operations = disk.n_operations();
    println!("{} faults", 4 * n_operations);
    assert!(n_operations > 60, "{n_operations}");
    for at in 0..n_operations {
        for errno in [EIO, ENOSPC] {
            for for_ever in [false, true] {
                run_with(Fault {
                    at,
                    errno,
                    for_ever,
                });
            }
        }
    }
}

#[test]
fn other_bytes_under_a_taken_name_get_a_name_of_their_own() {
    let disk = Arc::new(MemDisk::new());
    let objects = opened(&disk).expect("opens");
    let first = Description {
        area: 1.0,
        ..Description::default()
    };
    let second = Description {
        area: 2.0,
        ..Description::default()
    };
    let digest = Digest::of(b"one digest");
    let one = objects
        .put_description(digest, &first, "{}")
        .expect("stored");
    let two = objects
        .put_description(digest, &second, "{}")
        .expect("stored");
    assert_ne!(one.file, two.file);
    assert_ne!(one.blake3, two.blake3);
    assert_eq!(
        *objects
            .put_description(digest, &first, "{}")
            .expect("stored"),
        *one
    );
    assert_eq!(
        *objects
            .put_description(digest, &second, "{}")
            .expect("stored"),
        *two
    );
    for row in [&one, &two] {
        let bytes = disk.read(&Path::new("/l").join(&row.file)).expect("there");
        assert_eq!(
            (bytes.len() as u64, Digest::of(&bytes)),
            (row.length, row.blake3)
        );
    }
}

#[test]
fn opened_files_stay_mapped_within_the_bound() {
    let dir = tempfile::tempdir().expect("a folder");
    let disk = Arc::new(crate::store::disk::RealDisk);
    let objects = Objects::open(disk, dir.path(), Health::default()).expect("opens");
    let rows: Vec<_> = (0..4_u8)
        .map(|i| {
            let one = Description {
                area: f64::from(i),
                ..Description::default()
            };
            objects
                .put_description(Digest::of(&[i]), &one, "{}")
                .expect("stored")
        })
        .collect();
    let length = rows[0].length as usize;
    objects.set_cache_bytes(2 * length);
    for at in [0, 1, 0, 2] {
        objects.open_description(&rows[at]).expect("whole");
    }
    let cached = |row: &Kept| objects.cached(&row.file, row.blake3).is_some();
    assert_eq!(
        rows.iter().map(cached).collect::<Vec<_>>(),
        [true, false, true, false]
    );
    // A row with another digest never gets the mapping of an earlier one.
    let other = ObjectRow {
        blake3: rows[1].blake3,
        ..ObjectRow::clone(&rows[0])
    };
    assert!(objects.open_description(&other).is_err());
    objects.set_cache_bytes(0);
    assert!(!cached(&rows[0]));
    objects.open_description(&rows[0]).expect("whole");
    assert!(!cached(&rows[0]));
}
