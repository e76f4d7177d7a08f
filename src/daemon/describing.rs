//! Describes accepted shapes in parallel, as many at a time as there are workers and memory for.
//! Collections take turns.
//!
//! The placement queue of a shape's collection learns of the shape before its description begins,
//! so shapes are placed in the order of acceptance, whichever description is finished first.

use crate::config::Limits;
use crate::daemon::answer::panic_text;
use crate::daemon::failures::{cancelled, died_each_time, panicked, too_long};
use crate::daemon::shared::Daemon;
use crate::daemon::work::{Outcome, Prepared, Ready, Step};
use crate::daemon::worker::Ended;
use crate::library::isolate::DescribeJob;
use crate::library::{Code, Failure, JobItem, LibraryError};
use crate::pipeline::Description;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::oneshot;

/// Attempts at a shape that may end their worker before the shape has failed.
pub(crate) const MAX_ATTEMPTS: u32 = 3;

/// Describes waiting shapes until the daemon drains.
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
        let worker = Arc::clone(&daemon.capacity.describing)
            .acquire_owned()
            .await;
        let worker = worker.expect("invariant: the semaphore is never closed");
        let (waiting, queue) = loop {
            let arrived = daemon.work.arrived();
            // Not in the match: the lock must not be held while waiting.
            let next = daemon.work.progress().pop();
            match next {
                Some(next) => break next,
                None => arrived.await,
            }
        };
        let memory = daemon
            .capacity
            .describe_memory
            .reserve(Limits::to_describe(waiting.n_bytes))
            .await;
        let (sender, prepared) = oneshot::channel();
        // Before describing begins, so that the queue has its shapes in order of acceptance.
        if queue
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
                let secs = begin.elapsed().as_secs_f64() / daemon.capacity.n_workers.max(1) as f64;
                daemon.work.progress().note_pace(waiting.n_bytes, secs);
            }
            drop(worker);
            let held = match &prepared {
                Prepared::NotNeeded => 0,
                Prepared::Described(outcome) => match outcome.as_ref() {
                    Ok(d) => bytes_of(&d.description),
                    // Probably stopped by the drain: it is described again at the next start.
                    Err(_) if daemon.is_draining() => return,
                    Err(_) => 0,
                },
            };
            memory.shrink_to(held);
            // The queue is gone only if the daemon drains.
            let _ = sender.send((prepared, memory));
        });
    }
}

pub(crate) fn prepare(daemon: &Daemon, item: &JobItem) -> Prepared {
    match daemon.library.needs_description(item) {
        Ok(false) => Prepared::NotNeeded,
        Ok(true) => Prepared::Described(Box::new(describe(daemon, item))),
        Err(e) => Prepared::Described(Box::new(Err(Failure::from(&e)))),
    }
}

/// Describes one shape in a worker. A shape that ends its worker is tried again, up to
/// [`MAX_ATTEMPTS`]. The attempts are counted durably, so that a restart does not forget them.
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
            let attempts = note_death(daemon, item, &text).map_err(|e| Failure::from(&e))?;
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
        Ok(Err(failure)) if failure.code == Code::Cancelled && begin.elapsed() >= limit => {
            Err(too_long("describing", begin.elapsed(), limit))
        }
        Ok(Err(failure)) => Err(failure),
        Err(panic) => Err(panicked(&panic_text(panic.as_ref()))),
    }
}

/// Counts, durably, that the work on a shape has ended its worker. Returns the number of such
/// attempts, or 0 if the shape is finished.
pub(crate) fn note_death(daemon: &Daemon, item: &JobItem, text: &str) -> Result<u32, LibraryError> {
    let attempts = daemon.library.note_attempt(item, text)?;
    daemon.telemetry.metrics.workers_died.inc();
    tracing::warn!(
        collection = item.collection,
        shape = item.name,
        attempts,
        text,
        "a worker ended while it worked on a shape"
    );
    Ok(attempts)
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
