//! `coseg add`: mesh files become labelled shapes.
//!
//! Files are sent in batches, a few jobs ahead of the one being waited for, so that the daemon always
//! has something to describe. The same command again resumes: what is there is `unchanged`.

use super::session::{Session, ambiguous, bar};
use super::{CommandError, Outcome, json};
use crate::cli::Add;
use bytes::Bytes;
use coseg::ipc::client::unexpected;
use coseg::ipc::convert::mesh_format;
use coseg::ipc::wire::{self, ItemState, reply, request, shape_input::Source};
use coseg::mesh::Format;
use indicatif::ProgressBar;
use serde_json::{Value, json};
use std::collections::{HashMap, VecDeque};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Shapes and bytes of one request: small enough that the first is at work while the next is read.
const BATCH_SHAPES: usize = 16;
const BATCH_BYTES: u64 = 16 << 20;
/// Jobs that are sent ahead.
const JOBS_AHEAD: usize = 4;
/// Name of the collection that is created when none is named and there is none.
const DEFAULT_COLLECTION: &str = "default";
/// What lies beside meshes and is passed over without a word.
const BESIDE_MESHES: [&str; 19] = [
    "txt", "md", "mtl", "png", "jpg", "jpeg", "bmp", "tga", "json", "csv", "yaml", "yml", "seg",
    "npy", "npz", "html", "bin", "webp", "ktx2",
];

/// A mesh file to send.
#[derive(Debug, PartialEq)]
struct MeshFile {
    path: PathBuf,
    name: String,
    format: Format,
}

/// What became of the files so far.
struct Report {
    json: bool,
    bar: ProgressBar,
    shapes: Vec<Value>,
    counts: HashMap<String, usize>,
    n_failed: usize,
}

pub(crate) fn run(args: &Add, mut session: Session) -> Outcome {
    let begin = Instant::now();
    let files = mesh_files(&args.paths)?;
    let collection = match &args.collection {
        Some(name) => name.clone(),
        None => {
            let mut names = session.collection_names()?;
            if names.len() > 1 {
                return Err(ambiguous(&names));
            }
            names.pop().unwrap_or_else(|| DEFAULT_COLLECTION.to_owned())
        }
    };
    let limits = session.client.hello()?.limits.unwrap_or_default();
    let mut report = Report {
        json: session.json,
        bar: bar(files.len() as u64),
        shapes: Vec::new(),
        counts: HashMap::new(),
        n_failed: 0,
    };
    // A batch that the whole queue cannot hold would be refused for ever.
    let max_queued = usize::try_from(limits.max_queued_shapes).unwrap_or(usize::MAX);
    let max_shapes = BATCH_SHAPES
        .min(limits.max_shapes_per_request as usize)
        .min(max_queued)
        .max(1);
    let max_bytes = BATCH_BYTES.min(limits.max_message_bytes / 2);
    let mut jobs = VecDeque::new();
    let mut batch = Batch::default();
    for file in &files {
        let bytes = match super::mesh_file::read(&file.path, file.format) {
            Ok(bytes) => bytes,
            Err(e) => {
                report.refused(&file.name, &format!("{}: {e}", file.path.display()));
                continue;
            }
        };
        let n_bytes = bytes.len() as u64;
        if n_bytes > limits.max_shape_bytes {
            let limit = limits.max_shape_bytes;
            report.refused(
                &file.name,
                &format!("the file has {n_bytes} bytes, the limit is {limit}"),
            );
            continue;
        }
        if batch.shapes.len() == max_shapes || batch.n_bytes + n_bytes > max_bytes {
            send(&mut batch, &collection, args, &mut jobs, &mut session)?;
            while !args.no_wait && jobs.len() > JOBS_AHEAD {
                finish_job(&mut jobs, &mut session, &mut report)?;
            }
        }
        batch.push(file, bytes, args.replace);
    }
    send(&mut batch, &collection, args, &mut jobs, &mut session)?;
    if args.no_wait {
        return accepted(&jobs, &collection, report.n_failed, &session);
    }
    while !jobs.is_empty() {
        finish_job(&mut jobs, &mut session, &mut report)?;
    }
    report.finish(&collection, begin, &session)
}

/// Shapes of the next request.
#[derive(Default)]
struct Batch {
    shapes: Vec<wire::ShapeInput>,
    frames: Vec<Bytes>,
    n_bytes: u64,
}

impl Batch {
    fn push(&mut self, file: &MeshFile, bytes: Vec<u8>, replace: bool) {
        let frame = u32::try_from(self.frames.len()).expect("invariant: batches are small");
        let encoded = wire::EncodedMesh {
            format: mesh_format(file.format).into(),
            bytes: Some(wire::BytesRef { frame }),
        };
        self.n_bytes += bytes.len() as u64;
        self.frames.push(bytes.into());
        self.shapes.push(wire::ShapeInput {
            name: file.name.clone(),
            replace,
            source: Some(Source::Encoded(encoded)),
        });
    }
}

