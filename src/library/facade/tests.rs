//! After random operations the collection in memory is the one that is stored.
//!
//! `COSEG_TEST_OPERATIONS` and `COSEG_TEST_SEED` make the test longer and other; it prints the
//! seed.

use super::{Collection, Library};
use crate::library::error::{LibraryError, Result};
use crate::library::reason::Reason;
use crate::library::types::{CollectionSpec, ItemState, NewShape, Up};
use crate::library::{Correction, LabelId, LinkKind, PartName};
use crate::mesh::write::off;
use crate::mesh::{Format, parse};
use crate::pipeline::{Description, Params, describe};
use crate::synth::{Family, Options, family};
use rand::{Rng as _, SeedableRng as _};
use rand_pcg::Pcg64Mcg;
use std::collections::BTreeMap;
use std::sync::PoisonError;

const COLLECTION: &str = "tiny";
/// Most shapes at a time.
const MAX_SHAPES: usize = 9;

/// A mesh of few faces and its description.
struct Tiny {
    bytes: Vec<u8>,
    description: Description,
}

fn tiny_shapes() -> Vec<Tiny> {
    let options = Options {
        n_faces: 220,
        rotate: false,
    };
    let params = Params {
        working_faces: 90,
        n_eigenpairs: 12,
        ..Params::default()
    };
    let shapes = family(Family::Pliers, 3, 14, &options);
    let tiny = shapes.iter().map(|shape| {
        let bytes = off(&shape.mesh).into_bytes();
        let description = describe(&bytes, Format::Off, &params, &|_| true).expect("describes");
        Tiny { bytes, description }
    });
    tiny.collect()
}

fn number(variable: &str, default: u64) -> u64 {
    let text = std::env::var(variable).ok();
    text.map_or(default, |t| t.parse().expect("a number"))
}

/// Adds a shape without describing it again.
fn add(library: &Library, name: &str, tiny: &Tiny, replace: bool) -> Result<ItemState> {
    let shape = NewShape {
        name: name.to_owned(),
        bytes: tiny.bytes.clone(),
        format: Format::Off,
        replace,
    };
    let job = library.submit(COLLECTION, &library.store_originals(vec![shape])?, None)?;
    let item = &job.items[0];
    let described = library.describe_item_by(item, &|_| true, &|_, _| Ok(tiny.description.clone()));
    library.place_item(item, described)
}

/// Compares the collection in memory, if there is one, with the one in the catalog.
fn is_as_stored(library: &Library, context: &str) -> bool {
    let row = library.collection_row(COLLECTION).expect("there");
    let slot = library.slot(row.id);
    let slot = slot.lock().unwrap_or_else(PoisonError::into_inner);
    let Some(in_memory) = slot.as_ref() else {
        return false;
    };
    let catalog = library.store.catalog();
    let stored = catalog.read(|r| Collection::load(r, row)).expect("loads");
    assert_eq!(in_memory.row(), stored.row(), "{context}");
    assert_eq!(in_memory.state(), stored.state(), "{context}");
    let shapes = |c: &Collection| -> Vec<_> {
        let shapes = c.shapes().iter();
        shapes
            .map(|s| (s.id, s.ordinal, s.stale, s.pinned))
            .collect()
    };
    assert_eq!(shapes(in_memory), shapes(&stored), "{context}");
    assert!(
        in_memory.model() == stored.model(),
        "the models differ: {context}"
    );
    assert!(*in_memory == stored, "{context}");
    true
}

struct Random {
    random: Pcg64Mcg,
    tiny: Vec<Tiny>,
    n_added: u64,
}

impl Random {
    fn below(&mut self, n: usize) -> usize {
        self.random.random_range(0..n.max(1))
    }

    fn label(&mut self, library: &Library) -> Result<LabelId> {
        let labels = library.collection(COLLECTION)?.labels;
        let in_use: Vec<LabelId> = labels
            .iter()
            .filter(|l| l.merged_into.is_none())
            .map(|l| l.id)
            .collect();
        let at = self.below(in_use.len());
        Ok(in_use.get(at).copied().unwrap_or(0))
    }

