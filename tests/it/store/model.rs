//! Compares random operations and restarts with a model in memory: the answers of the store must
//! equal those of the model.
//!
//! `COSEG_TEST_OPERATIONS`, for each of `COSEG_TEST_ROUNDS` libraries, makes the test longer.
//! `COSEG_TEST_SEED`, which increases from library to library, makes it different; the seed is
//! printed.

use super::{add_shape, description, label_version, summary};
use crate::harness::{number, seed};
use coseg::store::check::check;
use coseg::store::rows::{ObjectKind, ShapeId};
use coseg::store::{Digest, Store, StoreError};
use rand::{Rng as _, SeedableRng as _};
use std::collections::BTreeMap;
use std::time::Duration;

/// The required state of a shape.
#[derive(Debug, Clone)]
struct Known {
    id: ShapeId,
    seed: u32,
    /// Sequence number that announced each version, version 1 first.
    versions: Vec<u64>,
}

#[derive(Debug, Default)]
struct Model {
    collections: BTreeMap<String, BTreeMap<String, Known>>,
    sequences: BTreeMap<String, u64>,
}

fn compare(store: &Store, model: &Model, whole: bool, context: &str) {
    let read = store.catalog().read(|r| {
        for (name, sequence) in &model.sequences {
            assert_eq!(r.sequence(name)?, *sequence, "{context}: log of {name}");
            // The newest events, and at the end all of them: a log only grows.
            let from = if whole {
                0
            } else {
                sequence.saturating_sub(200)
            };
            let events = r.events_since(name, from, usize::MAX)?;
            let numbers: Vec<u64> = events.iter().map(|e| e.sequence).collect();
            assert_eq!(
                numbers,
                (from + 1..=*sequence).collect::<Vec<_>>(),
                "{context}"
            );
        }
        let names: Vec<String> = r.collections()?.into_iter().map(|c| c.name).collect();
        assert_eq!(
            names,
            model.collections.keys().cloned().collect::<Vec<_>>(),
            "{context}"
        );
        for (name, shapes) in &model.collections {
            let id = r.collection(name)?.expect("there").id;
            let found = r.shapes(id, 0, usize::MAX, None)?;
            assert_eq!(found.len(), shapes.len(), "{context}: shapes of {name}");
            for row in found {
                let known = shapes.get(&row.name).expect("known");
                assert_eq!(
                    (row.id, row.version),
                    (known.id, known.versions.len() as u64)
                );
                let of = description(20 + known.seed as usize % 5, known.seed);
                let at = *known.versions.last().expect("has one");
                let mut expected = label_version(&of, row.version, at);
                expected.cause = if row.version == 1 { "added" } else { "changed" }.into();
                assert_eq!(
                    r.newest_labels(row.id)?,
                    Some(expected),
                    "{context}: {}",
                    row.name
                );
                let object = r.object(ObjectKind::Description, &row.description_digest)?;
                let mapped = store
                    .objects()
                    .open_description(&object.expect("catalogued"))?;
                assert_eq!(mapped.to_description(), of, "{context}: {}", row.name);
                let original = r.object(ObjectKind::Original, &row.content_digest)?;
                let bytes = store.objects().original(&original.expect("catalogued"))?;
                let sent = format!("OFF {name} {} {}", row.name, known.seed);
                assert_eq!(bytes, sent.into_bytes(), "{context}");
                assert_eq!(Digest::of(&bytes), row.content_digest);
            }
        }
        Ok::<_, StoreError>(())
    });
    read.unwrap_or_else(|e| panic!("{context}: {e}"));
}

#[test]
fn random_operations_agree_with_a_model_across_restarts() {
    let n_operations = number("COSEG_TEST_OPERATIONS", 3_000);
    let first = seed();
    for seed in first..first + number("COSEG_TEST_ROUNDS", 1) {
        agree(n_operations, seed);
    }
}

