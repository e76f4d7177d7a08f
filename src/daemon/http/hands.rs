//! Bounds the resources of HTTP: its own threads, of which a few with a lower priority do what
//! takes time, its memory, and the number of its requests.

use super::connection::PEER_TIME;
use crate::config::Limits;
use crate::daemon::answer::{busy, panic_text, panicked};
use crate::daemon::memory::{Budget, Reservation};
use crate::ipc::wire;
use bytes::Bytes;
use std::sync::Arc;
use tokio::runtime::Runtime;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, SemaphorePermit};

/// Threads that wait for connections: they compute nothing whose size a request chooses.
const N_THREADS: usize = 2;
/// Threads at a time that decode requests and encode replies.
const N_WORKING: usize = 2;
/// The same, and one thread that reads metrics.
const N_BLOCKING: usize = N_WORKING + 1;
/// The niceness of the threads that wait, above the workers, and of those that work, equal to them,
/// so that a page waits rather than a client of the sockets.
const WAITING_NICENESS: i32 = 1;
const WORKING_NICENESS: i32 = 5;
/// Requests of viewers in flight, and those of them that the daemon works on at a time. Both kinds
/// together are fewer than the connections, so that some connection can always be closed.
const READS: (usize, usize) = (48, 8);
const CHANGES: (usize, usize) = (16, 4);

/// A runtime for HTTP alone.
pub(super) fn runtime() -> std::io::Result<Runtime> {
    tokio::runtime::Builder::new_multi_thread()
        .worker_threads(N_THREADS)
        .max_blocking_threads(N_BLOCKING)
        .thread_name("http")
        .on_thread_start(|| give_way(WAITING_NICENESS))
        .enable_io()
        .enable_time()
        .build()
}

/// A value with the memory that is reserved for it.
pub(super) struct Reserved<T> {
    pub(super) value: T,
    pub(super) memory: Reservation,
}

impl AsRef<[u8]> for Reserved<Bytes> {
    fn as_ref(&self) -> &[u8] {
        &self.value
    }
}

impl Reserved<Bytes> {
    /// Bytes that give their memory back when the last of them is sent.
    pub(super) fn into_bytes(mut self) -> Bytes {
        self.memory.shrink_to(self.value.len() as u64);
        Bytes::from_owner(self)
    }
}

/// The resources that all requests share.
pub(super) struct Hands {
    memory: Arc<Budget>,
    /// Bytes of the largest answer of the daemon.
    max_answer: u64,
    reads: Queue,
    changes: Queue,
    working: Arc<Semaphore>,
}

/// The requests of one kind, which wait for their turn.
struct Queue {
    in_flight: Semaphore,
    turns: Semaphore,
}

impl Queue {
    fn new((in_flight, at_a_time): (usize, usize)) -> Self {
        Self {
            in_flight: Semaphore::new(in_flight),
            turns: Semaphore::new(at_a_time),
        }
    }

    async fn turn(&self) -> Result<Turn<'_>, wire::Error> {
        let in_flight = self.in_flight.try_acquire();
        let in_flight = in_flight.map_err(|_| busy("too many requests of viewers wait"))?;
        let turn = self.turns.acquire().await;
        Ok((in_flight, turn.expect(NEVER_CLOSED)))
    }
}

/// The permits of a request whose turn has come.
pub(super) type Turn<'a> = (SemaphorePermit<'a>, SemaphorePermit<'a>);

impl Hands {
    pub(super) fn new(limits: &Limits) -> Self {
        Self {
            memory: Budget::new(limits.http_bytes()),
            max_answer: limits.max_message.0,
            reads: Queue::new(READS),
            changes: Queue::new(CHANGES),
            working: Arc::new(Semaphore::new(N_WORKING)),
        }
    }

    /// The turn of a request that changes nothing.
    pub(super) async fn read(&self) -> Result<Turn<'_>, wire::Error> {
        self.reads.turn().await
    }

    /// The turn of a change.
    pub(super) async fn change(&self) -> Result<Turn<'_>, wire::Error> {
        self.changes.turn().await
    }

    /// Reserves memory, now or not at all.
    pub(super) fn memory(&self, bytes: u64) -> Option<Reservation> {
        self.memory.try_reserve(bytes)
    }

    /// Reserves memory for the largest possible answer, and waits a while for it.
    pub(super) async fn memory_of_answer(&self) -> Result<Reservation, wire::Error> {
        let reserved = self.memory.reserve(self.max_answer);
        let reserved = tokio::time::timeout(PEER_TIME, reserved).await;
        reserved.map_err(|_| full())
    }

    /// Does work whose size a request chooses, on one of few threads.
    pub(super) async fn work<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, wire::Error> {
        let working = Arc::clone(&self.working).acquire_owned().await;
        let working: OwnedSemaphorePermit = working.expect(NEVER_CLOSED);
        beside(move || {
            // Until it is done, also if the request has ended.
            let _working = working;
            work()
        })
        .await
    }
}

/// Does work on a thread that may block. The caller sees to it that few do so at a time.
pub(super) async fn beside<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, wire::Error> {
    let done = tokio::task::spawn_blocking(move || {
        give_way(WORKING_NICENESS);
        work()
    });
    done.await.map_err(|e| match e.try_into_panic() {
        Ok(panic) => panicked(&panic_text(panic.as_ref())),
        Err(e) => panicked(&e.to_string()),
    })
}

/// Lowers the priority of this thread alone. An error means that it keeps the one it has.
fn give_way(niceness: i32) {
    let _ = rustix::process::setpriority_process(None, niceness);
}

/// The memory of HTTP is in use.
pub(super) fn full() -> wire::Error {
    let mut error = busy("other requests leave no memory for this one");
    error.set_reason(wire::ErrorReason::MemoryLimit);
    error
}

const NEVER_CLOSED: &str = "invariant: the semaphore is never closed";
