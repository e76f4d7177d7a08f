//! Streams meshes with known parts through a daemon's socket in some order, and runs the baselines
//! on them in process.

use crate::error::BenchError;
use crate::proposals::ProposalScores;
use crate::session::{COLLECTION, Session};
use bytes::Bytes;
use coseg::call;
use coseg::ipc::client::unexpected;
use coseg::ipc::convert::mesh_format;
use coseg::ipc::frames::FrameWriter;
use coseg::ipc::wire::{
    self, correct_labels_request::Correction, reply, request, shape_input::Source,
};
use coseg::labels::score::{Score, ScoreError, ScoredShape, accuracy_by_id, accuracy_open, score};
use coseg::labels::{Baseline, DiscoveryOptions, Links};
use coseg::library::Library;
use coseg::mesh::{self, Format, TriMesh};
use coseg::pipeline::{
    DescriptionView, Labelling, Prepared, ReclusterOptions, Representative, batch, label,
    recluster, yang_tian_baseline,
};
use rand::SeedableRng as _;
use rand::seq::SliceRandom as _;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Suffix of the file with the true labels, beside the mesh.
const TRUTH: &str = ".labels.txt";
/// The stages after the description of a shape.
const PLACING: [&str; 4] = ["store", "place", "recluster", "boundary"];
/// Maximum number of shapes that are labelled together in process, since the cost grows with the
/// square.
const MAX_TOGETHER: usize = 60;

/// Meshes of one kind, with their true labels.
pub(crate) struct Category {
    pub(crate) name: String,
    pub(crate) n_parts: usize,
    pub(crate) shapes: Vec<Known>,
}

/// One mesh.
pub(crate) struct Known {
    pub(crate) name: String,
    pub(crate) bytes: Bytes,
    pub(crate) format: wire::MeshFormat,
    pub(crate) mesh: TriMesh,
    pub(crate) truth: Vec<i32>,
}

/// The result of one order of arrival.
pub(crate) struct Run {
    pub(crate) accuracy: f64,
    pub(crate) purity: f64,
    pub(crate) rand_error: Option<f64>,
    pub(crate) n_labels: usize,
    pub(crate) n_missing: usize,
    pub(crate) seconds: f64,
    /// Time of placing each shape in milliseconds, in the order of arrival: everything after its
    /// description.
    pub(crate) place_ms: Vec<f64>,
    /// Accuracy of the other shapes, for each requested number of shapes labelled by hand.
    pub(crate) with_exemplars: Vec<WithExemplars>,
    /// The proposals, if they are asked for.
    pub(crate) proposals: Option<ProposalScores>,
    labels: Vec<Option<Vec<i32>>>,
}

/// Accuracy of shapes that nobody labelled, where others are labelled by hand.
#[derive(Debug, Clone, Copy)]
pub(crate) struct WithExemplars {
    /// Labels are compared by id; one that no person gave is wrong.
    pub(crate) strict: f64,
    /// Labels that no person gave stand for true labels that no person gave, one to one.
    pub(crate) open: f64,
}

fn failed(path: &Path, what: impl std::fmt::Display) -> BenchError {
    BenchError::Failed(format!("{}: {what}", path.display()))
}

fn names_in(dir: &Path) -> Result<Vec<PathBuf>, BenchError> {
    let entries = std::fs::read_dir(dir).map_err(|e| BenchError::file(dir, e))?;
    let mut paths = Vec::new();
    for entry in entries {
        paths.push(entry.map_err(|e| BenchError::file(dir, e))?.path());
    }
    paths.sort_by(|a, b| natord::compare(&a.to_string_lossy(), &b.to_string_lossy()));
    Ok(paths)
}

fn is_truth(path: &Path) -> bool {
    path.to_string_lossy().ends_with(TRUTH)
}

/// The categories below a folder, by name; the folder itself, if it contains labels.
pub(crate) fn categories(
    data: &Path,
    wanted: &[String],
    limit: Option<u32>,
) -> Result<Vec<Category>, BenchError> {
    let name_of = |dir: &Path| {
        let name = dir.file_name().map(|n| n.to_string_lossy().into_owned());
        name.unwrap_or_else(|| COLLECTION.to_owned())
    };
    let inside = names_in(data)?;
    let folders = if inside.iter().any(|p| is_truth(p)) {
        vec![data.to_path_buf()]
    } else {
        inside.into_iter().filter(|p| p.is_dir()).collect()
    };
    let mut found = Vec::new();
    for dir in folders {
        let name = name_of(&dir);
        if wanted.is_empty() || wanted.contains(&name) {
            let shapes = shapes(&dir, limit)?;
            let parts: BTreeSet<i32> = shapes.iter().flat_map(|s| s.truth.clone()).collect();
            if !shapes.is_empty() {
                found.push(Category {
                    name,
                    n_parts: parts.len(),
                    shapes,
                });
            }
        }
    }
    let missing = wanted.iter().find(|w| found.iter().all(|c| c.name != **w));
    match missing {
        Some(name) => {
            let text = format!(
                "{} has no category {name} with {TRUTH} files",
                data.display()
            );
            Err(BenchError::Usage(text))
        }
        None if found.is_empty() => {
            let text = format!("{} has no folders with {TRUTH} files", data.display());
            Err(BenchError::Usage(text))
        }
        None => Ok(found),
    }
}

