//! Limits how many requests do some work at a time, and lets clients take turns at it.
//!
//! The requests of one client are served in order, and clients are served round robin: a client
//! that sends a thousand requests delays its own, not those of others.

use bytes::Bytes;
use std::collections::{HashMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tokio::sync::oneshot;

/// A client for the purpose of turns: the key if it is authenticated, else its connection.
pub(crate) type Client = Bytes;

/// A number of places, and the requests that wait for one.
pub(crate) struct Gate {
    state: Mutex<State>,
}

struct State {
    free: usize,
    waiting: HashMap<Client, VecDeque<oneshot::Sender<Pass>>>,
    /// Clients that wait; the first has the turn.
    turns: VecDeque<Client>,
}

/// A place; dropping it lets the next one in.
pub(crate) struct Pass {
    gate: Arc<Gate>,
    armed: bool,
}

/// A place in the queue, taken when it was made. Dropping it gives it up.
pub(crate) struct Turn {
    pass: oneshot::Receiver<Pass>,
    /// The other end is in there.
    _gate: Arc<Gate>,
}

impl Gate {
    pub(crate) fn new(places: usize) -> Arc<Self> {
        Arc::new(Self {
            state: Mutex::new(State {
                free: places,
                waiting: HashMap::new(),
                turns: VecDeque::new(),
            }),
        })
    }

    fn state(&self) -> MutexGuard<'_, State> {
        // Nothing panics while it is held.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Queues up.
    pub(crate) fn queue(self: &Arc<Self>, client: &Client) -> Turn {
        let (sender, receiver) = oneshot::channel();
        let mut state = self.state();
        let queue = state.waiting.entry(client.clone()).or_default();
        queue.push_back(sender);
        if queue.len() == 1 {
            state.turns.push_back(client.clone());
        }
        drop(state);
        self.admit();
        Turn {
            pass: receiver,
            _gate: Arc::clone(self),
        }
    }

    /// Lets in as many as there are places for.
    fn admit(self: &Arc<Self>) {
        loop {
            let mut state = self.state();
            if state.free == 0 {
                return;
            }
            let Some(client) = state.turns.pop_front() else {
                return;
            };
            let Some(queue) = state.waiting.get_mut(&client) else {
                continue;
            };
            let next = queue.pop_front();
            if queue.is_empty() {
                state.waiting.remove(&client);
            } else {
                state.turns.push_back(client);
            }
            let Some(next) = next else { continue };
            state.free -= 1;
            drop(state);
            let pass = Pass {
                gate: Arc::clone(self),
                armed: true,
            };
            if let Err(mut given_up) = next.send(pass) {
                // Here, not by dropping it, which would come back to this function.
                given_up.armed = false;
                self.state().free += 1;
            }
        }
    }
}

impl Drop for Pass {
    fn drop(&mut self) {
        if self.armed {
            self.gate.state().free += 1;
            self.gate.admit();
        }
    }
}

impl Turn {
    /// Waits for it.
    pub(crate) async fn come(self) -> Pass {
        self.pass
            .await
            .expect("invariant: a gate forgets nobody who waits")
    }
}

#[cfg(test)]
mod tests {
    use super::Gate;
    use bytes::Bytes;
    use std::sync::{Arc, Mutex};

    #[test]
    fn clients_take_turns_and_each_keeps_its_order() {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .build()
            .unwrap();
        runtime.block_on(async {
            let gate = Gate::new(1);
            let held = gate.queue(&Bytes::from("x")).come().await;
            let order = Arc::new(Mutex::new(Vec::new()));
            let mut tasks = Vec::new();
            for (client, n) in [("a", 1), ("a", 2), ("a", 3), ("b", 1), ("c", 1), ("b", 2)] {
                let turn = gate.queue(&Bytes::from(client));
                let order = Arc::clone(&order);
                tasks.push(tokio::spawn(async move {
                    let _pass = turn.come().await;
                    order.lock().unwrap().push((client, n));
                }));
            }
            // One gives up.
            drop(gate.queue(&Bytes::from("d")));
            drop(held);
            for task in tasks {
                task.await.unwrap();
            }
            let order = order.lock().unwrap().clone();
            assert_eq!(
                order,
                [("a", 1), ("b", 1), ("c", 1), ("a", 2), ("b", 2), ("a", 3)]
            );
            drop(gate.queue(&Bytes::from("a")).come().await);
            assert_eq!(gate.state().free, 1);
            assert!(gate.state().waiting.is_empty());
        });
    }
}
