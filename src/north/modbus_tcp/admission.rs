//! Who may connect to a listener, and with which rights.

use std::net::{IpAddr, SocketAddr};
use std::pin::pin;
use std::sync::Arc;
use std::time::{Duration, Instant};

use futures_util::future::{Either, select};
use ipnet::IpNet;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio_util::sync::CancellationToken;

use super::client::Client;
use super::routes::PlantView;
use super::session::ClientSession;
use super::tls::{Role, TlsAuthenticator};
use super::{ServerState, connection};
use crate::command::Authority;
use crate::north::ConnectionRefusal;
use crate::north::connection_limit::{ConnectionPermit, LimitReached};
use crate::north::listener::ConnectionHandler;
use crate::north::log_throttle::LogThrottle;

/// A peer that disappeared without closing is detected after 60 s + 3 * 10 s.
const KEEPALIVE_IDLE: Duration = Duration::from_secs(60);
const KEEPALIVE_INTERVAL: Duration = Duration::from_secs(10);
const KEEPALIVE_PROBES: u32 = 3;

/// What the rights of a client depend on.
#[derive(Debug, Clone)]
pub(super) enum WriteAccess {
    /// Its address: these networks may write.
    ByAddress(Vec<IpNet>),
    /// The role in its certificate.
    ByCertificate(Arc<TlsAuthenticator>),
}

/// Admits clients to the sockets of one section of the configuration.
pub(super) struct Admission {
    /// For messages: `[modbus_tcp]`.
    pub(super) section: String,
    pub(super) allow: Vec<IpNet>,
    pub(super) write: WriteAccess,
    pub(super) view: Arc<PlantView>,
    pub(super) state: Arc<ServerState>,
    pub(super) cancel: CancellationToken,
    pub(super) logs: RefusalLogs,
}

/// Refusals repeat, so each kind is throttled.
#[derive(Debug, Default)]
pub(super) struct RefusalLogs {
    not_allowed: LogThrottle,
    limit: LogThrottle,
    tls: LogThrottle,
}

impl ConnectionHandler for Admission {
    fn admits(&self, address: IpAddr) -> bool {
        let admitted = contains(&self.allow, address);
        if !admitted {
            self.state
                .stats
                .modbus_tcp
                .connection_refused(ConnectionRefusal::NotAllowed);
            if let Some(suppressed) = self.logs.not_allowed.permit(Instant::now()) {
                let section = &self.section;
                tracing::warn!(client = %address, suppressed,
                    "Modbus TCP: client refused: its address is not in `allow` of {section}");
            }
        }
        admitted
    }

    fn refuse(&self, _: &TcpStream, peer: SocketAddr, reached: LimitReached) {
        let (refusal, why, key) = match reached {
            LimitReached::Total(limit) => (
                ConnectionRefusal::Full,
                format!("{limit} connections are open"),
                "max_connections",
            ),
            LimitReached::Address(limit) => (
                ConnectionRefusal::AddressFull,
                format!("{limit} connections are open from its address"),
                "max_connections_per_address",
            ),
        };
        self.state.stats.modbus_tcp.connection_refused(refusal);
        if let Some(suppressed) = self.logs.limit.permit(Instant::now()) {
            tracing::warn!(client = %peer.ip(), suppressed,
                "Modbus TCP: client refused: {why}; raise `{key}` of [modbus_tcp] or close unused connections");
        }
    }

    async fn serve(self: Arc<Self>, stream: TcpStream, peer: SocketAddr, permit: ConnectionPermit) {
        set_socket_options(&stream);
        match &self.write {
            WriteAccess::ByAddress(write) => {
                let authority = if contains(write, peer.ip()) {
                    Authority::Write
                } else {
                    Authority::ReadOnly
                };
                let end = self.cancel.child_token();
                self.serve_client(stream, Client::new(peer, None, authority), end).await;
            }
            WriteAccess::ByCertificate(authenticator) => self.serve_tls_client(authenticator, stream, peer).await,
        }
        drop(permit);
    }
}

impl Admission {
    /// Serves a client until its connection ends or its certificate is no longer accepted.
    async fn serve_tls_client(&self, authenticator: &TlsAuthenticator, stream: TcpStream, peer: SocketAddr) {
        let identified = authenticator.authenticate(stream, peer);
        match self.cancel.run_until_cancelled(identified).await {
            None => {}
            Some(Ok((stream, identified))) => {
                let authority = match identified.role {
                    Role::Control => Authority::Write,
                    Role::Monitor => Authority::ReadOnly,
                };
                let client = Client::new(peer, Some(&identified.name), authority);
                let end = self.cancel.child_token();
                let served = pin!(self.serve_client(stream, client, end.clone()));
                let refused = pin!(identified.certificate.refused());
                if let Either::Right(((), served)) = select(served, refused).await {
                    // Commands that are under way are answered.
                    end.cancel();
                    served.await;
                }
            }
            Some(Err(error)) => {
                self.state.stats.modbus_tcp.connection_refused(ConnectionRefusal::Tls);
                if let Some(suppressed) = self.logs.tls.permit(Instant::now()) {
                    tracing::warn!(client = %peer, suppressed, "Modbus TCP: client refused: TLS: {error}");
                }
            }
        }
    }

    async fn serve_client(&self, stream: impl AsyncRead + AsyncWrite + Unpin, client: Client, end: CancellationToken) {
        let session = ClientSession::new(self.state.clone(), self.view.clone(), client);
        connection::serve(stream, session, self.state.options.idle_timeout, end).await;
    }
}

fn contains(networks: &[IpNet], address: IpAddr) -> bool {
    networks.iter().any(|network| network.contains(&address))
}

/// Sends answers without delay and detects peers that disappeared. A client is served even if the system refuses
/// either.
fn set_socket_options(stream: &TcpStream) {
    use rustix::net::sockopt;
    let failed = |what: &str, error: &dyn std::fmt::Display| tracing::debug!("Modbus TCP: cannot set {what}: {error}");
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
