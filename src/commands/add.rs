//! `coseg add` sends mesh files to the daemon, which labels them.
//!
//! Files are sent in batches, a few jobs ahead of the job whose result is awaited, so that the
//! daemon always has shapes to describe. Running the same command again resumes: stored shapes are
//! `unchanged`.

use super::collections::warn_of_up;
use super::mesh_files::{self, Found, MeshFile, printable};
use super::session::{Session, ambiguous, bar};
use super::{CommandError, Outcome, interrupt, json};
use crate::cli::Add;
use bytes::Bytes;
use coseg::ipc::client::unexpected;
use coseg::ipc::convert::mesh_format;
use coseg::ipc::size;
use coseg::ipc::wire::{self, ItemState, reply, request, shape_input::Source};
use coseg::text::counted;
use indicatif::ProgressBar;
use serde_json::{Value, json};
use std::collections::{HashMap, VecDeque};
use std::time::Instant;

/// Shapes and bytes of one request: small enough that the daemon works on the first while the next
/// is read.
const BATCH_SHAPES: usize = 16;
const BATCH_BYTES: u64 = 16 << 20;
/// Number of jobs that are sent ahead.
const JOBS_AHEAD: usize = 4;
/// Name of the collection that is created when none is named and none exists.
const DEFAULT_COLLECTION: &str = "default";

/// The results of the files so far.
struct Report {
    json: bool,
    bar: ProgressBar,
    shapes: Vec<Value>,
    counts: HashMap<String, usize>,
    n_failed: usize,
}

pub(crate) fn run(args: &Add, mut session: Session) -> Outcome {
    let begin = Instant::now();
    let Found {
        files,
        refused,
        notes,
    } = mesh_files::find(&args.paths, args.recursive)?;
    for note in notes {
        eprintln!("coseg: {note}");
    }
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
        bar: bar((files.len() + refused.len()) as u64),
        shapes: Vec::new(),
        counts: HashMap::new(),
        n_failed: 0,
    };
    for (path, why) in refused {
        report.refused(&printable(&path), &why);
    }
    // The daemon would always refuse a batch that exceeds its whole queue.
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
            let (limit, key) = (
                limits.max_shape_bytes,
                "limits.max_shape, within limits.memory",
            );
            report.refused(&file.name, &size::beyond("the file", n_bytes, limit, key));
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
    let described = session.describe(&collection).ok();
    report.finish(&collection, begin, described.as_ref(), &session)
}

/// The shapes of the next request.
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

/// Sends a batch, and repeats it while the daemon's queue is full.
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
    interrupt::set_note(left_behind(collection, jobs));
    Ok(())
}

/// The message about work that continues in the daemon if the command ends now.
fn left_behind(collection: &str, jobs: &VecDeque<(u64, usize)>) -> String {
    let n: usize = jobs.iter().map(|(_, n)| n).sum();
    let ids: Vec<String> = jobs.iter().map(|(id, _)| id.to_string()).collect();
    let (shapes, ids) = (counted(n as u64, "shape"), ids.join(" "));
    let which = if jobs.len() == 1 { "job" } else { "jobs" };
    format!(
        "coseg: interrupted; the daemon continues with the accepted work: up to {shapes} of \
         {collection:?}, {which} {ids}\n  to follow: coseg wait -c {collection:?}\n  to cancel: \
         coseg cancel {ids}\n  \
         to add the rest: the same command again"
    )
}

/// Waits for the oldest job and reports its shapes in order, as they finish.
fn finish_job(
    jobs: &mut VecDeque<(u64, usize)>,
    session: &mut Session,
    report: &mut Report,
) -> Result<(), CommandError> {
    let Some(&(job_id, _)) = jobs.front() else {
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
            jobs.pop_front();
            interrupt::clear_note();
            if !jobs.is_empty() {
                interrupt::set_note(left_behind(&job.collection, jobs));
            }
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
        let ids: Vec<String> = jobs.iter().map(|(id, _)| id.to_string()).collect();
        let (shapes, ids) = (counted(n as u64, "shape"), ids.join(" "));
        let which = if jobs.len() == 1 { "job" } else { "jobs" };
        eprintln!("{shapes} accepted into {collection}, {which} {ids}");
    }
    Ok(n_failed == 0)
}

impl Report {
    /// Reports a file that was not sent.
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
                    "{}: {outcome}, {}, {seconds:.2} s",
                    item.name,
                    counted(p.n_maps.into(), "map")
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

    fn finish(
        self,
        collection: &str,
        begin: Instant,
        described: Option<&wire::Collection>,
        session: &Session,
    ) -> Outcome {
        self.bar.finish_and_clear();
        let seconds = begin.elapsed().as_secs_f64();
        let count = |outcome: &str| self.counts.get(outcome).copied().unwrap_or(0);
        let outcomes = ["added", "replaced", "unchanged", "failed", "cancelled"];
        if session.json {
            let mut value = json!({ "collection": collection, "seconds": seconds });
            for outcome in outcomes {
                value[format!("n_{outcome}")] = count(outcome).into();
            }
            let other = described.and_then(|c| c.up_disagrees.as_ref());
            value["up_disagrees"] = other.map(json::up_estimate).into();
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
        if let Some(described) = described {
            warn_of_up(described);
        }
        Ok(self.n_failed == 0)
    }
}
