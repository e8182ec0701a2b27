//! HTTP: status page, Prometheus metrics, health and the JSON interface. GET and HEAD only.

use std::net::SocketAddr;

/// What the HTTP server is told.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Address to listen on.
    pub listen: SocketAddr,
}
