//! The rules, in the order in which they are asked.

mod access;

pub use access::{access, client_access};
