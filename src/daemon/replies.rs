//! Counts the replies that are not sent yet because their clients read slowly, for each client and
//! in total.
//!
//! A client that reads is served at its own pace: requests beyond its share wait until it has read
//! more. A client that reads nothing is disconnected when others need the memory, or when its own
//! requests have waited long enough.

use crate::ipc::convert;
use crate::ipc::wire::{self, ErrorCode, ErrorReason};
use bytes::Bytes;
use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::Notify;

/// Bytes that a frame takes beside its content.
const FRAME_COST: u64 = 256;
/// One client may have the limit divided by this.
const SHARE: u64 = 4;
/// Clients with unsent replies leave the limit divided by this to those that have none.
const SPARE: u64 = 4;
/// A client may have this much whatever others have, so that refusals reach it.
const ALWAYS: u64 = 16 << 10;
/// A client without a sent frame for this long is disconnected if memory is short.
const STALLED: Duration = Duration::from_secs(2);
/// How long a request waits until its client has read more.
const PATIENCE: Duration = Duration::from_secs(30);
/// Between checks for clients that stall.
const LOOK: Duration = Duration::from_millis(250);

/// Replies that are not sent yet.
pub(crate) struct Replies {
    state: Mutex<State>,
    freed: Notify,
}

struct State {
    limit: u64,
    used: u64,
    /// The part of `used` that belongs to connections that are ending.
    ending: u64,
    clients: HashMap<Bytes, Unsent>,
}

struct Unsent {
    bytes: u64,
    /// When a frame was last sent, or the first one made.
    progress: Instant,
    ending: bool,
    /// Requests that wait for room. The entry stays until they know that the connection ends.
    waiting: usize,
}

/// A request that waits for room.
struct Waiting<'a> {
    replies: &'a Replies,
    client: &'a Bytes,
}

/// A frame to be sent. It counts until libzmq releases it.
pub(crate) struct Frame {
    bytes: Bytes,
    replies: Arc<Replies>,
    client: Bytes,
}

/// Whether a client may be answered.
enum Room {
    Free,
    Wait,
    /// The client's connection is to be ended.
    Hopeless,
}

impl Replies {
    pub(crate) fn new(limit: u64) -> Arc<Self> {
        Arc::new(Self {
            state: Mutex::new(State {
                limit,
                used: 0,
                ending: 0,
                clients: HashMap::new(),
            }),
            freed: Notify::new(),
        })
    }

    fn state(&self) -> MutexGuard<'_, State> {
        // Counts are whole whatever panicked.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn set_limit(&self, limit: u64) {
        self.state().limit = limit;
    }

    /// Bytes of all replies that are not sent yet.
    pub(crate) fn used(&self) -> u64 {
        self.state().used
    }

    /// Counts the frames of a reply, or none of them if there is no room.
    pub(crate) fn take(
        self: &Arc<Self>,
        client: &Bytes,
        frames: Vec<Bytes>,
    ) -> Result<Vec<Frame>, Vec<Bytes>> {
        let bytes = frames.iter().map(cost).sum();
        if !self.state().take(client, bytes) {
            return Err(frames);
        }
        let frame = |bytes| Frame {
            bytes,
            replies: Arc::clone(self),
            client: client.clone(),
        };
        Ok(frames.into_iter().map(frame).collect())
    }

    /// Whether a client may be answered at once.
    pub(crate) fn has_room(&self, client: &Bytes) -> bool {
        matches!(self.state().room(client), Room::Free)
    }

    /// Waits until a client has read enough to be answered. Meanwhile `end` is called with the
    /// clients whose connections are to be ended.
    pub(crate) async fn room(
        &self,
        client: &Bytes,
        end: impl Fn(Bytes),
    ) -> Result<(), wire::Error> {
        let begin = Instant::now();
        let _waiting = self.wait(client);
        loop {
            let freed = self.freed.notified();
            // Not in the match: ending a connection locks the state.
            let room = self.state().room(client);
            match room {
                Room::Free => return Ok(()),
                Room::Wait if begin.elapsed() < PATIENCE => {}
                Room::Wait => return Err(unread()),
                Room::Hopeless => {
                    end(client.clone());
                    return Err(unread());
                }
            }
            self.end_stalled(&end);
            // Also when nothing is freed: a client may have stalled for long enough by then.
            let _ = tokio::time::timeout(LOOK, freed).await;
        }
    }

    /// If memory is short, ends the connection that has had most for longest without a sent frame.
    pub(crate) fn end_stalled(&self, end: impl Fn(Bytes)) {
        let stalled = self.state().stalled();
        if let Some(client) = stalled {
            end(client);
        }
    }

    /// Notes that a client's connection ends.
    pub(crate) fn ends(&self, client: &Bytes) {
        self.state().ends(client);
    }

    fn sent(&self, client: &Bytes, bytes: u64) {
        let mut state = self.state();
        state.used -= bytes;
        if let Some(unsent) = state.clients.get_mut(client) {
            unsent.bytes -= bytes;
            unsent.progress = Instant::now();
            let (left, ending) = (unsent.bytes, unsent.ending);
            if ending {
                state.ending -= bytes;
            }
            if left == 0 {
                state.forget(client);
            }
        }
        drop(state);
        self.freed.notify_waiters();
    }

    fn wait<'a>(&'a self, client: &'a Bytes) -> Waiting<'a> {
        if let Some(unsent) = self.state().clients.get_mut(client) {
            unsent.waiting += 1;
        }
        Waiting {
            replies: self,
            client,
        }
    }
}

