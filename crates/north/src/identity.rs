//! Certificate and private key of a server, read from files and checked; what is wrong with certificate files.

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use rustls::crypto::CryptoProvider;
use rustls::server::danger::ClientCertVerifier;
use rustls::{ClientConfig, RootCertStore, ServerConfig, crypto};
use rustls_pki_types::{CertificateDer, PrivateKeyDer};

use super::certificate;
use super::pem::{self, PemError};

/// How long before its end a certificate or a CRL causes a warning.
const SOON: Duration = Duration::from_secs(30 * 86_400);
/// Last second of the year 9999, which a certificate without an end states.
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
    /// Its private key.
    Key,
    /// The CA certificates that client certificates are verified against.
    ClientCa,
    /// The client certificates that were revoked.
    ClientCrl,
}

/// A fault of one of the files, or a warning about it: what is wrong and what to do.
#[derive(Debug, thiserror::Error)]
#[error("{problem}")]
pub struct IdentityFault {
    /// The file.
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
    Unusable(rustls::Error),
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
    /// Reads both files and checks that they fit together. A certificate that has ended or will soon is a warning:
    /// its clients will refuse it, but the drives must still be polled after a restart.
    ///
    /// # Errors
    /// All faults of the files.
    pub fn load(
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
        let own = chain.iter().take(1).filter_map(|own| validity(certificate, own, now));
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
    /// Certificate and key cannot be used.
    pub(super) fn server_config(
        &self,
        clients: Option<Arc<dyn ClientCertVerifier>>,
    ) -> Result<ServerConfig, IdentityFault> {
        let unusable = |error: rustls::Error| match error {
            rustls::Error::InconsistentKeys(_) => TlsFile::Key.fault(FileProblem::KeyMismatch),
            error => TlsFile::Certificate.fault(FileProblem::Unusable(error)),
        };
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

/// The one cryptographic provider of the gateway.
pub(super) fn provider() -> Arc<CryptoProvider> {
    Arc::new(crypto::ring::default_provider())
}

/// Why there are no CA certificates to verify a server with, and what to do.
#[derive(Debug, thiserror::Error)]
pub(super) enum RootsError {
    #[error(transparent)]
    Pem(#[from] PemError),
    #[error("{file}: not a usable CA certificate: {cause}; specify the PEM file of the CA")]
    UnusableCa { file: String, cause: rustls::Error },
    #[error("the system has no CA certificates; install them or name a file with `ca`")]
    NoSystemRoots,
}

/// The CA certificates of a file, or those of the system.
pub(super) fn roots(ca: Option<&Path>) -> Result<RootCertStore, RootsError> {
    let mut store = RootCertStore::empty();
    match ca {
        Some(file) => {
            for certificate in pem::certificates(file)? {
                store.add(certificate).map_err(|cause| RootsError::UnusableCa {
                    file: file.display().to_string(),
                    cause,
                })?;
            }
        }
        None => {
            // One certificate of the system that rustls cannot parse must not disable TLS.
            store.add_parsable_certificates(rustls_native_certs::load_native_certs().certs);
            if store.is_empty() {
                return Err(RootsError::NoSystemRoots);
            }
        }
    }
    Ok(store)
}

/// TLS towards a gateway, verified by the CA certificates of a file or by those of the system.
///
/// # Errors
/// What is wrong with them, and what to do.
pub fn client_tls(ca: Option<&Path>) -> Result<Arc<ClientConfig>, String> {
    let roots = roots(ca).map_err(|error| error.to_string())?;
    let config = ClientConfig::builder_with_provider(provider())
        .with_safe_default_protocol_versions()
        .map_err(|error| format!("TLS: {error}"))?
        .with_root_certificates(roots)
        .with_no_client_auth();
    Ok(Arc::new(config))
}

/// Certificates of a PEM file that have ended, or end within 30 days of `now`; each as what is wrong and what to do.
///
/// # Errors
/// The file cannot be read, or contains no certificate.
pub fn certificate_warnings(file: &Path, now: SystemTime) -> Result<Vec<String>, String> {
    let certificates = pem::certificates(file).map_err(|error| error.to_string())?;
    let problems = certificates.iter().filter_map(|der| validity(file, der, now));
    Ok(problems.map(|problem| problem.to_string()).collect())
}

/// What is wrong with the period of validity of a certificate.
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

/// Seconds since 1970.
pub(super) fn seconds(time: SystemTime) -> u64 {
    time.duration_since(UNIX_EPOCH).unwrap_or_default().as_secs()
}

/// A time in seconds since 1970 for messages.
pub(super) fn date(seconds: u64) -> String {
    let time = UNIX_EPOCH.checked_add(Duration::from_secs(seconds.min(LAST_DATE)));
    time.map_or_else(String::new, |time| humantime::format_rfc3339_seconds(time).to_string())
}
