//! The `coseg` command.
fn main() {}
