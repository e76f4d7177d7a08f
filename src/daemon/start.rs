//! The start of the daemon: opens the library, binds the sockets, and resumes the work that the
//! previous run left.

use crate::Library;
use crate::config::Config;
use crate::daemon::access::Access;
use crate::daemon::error::StartError;
use crate::daemon::progress::Waiting;
use crate::daemon::replies::Replies;
use crate::daemon::running::{Running, Ticks};
use crate::daemon::shared::{Admission, Daemon, Identity, Parts};
use crate::daemon::worker::pool::Pool;
use crate::daemon::{bind, describing, dispatch, http, publish, sockets, sweep};
use crate::ipc::endpoint::Endpoint;
use crate::library::{CollectionInfo, LibraryError};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};
use tokio::sync::mpsc;

/// Requests between the socket thread and the runtime; a moment's worth.
const ARRIVAL_QUEUE: usize = 256;

/// The content of the library at the start.
struct Found {
    queued: Vec<Waiting>,
    collections: Vec<CollectionInfo>,
}

/// Opens the library, binds the sockets and resumes the work that the previous run left.
pub fn start(config: Config) -> Result<Running, StartError> {
    let endpoint = match config.server.endpoint.as_str() {
        "" => Endpoint::default_for_user(),
        uri => Endpoint::parse(uri)?,
    };
    if config.has_keys() && zmq::has("curve") != Some(true) {
        return Err(StartError::NoCurve);
    }
    let access = Access::new(&config.security.keys)?;
    let replies = Replies::new(config.limits.reply_bytes());
    let admission = Admission::new(&config, Arc::clone(&replies), access.allowed());
    // Before the library: a second daemon should report the first one, not its library's lock.
    let bound = bind::bind(&endpoint, &config.limits, access, replies)?;
    let directory = config.library()?;
    let opened = |source| StartError::Library {
        path: directory.display().to_string(),
        source,
    };
    let library = Library::open(&directory).map_err(opened)?;
    let pages = http::bind(&config, &directory)?;
    let found = find(&library).map_err(opened)?;
    share(&library, &bound.endpoint).map_err(opened)?;
    let pool = Pool::new(
        &directory,
        config.n_workers(),
        config.limits.prepared_bytes(),
    )
    .map_err(StartError::Worker)?;

    let (notices, notices_out) = mpsc::unbounded_channel();
    let (control_in, control) = std::sync::mpsc::channel();
    let daemon = Daemon::new(Parts {
        pool,
        library,
        identity: Identity {
            endpoint: bound.endpoint.clone(),
            events: bound.events.clone(),
            http: pages.as_ref().and_then(http::Bound::address),
            instance: instance(),
            started: Instant::now(),
        },
        admission,
        outbox: Arc::clone(&bound.outbox),
        notices,
        control: control_in,
        config,
    });
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .thread_name("coseg")
        .enable_io()
        .enable_time()
        .build()?;
    let guard = runtime.enter();
    let published = found.published();
    let publisher = tokio::spawn(publish::run(Arc::clone(&daemon), notices_out, published));
    resume(&daemon, found);
    let (requests_in, requests) = mpsc::channel(ARRIVAL_QUEUE);
    let ticks = Ticks::default();
    tokio::spawn(describing::schedule(Arc::clone(&daemon)));
    tokio::spawn(dispatch::run(Arc::clone(&daemon), requests));
    tokio::spawn(sweep::run(Arc::clone(&daemon)));
    tokio::spawn(tick(Arc::clone(&ticks.runtime)));
    drop(guard);
    let serve = |pages: http::Bound| pages.serve(Arc::clone(&daemon), requests_in.clone(), &ticks);
    let pages = pages.map(serve).transpose()?;
    let shared = sockets::Shared {
        admission: Arc::clone(&daemon.admission),
        telemetry: Arc::clone(&daemon.telemetry),
        tick: Arc::clone(&ticks.sockets),
        max_message_bytes: daemon.config().limits.max_message.0,
    };
    let sockets = sockets::serve(bound, shared, requests_in)?;
    Ok(Running {
        daemon,
        runtime: Some(runtime),
        pages,
        sockets: Some(sockets),
        publisher: Some(publisher),
        ticks,
        control,
    })
}

fn find(library: &Library) -> Result<Found, LibraryError> {
    let mut queued = Vec::new();
    for item in library.queued_items()? {
        let n_bytes = library.item_bytes(&item)?;
        queued.push(Waiting { item, n_bytes });
    }
    let collections = library.collections()?;
    Ok(Found {
        queued,
        collections,
    })
}

impl Found {
    /// The last event of each collection. Events that are committed before the publisher runs are
    /// not lost, since it reads the log.
    fn published(&self) -> BTreeMap<String, u64> {
        let sequences = self.collections.iter();
        sequences
            .map(|c| (c.spec.name.clone(), c.sequence))
            .collect()
    }
}

/// Lets workers open the library beside this process, and others find this daemon.
fn share(library: &Library, endpoint: &Endpoint) -> Result<(), LibraryError> {
    let store = library.store();
    store.tell_endpoint(&endpoint.to_string())?;
    Ok(store.share_lock()?)
}

/// Resumes the shapes, the stale labels and the proposals that the previous run left.
fn resume(daemon: &Arc<Daemon>, found: Found) {
    for collection in &found.collections {
        let name = &collection.spec.name;
        // A collection that cannot be read is reported to those who ask for it.
        if collection.n_stale > 0 || daemon.library.lacks_proposals(name).unwrap_or(false) {
            daemon.nudge(name);
        }
    }
    let queued = found.queued;
    if !queued.is_empty() {
        tracing::info!(shapes = queued.len(), "resuming what the previous run left");
    }
    daemon.resume_items(queued);
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
