//! The MQTT client against Debian's Mosquitto and its clients.

// Helpers of tests fail like tests do.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::indexing_slicing)]

mod support;

mod commands;
mod delivery;
mod telemetry;
mod tls;
