//! The servers over real sockets, with hand-made plants behind them, and independently written clients.
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
