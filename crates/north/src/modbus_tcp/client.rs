//! The identity and rights of a client.

use std::net::SocketAddr;
use std::sync::Arc;

use super::routes::PlantView;
use crate::connection_limit::Rights;
use drivegate_core::order::{Authority, Grants, Origin, Proof, Right, SourceKind};

/// A connected client.
#[derive(Debug, Clone)]
pub(super) struct Client {
    pub(super) rights: Rights,
    /// Name of the client in the audit: its address, preceded by the name in its certificate if it has one.
    pub(super) who: String,
    /// Name without the port: all connections of a client share it.
    client: Arc<str>,
    proof: Proof,
    right: Right,
}

/// The right of a client to write: by its address or certificate, on the buses that its listener shows.
#[derive(Debug)]
struct ClientRight {
    rights: Rights,
    view: Arc<PlantView>,
}

impl Grants for ClientRight {
    fn may_write(&self, bus: &str) -> bool {
        self.rights.authority() == Authority::Write && self.view.shows(bus)
    }
}

impl Client {
    /// The client at `peer`, with the `name` in its certificate if it has one.
    pub(super) fn new(peer: SocketAddr, name: Option<&str>, rights: impl Into<Rights>) -> Client {
        let (kind, ip) = (SourceKind::ModbusTcp.name(), peer.ip());
        let (who, client) = match name {
            Some(name) => (format!("{name} at {peer}"), format!("{kind} {name} at {ip}")),
            None => (peer.to_string(), format!("{kind} {ip}")),
        };
        Client {
            rights: rights.into(),
            who,
            client: client.into(),
            proof: match name {
                Some(name) => Proof::Certificate(name.into(), ip),
                None => Proof::Address(ip),
            },
            right: Right::lasting(),
        }
    }

    /// Sets the view of the listener, which limits the right.
    pub(super) fn seeing(mut self, view: &Arc<PlantView>) -> Client {
        self.right = Right::of(Arc::new(ClientRight {
            rights: self.rights.clone(),
            view: view.clone(),
        }));
        self
    }

    /// The origin of this client's commands.
    pub(super) fn origin(&self) -> Origin {
        let origin = Origin::of(self.client.clone(), SourceKind::ModbusTcp, self.who.as_str());
        origin.proven(self.proof.clone()).with_right(self.right.clone())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_connections_of_a_client_share_its_name() {
        let client = |peer: &str, name: Option<&str>| {
            let client = Client::new(peer.parse().unwrap(), name, Authority::ReadOnly);
            client.origin().client().to_string()
        };
        assert_eq!(client("127.0.0.1:4711", None), client("127.0.0.1:4712", None));
        assert_ne!(client("127.0.0.1:4711", None), client("127.0.0.2:4711", None));
        assert_eq!(client("[::1]:5", None), "modbus_tcp ::1");
        let op = Some("op");
        assert_eq!(client("127.0.0.1:4711", op), client("127.0.0.1:4712", op));
        assert_ne!(
            client("127.0.0.1:4711", op),
            client("127.0.0.2:4711", op),
            "one certificate at two addresses"
        );
        assert_ne!(
            client("127.0.0.1:4711", op),
            client("127.0.0.1:4711", Some("vi")),
            "two certificates at one address"
        );
        assert_ne!(client("127.0.0.1:4711", op), client("127.0.0.1:4711", None));
        let who = Client::new("127.0.0.1:4711".parse().unwrap(), op, Authority::Write)
            .origin()
            .who;
        assert_eq!(who, "op at 127.0.0.1:4711", "the audit names the connection");
    }
}
