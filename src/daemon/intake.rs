//! Accepts shapes: reserves room in the queue, writes files in parallel, and accepts the shapes in
//! the order of their arrival, several requests in one transaction if they wait.

use crate::daemon::answer::{panicked, refused};
use crate::daemon::fair::{Client, Gate, Pass, Turn};
use crate::daemon::ingest::Files;
use crate::daemon::progress::Load;
use crate::daemon::shared::{Daemon, Notice, blocking};
use crate::daemon::writes::{Done, may_change};
use crate::ipc::convert::{self, Source};
use crate::ipc::frames::FrameReader;
use crate::ipc::size::in_words;
use crate::ipc::wire::{self, ErrorCode, ErrorReason, reply::Result as Reply};
use crate::library::{
    Job, LibraryError, NewShape, RequestKey, StoredOriginals, Submission, check_shape_name,
};
use bytes::Bytes;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Instant;
use tokio::sync::{mpsc, oneshot};

/// Milliseconds, at least and at most, after which a client should try a full queue again.
const QUEUE_RETRY_MS: (u64, u64) = (250, 60_000);
/// Additions that are accepted in one transaction at most.
const MAX_TOGETHER: usize = 64;

/// Room in the queue for shapes that are being added, given back when dropped.
pub(crate) struct Room {
    daemon: Arc<Daemon>,
    n_bytes: Vec<u64>,
}

impl Room {
    /// Reserves room for so many shapes, whatever their size, or refuses them.
    pub(crate) fn reserve(daemon: &Arc<Daemon>, n_shapes: usize) -> Result<Self, wire::Error> {
        let mut room = Self {
            daemon: Arc::clone(daemon),
            n_bytes: Vec::new(),
        };
        // A drain is the better reason to report, and shapes that the queue can never hold are
        // refused later, with the exact limit.
        match room.resize(vec![0; n_shapes]) {
            Err(full) if full.code() == ErrorCode::ResourceExhausted && !daemon.is_draining() => {
                Err(full)
            }
            _ => Ok(room),
        }
    }

    /// Reserves room for shapes of so many bytes in place of the present reservation, which stays
    /// if there is no room. The queue is bounded by number, by bytes, and by the estimated time
    /// until all of it is placed.
    fn resize(&mut self, n_bytes: Vec<u64>) -> Result<(), wire::Error> {
        let mut progress = self.daemon.work.progress();
        progress.release(&self.n_bytes);
        let admitted = admit(&self.daemon, &progress.load(), &n_bytes);
        if admitted.is_ok() {
            self.n_bytes = n_bytes;
        }
        progress.reserve(&self.n_bytes);
        admitted
    }
}

impl Drop for Room {
    fn drop(&mut self) {
        self.daemon.work.progress().release(&self.n_bytes);
    }
}

/// Shapes whose files are durable, to be accepted in turn.
pub(crate) struct Addition {
    request: wire::AddShapesRequest,
    key: Option<RequestKey>,
    shapes: StoredOriginals,
    room: Room,
}

/// Writes the files of shapes, durably. Whether the collection exists is checked in their turn,
/// since an earlier request may create it.
pub(crate) fn store_originals(
    daemon: &Arc<Daemon>,
    request: wire::AddShapesRequest,
    frames: &[Bytes],
    mut room: Room,
    key: Option<RequestKey>,
    deadline: Option<Instant>,
) -> Result<Addition, wire::Error> {
    may_change(daemon, key.as_ref())?;
    let limits = &daemon.config().limits;
    let ingest = convert::Ingest {
        max_shapes: limits.max_shapes_per_request,
        max_shape_bytes: limits.shape_bytes(),
    };
    let inputs = convert::new_shapes(&request, FrameReader::new(frames), &ingest)?;
    let files = Files::new(daemon, deadline);
    let mut n_bytes = Vec::with_capacity(inputs.len());
    for (i, input) in inputs.iter().enumerate() {
        let length = match &input.source {
            Source::Bytes(bytes) => bytes.len() as u64,
            Source::File(path) => files.length(path)?,
        };
        ingest.check_length(i, &input.name, length)?;
        n_bytes.push(length);
    }
    room.resize(n_bytes.clone())?;
    for input in &inputs {
        check_shape_name(&input.name).map_err(refused)?;
    }
    let mut shapes = StoredOriginals::new();
    // One after the other, so that only one file is in memory.
    for (input, length) in inputs.into_iter().zip(n_bytes) {
        let bytes = match input.source {
            Source::Bytes(bytes) => bytes,
            Source::File(path) => files.read(&path, length)?,
        };
        let shape = NewShape {
            name: input.name,
            bytes,
            format: input.format,
            replace: input.replace,
        };
        let library = &daemon.library;
        library
            .store_another_original(&mut shapes, shape)
            .map_err(refused)?;
    }
    Ok(Addition {
        request,
        key,
        shapes,
        room,
    })
}

