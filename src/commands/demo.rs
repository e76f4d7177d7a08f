//! `coseg demo` streams a generated family through a daemon of its own, and compares the results
//! with the known parts.
//!
//! The daemon runs in this process, but every byte goes through its socket, as between two
//! programs.

use super::session::{Session, print_line};
use super::{CommandError, Outcome, demo_ply, json, labels};
use crate::cli::{Global, Settings, parts};
use crate::telemetry;
use bytes::Bytes;
use clap::Args;
use coseg::config::{Config, Log};
use coseg::daemon::{self, Running, ServeError};
use coseg::ipc::client::unexpected;
use coseg::ipc::wire::{self, ItemState, reply, request, shape_input::Source};
use coseg::labels::score::{Score, ScoredShape, score};
use coseg::mesh::write::off;
use coseg::synth::{Family, LEAST_FACES, Labelled, Options};
use coseg::text::table;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::os::unix::fs::DirBuilderExt as _;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Maximum number of faces of a shape; more would take longer than a demonstration should.
const MOST_FACES: i64 = 200_000;
/// Time limit for the daemon's end; it has no work left by then.
pub(super) const DRAIN_LIMIT: Duration = Duration::from_secs(30);

/// `coseg demo`
#[derive(Debug, Clone, Args)]
pub(crate) struct DemoArgs {
    /// The family; `coseg synth --list` lists all
    #[arg(default_value = "pliers")]
    family: Family,
    /// Number of shapes
    #[arg(
        long,
        value_name = "N",
        default_value_t = 12,
        value_parser = clap::value_parser!(u32).range(1..=1000)
    )]
    count: u32,
    /// Seed that selects the members of the family
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Number of faces of each shape
    #[arg(
        long,
        value_name = "N",
        default_value_t = 6_000,
        value_parser = clap::value_parser!(u32).range(i64::from(LEAST_FACES)..=MOST_FACES)
    )]
    faces: u32,
    /// Turn each shape at random, and do not set the up axis
    #[arg(long)]
    rotate: bool,
    /// Number of part kinds that is set; 0: the daemon estimates it [default: that of the family]
    #[arg(long, value_name = "N", value_parser = parts, allow_hyphen_values = true)]
    parts: Option<u32>,
    /// Folder for the coloured meshes, created if missing [default: a new temporary folder]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
}

/// A private folder that is removed when this value is dropped.
pub(super) struct Scratch(pub(super) PathBuf);

impl Scratch {
    pub(super) fn create() -> Result<Self, CommandError> {
        // Process ids are reused, quickly in containers, and a killed demonstration leaves its
        // folder behind.
        let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
        let (id, nanos) = (std::process::id(), since.map_or(0, |d| d.as_nanos()));
        let path = std::env::temp_dir().join(format!("coseg-demo-{id}-{nanos:x}"));
        let created = std::fs::DirBuilder::new().mode(0o700).create(&path);
        created.map_err(|e| at(&path, e))?;
        Ok(Self(path))
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        if let Err(e) = std::fs::remove_dir_all(&self.0) {
            eprintln!("coseg: {} is left behind: {e}", self.0.display());
        }
    }
}

/// A shape that was sent, with its known parts and the daemon's results.
struct Sent {
    shape: Labelled,
    truth: Vec<i32>,
    predicted: Option<Vec<i32>>,
    seconds: f64,
    item: wire::JobItem,
}

