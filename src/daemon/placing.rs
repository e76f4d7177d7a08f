//! Places the described shapes of one collection, strictly in order of acceptance. When there is
//! nothing to place, stale shapes are relabelled; when there are none, proposals are made.
//!
//! Workers do the work, as they do for describing, and attempts that end a worker are counted
//! together with those of describing. A worker commits by itself, so the catalog decides what
//! became of a shape.

use crate::daemon::describing::{MAX_ATTEMPTS, note_death, prepare};
use crate::daemon::failures::{cancelled, died_each_time, failed, panicked, too_long};
use crate::daemon::outcome::outcome;
use crate::daemon::proposing::{Next, Proposing};
use crate::daemon::shared::{Daemon, Notice, blocking};
use crate::daemon::work::{Outcome, Prepared, Step};
use crate::daemon::worker::{self, Ended, Placing};
use crate::library::{
    Code, Described, Failure, ItemState, JobItem, LibraryError, MAX_BATCH, Reason,
};
use crate::store::StoreError;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};
use tokio::sync::{mpsc, oneshot};

/// Delay before a failed write is tried again, doubled each time up to the last.
const FIRST_RETRY: Duration = Duration::from_secs(1);
const LAST_RETRY: Duration = Duration::from_secs(30);

/// Workers that ended while they relabelled shapes of a collection.
#[derive(Default)]
struct Deaths {
    /// In a row.
    n: u32,
    /// Shapes to relabel one by one, to find the one that ended the last.
    n_single: usize,
}

impl Deaths {
    /// Most shapes to relabel next.
    fn batch(&self) -> usize {
        match self.n_single {
            0 => MAX_BATCH,
            _ => 1,
        }
    }

    fn one(&mut self) {
        self.n += 1;
        self.n_single = MAX_BATCH;
    }

    fn none(&mut self) {
        self.n = 0;
        self.n_single = self.n_single.saturating_sub(1);
    }
}

/// The placement queue of a collection.
pub(crate) async fn place_in_order(
    daemon: Arc<Daemon>,
    collection: String,
    mut steps: mpsc::UnboundedReceiver<Step>,
) {
    let mut relabel = true;
    let mut deaths = Deaths::default();
    let mut proposing = Proposing::default();
    loop {
        let step = match steps.try_recv() {
            Ok(step) => step,
            Err(mpsc::error::TryRecvError::Empty) if relabel => {
                relabel = relabel_next(&daemon, &collection, &mut deaths).await;
                continue;
            }
            Err(mpsc::error::TryRecvError::Empty) if proposing.is_wanted() => {
                match proposing.next(&daemon, &collection, &mut steps).await {
                    Next::Again => continue,
                    Next::Step(step) => step,
                    Next::Ended => return,
                }
            }
            Err(_) => match steps.recv().await {
                Some(step) => step,
                None => return,
            },
        };
        let mut ready = match step {
            Step::Place(ready) => ready,
            Step::Relabel => {
                (relabel, deaths) = (true, Deaths::default());
                proposing = Proposing::default();
                continue;
            }
        };
        let prepared = loop {
            match ready.prepared.try_recv() {
                Ok(prepared) => break Ok(prepared),
                Err(oneshot::error::TryRecvError::Empty) if relabel => {
                    relabel = relabel_next(&daemon, &collection, &mut deaths).await;
                }
                Err(_) => break (&mut ready.prepared).await,
            }
        };
        // Draining: this shape and all after it stay queued.
        let Ok((prepared, _memory)) = prepared else {
            return;
        };
        let Some(outcome) = described(&daemon, &ready.item, prepared).await else {
            return;
        };
        if !place(&daemon, &ready.item, outcome).await {
            return;
        }
        relabel = true;
        proposing = Proposing::default();
    }
}

/// The outcome of describing, now that all shapes before it are placed. `None`: the daemon drains.
async fn described(daemon: &Arc<Daemon>, item: &JobItem, prepared: Prepared) -> Option<Outcome> {
    if let Prepared::Described(outcome) = prepared {
        return Some(*outcome);
    }
    let subject = item.clone();
    // A shape before it may have removed the reason why no description was needed.
    let described = blocking(daemon, move |d| match prepare(d, &subject) {
        Prepared::Described(outcome) => *outcome,
        // The library finds the reason by itself, and ignores this.
        Prepared::NotNeeded => Err(failed(
            Code::Internal,
            Reason::Gone,
            "it was not described".to_owned(),
        )),
    });
    let outcome = described
        .await
        .unwrap_or_else(|panic| Err(panicked(&panic)));
    (outcome.is_ok() || !daemon.is_draining()).then_some(outcome)
}

