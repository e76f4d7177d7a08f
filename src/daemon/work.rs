//! Accepted shapes that are not placed yet: their state in memory, and the messages to the
//! placement queues of their collections.

use crate::daemon::attention::Attention;
use crate::daemon::memory::Reservation;
use crate::daemon::progress::Progress;
use crate::library::{Described, Failure, JobItem};
use std::sync::{Mutex, MutexGuard, PoisonError};
use tokio::sync::futures::Notified;
use tokio::sync::{Notify, oneshot, watch};
use tokio::task::JoinSet;

/// The result of describing.
pub(crate) type Outcome = Result<Described, Failure>;

/// A shape on its way to its placement queue.
#[allow(clippy::large_enum_variant)] // one at a time for each worker, never in a collection
pub(crate) enum Prepared {
    /// It was described, or failed to be.
    Described(Box<Outcome>),
    /// When its turn to be described came, no description was needed: the same bytes were stored
    /// under its name, or others that it may not replace. Checked again when its turn to be placed
    /// comes.
    NotNeeded,
}

/// A message to a placement queue.
pub(crate) enum Step {
    /// Place this shape after all before it.
    Place(Ready),
    /// Some labels may have become stale.
    Relabel,
}

/// A shape whose description is under way.
pub(crate) struct Ready {
    pub(crate) item: JobItem,
    /// Dropped without a value if the daemon drains: the shape stays queued in the catalog.
    pub(crate) prepared: oneshot::Receiver<(Prepared, Reservation)>,
}

/// The work on accepted shapes.
pub(crate) struct Work {
    /// Locked for moments, by all who add, describe, place, cancel or report.
    progress: Mutex<Progress<Step>>,
    /// A shape waits to be described.
    arrived: Notify,
    /// Advances with every change, for those who wait for one.
    changes: watch::Sender<u64>,
    /// The tasks that place, one for each queue.
    placing: Mutex<JoinSet<()>>,
    /// What pages show. Locked for moments, by pages and by those who relabel.
    attention: Mutex<Attention>,
}

impl Work {
    pub(crate) fn new() -> Self {
        Self {
            progress: Mutex::new(Progress::new()),
            arrived: Notify::new(),
            changes: watch::Sender::new(0),
            placing: Mutex::new(JoinSet::new()),
            attention: Mutex::new(Attention::default()),
        }
    }

    pub(crate) fn attention(&self) -> MutexGuard<'_, Attention> {
        // A panic leaves it whole or without one name.
        self.attention
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn progress(&self) -> MutexGuard<'_, Progress<Step>> {
        // `Progress` panics half-way for broken invariants only, which are reported.
        self.progress.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Reports every change from now on.
    pub(crate) fn changes(&self) -> watch::Receiver<u64> {
        self.changes.subscribe()
    }

    pub(crate) fn changed(&self) {
        self.changes.send_modify(|n| *n += 1);
    }

    /// Completes when a shape waits to be described.
    pub(crate) fn arrived(&self) -> Notified<'_> {
        self.arrived.notified()
    }

    pub(crate) fn notify_arrival(&self) {
        self.arrived.notify_one();
    }

    pub(crate) fn spawn_placing(&self, queue: impl Future<Output = ()> + Send + 'static) {
        let mut placing = self.placing.lock().unwrap_or_else(PoisonError::into_inner);
        while placing.try_join_next().is_some() {}
        placing.spawn(queue);
    }

    /// Waits until nothing is placed any more. For draining: the queues must have been closed.
    pub(crate) async fn placing_ended(&self) {
        let mut placing = {
            let mut placing = self.placing.lock().unwrap_or_else(PoisonError::into_inner);
            std::mem::take(&mut *placing)
        };
        while placing.join_next().await.is_some() {}
    }
}
