//! (being written)
pub mod assignment;
