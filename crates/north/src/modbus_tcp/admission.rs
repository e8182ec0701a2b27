//! Decides which clients may connect to a listener, and their rights.

use std::net::{IpAddr, SocketAddr};
use std::pin::pin;
use std::sync::Arc;
use std::time::{Duration, Instant};

use arc_swap::ArcSwap;
use futures_util::future::{Either, select};
use ipnet::IpNet;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio_rustls::server::TlsStream;
use tokio_util::sync::CancellationToken;

use super::client::Client;
use super::frame::NotModbus;
use super::routes::{PlantView, View};
use super::session::ClientSession;
use super::tls::{AuthenticatedClient, Role, TlsAuthenticator};
use super::{Listener, ServerState, connection};
use crate::ConnectionRefusal;
use crate::connection_limit::{
    CloseReason, ConnectionLimit, ConnectionPermit, ConnectionPlace, LimitReached, Newcomer,
};
use crate::listener::ConnectionHandler;
use crate::reading::{Dated, Reader};
use drivegate_core::order::Authority;

/// A peer that disappeared without closing is detected after 60 s + 3 * 10 s.
const KEEPALIVE_IDLE: Duration = Duration::from_secs(60);
const KEEPALIVE_INTERVAL: Duration = Duration::from_secs(10);
const KEEPALIVE_PROBES: u32 = 3;

/// How the rights of a client are determined.
#[derive(Debug, Clone)]
pub(super) enum WriteAccess {
    /// Clients may write by their address: from these networks.
    ByAddress(Vec<IpNet>),
    /// Clients may write by the role in their certificate.
    ByCertificate(Arc<TlsAuthenticator>),
}

/// The clients that may connect to a listener, and their rights. A reload replaces this policy.
#[derive(Debug, Clone)]
pub(super) struct Policy {
    pub(super) allow: Vec<IpNet>,
    pub(super) write: WriteAccess,
}

impl Policy {
    /// A policy that admits no client.
    pub(super) fn nobody() -> (Policy, View) {
        let write = WriteAccess::ByAddress(Vec::new());
        (
            Policy {
                allow: Vec::new(),
                write,
            },
            View::default(),
        )
    }

    /// The rights of a client at this address without a certificate; `None` if it may not connect.
    fn by_address(&self, address: IpAddr) -> Option<Authority> {
        contains(&self.allow, address).then(|| match &self.write {
            WriteAccess::ByAddress(write) if contains(write, address) => Authority::Write,
            _ => Authority::ReadOnly,
        })
    }

    /// The rights of a TLS client whose role grants `authority`; `None` if it may not connect. The authenticator
    /// checks its certificate and role.
    fn by_certificate(&self, address: IpAddr, authority: Authority) -> Option<Authority> {
        contains(&self.allow, address).then_some(authority)
    }
}

/// Admits the clients of one listener.
#[derive(Debug)]
pub struct Admission {
    /// Number of the listener, unique in the server.
    listener: usize,
    policy: ArcSwap<Policy>,
    view: Arc<PlantView>,
    state: Arc<ServerState>,
    /// Token that ends all connections of the listener.
    cancel: CancellationToken,
}

impl ConnectionHandler for Admission {
    /// With TLS, these places only count handshakes.
    type Permit = ConnectionPermit;

    fn admit(&self, client: IpAddr) -> Option<ConnectionPermit> {
        let policy = self.policy.load();
        let judge = || self.policy.load().by_address(client);
        match policy.write {
            WriteAccess::ByAddress(_) => self.acquire(&self.state.connections, client, remedy, judge),
            WriteAccess::ByCertificate(_) => self.acquire(&self.state.handshakes, client, handshake_remedy, judge),
        }
    }

    fn retire(&self) {
        let options = self.state.options.load();
        let write = &self.policy.load().write;
        self.state
            .connections
            .review(self.listener, |place| match (write, &options.tls) {
                (WriteAccess::ByAddress(_), _) => authority_of(&options.listeners, place.address()),
                (WriteAccess::ByCertificate(_), Some(tls)) => {
                    contains(&tls.allow, place.address()).then(|| place.rights().authority())
                }
                (WriteAccess::ByCertificate(_), None) => None,
            });
    }