impl State {
    /// Bytes that count against the limit: memory that is about to come back does not.
    fn taken(&self) -> u64 {
        self.used - self.ending
    }

    fn is_short(&self) -> bool {
        self.taken() >= self.limit - self.limit / SPARE
    }

    fn take(&mut self, client: &Bytes, bytes: u64) -> bool {
        let has = self.clients.get(client).map_or(0, |c| c.bytes);
        // The first reply may be larger than the limit, since nothing else is held then.
        let fits = self.taken() == 0 || self.taken() + bytes <= self.limit;
        if !fits && has + bytes > ALWAYS {
            return false;
        }
        self.used += bytes;
        let unsent = self
            .clients
            .entry(client.clone())
            .or_insert_with(|| Unsent {
                bytes: 0,
                progress: Instant::now(),
                ending: false,
                waiting: 0,
            });
        if unsent.bytes == 0 {
            unsent.progress = Instant::now();
        }
        unsent.bytes += bytes;
        if unsent.ending {
            self.ending += bytes;
        }
        true
    }

    fn room(&self, client: &Bytes) -> Room {
        let Some(unsent) = self.clients.get(client) else {
            return Room::Free;
        };
        if !unsent.ending && unsent.bytes < self.limit / SHARE && !self.is_short() {
            Room::Free
        } else if unsent.ending || unsent.progress.elapsed() >= PATIENCE {
            Room::Hopeless
        } else {
            Room::Wait
        }
    }

    /// Unless a request waits or a frame is not sent.
    fn forget(&mut self, client: &Bytes) {
        let idle = |unsent: &Unsent| unsent.bytes == 0 && unsent.waiting == 0;
        if self.clients.get(client).is_some_and(idle) {
            self.clients.remove(client);
        }
    }

    fn stalled(&self) -> Option<Bytes> {
        if !self.is_short() {
            return None;
        }
        let held = |unsent: &Unsent| unsent.bytes as f64 * unsent.progress.elapsed().as_secs_f64();
        let stalled = self
            .clients
            .iter()
            .filter(|(_, unsent)| !unsent.ending && unsent.progress.elapsed() >= STALLED);
        stalled
            .max_by(|a, b| held(a.1).total_cmp(&held(b.1)))
            .map(|(client, _)| client.clone())
    }

    fn ends(&mut self, client: &Bytes) {
        if let Some(unsent) = self.clients.get_mut(client)
            && !unsent.ending
        {
            unsent.ending = true;
            self.ending += unsent.bytes;
        }
    }
}

fn cost(bytes: &Bytes) -> u64 {
    bytes.len() as u64 + FRAME_COST
}

/// The refusal of a request whose client does not read.
fn unread() -> wire::Error {
    let text = "earlier replies are not read yet; read them, then ask again";
    convert::error(ErrorCode::ResourceExhausted, ErrorReason::ClientQuota, text)
}

impl Drop for Waiting<'_> {
    fn drop(&mut self) {
        let mut state = self.replies.state();
        if let Some(unsent) = state.clients.get_mut(self.client) {
            // The entry may have been forgotten and made again.
            unsent.waiting = unsent.waiting.saturating_sub(1);
            state.forget(self.client);
        }
    }
}

impl AsRef<[u8]> for Frame {
    fn as_ref(&self) -> &[u8] {
        &self.bytes
    }
}

impl Drop for Frame {
    fn drop(&mut self) {
        self.replies.sent(&self.client, cost(&self.bytes));
    }
}

#[cfg(test)]
mod tests {
    use super::{ALWAYS, Replies};
    use bytes::Bytes;

    fn frames(n_bytes: usize) -> Vec<Bytes> {
        vec![vec![0; n_bytes].into()]
    }

    #[test]
    fn what_is_not_sent_counts_and_comes_back() {
        let replies = Replies::new(1 << 20);
        let (a, b) = (Bytes::from("a"), Bytes::from("b"));
        assert!(replies.has_room(&a));
        let first = replies.take(&a, frames(300_000)).ok().unwrap();
        assert!(replies.used() > 300_000);
        // It has its share; the other has nothing yet.
        assert!(!replies.has_room(&a) && replies.has_room(&b));
        let rest = replies.take(&b, frames(745_000)).ok().unwrap();
        let refused = replies.take(&a, frames(100_000)).err().unwrap();
        assert_eq!(refused[0].len(), 100_000);
        // A client that has little gets a small reply, however much others have.
        let c = Bytes::from("c");
        let small = replies.take(&c, frames(ALWAYS as usize / 2)).ok().unwrap();
        assert!(replies.take(&c, frames(ALWAYS as usize)).is_err());
        drop((first, small));
        assert!(replies.has_room(&a));
        // Memory that is about to come back counts as free.
        replies.ends(&b);
        let more = replies.take(&a, frames(900_000)).ok().unwrap();
        drop((rest, more));
        assert_eq!(replies.used(), 0);
        assert!(replies.state().clients.is_empty());
        assert_eq!(replies.state().ending, 0);
    }

    #[test]
    fn a_reply_larger_than_all_is_sent_where_nothing_else_is() {
        let replies = Replies::new(1_000_000);
        let (a, b) = (Bytes::from("a"), Bytes::from("b"));
        let large = replies.take(&a, frames(2_000_000)).ok().unwrap();
        assert!(replies.take(&b, frames(2_000_000)).is_err());
        drop(large);
        assert!(replies.take(&b, frames(2_000_000)).is_ok());
    }
}