/// Places one shape and commits. False: the daemon drains and the shape stays queued.
async fn place(daemon: &Arc<Daemon>, item: &JobItem, mut outcome: Outcome) -> bool {
    if daemon.work.progress().is_cancelled(item.job) {
        outcome = Err(cancelled());
    }
    daemon.work.progress().set_stage(item, "place");
    daemon.work.changed();
    let mut delay = FIRST_RETRY;
    let mut draining = daemon.drain.subscribe();
    loop {
        let permit = Arc::clone(&daemon.capacity.placing).acquire_owned().await;
        let (again, subject) = (outcome.clone(), item.clone());
        let placed = blocking(daemon, move |d| place_remotely(d, &subject, again)).await;
        drop(permit);
        let failure = match placed {
            Ok(Ok(state)) => {
                report(daemon, item, &state);
                break;
            }
            // Nothing was written and the shape is still queued, until there is space again or the
            // daemon restarts.
            Ok(Err(LibraryError::Store(
                e @ (StoreError::NoSpace { .. } | StoreError::ReadOnly { .. }),
            ))) => {
                daemon.telemetry.metrics.fault("place");
                tracing::error!(
                    collection = item.collection, shape = item.name, error = %e,
                    "a shape cannot be stored; trying again in {} s", delay.as_secs()
                );
                tokio::select! {
                    () = tokio::time::sleep(delay) => {}
                    _ = draining.wait_for(|&d| d) => return false,
                }
                delay = (delay * 2).min(LAST_RETRY);
                continue;
            }
            Ok(Err(e)) => Failure::from(&e),
            Err(panic) => panicked(&panic),
        };
        if outcome.is_err() {
            // Not even the failure can be recorded: the collection or the job is gone.
            tracing::warn!(
                collection = item.collection,
                shape = item.name,
                job = item.job,
                message = failure.message,
                "a shape was dropped"
            );
            break;
        }
        outcome = Err(failure);
    }
    daemon.work.progress().finish(item);
    daemon.work.changed();
    daemon.notice(Notice::Changed(item.collection.clone()));
    true
}

/// Places one shape in a worker, if there is anything to place. Waits for the collection.
fn place_remotely(
    daemon: &Arc<Daemon>,
    item: &JobItem,
    outcome: Outcome,
) -> Result<ItemState, LibraryError> {
    let library = &daemon.library;
    let described = match outcome {
        Ok(described) => described,
        // Recording a failure needs no worker.
        Err(why) => return library.place_item(item, Err(why)),
    };
    let placed =
        library.with_exclusive(&item.collection, || try_to_place(daemon, item, &described));
    match placed {
        Ok(Ok(Ok(()))) => library.item_state(item),
        Ok(Ok(Err(why))) => library.place_item(item, Err(why)),
        Ok(Err(e)) => Err(e),
        // The collection is gone, which is recorded as well.
        Err(LibraryError::NotFound { .. }) => library.place_item(item, Ok(described)),
        Err(e) => Err(e),
    }
}

/// The attempts to place one shape. The inner error is why the shape has failed; otherwise the
/// catalog has its state.
fn try_to_place(
    daemon: &Arc<Daemon>,
    item: &JobItem,
    described: &Described,
) -> Result<Result<(), Failure>, LibraryError> {
    let library = &daemon.library;
    let ticket = library.placement_ticket(item, described)?;
    let n_bytes = library.item_bytes(item)?;
    let begin = Instant::now();
    let limit = Duration::from_secs(daemon.config().work.shape_seconds);
    let is_cancelled = || daemon.work.progress().is_cancelled(item.job);
    let wanted = || begin.elapsed() < limit && !is_cancelled();
    loop {
        let work = Placing::Place(&ticket.words, n_bytes);
        let (text, out_of_memory) = match daemon.pool.place(&item.collection, work, &wanted) {
            Ok(report) => match outcome(daemon, &report)? {
                worker::Outcome::Failed(why) if why.reason == Reason::Cancelled => {
                    return Ok(Ok(()));
                }
                worker::Outcome::Failed(why) => return Ok(Err(why)),
                worker::Outcome::State(_)
                | worker::Outcome::Relabelled(_)
                | worker::Outcome::Proposed(_) => return Ok(Ok(())),
            },
            Err(Ended::Stopped) => {
                // It may have been done in that moment.
                let state = library.item_state(item)?;
                return Ok(match state {
                    ItemState::Queued | ItemState::Running(_) if is_cancelled() => Err(cancelled()),
                    ItemState::Queued | ItemState::Running(_) => {
                        Err(too_long("placing", begin.elapsed(), limit))
                    }
                    _ => Ok(()),
                });
            }
            Err(Ended::Died {
                text,
                out_of_memory,
            }) => (text, out_of_memory),
        };
        match note_death(daemon, item, &text)? {
            // It was done, or cancelled, before the worker ended.
            0 => return Ok(Ok(())),
            n if n >= MAX_ATTEMPTS => return Ok(Err(died_each_time(&text, out_of_memory, n))),
            _ => {}
        }
    }
}

