//! Publishes the event log on the event socket: after commit, in order, every event.
//!
//! Events are read back from the log, not passed along by the task that caused them, so every
//! committed event is published, whatever caused it.

use crate::daemon::shared::{Daemon, Notice, blocking};
use crate::ipc::wire::{self, event::Kind};
use crate::ipc::{HEARTBEAT_TOPIC, convert, topic};
use crate::library::{Event, EventKind};
use prost::Message as _;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::mpsc;

/// Events read from the log at once.
const BATCH: usize = 256;
/// Time between heartbeats.
const HEARTBEAT: Duration = Duration::from_secs(1);
/// Deleted collections that heartbeats still name, so that a subscriber that missed the deletion
/// notices. The oldest is dropped beyond: clients may create and delete collections without end.
const MAX_DELETED: usize = 256;

/// The last published event of each collection.
struct Published {
    sequences: BTreeMap<String, u64>,
    /// Collections of these whose newest event is their deletion, oldest first.
    deleted: VecDeque<String>,
}

impl Published {
    /// Notes that an event of a collection was published.
    fn advance(&mut self, collection: &str, event: &Event) {
        self.sequences.insert(collection.to_owned(), event.sequence);
        self.deleted.retain(|name| name != collection);
        if event.kind == EventKind::CollectionDeleted {
            self.deleted.push_back(collection.to_owned());
        }
        if self.deleted.len() > MAX_DELETED
            && let Some(oldest) = self.deleted.pop_front()
        {
            self.sequences.remove(&oldest);
        }
    }
}

/// Publishes until it receives [`Notice::Stop`]. `published` has the last published event of each
/// collection.
pub(crate) async fn run(
    daemon: Arc<Daemon>,
    mut notices: mpsc::UnboundedReceiver<Notice>,
    published: BTreeMap<String, u64>,
) {
    let mut published = Published {
        sequences: published,
        deleted: VecDeque::new(),
    };
    let mut heartbeat = tokio::time::interval(HEARTBEAT);
    heartbeat.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    loop {
        tokio::select! {
            notice = notices.recv() => match notice {
                Some(Notice::Changed(collection)) => {
                    catch_up(&daemon, collection, &mut published).await;
                }
                Some(Notice::Created(collection, sequence)) => {
                    // The log may hold events of an earlier collection of the name.
                    let entry = published.sequences.entry(collection.clone());
                    entry.or_insert(sequence.saturating_sub(1));
                    catch_up(&daemon, collection, &mut published).await;
                }
                Some(Notice::Stop) | None => return,
            },
            _ = heartbeat.tick() => send_heartbeat(&daemon, &published.sequences),
        }
    }
}

/// Publishes the events of the log that are not published yet.
async fn catch_up(daemon: &Arc<Daemon>, collection: String, published: &mut Published) {
    // An unknown collection, or one whose deletion was published long ago, has no entry.
    while let Some(&after) = published.sequences.get(&collection) {
        let name = collection.clone();
        let events = blocking(daemon, move |d| d.library.events_since(&name, after, BATCH)).await;
        let events = match events {
            Ok(Ok(events)) => events,
            Ok(Err(e)) => {
                daemon.telemetry.metrics.fault("publish");
                tracing::error!(collection, error = %e, "the event log cannot be read");
                return;
            }
            Err(panic) => {
                tracing::error!(collection, panic, "reading the event log panicked");
                return;
            }
        };
        for event in &events {
            let body = convert::event(&collection, event).encode_to_vec();
            daemon.outbox.event(topic(&collection), body);
            daemon.telemetry.metrics.events.inc();
            published.advance(&collection, event);
        }
        if events.len() < BATCH {
            return;
        }
    }
}

fn send_heartbeat(daemon: &Daemon, published: &BTreeMap<String, u64>) {
    let collections = published
        .iter()
        .map(|(collection, &sequence)| wire::CollectionSequence {
            collection: collection.clone(),
            sequence,
        });
    let heartbeat = wire::Heartbeat {
        collections: collections.collect(),
        instance: daemon.identity.instance.clone(),
    };
    let event = wire::Event {
        sequence: 0,
        collection: String::new(),
        kind: Some(Kind::Heartbeat(heartbeat)),
    };
    daemon
        .outbox
        .event(HEARTBEAT_TOPIC.to_vec(), event.encode_to_vec());
}

#[cfg(test)]
mod tests {
    use super::{Event, EventKind, MAX_DELETED, Published};
    use std::collections::{BTreeMap, VecDeque};

    #[test]
    fn collections_that_come_and_go_are_forgotten_and_others_are_not() {
        let mut published = Published {
            sequences: BTreeMap::new(),
            deleted: VecDeque::new(),
        };
        let event = |sequence, kind| Event { sequence, kind };
        let mut advance = |name: &str, sequence, kind| {
            published.advance(name, &event(sequence, kind));
            published.sequences.len()
        };
        advance("stays", 1, EventKind::CollectionCreated);
        advance("comes back", 1, EventKind::CollectionCreated);
        advance("comes back", 2, EventKind::CollectionDeleted);
        advance("comes back", 3, EventKind::CollectionCreated);
        let mut most = 0;
        for n in 0..4 * MAX_DELETED {
            let name = format!("c{n}");
            advance(&name, 1, EventKind::CollectionCreated);
            most = most.max(advance(&name, 2, EventKind::CollectionDeleted));
        }
        assert_eq!(most, MAX_DELETED + 2);
        assert_eq!(published.sequences["stays"], 1);
        assert_eq!(published.sequences["comes back"], 3);
        let newest = format!("c{}", 4 * MAX_DELETED - 1);
        assert_eq!(published.sequences[&newest], 2);
    }
}
