//! A listener: who comes in, as whom.

use std::io;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::{Duration, Instant};

use ipnet::IpNet;
use tokio::net::{TcpListener, TcpStream};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::places::{Full, Place, Places};
use super::session::Session;
use super::shared::{Client, Shared, View};
use super::tls::{Gatekeeper, Role};
use super::{Seldom, connection};
use crate::command::Authority;
use crate::north::Turned;

/// Pause after a failed accept: the usual reason, too many open files, does not go away at once.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// A peer that vanished without a word is found out after 60 s + 3 * 10 s.
const KEEPALIVE_IDLE: Duration = Duration::from_secs(60);
const KEEPALIVE_INTERVAL: Duration = Duration::from_secs(10);
const KEEPALIVE_PROBES: u32 = 3;

/// What decides about the rights of a client.
#[derive(Debug, Clone)]
pub(super) enum Admission {
    /// Its address: these networks may write.
    ByAddress(Vec<IpNet>),
    /// The role in its certificate.
    ByCertificate(Arc<Gatekeeper>),
}

/// A listener.
pub(super) struct Door {
    /// Its section of the configuration, for messages.
    pub(super) section: String,
    pub(super) allow: Vec<IpNet>,
    pub(super) admission: Admission,
    pub(super) view: Arc<View>,
    pub(super) shared: Arc<Shared>,
    pub(super) places: Arc<Places>,
    pub(super) tasks: TaskTracker,
    pub(super) cancel: CancellationToken,
}

/// What is told again and again is told seldom.
#[derive(Default)]
struct Logs {
    refused: Seldom,
    full: Seldom,
    failed: Seldom,
}

impl Door {
    pub(super) async fn serve(self, listener: TcpListener) {
        let door = Arc::new(self);
        let mut logs = Logs::default();
        loop {
            let accepted = tokio::select! {
                () = door.cancel.cancelled() => return,
                accepted = listener.accept() => accepted,
            };
            match accepted {
                Ok((stream, peer)) => door.admit(stream, peer, &mut logs),
                // The client went away between its knock and the answer.
                Err(why) if why.kind() == io::ErrorKind::ConnectionAborted => {}
                Err(why) => {
                    if let Some(more) = logs.failed.tell(Instant::now()) {
                        tracing::warn!(more, "Modbus TCP: cannot accept a connection: {why}; trying on");
                    }
                    tokio::select! {
                        () = door.cancel.cancelled() => return,
                        () = tokio::time::sleep(ACCEPT_PAUSE) => {}
                    }
                }
            }
        }
    }

    /// Starts a task for a client that may connect; else its connection is closed at once.
    fn admit(self: &Arc<Self>, stream: TcpStream, peer: SocketAddr, logs: &mut Logs) {
        // A listener on [::] sees IPv4 clients as ::ffff:a.b.c.d.
        let peer = SocketAddr::new(peer.ip().to_canonical(), peer.port());
        let (ip, section, stats) = (peer.ip(), &self.section, &self.shared.stats.modbus_tcp);
        if !contains(&self.allow, ip) {
            stats.turned_away(Turned::NotAllowed);
            if let Some(more) = logs.refused.tell(Instant::now()) {
                tracing::warn!(client = %ip, more, "Modbus TCP: client refused: it is not in `allow` of {section}");
            }
            return;
        }
        match self.places.take(ip) {
            Ok(place) => {
                self.tasks.spawn(self.clone().receive(stream, peer, place));
            }
            Err(full) => {
                let (turned, why, key) = match full {
                    Full::All(most) => (Turned::Full, format!("{most} are connected already"), "max_connections"),
                    Full::Address(most) => (
                        Turned::AddressFull,
                        format!("{most} of its address are connected already"),
                        "max_connections_per_address",
                    ),
                };
                stats.turned_away(turned);
                if let Some(more) = logs.full.tell(Instant::now()) {
                    tracing::warn!(client = %ip, more,
                        "Modbus TCP: client refused: {why}; raise `{key}` of [modbus_tcp] or let the client close what it \
                         does not use");
                }
            }
        }
    }

