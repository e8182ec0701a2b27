//! The servers over real sockets, with plants made by hand behind them, and clients that were written elsewhere.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "tests may panic"
)]

mod support;

mod north {
    mod broker;
    mod http;
    mod modbus_tcp;
    mod mqtt;
}