    /// Does something to the collection; its name.
    fn operate(&mut self, library: &Library) -> (&'static str, Result<()>) {
        let shapes = library.shapes(COLLECTION, 0, 100, None).expect("listed");
        let names: Vec<String> = shapes.into_iter().map(|s| s.name).collect();
        let some = self.below(names.len());
        let name = names.get(some).cloned().unwrap_or_default();
        let tiny = self.below(self.tiny.len());
        match self.below(100) {
            0..22 if names.len() < MAX_SHAPES => {
                self.n_added += 1;
                let name = format!("s{}", self.n_added);
                let state = add(library, &name, &self.tiny[tiny], false);
                (
                    "add",
                    state.map(|s| assert!(matches!(s, ItemState::Done(_)), "{s:?}")),
                )
            }
            0..22 => ("remove", library.remove(COLLECTION, &name, None)),
            22..30 if !names.is_empty() => {
                let state = add(library, &name, &self.tiny[tiny], true);
                (
                    "replace",
                    state.map(|s| assert!(matches!(s, ItemState::Done(_)), "{s:?}")),
                )
            }
            30..38 => ("remove", library.remove(COLLECTION, &name, None)),
            38..50 => ("correct", self.correct(library, &name)),
            50..55 => {
                let (label, into) = (self.label(library), self.label(library));
                let merged = label.and_then(|label| {
                    library
                        .merge_labels(COLLECTION, label, into?, None)
                        .map(|_| ())
                });
                ("merge", merged)
            }
            55..59 => {
                let label = self.label(library);
                let split = label.and_then(|l| library.split_label(COLLECTION, l, None));
                ("split", split.map(|_| ()))
            }
            59..63 => {
                let text = format!("part {}", self.below(50));
                let label = self.label(library);
                let named = label.and_then(|l| library.name_label(COLLECTION, l, &text, None));
                ("name", named.map(|_| ()))
            }
            63..75 => ("undo", library.undo(COLLECTION, None).map(|_| ())),
            75..78 => {
                let up = [Up::PlusY, Up::PlusX, Up::Unknown, Up::Auto][self.below(4)];
                ("up", library.set_up(COLLECTION, up, None).map(|_| ()))
            }
            80..84 => ("link", self.link(library, &names)),
            84..86 => ("unlink", self.unlink(library)),
            78..80 => ("mend", library.mend_maps(COLLECTION).map(|_| ())),
            _ => (
                "relabel",
                library.relabel_next(Some(COLLECTION)).map(|_| ()),
            ),
        }
    }

    fn link(&mut self, library: &Library, names: &[String]) -> Result<()> {
        let mut part = || PartName {
            shape: names
                .get(self.below(names.len()))
                .cloned()
                .unwrap_or_default(),
            part: self.below(3) as u32,
        };
        let parts = [part(), part()];
        let kind = [LinkKind::Same, LinkKind::Differ][self.below(2)];
        let linked = library.link_parts(COLLECTION, kind, &parts, "", None);
        linked.map(|_| ())
    }

    fn unlink(&mut self, library: &Library) -> Result<()> {
        let links = library.links(COLLECTION, None)?;
        let at = self.below(links.len());
        let id = links.get(at).map_or(0, |l| l.id);
        library.unlink_parts(COLLECTION, id, None).map(|_| ())
    }

    fn correct(&mut self, library: &Library, name: &str) -> Result<()> {
        let n = library.shape(COLLECTION, name)?.n_polygons as usize;
        let label = self.below(6) as LabelId;
        let correction = match self.below(4) {
            0 => {
                let labels = 1 + self.below(4);
                Correction::Whole((0..n).map(|f| (f * labels / n) as i32).collect())
            }
            1 => Correction::Part {
                part: self.below(2) as u32,
                label,
            },
            _ => Correction::Faces {
                faces: (0..n as u32).filter(|f| f % 3 == 0).collect(),
                label,
            },
        };
        library
            .correct(COLLECTION, name, &correction, None)
            .map(|_| ())
    }
}

