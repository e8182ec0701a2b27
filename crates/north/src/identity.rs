//! Certificate and private key of a server: reads them from files, checks them, and reports problems in certificate files.

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use rustls::client::WantsClientCert;
use rustls::crypto::CryptoProvider;
use rustls::server::danger::ClientCertVerifier;
use rustls::{CertificateError, ClientConfig, ConfigBuilder, OtherError, RootCertStore, ServerConfig, crypto};
use rustls_pki_types::{CertificateDer, PrivateKeyDer};

use super::certificate;
use super::certificate_kind::{Kind, SUPPORTED_KEYS};
use super::pem::{self, PemError};
use super::server_trust::ServerTrust;

/// Time before the end of a certificate or a CRL at which a warning begins.
const SOON: Duration = Duration::from_secs(30 * 86_400);
/// Last second of the year 9999, which certificates without an expiry date contain.
const LAST_DATE: u64 = 253_402_300_799;

/// Certificate chain and key of a server or client, with the content of their files; equal while the content is.
#[derive(Debug, Clone, PartialEq)]
pub struct ServerIdentity {
    chain: Vec<CertificateDer<'static>>,
    key: Arc<PrivateKeyDer<'static>>,
}

/// A file that TLS is configured by.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TlsFile {
    /// The certificate of the server, followed by intermediate certificates.
    Certificate,
    /// The private key of the certificate.
    Key,
    /// The CA certificates that client certificates are verified against.
    ClientCa,
    /// The list of revoked client certificates.
    ClientCrl,
}

/// A fault of a certificate or key file, or a warning about it, with its remedy.
#[derive(Debug, thiserror::Error)]
#[error("{problem}")]
pub struct IdentityFault {
    pub file: TlsFile,
    problem: FileProblem,
}

#[derive(Debug, thiserror::Error)]
pub(super) enum FileProblem {
    #[error(transparent)]
    Pem(#[from] PemError),
    #[error("{0} contains data that is not a certificate; specify a PEM file")]
    NotACertificate(String),
    #[error("certificate `{name}` in {file} expired on {end}; renew it")]
    Expired { name: String, file: String, end: String },
    #[error("certificate `{name}` in {file} is not valid before {begin}; check the clock of this machine")]
    NotYetValid { name: String, file: String, begin: String },
    #[error("certificate `{name}` in {file} expires on {end}; renew it")]
    ExpiresSoon { name: String, file: String, end: String },
    #[error("not a usable CA certificate: {0}; specify the PEM file of the CA")]
    UnusableCa(String),
    #[error("the key does not match the certificate; specify the key of the certificate")]
    KeyMismatch,
    #[error("certificate and key cannot be used: {0}; specify a certificate and its key in PEM format")]
    Unusable(String),
    #[error(
        "certificate `{name}` is of X.509 version 1, which TLS libraries refuse; have it reissued as version 3, for \
         which \
         openssl x509 -req needs -extfile with a subjectAltName"
    )]
    OldVersion { name: String },
    #[error("certificate `{name}` has a key of {kind}, which the gateway does not support; use {SUPPORTED_KEYS}")]
    UnsupportedKey { name: String, kind: String },
    #[error("the private key is of a kind that the gateway does not support; use {SUPPORTED_KEYS}")]
    UnknownKey,
    #[error(
        "certificate `{name}` in {file} names no host (subjectAltName), and most clients ignore its common name; have \
         it reissued with subjectAltName"
    )]
    NoNames { name: String, file: String },
    #[error(
        "certificate `{name}` in {file} has a key of {kind}, which the gateway does not support: a client with it, or \
         with one signed by it, is refused; use {SUPPORTED_KEYS}"
    )]
    UnsupportedCaKey { name: String, file: String, kind: String },
    #[error(
        "certificate `{name}` in {file} is not a CA and is for {difference}, so the server with it is refused; \
         write a name that is in the certificate into the url"
    )]
    OtherHost {
        name: String,
        file: String,
        difference: String,
    },
    #[error("{file} contains no usable CRL: {cause}; specify a PEM or DER file with CRLs of version 2")]
    UnusableCrl { file: String, cause: String },
    #[error("a CRL cannot be used: {0:?}; specify CRLs of version 2")]
    UnsupportedCrl(rustls::CertRevocationListError),
    #[error(
        "the CRL of `{issuer}` in {file} is not signed by the CA in client_ca, so every client would be refused; \
         specify the CRL that this CA issued"
    )]
    ForeignCrl { issuer: String, file: String },
    #[error(
        "{file} contains no CRL of CA `{issuer}`, so clients with its certificates are refused; add its CRL, or remove \
         the CA from client_ca"
    )]
    NoCrl { issuer: String, file: String },
    #[error(
        "the CRL of `{issuer}` in {file} should have been replaced by {end} and stays in force, without newer revocations; \
         install the current one"
    )]
    OldCrl { issuer: String, file: String, end: String },
}