/// The result of an addition.
type Accepted = Result<Done, wire::Error>;

enum Step {
    Accept(Box<Addition>, oneshot::Sender<Accepted>),
    /// Report when all before it are done.
    Settle(oneshot::Sender<()>),
}

/// The order of additions, and of changes that settle among them.
pub(crate) struct Intake {
    gate: Arc<Gate>,
    steps: mpsc::UnboundedSender<Step>,
}

impl Intake {
    /// Accepts additions from now on, for as long as this exists. The requests in flight bound how
    /// many wait.
    pub(crate) fn new(daemon: &Arc<Daemon>) -> Arc<Self> {
        let (steps, queue) = mpsc::unbounded_channel();
        tokio::spawn(accept_in_order(Arc::clone(daemon), queue));
        let gate = Gate::new(1);
        Arc::new(Self { gate, steps })
    }

    /// Queues up.
    pub(crate) fn queue(&self, client: &Client) -> Turn {
        self.gate.queue(client)
    }

    /// Accepts an addition whose turn has come.
    pub(crate) fn accept(&self, addition: Addition) -> oneshot::Receiver<Accepted> {
        let (sender, accepted) = oneshot::channel();
        self.step(Step::Accept(Box::new(addition), sender));
        accepted
    }

    /// Queues up for a turn that comes when all additions before it are accepted.
    pub(crate) fn queue_alone(
        self: &Arc<Self>,
        client: &Client,
    ) -> impl Future<Output = Pass> + use<> {
        let (turn, intake) = (self.queue(client), Arc::clone(self));
        async move {
            let pass = turn.come().await;
            let (sender, settled) = oneshot::channel();
            intake.step(Step::Settle(sender));
            settled.await.expect(ACCEPTS);
            pass
        }
    }

    fn step(&self, step: Step) {
        self.steps.send(step).expect(ACCEPTS);
    }
}

const ACCEPTS: &str = "invariant: additions are accepted while an intake exists";

/// Accepts the additions that came during the previous transaction, in one transaction.
async fn accept_in_order(daemon: Arc<Daemon>, mut queue: mpsc::UnboundedReceiver<Step>) {
    let mut steps = Vec::new();
    while queue.recv_many(&mut steps, MAX_TOGETHER).await > 0 {
        let (mut additions, mut waiting, mut settled) = (Vec::new(), Vec::new(), Vec::new());
        for step in steps.drain(..) {
            match step {
                Step::Accept(addition, sender) => {
                    additions.push(addition);
                    waiting.push(sender);
                }
                // Its request holds the turn: nothing comes after it.
                Step::Settle(sender) => settled.push(sender),
            }
        }
        if !additions.is_empty() {
            let n = additions.len();
            let accepted = blocking(&daemon, move |d| accept_together(d, &additions)).await;
            let accepted = accepted.unwrap_or_else(|panic| {
                let refused = || Err(panicked(&panic));
                std::iter::repeat_with(refused).take(n).collect()
            });
            for (sender, accepted) in waiting.into_iter().zip(accepted) {
                // The request may have stopped waiting.
                let _ = sender.send(accepted);
            }
        }
        for sender in settled {
            let _ = sender.send(());
        }
    }
}