    async fn serve(self: Arc<Self>, stream: Dated<TcpStream>, peer: SocketAddr, permit: ConnectionPermit) {
        set_socket_options(stream.stream());
        let reader = stream.reader().clone();
        let write = self.policy.load().write.clone();
        match write {
            WriteAccess::ByAddress(_) => self.serve_client((stream, reader), peer, None, &permit).await,
            WriteAccess::ByCertificate(authenticator) => {
                self.serve_tls_client(&authenticator, (stream, reader), peer, permit)
                    .await;
            }
        }
    }
}

impl Admission {
    /// `listener` is unique in the server; the connections end with `cancel`.
    pub(super) fn new(
        listener: usize,
        policy: Policy,
        view: PlantView,
        state: Arc<ServerState>,
        cancel: CancellationToken,
    ) -> Admission {
        Admission {
            listener,
            policy: ArcSwap::from_pointee(policy),
            view: Arc::new(view),
            state,
            cancel,
        }
    }

    /// Applies a new policy, also to open connections: they get its rights, or are closed.
    pub(super) fn update(&self, policy: Policy, view: View) {
        self.view.show(view, Instant::now());
        self.policy.store(Arc::new(policy.clone()));
        self.state
            .connections
            .review(self.listener, |place: &ConnectionPlace| match &policy.write {
                WriteAccess::ByAddress(_) => policy.by_address(place.address()),
                WriteAccess::ByCertificate(_) => policy.by_certificate(place.address(), place.rights().authority()),
            });
    }

    /// Serves a client with TLS until its connection ends or its certificate is no longer accepted.
    async fn serve_tls_client(
        &self,
        authenticator: &TlsAuthenticator,
        (stream, reader): (Dated<TcpStream>, Arc<Reader>),
        peer: SocketAddr,
        handshake: ConnectionPermit,
    ) {
        let closing = handshake.place().closing();
        match closing
            .run_until_cancelled(authenticator.authenticate(stream, peer))
            .await
        {
            // The connection was displaced, or its listener closed.
            None => {}
            Some(Ok((stream, client))) => {
                let admitted = self.admit_authenticated(peer, &client);
                drop(handshake);
                self.serve_authenticated((stream, reader), peer, client, admitted).await;
            }
            Some(Err(error)) => {
                let text = format!("client refused: TLS: {error}");
                self.state.refusals.report(ConnectionRefusal::Tls, peer.ip(), &text);
            }
        }
    }

    /// A place among the connections for a client whose handshake is complete.
    fn admit_authenticated(&self, peer: SocketAddr, client: &AuthenticatedClient) -> Option<ConnectionPermit> {
        let authority = match client.role {
            Role::Control => Authority::Write,
            Role::Monitor => Authority::ReadOnly,
        };
        // A reload during the handshake may have changed who is let in.
        let judge = || self.policy.load().by_certificate(peer.ip(), authority);
        self.acquire(&self.state.connections, peer.ip(), remedy, judge)
    }

    /// Serves a client with TLS; without a place, its connection is closed.
    async fn serve_authenticated(
        &self,
        (mut stream, reader): (TlsStream<Dated<TcpStream>>, Arc<Reader>),
        peer: SocketAddr,
        client: AuthenticatedClient,
        admitted: Option<ConnectionPermit>,
    ) {
        let Some(permit) = admitted else {
            connection::close(&mut stream).await;
            return;
        };
        client.certificate.watch(permit.place().rights());
        let refused = pin!(client.certificate.refused());
        let served = pin!(self.serve_client((stream, reader), peer, Some(&client.name), &permit));
        if let Either::Left(((), served)) = select(refused, served).await {
            // Commands that are in progress are answered.
            permit.place().close(CloseReason::CertificateRefused);
            served.await;
        }
    }

    async fn serve_client(
        &self,
        stream: (impl AsyncRead + AsyncWrite + Unpin, Arc<Reader>),
        peer: SocketAddr,
        name: Option<&str>,
        permit: &ConnectionPermit,
    ) {
        let client = Client::new(peer, name, permit.place().rights().clone());
        let session = ClientSession::new(self.state.clone(), self.view.clone(), client);
        let idle_timeout = self.state.options.load().idle_timeout;
        let spoken = connection::serve(stream, session, idle_timeout, permit.place(), &self.state.stopping).await;
        if let Some(spoken @ NotModbus::Serial(_)) = spoken
            && let Some(suppressed) = self.state.serial_clients.permit(Instant::now())
        {
            tracing::warn!(target: "drivegate::north::modbus_tcp", client = %peer.ip(), suppressed, "Modbus TCP: connection closed: {spoken}");
        }
    }

