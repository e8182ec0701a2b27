//! Decides which clients may connect to an address of a slot, and how their connections are served.

use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;

use arc_swap::ArcSwapOption;
use tokio::net::TcpStream;
use tokio_util::sync::CancellationToken;

use super::terms::{Terms, Tool};
use super::{MAX_TOOLS, connection, limits};
use crate::connection_limit::{ConnectionLimit, ConnectionPermit, LimitReached, Newcomer};
use crate::listener::ConnectionHandler;
use crate::reading::Dated;
use crate::refusals::Refusals;
use drivegate_core::order::{Authority, Proof};
use drivegate_line::ServedPort;

/// How the tools of an address are served.
#[derive(Debug, Clone)]
pub(super) struct Served {
    pub(super) terms: Arc<Terms>,
    /// A COM port by RFC 2217, not the bare bytes.
    pub(super) telnet: bool,
}

impl Served {
    fn allows(&self, client: IpAddr) -> Option<Authority> {
        let allow = &self.terms.slot.allow;
        allow
            .iter()
            .any(|network| network.contains(&client))
            .then_some(Authority::ReadOnly)
    }
}

/// The handler of one address.
#[derive(Debug)]
pub struct SlotListener {
    number: usize,
    served: ArcSwapOption<Served>,
    limit: Arc<ConnectionLimit>,
    refusals: Arc<Refusals>,
    cancel: CancellationToken,
    /// Token that is cancelled when the gateway stops.
    stopping: CancellationToken,
}

impl SlotListener {
    pub(super) fn new(
        number: usize,
        served: Option<Served>,
        refusals: Arc<Refusals>,
        cancel: CancellationToken,
        stopping: CancellationToken,
    ) -> SlotListener {
        SlotListener {
            number,
            served: ArcSwapOption::from_pointee(served),
            limit: ConnectionLimit::new(limits()),
            refusals,
            cancel,
            stopping,
        }
    }

    /// Applies new settings. Connections stay if nothing changes for them and their address is still allowed.
    pub(super) fn update(&self, served: Served) {
        let before = self.served.load_full();
        let alike = before
            .is_some_and(|before| before.telnet == served.telnet && before.terms.slot.serves_like(&served.terms.slot));
        self.served.store(Some(Arc::new(served.clone())));
        self.limit
            .review(self.number, |place| served.allows(place.address()).filter(|_| alike));
    }
}

impl ConnectionHandler for SlotListener {
    type Permit = ConnectionPermit;

    fn admit(&self, client: IpAddr) -> Option<ConnectionPermit> {
        let newcomer = Newcomer {
            address: client,
            listener: self.number,
            cancel: &self.cancel,
        };
        let judge = || self.served.load().as_ref().and_then(|served| served.allows(client));
        self.refusals.acquire(&self.limit, newcomer, remedy, judge)
    }

    async fn serve(self: Arc<Self>, stream: Dated<TcpStream>, peer: SocketAddr, permit: ConnectionPermit) {
        let Some(served) = self.served.load_full() else { return };
        if let Err(error) = stream.stream().set_nodelay(true) {
            tracing::debug!(target: "drivegate::north::slot", "tool slot: cannot set TCP_NODELAY: {error}");
        }
        let slot = &served.terms.slot;
        let (port, greeting) = if served.telnet {
            let (port, greeting) = ServedPort::new(slot.format);
            (Some(port), greeting)
        } else {
            (None, Vec::new())
        };
        let tool = Tool::new(
            served.terms.clone(),
            &peer.to_string(),
            &peer.ip().to_string(),
            Proof::Address(peer.ip()),
        );
        let connection = connection::Connection::new(stream, Arc::new(tool), port, greeting);
        connection
            .serve(slot.idle_timeout, permit.place(), &self.stopping)
            .await;
    }
}

fn remedy(_: LimitReached) -> String {
    format!("an address of a slot serves {MAX_TOOLS} tools at a time; close one, or open another slot")
}
