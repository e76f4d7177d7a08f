//! Frees disk space: removes files without a reference a moment after the reference goes, forgets
//! old replies and jobs every hour, and keeps a reserve for removals on a full disk.

use crate::daemon::shared::{Daemon, blocking};
use crate::store::objects::ORPHAN_AGE;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

/// Time between rounds.
const ROUND: Duration = Duration::from_secs(10);
/// How long a file stays after its row is gone: a reader that found the row before may be about to
/// open it.
const GRACE: Duration = Duration::from_secs(10);
/// Rounds between looks at everything: an hour.
const ROUNDS: u32 = 360;

/// Sweeps now and then; never at start.
pub(crate) async fn run(daemon: Arc<Daemon>) {
    let mut round = 0_u32;
    loop {
        tokio::time::sleep(ROUND).await;
        round = (round + 1) % ROUNDS;
        let all = round == 0;
        if all {
            match blocking(&daemon, |d| d.library.forget_old()).await {
                Ok(Ok((replies, jobs))) => {
                    tracing::debug!(replies, jobs, "forgot old replies and jobs")
                }
                Ok(Err(e)) => {
                    tracing::warn!(error = %e, "old replies and jobs cannot be forgotten")
                }
                Err(panic) => tracing::error!(panic, "forgetting old replies panicked"),
            }
        }
        let swept = blocking(&daemon, move |d| {
            let store = d.library.store();
            store.keep_reserve();
            if store.health().read_only().is_some() {
                return Ok(Vec::new());
            }
            if all {
                return store.sweep_orphans(ORPHAN_AGE);
            }
            if d.unswept.swap(false, Ordering::Relaxed)
                && let Err(e) = store.release_unreferenced()
            {
                d.unswept.store(true, Ordering::Relaxed);
                return Err(e);
            }
            store.reclaim(GRACE)
        });
        match swept.await {
            Ok(Ok(files)) if files.is_empty() => {}
            Ok(Ok(files)) => tracing::info!(n_files = files.len(), "removed files nothing needs"),
            Ok(Err(e)) => {
                daemon.telemetry.metrics.fault("sweep");
                tracing::warn!(error = %e, "files nothing needs cannot be removed");
            }
            Err(panic) => tracing::error!(panic, "removing files nothing needs panicked"),
        }
    }
}
