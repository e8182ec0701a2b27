//! The command line: one file a command.

pub mod map;
pub mod simulate;
