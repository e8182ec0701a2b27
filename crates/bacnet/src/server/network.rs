//! Receives and sends datagrams, and answers router messages (clause 6).

use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::Arc;
use std::time::Instant;

use super::segments::Message;
use super::{Application, Delivery, Server, Source, Target};
use crate::apdu::{self, Apdu};
use crate::bvlc::{self, Bvlc};
use crate::npdu::{self, GLOBAL, Payload, message};
use crate::object::Device;
use crate::services::confirmed;
use crate::types::{Address, Mac};

/// Reasons for refusing a message to a network.
const UNKNOWN_NETWORK: u8 = 1;
const UNKNOWN_MESSAGE: u8 = 3;
const OTHER: u8 = 0;

impl Server {
    /// Processes a datagram that arrived.
    pub fn receive(&mut self, from: SocketAddrV4, bytes: &[u8], app: &dyn Application, now: Instant) {
        // The server's own broadcast was received.
        if from == self.options.address {
            return;
        }
        let Some(datagram) = bvlc::decode(bytes) else {
            self.counters.discarded += 1;
            return;
        };
        let of_bbmd = self.foreign.is_bbmd(from);
        let passed_on = of_bbmd || self.is_neighbour(*from.ip());
        let admitted = match datagram {
            Bvlc::Result(_) => of_bbmd,
            // The original sender is judged, not the one that forwards the datagram.
            Bvlc::Forwarded(origin, _) => passed_on && app.admits(*origin.ip()),
            _ => app.admits(*from.ip()),
        };
        if !admitted {
            self.counters.discarded += 1;
            return;
        }
        self.counters.received += 1;
        let source = |host: SocketAddrV4, way: Delivery| Source {
            address: Address::local(host),
            way,
        };
        match datagram {
            Bvlc::Result(code) => self.foreign.answered(code, now),
            Bvlc::ForBbmd(code) => {
                self.traffic.received(*from.ip(), bytes.len(), now);
                self.traffic.answer(from, bvlc::result(code), now);
            }
            Bvlc::Register(_) | Bvlc::ReadForeign | Bvlc::DeleteForeign(_) | Bvlc::Distribute(_) => {
                self.traffic.received(*from.ip(), bytes.len(), now);
                self.of_foreign_device(from, datagram, app, now);
            }
            Bvlc::Unicast(npdu) => {
                self.traffic.received(*from.ip(), bytes.len(), now);
                self.network(source(from, Delivery::Unicast), npdu, app, now);
            }
            Bvlc::Broadcast(npdu) => {
                self.distribute(from, npdu, now);
                self.network(source(from, Delivery::Broadcast), npdu, app, now);
            }
            Bvlc::Forwarded(origin, npdu) if origin != self.options.address => {
                self.network(source(origin, Delivery::Broadcast), npdu, app, now);
            }
            Bvlc::Forwarded(..) => {}
        }
    }

    /// A request to this host as a BBMD.
    fn of_foreign_device(&mut self, from: SocketAddrV4, request: Bvlc<'_>, app: &dyn Application, now: Instant) {
        let done = |done: bool, code: u16| bvlc::result(if done { 0 } else { code });
        let answer = match request {
            Bvlc::Register(time) => done(self.foreign_devices.register(from, time, now), bvlc::NO_REGISTRATION),
            Bvlc::DeleteForeign(host) => done(self.foreign_devices.delete(host, now), bvlc::NO_DELETION),
            Bvlc::Distribute(_) if !self.foreign_devices.has(from, now) => bvlc::result(bvlc::NO_DISTRIBUTION),
            Bvlc::Distribute(npdu) => {
                self.traffic.broadcast(bvlc::forwarded(from, npdu), now);
                self.distribute(from, npdu, now);
                let source = Source {
                    address: Address::local(from),
                    way: Delivery::Broadcast,
                };
                return self.network(source, npdu, app, now);
            }
            _ if self.options.foreign_devices == 0 => bvlc::result(0x0040),
            _ => bvlc::foreign_devices(self.foreign_devices.all(now)),
        };
        self.traffic.answer(from, answer, now);
    }

    /// Forwards a broadcast to the foreign devices, except to its sender.
    fn distribute(&mut self, from: SocketAddrV4, npdu: &[u8], now: Instant) {
        let others: Vec<SocketAddrV4> = self.foreign_devices.hosts(now).filter(|host| *host != from).collect();
        for host in others {
            self.traffic.answer(host, bvlc::forwarded(from, npdu), now);
        }
    }

