//! All integration tests in one binary: linking dominates on two cores.
#![allow(clippy::unwrap_used)] // a test says by panicking what is wrong

mod cli;
mod daemon;
mod harness;
mod pipeline;
mod store;
mod tidy;