fn shapes(dir: &Path, limit: Option<u32>) -> Result<Vec<Known>, BenchError> {
    let mut shapes = Vec::new();
    let limit = limit.map_or(usize::MAX, |n| n as usize);
    for path in names_in(dir)?.iter().filter(|p| is_truth(p)).take(limit) {
        let text = std::fs::read_to_string(path).map_err(|e| BenchError::file(path, e))?;
        let truth: Result<Vec<i32>, _> = text.split_whitespace().map(str::parse).collect();
        let truth = truth.map_err(|e| failed(path, e))?;
        let file = path.file_name().unwrap_or_default().to_string_lossy();
        let name = file.trim_end_matches(TRUTH).to_owned();
        let off = dir.join(format!("{name}.off"));
        let (mesh_path, format) = if off.exists() {
            (off, Format::Off)
        } else {
            (dir.join(format!("{name}.obj")), Format::Obj)
        };
        let bytes = std::fs::read(&mesh_path).map_err(|e| BenchError::file(&mesh_path, e))?;
        let parsed = mesh::parse(&bytes, format).map_err(|e| failed(&mesh_path, e))?;
        if parsed.triangles.len() != parsed.n_polygons {
            let n = parsed.n_polygons;
            return Err(failed(
                &mesh_path,
                format!("not all of its {n} faces are triangles"),
            ));
        }
        shapes.push(Known {
            name,
            bytes: bytes.into(),
            format: mesh_format(format),
            mesh: TriMesh {
                vertices: parsed.vertices,
                faces: parsed.triangles,
            },
            truth,
        });
    }
    Ok(shapes)
}

pub(crate) fn scored<'a>(
    category: &str,
    shapes: impl Iterator<Item = &'a Known>,
    labels: &'a [Option<Vec<i32>>],
) -> Result<Score, BenchError> {
    let shapes: Vec<ScoredShape<'_>> = shapes
        .zip(labels)
        .map(|(s, labels)| ScoredShape {
            mesh: &s.mesh,
            truth: &s.truth,
            predicted: labels.as_deref(),
        })
        .collect();
    score(&shapes).map_err(|e| BenchError::Failed(format!("{category}: {e}")))
}

/// The order of arrival: that of the names first, then shuffled ones.
fn arrival(n: usize, order: u32) -> Vec<usize> {
    let mut at: Vec<usize> = (0..n).collect();
    if order > 0 {
        at.shuffle(&mut rand_pcg::Pcg64::seed_from_u64(u64::from(order)));
    }
    at
}

/// Sends a category shape by shape, each when the previous one is labelled, and scores the final
/// labels.
pub(crate) fn stream(
    category: &Category,
    order: u32,
    n_parts: u32,
    up: wire::Up,
    session: &mut Session,
) -> Result<Run, BenchError> {
    let begin = Instant::now();
    let spec = wire::CollectionSpec {
        name: COLLECTION.to_owned(),
        n_parts: Some(n_parts),
        up: up.into(),
        ..wire::CollectionSpec::default()
    };
    let mut place_ms = Vec::with_capacity(category.shapes.len());
    for i in arrival(category.shapes.len(), order) {
        let shape = &category.shapes[i];
        let encoded = wire::EncodedMesh {
            format: shape.format.into(),
            bytes: Some(wire::BytesRef { frame: 0 }),
        };
        let body = request::Body::AddShapes(wire::AddShapesRequest {
            collection: COLLECTION.to_owned(),
            shapes: vec![wire::ShapeInput {
                name: shape.name.clone(),
                replace: false,
                source: Some(Source::Encoded(encoded)),
            }],
            mode: wire::AddMode::Job.into(),
            create: Some(spec.clone()),
        });
        let frames = [shape.bytes.clone()];
        let job_id = match session.client.call_patiently(&body, &frames)? {
            (reply::Result::AddShapes(reply), _) => reply.job_id,
            (other, _) => return Err(unexpected(&other).into()),
        };
        place_ms.extend(placing_ms(session.finished(job_id)?));
    }
    let labels = labels_now(category, session)?;
    let score = scored(&category.name, category.shapes.iter(), &labels)?;
    Ok(Run {
        accuracy: score.accuracy,
        purity: score.purity,
        rand_error: score.rand_error,
        n_labels: score.n_predicted_labels,
        n_missing: score.n_missing,
        seconds: begin.elapsed().as_secs_f64(),
        place_ms,
        with_exemplars: Vec::new(),
        proposals: None,
        labels,
    })
}