    /// Whether a host is on the same network as the server.
    fn is_neighbour(&self, host: Ipv4Addr) -> bool {
        let mask = u32::MAX
            .checked_shl(32 - u32::from(self.options.prefix.min(32)))
            .unwrap_or(0);
        let own = u32::from(*self.options.address.ip());
        self.options.prefix > 0 && u32::from(host) & mask == own & mask
    }

    fn network(&mut self, mut source: Source, bytes: &[u8], app: &dyn Application, now: Instant) {
        let Some(npdu) = npdu::decode(bytes) else {
            self.counters.discarded += 1;
            return;
        };
        // A source network equal to the virtual network is forged or looped, since its devices send nothing through
        // this socket.
        if npdu.from.is_some_and(|(network, _)| self.is_own(network)) {
            self.counters.discarded += 1;
            return;
        }
        source.address.remote = npdu.from;
        let target = match npdu.to {
            None => Target::Own,
            Some((_, _, 0)) => return,
            // The router to the virtual network uses up the last hop.
            Some((GLOBAL, _, 1)) => Target::Own,
            Some((network, _, 1)) if self.is_own(network) => return,
            Some((GLOBAL, ..)) => Target::All,
            Some((network, mac, _)) if self.is_own(network) => match mac {
                Mac::ALL => Target::Network,
                mac => match self.by_station.get(&mac) {
                    Some(place) => Target::Device(*place),
                    None => return self.receive_for_removed(source, mac, npdu.payload, app, now),
                },
            },
            // Without a virtual network the server is not a router, and only routers reject unknown networks.
            Some(_) if self.options.network.is_none() => return,
            Some((network, ..)) => return self.reject(source, UNKNOWN_NETWORK, network, now),
        };
        match npdu.payload {
            Payload::Application(apdu) => self.application(source, target, apdu, app, now),
            Payload::Network(kind, content) => self.between_routers(source, target, kind, content, now),
        }
    }

    /// A write to a station that no device has any more, which may stop the machine that had it.
    fn receive_for_removed(
        &mut self,
        source: Source,
        station: Mac,
        payload: Payload<'_>,
        app: &dyn Application,
        now: Instant,
    ) {
        let (Payload::Application(bytes), Delivery::Unicast) = (payload, source.way) else {
            return;
        };
        let Some(instance) = app.formerly(station) else { return };
        let Some(Apdu::Confirmed {
            segmented: false,
            invoke,
            service: service @ (confirmed::WRITE_PROPERTY | confirmed::WRITE_PROPERTY_MULTIPLE),
            data,
            ..
        }) = apdu::decode(bytes)
        else {
            return;
        };
        let device = Device::new(instance, Some(station), String::new(), Default::default(), Vec::new());
        self.write_request(source.address, &Arc::new(device), (invoke, service), data, app, now);
    }

    fn between_routers(&mut self, source: Source, target: Target, kind: u8, content: &[u8], now: Instant) {
        let Some(network) = self.options.network.map(u16::to_be_bytes) else {
            return;
        };
        match (kind, content) {
            _ if !matches!(target, Target::Own | Target::All) => {}
            (message::WHO_IS_ROUTER, []) => self.announce_network(Some(source), now),
            (message::WHO_IS_ROUTER, asked) if *asked == network => self.announce_network(Some(source), now),
            // These messages are answered by other routers, or are not meant for us.
            (message::WHO_IS_ROUTER | message::I_AM_ROUTER | message::REJECT, _) => {}
            // The message requests the routing table without changing it.
            (message::INITIALIZE_TABLE, [0]) if source.way == Delivery::Unicast => {
                let table = [1, network[0], network[1], 1, 0];
                self.between(source, message::INITIALIZE_TABLE_ACK, &table, now);
            }
            // Busy and available routers, numbers of networks, security: of no concern here.
            (0x01..=0x13, _) => {}
            _ => self.reject(source, UNKNOWN_MESSAGE, 0, now),
        }
    }

    /// Sends I-Am-Router-To-Network for the virtual network.
    pub(super) fn announce_network(&mut self, asked: Option<Source>, now: Instant) {
        let Some(network) = self.options.network.map(u16::to_be_bytes) else {
            return;
        };
        match asked {
            Some(source) if source.way == Delivery::Unicast => {
                self.between(source, message::I_AM_ROUTER, &network, now)
            }
            _ => {
                let npdu = npdu::encode(None, None, false, Payload::Network(message::I_AM_ROUTER, &network));
                self.broadcast(&npdu, now);
            }
        }
    }

    fn between(&mut self, source: Source, kind: u8, content: &[u8], now: Instant) {
        let npdu = npdu::encode(source.address.remote, None, false, Payload::Network(kind, content));
        self.traffic.answer(source.address.host, bvlc::unicast(&npdu), now);
    }

