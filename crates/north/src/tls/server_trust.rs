//! Server trust: certificates signed by a CA, and certificates listed themselves.
//!
//! rustls accepts a certificate in the list of CAs only as one that signs others. Other programs accept a server
//! that presents such a certificate itself, and so does this code: a user who names a certificate trusts exactly
//! that one, so its version and signing rights do not matter. Dates, purpose and host do matter, and the server
//! must prove in the handshake that it has the key.

use std::path::Path;
use std::sync::Arc;
use std::time::SystemTime;

use rustls::client::WebPkiServerVerifier;
use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::crypto::{WebPkiSupportedAlgorithms, verify_tls13_signature_with_raw_key};
use rustls::pki_types::{CertificateDer, ServerName, SubjectPublicKeyInfoDer, UnixTime};
use rustls::server::ParsedCertificate;
use rustls::{
    CertificateError, ClientConfig, DigitallySignedStruct, Error, OtherError, RootCertStore, SignatureScheme,
};
use x509_cert::certificate::Certificate;
use x509_cert::der::{Decode, Encode};
use x509_cert::spki::SubjectPublicKeyInfoOwned;

use super::certificate::{self, CertificateSummary};
use super::fault::{Problem, TlsFault, TlsFile};
use super::identity::ServerIdentity;
use super::{pem, provider};

#[derive(Debug)]
struct ServerTrust {
    by_ca: Arc<WebPkiServerVerifier>,
    /// Certificates of the configured file.
    named: Vec<CertificateDer<'static>>,
    algorithms: WebPkiSupportedAlgorithms,
}

/// A server with an unknown issuer.
#[derive(Debug, Clone, thiserror::Error)]
#[error("its certificate `{name}` is signed by `{issuer}`")]
pub(super) struct UnknownIssuer {
    pub(super) name: String,
    pub(super) issuer: String,
    pub(super) self_issued: bool,
}

impl ServerTrust {
    /// Trusts the certificates in a file and all certificates signed by the CAs in it; without a file, those signed by a CA of
    /// the system.
    fn new(ca: Option<&Path>) -> Result<ServerTrust, Problem> {
        let mut roots = RootCertStore::empty();
        let mut named = Vec::new();
        match ca {
            Some(path) => {
                named = pem::certificates(path)?;
                for certificate in &named {
                    let added = roots.add(certificate.clone());
                    added.map_err(|_| Problem::NotACa(path.display().to_string()))?;
                }
            }
            // A certificate of the system that rustls cannot parse must not disable TLS.
            None => {
                roots.add_parsable_certificates(rustls_native_certs::load_native_certs().certs);
            }
        }
        let provider = provider();
        let algorithms = provider.signature_verification_algorithms;
        let by_ca = WebPkiServerVerifier::builder_with_provider(Arc::new(roots), provider)
            .build()
            .map_err(|_| Problem::NoSystemRoots)?;
        Ok(ServerTrust {
            by_ca,
            named,
            algorithms,
        })
    }

    fn names(&self, certificate: &CertificateDer<'_>) -> bool {
        self.named.iter().any(|named| named.as_ref() == certificate.as_ref())
    }
}

/// TLS of a client that trusts the servers with a certificate in the file `ca`, or with one issued by a CA in it; without a
/// file, those with a certificate of a CA of the system. With its own certificate and key, if the server requires one.
/// Blocking, because it reads files.
///
/// # Errors
/// If a file cannot be used: contains the file and the remedy.
pub fn client(ca: Option<&Path>, own: Option<(&Path, &Path)>) -> Result<Arc<ClientConfig>, String> {
    let config = client_config(ca, own).map_err(|problem| problem.to_string());
    config.map(Arc::new)
}

fn client_config(ca: Option<&Path>, own: Option<(&Path, &Path)>) -> Result<ClientConfig, Problem> {
    let builder = ClientConfig::builder_with_provider(provider())
        .with_safe_default_protocol_versions()
        .map_err(Problem::Protocol)?;
    let trust = Arc::new(ServerTrust::new(ca)?);
    let builder = builder.dangerous().with_custom_certificate_verifier(trust);
    let Some((certificate, key)) = own else {
        return Ok(builder.with_no_client_auth());
    };
    let identity = ServerIdentity::new(pem::certificates(certificate)?, pem::private_key(key)?);
    identity
        .client_config(builder)
        .map_err(|cause| Problem::UnusableIdentity {
            file: certificate.display().to_string(),
            cause: Box::new(cause),
        })
}

/// Problems that will or may keep the server `host` from being trusted by the certificates of a PEM file: certificates that
/// have ended, or end within 30 days of `now`, whose keys are not supported, or that are its own and for another host.
///
/// # Errors
/// If the file cannot be read, or contains no certificate.
pub fn certificate_warnings(file: &Path, host: &str, now: SystemTime) -> Result<Vec<TlsFault>, TlsFault> {
    let certificates = pem::certificates(file).map_err(|why| TlsFile::Ca.fault(why))?;
    let problems = certificates
        .iter()
        .flat_map(|der| certificate::problems(file, der, now, |read, file| unfit_for(read, file, host)));
    Ok(problems.map(|why| TlsFile::Ca.fault(why)).collect())
}

