//! Tests the catalog: every row reads back, and transactions are atomic.

use super::{
    add_shape, collection_id, description, label_version, new_collection, opened, summary,
};
use coseg::store::catalog::KEPT_LABEL_VERSIONS;
use coseg::store::rows::{
    LabelRow, MapRow, NewJobItem, ObjectKind, confidence_from_u8, confidence_to_u8,
};
use coseg::store::{Digest, Store, StoreError};

type Result<T> = std::result::Result<T, StoreError>;

#[test]
fn a_shape_reads_back_after_reopening() -> Result<()> {
    let (_dir, store) = opened();
    let library_id = store.catalog().read(|r| r.library_id())?;
    let first = add_shape(&store, "chairs", "one", 1)?;
    let second = add_shape(&store, "chairs", "two", 2)?;
    let dir = store.dir().to_path_buf();
    drop(store);
    let store = Store::open(&dir)?;
    store.catalog().read(|r| -> Result<()> {
        assert_eq!(r.library_id()?, library_id);
        let collection = r.collection("chairs")?.expect("there");
        assert_eq!(r.collections()?, std::slice::from_ref(&collection));
        assert_eq!(
            r.collection_by_id(collection.id)?.as_ref(),
            Some(&collection)
        );
        assert_eq!(
            (
                collection.n_parts,
                collection.up.as_str(),
                collection.operator.as_str()
            ),
            (Some(3), "+y", "tufted")
        );
        assert_eq!((collection.sequence, collection.next_ordinal), (3, 3));
        assert_eq!(
            (collection.next_label, collection.state.as_slice()),
            (3, &b"state"[..])
        );
        assert_eq!(r.model(collection.id)?.as_deref(), Some(&[7; 1000][..]));
        let shape = r.shape_by_name(collection.id, "two")?.expect("there");
        assert_eq!(r.shape(second)?.as_ref(), Some(&shape));
        let expected = description(22, 2);
        assert_eq!((shape.ordinal, shape.version, shape.stale), (2, 1, false));
        assert_eq!(shape.n_polygons, expected.face_map.len() as u64);
        assert_eq!(shape.area, expected.area);
        assert_eq!(shape.format, "off");
        assert_eq!(
            r.signature(second)?.as_deref(),
            Some(&expected.signature[..])
        );
        let labels = label_version(&expected, 1, 3);
        assert_eq!(r.newest_labels(second)?.as_ref(), Some(&labels));
        assert_eq!(r.labels_at(second, 1)?, Some(labels));
        assert_eq!(r.labels_at(second, 2)?, None);
        assert_eq!(r.area_shares(second)?, [(0, 0.5), (2, 0.5)]);
        assert_eq!(r.stats(second)?, Some((0, 2_u32.to_le_bytes().to_vec())));
        let map = r.map(first, second)?.expect("kept");
        assert_eq!((map.k1, map.k2, map.p2p_21.len()), (2, 3, 22));
        assert_eq!(r.maps_into(second)?, [map]);
        assert_eq!(r.mapped_from(first)?, [second]);
        let refs = r.descriptions(collection.id)?;
        assert_eq!(
            refs.iter().map(|d| d.name.as_str()).collect::<Vec<_>>(),
            ["one", "two"]
        );
        let mapped = store.objects().open_description(&refs[1].object)?;
        assert_eq!(mapped.to_description(), expected);
        let original = r
            .object(ObjectKind::Original, &shape.content_digest)?
            .expect("there");
        assert_eq!(store.objects().original(&original)?, b"OFF chairs two 2");
        let mut seen = Vec::new();
        r.each_signature(collection.id, |shape, signature| {
            seen.push((shape, signature.len()))
        })?;
        assert_eq!(seen, [(first, 11), (second, 11)]);
        let mut seen = Vec::new();
        r.each_stats(collection.id, |shape, epoch, stats| {
            seen.push((shape, epoch, stats[0]))
        })?;
        assert_eq!(seen, [(first, 0, 1), (second, 0, 2)]);
        let events = r.events_since("chairs", 1, 10)?;
        assert_eq!(
            events.iter().map(|e| e.sequence).collect::<Vec<_>>(),
            [2, 3]
        );
        assert_eq!(events[1].payload_json, r#"{"shape":"two"}"#);
        let totals = r.totals()?;
        assert_eq!(
            (totals.n_collections, totals.n_shapes, totals.n_queued),
            (1, 2, 2)
        );
        assert!(totals.object_bytes > 0 && totals.catalog_bytes > 0);
        Ok(())
    })
}

#[test]
fn shapes_come_in_pages_and_by_label() -> Result<()> {
    let (_dir, store) = opened();
    for seed in 0..7 {
        add_shape(&store, "chairs", &format!("s{seed}"), seed)?;
    }
    add_shape(&store, "other", "s0", 0)?;
    let id = collection_id(&store, "chairs");
    let names = |after, limit, label| {
        let shapes = store.catalog().read(|r| r.shapes(id, after, limit, label));
        shapes
            .expect("readable")
            .into_iter()
            .map(|shape| shape.name)
            .collect::<Vec<_>>()
    };
    assert_eq!(names(0, 3, None), ["s0", "s1", "s2"]);
    assert_eq!(names(3, 100, None), ["s3", "s4", "s5", "s6"]);
    assert_eq!(names(0, 100, Some(1)), ["s1", "s4"]);
    assert_eq!(names(2, 1, Some(1)), ["s4"]);
    assert_eq!(names(u64::MAX, usize::MAX, None), [""; 0]);
    assert_eq!(names(0, usize::MAX, Some(9)), [""; 0]);
    Ok(())
}

#[test]
fn stale_shapes_come_in_order_of_arrival() -> Result<()> {
    let (_dir, store) = opened();
    let shapes: Vec<_> = (0..4)
        .map(|seed| add_shape(&store, "chairs", &format!("s{seed}"), seed))
        .collect::<Result<_>>()?;
    let id = collection_id(&store, "chairs");
    store.catalog().write(|tx| -> Result<()> {
        tx.set_epoch(id, 1)?;
        tx.put_labels(
            shapes[1],
            &label_version(&description(21, 1), 2, 6),
            &summary(1, &[2]),
        )?;
        assert_eq!(tx.mark_stale_before(id, 1)?, 3);
        assert_eq!(tx.mark_stale_before(id, 1)?, 0);
        tx.set_stale(shapes[0], false)?;
        Ok(())
    })?;
    let next = |id| {
        store
            .catalog()
            .read(|r| r.next_stale(id))
            .expect("readable")
    };
    assert_eq!(next(Some(id)).expect("stale").id, shapes[2]);
    assert_eq!(next(None).expect("stale").id, shapes[2]);
    assert_eq!(store.catalog().read(|r| r.n_stale(id))?, 2);
    let newest = label_version(&description(22, 2), 2, 7);
    store
        .catalog()
        .write(|tx| tx.put_labels(shapes[2], &newest, &summary(1, &[0])))?;
    assert_eq!(next(Some(id)).expect("stale").id, shapes[3]);
    let row = store
        .catalog()
        .read(|r| r.shape(shapes[2]))?
        .expect("there");
    assert_eq!((row.version, row.label_epoch, row.stale), (2, 1, false));
    Ok(())
}

#[test]
fn the_newest_versions_of_labels_are_kept() -> Result<()> {
    let (_dir, store) = opened();
    let shape = add_shape(&store, "chairs", "one", 0)?;
    let last = KEPT_LABEL_VERSIONS + 9;
    for version in 2..=last {
        let labels = label_version(&description(20, 0), version, version);
        store
            .catalog()
            .write(|tx| tx.put_labels(shape, &labels, &summary(0, &[0])))?;
    }
    let kept = store.catalog().read(|r| r.kept_versions(shape))?;
    assert_eq!(kept, (10..=last).collect::<Vec<_>>());
    Ok(())
}

#[test]
fn labels_that_do_not_fit_the_shape_are_refused() -> Result<()> {
    let (_dir, store) = opened();
    let shape = add_shape(&store, "chairs", "one", 0)?;
    let good = label_version(&description(20, 0), 2, 3);
    let refused = |change: &dyn Fn(&mut coseg::store::rows::LabelVersionRow)| {
        let mut labels = good.clone();
        change(&mut labels);
        let put = store
            .catalog()
            .write(|tx| tx.put_labels(shape, &labels, &summary(0, &[])));
        assert!(matches!(put, Err(StoreError::Must { .. })), "{put:?}");
    };
    refused(&|labels| labels.version = 1);
    refused(&|labels| labels.version = 3);
    refused(&|labels| labels.polygon_labels.truncate(5));
    refused(&|labels| labels.polygon_confidence.push(1));
    refused(&|labels| labels.proxy_labels.push(1));
    store
        .catalog()
        .write(|tx| tx.put_labels(shape, &good, &summary(0, &[])))
}

#[test]
fn deleting_takes_what_belongs_to_it_and_nothing_else() -> Result<()> {
    let (_dir, store) = opened();
    let shapes: Vec<_> = (0..3)
        .map(|seed| add_shape(&store, "chairs", &format!("s{seed}"), seed))
        .collect::<Result<_>>()?;
    add_shape(&store, "other", "s0", 0)?;
    store.catalog().write(|tx| tx.delete_shape(shapes[1]))?;
    store.catalog().read(|r| -> Result<()> {
        assert_eq!(r.shape(shapes[1])?, None);
        assert_eq!(r.newest_labels(shapes[1])?, None);
        assert_eq!(r.stats(shapes[1])?, None);
        assert_eq!(
            (r.map(shapes[0], shapes[1])?, r.map(shapes[1], shapes[2])?),
            (None, None)
        );
        Ok(())
    })?;
    let gone = store.catalog().write(|tx| tx.delete_shape(shapes[1]));
    assert!(
        matches!(
            gone,
            Err(StoreError::Missing {
                table: "shapes",
                ..
            })
        ),
        "{gone:?}"
    );
    let id = collection_id(&store, "chairs");
    store.catalog().write(|tx| tx.delete_collection(id))?;
    store.catalog().read(|r| -> Result<()> {
        assert_eq!(r.collection("chairs")?, None);
        assert_eq!((r.totals()?.n_shapes, r.model(id)?), (1, None));
        assert_eq!(r.labels(id)?, []);
        Ok(())
    })
}

/// Tests the rule for reused names: their events continue where they stopped.
#[test]
fn the_log_of_a_name_outlives_its_collection() -> Result<()> {
    let (_dir, store) = opened();
    let first = store.catalog().write(|tx| -> Result<_> {
        let id = tx.insert_collection(&new_collection("a"))?;
        assert_eq!(tx.append_event(id, "CollectionCreated", "{}")?, 1);
        assert_eq!(tx.append_event(id, "Deleted", "{}")?, 2);
        tx.delete_collection(id)?;
        Ok(id)
    })?;
    let events = store.catalog().read(|r| r.events_since("a", 0, 9))?;
    assert_eq!(events.len(), 2);
    let second = store.catalog().write(|tx| -> Result<_> {
        let id = tx.insert_collection(&new_collection("a"))?;
        assert_eq!(tx.append_event(id, "CollectionCreated", "{}")?, 3);
        assert_eq!((tx.take_ordinal(id)?, tx.take_ordinal(id)?), (1, 2));
        assert_eq!((tx.take_labels(id, 3)?, tx.take_labels(id, 1)?), (0, 3));
        Ok(id)
    })?;
    assert_ne!(first, second);
    let row = store.catalog().read(|r| r.collection("a"))?.expect("there");
    assert_eq!((row.sequence, row.next_ordinal, row.next_label), (3, 3, 4));
    assert_eq!(
        store.catalog().read(|r| r.events_since("a", 0, 2))?.len(),
        2
    );
    assert_eq!(store.catalog().read(|r| r.sequence("never"))?, 0);
    let unknown = store
        .catalog()
        .write(|tx| tx.append_event(first, "x", "{}"));
    assert!(
        matches!(unknown, Err(StoreError::Missing { .. })),
        "{unknown:?}"
    );
    Ok(())
}

#[test]
fn a_failed_change_leaves_no_trace() -> Result<()> {
    let (_dir, store) = opened();
    add_shape(&store, "chairs", "one", 1)?;
    let before = store
        .catalog()
        .read(|r| Ok::<_, StoreError>((r.totals()?, r.sequence("chairs")?)))?;
    let id = collection_id(&store, "chairs");
    let taken = add_shape(&store, "chairs", "one", 2);
    assert!(
        matches!(
            taken,
            Err(StoreError::Exists {
                table: "shapes",
                ..
            })
        ),
        "{taken:?}"
    );
    let failed: std::result::Result<(), StoreError> = store.catalog().write(|tx| {
        tx.append_event(id, "x", "{}")?;
        tx.take_ordinal(id)?;
        tx.insert_collection(&new_collection("chairs")).map(drop)
    });
    assert!(
        matches!(
            failed,
            Err(StoreError::Exists {
                table: "collections",
                ..
            })
        ),
        "{failed:?}"
    );
    let panicked = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
        store.catalog().write(|tx| -> Result<()> {
            tx.append_event(id, "x", "{}")?;
            panic!("in the middle of a change");
        })
    }));
    assert!(panicked.is_err());
    let after = store
        .catalog()
        .read(|r| Ok::<_, StoreError>((r.totals()?, r.sequence("chairs")?)))?;
    assert_eq!(before, after);
    add_shape(&store, "chairs", "two", 2).map(drop)
}