    /// Serves one client to its end.
    async fn receive(self: Arc<Self>, stream: TcpStream, peer: SocketAddr, place: Place) {
        prepare(&stream);
        let cancel = self.cancel.child_token();
        match &self.admission {
            Admission::ByAddress(write) => {
                let authority = if contains(write, peer.ip()) {
                    Authority::Write
                } else {
                    Authority::ReadOnly
                };
                self.converse(stream, Client::new(peer, None, authority), cancel).await;
            }
            Admission::ByCertificate(gatekeeper) => {
                let admitted = tokio::select! {
                    () = cancel.cancelled() => return,
                    admitted = gatekeeper.admit(stream) => admitted,
                };
                match admitted {
                    Ok((stream, known)) => {
                        let authority = match known.role {
                            Role::Control => Authority::Write,
                            Role::Monitor => Authority::ReadOnly,
                        };
                        let client = Client::new(peer, Some(&known.name), authority);
                        self.converse(stream, client, cancel).await;
                    }
                    Err(why) => {
                        self.shared.stats.modbus_tcp.turned_away(Turned::Tls);
                        if let Some(more) = self.shared.tell_tls(Instant::now()) {
                            tracing::warn!(client = %peer, more, "Modbus TCP: client refused: TLS: {why}");
                        }
                    }
                }
            }
        }
        drop(place);
    }

    async fn converse<S>(&self, stream: S, client: Client, cancel: CancellationToken)
    where
        S: tokio::io::AsyncRead + tokio::io::AsyncWrite + Unpin,
    {
        let session = Session::new(self.shared.clone(), self.view.clone(), client);
        connection::serve(stream, session, self.shared.options.idle_timeout, cancel).await;
    }
}

fn contains(networks: &[IpNet], ip: IpAddr) -> bool {
    networks.iter().any(|n| n.contains(&ip))
}

/// Answers leave at once; a peer that vanished is noticed. Neither is worth refusing a client for.
fn prepare(stream: &TcpStream) {
    use rustix::net::sockopt;
    let told = |what: &str, why: &dyn std::fmt::Display| tracing::debug!("Modbus TCP: cannot set {what}: {why}");
    if let Err(why) = stream.set_nodelay(true) {
        told("TCP_NODELAY", &why);
    }
    let keepalive = sockopt::set_socket_keepalive(stream, true)
        .and_then(|()| sockopt::set_tcp_keepidle(stream, KEEPALIVE_IDLE))
        .and_then(|()| sockopt::set_tcp_keepintvl(stream, KEEPALIVE_INTERVAL))
        .and_then(|()| sockopt::set_tcp_keepcnt(stream, KEEPALIVE_PROBES));
    if let Err(why) = keepalive {
        told("TCP keepalive", &why);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_vanished_client_is_found_out() {
        use rustix::net::sockopt;
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let client = TcpStream::connect(listener.local_addr().unwrap()).await.unwrap();
        let (accepted, _) = listener.accept().await.unwrap();
        assert!(!sockopt::socket_keepalive(&accepted).unwrap(), "nobody sets it unasked");
        prepare(&accepted);
        assert!(accepted.nodelay().unwrap());
        assert!(sockopt::socket_keepalive(&accepted).unwrap());
        assert_eq!(sockopt::tcp_keepidle(&accepted).unwrap(), Duration::from_secs(60));
        assert_eq!(sockopt::tcp_keepintvl(&accepted).unwrap(), Duration::from_secs(10));
        assert_eq!(sockopt::tcp_keepcnt(&accepted).unwrap(), 3);
        drop(client);
    }

    #[test]
    fn networks() {
        let networks = ["127.0.0.0/8".parse().unwrap(), "fd00::/8".parse().unwrap()];
        for (ip, inside) in [
            ("127.9.9.9", true),
            ("10.0.0.1", false),
            ("fd12::1", true),
            ("::1", false),
        ] {
            assert_eq!(contains(&networks, ip.parse().unwrap()), inside, "{ip}");
        }
        let mapped: IpAddr = "::ffff:127.0.0.1".parse().unwrap();
        assert!(contains(&networks, mapped.to_canonical()));
    }
}
