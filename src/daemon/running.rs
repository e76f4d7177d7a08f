//! A daemon that is up: its reload and its drain.

use crate::config::Config;
use crate::daemon::shared::{Control, Daemon, Notice};
use crate::ipc::endpoint::Endpoint;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// How long requests in flight may take to be answered before the sockets close.
const LAST_ANSWERS: Duration = Duration::from_secs(2);

/// A daemon that is up. Dropping it without [`Running::drain`] ends it at once; the shapes that it
/// had accepted are resumed at the next start.
pub struct Running {
    pub(super) daemon: Arc<Daemon>,
    pub(super) runtime: Option<tokio::runtime::Runtime>,
    /// The runtime of HTTP.
    pub(super) pages: Option<tokio::runtime::Runtime>,
    pub(super) sockets: Option<std::thread::JoinHandle<()>>,
    pub(super) publisher: Option<tokio::task::JoinHandle<()>>,
    pub(super) ticks: Ticks,
    pub(super) control: std::sync::mpsc::Receiver<Control>,
}

/// Counters that stand still when a thread hangs.
#[derive(Clone, Default)]
pub(crate) struct Ticks {
    pub(crate) sockets: Arc<AtomicU64>,
    pub(crate) runtime: Arc<AtomicU64>,
}

impl Running {
    /// Where requests are taken.
    pub fn endpoint(&self) -> &Endpoint {
        &self.daemon.identity.endpoint
    }

    /// Where events are published.
    pub fn events(&self) -> &Endpoint {
        &self.daemon.identity.events
    }

    /// Where the viewer is served, if it is.
    pub fn http(&self) -> Option<SocketAddr> {
        self.daemon.identity.http
    }

    /// Applies the settings that can change while the daemon runs, and returns the names of the
    /// other settings that differ.
    pub fn reload(&self, new: &Config) -> Vec<&'static str> {
        let old = self.daemon.config();
        let mut config = (*old).clone();
        config.log.clone_from(&new.log);
        config.ingest.clone_from(&new.ingest);
        config.work.shape_seconds = new.work.shape_seconds;
        config.limits.clone_from(&new.limits);
        config.limits.max_message = old.limits.max_message;
        config.limits.max_requests = old.limits.max_requests;
        self.daemon.set_config(config);
        self.daemon.outbox.reload();
        pending_settings(&old, new)
    }

    /// Counts of the socket thread and of the runtime that stand still when either hangs.
    pub(super) fn ticks(&self) -> (u64, u64) {
        (
            self.ticks.sockets.load(Ordering::Relaxed),
            self.ticks.runtime.load(Ordering::Relaxed),
        )
    }

    /// Refuses changes, finishes the shapes that are being placed, answers the requests in flight,
    /// and ends; at most for `limit`. Accepted shapes that are not placed stay queued in the
    /// library.
    pub fn drain(mut self, limit: Duration) {
        let deadline = Instant::now() + limit;
        let Some(runtime) = self.runtime.take() else {
            return;
        };
        self.daemon.drain.send_replace(true);
        // Wakes those who wait for a change of the queues.
        self.daemon.work.progress().close();
        let daemon = Arc::clone(&self.daemon);
        let publisher = self.publisher.take();
        let last_work = async move {
            daemon.work.placing_ended().await;
            let admission = &daemon.admission;
            let max = u32::try_from(admission.max_in_flight).unwrap_or(u32::MAX);
            let answered = Arc::clone(&admission.in_flight).acquire_many_owned(max);
            if tokio::time::timeout(LAST_ANSWERS, answered).await.is_err() {
                tracing::warn!("some requests were not answered");
            }
            daemon.notice(Notice::Stop);
            if let Some(publisher) = publisher {
                let _ = publisher.await;
            }
        };
        // Inside, for the timer needs the runtime.
        let ended = runtime.block_on(async { tokio::time::timeout(limit, last_work).await });
        self.daemon.pool.close();
        // Here, for a thread that hangs keeps the library from being dropped.
        self.daemon.library.store().catalog().settle();
        if ended.is_err() {
            tracing::warn!("the drain took longer than {} s", limit.as_secs());
        }
        self.daemon.outbox.stop();
        if let Some(sockets) = self.sockets.take() {
            let _ = sockets.join();
        }
        if let Some(pages) = self.pages.take() {
            pages.shutdown_timeout(LAST_ANSWERS);
        }
        runtime.shutdown_timeout(
            deadline
                .saturating_duration_since(Instant::now())
                .min(LAST_ANSWERS),
        );
    }
}

/// Settings that differ and take effect at the next start only.
fn pending_settings(old: &Config, new: &Config) -> Vec<&'static str> {
    let (server, limits) = (&new.server, &new.limits);
    let settings = [
        ("server.endpoint", server.endpoint != old.server.endpoint),
        ("server.library", server.library != old.server.library),
        ("security.keys", new.security.keys != old.security.keys),
        ("http", new.http != old.http),
        ("work.workers", new.work.workers != old.work.workers),
        (
            "limits.max_message",
            limits.max_message != old.limits.max_message,
        ),
        (
            "limits.max_requests",
            limits.max_requests != old.limits.max_requests,
        ),
        ("log.format", new.log.format != old.log.format),
    ];
    let differs = settings.into_iter().filter(|(_, differs)| *differs);
    differs.map(|(key, _)| key).collect()
}

impl Drop for Running {
    fn drop(&mut self) {
        if let Some(pages) = self.pages.take() {
            pages.shutdown_background();
        }
        if let Some(runtime) = self.runtime.take() {
            self.daemon.outbox.stop();
            runtime.shutdown_background();
        }
    }
}
