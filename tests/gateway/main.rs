//! The real program from outside: `demo`, `simulate` and `run` as processes, commanded by mbpoll and mosquitto.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "tests may panic"
)]

mod bad_commands;
mod commands;
mod demo;
mod drive_access;
mod flood;
mod local_socket;
mod operators;
mod process;
mod restart;
mod slow_log;
#[path = "../tools/mod.rs"]
mod tools;
mod user_profiles;