impl TlsFile {
    pub(super) fn fault(self, problem: impl Into<FileProblem>) -> IdentityFault {
        IdentityFault {
            file: self,
            problem: problem.into(),
        }
    }
}

impl ServerIdentity {
    /// Reads certificate and key of a server and checks that they match. A certificate that has expired, or soon
    /// will, is only a warning: clients will refuse it, but the drives must still be polled after a restart. A
    /// certificate that names no host is a warning as well.
    ///
    /// # Errors
    /// If certificate or key cannot be used; contains all faults.
    pub fn load(
        certificate: &Path,
        key: &Path,
        now: SystemTime,
    ) -> Result<(ServerIdentity, Vec<IdentityFault>), Vec<IdentityFault>> {
        let (identity, mut warnings) = ServerIdentity::load_of_client(certificate, key, now)?;
        let nameless = identity.chain.first().and_then(|own| nameless(certificate, own));
        warnings.extend(nameless.map(|problem| TlsFile::Certificate.fault(problem)));
        Ok((identity, warnings))
    }

    /// Loads an identity like [`ServerIdentity::load`], for a client, which needs no names.
    ///
    /// # Errors
    /// If certificate or key cannot be used; contains all faults.
    pub fn load_of_client(
        certificate: &Path,
        key: &Path,
        now: SystemTime,
    ) -> Result<(ServerIdentity, Vec<IdentityFault>), Vec<IdentityFault>> {
        let mut errors = Vec::new();
        let chain = pem::certificates(certificate).map_err(|error| errors.push(TlsFile::Certificate.fault(error)));
        let key = pem::private_key(key).map_err(|error| errors.push(TlsFile::Key.fault(error)));
        let (Ok(chain), Ok(key)) = (chain, key) else {
            return Err(errors);
        };
        let own = chain
            .first()
            .into_iter()
            .filter_map(|own| validity(certificate, own, now));
        let warnings = own.map(|problem| TlsFile::Certificate.fault(problem)).collect();
        let identity = ServerIdentity {
            chain,
            key: Arc::new(key),
        };
        match identity.server_config(None) {
            Ok(_) => Ok((identity, warnings)),
            Err(fault) => Err(vec![fault]),
        }
    }

    /// The configuration for rustls; with a verifier, clients must present certificates.
    ///
    /// # Errors
    /// If certificate and key cannot be used.
    pub fn server_config(&self, clients: Option<Arc<dyn ClientCertVerifier>>) -> Result<ServerConfig, IdentityFault> {
        let unusable = |error: rustls::Error| unusable(&error, &self.chain);
        let builder = ServerConfig::builder_with_provider(provider())
            .with_safe_default_protocol_versions()
            .map_err(unusable)?;
        let builder = match clients {
            Some(verifier) => builder.with_client_cert_verifier(verifier),
            None => builder.with_no_client_auth(),
        };
        builder
            .with_single_cert(self.chain.clone(), self.key.clone_key())
            .map_err(unusable)
    }
}