/// The labels of all shapes once no work is left; `None` for a missing shape.
pub(crate) fn labels_now(
    category: &Category,
    session: &mut Session,
) -> Result<Vec<Option<Vec<i32>>>, BenchError> {
    session.wait_until_idle()?;
    let there: BTreeSet<String> = session.shapes()?.into_iter().collect();
    let mut labels = Vec::new();
    for shape in &category.shapes {
        labels.push(if there.contains(&shape.name) {
            Some(session.labels(&shape.name)?)
        } else {
            None
        });
    }
    Ok(labels)
}

/// Labels the shapes that the daemon suggests, one by one, like a person, until `counts` shapes are
/// labelled. Returns for each count (ascending) the accuracy of the other shapes.
pub(crate) fn with_exemplars(
    category: &Category,
    counts: &[usize],
    session: &mut Session,
) -> Result<Vec<WithExemplars>, BenchError> {
    let mut labelled = BTreeSet::new();
    let mut accuracies = Vec::with_capacity(counts.len());
    for &count in counts {
        while labelled.len() < count {
            session.wait_until_idle()?;
            let collection = COLLECTION.to_owned();
            let suggested = call!(
                session.client,
                SuggestNext(wire::SuggestNextRequest { collection })
            )?;
            let at = category
                .shapes
                .iter()
                .position(|s| s.name == suggested.shape);
            let at = at.ok_or_else(|| {
                BenchError::Failed(format!("{:?} was suggested and not sent", suggested.shape))
            })?;
            let truth = &category.shapes[at].truth;
            let mut frames = FrameWriter::default();
            let labels = frames.i32_array(truth, &[truth.len()]);
            let request = wire::CorrectLabelsRequest {
                collection: COLLECTION.to_owned(),
                shape: suggested.shape,
                correction: Some(Correction::Labels(labels)),
                by: String::new(),
                closed: None,
            };
            let frames = frames.finish();
            call!(session.client, CorrectLabels(request), frames, with_frames)?;
            labelled.insert(at);
        }
        let labels = labels_now(category, session)?;
        let given = labelled.iter().flat_map(|at| &category.shapes[*at].truth);
        let given: BTreeSet<i32> = given.copied().collect();
        let others: Vec<ScoredShape<'_>> = category
            .shapes
            .iter()
            .zip(&labels)
            .enumerate()
            .filter(|(at, _)| !labelled.contains(at))
            .map(|(_, (s, labels))| ScoredShape {
                mesh: &s.mesh,
                truth: &s.truth,
                predicted: labels.as_deref(),
            })
            .collect();
        let failed = |e| BenchError::Failed(format!("{}: {e}", category.name));
        accuracies.push(WithExemplars {
            strict: strictly(&others, &given).map_err(failed)?,
            open: accuracy_open(&others, &given).map_err(failed)?,
        });
    }
    Ok(accuracies)
}

