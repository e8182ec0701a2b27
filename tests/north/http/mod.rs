//! The HTTP interface with a plant that the test sets up, tested with plain clients, promtool, a real Prometheus
//! and a real browser.

mod access;
mod client;
mod commands;
mod dashboards;
mod interface;
mod limits;
mod metrics;
mod operate;
mod page;
mod parameters;
mod plant;
mod streams;
