//! The UDP sockets: one for datagrams to this host, one for broadcasts of the network and one for 255.255.255.255,
//! to which many clients send. Linux delivers a broadcast only to a socket that is bound to the broadcast address.

use std::io;
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};

use drivegate_bacnet::To;
use rustix::net::{AddressFamily, SocketFlags, SocketType, bind, socket_with, sockopt};
use tokio::net::UdpSocket;

/// The sockets of a server.
#[derive(Debug)]
pub(super) struct Sockets {
    pub(super) address: SocketAddrV4,
    /// Bits of the mask of the network; 0 is not known.
    pub(super) prefix: u8,
    pub(super) broadcast_to: SocketAddrV4,
    pub(super) unicast: UdpSocket,
    /// Sockets for broadcasts; empty if the first socket also receives broadcasts.
    pub(super) broadcasts: Vec<UdpSocket>,
}

impl Sockets {
    /// Binds all sockets of the server.
    ///
    /// # Errors
    /// If the address cannot be used.
    pub(super) async fn bind(listen: SocketAddrV4) -> io::Result<Sockets> {
        let unicast = UdpSocket::bind(SocketAddr::V4(listen)).await?;
        unicast.set_broadcast(true)?;
        let port = unicast.local_addr()?.port();
        let address = SocketAddrV4::new(*listen.ip(), port);
        // Without the routing table only 255.255.255.255 is known.
        let routes = std::fs::read_to_string("/proc/net/route").unwrap_or_default();
        let prefix = prefix(*listen.ip(), &routes);
        let to = broadcast_of(*listen.ip(), prefix);
        let broadcast_to = SocketAddrV4::new(to, port);
        // A socket that is bound to no particular address also receives broadcasts.
        let mut broadcasts = Vec::new();
        if !listen.ip().is_unspecified() {
            broadcasts.push(shared(broadcast_to)?);
            let widest = SocketAddrV4::new(Ipv4Addr::BROADCAST, port);
            if widest != broadcast_to {
                broadcasts.push(shared(widest)?);
            }
        }
        Ok(Sockets {
            address,
            prefix,
            broadcast_to,
            unicast,
            broadcasts,
        })
    }

    /// The address, and the bits of the mask.
    pub(super) fn place(&self) -> (SocketAddrV4, u8) {
        (self.address, self.prefix)
    }
}

/// A socket for broadcasts that other programs on this host can receive at the same time.
fn shared(address: SocketAddrV4) -> io::Result<UdpSocket> {
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    let socket = socket_with(AddressFamily::INET, SocketType::DGRAM, flags, None)?;
    sockopt::set_socket_reuseaddr(&socket, true)?;
    bind(&socket, &address)?;
    UdpSocket::from_std(std::net::UdpSocket::from(socket))
}

/// Bits of the mask of the network of an address, by the table of routes; 0 is not known.
fn prefix(address: Ipv4Addr, routes: &str) -> u8 {
    if address.is_loopback() {
        return 8;
    }
    let networks = routes.lines().skip(1).filter_map(|line| {
        let fields: Vec<&str> = line.split_whitespace().collect();
        let number = |place: usize| Some(u32::from_str_radix(fields.get(place)?, 16).ok()?.swap_bytes());
        // A network that is reached through a gateway is not on the interface.
        let (network, gateway, mask) = (number(1)?, number(2)?, number(7)?);
        let own = gateway == 0 && mask != 0 && u32::from(address) & mask == network;
        own.then_some(mask.leading_ones())
    });
    let longest = networks.filter(|bits| *bits < 31).max();
    longest.and_then(|bits| u8::try_from(bits).ok()).unwrap_or(0)
}

fn broadcast_of(address: Ipv4Addr, prefix: u8) -> Ipv4Addr {
    match prefix {
        0 => Ipv4Addr::BROADCAST,
        bits => Ipv4Addr::from(u32::from(address) | u32::MAX.checked_shr(bits.into()).unwrap_or(0)),
    }
}

impl Sockets {
    /// Sends a datagram, if the system accepts it now.
    ///
    /// # Errors
    /// If the datagram was not sent.
    pub(super) fn send(&self, to: To, datagram: &[u8]) -> io::Result<()> {
        let to = match to {
            To::Host(host) => host,
            To::Broadcast => self.broadcast_to,
        };
        self.unicast.try_send_to(datagram, SocketAddr::V4(to)).map(|_| ())
    }
}

/// A datagram that the system did not accept yet.
#[derive(Debug, Default)]
pub(super) struct Outbox(Option<(To, Vec<u8>)>);

