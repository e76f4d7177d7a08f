//! `coseg watch` prints all events as they happen.
//!
//! The event socket may drop events for a slow reader. A gap in the sequence numbers, also one that
//! only a heartbeat shows, is filled from the log.

use super::session::Session;
use super::{CommandError, Outcome, events, json};
use crate::cli::Watch;
use coseg::call;
use coseg::ipc::client::ClientError;
use coseg::ipc::wire::{self, event::Kind};
use coseg::library::likely::{did_you_mean, likeliest};
use prost::Message as _;
use std::collections::BTreeMap;
use std::time::Duration;

/// Longest silence that is accepted: heartbeats come once a second, and a few may be late.
const LEAST_SILENCE: Duration = Duration::from_secs(3);

/// Prints events in order and counts them.
struct Printer {
    seen: BTreeMap<String, u64>,
    only: Option<String>,
    left: Option<u64>,
}

impl Printer {
    fn is_over(&self) -> bool {
        self.left == Some(0)
    }

    fn is_wanted(&self, collection: &str) -> bool {
        self.only.as_deref().is_none_or(|only| only == collection)
    }

    fn print(&mut self, event: &wire::Event, session: &Session) -> Result<(), CommandError> {
        let seen = self.seen.entry(event.collection.clone()).or_default();
        if event.sequence <= *seen || self.left == Some(0) {
            return Ok(());
        }
        *seen = event.sequence;
        if session.json {
            session.print_json(&json::event(event))?;
        } else {
            session.line(&json::event_line(event))?;
        }
        self.left = self.left.map(|n| n - 1);
        Ok(())
    }

    /// Prints all events up to `sequence`, which the event socket announced.
    fn catch_up(
        &mut self,
        collection: &str,
        sequence: u64,
        session: &mut Session,
    ) -> Result<(), CommandError> {
        let seen = self.seen.get(collection).copied().unwrap_or(0);
        if sequence > seen && !self.is_over() {
            for event in events::since(session, collection, seen, None)? {
                self.print(&event, session)?;
            }
        }
        Ok(())
    }
}

pub(crate) fn run(args: &Watch, mut session: Session) -> Outcome {
    let only = match args.since {
        Some(_) => Some(session.collection(&args.of.within())?),
        None => args.of.named().cloned(),
    };
    let socket = session.client.subscribe(only.as_deref())?;
    let silence = session.client.timeout().max(LEAST_SILENCE);
    let socket_error = |source| {
        CommandError::Client(ClientError::Socket {
            endpoint: "events".to_owned(),
            source,
        })
    };
    let ms = i32::try_from(silence.as_millis()).unwrap_or(i32::MAX);
    socket.set_rcvtimeo(ms).map_err(socket_error)?;
    // The log is read after subscribing, so that no event is lost in between.
    let mut printer = Printer {
        seen: BTreeMap::new(),
        only: only.clone(),
        left: args.limit,
    };
    let reply = call!(
        session.client,
        ListCollections(wire::ListCollectionsRequest {})
    )?;
    let known: Vec<_> = reply
        .collections
        .iter()
        .filter_map(|c| c.spec.as_ref())
        .collect();
    if let Some(name) = only.filter(|only| known.iter().all(|s| s.name != **only)) {
        let meant = did_you_mean(likeliest(&name, known.iter().map(|s| s.name.as_str())));
        eprintln!("coseg: no collection named {name:?} yet{meant}");
    }
    for c in reply.collections {
        let name = c.spec.unwrap_or_default().name;
        let begin = args
            .since
            .filter(|_| printer.is_wanted(&name))
            .unwrap_or(c.sequence);
        printer.seen.insert(name.clone(), begin);
        if printer.is_wanted(&name) {
            printer.catch_up(&name, c.sequence, &mut session)?;
        }
    }
    while !printer.is_over() {
        let frames = match socket.recv_multipart(0) {
            Ok(frames) => frames,
            Err(zmq::Error::EINTR) => continue,
            Err(zmq::Error::EAGAIN) => {
                return Err(CommandError::Client(ClientError::NoAnswer {
                    endpoint: session.client.endpoint().to_string(),
                    timeout: silence,
                }));
            }
            Err(e) => return Err(socket_error(e)),
        };
        let body = frames.get(1).map(Vec::as_slice).unwrap_or_default();
        let event = wire::Event::decode(body)
            .map_err(|e| CommandError::Client(ClientError::BadReply(e.to_string())))?;
        if let Some(Kind::Heartbeat(heartbeat)) = &event.kind {
            for c in &heartbeat.collections {
                if printer.is_wanted(&c.collection) {
                    printer.catch_up(&c.collection, c.sequence, &mut session)?;
                }
            }
            continue;
        }
        let collection = event.collection.clone();
        let seen = printer.seen.get(&collection).copied().unwrap_or(0);
        if event.sequence > seen + 1 {
            printer.catch_up(&collection, event.sequence, &mut session)?;
        }
        printer.print(&event, &session)?;
    }
    Ok(true)
}
