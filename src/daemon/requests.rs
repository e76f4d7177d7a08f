//! Requests are sorted by what they need: reads run side by side, changes of one collection one after the
//! other, what is taken in likewise, waits hold no thread. Where requests queue up, clients take turns; what is to be
//! computed queues up apart from what is only looked up.

use crate::daemon::fair::{Gate, Pass, Turn};
use crate::daemon::intake::{self, Intake, Room};
use crate::daemon::service::Control;
use crate::daemon::sockets::{BUSY_RETRY_MS, Incoming, ReplyTo};
use crate::daemon::writes;
use crate::daemon::{Daemon, asked, blocking, reads};
use crate::ipc::convert;
use crate::ipc::wire::{
    self, AddShapesRequest, ErrorCode, ErrorReason, Reply, error::Subject, reply, request::Body,
};
use crate::library::Job;
use bytes::Bytes;
use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};
use tokio::sync::{OwnedSemaphorePermit, mpsc};

/// Longest wait of WatchJob and WaitIdle, in milliseconds.
pub(crate) const MAX_WAIT_MS: u64 = 30_000;
/// WatchJob answers changes no faster than this, so that a client that asks again at once does not read
/// a job from the catalog a thousand times a second.
const WATCH_PACE: Duration = Duration::from_millis(50);
/// Collections whose gates are kept before idle ones are forgotten.
const MAX_GATES: usize = 1_024;
/// Reads that run at a time beyond the workers; they mostly wait for the disk.
const EXTRA_READS: usize = 2;
/// Requests whose files are written at a time: while one waits for the disk, others compress.
const MAX_KEEPING: usize = 16;

/// The result and raw frames of a reply.
pub(crate) type Answer = Result<(reply::Result, Vec<Bytes>), wire::Error>;

/// A request in hand. Its permit bounds how many there are.
pub(crate) struct InHand {
    pub(crate) incoming: Incoming,
    permit: OwnedSemaphorePermit,
}

/// Sorts requests until the socket thread ends.
pub(crate) async fn dispatch(daemon: Arc<Daemon>, mut requests: mpsc::Receiver<Incoming>) {
    // What queues up at the gates is bounded by the permits.
    let readers = Gate::new(daemon.n_workers + EXTRA_READS);
    let computing = Gate::new(daemon.n_workers);
    let keeping = Gate::new(MAX_KEEPING);
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
        let mut in_hand = InHand { incoming, permit };
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
                    let turns = (keeping.queue(&client), intake.queue(&client));
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
                let turn = readers.queue(&client);
                let computing = Arc::clone(&computing);
                let frames = std::mem::take(&mut in_hand.incoming.frames);
                tokio::spawn(in_hand.respond(daemon, async move |d| {
                    let pass = turn.come().await;
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

/// How far a request was when its deadline passed.
enum Late {
    /// It changes nothing.
    Over,
    /// It was to change something, and will not.
    NotBegun,
    /// What it changes goes on.
    GoesOn,
    /// It was accepted: this job goes on.
    Accepted(u64),
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
    let Some(pass) = in_hand.by_deadline(keeping.come()).await else {
        return in_hand.late(&daemon, Late::NotBegun);
    };
    let key = writes::key(&in_hand.incoming.request);
    let frames = std::mem::take(&mut in_hand.incoming.frames);
    // Given back when the files are there.
    let memory = in_hand.incoming.memory.take();
    let kept = blocking(&daemon, move |d| {
        let _here = (memory, pass);
        intake::keep(d, request, &frames, room, key)
    });
    let Some(kept) = in_hand.by_deadline(kept).await else {
        return in_hand.late(&daemon, Late::NotBegun);
    };
    in_hand.incoming.ticket.free_bytes();
    let addition = match kept.unwrap_or_else(|panic| Err(panic_error(&panic))) {
        Ok(addition) => addition,
        Err(error) => return in_hand.finish(&daemon, Err(error)),
    };
    let Some(pass) = in_hand.turn(turn.come()).await else {
        return in_hand.late(&daemon, Late::NotBegun);
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
    let Some(pass) = in_hand.turn(turn).await else {
        return in_hand.late(&daemon, Late::NotBegun);
    };
    let key = writes::key(&in_hand.incoming.request);
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

    /// Answers with what `work` returns, or that the deadline passed.
    async fn respond<F: Future<Output = Answer>>(
        self,
        daemon: Arc<Daemon>,
        work: impl FnOnce(Arc<Daemon>) -> F,
    ) {
        match self.by_deadline(work(Arc::clone(&daemon))).await {
            Some(answer) => self.finish(&daemon, answer),
            None => self.late(&daemon, Late::Over),
        }
    }

    /// Answers a change that has begun, when it is done.
    async fn answer_change(
        mut self,
        daemon: Arc<Daemon>,
        done: impl Future<Output = Result<writes::Done, wire::Error>>,
    ) {
        let Some(done) = self.by_deadline(done).await else {
            return self.late(&daemon, Late::GoesOn);
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
                match self.by_deadline(wait_placed(&daemon, job)).await {
                    Some(answer) => self.finish(&daemon, answer),
                    None => self.late(&daemon, Late::Accepted(job)),
                }
            }
            Err(error) => self.finish(&daemon, Err(error)),
        }
    }

    /// The turn of a request, unless its deadline passes before.
    async fn turn(&self, turn: impl Future<Output = Pass>) -> Option<Pass> {
        let pass = self.by_deadline(turn).await?;
        (!self.is_late()).then_some(pass)
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

    async fn by_deadline<T>(&self, work: impl Future<Output = T>) -> Option<T> {
        match self.deadline() {
            Some(deadline) => tokio::time::timeout_at(deadline.into(), work).await.ok(),
            None => Some(work.await),
        }
    }

    fn late(self, daemon: &Daemon, how_far: Late) {
        let ms = self.incoming.request.deadline_ms;
        let has_key = writes::key(&self.incoming.request).is_some();
        let rest = match how_far {
            Late::Over => String::new(),
            Late::NotBegun => "; it was not begun".to_owned(),
            Late::Accepted(job) => format!("; job {job} goes on"),
            Late::GoesOn if has_key => {
                "; the change goes on, and the same request, sent again with \
                its request_id, tells what came of it"
                    .to_owned()
            }
            Late::GoesOn => "; the change goes on".to_owned(),
        };
        let mut error = convert::error(
            ErrorCode::DeadlineExceeded,
            ErrorReason::Deadline,
            format!("no answer within the request's {ms} ms{rest}"),
        );
        if let Late::Accepted(job) = how_far {
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

/// Reads a job and shows it.
async fn read_job(daemon: &Arc<Daemon>, job: u64) -> Result<wire::Job, wire::Error> {
    let read = blocking(daemon, move |d| {
        d.library.job(job).map(|j| d.job_to_wire(&j))
    })
    .await;
    match read {
        Ok(Ok(job)) => Ok(job),
        Ok(Err(e)) => Err(convert::library_error(&e)),
        Err(panic) => Err(panic_error(&panic)),
    }
}

/// The answer to AddShapes with ADD_MODE_WAIT.
async fn wait_placed(daemon: &Arc<Daemon>, job: u64) -> Answer {
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
            // Over, or a correction that is carried, which only the catalog knows.
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
        let counted = blocking(daemon, move |d| reads::n_stale(d, collection.as_deref())).await;
        let n_stale = match counted {
            Ok(Ok(n)) => n,
            Ok(Err(e)) => return Err(convert::library_error(&e)),
            Err(panic) => return panicked(panic),
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
        // Shapes in work change their stage often; only the last one's end matters.
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