fn unfit_for(certificate: CertificateSummary, file: String, host: &str) -> Option<Problem> {
    if !certificate.key.verifies {
        return certificate.unsupported_key(file);
    }
    // A certificate of version 1 does not show whether it is a CA.
    let is_own = !certificate.is_ca && !certificate.is_old;
    let other = is_own && !certificate.is_for(host);
    other.then(|| Problem::OtherHost {
        difference: format!("{}, not for `{host}`", certificate.shown_names()),
        name: certificate.name,
        file,
    })
}

impl ServerCertVerifier for ServerTrust {
    fn verify_server_cert(
        &self,
        certificate: &CertificateDer<'_>,
        intermediates: &[CertificateDer<'_>],
        host: &ServerName<'_>,
        ocsp: &[u8],
        now: UnixTime,
    ) -> Result<ServerCertVerified, Error> {
        if self.names(certificate) {
            return check_named(certificate, host, now).map(|()| ServerCertVerified::assertion());
        }
        let verified = self
            .by_ca
            .verify_server_cert(certificate, intermediates, host, ocsp, now);
        verified.map_err(|error| match certificate::read(certificate) {
            // A self-signed certificate is reported as unknown before any other defect.
            Ok(read) if read.self_issued && is_of_ca(&error) || is_unknown(&error) => other(UnknownIssuer {
                name: read.name,
                issuer: read.issuer,
                self_issued: read.self_issued,
            }),
            _ => error,
        })
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        if ParsedCertificate::try_from(certificate).is_ok() || !self.names(certificate) {
            return self.by_ca.verify_tls12_signature(message, certificate, signed);
        }
        verify_with_key(&key_of(certificate)?, message, signed, &self.algorithms)
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        if ParsedCertificate::try_from(certificate).is_ok() || !self.names(certificate) {
            return self.by_ca.verify_tls13_signature(message, certificate, signed);
        }
        let key = key_of(certificate)?.to_der().map_err(|_| bad_encoding())?;
        verify_tls13_signature_with_raw_key(message, &SubjectPublicKeyInfoDer::from(key), signed, &self.algorithms)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.algorithms.supported_schemes()
    }
}

/// Whether a certificate that the configuration itself names is valid now, for a server, and for this host.
fn check_named(certificate: &CertificateDer<'_>, host: &ServerName<'_>, now: UnixTime) -> Result<(), Error> {
    let read = certificate::read(certificate).map_err(|_| bad_encoding())?;
    let at = |seconds| UnixTime::since_unix_epoch(std::time::Duration::from_secs(seconds));
    if now.as_secs() > read.not_after {
        let not_after = at(read.not_after);
        return Err(CertificateError::ExpiredContext { time: now, not_after }.into());
    }
    if now.as_secs() < read.not_before {
        let not_before = at(read.not_before);
        return Err(CertificateError::NotValidYetContext { time: now, not_before }.into());
    }
    if !read.serves {
        return Err(CertificateError::InvalidPurpose.into());
    }
    // If a certificate has no other names, other programs compare the common name as well.
    if read.is_commonly_named(host) {
        return Ok(());
    }
    if read.is_old {
        return Err(CertificateError::NotValidForNameContext {
            expected: host.to_owned(),
            presented: Vec::new(),
        }
        .into());
    }
    rustls::client::verify_server_name(&ParsedCertificate::try_from(certificate)?, host)
}

fn key_of(certificate: &CertificateDer<'_>) -> Result<SubjectPublicKeyInfoOwned, Error> {
    let read = Certificate::from_der(certificate).map_err(|_| bad_encoding())?;
    Ok(read.tbs_certificate().subject_public_key_info().clone())
}

/// Verifies a signature of TLS 1.2 by a key, for a certificate that rustls does not read.
fn verify_with_key(
    key: &SubjectPublicKeyInfoOwned,
    message: &[u8],
    signed: &DigitallySignedStruct,
    algorithms: &WebPkiSupportedAlgorithms,
) -> Result<HandshakeSignatureValid, Error> {
    // In TLS 1.2 the scheme does not name the curve, so several algorithms may fit; the key decides.
    let of_scheme = algorithms.mapping.iter().filter(|(scheme, _)| *scheme == signed.scheme);
    let wanted = key.algorithm.to_der().map_err(|_| bad_encoding())?;
    let bytes = key.subject_public_key.as_bytes().ok_or_else(bad_encoding)?;
    let fits = of_scheme
        .flat_map(|(_, algorithms)| algorithms.iter())
        // The identifier follows after the head of the sequence.
        .find(|algorithm| wanted.get(2..) == Some(algorithm.public_key_alg_id().as_ref()));
    let bad = || Error::from(CertificateError::BadSignature);
    let algorithm = fits.ok_or_else(bad)?;
    algorithm
        .verify_signature(bytes, message, signed.signature())
        .map_err(|_| bad())?;
    Ok(HandshakeSignatureValid::assertion())
}

fn is_unknown(error: &Error) -> bool {
    *error == Error::InvalidCertificate(CertificateError::UnknownIssuer)
}

fn is_of_ca(error: &Error) -> bool {
    let Error::InvalidCertificate(CertificateError::Other(OtherError(cause))) = error else {
        return false;
    };
    matches!(cause.downcast_ref(), Some(webpki::Error::CaUsedAsEndEntity))
}

fn other(why: UnknownIssuer) -> Error {
    CertificateError::Other(OtherError(Arc::new(why))).into()
}

fn bad_encoding() -> Error {
    CertificateError::BadEncoding.into()
}