/// Tests one library, starting empty.
fn agree(n_operations: u64, seed: u64) {
    println!("{n_operations} operations, COSEG_TEST_SEED={seed}");
    let mut random = rand_pcg::Pcg64Mcg::seed_from_u64(seed);
    let dir = tempfile::tempdir().expect("a folder");
    let mut store = Store::open(dir.path()).expect("opens");
    let mut model = Model::default();
    let (mut n_restarts, mut n_shapes) = (0, 0_u32);
    for step in 0..n_operations {
        let collection = ["chairs", "tables", "lamps"][random.random_range(0..3)].to_owned();
        let shapes = model.collections.get(&collection);
        let pick = |random: &mut rand_pcg::Pcg64Mcg| {
            let shapes = shapes.filter(|s| !s.is_empty())?;
            let at = random.random_range(0..shapes.len());
            shapes.iter().nth(at).map(|(n, k)| (n.clone(), k.clone()))
        };
        let context = format!("seed {seed}, operation {step}");
        match random.random_range(0..100) {
            0..45 => {
                n_shapes += 1;
                // Every tenth time an existing name, if there is one.
                let taken = pick(&mut random).filter(|_| n_shapes % 10 == 0);
                let known = taken.is_some();
                let name = taken.map_or_else(|| format!("s{n_shapes}"), |(name, _)| name);
                let new = !model.collections.contains_key(&collection);
                match add_shape(&store, &collection, &name, n_shapes) {
                    // A name that exists leaves no trace, not even an event.
                    Err(StoreError::Exists { .. }) if known => continue,
                    Ok(id) if !known => {
                        let sequence = model.sequences.entry(collection.clone()).or_default();
                        *sequence += 1 + u64::from(new);
                        let versions = vec![*sequence];
                        let seed = n_shapes;
                        let known = Known { id, seed, versions };
                        model
                            .collections
                            .entry(collection)
                            .or_default()
                            .insert(name, known);
                    }
                    other => panic!("{context}: {name} known {known}: {other:?}"),
                }
            }
            45..70 => {
                let Some((name, known)) = pick(&mut random) else {
                    continue;
                };
                let of = description(20 + known.seed as usize % 5, known.seed);
                let version = known.versions.len() as u64 + 1;
                let sequence = store.catalog().write(|tx| {
                    let id = tx.collection(&collection)?.expect("there").id;
                    let sequence = tx.append_event(id, "LabelsChanged", "{}")?;
                    let mut row = label_version(&of, version, sequence);
                    row.cause = "changed".into();
                    tx.put_labels(known.id, &row, &summary(0, &[0]))?;
                    Ok::<_, StoreError>(sequence)
                });
                let sequence = sequence.unwrap_or_else(|e| panic!("{context}: {e}"));
                *model.sequences.get_mut(&collection).expect("there") = sequence;
                let shapes = model.collections.get_mut(&collection).expect("there");
                shapes
                    .get_mut(&name)
                    .expect("there")
                    .versions
                    .push(sequence);
            }
            70..82 => {
                let Some((name, known)) = pick(&mut random) else {
                    continue;
                };
                let sequence = store.catalog().write(|tx| {
                    let id = tx.collection(&collection)?.expect("there").id;
                    tx.delete_shape(known.id)?;
                    tx.append_event(id, "ShapeRemoved", "{}")
                });
                *model.sequences.get_mut(&collection).expect("there") = sequence.expect("removed");
                model
                    .collections
                    .get_mut(&collection)
                    .expect("there")
                    .remove(&name);
            }
            82..85 => {
                if model.collections.remove(&collection).is_none() {
                    continue;
                }
                let sequence = store.catalog().write(|tx| {
                    let id = tx.collection(&collection)?.expect("there").id;
                    let sequence = tx.append_event(id, "CollectionDeleted", "{}")?;
                    tx.delete_collection(id)?;
                    Ok::<_, StoreError>(sequence)
                });
                *model.sequences.get_mut(&collection).expect("there") = sequence.expect("deleted");
            }
            85..90 => {
                // A change that fails half-way.
                let failed = store.catalog().write(|tx| {
                    if let Some(row) = tx.collection(&collection)? {
                        tx.append_event(row.id, "Never", "{}")?;
                    }
                    Err::<(), _>(StoreError::Damaged {
                        path: String::new(),
                        message: String::new(),
                    })
                });
                assert!(failed.is_err());
            }
            90..94 => {
                store.sweep_orphans(Duration::ZERO).expect("swept");
            }
            94..97 => compare(&store, &model, false, &context),
            _ => {
                n_restarts += 1;
                drop(store);
                store = Store::open(dir.path()).unwrap_or_else(|e| panic!("{context}: {e}"));
            }
        }
    }
    compare(&store, &model, true, "at the end");
    drop(store);
    assert_eq!(
        check(dir.path())
            .expect("runs")
            .iter()
            .filter(|f| f.damage)
            .count(),
        0
    );
    println!("{n_shapes} additions, {n_restarts} restarts");
    assert!(n_restarts > 0 && n_shapes > 0);
}
