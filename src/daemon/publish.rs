//! The event log becomes messages on the event socket: after commit, in order, none left out.
//!
//! Events are read back from the log rather than passed along by whoever caused them, so whatever was
//! committed is published, by whichever way it came about.

use crate::daemon::{Daemon, blocking};
use crate::ipc::wire::{self, event::Kind};
use crate::ipc::{HEARTBEAT_TOPIC, convert, topic};
use prost::Message as _;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::mpsc;

/// Events read from the log at once.
const BATCH: usize = 256;
/// Time between heartbeats.
const HEARTBEAT: Duration = Duration::from_secs(1);

/// What the publisher is told.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Notice {
    /// Something may have been committed to the collection.
    Changed(String),
    /// The collection was created, which the event with this number says.
    Created(String, u64),
    /// Nothing more will be committed.
    Stop,
}

/// Publishes until it is told to stop. `published` says how far each log was published before.
pub(crate) async fn run(
    daemon: Arc<Daemon>,
    mut notices: mpsc::UnboundedReceiver<Notice>,
    mut published: BTreeMap<String, u64>,
) {
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
                    published.entry(collection.clone()).or_insert(sequence.saturating_sub(1));
                    catch_up(&daemon, collection, &mut published).await;
                }
                Some(Notice::Stop) | None => return,
            },
            _ = heartbeat.tick() => send_heartbeat(&daemon, &published),
        }
    }
}

/// Publishes what the log has beyond what was published.
async fn catch_up(daemon: &Arc<Daemon>, collection: String, published: &mut BTreeMap<String, u64>) {
    loop {
        let after = published.get(&collection).copied().unwrap_or(0);
        let name = collection.clone();
        let events = blocking(daemon, move |d| d.library.events_since(&name, after, BATCH)).await;
        let events = match events {
            Ok(Ok(events)) => events,
            Ok(Err(e)) => {
                daemon.metrics.fault("publish");
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
            daemon.metrics.events.inc();
            published.insert(collection.clone(), event.sequence);
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
        instance: daemon.instance.clone(),
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
