//! Accepted shapes are described side by side and placed one after the other.
//!
//! One scheduler hands waiting shapes to describing threads, as many as there are workers and memory
//! for, collections in turn. One lane for each collection ([`placing`]) places them strictly in order of acceptance,
//! however the describing threads overtake each other.

use crate::config::Limits;
use crate::daemon::memory::Reservation;
use crate::daemon::progress::{Progress, Waiting};
use crate::daemon::worker::{Ended, panicked};
use crate::daemon::{Daemon, panic_text, placing};
use crate::ipc::convert;
use crate::library::isolate::DescribeJob;
use crate::library::{Described, Failure, Job, JobItem, LibraryError};
use crate::pipeline::Description;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::{Notify, mpsc, oneshot, watch};
use tokio::task::JoinSet;

/// What describing came to.
pub(super) type Outcome = Result<Described, Failure>;

/// A shape on its way to its lane.
#[allow(clippy::large_enum_variant)] // one at a time for each worker, never in a collection
pub(super) enum Prepared {
    /// It was described, or failed to be.
    Described(Box<Outcome>),
    /// When its turn to be described came, no description was needed: the same bytes were there under its
    /// name, or others that it may not replace. Looked at again when its turn to be placed comes.
    NotNeeded,
}

/// What a lane is told.
pub(crate) enum Step {
    /// Place this shape after all before it.
    Place(Ready),
    /// Some labels may have become stale.
    Relabel,
}

/// A shape whose description is under way.
pub(crate) struct Ready {
    pub(super) item: JobItem,
    /// Dropped without a value if the daemon drains: the shape stays queued in the catalog.
    pub(super) prepared: oneshot::Receiver<(Prepared, Reservation)>,
}

/// How often the work on a shape may end its worker before it has failed.
pub(super) const MAX_ATTEMPTS: u32 = 3;
/// The work in hand.
pub(crate) struct Work {
    progress: Mutex<Progress<Step>>,
    /// A shape waits to be described.
    arrived: Notify,
    /// Advances with every change, for those who wait for one.
    changes: watch::Sender<u64>,
    lanes: Mutex<JoinSet<()>>,
}

impl Work {
    pub(crate) fn new() -> Self {
        Self {
            progress: Mutex::new(Progress::new()),
            arrived: Notify::new(),
            changes: watch::Sender::new(0),
            lanes: Mutex::new(JoinSet::new()),
        }
    }

    pub(crate) fn progress(&self) -> MutexGuard<'_, Progress<Step>> {
        // Nothing in `Progress` panics half-way but for broken invariants, which are reported.
        self.progress.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Told of every change from now on.
    pub(crate) fn changes(&self) -> watch::Receiver<u64> {
        self.changes.subscribe()
    }

    pub(super) fn changed(&self) {
        self.changes.send_modify(|n| *n += 1);
    }
}

impl Daemon {
    /// Takes up the shapes of a job that was accepted, unless it was taken up before.
    pub(crate) fn take_up(self: &Arc<Self>, job: &Job, n_bytes: &[u64]) {
        if self.work.progress().is_known(job.id) {
            return;
        }
        let items = job.items.iter().zip(n_bytes);
        self.take_up_items(
            items
                .map(|(item, &n_bytes)| Waiting {
                    item: item.clone(),
                    n_bytes,
                })
                .collect(),
        );
    }

    /// Takes up shapes in the order given.
    pub(crate) fn take_up_items(self: &Arc<Self>, items: Vec<Waiting>) {
        for waiting in items {
            if convert::job_finished(&waiting.item.state) {
                continue;
            }
            self.ensure_lane(&waiting.item.collection);
            let mut progress = self.work.progress();
            // Without a lane the daemon drains, and the shape is taken up at the next start.
            if progress.lane(&waiting.item.collection).is_some() {
                progress.push(waiting);
            }
        }
        self.work.changed();
        self.work.arrived.notify_one();
    }

    /// Something that may make labels stale was committed to the collection.
    pub(crate) fn nudge(self: &Arc<Self>, collection: &str) {
        self.ensure_lane(collection);
        if let Some(lane) = self.work.progress().lane(collection) {
            // A lane ends only when the daemon does.
            let _ = lane.send(Step::Relabel);
        }
        self.work.changed();
    }