/// Sends a batch; a daemon that is full is asked again until it has room.
fn send(
    batch: &mut Batch,
    collection: &str,
    args: &Add,
    jobs: &mut VecDeque<(u64, usize)>,
    session: &mut Session,
) -> Result<(), CommandError> {
    let batch = std::mem::take(batch);
    if batch.shapes.is_empty() {
        return Ok(());
    }
    let n = batch.shapes.len();
    let body = request::Body::AddShapes(wire::AddShapesRequest {
        collection: collection.to_owned(),
        shapes: batch.shapes,
        mode: wire::AddMode::Job.into(),
        create: Some(args.settings.to_spec(collection)),
    });
    match session.client.call_patiently(&body, &batch.frames)? {
        (reply::Result::AddShapes(reply), _) => jobs.push_back((reply.job_id, n)),
        (other, _) => return Err(unexpected(&other).into()),
    }
    Ok(())
}

/// Waits for the oldest job and reports its shapes as they come, in order.
fn finish_job(
    jobs: &mut VecDeque<(u64, usize)>,
    session: &mut Session,
    report: &mut Report,
) -> Result<(), CommandError> {
    let Some((job_id, _)) = jobs.pop_front() else {
        return Ok(());
    };
    let (mut revision, mut n_reported) = (0, 0);
    loop {
        let job = session.watch_job(job_id, &mut revision)?;
        for item in job.items.iter().skip(n_reported) {
            match item.state() {
                ItemState::Done | ItemState::Failed | ItemState::Cancelled => {
                    report.item(item)?;
                    n_reported += 1;
                }
                ItemState::Unspecified | ItemState::Queued | ItemState::Running => {
                    report
                        .bar
                        .set_message(format!("{} {}", item.name, item.stage));
                    break;
                }
            }
        }
        if job.finished {
            return Ok(());
        }
    }
}

fn accepted(
    jobs: &VecDeque<(u64, usize)>,
    collection: &str,
    n_failed: usize,
    session: &Session,
) -> Outcome {
    let n: usize = jobs.iter().map(|(_, n)| n).sum();
    if session.json {
        let ids: Vec<u64> = jobs.iter().map(|(id, _)| *id).collect();
        session.print_json(&json!({
            "collection": collection,
            "jobs": ids,
            "n_accepted": n,
            "n_failed": n_failed,
        }))?;
    } else {
        eprintln!("{n} shapes accepted into {collection}");
    }
    Ok(n_failed == 0)
}

impl Report {
    /// A file that was not even sent.
    fn refused(&mut self, name: &str, message: &str) {
        self.bar.suspend(|| eprintln!("coseg: {name}: {message}"));
        let error = json!({ "code": "INVALID_ARGUMENT", "reason": "NOT_SENT", "message": message });
        self.shapes
            .push(json!({ "name": name, "outcome": "failed", "error": error }));
        self.count("failed");
        self.n_failed += 1;
        self.bar.inc(1);
    }

    fn item(&mut self, item: &wire::JobItem) -> Result<(), CommandError> {
        let value = json::job_item(item);
        let outcome = value["outcome"].as_str().unwrap_or_default().to_owned();
        if item.state() != ItemState::Done {
            self.n_failed += 1;
            let message = item
                .error
                .as_ref()
                .map_or("cancelled", |e| e.message.as_str());
            self.bar
                .suspend(|| eprintln!("coseg: {}: {message}", item.name));
        } else if !self.json {
            let p = item.placed.clone().unwrap_or_default();
            let seconds = p.stages.iter().map(|s| s.ms).sum::<f64>() / 1e3;
            let line = if p.outcome() == wire::Outcome::Unchanged {
                format!("{}: {outcome}", item.name)
            } else {
                format!(
                    "{}: {outcome}, {} maps, {seconds:.2} s",
                    item.name, p.n_maps
                )
            };
            self.bar.suspend(|| super::session::print_line(&line))?;
        }
        self.count(&outcome);
        self.shapes.push(value);
        self.bar.inc(1);
        Ok(())
    }

    fn count(&mut self, outcome: &str) {
        *self.counts.entry(outcome.to_owned()).or_default() += 1;
    }

    fn finish(self, collection: &str, begin: Instant, session: &Session) -> Outcome {
        self.bar.finish_and_clear();
        let seconds = begin.elapsed().as_secs_f64();
        let count = |outcome: &str| self.counts.get(outcome).copied().unwrap_or(0);
        let outcomes = ["added", "replaced", "unchanged", "failed", "cancelled"];
        if session.json {
            let mut value = json!({ "collection": collection, "seconds": seconds });
            for outcome in outcomes {
                value[format!("n_{outcome}")] = count(outcome).into();
            }
            value["shapes"] = self.shapes.into();
            session.print_json(&value)?;
        } else {
            let counted: Vec<String> = outcomes
                .iter()
                .filter(|o| count(o) > 0)
                .map(|o| format!("{} {o}", count(o)))
                .collect();
            eprintln!("{collection}: {} in {seconds:.1} s", counted.join(", "));
        }
        Ok(self.n_failed == 0)
    }
}

