//! What is wrong with a file of certificates, keys or revocations, and the remedy.

use super::key::SUPPORTED_KEYS;
use super::pem::Found;

/// A file that TLS is configured by.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TlsFile {
    /// The own certificate, followed by intermediate certificates.
    Certificate,
    /// The private key of the certificate.
    Key,
    /// The CA certificates that the certificates of the other end are verified against.
    Ca,
    /// The list of revoked client certificates.
    Crl,
}

/// A fault of a file, or a warning about it, with its remedy: `what; what to do`.
#[derive(Debug, thiserror::Error)]
#[error("{problem}")]
pub struct TlsFault {
    /// The file that has the fault.
    pub file: TlsFile,
    problem: Problem,
}

#[derive(Debug, thiserror::Error)]
pub(super) enum Problem {
    #[error("{what}; {remedy}")]
    Unreadable { what: String, remedy: String },
    #[error("{file} contains no {expected}{}; {}", found.what(expected), found.remedy(file, expected))]
    Missing {
        file: String,
        expected: &'static str,
        found: Found,
    },
    #[error("{file} contains no valid {expected}: {cause}; specify a PEM file")]
    Invalid {
        file: String,
        expected: &'static str,
        cause: String,
    },
    #[error("the system has no CA certificates; install them or name a file with `ca`")]
    NoSystemRoots,
    #[error("TLS: {0}")]
    Protocol(rustls::Error),
    #[error("{0} contains data that is not a certificate; specify a PEM file")]
    NotACertificate(String),
    #[error("{0} contains data that is not a certificate; specify the PEM file of the CA")]
    NotACa(String),
    #[error("{file}: {cause}")]
    UnusableIdentity { file: String, cause: Box<TlsFault> },
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
    pub(super) fn fault(self, problem: Problem) -> TlsFault {
        TlsFault { file: self, problem }
    }
}
