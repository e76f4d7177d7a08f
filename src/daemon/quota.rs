//! Bounds the requests in flight of one client, and their bytes.

use crate::config::Limits;
use crate::daemon::fair::Client;
use crate::ipc::size::in_words;
use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// The requests in flight of each client.
pub(crate) struct Quotas(Mutex<State>);

struct State {
    max_requests: usize,
    max_bytes: u64,
    clients: HashMap<Client, InFlight>,
}

#[derive(Default)]
struct InFlight {
    requests: usize,
    bytes: u64,
}

/// One request of a client, which counts until this is dropped.
pub(crate) struct Ticket {
    quotas: Arc<Quotas>,
    client: Client,
    bytes: u64,
}

impl Quotas {
    pub(crate) fn new(limits: &Limits) -> Arc<Self> {
        Arc::new(Self(Mutex::new(State {
            max_requests: limits.max_requests_per_client,
            max_bytes: limits.max_bytes_per_client.0,
            clients: HashMap::new(),
        })))
    }

    fn state(&self) -> MutexGuard<'_, State> {
        // Counts are whole whatever panicked.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn set_limits(&self, limits: &Limits) {
        let mut state = self.state();
        state.max_requests = limits.max_requests_per_client;
        state.max_bytes = limits.max_bytes_per_client.0;
    }

    /// Bytes that one client may have in flight.
    pub(crate) fn max_bytes(&self) -> u64 {
        self.state().max_bytes
    }

    /// Counts a request, or returns why it may not be in flight.
    pub(crate) fn admit(self: &Arc<Self>, client: &Client, bytes: u64) -> Result<Ticket, String> {
        let mut state = self.state();
        let (max_requests, max_bytes) = (state.max_requests, state.max_bytes);
        let (requests, held) = state
            .clients
            .get(client)
            .map_or((0, 0), |c| (c.requests, c.bytes));
        if requests >= max_requests {
            return Err(format!(
                "the client has {requests} requests in hand, the limit is {max_requests} \
                 (limits.max_requests_per_client)"
            ));
        }
        if held.saturating_add(bytes) > max_bytes {
            let [held, bytes, limit] = [held, bytes, max_bytes].map(in_words);
            return Err(format!(
                "the client has {held} in hand and sends {bytes} more, the limit is {limit} \
                 (limits.max_bytes_per_client)"
            ));
        }
        let mine = state.clients.entry(client.clone()).or_default();
        mine.requests += 1;
        mine.bytes += bytes;
        Ok(Ticket {
            quotas: Arc::clone(self),
            client: client.clone(),
            bytes,
        })
    }
}

impl Ticket {
    /// The client of the request.
    pub(crate) fn client(&self) -> &Client {
        &self.client
    }

    /// The request is still in flight, but its bytes are released.
    pub(crate) fn free_bytes(&mut self) {
        let bytes = std::mem::take(&mut self.bytes);
        if let Some(mine) = self.quotas.state().clients.get_mut(&self.client) {
            mine.bytes -= bytes;
        }
    }
}

impl Drop for Ticket {
    fn drop(&mut self) {
        self.free_bytes();
        let mut state = self.quotas.state();
        if let Some(mine) = state.clients.get_mut(&self.client) {
            mine.requests -= 1;
            if mine.requests == 0 {
                state.clients.remove(&self.client);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::Quotas;
    use crate::config::{ByteSize, Config};
    use bytes::Bytes;

    #[test]
    fn each_client_has_its_own_and_gets_it_back() {
        let mut limits = Config::default().limits;
        limits.max_requests_per_client = 2;
        limits.max_bytes_per_client = ByteSize(100);
        let quotas = Quotas::new(&limits);
        let (a, b) = (Bytes::from("a"), Bytes::from("b"));
        let mut first = quotas.admit(&a, 60).unwrap();
        let text = quotas.admit(&a, 41).err().unwrap();
        assert!(text.contains("the limit is 100"), "{text}");
        quotas.admit(&b, 100).unwrap();
        first.free_bytes();
        let second = quotas.admit(&a, 100).unwrap();
        let text = quotas.admit(&a, 0).err().unwrap();
        assert!(text.contains("the limit is 2"), "{text}");
        drop((first, second));
        assert!(quotas.state().clients.is_empty());
    }
}
