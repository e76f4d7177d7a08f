//! A budget of bytes, handed out in reservations.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tokio::sync::Notify;

/// Bytes to hand out.
pub(crate) struct Budget {
    state: Mutex<State>,
    freed: Notify,
}

struct State {
    limit: u64,
    used: u64,
}

/// Bytes that were handed out; dropping it gives them back.
pub(crate) struct Reservation {
    budget: Arc<Budget>,
    bytes: u64,
}

impl Budget {
    pub(crate) fn new(limit: u64) -> Arc<Self> {
        Arc::new(Self {
            state: Mutex::new(State { limit, used: 0 }),
            freed: Notify::new(),
        })
    }

    fn state(&self) -> MutexGuard<'_, State> {
        // Two integers are whole whatever panicked.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Reserves now or not at all.
    pub(crate) fn try_reserve(self: &Arc<Self>, bytes: u64) -> Option<Reservation> {
        let mut state = self.state();
        let used = state
            .used
            .checked_add(bytes)
            .filter(|&used| used <= state.limit)?;
        state.used = used;
        Some(Reservation {
            budget: Arc::clone(self),
            bytes,
        })
    }

    /// Waits until there is room. If nothing else is reserved, more than the limit is handed out,
    /// so that a lowered limit cannot block for ever.
    pub(crate) async fn reserve(self: &Arc<Self>, bytes: u64) -> Reservation {
        loop {
            // Made before the check, so that no release after it is missed.
            let freed = self.freed.notified();
            let limit = self.state().limit;
            if let Some(reservation) = self.try_reserve(bytes.min(limit)) {
                return reservation;
            }
            freed.await;
        }
    }

    pub(crate) fn set_limit(&self, limit: u64) {
        self.state().limit = limit;
        self.freed.notify_waiters();
    }

    pub(crate) fn limit(&self) -> u64 {
        self.state().limit
    }

    pub(crate) fn used(&self) -> u64 {
        self.state().used
    }
}

impl Reservation {
    /// Reserves so many bytes more, or leaves the reservation as it is.
    #[must_use]
    pub(crate) fn try_grow(&mut self, bytes: u64) -> bool {
        let Some(mut more) = self.budget.try_reserve(bytes) else {
            return false;
        };
        self.bytes += std::mem::take(&mut more.bytes);
        true
    }

    /// Gives back all but `bytes`.
    pub(crate) fn shrink_to(&mut self, bytes: u64) {
        let excess = self.bytes.saturating_sub(bytes);
        self.bytes -= excess;
        self.budget.state().used -= excess;
        self.budget.freed.notify_waiters();
    }
}

impl Drop for Reservation {
    fn drop(&mut self) {
        self.shrink_to(0);
    }
}

#[cfg(test)]
mod tests {
    use super::Budget;

    #[test]
    fn bytes_are_handed_out_once() {
        let budget = Budget::new(100);
        let mut a = budget.try_reserve(60).unwrap();
        assert!(budget.try_reserve(41).is_none());
        assert!(budget.try_reserve(u64::MAX).is_none());
        let b = budget.try_reserve(40).unwrap();
        a.shrink_to(10);
        assert_eq!(budget.used(), 50);
        assert!(a.try_grow(50) && !a.try_grow(1));
        assert_eq!(budget.used(), 100);
        drop((a, b));
        assert_eq!(budget.used(), 0);
    }

    #[test]
    fn waiting_ends_when_bytes_come_back() {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .build()
            .unwrap();
        runtime.block_on(async {
            let budget = Budget::new(100);
            let held = budget.reserve(100).await;
            let wait = || {
                let budget = std::sync::Arc::clone(&budget);
                tokio::spawn(async move { budget.reserve(1_000).await.bytes })
            };
            let (one, other) = (wait(), wait());
            tokio::task::yield_now().await;
            assert!(!one.is_finished() && !other.is_finished());
            drop(held);
            assert_eq!((one.await.unwrap(), other.await.unwrap()), (100, 100));
        });
    }
}