/// The files to send, in order: as named, the files of a folder as people count.
fn mesh_files(paths: &[PathBuf]) -> Result<Vec<MeshFile>, CommandError> {
    let mut files = Vec::new();
    for path in paths {
        if path.is_dir() {
            let n = files.len();
            folder(path, &mut files)?;
            if files.len() == n {
                let (path, known) = (path.display(), Format::EXTENSIONS);
                let text = format!("{path} has no mesh files ({known})");
                return Err(CommandError::Usage(text));
            }
        } else if !path.exists() {
            return Err(CommandError::Usage(format!(
                "{} does not exist",
                path.display()
            )));
        } else {
            let file = mesh_file(path)?.ok_or_else(|| {
                let (path, known) = (path.display(), Format::EXTENSIONS);
                let text = format!("{path} is not a mesh file ({known})");
                CommandError::Usage(text)
            })?;
            files.push(file);
        }
    }
    let mut first = HashMap::new();
    for file in &files {
        if let Some(other) = first.insert(&file.name, &file.path) {
            return Err(CommandError::Usage(format!(
                "{} and {} would both be named {:?}",
                other.display(),
                file.path.display(),
                file.name
            )));
        }
    }
    Ok(files)
}

fn folder(path: &Path, files: &mut Vec<MeshFile>) -> Result<(), CommandError> {
    let at = |source| CommandError::File {
        path: path.display().to_string(),
        source,
    };
    let entries = std::fs::read_dir(path).map_err(at)?;
    let mut names: Vec<String> = Vec::new();
    for entry in entries {
        let entry = entry.map_err(at)?;
        let name = entry.file_name().to_string_lossy().into_owned();
        if !name.starts_with('.') && !entry.path().is_dir() {
            names.push(name);
        }
    }
    // By bytes first: natural order alone does not tell `a01` from `a1`.
    names.sort();
    names.sort_by(|a, b| natord::compare(a, b));
    for name in names {
        match mesh_file(&path.join(&name))? {
            Some(file) => files.push(file),
            None if is_beside_meshes(&name) => {}
            None => {
                let known = Format::EXTENSIONS;
                eprintln!("coseg: {name} is skipped, it is not a mesh file ({known})");
            }
        }
    }
    Ok(())
}

fn is_beside_meshes(name: &str) -> bool {
    let extension = name.rsplit_once('.').map(|(_, e)| e.to_ascii_lowercase());
    extension.is_none_or(|e| BESIDE_MESHES.contains(&e.as_str()))
}

/// The file, if its extension says that it is a mesh.
fn mesh_file(path: &Path) -> Result<Option<MeshFile>, CommandError> {
    let not_text =
        || CommandError::Usage(format!("the name of {} is not valid UTF-8", path.display()));
    let name = path
        .file_name()
        .map(|n| n.to_string_lossy())
        .unwrap_or_default();
    let Some(format) = Format::from_name(&name) else {
        return Ok(None);
    };
    let stem = path
        .file_stem()
        .and_then(|s| s.to_str())
        .ok_or_else(not_text)?;
    Ok(Some(MeshFile {
        path: path.to_owned(),
        name: stem.to_owned(),
        format,
    }))
}

#[cfg(test)]
mod tests {
    use super::{CommandError, mesh_files};

    #[test]
    fn a_folder_is_read_in_natural_order_and_other_files_are_skipped() {
        let folder = tempfile::tempdir().unwrap();
        for name in [
            "10.off",
            "9.OBJ",
            "9.labels.txt",
            "11.Glb",
            "12.gltf",
            "13.stl",
            "14.PLY",
            "1.off",
            "x.step",
            ".hidden.off",
            "readme",
        ] {
            std::fs::write(folder.path().join(name), "").unwrap();
        }
        let files = mesh_files(&[folder.path().to_owned()]).unwrap();
        let names: Vec<_> = files.iter().map(|f| f.name.as_str()).collect();
        assert_eq!(names, ["1", "9", "10", "11", "12", "13", "14"]);
    }

    #[test]
    fn argument_order_is_kept_and_double_names_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        for name in ["b.off", "a.off", "a.obj", "c.txt"] {
            std::fs::write(path(name), "").unwrap();
        }
        let files = mesh_files(&[path("b.off"), path("a.obj")]).unwrap();
        assert_eq!(
            files.iter().map(|f| f.name.as_str()).collect::<Vec<_>>(),
            ["b", "a"]
        );
        for paths in [
            vec![path("a.off"), path("a.obj")],
            vec![path("c.txt")],
            vec![path("none.off")],
        ] {
            assert!(
                matches!(mesh_files(&paths), Err(CommandError::Usage(_))),
                "{paths:?}"
            );
        }
    }
}
