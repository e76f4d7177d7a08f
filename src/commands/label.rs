//! `coseg label` labels meshes by a bundle that `coseg publish` wrote, without a daemon.

use super::export::{Form, Original, encoded, file_stem};
use super::export_mesh::styles;
use super::mesh_files::{self, Found, MeshFile, printable};
use super::session::{bar, print_line};
use super::{CommandError, Outcome, json};
use crate::cli::{ExportFormat, Global, LabelMeshes};
use coseg::ipc::convert::clean_report;
use coseg::ipc::wire;
use coseg::label;
use coseg::library::{Bundle, LabelledMesh};
use coseg::mesh::write::{LabelStyle, Labelling};
use coseg::text::counted;
use indicatif::ProgressBar;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Instant;

/// Suffix of the file with everything about a mesh but its labels.
const REPORT: &str = ".report.json";
/// Stack of the threads that label: that of a daemon's workers.
const STACK_BYTES: usize = 8 << 20;

/// What all meshes share.
struct Task<'a> {
    args: &'a LabelMeshes,
    bundle: &'a Bundle,
    styles: BTreeMap<i32, LabelStyle>,
    form: Form,
    progress: ProgressBar,
    json: bool,
}

pub(crate) fn run(args: &LabelMeshes, global: &Global) -> Outcome {
    let begin = Instant::now();
    if args.format == ExportFormat::Obj {
        let text = "--format obj needs one file of materials for all meshes; take glb or ply";
        return Err(CommandError::Usage(text.to_owned()));
    }
    let Found {
        files,
        refused,
        notes,
    } = mesh_files::find(&args.paths, args.recursive)?;
    for note in notes {
        eprintln!("coseg: {note}");
    }
    let bundle = Bundle::open(&args.bundle)?;
    if !bundle.info().same_processor {
        eprintln!(
            "coseg: the bundle was published on another kind of processor: labels of single faces \
             can differ from those that its library would give"
        );
    }
    std::fs::create_dir_all(&args.out).map_err(at(&args.out))?;
    let task = Task {
        args,
        bundle: &bundle,
        styles: styles_of(&bundle),
        form: Form {
            format: args.format,
            materials: args.materials,
            instances: args.instances,
        },
        progress: bar((files.len() + refused.len()) as u64),
        json: global.json,
    };
    let mut rows: Vec<Value> = Vec::new();
    for (path, why) in &refused {
        rows.push(task.failed(&printable(path), &not_read(why.clone())));
        task.progress.inc(1);
    }
    rows.extend(task.label_all(&files)?);
    task.progress.finish_and_clear();
    let n_failed = rows.iter().filter(|r| r["outcome"] == "failed").count();
    let (n_labelled, seconds) = (rows.len() - n_failed, begin.elapsed().as_secs_f64());
    let info = bundle.info();
    if global.json {
        let value = json!({
            "collection": info.collection,
            "bundle": info.id.to_string(),
            "sequence": info.sequence,
            "same_processor": info.same_processor,
            "seconds": seconds,
            "n_labelled": n_labelled,
            "n_failed": n_failed,
            "shapes": rows,
        });
        print_line(&value.to_string())?;
    } else {
        let failed = match n_failed {
            0 => String::new(),
            n => format!(", {n} failed"),
        };
        let shapes = counted(n_labelled as u64, "shape");
        let out = args.out.display();
        eprintln!("{shapes} labelled{failed} in {seconds:.1} s, written to {out}");
    }
    Ok(n_failed == 0)
}

/// The rows of the meshes so far, by their place, and the number of them that were printed.
#[derive(Default)]
struct Rows {
    rows: Vec<Option<Value>>,
    n_printed: usize,
    failed: Option<CommandError>,
}

