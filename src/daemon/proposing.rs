//! Makes the proposals of a collection, step by step, while the daemon has nothing else to do.
//!
//! A step is ended as soon as a shape of any collection is to be placed or relabelled, and made
//! again later. It changes nothing but the proposals, so it does not hold the collection.

use crate::daemon::describing::MAX_ATTEMPTS;
use crate::daemon::outcome::outcome;
use crate::daemon::shared::{Daemon, blocking};
use crate::daemon::work::Step;
use crate::daemon::worker::{self, Ended, Placing};
use crate::library::LibraryError;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use tokio::sync::mpsc;

/// Nothing is proposed until nothing else has happened to the collection for so long: whoever sends
/// shapes one by one shall not wait for steps to end.
const QUIET: Duration = Duration::from_secs(1);

/// Whether proposals of a collection remain to be made.
#[derive(Default)]
pub(super) struct Proposing {
    is_done: bool,
    /// Whether the last step was made and nothing has happened since.
    is_quiet: bool,
    /// Steps that ended their worker, in a row.
    n_deaths: u32,
}

/// What a placement queue does next.
pub(super) enum Next {
    /// Looks again.
    Again,
    /// This step, which has arrived.
    Step(Step),
    /// Nothing: the queue is closed.
    Ended,
}

/// What became of a step towards proposals.
enum Made {
    One,
    /// Nothing remains.
    None,
    /// It was ended, since something else is to be done.
    Interrupted,
    /// It failed, for this reason.
    Failed(String),
    /// It ended its worker, for this reason.
    Died(String),
}

impl From<Option<Step>> for Next {
    fn from(step: Option<Step>) -> Self {
        step.map_or(Self::Ended, Self::Step)
    }
}

impl Proposing {
    pub(super) fn is_wanted(&self) -> bool {
        !self.is_done && self.n_deaths < MAX_ATTEMPTS
    }

    /// Makes a step, unless one of the placement queue arrives before it is done.
    pub(super) async fn next(
        &mut self,
        daemon: &Arc<Daemon>,
        collection: &str,
        steps: &mut mpsc::UnboundedReceiver<Step>,
    ) -> Next {
        let name = collection.to_owned();
        let lacks = blocking(daemon, move |d| d.library.lacks_proposals(&name)).await;
        // A collection that cannot be read is reported to those who ask for it.
        if !matches!(lacks, Ok(Ok(true))) {
            self.is_done = true;
            return Next::Again;
        }
        let quiet = match std::mem::take(&mut self.is_quiet) {
            true => Duration::ZERO,
            false => QUIET,
        };
        let ready = async {
            tokio::time::sleep(quiet).await;
            let permit = daemon.capacity.proposing.acquire().await;
            let mut changes = daemon.work.changes();
            while !is_idle(daemon) && changes.changed().await.is_ok() {}
            permit
        };
        let _permit = tokio::select! {
            permit = ready => permit,
            step = steps.recv() => return step.into(),
        };
        let stop = Arc::new(AtomicBool::new(false));
        let (name, is_stopped) = (collection.to_owned(), Arc::clone(&stop));
        let made = blocking(daemon, move |d| propose(d, &name, &is_stopped));
        tokio::pin!(made);
        let made = tokio::select! {
            made = &mut made => made,
            step = steps.recv() => {
                stop.store(true, Ordering::Relaxed);
                let _ = made.await;
                return step.into();
            }
        };
        self.note(daemon, collection, made);
        Next::Again
    }

    fn note(&mut self, daemon: &Daemon, collection: &str, made: Result<Made, String>) {
        let failed = |error: &str| {
            daemon.telemetry.metrics.fault("propose");
            tracing::error!(collection, error, "proposals cannot be made");
        };
        match made {
            Ok(Made::One) => (self.n_deaths, self.is_quiet) = (0, true),
            Ok(Made::None) => self.is_done = true,
            Ok(Made::Interrupted) => {}
            Ok(Made::Failed(error)) | Err(error) => {
                self.is_done = true;
                failed(&error);
            }
            Ok(Made::Died(error)) => {
                self.n_deaths += 1;
                daemon.telemetry.metrics.workers_died.inc();
                failed(&error);
            }
        }
    }
}

/// Whether no shape of any collection waits to be placed, or is placed or relabelled.
fn is_idle(daemon: &Daemon) -> bool {
    let capacity = &daemon.capacity;
    capacity.placing.available_permits() == capacity.n_workers
        && daemon.work.progress().n_live(None) == 0
}

/// Makes a step in a worker.
fn propose(daemon: &Arc<Daemon>, collection: &str, stop: &AtomicBool) -> Made {
    if let Err(e) = daemon.library.store().health().writable() {
        return Made::Failed(e.to_string());
    }
    let begin = Instant::now();
    let limit = Duration::from_secs(daemon.config().work.shape_seconds);
    let wanted = || {
        let is_stopped = stop.load(Ordering::Relaxed) || daemon.is_draining();
        !is_stopped && begin.elapsed() < limit && is_idle(daemon)
    };
    match daemon
        .pool
        .place(collection, Placing::Propose(collection), &wanted)
    {
        Ok(report) => match outcome(daemon, &report) {
            Ok(worker::Outcome::Proposed(true)) => Made::One,
            Ok(worker::Outcome::Proposed(false)) => Made::None,
            Ok(worker::Outcome::Failed(why)) => Made::Failed(why.message),
            Ok(other) => Made::Failed(format!("a worker reported {other:?}")),
            Err(LibraryError::NotFound { .. }) => Made::None,
            Err(e) => Made::Failed(e.to_string()),
        },
        Err(Ended::Stopped) if begin.elapsed() >= limit => {
            Made::Failed(format!("a step took more than {} s", limit.as_secs()))
        }
        Err(Ended::Stopped) => Made::Interrupted,
        Err(Ended::Died { text, .. }) => Made::Died(text),
    }
}