impl Outbox {
    /// Sends what waits and what `next` gives. If the system accepts no more now, the rest waits for the next call; a datagram
    /// that cannot be sent at all is dropped, as UDP allows.
    pub(super) fn flush(
        &mut self,
        mut next: impl FnMut() -> Option<(To, Vec<u8>)>,
        mut send: impl FnMut(To, &[u8]) -> io::Result<()>,
    ) {
        while let Some((to, datagram)) = self.0.take().or_else(&mut next) {
            match send(to, &datagram) {
                Ok(()) => {}
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                    self.0 = Some((to, datagram));
                    return;
                }
                Err(error) => tracing::debug!(target: "drivegate::bacnet", "cannot send to {to:?}: {error}"),
            }
        }
    }

    /// Whether a datagram waits for the system.
    pub(super) fn is_waiting(&self) -> bool {
        self.0.is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ROUTES: &str = "Iface\tDestination\tGateway \tFlags\tRefCnt\tUse\tMetric\tMask\t\tMTU\tWindow\tIRTT\n\
        eth0\t00000000\t010200C0\t0003\t0\t0\t0\t00000000\t0\t0\t0\n\
        eth0\t000200C0\t00000000\t0001\t0\t0\t0\t00FFFFFF\t0\t0\t0\n\
        eth1\t0000000A\t00000000\t0001\t0\t0\t0\t000000FF\t0\t0\t0\n\
        eth1\t0000010A\t0100000A\t0003\t0\t0\t0\t0000FFFF\t0\t0\t0\n";

    #[test]
    fn broadcasts_go_to_the_network_of_the_interface() {
        let cases = [
            ("192.0.2.7", 24, "192.0.2.255"),
            ("10.1.2.3", 8, "10.255.255.255"),
            ("127.0.0.1", 8, "127.255.255.255"),
            ("172.16.0.1", 0, "255.255.255.255"),
            ("0.0.0.0", 0, "255.255.255.255"),
        ];
        for (address, bits, broadcast) in cases {
            let address: Ipv4Addr = address.parse().unwrap();
            let prefix = prefix(address, ROUTES);
            assert_eq!(
                (prefix, broadcast_of(address, prefix)),
                (bits, broadcast.parse().unwrap()),
                "{address}"
            );
        }
        assert_eq!(prefix("192.0.2.7".parse().unwrap(), "broken\nx y z"), 0);
    }

    #[tokio::test]
    async fn what_is_broadcast_is_heard() {
        let sockets = Sockets::bind("127.0.0.3:0".parse().unwrap()).await.unwrap();
        let other = UdpSocket::bind("127.0.0.4:0").await.unwrap();
        other.set_broadcast(true).unwrap();
        other.send_to(b"all", sockets.broadcast_to).await.unwrap();
        let mut buffer = [0; 8];
        let heard = sockets.broadcasts[0].recv_from(&mut buffer).await.unwrap();
        assert_eq!(
            (&buffer[..heard.0], heard.1),
            (&b"all"[..], other.local_addr().unwrap())
        );
        let bound: Vec<SocketAddr> = sockets
            .broadcasts
            .iter()
            .map(|socket| socket.local_addr().unwrap())
            .collect();
        let port = sockets.address.port();
        let widest = SocketAddr::from((Ipv4Addr::BROADCAST, port));
        assert_eq!(bound, [SocketAddr::V4(sockets.broadcast_to), widest]);
    }

    #[test]
    fn what_the_system_does_not_accept_yet_is_sent_later_in_its_order() {
        let datagrams = |numbers: std::ops::Range<u8>| numbers.map(|n| (To::Broadcast, vec![n]));
        let (mut outbox, mut pending) = (Outbox::default(), datagrams(0..6));
        let mut sent: Vec<u8> = Vec::new();
        // The system accepts two datagrams at a time; number 3 it never accepts.
        let mut flush = |outbox: &mut Outbox| {
            let mut room = 2;
            outbox.flush(
                || pending.next(),
                |_, datagram| match (datagram, room) {
                    ([3], _) => Err(io::ErrorKind::NetworkUnreachable.into()),
                    (_, 0) => Err(io::ErrorKind::WouldBlock.into()),
                    (datagram, _) => {
                        room -= 1;
                        sent.extend(datagram);
                        Ok(())
                    }
                },
            );
            (outbox.is_waiting(), sent.clone())
        };
        assert_eq!(flush(&mut outbox), (true, vec![0, 1]));
        assert_eq!(flush(&mut outbox), (true, vec![0, 1, 2, 4]));
        assert_eq!(flush(&mut outbox), (false, vec![0, 1, 2, 4, 5]));
    }
}
