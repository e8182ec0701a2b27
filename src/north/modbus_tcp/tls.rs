//! Modbus/TCP Security: certificates of the server, who is trusted, and what a client may do by its role.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use arc_swap::ArcSwap;
use ipnet::IpNet;
use rustls::server::{NoServerSessionStorage, WebPkiClientVerifier};
use rustls::{RootCertStore, ServerConfig};
use rustls_pki_types::pem::PemObject;
use rustls_pki_types::{CertificateDer, PrivateKeyDer};
use tokio::net::TcpStream;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;

use super::certificate;

/// Time for a client to show who it is.
const HANDSHAKE: Duration = Duration::from_secs(10);
/// How long before its end a certificate is worth a warning.
const SOON: Duration = Duration::from_secs(30 * 86_400);

/// The listener that speaks TLS.
#[derive(Debug, Clone, PartialEq)]
pub struct Tls {
    /// Addresses to listen on.
    pub listen: Vec<SocketAddr>,
    /// Networks that may connect.
    pub allow: Vec<IpNet>,
    /// Names of the buses whose drives are shown; `None` shows all.
    pub buses: Option<Vec<String>>,
    /// Who the server is and whom it trusts.
    pub identity: Identity,
    /// What the roles in client certificates may do.
    pub roles: BTreeMap<String, Role>,
}

/// What a client may do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// Read.
    Monitor,
    /// Read and write.
    Control,
}

/// Certificates and key as they stood in their files; compares equal while the files say the same.
#[derive(Debug, Clone, PartialEq)]
pub struct Identity {
    chain: Vec<CertificateDer<'static>>,
    key: Arc<PrivateKeyDer<'static>>,
    client_ca: Vec<CertificateDer<'static>>,
}

/// A file of an [`Identity`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TlsFile {
    /// The certificate of the server, with those between it and the CA.
    Certificate,
    /// The private key that belongs to it.
    Key,
    /// The certificates that those of the clients are checked against.
    ClientCa,
}

/// Something about a file: what, and what to do.
pub type Finding = (TlsFile, String);

impl Identity {
    /// Reads the three files and tries whether they can be used together at `now`; with what is worth a warning.
    ///
    /// # Errors
    /// Everything that is wrong, each with its file.
    pub fn load(
        certificate: &Path,
        key: &Path,
        client_ca: &Path,
        now: SystemTime,
    ) -> Result<(Identity, Vec<Finding>), Vec<Finding>> {
        let (mut errors, mut warnings) = (Vec::new(), Vec::new());
        let chain = certificates(certificate).and_then(|chain| {
            let warning = chain
                .first()
                .map_or(Ok(None), |own| judge_time(certificate, own, now))?;
            warnings.extend(warning.map(|text| (TlsFile::Certificate, text)));
            Ok(chain)
        });
        let chain = chain.map_err(|text| errors.push((TlsFile::Certificate, text)));
        let key = private_key(key).map_err(|text| errors.push((TlsFile::Key, text)));
        let ca = certificates(client_ca).map_err(|text| errors.push((TlsFile::ClientCa, text)));
        // An expired CA is still an anchor of trust (RFC 5280, 6.1.1), so it does not keep anybody out.
        for anchor in ca.iter().flatten() {
            let told = judge_time(client_ca, anchor, now).unwrap_or_else(Some);
            warnings.extend(told.map(|text| (TlsFile::ClientCa, text)));
        }
        if let (Ok(chain), Ok(key), Ok(client_ca)) = (chain, key, ca) {
            let identity = Identity {
                chain,
                key: Arc::new(key),
                client_ca,
            };
            match identity.server_config() {
                Ok(_) => return Ok((identity, warnings)),
                Err(finding) => errors.push(finding),
            }
        }
        Err(errors)
    }

