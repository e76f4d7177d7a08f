//! Answers to requests that wait: for a job to change, for shapes to be placed, until no work is
//! left. They hold no thread.

use crate::daemon::answer::{Answer, MAX_WAIT_MS, draining, panicked, refused};
use crate::daemon::operation::Wait;
use crate::daemon::reads::{job_to_wire, n_stale};
use crate::daemon::shared::{Daemon, blocking};
use crate::ipc::convert;
use crate::ipc::wire::{self, ErrorReason, error::Subject, reply};
use std::sync::Arc;
use std::time::Duration;

/// `watch_job` reports changes no faster than this, so that a client that watches on at once does
/// not read a job from the catalog a thousand times a second.
const WATCH_PACE: Duration = Duration::from_millis(50);

/// Waits for what the request names.
pub(crate) async fn wait(daemon: &Arc<Daemon>, wait: &Wait) -> Answer {
    match wait {
        Wait::WatchJob(request) => watch_job(daemon, request).await,
        Wait::WaitIdle(request) => wait_idle(daemon, request).await,
    }
}

async fn read_job(daemon: &Arc<Daemon>, job: u64) -> Result<wire::Job, wire::Error> {
    let read = blocking(daemon, move |d| {
        d.library.job(job).map(|j| job_to_wire(d, &j))
    })
    .await;
    match read {
        Ok(Ok(job)) => Ok(job),
        Ok(Err(e)) => Err(refused(e)),
        Err(panic) => Err(panicked(&panic)),
    }
}

/// The answer to AddShapes with ADD_MODE_WAIT.
pub(crate) async fn wait_placed(daemon: &Arc<Daemon>, job: u64) -> Answer {
    let mut changes = daemon.work.changes();
    let mut drain = daemon.drain.subscribe();
    while daemon.work.progress().revision(job).is_some() {
        tokio::select! {
            _ = changes.changed() => {}
            _ = drain.wait_for(|&d| d) => break,
        }
    }
    let job = read_job(daemon, job).await?;
    if !job.finished {
        return Err(convert::with_subject(
            draining(),
            Subject::JobId(job.job_id),
        ));
    }
    let reply = convert::add_shapes(job.job_id, job.items.len(), Some(job));
    Ok((reply::Result::AddShapes(reply), Vec::new()))
}

fn wait_limit(ms: u64) -> Result<Duration, wire::Error> {
    if ms <= MAX_WAIT_MS {
        return Ok(Duration::from_millis(ms));
    }
    let text = format!("wait_ms is {ms}, the limit is {MAX_WAIT_MS}");
    Err(convert::field_error(
        ErrorReason::FieldRange,
        "wait_ms",
        text,
    ))
}

async fn watch_job(daemon: &Arc<Daemon>, request: &wire::WatchJobRequest) -> Answer {
    let begin = tokio::time::Instant::now();
    let until = begin + wait_limit(request.wait_ms)?;
    let mut changes = daemon.work.changes();
    let mut drain = daemon.drain.subscribe();
    loop {
        let revision = daemon.work.progress().revision(request.job_id);
        let revision = match revision {
            Some(revision) => revision,
            // Finished, or a correction that is propagated, which only the catalog knows.
            None => match read_job(daemon, request.job_id).await? {
                job if job.finished => break,
                job => job.revision,
            },
        };
        if revision != request.revision && begin.elapsed() >= WATCH_PACE {
            break;
        }
        let pace = begin + WATCH_PACE;
        let wake = if revision == request.revision {
            until
        } else {
            pace.min(until)
        };
        tokio::select! {
            _ = changes.changed() => {}
            () = tokio::time::sleep_until(wake) => {
                if wake == until {
                    break;
                }
            }
            _ = drain.wait_for(|&d| d) => break,
        }
    }
    let job = read_job(daemon, request.job_id).await?;
    Ok((
        reply::Result::WatchJob(wire::WatchJobReply { job: Some(job) }),
        Vec::new(),
    ))
}

async fn wait_idle(daemon: &Arc<Daemon>, request: &wire::WaitIdleRequest) -> Answer {
    let until = tokio::time::Instant::now() + wait_limit(request.wait_ms)?;
    let mut changes = daemon.work.changes();
    let mut drain = daemon.drain.subscribe();
    let name = Some(request.collection.clone()).filter(|c| !c.is_empty());
    loop {
        let collection = name.clone();
        let counted = blocking(daemon, move |d| n_stale(d, collection.as_deref())).await;
        let n_stale = match counted {
            Ok(Ok(n)) => n,
            Ok(Err(e)) => return Err(refused(e)),
            Err(panic) => return Err(panicked(&panic)),
        };
        let n_queued = daemon.work.progress().n_live(name.as_deref()) as u64;
        let idle = n_stale == 0 && n_queued == 0;
        let over = idle || tokio::time::Instant::now() >= until || daemon.is_draining();
        if over {
            let reply = wire::WaitIdleReply {
                idle,
                n_queued,
                n_stale,
            };
            return Ok((reply::Result::WaitIdle(reply), Vec::new()));
        }
        // Shapes change their stage often; only the end of the last one matters.
        let pause = async {
            if n_queued > 0 {
                while daemon.work.progress().n_live(name.as_deref()) as u64 == n_queued
                    && changes.changed().await.is_ok()
                {}
            } else {
                let _ = changes.changed().await;
            }
        };
        tokio::select! {
            () = pause => {}
            () = tokio::time::sleep_until(until) => {}
            _ = drain.wait_for(|&d| d) => {}
        }
    }
}
