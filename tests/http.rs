//! The HTTP interface against a hand-made plant, with plain clients, promtool, a real Prometheus and a
//! real browser.
#![allow(
    clippy::expect_used,
    clippy::indexing_slicing,
    clippy::panic,
    clippy::unwrap_used,
    reason = "a test ends where it fails, in its helpers too"
)]

#[path = "http/client.rs"]
mod client;
#[path = "http/interface.rs"]
mod interface;
#[path = "http/metrics.rs"]
mod metrics;
#[path = "http/page.rs"]
mod page;
#[path = "http/plant.rs"]
mod plant;
#[path = "http/streams.rs"]
mod streams;
