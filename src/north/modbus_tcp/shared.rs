//! What connections share, and what each knows beforehand: who the client is, which drive a unit id means.

use std::collections::HashMap;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, PoisonError};

use arc_swap::ArcSwap;

use super::Options;
use crate::command::{Authority, Origin, SourceKind};
use crate::north::NorthStats;
use crate::plant::{BusHandle, DriveHandle, Plant, SharedPlant};

/// What all connections share.
#[derive(Debug)]
pub(super) struct Shared {
    pub(super) options: Options,
    pub(super) stats: Arc<NorthStats>,
    /// The word last written at 0x8100, by drive name: a fault reset is a change of its bit 2.
    command_words: Mutex<HashMap<String, Option<u16>>>,
}

impl Shared {
    pub(super) fn new(options: Options, stats: Arc<NorthStats>) -> Shared {
        Shared {
            options,
            stats,
            command_words: Mutex::default(),
        }
    }

    /// Does something with the word of a drive that nobody else may change in between.
    pub(super) fn with_command_word<T>(&self, drive: &str, act: impl FnOnce(&mut Option<u16>) -> T) -> T {
        let mut words = self.command_words.lock().unwrap_or_else(PoisonError::into_inner);
        let mut word = words.get(drive).copied().unwrap_or_default();
        let result = act(&mut word);
        words.insert(drive.to_string(), word);
        result
    }
}

/// Who a client is and what it may do.
#[derive(Debug, Clone)]
pub(super) struct Client {
    pub(super) authority: Authority,
    /// Its address, with the name in its certificate if it has shown one: its name in the audit.
    pub(super) who: String,
    /// The same without the port: all its connections are one client.
    client: Arc<str>,
}

impl Client {
    /// The client at `peer`, by the `name` in its certificate if it has shown one.
    pub(super) fn new(peer: SocketAddr, name: Option<&str>, authority: Authority) -> Client {
        let (kind, ip) = (SourceKind::ModbusTcp.name(), peer.ip());
        let (who, client) = match name {
            Some(name) => (format!("{name} at {peer}"), format!("{kind} {name} at {ip}")),
            None => (peer.to_string(), format!("{kind} {ip}")),
        };
        Client {
            authority,
            who,
            client: client.into(),
        }
    }

    /// Who gives an order.
    pub(super) fn origin(&self) -> Origin {
        Origin::of(self.client.clone(), SourceKind::ModbusTcp, self.who.as_str())
    }
}

/// What the clients of one listener see of the plant.
#[derive(Debug)]
pub(super) struct View {
    plant: SharedPlant,
    /// Names of the buses that are shown; `None` shows all.
    buses: Option<Vec<String>>,
    routes: ArcSwap<Routes>,
}

impl View {
    pub(super) fn new(plant: SharedPlant, buses: Option<Vec<String>>) -> View {
        let routes = ArcSwap::from_pointee(Routes::new(plant.load_full(), buses.as_deref()));
        View { plant, buses, routes }
    }

    /// The drives as the plant has them now; all clients share what one has worked out after a reload.
    pub(super) fn routes(&self) -> Arc<Routes> {
        let routes = self.routes.load_full();
        if self.is_current(&routes) {
            return routes;
        }
        let routes = Arc::new(Routes::new(self.plant.load_full(), self.buses.as_deref()));
        self.routes.store(routes.clone());
        routes
    }

    pub(super) fn is_current(&self, routes: &Routes) -> bool {
        Arc::ptr_eq(&self.plant.load(), &routes.plant)
    }
}

/// The drives by unit id, as the plant had them at one time.
#[derive(Debug)]
pub(super) struct Routes {
    pub(super) plant: Arc<Plant>,
    drives: Vec<DriveHandle>,
    /// Place in `drives`.
    units: Vec<Option<u16>>,
    /// Whether the bus is shown, in the order of the plant.
    shown: Vec<bool>,
}

impl Routes {
    fn new(plant: Arc<Plant>, buses: Option<&[String]>) -> Routes {
        let is_shown = |name: &String| buses.is_none_or(|buses| buses.contains(name));
        let drives: Vec<DriveHandle> = plant.drives().filter(|d| is_shown(&d.image.spec.bus)).collect();
        let mut units = vec![None; usize::from(u8::MAX) + 1];
        for (place, drive) in (0u16..).zip(&drives) {
            if let Some(unit) = units.get_mut(usize::from(drive.image.spec.unit)) {
                unit.get_or_insert(place);
            }
        }
        let shown = plant.buses.iter().map(|b| is_shown(&b.image.spec.name)).collect();
        Routes {
            plant,
            drives,
            units,
            shown,
        }
    }

    pub(super) fn drive(&self, unit: u8) -> Option<&DriveHandle> {
        let place = self.units.get(usize::from(unit)).copied().flatten()?;
        self.drives.get(usize::from(place))
    }

    /// The bus at that place of the file, if it is shown.
    pub(super) fn bus(&self, place: usize) -> Option<&BusHandle> {
        let shown = self.shown.get(place).copied().unwrap_or_default();
        self.plant.buses.get(place).filter(|_| shown)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn connections_are_one_client_and_clients_are_told_apart() {
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
            "one certificate, two places"
        );
        assert_ne!(
            client("127.0.0.1:4711", op),
            client("127.0.0.1:4711", Some("vi")),
            "one place, two certificates"
        );
        assert_ne!(client("127.0.0.1:4711", op), client("127.0.0.1:4711", None));
        let who = Client::new("127.0.0.1:4711".parse().unwrap(), op, Authority::Write)
            .origin()
            .who;
        assert_eq!(who, "op at 127.0.0.1:4711", "the audit names the connection");
    }
}
