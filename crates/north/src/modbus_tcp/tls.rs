//! Modbus/TCP Security: certificates of the server, the CA of its clients, and the rights that a role grants.

use std::collections::BTreeMap;
use std::io;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use ipnet::IpNet;
use rustls::server::danger::ClientCertVerifier;
use rustls::server::{NoServerSessionStorage, VerifierBuilderError, WebPkiClientVerifier};
use rustls::{RootCertStore, ServerConfig};
use rustls_pki_types::CertificateDer;
use tokio::net::TcpStream;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;

use super::crl::{self, Crls};
use super::open_clients::{CertificateGuard, OpenClients};
use crate::certificate::{self, RoleError};
use crate::identity::{FileProblem, IdentityFault, ServerIdentity, TlsFile, provider, unsupported_ca, validity};
use crate::pem;
use crate::reading::Dated;
use crate::tls_words::{self, Peer};

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
    client_ca: Vec<CertificateDer<'static>>,
    client_crl: Crls,
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
    ) -> Result<(Identity, Vec<IdentityFault>), Vec<IdentityFault>> {
        let (mut errors, mut warnings) = (Vec::new(), Vec::new());
        let server = ServerIdentity::load(certificate, key, now).map_err(|faults| errors.extend(faults));
        let ca = pem::certificates(client_ca).map_err(|error| errors.push(TlsFile::ClientCa.fault(error)));
        // An expired CA is still a valid trust anchor (RFC 5280, 6.1.1), so no client is refused for it.
        let anchors = ca.iter().flatten().flat_map(|anchor| {
            let unsupported = unsupported_ca(client_ca, anchor);
            validity(client_ca, anchor, now).into_iter().chain(unsupported)
        });
        warnings.extend(anchors.map(|problem| TlsFile::ClientCa.fault(problem)));
        let lists = client_crl.map(|file| crl::load(file, ca.as_deref().unwrap_or_default(), now));
        let lists = lists
            .transpose()
            .map_err(|problem| errors.push(TlsFile::ClientCrl.fault(problem)));
        if let (Ok((server, expiry)), Ok(client_ca), Ok(lists)) = (server, ca, lists) {
            let (client_crl, doubts) = lists.unwrap_or_default();
            warnings.extend(expiry);
            warnings.extend(doubts.into_iter().map(|problem| TlsFile::ClientCrl.fault(problem)));
            let identity = Identity {
                server,
                client_ca,
                client_crl,
            };
            match identity.verifier() {
                Ok(_) => return Ok((identity, warnings)),
                Err(fault) => errors.push(fault),
            }
        }
        Err(errors)
    }

    /// The verifier for certificates of clients. If there are revocation lists, each CA in the chain of a client
    /// must have one; an outdated list remains in force.
    fn verifier(&self) -> Result<Arc<dyn ClientCertVerifier>, IdentityFault> {
        let unusable_ca = |why: &str| TlsFile::ClientCa.fault(FileProblem::UnusableCa(why.to_string()));
        let mut roots = RootCertStore::empty();
        for anchor in &self.client_ca {
            let added = roots.add(anchor.clone());
            added.map_err(|_| unusable_ca("it is not valid X.509"))?;
        }
        WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider())
            .with_crls(self.client_crl.clone())
            .build()
            .map_err(|error| match error {
                VerifierBuilderError::InvalidCrl(error) => TlsFile::ClientCrl.fault(FileProblem::UnsupportedCrl(error)),
                error => unusable_ca(&error.to_string()),
            })
    }

    /// The configuration for rustls. Sessions are not resumed: each connection presents its certificate, so no
    /// session can outlive it.
    fn server_config(&self, verifier: Arc<dyn ClientCertVerifier>) -> Result<Arc<ServerConfig>, IdentityFault> {
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
    pub(super) fn new(tls: &Tls) -> Result<Requirements, IdentityFault> {
        let verifier = tls.identity.verifier()?;
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
    #[error("{}", in_words(.0))]
    Handshake(#[from] io::Error),
    #[error(transparent)]
    Role(#[from] RoleError),
    #[error("a reload during the handshake: {}", in_words(.0))]
    Renewed(#[from] rustls::Error),
}

fn in_words(error: &(dyn std::error::Error + 'static)) -> String {
    tls_words::explain(error, Peer::Client).unwrap_or_else(|| error.to_string())
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
