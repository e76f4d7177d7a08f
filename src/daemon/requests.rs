//! Requests are sorted by what they need: reads run side by side, changes of one collection one after the
//! other, what is taken in likewise, waits hold no thread. Where requests queue up, clients take turns; what is to be
//! computed queues up apart from what is only looked up.

use crate::daemon::fair::{Gate, Pass, Turn};
use crate::daemon::intake::{self, Intake, Room};
use crate::daemon::service::Control;
use crate::daemon::sockets::{BUSY_RETRY_MS, Incoming, ReplyTo};
use crate::daemon::waits::{wait_idle, wait_placed, watch_job};
use crate::daemon::{Daemon, access, asked, blocking, reads, writes};
use crate::ipc::convert;
use crate::ipc::keys::AllowList;
use crate::ipc::wire::{
    self, AddShapesRequest, ErrorCode, ErrorReason, Reply, error::Subject, reply, request::Body,
};
use crate::library::{Job, RequestKey};
use bytes::Bytes;
use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};
use tokio::sync::{OwnedSemaphorePermit, mpsc, watch};

/// Collections whose gates are kept before idle ones are forgotten.
const MAX_GATES: usize = 1_024;
/// Reads that run at a time beyond the workers; they mostly wait for the disk.
const EXTRA_READS: usize = 2;
/// Requests whose files are written at a time: while one waits for the disk, others compress.
const MAX_KEEPING: usize = 16;
/// The same of requests that name files by path: apart, since the file system that they are on may hang.
const MAX_READING: usize = 64;
/// How long such a request keeps its turn among those that are taken in while its files are read.
const KEEPS_TURN: Duration = Duration::from_secs(1);

/// The result and raw frames of a reply.
pub(crate) type Answer = Result<(reply::Result, Vec<Bytes>), wire::Error>;

/// A request in hand. Its permit bounds how many there are.
pub(crate) struct InHand {
    pub(crate) incoming: Incoming,
    permit: OwnedSemaphorePermit,
    /// Who may connect, as it stands.
    allowed: Option<watch::Receiver<Arc<AllowList>>>,
}