pub(crate) fn run(args: &DemoArgs, global: &Global) -> Outcome {
    let begin = Instant::now();
    let options = Options {
        n_faces: args.faces,
        rotate: args.rotate,
    };
    let shapes = coseg::synth::family(args.family, args.seed, args.count, &options);
    let made_seconds = begin.elapsed().as_secs_f64();

    // Dropped after the daemon has ended, because the daemon has files there.
    let scratch = Scratch::create()?;
    log_warnings()?;
    let running = start(&scratch.0)?;
    let global = Global {
        endpoint: Some(running.endpoint().to_string()),
        ..global.clone()
    };
    let mut session = Session::open(&global)?;
    if !session.json {
        let (family, n, n_faces) = (args.family, shapes.len(), args.faces);
        let names = args.family.label_names().join(", ");
        session.line(&format!(
            "family {family}: {n} shapes of {n_faces} faces, generated in {made_seconds:.1} s"
        ))?;
        session.line(&format!("its parts: {names}"))?;
        session.line(&format!(
            "daemon: {}, an empty library in {}",
            running.endpoint(),
            scratch.0.display()
        ))?;
        session.line("")?;
    }
    let done = stream(args, shapes, &mut session).and_then(|sent| finish(args, sent, &mut session));
    drop(session);
    running.drain(DRAIN_LIMIT);
    done
}

pub(super) fn at(path: &Path, source: std::io::Error) -> CommandError {
    CommandError::File {
        path: path.display().to_string(),
        source,
    }
}

/// Sets the log to warnings; once for each process.
pub(super) fn log_warnings() -> Result<(), CommandError> {
    telemetry::start(&Log {
        level: "warn".to_owned(),
        ..Config::default().log
    })?;
    Ok(())
}

/// Starts a daemon with default settings on an empty library.
pub(super) fn start(directory: &Path) -> Result<Running, CommandError> {
    let mut config = Config::default();
    config.server.endpoint = format!("ipc://{}/coseg.sock", directory.display());
    config.server.library = directory.join("library");
    Ok(daemon::start(config).map_err(ServeError::Start)?)
}

/// Sends the shapes one by one; each is labelled from the previous ones.
fn stream(
    args: &DemoArgs,
    shapes: Vec<Labelled>,
    session: &mut Session,
) -> Result<Vec<Sent>, CommandError> {
    let collection = args.family.name();
    let mut sent: Vec<Sent> = Vec::with_capacity(shapes.len());
    for shape in shapes {
        let begin = Instant::now();
        let item = add(args, collection, &shape, session)?;
        let seconds = begin.elapsed().as_secs_f64();
        let predicted = match item.state() {
            ItemState::Done => Some(receive(collection, &shape.name, session)?),
            _ => None,
        };
        let truth = shape.labels.iter().map(|&l| l as i32).collect();
        sent.push(Sent {
            shape,
            truth,
            predicted,
            seconds,
            item,
        });
        let so_far = scored(&sent)?;
        if let (Some(last), false) = (sent.last(), session.json) {
            session.line(&arrival(last, &so_far))?;
        }
    }
    Ok(sent)
}

/// Sends one shape and waits until it is labelled or refused.
fn add(
    args: &DemoArgs,
    collection: &str,
    shape: &Labelled,
    session: &mut Session,
) -> Result<wire::JobItem, CommandError> {
    let n_parts = args.family.label_names().len() as u32;
    let settings = Settings {
        parts: Some(args.parts.unwrap_or(n_parts)),
        up: Some(if args.rotate {
            wire::Up::Unknown
        } else {
            wire::Up::PlusY
        }),
        operator: None,
        working_faces: None,
    };
    let encoded = wire::EncodedMesh {
        format: wire::MeshFormat::Off.into(),
        bytes: Some(wire::BytesRef { frame: 0 }),
    };
    let input = wire::ShapeInput {
        name: shape.name.clone(),
        replace: false,
        source: Some(Source::Encoded(encoded)),
    };
    let body = request::Body::AddShapes(wire::AddShapesRequest {
        collection: collection.to_owned(),
        shapes: vec![input],
        mode: wire::AddMode::Job.into(),
        create: Some(settings.to_spec(collection)),
    });
    let frames = [Bytes::from(off(&shape.mesh))];
    let job_id = match session.client.call_patiently(&body, &frames)? {
        (reply::Result::AddShapes(reply), _) => reply.job_id,
        (other, _) => return Err(unexpected(&other).into()),
    };
    let mut revision = 0;
    loop {
        let job = session.watch_job(job_id, &mut revision)?;
        if job.finished {
            let item = job.items.into_iter().next();
            return item.ok_or_else(|| CommandError::Failed(format!("job {job_id} has no shapes")));
        }
    }
}