    fn acquire(
        &self,
        limit: &Arc<ConnectionLimit>,
        address: IpAddr,
        remedy: fn(LimitReached) -> String,
        judge: impl FnOnce() -> Option<Authority>,
    ) -> Option<ConnectionPermit> {
        let newcomer = Newcomer {
            address,
            listener: self.listener,
            cancel: &self.cancel,
        };
        self.state.refusals.acquire(limit, newcomer, remedy, judge)
    }
}

fn remedy(reached: LimitReached) -> String {
    let key = match reached {
        LimitReached::Total(_) => "max_connections",
        LimitReached::Address(_) => "max_connections_per_address",
    };
    format!("raise `{key}` of [modbus_tcp] or close unused connections")
}

fn handshake_remedy(_: LimitReached) -> String {
    "their TLS handshakes are not complete; they have 10 s for them".to_string()
}

/// The highest authority that any of the listeners grants this address; `None` if it may not connect to any.
fn authority_of(listeners: &[Listener], address: IpAddr) -> Option<Authority> {
    let mut of = listeners.iter().filter(|listener| contains(&listener.allow, address));
    let first = of.next()?;
    let writes = |listener: &Listener| contains(&listener.write, address);
    Some(if writes(first) || of.any(writes) {
        Authority::Write
    } else {
        Authority::ReadOnly
    })
}

fn contains(networks: &[IpNet], address: IpAddr) -> bool {
    networks.iter().any(|network| network.contains(&address))
}

/// Sends answers without delay and detects peers that disappeared. A client is served even if the system refuses
/// either.
fn set_socket_options(stream: &TcpStream) {
    use rustix::net::sockopt;
    let failed = |what: &str, error: &dyn std::fmt::Display| tracing::debug!(target: "drivegate::north::modbus_tcp", "Modbus TCP: cannot set {what}: {error}");
    if let Err(error) = stream.set_nodelay(true) {
        failed("TCP_NODELAY", &error);
    }
    let keepalive = sockopt::set_socket_keepalive(stream, true)
        .and_then(|()| sockopt::set_tcp_keepidle(stream, KEEPALIVE_IDLE))
        .and_then(|()| sockopt::set_tcp_keepintvl(stream, KEEPALIVE_INTERVAL))
        .and_then(|()| sockopt::set_tcp_keepcnt(stream, KEEPALIVE_PROBES));
    if let Err(error) = keepalive {
        failed("TCP keepalive", &error);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::net::TcpListener;

    #[tokio::test]
    async fn disappeared_clients_are_detected() {
        use rustix::net::sockopt;
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let client = TcpStream::connect(listener.local_addr().unwrap()).await.unwrap();
        let (accepted, _) = listener.accept().await.unwrap();
        assert!(!sockopt::socket_keepalive(&accepted).unwrap(), "off by default");
        set_socket_options(&accepted);
        assert!(accepted.nodelay().unwrap());
        assert!(sockopt::socket_keepalive(&accepted).unwrap());
        assert_eq!(sockopt::tcp_keepidle(&accepted).unwrap(), Duration::from_secs(60));
        assert_eq!(sockopt::tcp_keepintvl(&accepted).unwrap(), Duration::from_secs(10));
        assert_eq!(sockopt::tcp_keepcnt(&accepted).unwrap(), 3);
        drop(client);
    }

    #[test]
    fn who_loses_its_listener_keeps_what_another_one_allows() {
        let listener = |allow: &[&str], write: &[&str]| {
            let networks = |all: &[&str]| all.iter().map(|text| text.parse().unwrap()).collect();
            Listener {
                section: String::new(),
                listen: Vec::new(),
                allow: networks(allow),
                write: networks(write),
                view: View::default(),
            }
        };
        let address = "10.0.0.5".parse().unwrap();
        let (all, own, other) = (&["10.0.0.0/8"][..], &["10.0.0.5/32"][..], &["10.0.0.6/32"][..]);
        let table = [
            (vec![], None),
            (vec![listener(other, own)], None),
            (vec![listener(all, other)], Some(Authority::ReadOnly)),
            (vec![listener(all, own)], Some(Authority::Write)),
            (vec![listener(all, other), listener(all, own)], Some(Authority::Write)),
            (
                vec![listener(all, other), listener(other, own)],
                Some(Authority::ReadOnly),
            ),
        ];
        for (listeners, expected) in table {
            assert_eq!(authority_of(&listeners, address), expected, "{listeners:?}");
        }
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