fn report(daemon: &Daemon, item: &JobItem, state: &ItemState) {
    let (collection, shape) = (&item.collection, &item.name);
    match state {
        ItemState::Done(placed) => {
            daemon.telemetry.metrics.placed(placed);
            // The shape that it replaced, or its own bytes if they were stored already, can go.
            if placed.outcome != crate::library::Outcome::Added {
                daemon.needs_sweep();
            }
            tracing::info!(
                collection, shape, outcome = ?placed.outcome, version = placed.version,
                ms = placed.stages_ms.iter().map(|(_, ms)| ms).sum::<f64>() as u64, "placed"
            );
        }
        ItemState::Failed(f) => {
            daemon.telemetry.metrics.finished("failed");
            daemon
                .telemetry
                .counters
                .failed
                .fetch_add(1, Ordering::Relaxed);
            tracing::warn!(
                collection,
                shape,
                code = %f.code,
                reason = %f.reason,
                message = f.message,
                "failed"
            );
        }
        ItemState::Cancelled => {
            daemon.telemetry.metrics.finished("cancelled");
            daemon.needs_sweep();
            tracing::info!(collection, shape, "cancelled");
        }
        ItemState::Queued | ItemState::Running(_) => {
            tracing::error!(collection, shape, "was placed but is not finished");
        }
    }
}

/// Relabels a batch of stale shapes of the collection. Returns false if none was stale, or none can
/// be relabelled now. A shape that ends its worker too often is not tried again before a change.
async fn relabel_next(daemon: &Arc<Daemon>, collection: &str, deaths: &mut Deaths) -> bool {
    if daemon.is_draining() || deaths.n >= MAX_ATTEMPTS {
        return false;
    }
    let most = deaths.batch();
    let permit = Arc::clone(&daemon.capacity.placing).acquire_owned().await;
    let name = collection.to_owned();
    let relabelled = blocking(daemon, move |d| relabel_remotely(d, &name, most)).await;
    drop(permit);
    let fault = |error: &str| {
        daemon.telemetry.metrics.fault("relabel");
        tracing::error!(collection, error, "a stale shape cannot be relabelled");
    };
    let n_shapes = match relabelled {
        Ok(Ok(Ok(n_shapes))) => {
            deaths.none();
            n_shapes
        }
        Ok(Ok(Err(death))) => {
            deaths.one();
            daemon.telemetry.metrics.workers_died.inc();
            fault(&death);
            return deaths.n < MAX_ATTEMPTS;
        }
        Ok(Err(LibraryError::NotFound { .. })) => 0,
        Ok(Err(e)) => {
            fault(&e.to_string());
            0
        }
        Err(panic) => {
            fault(&format!("it panicked: {panic}"));
            0
        }
    };
    let again = n_shapes > 0;
    if again {
        daemon.telemetry.metrics.relabelled.inc_by(n_shapes);
        daemon.notice(Notice::Changed(collection.to_owned()));
    }
    daemon.work.changed();
    again
}

/// How many shapes were relabelled, at most `most`. The inner error says what ended the worker.
fn relabel_remotely(
    daemon: &Arc<Daemon>,
    collection: &str,
    most: usize,
) -> Result<Result<u64, String>, LibraryError> {
    let library = &daemon.library;
    // Most often there is nothing to do, which shows without a worker.
    if !library.has_stale(collection)? {
        return Ok(Ok(0));
    }
    library.store().health().writable()?;
    let begin = Instant::now();
    let limit = Duration::from_secs(daemon.config().work.shape_seconds);
    let wanted = || begin.elapsed() < limit;
    let first = daemon.work.attention().of(collection);
    let work = Placing::Relabel(collection, most, &first);
    let report =
        library.with_exclusive(collection, || daemon.pool.place(collection, work, &wanted))?;
    match report {
        Ok(report) => match outcome(daemon, &report)? {
            worker::Outcome::Relabelled(n_shapes) => Ok(Ok(n_shapes)),
            worker::Outcome::Failed(why) => Ok(Err(why.message)),
            worker::Outcome::State(state) => Ok(Err(format!("a worker reported {state:?}"))),
            worker::Outcome::Proposed(_) => Ok(Err("a worker made proposals instead".to_owned())),
        },
        Err(Ended::Stopped) => Ok(Err(format!("it took more than {} s", limit.as_secs()))),
        Err(Ended::Died { text, .. }) => Ok(Err(text)),
    }
}