    /// Refuses a message; a broadcast is not answered with that.
    fn reject(&mut self, source: Source, why: u8, network: u16, now: Instant) {
        if source.way == Delivery::Unicast {
            let [high, low] = network.to_be_bytes();
            self.between(source, message::REJECT, &[why, high, low], now);
        }
        debug_assert!(why != OTHER);
    }

    fn application(&mut self, source: Source, target: Target, bytes: &[u8], app: &dyn Application, now: Instant) {
        let Some(message) = apdu::decode(bytes) else {
            self.counters.discarded += 1;
            return;
        };
        if let Apdu::Unconfirmed(service, data) = message {
            return self.unconfirmed(source, target, service, data, app, now);
        }
        // A request that is answered, and what belongs to one, is between two.
        let place = match target {
            Target::Own => 0,
            Target::Device(place) => place,
            Target::All | Target::Network => return,
        };
        let Some(device) = self
            .devices
            .get(place)
            .cloned()
            .filter(|_| source.way == Delivery::Unicast)
        else {
            return;
        };
        let from = source.address;
        match message {
            Apdu::Confirmed { .. } => self.confirmed(from, &device, message, app, now),
            Apdu::SimpleAck(invoke) | Apdu::ComplexAck(invoke) | Apdu::Error(invoke) | Apdu::Reject(invoke) => {
                self.cov.answered(from, device.instance, invoke);
                self.notify(app, now);
            }
            Apdu::SegmentAck {
                server: false,
                invoke,
                sequence,
                window,
                ..
            } => {
                let mut out = Vec::new();
                let which = (invoke, sequence, window);
                self.segments
                    .acknowledged((from, device.instance), which, now, &mut out);
                self.send_segments(out, now);
            }
            Apdu::Abort { server: false, invoke } => self.segments.end(from, device.instance, invoke),
            Apdu::Abort { server: true, invoke } => {
                self.cov.answered(from, device.instance, invoke);
                self.notify(app, now);
            }
            Apdu::SegmentAck { .. } | Apdu::Unconfirmed(..) => {}
        }
    }

    /// The station of a device, as a sender.
    fn station(&self, device: u32) -> Option<(u16, Mac)> {
        let mac = self.device(device)?.station?;
        Some((self.options.network?, mac))
    }

    /// Sends an answer of a station.
    pub(super) fn send_as(&mut self, station: Option<(u16, Mac)>, to: Address, apdu: &[u8], now: Instant) {
        let npdu = npdu::encode(to.remote, station, false, Payload::Application(apdu));
        self.traffic.answer(to.host, bvlc::unicast(&npdu), now);
    }

    pub(super) fn message(&self, to: Address, device: u32, apdu: &[u8], expects: bool) -> Vec<u8> {
        let payload = Payload::Application(apdu);
        bvlc::unicast(&npdu::encode(to.remote, self.station(device), expects, payload))
    }

    /// Sends an answer of a device.
    pub(super) fn send(&mut self, to: Address, device: u32, apdu: &[u8], now: Instant) {
        self.send_as(self.station(device), to, apdu, now);
    }

    pub(super) fn send_segments(&mut self, segments: Vec<Message>, now: Instant) {
        for (to, device, segment) in segments {
            // The last one of a window is acknowledged.
            let message = self.message(to, device, &segment, true);
            self.traffic.answer(to.host, message, now);
        }
    }

    /// Sends a notification that was subscribed to.
    pub(super) fn send_exempt(&mut self, to: Address, device: u32, apdu: &[u8], expects: bool) {
        let message = self.message(to, device, apdu, expects);
        self.traffic.exempt(to.host, message);
    }

    /// Broadcasts a message of a device: on this network, or on the network from which the request came.
    pub(super) fn send_to_all(&mut self, device: u32, network: Option<u16>, apdu: &[u8], now: Instant) {
        let to = network.map(|network| (network, Mac::ALL));
        let npdu = npdu::encode(to, self.station(device), false, Payload::Application(apdu));
        self.broadcast(&npdu, now);
    }

    fn broadcast(&mut self, npdu: &[u8], now: Instant) {
        self.traffic.broadcast(bvlc::broadcast(npdu), now);
        if let Some(bbmd) = self.foreign.passes_on() {
            self.traffic.answer(bbmd, bvlc::distribute(npdu), now);
        }
        self.distribute(self.options.address, npdu, now);
    }

    /// Whether the number is that of the virtual network.
    fn is_own(&self, network: u16) -> bool {
        self.options.network == Some(network)
    }
}