/// Accepts shapes whose files are durable. A collection that a request creates exists for those
/// after it.
fn accept_together(daemon: &Arc<Daemon>, additions: &[Box<Addition>]) -> Vec<Accepted> {
    let creates = |a: &Addition| {
        a.request.create.is_some() && daemon.library.collection(&a.request.collection).is_err()
    };
    let mut accepted = Vec::with_capacity(additions.len());
    for some in additions.chunk_by(|_, next| !creates(next)) {
        let checked: Vec<_> = some.iter().map(|a| check(daemon, a)).collect();
        let submissions: Vec<_> = some
            .iter()
            .zip(&checked)
            .filter(|(_, checked)| checked.is_ok())
            .map(|(a, _)| a.submission())
            .collect();
        let mut jobs = submit(daemon, &submissions).into_iter();
        accepted.extend(some.iter().zip(checked).map(|(addition, checked)| {
            checked?;
            let job = jobs.next().expect("invariant: a job for each submission");
            Ok(addition.begin(daemon, &job.map_err(refused)?))
        }));
    }
    accepted
}

/// Whether an addition may be accepted; creates its collection if it says so.
fn check(daemon: &Arc<Daemon>, addition: &Addition) -> Result<(), wire::Error> {
    may_change(daemon, addition.key.as_ref())?;
    match &addition.request.create {
        Some(create) => ensure_collection(daemon, &addition.request.collection, create),
        None => Ok(()),
    }
}

/// Submits all of them in one transaction or, if one of them is refused, each in its own.
fn submit(daemon: &Daemon, submissions: &[Submission<'_>]) -> Vec<Result<Job, LibraryError>> {
    let library = &daemon.library;
    match library.submit_together(submissions) {
        Ok(jobs) => jobs,
        Err(e) if submissions.len() == 1 => vec![Err(e)],
        Err(_) => {
            let alone = |s: &Submission<'_>| library.submit(s.collection, s.shapes, s.key);
            submissions.iter().map(alone).collect()
        }
    }
}

impl Addition {
    fn submission(&self) -> Submission<'_> {
        Submission {
            collection: &self.request.collection,
            shapes: &self.shapes,
            key: self.key.as_ref(),
        }
    }

    /// Begins the work on the accepted shapes.
    fn begin(&self, daemon: &Arc<Daemon>, job: &Job) -> Done {
        daemon.begin(job, &self.room.n_bytes);
        match self.request.mode() {
            wire::AddMode::Wait => Done::WhenPlaced(job.id),
            wire::AddMode::Job | wire::AddMode::Unspecified => {
                let reply = convert::add_shapes(job.id, job.items.len(), None);
                Done::Now(Box::new(Reply::AddShapes(reply)))
            }
        }
    }
}

