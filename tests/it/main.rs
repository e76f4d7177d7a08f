//! All integration tests in one binary: linking dominates on two cores.
// Clippy sees tests, not what they share.
#![allow(clippy::unwrap_used)]

mod cli;
mod correcting;
mod daemon;
mod formats;
mod fuzzing;
mod golden;
mod harness;
mod hostile;
mod maps;
mod old_store;
mod pipeline;
mod side_by_side;
mod snapshot;
mod spectra;
mod store;
mod tidy;
mod upright;
mod viewing;
