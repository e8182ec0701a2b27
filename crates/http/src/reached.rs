//! How a request arrived: its client, and the properties of its connection.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use axum::http::{StatusCode, request};

use super::access::Access;
use super::hosts::Hosts;
use super::limits::{HEAD_TIMEOUT, HEALTH_HEAD_TIMEOUT};
use super::replies::Replied;
use crate::local::Control;
use drivegate_core::order::{Proof, Right, SourceKind};
use drivegate_north::connection_limit::ConnectionPlace;
use drivegate_north::log_throttle::LogThrottle;

/// Requests that a connection may make.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Coverage {
    Everything,
    /// `/healthz`, `/readyz` and commands of users; the rest is refused with 503.
    Health,
}

impl Coverage {
    /// Time limit for the head of a request.
    pub(super) fn head_timeout(self) -> Duration {
        match self {
            Coverage::Everything => HEAD_TIMEOUT,
            Coverage::Health => HEALTH_HEAD_TIMEOUT,
        }
    }
}

/// The client of a request.
#[derive(Debug, Clone, Copy)]
pub(super) struct Client {
    pub(super) address: IpAddr,
    pub(super) coverage: Coverage,
}

/// A user of the local socket: any user who may open the socket may do everything.
#[derive(Debug, Clone)]
pub(crate) struct LocalUser {
    /// The interface that the user used, for the audit.
    pub(crate) kind: SourceKind,
    /// Name of the user, as the audit shows it.
    pub(crate) who: Arc<str>,
    /// The proof of the user, from the connection.
    pub(crate) proof: Proof,
    /// Right of the user to write.
    pub(crate) right: Right,
    /// Control of the gateway itself; `None` if it has no configuration file.
    pub(crate) control: Option<Control>,
}

/// How a request arrived; stored with the request as an extension.
#[derive(Debug, Clone)]
pub(super) struct Reached {
    /// The address of this machine that the client connected to.
    pub(super) address: IpAddr,
    pub(super) peer: SocketAddr,
    pub(super) access: Arc<Access>,
    /// Limits the log of refused requests.
    pub(super) refusals: Arc<LogThrottle>,
    /// The connection has TLS.
    pub(super) tls: bool,
    /// The user of the local socket; `None` for a connection over TCP.
    pub(super) local: Option<LocalUser>,
    /// The place of the connection under the limit; `None` without a socket.
    pub(super) place: Option<Arc<ConnectionPlace>>,
}

impl Reached {
    /// How the request with this head arrived.
    ///
    /// # Errors
    /// If no listener stored this data in the request.
    pub(super) fn of(head: &request::Parts) -> Replied<Reached> {
        let reached = head.extensions.get().cloned();
        reached.ok_or(StatusCode::INTERNAL_SERVER_ERROR.into())
    }

    /// A request from this machine that did not come over a network: through the local socket, or from a test of
    /// the interface.
    pub(super) fn within(local: Option<LocalUser>, place: Option<Arc<ConnectionPlace>>) -> Reached {
        let address = IpAddr::V4(Ipv4Addr::LOCALHOST);
        Reached {
            address,
            peer: (address, 0).into(),
            access: Arc::new(Access {
                hosts: Hosts::new("", &[]),
                tokens: None,
            }),
            refusals: Arc::default(),
            tls: false,
            local,
            place,
        }
    }
}