/// Accuracy by id, where a label that no person gave is wrong, whatever its id.
fn strictly(shapes: &[ScoredShape<'_>], given: &BTreeSet<i32>) -> Result<f64, ScoreError> {
    let of_person = |l: &i32| if given.contains(l) { *l } else { -1 };
    let of_shape = |s: &ScoredShape<'_>| Some(s.predicted?.iter().map(of_person).collect());
    let labels: Vec<Option<Vec<i32>>> = shapes.iter().map(of_shape).collect();
    let shapes: Vec<ScoredShape<'_>> = shapes
        .iter()
        .zip(&labels)
        .map(|(s, labels)| ScoredShape {
            predicted: labels.as_deref(),
            ..*s
        })
        .collect();
    accuracy_by_id(&shapes)
}

/// Time of placing each shape of a finished job in milliseconds.
fn placing_ms(job: wire::Job) -> Vec<f64> {
    let of_shape = |item: wire::JobItem| {
        let stages = item.placed.unwrap_or_default().stages.into_iter();
        let placing = stages.filter(|s| PLACING.contains(&s.stage.as_str()));
        placing.map(|s| s.ms).sum()
    };
    job.items.into_iter().map(of_shape).collect()
}

/// Writes the labels of a run, one file for each shape.
pub(crate) fn write(category: &Category, run: &Run, out: &Path) -> Result<(), BenchError> {
    std::fs::create_dir_all(out).map_err(|e| BenchError::file(out, e))?;
    for (shape, labels) in category.shapes.iter().zip(&run.labels) {
        let text: String = labels.iter().flatten().map(|l| format!("{l}\n")).collect();
        let path = out.join(format!("{}{TRUTH}", shape.name));
        std::fs::write(&path, text).map_err(|e| BenchError::file(&path, e))?;
    }
    Ok(())
}

/// Accuracy of the batch run, of streaming without maps and of the baselines, on the descriptions
/// in a library of an ended daemon. Labels are extended from the proxy to the faces of the input
/// without refined boundaries.
pub(crate) fn others(
    category: &Category,
    library: &Path,
) -> Result<Vec<(&'static str, f64)>, BenchError> {
    let library = Library::open(library)?;
    let up = library.collection(COLLECTION)?.spec.up.axis();
    let mut kept = Vec::new();
    for info in library.shapes(COLLECTION, 0, usize::MAX, None)? {
        let at = category.shapes.iter().position(|s| s.name == info.name);
        if let Some(at) = at {
            kept.push((at, library.description(COLLECTION, &info.name)?));
        }
    }
    kept.sort_by_key(|k| k.0);
    let n = kept.len();
    if n > MAX_TOGETHER {
        let spread: BTreeSet<usize> = (0..MAX_TOGETHER).map(|i| i * n / MAX_TOGETHER).collect();
        let mut at = 0;
        kept.retain(|_| {
            at += 1;
            spread.contains(&(at - 1))
        });
    }
    let views: Vec<DescriptionView<'_>> = kept.iter().map(|k| k.1.view()).collect();
    let accuracy = |of_proxy: Vec<Vec<u32>>| -> Result<f64, BenchError> {
        let labels: Vec<Option<Vec<i32>>> = views
            .iter()
            .zip(of_proxy)
            .map(|(v, l)| Some(v.face_map.iter().map(|f| l[*f as usize] as i32).collect()))
            .collect();
        let shapes = kept.iter().map(|k| &category.shapes[k.0]);
        Ok(scored(&category.name, shapes, &labels)?.accuracy)
    };
    let k = category.n_parts;
    let mut out = vec![
        ("batch", accuracy(batch(&views, k, up, None))?),
        ("without maps", accuracy(without_maps(&views, k, up))?),
    ];
    for (which, name) in Baseline::ALL {
        out.push((name, accuracy(batch(&views, k, up, Some(which)))?));
    }
    let seed = DiscoveryOptions::default().seed;
    let published = yang_tian_baseline(&views, k, seed)
        .map_err(|e| BenchError::Failed(format!("{}, the paper literally: {e}", category.name)))?;
    out.push(("the paper literally", accuracy(published)?));
    Ok(out)
}

/// Streaming like the daemon's, in the given order, but with each shape labelled by the label model
/// alone.
fn without_maps(views: &[DescriptionView<'_>], k: usize, up: Option<[f64; 3]>) -> Vec<Vec<u32>> {
    let mut model = None;
    let mut labels: Vec<Vec<u32>> = Vec::new();
    let mut next_recluster = 1;
    for (n, view) in views.iter().enumerate() {
        let ids = |l: &Labelling, ids: &[u32]| l.classes.iter().map(|c| ids[*c as usize]).collect();
        let prepared = model.as_ref().map(|m| Prepared::new(view, m));
        let labelling = prepared.as_ref().zip(model.as_ref());
        let labelling = labelling.map(|(p, m)| label(view, p, m, &[]));
        let own: Vec<u32> = labelling
            .as_ref()
            .zip(model.as_ref())
            .map(|(l, m)| ids(l, &m.labels))
            .unwrap_or_default();
        labels.push(own);
        if n + 1 >= next_recluster {
            let shapes: Vec<Representative<'_>> = views
                .iter()
                .zip(&labels)
                .map(|(shape, labels)| Representative {
                    shape: *shape,
                    labels,
                })
                .collect();
            let used = labels.iter().flatten().max().map_or(0, |l| l + 1);
            let options = ReclusterOptions {
                discovery: DiscoveryOptions {
                    n_labels: Some(k),
                    ..DiscoveryOptions::default()
                },
                up,
                min_gain: coseg::library::min_gain(n + 1),
                next_label: used,
                links: Links::default(),
            };
            let outcome = recluster(&shapes, model.as_ref(), n as u64 + 1, &options);
            next_recluster = coseg::library::next_recluster(n as u64 + 1) as usize;
            labels = outcome
                .labellings
                .iter()
                .map(|l| ids(l, &outcome.model.labels))
                .collect();
            model = Some(outcome.model);
        } else if let (Some(l), Some(p), Some(m)) = (labelling, prepared, &mut model) {
            let statistics = l.statistics(&p, m.labels.len());
            m.statistics.accumulate(&statistics, 1.0);
        }
    }
    labels
}
