//! The state that the tasks and threads of the daemon share, in groups by purpose.
//!
//! Nothing here is locked across an await or a call of the library. Each field locks itself, if it
//! changes at all; the comments say who changes it.

use crate::Library;
use crate::config::Config;
use crate::daemon::answer::panic_text;
use crate::daemon::memory::Budget;
use crate::daemon::metrics::Metrics;
use crate::daemon::outbox::Outbox;
use crate::daemon::quota::Quotas;
use crate::daemon::replies::Replies;
use crate::daemon::work::Work;
use crate::daemon::worker::pool::Pool;
use crate::ipc::endpoint::Endpoint;
use crate::ipc::keys::AllowList;
use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, PoisonError, RwLock};
use std::time::Instant;
use tokio::sync::{Semaphore, mpsc, watch};

/// Threads that may be reading files that requests name, or hang in it, at a time.
const MAX_READING_THREADS: usize = 128;

/// The shared state.
pub(crate) struct Daemon {
    /// Worker processes. Before the library, since fields are dropped in order and its workers must
    /// end first.
    pub(crate) pool: Pool,
    /// All handlers use it; it locks each collection while it changes.
    pub(crate) library: Library,
    /// Replaced by the main thread when the configuration is reloaded; everybody else takes the
    /// current one.
    config: RwLock<Arc<Config>>,
    pub(crate) identity: Identity,
    /// Shared with the socket thread, which admits requests before the runtime sees them.
    pub(crate) admission: Arc<Admission>,
    pub(crate) capacity: Capacity,
    /// Shared with the socket thread, which counts what it receives and sends.
    pub(crate) telemetry: Arc<Telemetry>,
    /// Accepted shapes; intake adds them, describing and placing take them.
    pub(crate) work: Work,
    /// The way to the socket thread, for every task that answers or publishes.
    pub(crate) outbox: Arc<Outbox>,
    /// The way to the publisher, for every task that commits.
    notices: mpsc::UnboundedSender<Notice>,
    /// Becomes true once, by the main thread; tasks that wait observe it.
    pub(crate) drain: watch::Sender<bool>,
    /// The way to the main thread, for a drain request and for signals.
    pub(crate) control: std::sync::mpsc::Sender<Control>,
    /// Set by changes after which files may have no reference any more, cleared by the sweep.
    pub(crate) unswept: AtomicBool,
}

/// Values that are fixed at the start.
pub(crate) struct Identity {
    pub(crate) endpoint: Endpoint,
    /// Where events are published.
    pub(crate) events: Endpoint,
    /// Where the viewer is served, if it is.
    pub(crate) http: Option<SocketAddr>,
    /// Differs between any two starts.
    pub(crate) instance: String,
    pub(crate) started: Instant,
}

/// The bounds of requests, from their arrival until their replies are sent.
pub(crate) struct Admission {
    /// Memory of requests. The socket thread reserves, handlers give back.
    pub(crate) memory: Arc<Budget>,
    /// Memory of replies that are not sent yet. The outbox reserves, libzmq gives back.
    pub(crate) replies: Arc<Replies>,
    /// Requests and bytes of each client. The socket thread and HTTP count, handlers give back.
    pub(crate) quotas: Arc<Quotas>,
    /// A permit for each request in flight. The dispatcher takes one, the reply gives it back, and
    /// a drain takes all to see that none is left.
    pub(crate) in_flight: Arc<Semaphore>,
    pub(crate) max_in_flight: usize,
    /// The current allow list, if connections are authenticated. The socket thread replaces it;
    /// requests in flight observe it.
    pub(crate) allowed: Option<watch::Receiver<Arc<AllowList>>>,
}

/// How much work is done at a time. Tasks of the runtime wait for permits here.
pub(crate) struct Capacity {
    pub(crate) n_workers: usize,
    /// Memory of shapes that are described or wait to be placed.
    pub(crate) describe_memory: Arc<Budget>,
    /// A permit for each thread that may describe.
    pub(crate) describing: Arc<Semaphore>,
    /// A permit for each shape that may be placed at a time.
    pub(crate) placing: Arc<Semaphore>,
    /// A permit for the collection whose proposals are made.
    pub(crate) proposing: Semaphore,
    /// A permit for each edit that may be carried out at a time.
    pub(crate) editing: Semaphore,
    /// A permit for each thread that reads a file which a request names by path.
    pub(crate) reading: Arc<Semaphore>,
}

/// Counts and metrics. All of them are atomic or lock themselves.
pub(crate) struct Telemetry {
    pub(crate) counters: Counters,
    pub(crate) metrics: Metrics,
    /// Bytes of messages that are not complete yet, as the socket thread last saw.
    pub(crate) arriving: AtomicU64,
}