/// Sorts requests until the socket thread ends.
pub(crate) async fn dispatch(daemon: Arc<Daemon>, mut requests: mpsc::Receiver<Incoming>) {
    // What queues up at the gates is bounded by the permits.
    let readers = Gate::new(daemon.n_workers + EXTRA_READS);
    let bulk = Gate::new(daemon.n_workers);
    let computing = Gate::new(daemon.n_workers);
    let keeping = Gate::new(MAX_KEEPING);
    let reading = Gate::new(MAX_READING);
    let intake = Intake::new(&daemon);
    let mut collections: HashMap<String, Arc<Gate>> = HashMap::new();
    while let Some(mut incoming) = requests.recv().await {
        let Ok(permit) = Arc::clone(&daemon.pending).try_acquire_owned() else {
            let error = busy("too many requests are in hand");
            daemon.counters.refused.fetch_add(1, Ordering::Relaxed);
            daemon.answer(incoming.reply_to, incoming.request.request_id, Err(error));
            continue;
        };
        let Some(body) = incoming.request.body.take() else {
            let error = convert::error(
                ErrorCode::InvalidArgument,
                ErrorReason::UnknownRequest,
                "the request has no body that this version knows",
            );
            daemon.answer(incoming.reply_to, incoming.request.request_id, Err(error));
            continue;
        };
        if let Err(error) = convert::check_request(&body, incoming.frames.len()) {
            daemon.answer(incoming.reply_to, incoming.request.request_id, Err(error));
            continue;
        }
        let mut in_hand = InHand {
            incoming,
            permit,
            allowed: daemon.allowed.clone(),
        };
        let client = in_hand.incoming.ticket.client().clone();
        let daemon = Arc::clone(&daemon);
        // Changes of labels may wait while a lane learns; nothing else waits with them.
        let gate = changed_collection(&body).map(|name| {
            if collections.len() >= MAX_GATES {
                collections.retain(|_, gate| Arc::strong_count(gate) > 1);
            }
            let gate = collections.entry(name.to_owned());
            Arc::clone(gate.or_insert_with(|| Gate::new(1)))
        });
        match body {
            Body::DeleteCollection(_)
            | Body::NameLabel(_)
            | Body::UpdateCollection(_)
            | Body::CorrectLabels(_)
            | Body::MergeLabels(_)
            | Body::SplitLabel(_)
            | Body::Undo(_)
            | Body::RemoveShape(_)
            | Body::CreateCollection(_)
            | Body::CancelJob(_)
            | Body::RetryJob(_)
            | Body::Drain(_) => match &gate {
                Some(gate) => {
                    let turn = gate.queue(&client).come();
                    tokio::spawn(change_in_turn(daemon, body, in_hand, turn));
                }
                None => {
                    let turn = intake.queue_alone(&client);
                    tokio::spawn(change_in_turn(daemon, body, in_hand, turn));
                }
            },
            // At once: what is refused keeps nobody waiting for what is taken in.
            Body::AddShapes(request) => match Room::reserve(&daemon, request.shapes.len()) {
                Err(full) => in_hand.finish(&daemon, Err(full)),
                Ok(room) => {
                    let gate = if names_files(&request) {
                        &reading
                    } else {
                        &keeping
                    };
                    let turns = (gate.queue(&client), intake.queue(&client));
                    let intake = Arc::clone(&intake);
                    tokio::spawn(add_in_turn(daemon, intake, request, room, in_hand, turns));
                }
            },
            Body::WatchJob(request) => {
                tokio::spawn(in_hand.respond(daemon, async move |d| watch_job(&d, &request).await));
            }
            Body::WaitIdle(request) => {
                tokio::spawn(in_hand.respond(daemon, async move |d| wait_idle(&d, &request).await));
            }
            // Needs nothing that may be busy: whoever asks wants to know whether the daemon lives.
            Body::Hello(_) => {
                let hello = reply::Result::Hello(reads::hello(&daemon));
                in_hand.finish(&daemon, Ok((hello, Vec::new())));
            }
            Body::Stats(_)
            | Body::ListCollections(_)
            | Body::DescribeCollection(_)
            | Body::GetJob(_)
            | Body::ListJobs(_)
            | Body::ListShapes(_)
            | Body::GetShape(_)
            | Body::GetLabels(_)
            | Body::GetOriginal(_)
            | Body::LabelsSnapshot(_)
            | Body::GetSpectrum(_)
            | Body::GetHks(_)
            | Body::GetDescriptors(_)
            | Body::GetFunctionalMap(_)
            | Body::GetPartCorrespondence(_)
            | Body::TransferFunction(_)
            | Body::Nearest(_)
            | Body::GetPortraits(_)
            | Body::SuggestNext(_)
            | Body::EventsSince(_) => {
                let gate = if is_bulk(&body) { &bulk } else { &readers };
                let (gate, computing) = (Arc::clone(gate), Arc::clone(&computing));
                let peer = in_hand.incoming.reply_to.client().cloned();
                let turn = gate.queue(&client);
                let frames = std::mem::take(&mut in_hand.incoming.frames);
                tokio::spawn(in_hand.respond(daemon, async move |d| {
                    let pass = match peer {
                        Some(peer) => {
                            pass_with_room(&d, &peer, turn, || gate.queue(&client)).await?
                        }
                        None => turn.come().await,
                    };
                    let looked = blocking(&d, move |d| reads::look_up(d, body)).await;
                    drop(pass);
                    match looked.unwrap_or_else(|panic| Err(panic_error(&panic)))? {
                        reads::Looked::Up(answer) => Ok(answer),
                        reads::Looked::ToCompute(body) => {
                            let _pass = computing.queue(&client).come().await;
                            asked::read(&d, body, frames).await
                        }
                    }
                }));
            }
        }
    }
}

/// Whether a read copies whole files or arrays; a short one does not wait for such.
fn is_bulk(body: &Body) -> bool {
    matches!(
        body,
        Body::GetOriginal(_)
            | Body::LabelsSnapshot(_)
            | Body::GetSpectrum(_)
            | Body::GetHks(_)
            | Body::GetDescriptors(_)
            | Body::GetPortraits(_)
    )
}

