//! Times the stages of the pipeline: `cargo bench -p coseg --bench stages`, with a word after `--`
//! to run only those whose names contain it. One thread, except where a stage uses rayon's pool
//! itself; the shapes are generated here.

use coseg::Library;
use coseg::labels::{DiscoveryOptions, LabelModel, Links};
use coseg::library::{CollectionSpec, Correction, MAX_BATCH, NewShape};
use coseg::mesh::{Format, write};
use coseg::pipeline::{
    Description, Params, Prepared, ReclusterOptions, Reclustering, Representative, Vote, describe,
    label, map, recluster,
};
use coseg::synth::{Family, Options, family};
use divan::Bencher;

/// Number of labels of a chair: seat, back, legs, arms.
const N_LABELS: usize = 4;

fn main() {
    divan::main();
}

/// Files of chairs with `n_faces` faces each.
fn chairs(count: u32, n_faces: u32) -> Vec<String> {
    let options = Options {
        n_faces,
        ..Options::default()
    };
    let made = family(Family::Chair, 7, count, &options);
    made.iter().map(|s| write::off(&s.mesh)).collect()
}

fn described(file: &str) -> Description {
    let params = Params::default();
    describe(file.as_bytes(), Format::Off, &params, &|_| true).expect("a made chair")
}

/// A collection of chairs with discovered labels.
struct Collection {
    shapes: Vec<Description>,
    found: Reclustering,
}

impl Collection {
    fn new(count: u32) -> Self {
        let files = chairs(count, 5_000);
        let shapes: Vec<Description> = files.iter().map(|f| described(f)).collect();
        let representatives: Vec<_> = shapes.iter().map(|s| representative(s, &[])).collect();
        let found = recluster(&representatives, None, 0, &options(0));
        Self { shapes, found }
    }

    fn model(&self) -> &LabelModel {
        &self.found.model
    }

    /// Label ids of the faces of a shape.
    fn labels(&self, shape: usize) -> Vec<u32> {
        let classes = &self.found.labellings[shape].classes;
        let labels = &self.model().labels;
        classes.iter().map(|c| labels[*c as usize]).collect()
    }
}

fn representative<'a>(shape: &'a Description, labels: &'a [u32]) -> Representative<'a> {
    Representative {
        shape: shape.view(),
        labels,
    }
}

fn options(next_label: u32) -> ReclusterOptions {
    ReclusterOptions {
        discovery: DiscoveryOptions {
            n_labels: Some(N_LABELS),
            ..DiscoveryOptions::default()
        },
        up: None,
        min_gain: 0.0,
        next_label,
        links: Links::default(),
    }
}

/// Times the description from the bytes of a file, by the number of faces.
#[divan::bench(args = [5_000, 50_000], sample_count = 7, sample_size = 1)]
fn describe_a_file(bencher: Bencher<'_, '_>, n_faces: u32) {
    let file = chairs(1, n_faces).remove(0);
    bencher.bench_local(|| described(&file));
}

/// Labels a described chair by maps from four others: maps, votes and the cut.
#[divan::bench(sample_count = 7, sample_size = 1)]
fn place_a_shape(bencher: Bencher<'_, '_>) {
    let collection = Collection::new(5);
    let (shape, known) = collection.shapes.split_last().expect("five chairs");
    let view = shape.view();
    let prepare = |s: &Description| Prepared::new(&s.view(), collection.model());
    let known_prepared: Vec<Prepared> = known.iter().map(prepare).collect();
    bencher.bench_local(|| {
        let prepared = prepare(shape);
        let maps: Vec<_> = known
            .iter()
            .zip(&known_prepared)
            .map(|(k, p)| map((&k.view(), p), (&view, &prepared), &Default::default()))
            .collect();
        let votes: Vec<Vote<'_>> = (0..known.len())
            .map(|i| Vote {
                faces: &known[i].faces,
                probabilities: &collection.found.labellings[i].probabilities,
                p2p: &maps[i].p2p_21,
                confidence: &maps[i].confidence,
                trust: 1.0,
            })
            .collect();
        label(&view, &prepared, collection.model(), &votes)
    });
}

/// The cut alone: a shape is labelled by the label model, without maps.
#[divan::bench(sample_count = 20, sample_size = 1)]
fn label_without_maps(bencher: Bencher<'_, '_>) {
    let collection = Collection::new(5);
    let view = collection.shapes[0].view();
    let prepared = Prepared::new(&view, collection.model());
    bencher.bench_local(|| label(&view, &prepared, collection.model(), &[]));
}

/// Re-clusters the parts of eight chairs, and compares with their present labels.
#[divan::bench(sample_count = 3, sample_size = 1)]
fn recluster_eight(bencher: Bencher<'_, '_>) {
    let collection = Collection::new(8);
    let labels: Vec<Vec<u32>> = (0..8).map(|i| collection.labels(i)).collect();
    let shapes: Vec<_> = collection
        .shapes
        .iter()
        .zip(&labels)
        .map(|(s, l)| representative(s, l))
        .collect();
    bencher.bench_local(|| recluster(&shapes, Some(collection.model()), 1, &options(100)));
}

/// A correction of one of 60 chairs, and its propagation to the others, at 200 working faces: the
/// model is fitted to 40 of them, and the rest are relabelled, so many at a time.
#[divan::bench(args = [1, MAX_BATCH], sample_count = 5, sample_size = 1)]
fn propagate_a_correction(bencher: Bencher<'_, '_>, batch: usize) {
    let folder = tempfile::tempdir().expect("a folder");
    let library = Library::open(folder.path()).expect("a library");
    let spec = CollectionSpec {
        name: "chairs".to_owned(),
        n_parts: Some(N_LABELS as u32),
        working_faces: 200,
        ..CollectionSpec::default()
    };
    library.create_collection(&spec, None).expect("created");
    let options = Options {
        n_faces: 1_000,
        ..Options::default()
    };
    let made = family(Family::Chair, 7, 60, &options);
    for shape in &made {
        let file = NewShape {
            name: shape.name.clone(),
            bytes: write::off(&shape.mesh).into_bytes(),
            format: Format::Off,
            replace: false,
        };
        library.add("chairs", file).expect("added");
    }
    let truth = Correction::Whole(made[0].labels.iter().map(|l| *l as i32).collect());
    bencher.bench_local(|| {
        let corrected = library.correct("chairs", &made[0].name, &truth, None);
        corrected.expect("corrected");
        while library
            .relabel_batch(Some("chairs"), batch)
            .expect("relabelled")
            > 0
        {}
    });
}
