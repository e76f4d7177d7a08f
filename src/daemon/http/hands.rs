//! What HTTP may take of the daemon: threads of its own, a few of lower priority for what takes
//! time, memory, and so many requests at a time.

use crate::config::Limits;
use crate::daemon::memory::{Budget, Reservation};
use crate::daemon::panic_text;
use crate::daemon::requests::{busy, panic_error};
use crate::ipc::wire;
use bytes::Bytes;
use std::sync::Arc;
use tokio::runtime::Runtime;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, SemaphorePermit};

/// Threads that wait for connections: they compute nothing whose size a request chooses.
const N_THREADS: usize = 2;
/// Threads at a time that turn requests into what is asked, and replies into answers.
const N_WORKING: usize = 2;
/// Those, and one that reads metrics.
const N_BLOCKING: usize = N_WORKING + 1;
/// The priority of those that wait, before the workers, and of those that work, beside them: a page
/// waits rather than a client of the sockets.
const WAITING_NICENESS: i32 = 1;
const WORKING_NICENESS: i32 = 5;
/// Requests of viewers in hand, and of those for which the daemon is asked at a time: both kinds
/// together fewer than there are connections, so that some can always make way.
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

/// Something with the memory that is set aside for it.
pub(super) struct Kept<T> {
    pub(super) it: T,
    pub(super) memory: Reservation,
}

impl AsRef<[u8]> for Kept<Bytes> {
    fn as_ref(&self) -> &[u8] {
        &self.it
    }
}

impl Kept<Bytes> {
    /// Bytes that give their memory back when the last of them is sent.
    pub(super) fn into_bytes(mut self) -> Bytes {
        self.memory.shrink_to(self.it.len() as u64);
        Bytes::from_owner(self)
    }
}

/// What all requests share.
pub(super) struct Hands {
    memory: Arc<Budget>,
    /// Bytes of the largest answer of the daemon.
    max_answer: u64,
    reads: Lane,
    changes: Lane,
    working: Arc<Semaphore>,
}

/// Where requests of one kind wait for their turn.
struct Lane {
    in_hand: Semaphore,
    turns: Semaphore,
}

impl Lane {
    fn new((in_hand, at_a_time): (usize, usize)) -> Self {
        Self {
            in_hand: Semaphore::new(in_hand),
            turns: Semaphore::new(at_a_time),
        }
    }

    async fn turn(&self) -> Result<Turn<'_>, wire::Error> {
        let in_hand = self.in_hand.try_acquire();
        let in_hand = in_hand.map_err(|_| busy("too many requests of viewers wait"))?;
        let turn = self.turns.acquire().await;
        Ok((in_hand, turn.expect(NEVER_CLOSED)))
    }
}

/// A request in hand whose turn has come.
pub(super) type Turn<'a> = (SemaphorePermit<'a>, SemaphorePermit<'a>);

impl Hands {
    pub(super) fn new(limits: &Limits) -> Self {
        Self {
            memory: Budget::new(limits.http_bytes()),
            max_answer: limits.max_message.0,
            reads: Lane::new(READS),
            changes: Lane::new(CHANGES),
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

    /// Sets memory aside, now or not at all.
    pub(super) fn memory(&self, bytes: u64) -> Option<Reservation> {
        self.memory.try_reserve(bytes)
    }

    /// Sets memory aside for the largest answer there may be; waits a while for it.
    pub(super) async fn memory_of_answer(&self) -> Result<Reservation, wire::Error> {
        let reserved = self.memory.reserve(self.max_answer);
        let reserved = tokio::time::timeout(super::PEER_TIME, reserved).await;
        reserved.map_err(|_| full())
    }

    /// Does what takes time whose length a request chooses, on one of few threads.
    pub(super) async fn work<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, wire::Error> {
        let working = Arc::clone(&self.working).acquire_owned().await;
        let working: OwnedSemaphorePermit = working.expect(NEVER_CLOSED);
        beside(move || {
            // Until it is done, also if nobody waits for it any more.
            let _working = working;
            work()
        })
        .await
    }
}

/// Does what takes time on a thread for it. Whoever asks sees to it that few do at a time.
pub(super) async fn beside<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, wire::Error> {
    let done = tokio::task::spawn_blocking(move || {
        give_way(WORKING_NICENESS);
        work()
    });
    done.await.map_err(|e| match e.try_into_panic() {
        Ok(panic) => panic_error(&panic_text(panic.as_ref())),
        Err(e) => panic_error(&e.to_string()),
    })
}

/// Lowers the priority of this thread alone. An error means that it keeps the one it has.
fn give_way(niceness: i32) {
    let _ = rustix::process::setpriority_process(None, niceness);
}

/// Memory is in use.
pub(super) fn full() -> wire::Error {
    let mut error = busy("other requests leave no memory for this one");
    error.set_reason(wire::ErrorReason::MemoryLimit);
    error
}

const NEVER_CLOSED: &str = "invariant: the semaphore is never closed";
