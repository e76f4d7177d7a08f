//! All integration tests in one binary: linking dominates on two cores.
mod cli;
mod daemon;
mod harness;
mod pipeline;
mod store;
mod tidy;