/// The newest labels of a shape.
fn receive(collection: &str, shape: &str, session: &mut Session) -> Result<Vec<i32>, CommandError> {
    let request = wire::GetLabelsRequest {
        collection: collection.to_owned(),
        shape: shape.to_owned(),
        version: 0,
        confidence: false,
    };
    Ok(labels::receive(session, request)?.labels)
}

fn scored(sent: &[Sent]) -> Result<Score, CommandError> {
    let shapes: Vec<ScoredShape<'_>> = sent
        .iter()
        .map(|s| ScoredShape {
            mesh: &s.shape.mesh,
            truth: &s.truth,
            predicted: s.predicted.as_deref(),
        })
        .collect();
    score(&shapes).map_err(|e| CommandError::Failed(format!("labels cannot be scored: {e}")))
}

/// The result of one shape, in two lines.
fn arrival(sent: &Sent, so_far: &Score) -> String {
    let (name, seconds) = (&sent.shape.name, sent.seconds);
    if sent.predicted.is_none() {
        let message = sent
            .item
            .error
            .as_ref()
            .map_or("cancelled", |e| e.message.as_str());
        return format!("{name}  failed: {message}");
    }
    let accuracy = so_far.shapes.last().copied().unwrap_or(0.0);
    let parts: Vec<String> = shares(sent)
        .into_iter()
        .map(|(label, share)| format!("{} {:.0} %", word(label), 100.0 * share))
        .collect();
    let stages = stages(sent)
        .into_iter()
        .map(|(stage, ms)| format!("{stage} {ms:.0}"));
    let stages: Vec<String> = stages.collect();
    format!(
        "{name}  {seconds:.2} s  accuracy {accuracy:.3}  {}\n    ms: {}",
        parts.join(", "),
        stages.join(", ")
    )
}

fn word(label: i32) -> String {
    if label < 0 {
        "unlabelled".to_owned()
    } else {
        format!("label {label}")
    }
}

/// Share of the area of each label, largest first.
fn shares(sent: &Sent) -> Vec<(i32, f64)> {
    let mesh = &sent.shape.mesh;
    let mut areas: BTreeMap<i32, f64> = BTreeMap::new();
    for (face, &label) in mesh.faces.iter().zip(sent.predicted.iter().flatten()) {
        *areas.entry(label).or_default() += demo_ply::face_area(mesh, face);
    }
    let total: f64 = areas.values().sum();
    let mut shares: Vec<(i32, f64)> = areas.into_iter().map(|(l, a)| (l, a / total)).collect();
    shares.sort_by(|a, b| b.1.total_cmp(&a.1));
    shares
}

/// Milliseconds of each stage, as measured by the daemon.
fn stages(sent: &Sent) -> Vec<(String, f64)> {
    let placed = sent.item.placed.iter().flat_map(|p| &p.stages);
    placed.map(|s| (s.stage.clone(), s.ms)).collect()
}

/// Waits for queued relabellings, scores the final labels, writes the coloured meshes and prints
/// the results.
fn finish(args: &DemoArgs, mut sent: Vec<Sent>, session: &mut Session) -> Outcome {
    let collection = args.family.name();
    let on_arrival = scored(&sent)?;
    session.wait_until_idle(collection)?;
    for s in sent.iter_mut().filter(|s| s.predicted.is_some()) {
        s.predicted = Some(receive(collection, &s.shape.name, session)?);
    }
    let last = scored(&sent)?;
    let infos = session.describe(collection)?.labels;
    let out = match &args.out {
        Some(out) => out.clone(),
        None => {
            let id = std::process::id();
            std::env::temp_dir().join(format!("coseg-demo-{collection}-{id}"))
        }
    };
    std::fs::create_dir_all(&out).map_err(|e| at(&out, e))?;
    let labelled: Vec<(&Labelled, &[i32])> = sent
        .iter()
        .filter_map(|s| Some((&s.shape, s.predicted.as_deref()?)))
        .collect();
    for (name, bytes) in demo_ply::files(&labelled, &infos) {
        let path = out.join(name);
        std::fs::write(&path, bytes).map_err(|e| at(&path, e))?;
    }
    if session.json {
        session.print_json(&report(args, &sent, &on_arrival, &last, &out))?;
    } else {
        summary(args, &sent, &on_arrival, &last, &out)?;
    }
    Ok(last.n_missing == 0)
}