impl Task<'_> {
    /// Labels all meshes, each on one thread if there are as many as threads. Returns their rows in
    /// the order of the meshes.
    fn label_all(&self, files: &[MeshFile]) -> Result<Vec<Value>, CommandError> {
        let n_threads = match self.args.threads {
            Some(n) => n as usize,
            None => std::thread::available_parallelism().map_or(1, usize::from),
        };
        let n_at_once = n_threads.min(files.len()).max(1);
        // Pools of their own: a thread that waits for its mesh never begins another one meanwhile.
        let pool = || {
            let pool = rayon::ThreadPoolBuilder::new();
            pool.num_threads(n_threads / n_at_once)
                .stack_size(STACK_BYTES)
                .build()
        };
        let pools: Result<Vec<_>, _> = (0..n_at_once).map(|_| pool()).collect();
        let pools =
            pools.map_err(|e| CommandError::Failed(format!("cannot start threads: {e}")))?;
        let next = AtomicUsize::new(0);
        let rows = Mutex::new(Rows {
            rows: vec![None; files.len()],
            ..Rows::default()
        });
        std::thread::scope(|scope| {
            for pool in &pools {
                scope.spawn(|| {
                    loop {
                        let at = next.fetch_add(1, Ordering::Relaxed);
                        let Some(file) = files.get(at) else { return };
                        let row = pool.install(|| self.label(file));
                        if !self.note(&mut lock(&rows), at, row) {
                            // Nobody begins another one.
                            next.store(files.len(), Ordering::Relaxed);
                        }
                    }
                });
            }
        });
        let done = rows.into_inner().unwrap_or_else(PoisonError::into_inner);
        match done.failed {
            Some(error) => Err(error),
            None => Ok(done.rows.into_iter().flatten().collect()),
        }
    }

    /// Notes the row of a mesh, and prints those that are complete up to the first that is not.
    /// Returns false once the command has failed.
    fn note(&self, rows: &mut Rows, at: usize, row: Result<Value, CommandError>) -> bool {
        let mut noted = row.map(|row| rows.rows[at] = Some(row));
        while noted.is_ok()
            && let Some(Some(row)) = rows.rows.get(rows.n_printed)
        {
            rows.n_printed += 1;
            if !self.json && row["outcome"] == "labelled" {
                let line = self.line(row);
                noted = self.progress.suspend(|| print_line(&line));
            }
        }
        if let Err(error) = noted {
            rows.failed.get_or_insert(error);
        }
        self.progress.inc(1);
        rows.failed.is_none()
    }

    /// The line about a mesh that was labelled.
    fn line(&self, row: &Value) -> String {
        let missing: Vec<String> = row["missing"].as_array().map_or_else(Vec::new, |ids| {
            ids.iter()
                .map(|id| self.name(id.as_i64().unwrap_or(-1)))
                .collect()
        });
        let missing = match missing.as_slice() {
            [] => String::new(),
            names => format!(", missing {}", names.join(" ")),
        };
        let parts = counted(row["n_parts"].as_u64().unwrap_or_default(), "part");
        let name = row["name"].as_str().unwrap_or_default();
        let seconds = row["seconds"].as_f64().unwrap_or_default();
        format!("{name}: {parts}{missing}, {seconds:.2} s")
    }

    /// The name of a label.
    fn name(&self, id: i64) -> String {
        let style = i32::try_from(id).ok().and_then(|id| self.styles.get(&id));
        style.map_or_else(|| format!("label_{id}"), |style| style.name.clone())
    }

    /// Labels a mesh and writes its files. Returns its row of the result; a failure to write ends
    /// the command.
    fn label(&self, file: &MeshFile) -> Result<Value, CommandError> {
        let begin = Instant::now();
        self.progress.set_message(file.name.clone());
        let bytes = match super::mesh_file::read(&file.path, file.format) {
            Ok(bytes) => bytes,
            Err(e) => {
                let why = not_read(format!("{}: {e}", file.path.display()));
                return Ok(self.failed(&file.name, &why));
            }
        };
        let found = match label(&bytes, file.format, self.bundle) {
            Ok(found) => found,
            Err(why) => {
                let error = json!({
                    "code": why.code.name(),
                    "reason": why.reason.name(),
                    "message": why.message,
                });
                return Ok(self.failed(&file.name, &(why.message, error)));
            }
        };
        let original = Original::new(bytes, file.format);
        self.write(file, &original, &found)?;
        Ok(self.row(file, &found, begin.elapsed().as_secs_f64()))
    }

    fn row(&self, file: &MeshFile, found: &LabelledMesh, seconds: f64) -> Value {
        json!({
            "name": file.name,
            "outcome": "labelled",
            "n_polygons": found.labels.len(),
            "n_parts": found.parts.len(),
            "missing": found.missing,
            "n_maps": found.n_maps,
            "reclustered": found.reclustered,
            "seconds": seconds,
        })
    }

    fn failed(&self, name: &str, (message, error): &(String, Value)) -> Value {
        let text = format!("coseg: {name}: {message}");
        self.progress.suspend(|| eprintln!("{text}"));
        json!({ "name": name, "outcome": "failed", "error": error })
    }

    fn write(
        &self,
        file: &MeshFile,
        original: &Original,
        found: &LabelledMesh,
    ) -> Result<(), CommandError> {
        let with_confidence = self.form.format == ExportFormat::Usda;
        let labelling = Labelling {
            labels: &found.labels,
            confidence: with_confidence.then_some(&found.confidence[..]),
            styles: &self.styles,
        };
        let info = self.bundle.info();
        let up = info.up.axis().or(info.axis);
        let (suffix, bytes) = encoded(&self.form, &file.name, original, up, &labelling)?;
        let write = |suffix: &str, bytes: &[u8]| {
            let stem = file_stem(&file.name, suffix);
            let path = self.args.out.join(format!("{stem}{suffix}"));
            std::fs::write(&path, bytes).map_err(at(&path))
        };
        write(suffix, &bytes)?;
        let mut report = self.report(&file.name, found);
        if self.args.confidence {
            report["confidence"] = found.confidence.as_slice().into();
        }
        write(REPORT, report.to_string().as_bytes())
    }

    fn report(&self, name: &str, found: &LabelledMesh) -> Value {
        let info = self.bundle.info();
        let parts = found.parts.iter().map(
            |p| json!({ "label": p.label, "area_share": p.area_share, "confidence": p.confidence }),
        );
        let sources = found.sources.iter();
        let sources =
            sources.map(|s| json!({ "shape": s.shape, "version": s.version, "weight": s.weight }));
        json!({
            "name": name,
            "collection": info.collection,
            "bundle": info.id.to_string(),
            "sequence": info.sequence,
            "epoch": info.epoch,
            "same_processor": info.same_processor,
            "n_polygons": found.labels.len(),
            "area": found.area,
            "content_digest": found.content_digest.to_string(),
            "report": json::report(&clean_report(&found.report)),
            "parts": parts.collect::<Vec<_>>(),
            "missing": found.missing,
            "sources": sources.collect::<Vec<_>>(),
            "n_maps": found.n_maps,
            "reclustered": found.reclustered,
        })
    }
}

fn lock(rows: &Mutex<Rows>) -> MutexGuard<'_, Rows> {
    rows.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The failure of a file that was not read.
fn not_read(message: String) -> (String, Value) {
    let error = json!({ "code": "INVALID_ARGUMENT", "reason": "NOT_SENT", "message": message });
    (message, error)
}

fn at(path: &Path) -> impl Fn(std::io::Error) -> CommandError {
    let path = path.display().to_string();
    move |source| CommandError::File {
        path: path.clone(),
        source,
    }
}

/// How the labels of a bundle are shown.
fn styles_of(bundle: &Bundle) -> BTreeMap<i32, LabelStyle> {
    let info = |l: &coseg::library::BundledLabel| {
        let [r, g, b] = l.colour;
        wire::LabelInfo {
            id: l.id,
            name: l.name.clone().unwrap_or_default(),
            colour_rgb: u32::from_be_bytes([0, r, g, b]),
            ..wire::LabelInfo::default()
        }
    };
    let infos: Vec<wire::LabelInfo> = bundle.info().labels.iter().map(info).collect();
    styles(&infos)
}