/// The pass of a read once its client has read enough of earlier replies. Until then the client
/// keeps no place from others.
async fn pass_with_room(
    daemon: &Daemon,
    peer: &Bytes,
    turn: Turn,
    queue: impl Fn() -> Turn,
) -> Result<Pass, wire::Error> {
    let mut turn = Some(turn);
    loop {
        if !daemon.replies.has_room(peer) {
            turn = None;
            let end = |client| daemon.outbox.end(client);
            daemon.replies.room(peer, end).await?;
        }
        let pass = turn.take().unwrap_or_else(&queue).come().await;
        if daemon.replies.has_room(peer) {
            return Ok(pass);
        }
    }
}

/// Why nobody waits for a request any more.
enum Cut {
    /// Its deadline passed.
    Late,
    /// The key of whoever asked was taken off the list.
    Revoked,
}

/// How far a request was then.
enum Reached {
    /// It changes nothing.
    Over,
    /// It was to change something, and will not.
    NotBegun,
    /// What it changes goes on.
    GoesOn,
    /// It was accepted: this job goes on.
    Accepted(u64),
}

/// Whether the daemon is to read files for an addition.
fn names_files(request: &AddShapesRequest) -> bool {
    let named = |source: &_| matches!(source, wire::shape_input::Source::Path(_));
    request
        .shapes
        .iter()
        .any(|s| s.source.as_ref().is_some_and(named))
}

/// The collection whose labels, or existence, a request changes.
fn changed_collection(body: &Body) -> Option<&str> {
    Some(match body {
        Body::DeleteCollection(r) => &r.collection,
        Body::NameLabel(r) => &r.collection,
        Body::UpdateCollection(r) => &r.collection,
        Body::CorrectLabels(r) => &r.collection,
        Body::MergeLabels(r) => &r.collection,
        Body::SplitLabel(r) => &r.collection,
        Body::Undo(r) => &r.collection,
        Body::RemoveShape(r) => &r.collection,
        _ => return None,
    })
}

/// Takes in shapes: their files are written beside those of others, and accepted in turn.
async fn add_in_turn(
    daemon: Arc<Daemon>,
    intake: Arc<Intake>,
    request: AddShapesRequest,
    room: Room,
    mut in_hand: InHand,
    (keeping, turn): (Turn, Turn),
) {
    let key = in_hand.key();
    let client = in_hand.incoming.ticket.client().clone();
    let frames = std::mem::take(&mut in_hand.incoming.frames);
    // Given back when the files are there.
    let memory = in_hand.incoming.memory.take();
    let deadline = in_hand.deadline();
    let may_hang = names_files(&request);
    let keeper = Arc::clone(&daemon);
    let kept = async move {
        let pass = keeping.come().await;
        blocking(&keeper, move |d| {
            let _here = (memory, pass);
            intake::keep(d, request, &frames, room, key, deadline)
        })
        .await
    };
    let mut kept = std::pin::pin!(kept);
    let mut turn = Some(turn);
    let kept = in_hand.until_cut(async {
        if may_hang {
            // Whoever comes after it does not wait for a file system that hangs.
            match tokio::time::timeout(KEEPS_TURN, &mut kept).await {
                Ok(kept) => return kept,
                Err(_) => turn = None,
            }
        }
        kept.await
    });
    let kept = match kept.await {
        Ok(kept) => kept,
        Err(why) => return in_hand.cut(&daemon, why, Reached::NotBegun),
    };
    let turn = turn.unwrap_or_else(|| intake.queue(&client));
    in_hand.incoming.ticket.free_bytes();
    let addition = match kept.unwrap_or_else(|panic| Err(panic_error(&panic))) {
        Ok(addition) => addition,
        Err(error) => return in_hand.finish(&daemon, Err(error)),
    };
    let pass = match in_hand.turn(turn.come()).await {
        Ok(pass) => pass,
        Err(why) => return in_hand.cut(&daemon, why, Reached::NotBegun),
    };
    let accepted = intake.accept(addition);
    drop(pass);
    let accepted = async {
        accepted
            .await
            .unwrap_or_else(|e| Err(panic_error(&e.to_string())))
    };
    in_hand.answer_change(daemon, accepted).await;
}

