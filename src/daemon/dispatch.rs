//! Gives each operation to its handler when its turn comes.
//!
//! Reads run in parallel, changes of one collection one after the other, additions too, and waits
//! hold no thread. Where requests queue up, clients take turns. Computed answers queue up apart
//! from stored ones.

use crate::daemon::answer::{Answer, busy, panicked};
use crate::daemon::fair::{Client, Gate, Pass, Turn};
use crate::daemon::in_flight::{Effect, InFlight, send_answer};
use crate::daemon::incoming::Incoming;
use crate::daemon::intake::{self, Intake, Room};
use crate::daemon::operation::{Compute, Cost, Operation, unknown_request};
use crate::daemon::shared::{Daemon, blocking};
use crate::daemon::writes::Done;
use crate::daemon::{reads, remote, status, waits, writes};
use crate::ipc::wire::{self, AddShapesRequest, reply};
use crate::library::RequestKey;
use bytes::Bytes;
use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;
use tokio::sync::mpsc;

/// Collections whose gates are held before idle ones are dropped.
const MAX_GATES: usize = 1_024;
/// Reads that run at a time beyond the workers; they mostly wait for the disk.
const EXTRA_READS: usize = 2;
/// Additions whose files are written at a time: while one waits for the disk, others compress.
const MAX_WRITING: usize = 16;
/// The same of additions that name files by path. They are separate, since the file system of those
/// files may hang.
const MAX_READING: usize = 64;
/// How long such an addition holds its place in the order of additions while its files are read.
const HOLDS_TURN: Duration = Duration::from_secs(1);

/// Dispatches requests until the socket thread ends.
pub(crate) async fn run(daemon: Arc<Daemon>, mut requests: mpsc::Receiver<Incoming>) {
    let mut dispatcher = Dispatcher::new(daemon);
    while let Some(incoming) = requests.recv().await {
        if let Some((operation, in_flight)) = dispatcher.admit(incoming) {
            dispatcher.dispatch(operation, in_flight);
        }
    }
}

/// The gates at which requests wait for their turn. The permits of requests in flight bound what
/// waits there.
struct Dispatcher {
    daemon: Arc<Daemon>,
    short_reads: Arc<Gate>,
    bulk_reads: Arc<Gate>,
    computing: Arc<Gate>,
    writing_files: Arc<Gate>,
    reading_files: Arc<Gate>,
    intake: Arc<Intake>,
    /// Changes of one collection may wait long; nothing else waits with them.
    collections: HashMap<String, Arc<Gate>>,
}

/// The turn of a read.
struct ReadTurn {
    gate: Arc<Gate>,
    client: Client,
    /// The client of the sockets that waits for the reply.
    peer: Option<Bytes>,
    turn: Turn,
}

impl Dispatcher {
    fn new(daemon: Arc<Daemon>) -> Self {
        let n_workers = daemon.capacity.n_workers;
        Self {
            short_reads: Gate::new(n_workers + EXTRA_READS),
            bulk_reads: Gate::new(n_workers),
            computing: Gate::new(n_workers),
            writing_files: Gate::new(MAX_WRITING),
            reading_files: Gate::new(MAX_READING),
            intake: Intake::new(&daemon),
            collections: HashMap::new(),
            daemon,
        }
    }

    /// The operation of a request that can be answered otherwise than by an error.
    fn admit(&self, mut incoming: Incoming) -> Option<(Operation, InFlight)> {
        let daemon = &self.daemon;
        let permit = Arc::clone(&daemon.admission.in_flight).try_acquire_owned();
        let admitted = match permit {
            Err(_) => {
                let refused = &daemon.telemetry.counters.refused;
                refused.fetch_add(1, Ordering::Relaxed);
                Err(busy("too many requests are in hand"))
            }
            Ok(permit) => checked(&mut incoming).map(|operation| (operation, permit)),
        };
        match admitted {
            Ok((operation, permit)) => Some((operation, InFlight::new(incoming, permit))),
            Err(error) => {
                send_answer(daemon, incoming.reply_to, incoming.request_id, Err(error));
                None
            }
        }
    }

