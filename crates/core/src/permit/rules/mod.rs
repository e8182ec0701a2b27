//! The rules. Each is asked when an order is accepted, when its turn comes and before a frame of it is sent.

pub mod age;