#[test]
fn rows_need_what_they_refer_to() -> Result<()> {
    let (_dir, store) = opened();
    let shape = add_shape(&store, "chairs", "one", 1)?;
    let absent = Digest::of(b"absent");
    let item = |original_digest| NewJobItem {
        name: "x".into(),
        original_digest,
        format: "off".into(),
        replace: false,
    };
    let job = store
        .catalog()
        .write(|tx| tx.insert_job("chairs", 0, &[item(absent)]));
    assert!(
        matches!(
            job,
            Err(StoreError::Missing {
                table: "objects",
                ..
            })
        ),
        "{job:?}"
    );
    let map = MapRow {
        from: shape,
        to: coseg::store::rows::ShapeId(77),
        k1: 1,
        k2: 1,
        c_12: vec![1.0],
        p2p_21: vec![],
        confidence: vec![],
        quality_json: "{}".into(),
    };
    let put = store.catalog().write(|tx| tx.put_map(&map));
    assert!(
        matches!(put, Err(StoreError::Dangling { table: "maps", .. })),
        "{put:?}"
    );
    let put = store.catalog().write(|tx| {
        tx.put_map(&MapRow {
            k2: 2,
            to: shape,
            ..map
        })
    });
    assert!(matches!(put, Err(StoreError::Must { .. })), "{put:?}");
    Ok(())
}

#[test]
fn labels_have_names_colours_and_successors() -> Result<()> {
    let (_dir, store) = opened();
    add_shape(&store, "chairs", "one", 1)?;
    let id = collection_id(&store, "chairs");
    let named = LabelRow {
        id: 1,
        name: Some("leg".into()),
        colour: [255, 0, 7],
        merged_into: None,
    };
    let merged = LabelRow {
        id: 2,
        name: None,
        colour: [0, 0, 0],
        merged_into: Some(1),
    };
    store.catalog().write(|tx| -> Result<()> {
        tx.put_label(id, &named)?;
        tx.put_label(id, &merged)
    })?;
    assert_eq!(
        store.catalog().read(|r| r.labels(id))?[1..],
        [named, merged]
    );
    Ok(())
}

#[test]
fn confidence_keeps_its_ends() {
    for (probability, stored) in [
        (0.0, 0),
        (1.0, 255),
        (0.5, 128),
        (-3.0, 0),
        (9.0, 255),
        (f32::NAN, 0),
    ] {
        assert_eq!(confidence_to_u8(probability), stored);
    }
    assert!((0..=255).all(|stored| confidence_to_u8(confidence_from_u8(stored)) == stored));
}
