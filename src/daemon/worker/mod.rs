//! Worker processes, which describe and place shapes, and carry out computations and edits, so that
//! no shape can end the daemon.
//!
//! A worker is the same program started again (`coseg worker`). It reads its work from stdin
//! ([`inside`]), and writes stages and the outcome to stdout, one piece of work after the other. A
//! panic is caught in it and fails that shape or request. An abort, a stack overflow, too much
//! memory or too much time costs one process; the next piece of work gets a new one.
//!
//! Workers that describe see bytes only. The others open the library beside the daemon, which does
//! not use a collection while a worker changes it. A worker that is killed in the middle of a
//! commit leaves what a crash leaves: nothing or all of it.

mod answers;
mod inside;
mod pipe;
mod poison;
pub(in crate::daemon) mod pool;
mod process;
mod report;
mod resolution;

pub use inside::run_worker;
pub use pipe::WORKER_COMMAND;
pub use poison::POISON_VARIABLE;
pub(crate) use pool::{Placing, RemoteWork};
pub(crate) use process::Ended;
pub(crate) use report::{Outcome, Report, read_answer, read_report};
