//! Modbus TCP server.

use std::net::SocketAddr;

use ipnet::IpNet;

/// What the Modbus TCP server is told.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Addresses to listen on.
    pub listen: Vec<SocketAddr>,
    /// Networks that may connect.
    pub allow: Vec<IpNet>,
    /// Networks that may write.
    pub write: Vec<IpNet>,
    /// Connections at one time.
    pub max_connections: usize,
    /// What happens to raw reads outside the plan.
    pub uncached: Uncached,
}

/// What happens to raw reads outside the plan.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Uncached {
    /// They are asked of the drive.
    Forward,
    /// They are refused with 02.
    Refuse,
}
