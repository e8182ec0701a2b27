//! The real program from outside: its commands and the gateway as processes, commanded by mbpoll and mosquitto.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "tests may panic"
)]

mod support;

mod gateway {
    mod any_profile;
    mod audit;
    mod bacnet;
    mod bad_commands;
    mod cli;
    mod commands;
    mod demo;
    mod documents;
    mod drill;
    mod drive_access;
    mod families;
    mod fleet;
    mod history;
    mod holder;
    mod hung_disk;
    mod listening;
    mod living;
    mod local_answers;
    mod local_socket;
    mod login_memory;
    mod messages;
    mod openapi;
    mod operators;
    mod other_machines;
    mod parameters;
    mod pauses;
    mod recordings;
    mod reload;
    mod replay;
    mod restart;
    mod restoring;
    mod rights;
    mod slow_log;
    mod start_guard;
    mod stop_all;
    mod stops_in_blocks;
    mod trace;
    mod trying;
    mod user_profiles;
    mod without_gateway;
    mod wrong_protocol;
}
