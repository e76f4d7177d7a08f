//! The daemon: a shell around [`Library`](crate::Library) that takes requests over ZeroMQ and
//! publishes events.
//!
//! One thread owns the sockets ([`sockets`]), and a tokio runtime does the rest. A request becomes
//! an [`operation`], and [`dispatch`] gives each kind to its handler: reads run in parallel
//! ([`reads`]), changes of one collection run one after the other, in the order of their arrival
//! ([`writes`]), additions are accepted in that order ([`intake`]), and waits hold no thread
//! ([`waits`]). [`describing`] and [`placing`] work on accepted shapes, and [`remote`] computes
//! answers, all three in worker processes ([`worker`]). [`publish`] sends new events of the log.
//! Browsers and monitors are served by a runtime of their own ([`http`]). Every queue is bounded;
//! a request beyond the bound is refused with a delay after which to try again.
//!
//! A file of this folder names only files that do not lead back to it: [`answer`] and [`operation`]
//! are at the bottom, the [`shared`] state is in the middle, [`dispatch`] and [`start`] are on top.

mod access;
mod answer;
mod attention;
mod bind;
mod describing;
mod dispatch;
mod error;
mod failures;
mod fair;
mod http;
mod in_flight;
mod incoming;
mod ingest;
mod intake;
mod memory;
mod metrics;
mod operation;
mod outbox;
mod outcome;
mod placing;
mod proposing;
mod progress;
mod publish;
mod queues;
mod quota;
mod reads;
mod remote;
mod replies;
mod running;
mod service;
mod shared;
mod sockets;
mod start;
mod status;
mod sweep;
mod waits;
mod work;
mod worker;
mod writes;

pub use error::StartError;
pub use http::TokenError;
pub use running::Running;
pub use service::{ServeError, serve};
pub use start::start;
pub use worker::{POISON_VARIABLE, WORKER_COMMAND, run_worker};
