//! Server trust: certificates signed by a CA, and certificates listed themselves.
//!
//! rustls accepts a certificate in the list of CAs only as one that signs others. Other programs accept a server
//! that presents such a certificate itself, and so does this code: a user who names a certificate trusts exactly
//! that one, so its version and signing rights do not matter. Dates, purpose and host do matter, and the server
//! must prove in the handshake that it has the key.

use std::sync::Arc;

use rustls::client::WebPkiServerVerifier;
use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::crypto::{WebPkiSupportedAlgorithms, verify_tls13_signature_with_raw_key};
use rustls::pki_types::{CertificateDer, ServerName, SubjectPublicKeyInfoDer, UnixTime};
use rustls::server::ParsedCertificate;
use rustls::{CertificateError, DigitallySignedStruct, Error, OtherError, RootCertStore, SignatureScheme};
use x509_cert::certificate::Certificate;
use x509_cert::der::{Decode, Encode};
use x509_cert::spki::SubjectPublicKeyInfoOwned;

use super::certificate;
use super::certificate_kind::Kind;
use super::identity::provider;

#[derive(Debug)]
pub(super) struct ServerTrust {
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
    /// Trusts the certificates in `named` and all certificates signed by the CAs in `roots`.
    ///
    /// # Errors
    /// If there is no usable CA.
    pub(super) fn new(roots: RootCertStore, named: Vec<CertificateDer<'static>>) -> Result<ServerTrust, Error> {
        let provider = provider();
        let algorithms = provider.signature_verification_algorithms;
        let by_ca = WebPkiServerVerifier::builder_with_provider(Arc::new(roots), provider)
            .build()
            .map_err(|error| Error::General(error.to_string()))?;
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
        verified.map_err(|error| match Kind::of(certificate) {
            // A self-signed certificate is reported as unknown before any other defect.
            Some(kind) if kind.self_issued && is_of_ca(&error) || is_unknown(&error) => other(UnknownIssuer {
                name: kind.name,
                issuer: kind.issuer,
                self_issued: kind.self_issued,
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
    let (Ok(read), Some(kind)) = (certificate::read(certificate), Kind::of(certificate)) else {
        return Err(bad_encoding());
    };
    let at = |seconds| UnixTime::since_unix_epoch(std::time::Duration::from_secs(seconds));
    if now.as_secs() > read.not_after {
        let not_after = at(read.not_after);
        return Err(CertificateError::ExpiredContext { time: now, not_after }.into());
    }
    if now.as_secs() < read.not_before {
        let not_before = at(read.not_before);
        return Err(CertificateError::NotValidYetContext { time: now, not_before }.into());
    }
    if !kind.serves {
        return Err(CertificateError::InvalidPurpose.into());
    }
    // If a certificate has no other names, other programs compare the common name as well.
    if kind.is_commonly_named(host) {
        return Ok(());
    }
    if kind.is_old {
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