/// Carries out a change when its turn comes.
async fn change_in_turn(
    daemon: Arc<Daemon>,
    change: Body,
    mut in_hand: InHand,
    turn: impl Future<Output = Pass>,
) {
    let pass = match in_hand.turn(turn).await {
        Ok(pass) => pass,
        Err(why) => return in_hand.cut(&daemon, why, Reached::NotBegun),
    };
    let key = in_hand.key();
    let frames = std::mem::take(&mut in_hand.incoming.frames);
    // Given back when the change is made: who waits for the placing holds no frames.
    let memory = in_hand.incoming.memory.take();
    let changing = Arc::clone(&daemon);
    // It goes on, and keeps its turn, when nobody waits for it any more.
    let done = tokio::spawn(async move {
        let done = blocking(&changing, move |d| {
            let _memory = memory;
            writes::change(d, &change, &frames, key.as_ref())
        });
        let done = done.await;
        drop(pass);
        done.unwrap_or_else(|panic| Err(panic_error(&panic)))
    });
    let done = async {
        done.await
            .unwrap_or_else(|e| Err(panic_error(&e.to_string())))
    };
    in_hand.answer_change(daemon, done).await;
}

impl InHand {
    /// Sends the reply and gives back the permit.
    fn finish(self, daemon: &Daemon, answer: Answer) {
        drop(self.incoming.ticket);
        daemon.answer(
            self.incoming.reply_to,
            self.incoming.request.request_id,
            answer,
        );
        drop(self.permit);
    }

    /// The idempotency key.
    fn key(&self) -> Option<RequestKey> {
        writes::key(&self.incoming.request, self.incoming.user.as_deref())
    }

    /// Answers with what `work` returns, or why nobody waits for it any more.
    async fn respond<F: Future<Output = Answer>>(
        self,
        daemon: Arc<Daemon>,
        work: impl FnOnce(Arc<Daemon>) -> F,
    ) {
        match self.until_cut(work(Arc::clone(&daemon))).await {
            Ok(answer) => self.finish(&daemon, answer),
            Err(why) => self.cut(&daemon, why, Reached::Over),
        }
    }

    /// Answers a change that has begun, when it is done.
    async fn answer_change(
        mut self,
        daemon: Arc<Daemon>,
        done: impl Future<Output = Result<writes::Done, wire::Error>>,
    ) {
        let done = match self.until_cut(done).await {
            Ok(done) => done,
            Err(why) => return self.cut(&daemon, why, Reached::GoesOn),
        };
        self.incoming.ticket.free_bytes();
        match done {
            Ok(writes::Done::Now(result)) => {
                let drain = matches!(*result, reply::Result::Drain(_));
                self.finish(&daemon, Ok((*result, Vec::new())));
                if drain {
                    // After the reply, which would else come too late for the sockets. An error
                    // means that the main thread is gone: the daemon is ending already.
                    let _ = daemon.asked_to_drain.send(Control::Drain);
                }
            }
            Ok(writes::Done::WhenPlaced(job)) => {
                match self.until_cut(wait_placed(&daemon, job)).await {
                    Ok(answer) => self.finish(&daemon, answer),
                    Err(why) => self.cut(&daemon, why, Reached::Accepted(job)),
                }
            }
            Err(error) => self.finish(&daemon, Err(error)),
        }
    }

    /// The turn of a request, unless nobody waits for it any more.
    async fn turn(&self, turn: impl Future<Output = Pass>) -> Result<Pass, Cut> {
        let pass = self.until_cut(turn).await?;
        if self.is_late() {
            return Err(Cut::Late);
        }
        if self.is_revoked() {
            return Err(Cut::Revoked);
        }
        Ok(pass)
    }

    fn deadline(&self) -> Option<Instant> {
        let ms = self.incoming.request.deadline_ms;
        (ms > 0)
            .then(|| {
                self.incoming
                    .received
                    .checked_add(Duration::from_millis(ms))
            })
            .flatten()
    }

    fn is_late(&self) -> bool {
        self.deadline().is_some_and(|d| d <= Instant::now())
    }

    fn is_revoked(&self) -> bool {
        let (Some(list), Some(key)) = (&self.allowed, &self.incoming.user) else {
            return false;
        };
        list.borrow().find(key).is_none()
    }