    fn ensure_lane(self: &Arc<Self>, collection: &str) {
        let mut progress = self.work.progress();
        if self.is_draining() || progress.lane(collection).is_some() {
            return;
        }
        let (sender, receiver) = mpsc::unbounded_channel();
        progress.add_lane(collection, sender);
        let lane = placing::place_in_order(Arc::clone(self), collection.to_owned(), receiver);
        let mut lanes = self
            .work
            .lanes
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        while lanes.try_join_next().is_some() {}
        lanes.spawn(lane);
    }

    /// Cancels what is not placed of a job, after the catalog did.
    pub(crate) fn forget_cancelled(&self, job: &Job) {
        let mut progress = self.work.progress();
        progress.cancel(job.id);
        progress.drop_waiting(job.id, |index| {
            job.items
                .iter()
                .any(|i| i.index == index && convert::job_finished(&i.state))
        });
        drop(progress);
        self.work.changed();
    }

    /// Waits until every lane has ended. For draining: the lanes must have been closed.
    pub(crate) async fn lanes_ended(&self) {
        let mut lanes = std::mem::take(
            &mut *self
                .work
                .lanes
                .lock()
                .unwrap_or_else(PoisonError::into_inner),
        );
        while lanes.join_next().await.is_some() {}
    }
}

/// Hands waiting shapes to describing threads until the daemon drains.
pub(crate) async fn schedule(daemon: Arc<Daemon>) {
    let mut draining = daemon.drain.subscribe();
    tokio::select! {
        () = hand_out(&daemon) => {}
        _ = draining.wait_for(|&d| d) => {}
    }
    daemon.work.progress().close();
}

async fn hand_out(daemon: &Arc<Daemon>) {
    loop {
        let worker = Arc::clone(&daemon.workers).acquire_owned().await;
        let worker = worker.expect("invariant: the semaphore is never closed");
        let (waiting, lane) = loop {
            let arrived = daemon.work.arrived.notified();
            // Not in the match: the lock must not be held while waiting.
            let next = daemon.work.progress().pop();
            match next {
                Some(next) => break next,
                None => arrived.await,
            }
        };
        let memory = daemon
            .describe_memory
            .reserve(Limits::to_describe(waiting.n_bytes))
            .await;
        let (sender, prepared) = oneshot::channel();
        // Told before describing begins, so that the lane has its shapes in order of acceptance.
        if lane
            .send(Step::Place(Ready {
                item: waiting.item.clone(),
                prepared,
            }))
            .is_err()
        {
            continue;
        }
        let daemon = Arc::clone(daemon);
        tokio::task::spawn_blocking(move || {
            let mut memory = memory;
            let begin = Instant::now();
            let prepared = prepare(&daemon, &waiting.item);
            if matches!(&prepared, Prepared::Described(d) if d.is_ok()) {
                let secs = begin.elapsed().as_secs_f64() / daemon.n_workers.max(1) as f64;
                daemon.work.progress().note_pace(waiting.n_bytes, secs);
            }
            drop(worker);
            let kept = match &prepared {
                Prepared::NotNeeded => 0,
                Prepared::Described(outcome) => match outcome.as_ref() {
                    Ok(d) => bytes_of(&d.description),
                    // Stopped, it seems: it is described again at the next start.
                    Err(_) if daemon.is_draining() => return,
                    Err(_) => 0,
                },
            };
            memory.shrink_to(kept);
            // The lane is gone only if the daemon drains.
            let _ = sender.send((prepared, memory));
        });
    }
}

pub(super) fn prepare(daemon: &Daemon, item: &JobItem) -> Prepared {
    match daemon.library.needs_description(item) {
        Ok(false) => Prepared::NotNeeded,
        Ok(true) => Prepared::Described(Box::new(describe(daemon, item))),
        Err(e) => Prepared::Described(Box::new(Err(convert::library_failure(&e)))),
    }
}