    /// The configuration that rustls serves with. Sessions are not resumed: each connection shows its certificate,
    /// and one that has run out is not carried on.
    fn server_config(&self) -> Result<Arc<ServerConfig>, Finding> {
        let mut roots = RootCertStore::empty();
        for anchor in &self.client_ca {
            roots.add(anchor.clone()).map_err(|why| {
                (
                    TlsFile::ClientCa,
                    format!("not a usable CA certificate: {why}; give the PEM file of the CA"),
                )
            })?;
        }
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let verifier = WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider.clone())
            .build()
            .map_err(|why| {
                (
                    TlsFile::ClientCa,
                    format!("no client can be checked by it: {why}; give another file"),
                )
            })?;
        let unusable = |why: rustls::Error| match why {
            rustls::Error::InconsistentKeys(_) => (
                TlsFile::Key,
                "the key does not belong to the certificate; give the key that the certificate was made for"
                    .to_string(),
            ),
            why => (
                TlsFile::Certificate,
                format!("certificate and key cannot be used: {why}; give a certificate and its key in PEM"),
            ),
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

fn cannot_read(file: &Path, why: &rustls_pki_types::pem::Error, what: &str) -> String {
    match why {
        rustls_pki_types::pem::Error::Io(why) => {
            format!(
                "cannot read {}: {why}; check the path and its permissions",
                file.display()
            )
        }
        why => format!("{} holds no {what}: {why}; give a PEM file", file.display()),
    }
}

fn certificates(file: &Path) -> Result<Vec<CertificateDer<'static>>, String> {
    let bad = |why: rustls_pki_types::pem::Error| cannot_read(file, &why, "certificate");
    let found: Vec<_> = CertificateDer::pem_file_iter(file)
        .map_err(bad)?
        .collect::<Result<_, _>>()
        .map_err(bad)?;
    if found.is_empty() {
        return Err(format!("{} holds no certificate; give a PEM file", file.display()));
    }
    Ok(found)
}

fn private_key(file: &Path) -> Result<PrivateKeyDer<'static>, String> {
    PrivateKeyDer::from_pem_file(file).map_err(|why| cannot_read(file, &why, "private key"))
}

/// An error when the certificate is not valid at `now`, a warning when it will not be for long.
fn judge_time(file: &Path, der: &CertificateDer<'_>, now: SystemTime) -> Result<Option<String>, String> {
    let facts = certificate::read(der).ok_or_else(|| {
        format!(
            "{} holds something that is no certificate; give a PEM file",
            file.display()
        )
    })?;
    let seconds = now.duration_since(UNIX_EPOCH).unwrap_or_default().as_secs();
    let date = |seconds: u64| {
        let time = UNIX_EPOCH.checked_add(Duration::from_secs(seconds.min(253_402_300_799)));
        time.map_or_else(String::new, |time| humantime::format_rfc3339_seconds(time).to_string())
    };
    let (name, file) = (&facts.name, file.display());
    if seconds > facts.not_after {
        let end = date(facts.not_after);
        return Err(format!("certificate `{name}` in {file} has expired on {end}; renew it"));
    }
    if seconds < facts.not_before {
        let begin = date(facts.not_before);
        return Err(format!(
            "certificate `{name}` in {file} is not valid before {begin}; check the clock of this machine"
        ));
    }
    let end = facts.not_after;
    Ok((end - seconds < SOON.as_secs())
        .then(|| format!("certificate `{name}` in {file} expires on {}; renew it", date(end))))
}

/// What a listener does handshakes with; certificates can be renewed while it serves.
#[derive(Debug)]
pub(super) struct TlsAuthenticator {
    config: ArcSwap<ServerConfig>,
    roles: BTreeMap<String, Role>,
}

/// A client that has shown who it is.
#[derive(Debug)]
pub(super) struct AuthenticatedClient {
    pub(super) name: String,
    pub(super) role: Role,
}

impl TlsAuthenticator {
    pub(super) fn new(tls: &Tls) -> Result<TlsAuthenticator, String> {
        let config = tls.identity.server_config().map_err(|(_, text)| text)?;
        Ok(TlsAuthenticator {
            config: ArcSwap::new(config),
            roles: tls.roles.clone(),
        })
    }

    /// Serves with other certificates from now on; connections that are open stay.
    pub(super) fn renew(&self, identity: &Identity) -> Result<(), String> {
        self.config.store(identity.server_config().map_err(|(_, text)| text)?);
        Ok(())
    }

    /// The handshake, and who the client is by it.
    ///
    /// # Errors
    /// Why the client is refused.
    pub(super) async fn authenticate(
        &self,
        stream: TcpStream,
    ) -> Result<(TlsStream<TcpStream>, AuthenticatedClient), String> {
        let handshake = TlsAcceptor::from(self.config.load_full()).accept(stream);
        let stream = tokio::time::timeout(HANDSHAKE, handshake)
            .await
            .map_err(|_| format!("no handshake within {HANDSHAKE:?}"))?
            .map_err(|why| why.to_string())?;
        let certificate = stream.get_ref().1.peer_certificates().and_then(|chain| chain.first());
        // The verifier lets nobody in without one; a certificate that rustls can read and this house cannot gets no role.
        let facts = certificate.and_then(|der| certificate::read(der));
        let known = match facts {
            Some(facts) => AuthenticatedClient {
                role: self.role(facts.role.as_deref()),
                name: facts.name,
            },
            None => AuthenticatedClient {
                role: Role::Monitor,
                name: "unreadable certificate".to_string(),
            },
        };
        Ok((stream, known))
    }

    /// No role and an unknown one may read.
    fn role(&self, name: Option<&str>) -> Role {
        name.and_then(|name| self.roles.get(name))
            .copied()
            .unwrap_or(Role::Monitor)
    }
}