    fn dispatch(&mut self, operation: Operation, in_flight: InFlight) {
        let cost = operation.cost();
        let daemon = Arc::clone(&self.daemon);
        match operation {
            Operation::Hello => {
                let hello = reply::Result::Hello(status::hello(&daemon));
                in_flight.finish(&daemon, Ok((hello, Vec::new())));
            }
            Operation::Look(look) => self.read(cost, in_flight, move |d| reads::look(d, look)),
            Operation::Fetch(fetch) => self.read(cost, in_flight, move |d| reads::fetch(d, fetch)),
            Operation::Compute(compute) => self.compute(cost, compute, in_flight),
            Operation::Wait(wait) => {
                let wait = in_flight.respond(daemon, async move |d| waits::wait(&d, &wait).await);
                tokio::spawn(wait);
            }
            Operation::Add(request) => self.add(request, in_flight),
            Operation::Change(change) => {
                let turn = self.collection_turn(change.collection(), in_flight.client());
                let work = change_in_turn(daemon, in_flight, turn, move |d, _frames, key| {
                    writes::change(d, change, key)
                });
                tokio::spawn(work);
            }
            Operation::Edit(edit) => {
                let turn = self.collection_turn(edit.collection(), in_flight.client());
                let work = change_in_turn(daemon, in_flight, turn, move |d, frames, key| {
                    remote::edit(d, edit, frames, key)
                });
                tokio::spawn(work);
            }
            Operation::Settle(settle) => {
                let turn = self.intake.queue_alone(in_flight.client());
                let work = change_in_turn(daemon, in_flight, turn, move |d, _frames, key| {
                    writes::settle(d, settle, key)
                });
                tokio::spawn(work);
            }
            Operation::Drain => {
                let turn = self.intake.queue_alone(in_flight.client());
                let work =
                    change_in_turn(daemon, in_flight, turn, |d, _frames, _key| writes::drain(d));
                tokio::spawn(work);
            }
        }
    }

    /// Answers from what is stored, in the client's turn.
    fn read(
        &self,
        cost: Cost,
        in_flight: InFlight,
        read: impl FnOnce(&Arc<Daemon>) -> Answer + Send + 'static,
    ) {
        let turn = self.read_turn(cost, &in_flight);
        let work = in_flight.respond(Arc::clone(&self.daemon), async move |d| {
            let pass = turn.come(&d).await?;
            let answer = blocking(&d, read).await;
            drop(pass);
            answer.unwrap_or_else(|panic| Err(panicked(&panic)))
        });
        tokio::spawn(work);
    }

    /// Answers from what is stored or, if that does not suffice, in a worker.
    fn compute(&self, cost: Cost, compute: Compute, mut in_flight: InFlight) {
        let turn = self.read_turn(cost, &in_flight);
        let computing = Arc::clone(&self.computing);
        let client = in_flight.client().clone();
        let frames = std::mem::take(&mut in_flight.incoming.frames);
        let work = in_flight.respond(Arc::clone(&self.daemon), async move |d| {
            let pass = turn.come(&d).await?;
            let looked_up = blocking(&d, move |d| {
                reads::stored(d, &compute).map(|stored| (stored, compute))
            });
            let looked_up = looked_up.await;
            drop(pass);
            match looked_up.unwrap_or_else(|panic| Err(panicked(&panic)))? {
                (Some(stored), _) => Ok(stored),
                (None, compute) => {
                    let _pass = computing.queue(&client).come().await;
                    remote::compute(&d, compute, frames).await
                }
            }
        });
        tokio::spawn(work);
    }

    /// Reserves room for shapes at once, so that a refused addition delays no other.
    fn add(&self, request: AddShapesRequest, in_flight: InFlight) {
        let room = match Room::reserve(&self.daemon, request.shapes.len()) {
            Ok(room) => room,
            Err(full) => return in_flight.finish(&self.daemon, Err(full)),
        };
        let files = if names_files(&request) {
            &self.reading_files
        } else {
            &self.writing_files
        };
        let client = in_flight.client();
        let turns = (files.queue(client), self.intake.queue(client));
        let (daemon, intake) = (Arc::clone(&self.daemon), Arc::clone(&self.intake));
        tokio::spawn(add_in_turn(daemon, intake, request, room, in_flight, turns));
    }

    fn read_turn(&self, cost: Cost, in_flight: &InFlight) -> ReadTurn {
        let gate = match cost {
            Cost::Short => &self.short_reads,
            Cost::Bulk => &self.bulk_reads,
        };
        let client = in_flight.client();
        ReadTurn {
            gate: Arc::clone(gate),
            client: client.clone(),
            peer: in_flight.incoming.reply_to.client().cloned(),
            turn: gate.queue(client),
        }
    }

    /// The turn of a change of one collection, after the changes before it.
    fn collection_turn(
        &mut self,
        collection: &str,
        client: &Client,
    ) -> impl Future<Output = Pass> + use<> {
        if self.collections.len() >= MAX_GATES {
            self.collections
                .retain(|_, gate| Arc::strong_count(gate) > 1);
        }
        let gate = self.collections.entry(collection.to_owned());
        gate.or_insert_with(|| Gate::new(1)).queue(client).come()
    }
}

/// The operation of a request, if this version knows it and nothing is wrong with its form.
fn checked(incoming: &mut Incoming) -> Result<Operation, wire::Error> {
    let operation = incoming.operation.take().ok_or_else(unknown_request)?;
    operation.check(incoming.frames.len())?;
    Ok(operation)
}

