//! Modbus/TCP Security: certificates of the server, the CA of its clients, and the rights that a role grants.

use std::collections::BTreeMap;
use std::io;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use ipnet::IpNet;
use rustls::ServerConfig;
use rustls::server::NoServerSessionStorage;
use rustls::server::danger::ClientCertVerifier;
use rustls_pki_types::CertificateDer;
use tokio::net::TcpStream;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;

use super::open_clients::{CertificateGuard, OpenClients};
use crate::reading::Dated;
use crate::tls::certificate::{self, RoleError};
use crate::tls::{self, ClientTrust, Peer, ServerIdentity, TlsFault};

/// Time limit of a handshake.
const HANDSHAKE: Duration = Duration::from_secs(10);

/// The TLS listener.
#[derive(Debug, Clone, PartialEq)]
pub struct Tls {
    /// Addresses on which the TLS listener listens.
    pub listen: Vec<SocketAddr>,
    /// Networks whose clients may connect.
    pub allow: Vec<IpNet>,
    /// Names of the visible buses; `None` for all.
    pub buses: Option<Vec<String>>,
    /// Certificate and key of the server, and the CA of its clients.
    pub identity: Identity,
    /// The rights of the roles in client certificates.
    pub roles: BTreeMap<String, Role>,
}

impl Tls {
    /// Whether both options require the same of a client's certificate, present the same server certificate and
    /// grant the same rights.
    pub(super) fn admits_like(&self, other: &Tls) -> bool {
        (&self.identity, &self.roles) == (&other.identity, &other.roles)
    }
}

/// The rights that a role grants.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// The role may read.
    Monitor,
    /// The role may read and write.
    Control,
}

/// Certificates, key and revocations with the content of their files; equal while the content is.
#[derive(Debug, Clone, PartialEq)]
pub struct Identity {
    server: ServerIdentity,
    clients: ClientTrust,
}

impl Identity {
    /// Reads the certificate files and checks at `now` that they can be used together; also returns warnings.
    ///
    /// # Errors
    /// If the files cannot be used; contains all faults.
    pub fn load(
        certificate: &Path,
        key: &Path,
        client_ca: &Path,
        client_crl: Option<&Path>,
        now: SystemTime,
    ) -> Result<(Identity, Vec<TlsFault>), Vec<TlsFault>> {
        let server = ServerIdentity::load(certificate, key, now);
        match (server, ClientTrust::load(client_ca, client_crl, now)) {
            (Ok((server, mut warnings)), Ok((clients, of_clients))) => {
                warnings.extend(of_clients);
                Ok((Identity { server, clients }, warnings))
            }
            (server, clients) => Err([server.err(), clients.err()].into_iter().flatten().flatten().collect()),
        }
    }

    /// The configuration for rustls. Sessions are not resumed: each connection presents its certificate, so no
    /// session can outlive it.
    fn server_config(&self, verifier: Arc<dyn ClientCertVerifier>) -> Result<Arc<ServerConfig>, TlsFault> {
        let mut config = self.server.server_config(Some(verifier))?;
        config.session_storage = Arc::new(NoServerSessionStorage {});
        config.send_tls13_tickets = 0;
        Ok(Arc::new(config))
    }
}

/// The requirements for client certificates.
#[derive(Debug)]
pub struct Requirements {
    config: Arc<ServerConfig>,
    verifier: Arc<dyn ClientCertVerifier>,
    roles: BTreeMap<String, Role>,
}

impl Requirements {
    /// The requirements of the configuration.
    ///
    /// # Errors
    /// If the certificates cannot be used.
    pub(super) fn new(tls: &Tls) -> Result<Requirements, TlsFault> {
        let verifier = tls.identity.clients.verifier()?;
        Ok(Requirements {
            config: tls.identity.server_config(verifier.clone())?,
            verifier,
            roles: tls.roles.clone(),
        })
    }

    /// Whether a client's certificates, its own first, are accepted at `now`.
    ///
    /// # Errors
    /// If the certificates are not accepted; contains the reason.
    pub(super) fn check(&self, chain: &[CertificateDer<'_>], now: SystemTime) -> Result<(), rustls::Error> {
        let Some((own, intermediates)) = chain.split_first() else {
            return Err(rustls::Error::NoCertificatesPresented);
        };
        let since_1970 = now.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
        let now = rustls_pki_types::UnixTime::since_unix_epoch(since_1970);
        self.verifier.verify_client_cert(own, intermediates, now).map(|_| ())
    }

    /// Without a role, or with one that is not configured, a client may read.
    pub(super) fn role(&self, name: Option<&str>) -> Role {
        name.and_then(|name| self.roles.get(name))
            .copied()
            .unwrap_or(Role::Monitor)
    }
}

/// Authenticates the clients of a listener. Certificates, revocations and roles can be renewed while the listener serves.
#[derive(Debug)]
pub(super) struct TlsAuthenticator {
    clients: Arc<OpenClients>,
}

/// A client whose certificate was verified.
#[derive(Debug)]
pub(super) struct AuthenticatedClient {
    pub(super) name: String,
    pub(super) role: Role,
    /// Counts the client as connected until it is dropped.
    pub(super) certificate: CertificateGuard,
}

/// Why a client is refused.
#[derive(Debug, thiserror::Error)]
pub(super) enum AuthenticationError {
    #[error("the handshake took longer than {HANDSHAKE:?}")]
    Timeout,
    #[error("{}", tls::in_words(.0, Peer::Client))]
    Handshake(#[from] io::Error),
    #[error(transparent)]
    Role(#[from] RoleError),
    #[error("a reload during the handshake: {}", tls::in_words(.0, Peer::Client))]
    Renewed(#[from] rustls::Error),
}

impl TlsAuthenticator {
    pub(super) fn new(requirements: Requirements) -> TlsAuthenticator {
        TlsAuthenticator {
            clients: OpenClients::new(requirements),
        }
    }

    /// Uses other certificates, revocations and roles. Clients that they do not admit, or admit with other rights, are
    /// disconnected.
    pub(super) fn renew(&self, requirements: Requirements) {
        self.clients.renew(requirements, SystemTime::now());
    }

    /// Performs the handshake and reads the role of the client at `peer`.
    ///
    /// # Errors
    /// If the client is refused; contains the reason.
    pub(super) async fn authenticate(
        &self,
        stream: Dated<TcpStream>,
        peer: SocketAddr,
    ) -> Result<(TlsStream<Dated<TcpStream>>, AuthenticatedClient), AuthenticationError> {
        let requirements = self.clients.requirements();
        let handshake = TlsAcceptor::from(requirements.config.clone()).accept(stream);
        let stream = tokio::time::timeout(HANDSHAKE, handshake)
            .await
            .map_err(|_| AuthenticationError::Timeout)??;
        let chain: Vec<CertificateDer<'static>> = match stream.get_ref().1.peer_certificates() {
            Some(chain) => chain.iter().map(|der| der.clone().into_owned()).collect(),
            None => Vec::new(),
        };
        let (name, role) = match chain.first().map(|der| certificate::read(der)) {
            Some(Ok(certificate)) => (certificate.name, certificate.role?),
            // The verifier refuses clients without a certificate; a certificate that only rustls can read grants no
            // role.
            Some(Err(_)) | None => ("unreadable certificate".to_string(), None),
        };
        let (certificate, role) = self
            .clients
            .admit(&requirements, chain, role, format!("{name} at {peer}"))?;
        let client = AuthenticatedClient {
            name,
            role,
            certificate,
        };
        Ok((stream, client))
    }
}
