//! Modbus/TCP Security: certificates of the server, the CA of its clients, and the rights that a role grants.

use std::collections::BTreeMap;
use std::io;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use arc_swap::ArcSwap;
use ipnet::IpNet;
use rustls::server::{NoServerSessionStorage, WebPkiClientVerifier};
use rustls::{RootCertStore, ServerConfig};
use rustls_pki_types::{CertificateDer, PrivateKeyDer};
use tokio::net::TcpStream;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;

use super::certificate::{self, RoleError};
use crate::north::pem::{self, PemError};

/// Time limit of a handshake.
const HANDSHAKE: Duration = Duration::from_secs(10);
/// How long before its expiry a certificate causes a warning.
const SOON: Duration = Duration::from_secs(30 * 86_400);

/// The TLS listener.
#[derive(Debug, Clone, PartialEq)]
pub struct Tls {
    /// Addresses to listen on.
    pub listen: Vec<SocketAddr>,
    /// Networks that may connect.
    pub allow: Vec<IpNet>,
    /// Names of the visible buses; `None` for all.
    pub buses: Option<Vec<String>>,
    /// Certificate and key of the server, and the CA of its clients.
    pub identity: Identity,
    /// The rights of the roles in client certificates.
    pub roles: BTreeMap<String, Role>,
}

/// The rights of a client.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// Read.
    Monitor,
    /// Read and write.
    Control,
}

/// Certificates and key with the content of their files; equal while the content is.
#[derive(Debug, Clone, PartialEq)]
pub struct Identity {
    chain: Vec<CertificateDer<'static>>,
    key: Arc<PrivateKeyDer<'static>>,
    client_ca: Vec<CertificateDer<'static>>,
}

/// A file of an [`Identity`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TlsFile {
    /// The certificate of the server, followed by intermediate certificates.
    Certificate,
    /// Its private key.
    Key,
    /// The CA certificates that client certificates are verified against.
    ClientCa,
}

/// A fault of one of the files, or a warning about it: what is wrong and what to do.
#[derive(Debug, thiserror::Error)]
#[error("{problem}")]
pub struct IdentityFault {
    /// The file.
    pub file: TlsFile,
    problem: IdentityProblem,
}

#[derive(Debug, thiserror::Error)]
enum IdentityProblem {
    #[error(transparent)]
    Pem(#[from] PemError),
    #[error("{0} contains data that is not a certificate; specify a PEM file")]
    NotACertificate(String),
    #[error("certificate `{name}` in {file} expired on {end}; renew it")]
    Expired { name: String, file: String, end: String },
    #[error("certificate `{name}` in {file} is not valid before {begin}; check the clock of this machine")]
    NotYetValid { name: String, file: String, begin: String },
    /// A warning: within 30 days.
    #[error("certificate `{name}` in {file} expires on {end}; renew it")]
    ExpiresSoon { name: String, file: String, end: String },
    #[error("not a usable CA certificate: {0}; specify the PEM file of the CA")]
    UnusableCa(String),
    #[error("the key does not match the certificate; specify the key of the certificate")]
    KeyMismatch,
    #[error("certificate and key cannot be used: {0}; specify a certificate and its key in PEM format")]
    Unusable(rustls::Error),
}

impl TlsFile {
    fn fault(self, problem: impl Into<IdentityProblem>) -> IdentityFault {
        IdentityFault {
            file: self,
            problem: problem.into(),
        }
    }
}

impl Identity {
    /// Reads the three files and checks at `now` that they can be used together; returns warnings with it.
    ///
    /// # Errors
    /// All faults of the files.
    pub fn load(
        certificate: &Path,
        key: &Path,
        client_ca: &Path,
        now: SystemTime,
    ) -> Result<(Identity, Vec<IdentityFault>), Vec<IdentityFault>> {
        let (mut errors, mut warnings) = (Vec::new(), Vec::new());
        let chain = read_chain(certificate, now).map_err(|problem| errors.push(TlsFile::Certificate.fault(problem)));
        let key = pem::private_key(key).map_err(|error| errors.push(TlsFile::Key.fault(error)));
        let ca = pem::certificates(client_ca).map_err(|error| errors.push(TlsFile::ClientCa.fault(error)));
        // An expired CA is still a trust anchor (RFC 5280, 6.1.1), so it refuses nobody.
        for anchor in ca.iter().flatten() {
            let problem = check_validity(client_ca, anchor, now).unwrap_or_else(Some);
            warnings.extend(problem.map(|problem| TlsFile::ClientCa.fault(problem)));
        }
        if let (Ok((chain, warning)), Ok(key), Ok(client_ca)) = (chain, key, ca) {
            warnings.extend(warning.map(|problem| TlsFile::Certificate.fault(problem)));
            let identity = Identity {
                chain,
                key: Arc::new(key),
                client_ca,
            };
            match identity.server_config() {
                Ok(_) => return Ok((identity, warnings)),
                Err(fault) => errors.push(fault),
            }
        }
        Err(errors)
    }