impl ReadTurn {
    /// Waits for the turn, and until the client has read enough of earlier replies. In the second
    /// case the client gives its place to others.
    async fn come(self, daemon: &Daemon) -> Result<Pass, wire::Error> {
        let Some(peer) = self.peer else {
            return Ok(self.turn.come().await);
        };
        let replies = &daemon.admission.replies;
        let mut turn = Some(self.turn);
        loop {
            if !replies.has_room(&peer) {
                turn = None;
                replies
                    .room(&peer, |client| daemon.outbox.end(client))
                    .await?;
            }
            let turn = turn.take().unwrap_or_else(|| self.gate.queue(&self.client));
            let pass = turn.come().await;
            if replies.has_room(&peer) {
                return Ok(pass);
            }
        }
    }
}

/// Whether the daemon is to read files for an addition.
fn names_files(request: &AddShapesRequest) -> bool {
    let named = |source: &_| matches!(source, wire::shape_input::Source::Path(_));
    request
        .shapes
        .iter()
        .any(|s| s.source.as_ref().is_some_and(named))
}

/// Adds shapes: their files are written in parallel with those of others, and accepted in turn.
async fn add_in_turn(
    daemon: Arc<Daemon>,
    intake: Arc<Intake>,
    request: AddShapesRequest,
    room: Room,
    mut in_flight: InFlight,
    (files, turn): (Turn, Turn),
) {
    let key = in_flight.incoming.key();
    let client = in_flight.client().clone();
    let frames = std::mem::take(&mut in_flight.incoming.frames);
    // Given back when the files are written.
    let memory = in_flight.incoming.memory.take();
    let deadline = in_flight.incoming.deadline();
    let may_hang = names_files(&request);
    let writing = Arc::clone(&daemon);
    let stored = async move {
        let pass = files.come().await;
        blocking(&writing, move |d| {
            let _held = (memory, pass);
            intake::store_originals(d, request, &frames, room, key, deadline)
        })
        .await
    };
    let mut stored = std::pin::pin!(stored);
    let mut turn = Some(turn);
    let stored = in_flight.until_interrupted(&daemon, async {
        if may_hang {
            // Additions after it do not wait for a file system that hangs.
            match tokio::time::timeout(HOLDS_TURN, &mut stored).await {
                Ok(stored) => return stored,
                Err(_) => turn = None,
            }
        }
        stored.await
    });
    let stored = match stored.await {
        Ok(stored) => stored,
        Err(why) => return in_flight.interrupt(&daemon, why, Effect::NotBegun),
    };
    let turn = turn.unwrap_or_else(|| intake.queue(&client));
    in_flight.incoming.ticket.free_bytes();
    let addition = match stored.unwrap_or_else(|panic| Err(panicked(&panic))) {
        Ok(addition) => addition,
        Err(error) => return in_flight.finish(&daemon, Err(error)),
    };
    let pass = match in_flight.turn(&daemon, turn.come()).await {
        Ok(pass) => pass,
        Err(why) => return in_flight.interrupt(&daemon, why, Effect::NotBegun),
    };
    let accepted = intake.accept(addition);
    drop(pass);
    let accepted = async {
        accepted
            .await
            .unwrap_or_else(|e| Err(panicked(&e.to_string())))
    };
    in_flight.answer_change(daemon, accepted).await;
}

/// Makes a change in its turn.
async fn change_in_turn(
    daemon: Arc<Daemon>,
    mut in_flight: InFlight,
    turn: impl Future<Output = Pass>,
    make: impl FnOnce(&Arc<Daemon>, &[Bytes], Option<&RequestKey>) -> Result<Done, wire::Error>
    + Send
    + 'static,
) {
    let pass = match in_flight.turn(&daemon, turn).await {
        Ok(pass) => pass,
        Err(why) => return in_flight.interrupt(&daemon, why, Effect::NotBegun),
    };
    let key = in_flight.incoming.key();
    let frames = std::mem::take(&mut in_flight.incoming.frames);
    // Given back when the change is made.
    let memory = in_flight.incoming.memory.take();
    let changing = Arc::clone(&daemon);
    // It continues, and holds its turn, also if the request is interrupted.
    let done = tokio::spawn(async move {
        let done = blocking(&changing, move |d| {
            let _memory = memory;
            make(d, &frames, key.as_ref())
        });
        let done = done.await;
        drop(pass);
        done.unwrap_or_else(|panic| Err(panicked(&panic)))
    });
    let done = async { done.await.unwrap_or_else(|e| Err(panicked(&e.to_string()))) };
    in_flight.answer_change(daemon, done).await;
}