/// Counts since the start, for `stats`.
#[derive(Default)]
pub(crate) struct Counters {
    pub(crate) requests: AtomicU64,
    pub(crate) refused: AtomicU64,
    pub(crate) failed: AtomicU64,
}

/// A message to the publisher.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Notice {
    /// Something may have been committed to the collection.
    Changed(String),
    /// The collection was created, by the event with this number.
    Created(String, u64),
    /// Nothing more will be committed.
    Stop,
}

/// A message to the main thread.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Control {
    /// Finish and end.
    Drain,
    /// Read the configuration again.
    Reload,
}

/// The parts that a start has opened and bound.
pub(crate) struct Parts {
    pub(crate) config: Config,
    pub(crate) library: Library,
    pub(crate) pool: Pool,
    pub(crate) identity: Identity,
    pub(crate) admission: Admission,
    pub(crate) outbox: Arc<Outbox>,
    pub(crate) notices: mpsc::UnboundedSender<Notice>,
    pub(crate) control: std::sync::mpsc::Sender<Control>,
}

impl Daemon {
    pub(crate) fn new(parts: Parts) -> Arc<Self> {
        let capacity = Capacity::new(&parts.config);
        Arc::new(Self {
            pool: parts.pool,
            library: parts.library,
            config: RwLock::new(Arc::new(parts.config)),
            identity: parts.identity,
            admission: Arc::new(parts.admission),
            capacity,
            telemetry: Arc::new(Telemetry {
                counters: Counters::default(),
                metrics: Metrics::new(),
                arriving: AtomicU64::new(0),
            }),
            work: Work::new(),
            outbox: parts.outbox,
            notices: parts.notices,
            drain: watch::Sender::new(false),
            control: parts.control,
            // The previous run may not have swept everything that it removed.
            unswept: AtomicBool::new(true),
        })
    }

    pub(crate) fn config(&self) -> Arc<Config> {
        Arc::clone(&self.config.read().unwrap_or_else(PoisonError::into_inner))
    }

    /// Replaces the configuration, and the limits that follow from it.
    pub(crate) fn set_config(&self, config: Config) {
        let limits = &config.limits;
        self.admission.memory.set_limit(limits.request_bytes());
        self.admission.replies.set_limit(limits.reply_bytes());
        self.admission.quotas.set_limits(limits);
        let describing = &self.capacity.describe_memory;
        describing.set_limit(limits.describe_bytes() - limits.prepared_bytes());
        *self.config.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(config);
    }

    /// Whether connections are authenticated.
    pub(crate) fn has_keys(&self) -> bool {
        self.admission.allowed.is_some()
    }

    pub(crate) fn is_draining(&self) -> bool {
        *self.drain.borrow()
    }

    /// Notes that files may have no reference any more.
    pub(crate) fn needs_sweep(&self) {
        self.unswept.store(true, Ordering::Relaxed);
    }

    pub(crate) fn notice(&self, notice: Notice) {
        // The publisher ends last; without it nobody needs the notice.
        let _ = self.notices.send(notice);
    }
}

impl Admission {
    pub(crate) fn new(
        config: &Config,
        replies: Arc<Replies>,
        allowed: Option<watch::Receiver<Arc<AllowList>>>,
    ) -> Self {
        let max_in_flight = config.limits.max_requests;
        Self {
            memory: Budget::new(config.limits.request_bytes()),
            replies,
            quotas: Quotas::new(&config.limits),
            in_flight: Arc::new(Semaphore::new(max_in_flight)),
            max_in_flight,
            allowed,
        }
    }
}

impl Capacity {
    fn new(config: &Config) -> Self {
        let (n_workers, limits) = (config.n_workers(), &config.limits);
        Self {
            n_workers,
            describe_memory: Budget::new(limits.describe_bytes() - limits.prepared_bytes()),
            describing: Arc::new(Semaphore::new(n_workers)),
            placing: Arc::new(Semaphore::new(n_workers)),
            proposing: Semaphore::new(1),
            editing: Semaphore::new(n_workers),
            reading: Arc::new(Semaphore::new(MAX_READING_THREADS)),
        }
    }
}

/// Runs a call of the library on a thread that may block. The error is the text of a panic.
pub(crate) async fn blocking<T: Send + 'static>(
    daemon: &Arc<Daemon>,
    work: impl FnOnce(&Arc<Daemon>) -> T + Send + 'static,
) -> Result<T, String> {
    let daemon = Arc::clone(daemon);
    let joined = tokio::task::spawn_blocking(move || work(&daemon)).await;
    joined.map_err(|e| match e.try_into_panic() {
        Ok(panic) => panic_text(panic.as_ref()),
        Err(e) => e.to_string(),
    })
}