    /// The configuration for rustls. Sessions are not resumed: each connection presents its certificate, and a session
    /// cannot outlive it.
    fn server_config(&self) -> Result<Arc<ServerConfig>, IdentityFault> {
        let unusable_ca =
            |error: &dyn std::fmt::Display| TlsFile::ClientCa.fault(IdentityProblem::UnusableCa(error.to_string()));
        let mut roots = RootCertStore::empty();
        for anchor in &self.client_ca {
            roots.add(anchor.clone()).map_err(|error| unusable_ca(&error))?;
        }
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let verifier = WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider.clone())
            .build()
            .map_err(|error| unusable_ca(&error))?;
        let unusable = |error: rustls::Error| match error {
            rustls::Error::InconsistentKeys(_) => TlsFile::Key.fault(IdentityProblem::KeyMismatch),
            error => TlsFile::Certificate.fault(IdentityProblem::Unusable(error)),
        };
        let mut config = ServerConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()
            .map_err(unusable)?
            .with_client_cert_verifier(verifier)
            .with_single_cert(self.chain.clone(), self.key.clone_key())
            .map_err(unusable)?;
        config.session_storage = Arc::new(NoServerSessionStorage {});
        config.send_tls13_tickets = 0;
        Ok(Arc::new(config))
    }
}

/// The certificates of the server, its own first, with a warning if that one expires soon.
fn read_chain(
    file: &Path,
    now: SystemTime,
) -> Result<(Vec<CertificateDer<'static>>, Option<IdentityProblem>), IdentityProblem> {
    let chain = pem::certificates(file)?;
    let warning = chain.first().map_or(Ok(None), |own| check_validity(file, own, now))?;
    Ok((chain, warning))
}

/// An error if the certificate is not valid at `now`, a warning if it expires soon.
fn check_validity(
    file: &Path,
    der: &CertificateDer<'_>,
    now: SystemTime,
) -> Result<Option<IdentityProblem>, IdentityProblem> {
    let file = file.display().to_string();
    let Ok(certificate) = certificate::read(der) else {
        return Err(IdentityProblem::NotACertificate(file));
    };
    let now = now.duration_since(UNIX_EPOCH).unwrap_or_default().as_secs();
    let date = |seconds: u64| {
        let time = UNIX_EPOCH.checked_add(Duration::from_secs(seconds.min(253_402_300_799)));
        time.map_or_else(String::new, |time| humantime::format_rfc3339_seconds(time).to_string())
    };
    let (name, end) = (certificate.name, date(certificate.not_after));
    if now > certificate.not_after {
        return Err(IdentityProblem::Expired { name, file, end });
    }
    if now < certificate.not_before {
        let begin = date(certificate.not_before);
        return Err(IdentityProblem::NotYetValid { name, file, begin });
    }
    let soon = certificate.not_after - now < SOON.as_secs();
    Ok(soon.then_some(IdentityProblem::ExpiresSoon { name, file, end }))
}

/// Authenticates the clients of a listener; its certificates can be renewed while it serves.
#[derive(Debug)]
pub(super) struct TlsAuthenticator {
    config: ArcSwap<ServerConfig>,
    roles: BTreeMap<String, Role>,
}

/// A client whose certificate was verified.
#[derive(Debug)]
pub(super) struct AuthenticatedClient {
    pub(super) name: String,
    pub(super) role: Role,
}

/// Why a client is refused.
#[derive(Debug, thiserror::Error)]
pub(super) enum AuthenticationError {
    #[error("the handshake took longer than {HANDSHAKE:?}")]
    Timeout,
    #[error(transparent)]
    Handshake(#[from] io::Error),
    #[error(transparent)]
    Role(#[from] RoleError),
}

impl TlsAuthenticator {
    pub(super) fn new(tls: &Tls) -> Result<TlsAuthenticator, IdentityFault> {
        Ok(TlsAuthenticator {
            config: ArcSwap::new(tls.identity.server_config()?),
            roles: tls.roles.clone(),
        })
    }

    /// Uses another identity for new connections; open connections stay.
    pub(super) fn renew(&self, identity: &Identity) -> Result<(), IdentityFault> {
        self.config.store(identity.server_config()?);
        Ok(())
    }

    /// Performs the handshake and reads the role of the client.
    ///
    /// # Errors
    /// Why the client is refused.
    pub(super) async fn authenticate(
        &self,
        stream: TcpStream,
    ) -> Result<(TlsStream<TcpStream>, AuthenticatedClient), AuthenticationError> {
        let handshake = TlsAcceptor::from(self.config.load_full()).accept(stream);
        let stream = tokio::time::timeout(HANDSHAKE, handshake)
            .await
            .map_err(|_| AuthenticationError::Timeout)??;
        let chain = stream.get_ref().1.peer_certificates();
        let client = match chain.and_then(|chain| chain.first()).map(|der| certificate::read(der)) {
            Some(Ok(certificate)) => AuthenticatedClient {
                role: self.role(certificate.role?.as_deref()),
                name: certificate.name,
            },
            // The verifier refuses clients without a certificate; one that only rustls can read grants no role.
            Some(Err(_)) | None => AuthenticatedClient {
                role: Role::Monitor,
                name: "unreadable certificate".to_string(),
            },
        };
        Ok((stream, client))
    }

    /// Without a role, or with one that is not configured, a client may read.
    fn role(&self, name: Option<&str>) -> Role {
        name.and_then(|name| self.roles.get(name))
            .copied()
            .unwrap_or(Role::Monitor)
    }
}