    /// Comes when the key of whoever asked is taken off the list.
    async fn revoked(&self) {
        let (Some(list), Some(key)) = (&self.allowed, &self.incoming.user) else {
            return std::future::pending().await;
        };
        let gone = |list: &Arc<AllowList>| list.find(key).is_none();
        if list.clone().wait_for(gone).await.is_err() {
            // The list went with the sockets: nobody is answered any more.
            std::future::pending().await
        }
    }

    async fn until_cut<T>(&self, work: impl Future<Output = T>) -> Result<T, Cut> {
        let late = async {
            match self.deadline() {
                Some(deadline) => tokio::time::sleep_until(deadline.into()).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            biased;
            done = work => Ok(done),
            () = late => Err(Cut::Late),
            () = self.revoked() => Err(Cut::Revoked),
        }
    }

    /// Answers a request for which nobody waits any more.
    fn cut(self, daemon: &Daemon, why: Cut, how_far: Reached) {
        let ms = self.incoming.request.deadline_ms;
        let has_key = self.key().is_some();
        let rest = match how_far {
            Reached::Over => String::new(),
            Reached::NotBegun => "; it was not begun".to_owned(),
            Reached::Accepted(job) => format!("; job {job} goes on"),
            Reached::GoesOn if has_key => {
                "; the change goes on, and the same request, sent again with \
                its request_id, tells what came of it"
                    .to_owned()
            }
            Reached::GoesOn => "; the change goes on".to_owned(),
        };
        let mut error = match why {
            Cut::Late => convert::error(
                ErrorCode::DeadlineExceeded,
                ErrorReason::Deadline,
                format!("no answer within the request's {ms} ms{rest}"),
            ),
            Cut::Revoked => access::not_allowed(&rest),
        };
        if let Reached::Accepted(job) = how_far {
            error.subject = Some(Subject::JobId(job));
        }
        self.finish(daemon, Err(error));
    }
}

impl Daemon {
    fn answer(&self, reply_to: ReplyTo, request_id: String, answer: Answer) {
        if let Err(error) = &answer {
            self.metrics.refused(error);
            if error.code() == ErrorCode::Internal || error.code() == ErrorCode::DataLoss {
                tracing::error!(request_id, message = error.message, "a request failed");
            }
        }
        let peer = match reply_to {
            ReplyTo::Peer(peer) => peer,
            ReplyTo::Task(task) => {
                // Whoever asked may have stopped waiting.
                let _ = task.send(answer);
                return;
            }
        };
        let (result, frames) =
            answer.unwrap_or_else(|error| (reply::Result::Error(error), Vec::new()));
        self.outbox.reply(
            peer,
            Reply {
                request_id,
                result: Some(result),
            },
            frames,
        );
    }

    /// A job with what this process knows of it.
    pub(crate) fn job_to_wire(&self, job: &Job) -> wire::Job {
        let progress = self.work.progress();
        let items: Vec<_> = job
            .items
            .iter()
            .map(|i| convert::item(i, progress.stage(job.id, i.index)))
            .collect();
        let n_over = job
            .items
            .iter()
            .filter(|i| convert::job_finished(&i.state))
            .count();
        if let Some(carrying) = job.carrying {
            return convert::carrying_job(job, &carrying);
        }
        wire::Job {
            job_id: job.id,
            collection: job.collection.clone(),
            finished: n_over == job.items.len(),
            progress: n_over as f64 / job.items.len().max(1) as f64,
            // A finished job changes no more.
            revision: progress.revision(job.id).unwrap_or(u64::MAX),
            items,
            carrying: None,
        }
    }
}

pub(crate) fn busy(message: &str) -> wire::Error {
    let mut error = convert::error(
        ErrorCode::ResourceExhausted,
        ErrorReason::QueueFull,
        message,
    );
    error.retry_after_ms = BUSY_RETRY_MS;
    error
}

pub(crate) fn panic_error(panic: &str) -> wire::Error {
    convert::error(
        ErrorCode::Internal,
        ErrorReason::Panic,
        format!("answering panicked: {panic}"),
    )
}

pub(crate) fn panicked(panic: String) -> Answer {
    Err(panic_error(&panic))
}

pub(crate) fn draining() -> wire::Error {
    convert::error(
        ErrorCode::FailedPrecondition,
        ErrorReason::Draining,
        "the daemon is shutting down; what it accepted is resumed at its next start",
    )
}
