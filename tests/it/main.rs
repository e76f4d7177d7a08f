//! All integration tests in one binary: linking dominates on two cores.
mod cli;
mod daemon;
mod pipeline;
mod store;
mod tidy;
