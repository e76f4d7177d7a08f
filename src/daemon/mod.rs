//! The daemon: a shell around [`Library`] that takes requests over ZeroMQ and publishes events.
//!
//! One thread owns the sockets ([`sockets`]), a tokio runtime does the rest: [`requests`] sorts
//! what arrives into reads (side by side), changes (one after the other, in order of arrival) and
//! waits; [`work`] describes and [`placing`] places accepted shapes, [`asked`] answers what needs
//! computing, all three in processes of their own ([`worker`]); [`publish`] sends what the event
//! log gained. What browsers and monitors ask has a runtime of its own ([`http`]). Every queue is
//! bounded; beyond the bound a request is refused with a delay after which to retry.

mod access;
mod asked;
mod fair;
mod http;
mod ingest;
mod intake;
mod memory;
mod metrics;
mod outbox;
mod placing;
mod progress;
mod publish;
mod quota;
mod reads;
mod replies;
mod requests;
mod service;
mod sockets;
mod sweep;
mod waits;
mod work;
mod worker;
mod writes;

pub use http::TokenError;
pub use service::{ServeError, serve};
pub use worker::{POISON_VARIABLE, WORKER_COMMAND, run_worker};

use crate::Library;
use crate::config::{Config, ConfigError};
use crate::ipc::endpoint::{Endpoint, EndpointError};
use crate::ipc::keys::{AllowList, KeyError};
use crate::library::LibraryError;
use memory::Budget;
use metrics::Metrics;
use outbox::Outbox;
use progress::Waiting;
use publish::Notice;
use quota::Quotas;
use replies::Replies;
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, PoisonError, RwLock};
use std::time::{Duration, Instant};
use tokio::sync::{Semaphore, mpsc, watch};
use work::Work;

/// Requests between the socket thread and the runtime; a moment's worth.
const ARRIVAL_QUEUE: usize = 256;
/// How long the runtime is given to answer what was asked before the sockets close.
const LAST_ANSWERS: Duration = Duration::from_secs(2);

