//! Configuration of the HTTP server.

use std::net::SocketAddr;

use super::limits::{HEALTH, MAX_CONNECTIONS};
use super::tokens::Tokens;
use super::users::Users;
use drivegate_north::connection_limit::Limits;
use drivegate_north::tls::ServerIdentity;

/// Configuration of the HTTP server.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Address on which the server listens.
    pub listen: SocketAddr,
    /// Host names and addresses by which the gateway is reached, in addition to its own and those of the loopback.
    pub hosts: Vec<String>,
    /// The tokens for reading; `None` means that every client may read.
    pub tokens: Option<Tokens>,
    /// The users who may command; `None` if commands are disabled.
    pub users: Option<Users>,
    /// Certificate and key; `None`: without TLS.
    pub identity: Option<ServerIdentity>,
    /// Maximum number of open connections: [`MAX_CONNECTIONS`], or fewer where the system allows fewer open files.
    pub max_connections: usize,
}

impl Options {
    /// Listens on that address, open to everyone, without TLS.
    pub fn listening_on(listen: SocketAddr) -> Options {
        Options {
            listen,
            hosts: Vec::new(),
            tokens: None,
            users: None,
            identity: None,
            max_connections: MAX_CONNECTIONS,
        }
    }

    /// Files that the connections can have open at one time, with those that are being closed.
    pub fn files(&self) -> usize {
        self.limits().files() + HEALTH.files()
    }

    /// The limits of connections: half of them may come from one address. If commands are enabled, some are
    /// reserved for addresses of users.
    pub(super) fn limits(&self) -> Limits {
        let limits = Limits::new(self.max_connections, self.max_connections.div_ceil(2));
        match self.users {
            Some(_) => limits.with_reserve(),
            None => limits,
        }
    }
}