/// Describes one shape in a worker. What ends the worker is tried again, and is at last that shape's failure;
/// the attempts are counted durably, so that a restart does not begin anew.
fn describe(daemon: &Daemon, item: &JobItem) -> Outcome {
    let begin = Instant::now();
    let limit = Duration::from_secs(daemon.config().work.shape_seconds);
    let wanted = || {
        !daemon.is_draining()
            && begin.elapsed() < limit
            && !daemon.work.progress().is_cancelled(item.job)
    };
    let stage = |name: &str| {
        daemon.work.progress().set_stage(item, name);
        daemon.work.changed();
        wanted()
    };
    let describer = |job: &DescribeJob<'_>, observed: &dyn Fn(&str) -> bool| {
        let memory = Limits::to_describe(job.bytes.len() as u64);
        let observed = |name: &str| {
            observed(name);
        };
        loop {
            let (text, out_of_memory) = match daemon.pool.describe(job, memory, &observed, &wanted)
            {
                Ok(outcome) => return outcome,
                Err(Ended::Stopped) => return Err(cancelled()),
                Err(Ended::Died {
                    text,
                    out_of_memory,
                }) => (text, out_of_memory),
            };
            let attempts =
                note_death(daemon, item, &text).map_err(|e| convert::library_failure(&e))?;
            if attempts >= MAX_ATTEMPTS {
                return Err(died_each_time(&text, out_of_memory, attempts));
            }
            if !wanted() {
                return Err(cancelled());
            }
        }
    };
    let outcome = catch_unwind(AssertUnwindSafe(|| {
        daemon.library.describe_item_by(item, &stage, &describer)
    }));
    match outcome {
        Ok(Ok(described)) => Ok(described),
        Ok(Err(_)) if daemon.work.progress().is_cancelled(item.job) => Err(cancelled()),
        Ok(Err(failure)) if failure.code == "CANCELLED" && begin.elapsed() >= limit => {
            Err(too_long("describing", begin.elapsed(), limit))
        }
        Ok(Err(failure)) => Err(failure),
        Err(panic) => Err(panicked(&panic_text(panic.as_ref()))),
    }
}

/// Counts, durably, that the work on a shape has ended its worker; how often now, or 0 if the shape is over.
pub(super) fn note_death(daemon: &Daemon, item: &JobItem, text: &str) -> Result<u32, LibraryError> {
    let attempts = daemon.library.note_attempt(item, text)?;
    daemon.metrics.workers_died.inc();
    tracing::warn!(
        collection = item.collection,
        shape = item.name,
        attempts,
        text,
        "a worker ended while it worked on a shape"
    );
    Ok(attempts)
}

/// The failure of a shape whose last attempt ended its worker too.
pub(super) fn died_each_time(text: &str, out_of_memory: bool, attempts: u32) -> Failure {
    let what = format!("the work on this shape ended its process {attempts} times, the last time");
    died(&what, text, out_of_memory)
}

/// The failure of work that ended its worker.
pub(super) fn died(what: &str, text: &str, out_of_memory: bool) -> Failure {
    let reason = if out_of_memory {
        "SHAPE_MEMORY"
    } else {
        "WORKER_DIED"
    };
    let code = if out_of_memory {
        "RESOURCE_EXHAUSTED"
    } else {
        "INTERNAL"
    };
    failed(code, reason, format!("{what}: {text}"))
}

/// Bytes that a description holds until it is placed.
fn bytes_of(d: &Description) -> u64 {
    let floats = d.mass.len()
        + d.eigenvectors.len()
        + d.hks.len()
        + d.face_descriptors.len()
        + d.polygon_area.len()
        + d.signature.len();
    let integers = d.patches.len() + d.face_map.len();
    let triples = d.vertices.len() + d.faces.len();
    (4 * (floats + integers) + 12 * triples + 8 * d.eigenvalues.len()) as u64
}

pub(super) fn failed(code: &str, reason: &str, message: String) -> Failure {
    Failure {
        code: code.to_owned(),
        reason: reason.to_owned(),
        message,
        subject: None,
    }
}

pub(super) fn cancelled() -> Failure {
    let message = "the job was cancelled before this shape was placed".to_owned();
    failed("CANCELLED", "CANCELLED", message)
}

pub(super) fn too_long(doing: &str, took: Duration, limit: Duration) -> Failure {
    let (found, limit) = (took.as_secs_f64(), limit.as_secs());
    let message = format!("{doing} it took {found:.0} s, the limit is {limit} s");
    failed("DEADLINE_EXCEEDED", "SHAPE_TIMEOUT", message)
}