/// Mean milliseconds of each stage, in order of first occurrence.
fn mean_stages(sent: &[Sent]) -> Vec<(String, f64)> {
    let mut means: Vec<(String, f64)> = Vec::new();
    for (stage, ms) in sent.iter().flat_map(stages) {
        match means.iter_mut().find(|(s, _)| *s == stage) {
            Some((_, sum)) => *sum += ms,
            None => means.push((stage, ms)),
        }
    }
    means
        .into_iter()
        .map(|(stage, sum)| (stage, sum / sent.len() as f64))
        .collect()
}

fn summary(
    args: &DemoArgs,
    sent: &[Sent],
    on_arrival: &Score,
    last: &Score,
    out: &Path,
) -> Result<(), CommandError> {
    let mut rows = vec![vec!["stage".to_owned(), "mean ms".to_owned()]];
    rows.extend(
        mean_stages(sent)
            .into_iter()
            .map(|(stage, ms)| vec![stage, format!("{ms:.1}")]),
    );
    print_line(&format!("\n{}\n", table(&rows)))?;
    let names = args.family.label_names();
    for (predicted, truth) in &last.assignment {
        let name = usize::try_from(*truth).ok().and_then(|t| names.get(t));
        print_line(&format!(
            "label {predicted} is the {}",
            name.copied().unwrap_or("?")
        ))?;
    }
    let mean = sent.iter().map(|s| s.seconds).sum::<f64>() / sent.len() as f64;
    print_line(&format!(
        "\n{mean:.2} s for each shape, from sending the file to durable labels"
    ))?;
    print_line(&format!(
        "accuracy {:.3} (each shape as labelled on arrival: {:.3}), {} labels for {} parts",
        last.accuracy, on_arrival.accuracy, last.n_predicted_labels, last.n_true_labels
    ))?;
    print_line(&format!(
        "coloured meshes: {} (all.ply: all of them, with the known parts behind the found ones)",
        out.display()
    ))
}

fn report(args: &DemoArgs, sent: &[Sent], on_arrival: &Score, last: &Score, out: &Path) -> Value {
    let shapes = sent
        .iter()
        .zip(&on_arrival.shapes)
        .zip(&last.shapes)
        .map(|((s, first), now)| {
            let mut value = json::job_item(&s.item);
            value["seconds"] = s.seconds.into();
            value["accuracy_on_arrival"] = (*first).into();
            value["accuracy"] = (*now).into();
            let parts = shares(s)
                .into_iter()
                .map(|(label, share)| json!({"label": label, "area_share": share}));
            value["parts"] = parts.collect();
            value
        });
    let stages = mean_stages(sent)
        .into_iter()
        .map(|(stage, ms)| (stage, ms.into()));
    let names = args.family.label_names();
    let assignment = last.assignment.iter().map(|(predicted, truth)| {
        let name = usize::try_from(*truth).ok().and_then(|t| names.get(t));
        json!({ "label": predicted, "part": name })
    });
    json!({
        "family": args.family.name(),
        "seed": args.seed,
        "n_faces": args.faces,
        "parts": names,
        "shapes": shapes.collect::<Vec<_>>(),
        "mean_stages_ms": Value::Object(stages.collect()),
        "accuracy_on_arrival": on_arrival.accuracy,
        "accuracy": last.accuracy,
        "purity": last.purity,
        "rand_error": last.rand_error,
        "assignment": assignment.collect::<Vec<_>>(),
        "out": out.display().to_string(),
    })
}