/// Why the daemon did not start.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)]
pub enum StartError {
    #[error(transparent)]
    Config(#[from] ConfigError),
    #[error(transparent)]
    Endpoint(#[from] EndpointError),
    #[error(transparent)]
    Keys(#[from] KeyError),
    #[error("this binary was built without CURVE; keys cannot be used")]
    NoCurve,
    #[error("library {path}: {source}")]
    Library { path: String, source: LibraryError },
    #[error("{endpoint}: {source}")]
    Socket {
        endpoint: String,
        source: zmq::Error,
    },
    #[error("a worker process cannot be started: {0}")]
    Worker(std::io::Error),
    #[error("http.listen {address}: {source}")]
    Http {
        address: std::net::SocketAddr,
        source: std::io::Error,
    },
    #[error(transparent)]
    Token(#[from] http::TokenError),
    #[error("threads cannot be started: {0}")]
    Threads(#[from] std::io::Error),
}

impl StartError {
    /// Whether the configuration or the command line must be changed.
    pub fn is_configuration(&self) -> bool {
        match self {
            Self::Config(_) | Self::Keys(_) | Self::NoCurve | Self::Token(_) => true,
            Self::Endpoint(e) => {
                !matches!(e, EndpointError::InUse { .. } | EndpointError::Io { .. })
            }
            Self::Library { .. }
            | Self::Socket { .. }
            | Self::Worker(_)
            | Self::Http { .. }
            | Self::Threads(_) => false,
        }
    }
}

/// Counts since the start.
#[derive(Default)]
struct Counters {
    requests: AtomicU64,
    refused: AtomicU64,
    failed: AtomicU64,
}

/// What all tasks of the daemon share.
struct Daemon {
    // Before the library: its workers end first.
    pool: worker::Pool,
    library: Library,
    config: RwLock<Arc<Config>>,
    endpoint: Endpoint,
    events: Endpoint,
    instance: String,
    started: Instant,
    counters: Arc<Counters>,
    metrics: Arc<Metrics>,
    /// Where the viewer is served, if it is.
    http: Option<std::net::SocketAddr>,
    request_memory: Arc<Budget>,
    /// Replies that are not sent yet.
    replies: Arc<Replies>,
    /// Bytes of messages that arrive.
    arriving: Arc<AtomicU64>,
    quotas: Arc<Quotas>,
    /// Who may connect, as it stands, if connections are authenticated.
    allowed: Option<watch::Receiver<Arc<AllowList>>>,
    describe_memory: Arc<Budget>,
    /// A permit for each thread that reads a file which a request names by path.
    reading: Arc<Semaphore>,
    /// Something was done since the last sweep after which files may be needed no more.
    freed: AtomicBool,
    /// A permit for each thread that may describe.
    workers: Arc<Semaphore>,
    n_workers: usize,
    /// A permit for each request that may be in hand.
    pending: Arc<Semaphore>,
    max_pending: usize,
    outbox: Arc<Outbox>,
    notices: mpsc::UnboundedSender<Notice>,
    work: Work,
    /// A permit for each shape that may be placed at a time.
    placing: Arc<Semaphore>,
    /// A permit for each change of labels that may be carried out at a time.
    changing: Semaphore,
    drain: watch::Sender<bool>,
    /// A client asked for the drain.
    asked_to_drain: std::sync::mpsc::Sender<service::Control>,
}

impl Daemon {
    fn config(&self) -> Arc<Config> {
        Arc::clone(&self.config.read().unwrap_or_else(PoisonError::into_inner))
    }

    /// Whether connections are authenticated.
    fn has_keys(&self) -> bool {
        self.allowed.is_some()
    }

    fn is_draining(&self) -> bool {
        *self.drain.borrow()
    }

    /// Notes that files may be needed no more.
    fn freed(&self) {
        self.freed.store(true, Ordering::Relaxed);
    }

    fn notice(&self, notice: Notice) {
        // The publisher ends last; without it nobody listens.
        let _ = self.notices.send(notice);
    }
}

/// Runs a call of the library on a thread that may block. The error is the text of a panic.
async fn blocking<T: Send + 'static>(
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

/// What a panic said.
fn panic_text(panic: &(dyn std::any::Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().map(|s| (*s).to_owned());
    text.or_else(|| panic.downcast_ref::<String>().cloned())
        .unwrap_or_else(|| "no message".to_owned())
}

/// A daemon that is up. Dropping it without [`Running::drain`] ends it at once; what it had accepted is
/// taken up at the next start.
pub struct Running {
    daemon: Arc<Daemon>,
    runtime: Option<tokio::runtime::Runtime>,
    /// That of HTTP.
    pages: Option<tokio::runtime::Runtime>,
    sockets: Option<std::thread::JoinHandle<()>>,
    publisher: Option<tokio::task::JoinHandle<()>>,
    socket_tick: Arc<AtomicU64>,
    runtime_tick: Arc<AtomicU64>,
    control: std::sync::mpsc::Receiver<service::Control>,
}

/// Opens the library, binds the sockets and takes up what the last run left.
pub fn start(config: Config) -> Result<Running, StartError> {
    let endpoint = match config.server.endpoint.as_str() {
        "" => Endpoint::default_for_user(),
        uri => Endpoint::parse(uri)?,
    };
    // First the socket: a second daemon should hear of the first, not of its library's lock.
    if config.has_keys() && zmq::has("curve") != Some(true) {
        return Err(StartError::NoCurve);
    }
    let access = access::Access::new(&config.security.keys)?;
    let allowed = access.allowed();
    let replies = Replies::new(config.limits.reply_bytes());
    let bound = sockets::bind(&endpoint, &config.limits, access, Arc::clone(&replies))?;
    let directory = config.library()?;
    let opened = |source| StartError::Library {
        path: directory.display().to_string(),
        source,
    };
    let library = Library::open(&directory).map_err(opened)?;
    let pages = http::bind(&config, &directory)?;
    let mut queued = Vec::new();
    for item in library.queued_items().map_err(opened)? {
        let n_bytes = library.item_bytes(&item).map_err(opened)?;
        queued.push(Waiting { item, n_bytes });
    }
    let collections = library.collections().map_err(opened)?;

    let (requests_in, requests_out) = mpsc::channel(ARRIVAL_QUEUE);
    let (notices, notices_out) = mpsc::unbounded_channel();
    let (asked_to_drain, control) = std::sync::mpsc::channel();
    let n_workers = config.n_workers();
    let store = library.store();
    let said = store.tell_endpoint(&bound.endpoint.to_string());
    said.and_then(|()| store.share_lock())
        .map_err(|e| opened(e.into()))?;
    let pool = worker::Pool::new(&directory, n_workers).map_err(StartError::Worker)?;
    let daemon = Arc::new(Daemon {
        pool,
        library,
        placing: Arc::new(Semaphore::new(n_workers)),
        changing: Semaphore::new(n_workers),
        endpoint: bound.endpoint.clone(),
        events: bound.events.clone(),
        instance: instance(),
        started: Instant::now(),
        counters: Arc::default(),
        metrics: Arc::new(Metrics::new()),
        http: pages.as_ref().and_then(http::Bound::address),
        request_memory: Budget::new(config.limits.request_bytes()),
        replies,
        arriving: Arc::default(),
        quotas: Quotas::new(&config.limits),
        allowed,
        describe_memory: Budget::new(config.limits.describe_bytes()),
        reading: Arc::new(Semaphore::new(ingest::MAX_THREADS)),
        // What the last run removed, it may not have swept.
        freed: AtomicBool::new(true),
        workers: Arc::new(Semaphore::new(n_workers)),
        n_workers,
        pending: Arc::new(Semaphore::new(config.limits.max_requests)),
        max_pending: config.limits.max_requests,
        outbox: Arc::clone(&bound.outbox),
        notices,
        work: Work::new(),
        drain: watch::Sender::new(false),
        asked_to_drain,
        config: RwLock::new(Arc::new(config)),
    });
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .thread_name("coseg")
        .enable_io()
        .enable_time()
        .build()?;
    let socket_tick = Arc::new(AtomicU64::new(0));
    let runtime_tick = Arc::new(AtomicU64::new(0));
    let guard = runtime.enter();
    // What a lane commits before the publisher runs is not lost: the log has it.
    let published: BTreeMap<_, _> = collections
        .iter()
        .map(|c| (c.spec.name.clone(), c.sequence))
        .collect();
    let publisher = tokio::spawn(publish::run(Arc::clone(&daemon), notices_out, published));
    for collection in collections.iter().filter(|c| c.n_stale > 0) {
        daemon.nudge(&collection.spec.name);
    }
    if !queued.is_empty() {
        tracing::info!(shapes = queued.len(), "taking up what the last run left");
    }
    daemon.take_up_items(queued);
    tokio::spawn(work::schedule(Arc::clone(&daemon)));
    tokio::spawn(requests::dispatch(Arc::clone(&daemon), requests_out));
    tokio::spawn(sweep::run(Arc::clone(&daemon)));
    tokio::spawn(tick(Arc::clone(&runtime_tick)));
    drop(guard);
    let serve = |pages: http::Bound| {
        let ticks = [&socket_tick, &runtime_tick];
        pages.serve(Arc::clone(&daemon), requests_in.clone(), ticks)
    };
    let pages = pages.map(serve).transpose()?;
    let shared = sockets::Shared {
        memory: Arc::clone(&daemon.request_memory),
        replies: Arc::clone(&daemon.replies),
        arriving: Arc::clone(&daemon.arriving),
        quotas: Arc::clone(&daemon.quotas),
        counters: Arc::clone(&daemon.counters),
        metrics: Arc::clone(&daemon.metrics),
        tick: Arc::clone(&socket_tick),
        max_message_bytes: daemon.config().limits.max_message.0,
    };
    let sockets = sockets::serve(bound, shared, requests_in)?;
    Ok(Running {
        daemon,
        runtime: Some(runtime),
        pages,
        sockets: Some(sockets),
        publisher: Some(publisher),
        socket_tick,
        runtime_tick,
        control,
    })
}

/// Differs between any two starts: process and time, or two starts of one process in one instant.
fn instance() -> String {
    static STARTS: AtomicU64 = AtomicU64::new(0);
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    let nanos = since.map_or(0, |d| d.as_nanos());
    format!(
        "{:x}-{nanos:x}-{:x}",
        std::process::id(),
        STARTS.fetch_add(1, Ordering::Relaxed)
    )
}

/// Shows the watchdog that the runtime runs tasks.
async fn tick(counter: Arc<AtomicU64>) {
    let mut interval = tokio::time::interval(Duration::from_millis(500));
    loop {
        interval.tick().await;
        counter.fetch_add(1, Ordering::Relaxed);
    }
}

impl Running {
    /// Where requests are taken.
    pub fn endpoint(&self) -> &Endpoint {
        &self.daemon.endpoint
    }

    /// Where events are published.
    pub fn events(&self) -> &Endpoint {
        &self.daemon.events
    }

    /// Where the viewer is served, if it is.
    pub fn http(&self) -> Option<std::net::SocketAddr> {
        self.daemon.http
    }

    /// Takes over the settings that can change while the daemon runs; the names of the others that differ
    /// are returned.
    pub fn reload(&self, new: &Config) -> Vec<&'static str> {
        let old = self.daemon.config();
        let mut config = (*old).clone();
        config.log.clone_from(&new.log);
        config.ingest.clone_from(&new.ingest);
        config.work.shape_seconds = new.work.shape_seconds;
        let max_message = old.limits.max_message;
        let max_requests = old.limits.max_requests;
        config.limits.clone_from(&new.limits);
        config.limits.max_message = max_message;
        config.limits.max_requests = max_requests;
        self.daemon
            .request_memory
            .set_limit(config.limits.request_bytes());
        self.daemon.replies.set_limit(config.limits.reply_bytes());
        self.daemon.quotas.set_limits(&config.limits);
        self.daemon.outbox.reload();
        self.daemon
            .describe_memory
            .set_limit(config.limits.describe_bytes());
        let mut waiting = Vec::new();
        for (key, differs) in [
            (
                "server.endpoint",
                new.server.endpoint != config.server.endpoint,
            ),
            (
                "server.library",
                new.server.library != config.server.library,
            ),
            ("security.keys", new.security.keys != config.security.keys),
            ("http", new.http != config.http),
            ("work.workers", new.work.workers != config.work.workers),
            ("limits.max_message", new.limits.max_message != max_message),
            (
                "limits.max_requests",
                new.limits.max_requests != max_requests,
            ),
            ("log.format", new.log.format != old.log.format),
        ] {
            if differs {
                waiting.push(key);
            }
        }
        *self
            .daemon
            .config
            .write()
            .unwrap_or_else(PoisonError::into_inner) = Arc::new(config);
        waiting
    }

    /// Counts of the socket thread and of the runtime that stand still when either hangs.
    fn ticks(&self) -> (u64, u64) {
        (
            self.socket_tick.load(Ordering::Relaxed),
            self.runtime_tick.load(Ordering::Relaxed),
        )
    }

    /// Refuses changes, finishes what is being placed, answers what was asked, and ends; at most for
    /// `limit`. What was accepted and not placed stays queued in the library.
    pub fn drain(mut self, limit: Duration) {
        let deadline = Instant::now() + limit;
        let Some(runtime) = self.runtime.take() else {
            return;
        };
        self.daemon.drain.send_replace(true);
        // Wakes whoever waits for a change, to be told.
        self.daemon.work.progress().close();
        let daemon = Arc::clone(&self.daemon);
        let publisher = self.publisher.take();
        let last_work = async move {
            daemon.lanes_ended().await;
            let max = u32::try_from(daemon.max_pending).unwrap_or(u32::MAX);
            let answered = Arc::clone(&daemon.pending).acquire_many_owned(max);
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
