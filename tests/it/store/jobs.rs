//! Tests accepted jobs and answered requests.

use super::opened;
use coseg::store::rows::{ItemStatus, NewJobItem, RequestRow};
use coseg::store::{Digest, StoreError};

type Result<T> = std::result::Result<T, StoreError>;

#[test]
fn jobs_are_taken_up_again_in_order() -> Result<()> {
    let (_dir, store) = opened();
    let original = store.objects().put_original(b"bytes")?;
    let item = |name: &str| NewJobItem {
        name: name.into(),
        original_digest: original.digest,
        format: "obj".into(),
        replace: name == "b",
    };
    let (first, second) = store.catalog().write(|tx| -> Result<_> {
        tx.insert_object(&original)?;
        let first = tx.insert_job("x", 10, &[item("a"), item("b")])?;
        Ok((first, tx.insert_job("y", 11, &[item("c")])?))
    })?;
    store
        .catalog()
        .write(|tx| tx.set_item(first, 0, ItemStatus::Failed, Some("{}")))?;
    let queued = store.catalog().read(|r| r.queued_items())?;
    let order: Vec<_> = queued
        .iter()
        .map(|i| (i.job, i.index, i.collection.as_str(), i.item.replace))
        .collect();
    assert_eq!(order, [(first, 1, "x", true), (second, 0, "y", false)]);
    let items = store.catalog().read(|r| r.job_items(first))?;
    assert_eq!(items[0].status, ItemStatus::Failed);
    assert_eq!(items[0].detail_json.as_deref(), Some("{}"));
    assert_eq!(
        store
            .catalog()
            .read(|r| r.job(second))?
            .expect("there")
            .created_unix_secs,
        11
    );
    let unknown = store
        .catalog()
        .write(|tx| tx.set_item(second, 5, ItemStatus::Done, None));
    assert!(
        matches!(unknown, Err(StoreError::Missing { .. })),
        "{unknown:?}"
    );
    store
        .catalog()
        .write(|tx| tx.set_item(second, 0, ItemStatus::Cancelled, None))?;
    assert_eq!(
        store.catalog().write(|tx| tx.purge_jobs(100))?,
        1,
        "the first has one queued"
    );
    assert_eq!(store.catalog().read(|r| r.job_items(second))?, []);
    Ok(())
}

#[test]
fn answers_are_kept_for_a_day_whatever_the_clock_does() -> Result<()> {
    const DAY: u64 = 24 * 60 * 60;
    let (_dir, store) = opened();
    let row = |id: u64, created| RequestRow {
        client_id: "c".into(),
        request_id: id.to_string(),
        request_digest: Digest::of(&id.to_le_bytes()),
        reply: vec![0, 159, id as u8],
        created_unix_secs: created,
    };
    let catalog = store.catalog();
    let mut now = 1_000 * DAY;
    catalog.write(|tx| tx.purge_requests(now, DAY))?;
    catalog.write(|tx| tx.put_request(&row(1, now)))?;
    let again = catalog.write(|tx| tx.put_request(&row(1, now)));
    assert!(
        matches!(
            again,
            Err(StoreError::Exists {
                table: "requests",
                ..
            })
        ),
        "{again:?}"
    );
    assert_eq!(catalog.read(|r| r.request("c", "1"))?, Some(row(1, now)));
    assert_eq!(catalog.read(|r| r.request("d", "1"))?, None);
    // The clock jumps ten years ahead, then a day back: nothing is deleted.
    for jump in [now + 3_650 * DAY, now - DAY] {
        assert_eq!(catalog.write(|tx| tx.purge_requests(jump, 0))?, 0);
        now = jump;
    }
    for _ in 0..24 {
        now += 3_600;
        assert_eq!(catalog.write(|tx| tx.purge_requests(now, 0))?, 0);
    }
    now += 3_600;
    assert_eq!(catalog.write(|tx| tx.purge_requests(now, 0))?, 1);
    Ok(())
}