/// Why a certificate chain and a key cannot be used together, in words for the user.
pub fn unusable(error: &rustls::Error, chain: &[CertificateDer<'_>]) -> IdentityFault {
    let own = chain.first().and_then(|own| Kind::of(own));
    let Some(Kind { name, is_old, key, .. }) = own else {
        return TlsFile::Certificate.fault(FileProblem::Unusable(error.to_string()));
    };
    match error {
        rustls::Error::InconsistentKeys(_) => TlsFile::Key.fault(FileProblem::KeyMismatch),
        _ if is_old => TlsFile::Certificate.fault(FileProblem::OldVersion { name }),
        _ if !key.signs => TlsFile::Certificate.fault(FileProblem::UnsupportedKey { name, kind: key.name }),
        // The only message for a key that cannot be read.
        rustls::Error::General(_) => TlsFile::Key.fault(FileProblem::UnknownKey),
        rustls::Error::InvalidCertificate(CertificateError::Other(OtherError(cause))) => {
            TlsFile::Certificate.fault(FileProblem::Unusable(cause.to_string()))
        }
        error => TlsFile::Certificate.fault(FileProblem::Unusable(error.to_string())),
    }
}

/// The cryptographic provider that the whole gateway uses.
pub(super) fn provider() -> Arc<CryptoProvider> {
    Arc::new(crypto::ring::default_provider())
}

/// Why there are no CA certificates for verifying a server, and the remedy.
#[derive(Debug, thiserror::Error)]
pub enum RootsError {
    #[error(transparent)]
    Pem(#[from] PemError),
    #[error("{file} contains data that is not a certificate; specify the PEM file of the CA")]
    UnusableCa { file: String },
    #[error("the system has no CA certificates; install them or name a file with `ca`")]
    NoSystemRoots,
    #[error("TLS: {0}")]
    Protocol(rustls::Error),
}

/// The servers to trust: those with a certificate issued by a CA in the file, or contained in the file; without a
/// file, those with a certificate of a CA of the system.
pub(super) fn trusted_servers(ca: Option<&Path>) -> Result<ServerTrust, RootsError> {
    let mut store = RootCertStore::empty();
    let mut named = Vec::new();
    match ca {
        Some(path) => {
            let file = || path.display().to_string();
            named = pem::certificates(path)?;
            for certificate in &named {
                store
                    .add(certificate.clone())
                    .map_err(|_| RootsError::UnusableCa { file: file() })?;
            }
        }
        None => {
            // A certificate of the system that rustls cannot parse must not disable TLS.
            store.add_parsable_certificates(rustls_native_certs::load_native_certs().certs);
        }
    }
    ServerTrust::new(store, named).map_err(|_| RootsError::NoSystemRoots)
}

/// A builder for the TLS of a client that trusts such servers.
pub fn client_builder(ca: Option<&Path>) -> Result<ConfigBuilder<ClientConfig, WantsClientCert>, RootsError> {
    let builder = ClientConfig::builder_with_provider(provider())
        .with_safe_default_protocol_versions()
        .map_err(RootsError::Protocol)?;
    let trust = Arc::new(trusted_servers(ca)?);
    Ok(builder.dangerous().with_custom_certificate_verifier(trust))
}

/// TLS towards a gateway, verified by the certificates of a file or by the CAs of the system.
///
/// # Errors
/// If the certificates of the authority are not usable: contains the fault and the remedy.
pub fn client_tls(ca: Option<&Path>) -> Result<Arc<ClientConfig>, String> {
    let builder = client_builder(ca).map_err(|error| error.to_string())?;
    Ok(Arc::new(builder.with_no_client_auth()))
}

/// Problems that will or may keep the server `host` from being trusted by the certificates of a PEM file: certificates that
/// have ended, or end within 30 days of `now`, whose keys are not supported, or that are its own and for another host. Each
/// with error and remedy.
///
/// # Errors
/// If the file cannot be read, or contains no certificate.
pub fn certificate_warnings(file: &Path, host: &str, now: SystemTime) -> Result<Vec<String>, String> {
    let certificates = pem::certificates(file).map_err(|error| error.to_string())?;
    let problems = certificates.iter().flat_map(|der| {
        let shown = file.display().to_string();
        let unfit = Kind::of(der).and_then(|kind| unfit_for(kind, shown, host));
        validity(file, der, now).into_iter().chain(unfit)
    });
    Ok(problems.map(|problem| problem.to_string()).collect())
}

fn unfit_for(kind: Kind, file: String, host: &str) -> Option<FileProblem> {
    if !kind.key.verifies {
        return Some(unsupported_key(kind, file));
    }
    let name = kind.name.clone();
    // A certificate of version 1 does not show whether it is a CA.
    let is_own = !kind.is_ca && !kind.is_old;
    let other = is_own && !kind.is_for(host);
    other.then(|| FileProblem::OtherHost {
        name,
        file,
        difference: format!("{}, not for `{host}`", kind.shown_names()),
    })
}

/// Warns of a CA whose signatures cannot be verified.
pub(super) fn unsupported_ca(file: &Path, der: &CertificateDer<'_>) -> Option<FileProblem> {
    let kind = Kind::of(der).filter(|kind| !kind.key.verifies)?;
    Some(unsupported_key(kind, file.display().to_string()))
}

fn unsupported_key(kind: Kind, file: String) -> FileProblem {
    FileProblem::UnsupportedCaKey {
        name: kind.name,
        file,
        kind: kind.key.name,
    }
}

/// A warning about a server certificate without names.
fn nameless(file: &Path, der: &CertificateDer<'_>) -> Option<FileProblem> {
    let kind = Kind::of(der)?;
    kind.names.is_empty().then(|| FileProblem::NoNames {
        name: kind.name,
        file: file.display().to_string(),
    })
}

/// The fault in the validity period of a certificate.
pub(super) fn validity(file: &Path, der: &CertificateDer<'_>, now: SystemTime) -> Option<FileProblem> {
    let file = file.display().to_string();
    let Ok(certificate) = certificate::read(der) else {
        return Some(FileProblem::NotACertificate(file));
    };
    let now = seconds(now);
    let (name, end) = (certificate.name, date(certificate.not_after));
    if now > certificate.not_after {
        return Some(FileProblem::Expired { name, file, end });
    }
    if now < certificate.not_before {
        let begin = date(certificate.not_before);
        return Some(FileProblem::NotYetValid { name, file, begin });
    }
    let soon = certificate.not_after - now < SOON.as_secs();
    soon.then_some(FileProblem::ExpiresSoon { name, file, end })
}

/// A time as seconds since 1970.
pub(super) fn seconds(time: SystemTime) -> u64 {
    time.duration_since(UNIX_EPOCH).unwrap_or_default().as_secs()
}

/// A time in seconds since 1970 for messages.
pub(super) fn date(seconds: u64) -> String {
    let time = UNIX_EPOCH.checked_add(Duration::from_secs(seconds.min(LAST_DATE)));
    time.map_or_else(String::new, |time| humantime::format_rfc3339_seconds(time).to_string())
}
