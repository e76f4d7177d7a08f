//! Runs a daemon on an empty library in a temporary folder, and a client of its only collection.

use crate::error::BenchError;
use coseg::call;
use coseg::config::Config;
use coseg::daemon::{self, Running};
use coseg::ipc::client::{Client, ClientError};
use coseg::ipc::frames::FrameReader;
use coseg::ipc::wire;
use std::fs::Permissions;
use std::os::unix::fs::PermissionsExt as _;
use std::path::PathBuf;
use std::time::Duration;
use tracing_subscriber::EnvFilter;

/// Name of the only collection.
pub(crate) const COLLECTION: &str = "bench";
/// Time limit for the end of the daemon.
const DRAIN_LIMIT: Duration = Duration::from_secs(30);
/// Milliseconds that the daemon may wait before it answers that nothing has changed.
const WAIT_MS: u64 = 1_000;

/// Logs warnings of the daemon to stderr. Only the first call in a process has an effect.
pub(crate) fn log_warnings() {
    let lines = tracing_subscriber::fmt()
        .with_env_filter(EnvFilter::new("warn"))
        .with_writer(std::io::stderr);
    // An error means that a logger exists already.
    let _ = lines.try_init();
}

/// A daemon with default settings, and a client that is connected to it.
pub(crate) struct Session {
    pub(crate) client: Client,
    running: Option<Running>,
    // The last field, because the daemon has files there.
    folder: tempfile::TempDir,
}

impl Session {
    /// Starts the daemon; `patience` is the time limit for each answer.
    pub(crate) fn start(patience: Duration) -> Result<Self, BenchError> {
        let temporary = std::env::temp_dir();
        // It contains the daemon's socket, so others must not enter it.
        let folder = tempfile::Builder::new()
            .prefix("coseg-bench-")
            .permissions(Permissions::from_mode(0o700))
            .tempdir();
        let folder = folder.map_err(|e| BenchError::file(&temporary, e))?;
        let mut config = Config::default();
        config.server.endpoint = format!("ipc://{}/coseg.sock", folder.path().display());
        config.server.library = folder.path().join("library");
        let running = daemon::start(config)?;
        let client = Client::connect_with(&running.endpoint().to_string(), patience, None)?;
        Ok(Self {
            client,
            running: Some(running),
            folder,
        })
    }

    /// Ends the daemon. Its library, whose folder is returned, stays until the session is dropped.
    pub(crate) fn drain(&mut self) -> PathBuf {
        if let Some(running) = self.running.take() {
            running.drain(DRAIN_LIMIT);
        }
        self.folder.path().join("library")
    }

    /// Waits until the collection has no work left.
    pub(crate) fn wait_until_idle(&mut self) -> Result<(), BenchError> {
        loop {
            let request = wire::WaitIdleRequest {
                collection: COLLECTION.to_owned(),
                wait_ms: WAIT_MS,
            };
            if call!(self.client, WaitIdle(request))?.idle {
                return Ok(());
            }
        }
    }

    /// Waits for the end of a job and returns it.
    pub(crate) fn finished(&mut self, job_id: u64) -> Result<wire::Job, BenchError> {
        let mut revision = 0;
        loop {
            let request = wire::WatchJobRequest {
                job_id,
                revision,
                wait_ms: WAIT_MS,
            };
            let job = call!(self.client, WatchJob(request))?.job;
            let job = job.unwrap_or_default();
            if job.finished {
                return Ok(job);
            }
            revision = job.revision;
        }
    }

    /// Names of all shapes of the collection.
    pub(crate) fn shapes(&mut self) -> Result<Vec<String>, BenchError> {
        let mut names = Vec::new();
        let mut page_token = String::new();
        loop {
            let request = wire::ListShapesRequest {
                collection: COLLECTION.to_owned(),
                page_size: 0,
                page_token,
                label: None,
                review: wire::ReviewState::Unspecified.into(),
            };
            let reply = call!(self.client, ListShapes(request))?;
            names.extend(reply.shapes.into_iter().map(|s| s.name));
            page_token = reply.next_page_token;
            if page_token.is_empty() {
                return Ok(names);
            }
        }
    }

    /// The newest labels of a shape, one for each face of its file.
    pub(crate) fn labels(&mut self, shape: &str) -> Result<Vec<i32>, BenchError> {
        let request = wire::GetLabelsRequest {
            collection: COLLECTION.to_owned(),
            shape: shape.to_owned(),
            version: 0,
            confidence: false,
        };
        let (reply, frames) = call!(self.client, GetLabels(request), frames)?;
        let read = FrameReader::new(&frames).i32_array(reply.labels.as_ref(), "labels");
        let (labels, _) = read.map_err(|e| ClientError::BadReply(e.to_string()))?;
        Ok(labels)
    }
}