#[test]
fn the_collection_in_memory_is_the_stored_one_after_every_operation() {
    let seed = number("COSEG_TEST_SEED", 1);
    let n_operations = number("COSEG_TEST_OPERATIONS", 2_000);
    println!("{n_operations} operations, COSEG_TEST_SEED={seed}");
    let folder = tempfile::tempdir().expect("a folder");
    let library = Library::open(folder.path()).expect("opens");
    let spec = CollectionSpec {
        name: COLLECTION.into(),
        n_parts: Some(3),
        ..CollectionSpec::default()
    };
    library.create_collection(&spec, None).expect("created");
    let mut random = Random {
        random: Pcg64Mcg::seed_from_u64(seed),
        tiny: tiny_shapes(),
        n_added: 0,
    };
    let mut done: BTreeMap<&str, [u64; 2]> = BTreeMap::new();
    let mut n_compared = 0;
    for step in 0..n_operations {
        let (what, result) = random.operate(&library);
        let context = format!("seed {seed}, operation {step}, {what}: {result:?}");
        match &result {
            Err(LibraryError::Store(e)) => panic!("{context}: {e}"),
            result => done.entry(what).or_default()[usize::from(result.is_err())] += 1,
        }
        n_compared += u64::from(is_as_stored(&library, &context));
    }
    println!("{n_compared} compared; done and refused: {done:?}");
    assert!(n_compared > n_operations / 2, "{n_compared} were compared");
    let kinds = [
        "add", "replace", "remove", "correct", "merge", "split", "name", "undo", "up", "relabel",
        "link", "unlink",
    ];
    for kind in kinds {
        assert!(
            done.get(kind).is_some_and(|n| n[0] > 0),
            "no {kind} was done: {done:?}"
        );
    }
    drop(library);
    let findings = Library::check(folder.path()).expect("checked");
    assert!(findings.is_empty(), "{findings:?}");
}

/// A collection that is deleted while something uses it is no fault of the store.
#[test]
fn what_uses_a_deleted_collection_is_told_so() {
    let folder = tempfile::tempdir().expect("a folder");
    let library = Library::open(folder.path()).expect("opens");
    let spec = CollectionSpec {
        name: COLLECTION.into(),
        n_parts: Some(2),
        ..CollectionSpec::default()
    };
    library.create_collection(&spec, None).expect("created");
    let tiny = &tiny_shapes()[0];
    add(&library, "a", tiny, false).expect("added");
    let parsed = parse(&tiny.bytes, Format::Off).expect("parses");
    let shape = library.shape(COLLECTION, "a").expect("there");
    assert_eq!(shape.n_polygons as usize, parsed.n_polygons);

    let outcome = |work: &dyn Fn(&mut Collection) -> Result<()>| {
        let row = library.collection_row(COLLECTION).expect("there");
        let error = library.with_collection(row, |collection| {
            library.delete_collection(COLLECTION, None)?;
            work(collection)
        });
        library
            .create_collection(&spec, None)
            .expect("created again");
        add(&library, "a", tiny, false).expect("added again");
        error.expect_err("it is gone")
    };
    let writes = outcome(&|collection| {
        let change = crate::library::change::Change::default();
        crate::library::change::commit(&library.store, collection, change, |_, _| Ok(()))
    });
    let reads = outcome(&|collection| {
        let id = collection.shapes()[0].id;
        crate::library::sources::Sources::known(&library.store, id).map(|_| ())
    });
    for error in [writes, reads] {
        let LibraryError::FailedPrecondition { reason, message } = error else {
            panic!("{error:?}");
        };
        assert_eq!(reason, Reason::Gone);
        assert_eq!(message, "collection \"tiny\" was deleted meanwhile");
    }
}

/// Before the first shape there is no model to go back to.
#[test]
fn an_up_axis_of_an_empty_collection_is_undone_after_shapes_came() {
    let folder = tempfile::tempdir().expect("a folder");
    let library = Library::open(folder.path()).expect("opens");
    let spec = CollectionSpec {
        name: COLLECTION.into(),
        n_parts: Some(2),
        ..CollectionSpec::default()
    };
    library.create_collection(&spec, None).expect("created");
    library.set_up(COLLECTION, Up::PlusY, None).expect("set");
    let tiny = tiny_shapes();
    for (name, tiny) in ["a", "b"].iter().zip(&tiny) {
        add(&library, name, tiny, false).expect("added");
    }
    let undone = library.undo(COLLECTION, None).expect("undone");
    assert_eq!(undone.change, "up");
    while library.relabel_next(Some(COLLECTION)).expect("relabelled") {}
    let info = library.collection(COLLECTION).expect("there");
    assert_eq!(
        (info.spec.up, info.n_shapes, info.n_stale),
        (Up::Unknown, 2, 0)
    );
    add(&library, "c", &tiny[2], false).expect("added");
    assert!(is_as_stored(&library, "after it"));
}
