//! Holds all integration tests in one binary, because linking dominates on two cores.
// Clippy recognises tests, but not their shared functions.
#![allow(clippy::unwrap_used)]

mod asking;
mod bundles;
mod cli;
mod correcting;
mod daemon;
mod formats;
mod fuzzing;
mod golden;
mod harness;
mod hostile;
mod linking;
mod maps;
mod old_store;
mod pipeline;
mod resolution;
mod side_by_side;
mod snapshot;
mod spectra;
mod store;
mod tidy;
mod upright;
mod viewing;