/// Refuses shapes for which a queue with that load has no room.
fn admit(daemon: &Daemon, load: &Load, n_bytes: &[u64]) -> Result<(), wire::Error> {
    let limits = &daemon.config().limits;
    let (n, bytes) = (n_bytes.len(), n_bytes.iter().sum::<u64>());
    let secs = load.seconds_of(n, bytes);
    let max_secs = limits.max_queued_seconds as f64;
    let max_shapes = limits.max_queued_shapes as f64;
    let max_bytes = limits.max_queued_bytes.0 as f64;
    type Bound = (&'static str, fn(f64) -> String, f64, f64, f64);
    let bounds: [Bound; 3] = [
        (
            "limits.max_queued_shapes",
            |n| format!("{n} shapes"),
            n as f64,
            load.n_shapes as f64,
            max_shapes,
        ),
        (
            "limits.max_queued_bytes",
            |n| in_words(n as u64),
            bytes as f64,
            load.n_bytes as f64,
            max_bytes,
        ),
        // An estimate alone never refuses for good: an empty queue accepts every request.
        (
            "limits.max_queued_seconds",
            |n| format!("{n} seconds of work"),
            secs.ceil().min(max_secs),
            load.seconds().floor(),
            max_secs,
        ),
    ];
    for (key, words, requested, queued, limit) in bounds {
        if requested > limit {
            let (requested, limit) = (words(requested), words(limit));
            let text =
                format!("the request has {requested}, the whole queue holds {limit} ({key})");
            let code = ErrorCode::InvalidArgument;
            return Err(convert::error(code, ErrorReason::MessageTooLarge, text));
        }
        if queued + requested > limit {
            let [queued_in_words, requested_in_words, limit_in_words] =
                [queued, requested, limit].map(words);
            let text = format!(
                "{queued_in_words} are queued and {requested_in_words} more asked for, the limit \
                 is {limit_in_words} ({key})"
            );
            let code = ErrorCode::ResourceExhausted;
            let mut error = convert::error(code, ErrorReason::QueueFull, text);
            // Until the excess is done.
            let wait = load.seconds() * (queued + requested - limit) / queued.max(1.0);
            let n_refused = daemon
                .telemetry
                .counters
                .refused
                .fetch_add(1, Ordering::Relaxed);
            error.retry_after_ms = spread_out(wait * 1e3, n_refused);
            return Err(error);
        }
    }
    Ok(())
}

/// The delay in milliseconds for the `n`th refused request: up to twice `wait_ms`, spread evenly,
/// so that requests that were refused together do not come back together.
fn spread_out(wait_ms: f64, n: u64) -> u64 {
    // The fraction of n times the golden ratio.
    let share = n.wrapping_mul(0x9E37_79B9_7F4A_7C15) as f64 / 2.0_f64.powi(64);
    let wait_ms = wait_ms.clamp(QUEUE_RETRY_MS.0 as f64, QUEUE_RETRY_MS.1 as f64);
    ((wait_ms * (1.0 + share)) as u64).min(QUEUE_RETRY_MS.1)
}

/// Creates the collection if it is missing, or compares it with what the request states.
fn ensure_collection(
    daemon: &Arc<Daemon>,
    name: &str,
    wanted: &wire::CollectionSpec,
) -> Result<(), wire::Error> {
    if !wanted.name.is_empty() && wanted.name != name {
        let text = format!(
            "create.name is {:?}, but collection is {name:?}",
            wanted.name
        );
        return Err(convert::field_error(
            ErrorReason::FieldRange,
            "create.name",
            text,
        ));
    }
    let named = wire::CollectionSpec {
        name: name.to_owned(),
        ..wanted.clone()
    };
    let spec = convert::collection_spec(&named, "create")?;
    match daemon.library.collection(name) {
        Ok(is) => match convert::collection_differs(&named, &is.spec) {
            None => Ok(()),
            Some((setting, wanted, is)) => {
                let text = format!("collection {name:?} has {setting} {is}, not {wanted}");
                let code = ErrorCode::FailedPrecondition;
                Err(convert::error(code, ErrorReason::CollectionDiffers, text))
            }
        },
        Err(LibraryError::NotFound { .. }) => {
            let info = daemon
                .library
                .create_collection(&spec, None)
                .map_err(refused)?;
            daemon.notice(Notice::Created(name.to_owned(), info.sequence));
            Ok(())
        }
        Err(e) => Err(refused(e)),
    }
}

#[cfg(test)]
mod tests {
    use super::{QUEUE_RETRY_MS, spread_out};

    #[test]
    fn requests_that_are_refused_together_come_back_one_after_the_other() {
        let mut delays: Vec<u64> = (0..64).map(|n| spread_out(0.0, n)).collect();
        delays.sort_unstable();
        assert!(delays[0] >= QUEUE_RETRY_MS.0 && delays[63] < 2 * QUEUE_RETRY_MS.0);
        let gaps = delays.windows(2).map(|w| w[1] - w[0]);
        assert!(gaps.clone().max() <= Some(8), "{delays:?}");
        assert!(
            gaps.clone().filter(|gap| *gap == 0).count() < 4,
            "{delays:?}"
        );
        assert_eq!(spread_out(f64::INFINITY, 1), QUEUE_RETRY_MS.1);
    }
}
