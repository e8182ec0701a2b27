//! Reads certificates, keys and revocation lists from files; reports the content of a file that holds something else.

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

use rustls_pki_types::pem::{self, PemObject};
use rustls_pki_types::{CertificateDer, CertificateRevocationListDer, PrivateKeyDer};

use super::fault::Problem;

/// The content of a file instead of the expected one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Found {
    /// A private key that needs a passphrase.
    EncryptedKey,
    /// A private key in the form of OpenSSH.
    SshKey,
    Key,
    PublicKey,
    Certificate,
    /// A certificate with the purposes for which its owner trusts it, a format of OpenSSL.
    TrustedCertificate,
    Request,
    /// PKCS#7.
    Bundle,
    /// No text: DER or PKCS#12.
    Binary,
    Nothing,
}

const CERTIFICATE: &str = "certificate";
const PRIVATE_KEY: &str = "private key";
const CRL: &str = "CRL";
/// Largest file of certificates or revocation lists, bytes: some hundred thousand entries.
const MOST_BYTES: u64 = 16 << 20;

impl Found {
    /// The kind of content by the first lines of the sections, in the order in which they explain the mistake best.
    fn of(bytes: &[u8]) -> Found {
        let text = String::from_utf8_lossy(bytes);
        let begins = |label: &str| text.contains(&format!("-----BEGIN {label}-----"));
        let ends_in =
            |label: &str| text.contains(&format!("{label}-----\n")) || text.contains(&format!("{label}-----\r"));
        let encrypted = begins("ENCRYPTED PRIVATE KEY") || text.contains("Proc-Type: 4,ENCRYPTED");
        match () {
            () if encrypted => Found::EncryptedKey,
            () if begins("OPENSSH PRIVATE KEY") => Found::SshKey,
            () if ends_in("PRIVATE KEY") && text.contains("-----BEGIN ") => Found::Key,
            () if begins("TRUSTED CERTIFICATE") => Found::TrustedCertificate,
            () if begins("CERTIFICATE") || begins("X509 CERTIFICATE") => Found::Certificate,
            () if begins("CERTIFICATE REQUEST") || begins("NEW CERTIFICATE REQUEST") => Found::Request,
            () if begins("PKCS7") => Found::Bundle,
            () if ends_in("PUBLIC KEY") => Found::PublicKey,
            () if is_sequence(bytes) => Found::Binary,
            () => Found::Nothing,
        }
    }

    pub(super) fn what(self, expected: &str) -> &'static str {
        match self {
            Found::EncryptedKey if expected == PRIVATE_KEY => {
                " that can be read: it is encrypted, and there is nobody to enter its passphrase"
            }
            Found::EncryptedKey | Found::Key => ", but a private key",
            Found::SshKey => ", but a key in the format of OpenSSH",
            Found::PublicKey => ", but a public key",
            Found::Certificate | Found::TrustedCertificate if expected == CERTIFICATE => {
                " in plain PEM, but a TRUSTED CERTIFICATE of OpenSSL"
            }
            Found::Certificate | Found::TrustedCertificate => ", but a certificate",
            Found::Request => ", but a request for one, which a CA has yet to sign",
            Found::Bundle => " in plain PEM, but a bundle of PKCS#7",
            Found::Binary => " in PEM: it is binary (DER or PKCS#12)",
            Found::Nothing => "",
        }
    }

    pub(super) fn remedy(self, file: &str, expected: &str) -> String {
        match (self, expected) {
            (Found::EncryptedKey, PRIVATE_KEY) => {
                format!("save it without a passphrase, readable only by the gateway: openssl pkey -in {file} -out NEW")
            }
            (Found::EncryptedKey | Found::Key | Found::SshKey, CERTIFICATE) => {
                "specify the certificate: are certificate and key swapped?".to_string()
            }
            (Found::Certificate | Found::TrustedCertificate, PRIVATE_KEY) => {
                "specify the key of the certificate: are certificate and key swapped?".to_string()
            }
            (Found::SshKey, PRIVATE_KEY) => format!("convert a copy of it: ssh-keygen -p -m PKCS8 -f {file}"),
            (Found::TrustedCertificate, CERTIFICATE) => format!("convert it: openssl x509 -in {file} -out NEW"),
            (Found::Request, CERTIFICATE) => "specify the certificate that the CA issued for it".to_string(),
            (Found::Bundle, CERTIFICATE) => format!("convert it: openssl pkcs7 -print_certs -in {file} -out NEW"),
            (Found::Binary, PRIVATE_KEY) => format!(
                "convert it: openssl pkey -in {file} -out NEW, or, from PKCS#12, openssl pkcs12 -nocerts -nodes -in {file} -out NEW"
            ),
            (Found::Binary, CERTIFICATE) => format!(
                "convert it: openssl x509 -in {file} -out NEW, or, from PKCS#12, openssl pkcs12 -nokeys -in {file} -out NEW"
            ),
            _ => "specify a PEM file".to_string(),
        }
    }
}

/// Whether the bytes begin like a sequence of DER, whose length field does not occur in text.
fn is_sequence(bytes: &[u8]) -> bool {
    match bytes {
        [0x30, length @ 0..0x80, content @ ..] => usize::from(*length) == content.len(),
        [0x30, ..] => bytes.len() > 2,
        _ => false,
    }
}

/// All certificates of a file; an error if there is none.
pub(super) fn certificates(file: &Path) -> Result<Vec<CertificateDer<'static>>, Problem> {
    let bytes = content(file)?;
    let read: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(&bytes).collect();
    let certificates = read.map_err(|error| pem_error(file, CERTIFICATE, &bytes, &error))?;
    if certificates.is_empty() {
        return Err(pem_error(file, CERTIFICATE, &bytes, &pem::Error::NoItemsFound));
    }
    Ok(certificates)
}

/// The first private key of a file.
pub(super) fn private_key(file: &Path) -> Result<PrivateKeyDer<'static>, Problem> {
    let bytes = content(file)?;
    PrivateKeyDer::from_pem_slice(&bytes).map_err(|error| match Found::of(&bytes) {
        // An encrypted key in the old form would otherwise pass for a broken key.
        Found::EncryptedKey => pem_error(file, PRIVATE_KEY, &bytes, &pem::Error::NoItemsFound),
        _ => pem_error(file, PRIVATE_KEY, &bytes, &error),
    })
}

/// All certificate revocation lists of a file, at least one: in PEM, or a single one in DER as CAs publish it.
pub(super) fn revocation_lists(file: &Path) -> Result<Vec<CertificateRevocationListDer<'static>>, Problem> {
    let bytes = content(file)?;
    // A DER file begins with the tag of a sequence, which is not a letter of PEM.
    if Found::of(&bytes) == Found::Binary {
        return Ok(vec![bytes.into()]);
    }
    let read: Result<Vec<_>, _> = CertificateRevocationListDer::pem_slice_iter(&bytes).collect();
    let lists = read.map_err(|error| pem_error(file, CRL, &bytes, &error))?;
    if lists.is_empty() {
        Err(pem_error(file, CRL, &bytes, &pem::Error::NoItemsFound))
    } else {
        Ok(lists)
    }
}

fn content(file: &Path) -> Result<Vec<u8>, Problem> {
    let mut bytes = Vec::new();
    let read = File::open(file).and_then(|open| open.take(MOST_BYTES).read_to_end(&mut bytes));
    match read {
        Ok(_) => Ok(bytes),
        Err(error) => {
            let (what, remedy) = unreadable(file, &error);
            Err(Problem::Unreadable { what, remedy })
        }
    }
}

/// Why a configured file cannot be read, and the remedy.
pub fn unreadable(file: &Path, error: &io::Error) -> (String, String) {
    let shown = file.display();
    if error.kind() != io::ErrorKind::PermissionDenied {
        return (
            format!("cannot read {shown}: {error}"),
            "check the path and its permissions".to_string(),
        );
    }
    let user = rustix::process::geteuid().as_raw();
    let users = std::fs::read_to_string("/etc/passwd").unwrap_or_default();
    let named = users.lines().find_map(|line| {
        let mut fields = line.split(':');
        let name = fields.next()?;
        (fields.nth(1)?.parse() == Ok(user)).then(|| format!("user `{name}`"))
    });
    let who = named.unwrap_or_else(|| format!("user {user}"));
    (
        format!("cannot read {shown}: {who} is not permitted to"),
        "let that user, or its group, read the file and enter its directories (chgrp, chmod g+r)".to_string(),
    )
}

fn pem_error(file: &Path, expected: &'static str, bytes: &[u8], error: &pem::Error) -> Problem {
    let file = file.display().to_string();
    match error {
        pem::Error::NoItemsFound => Problem::Missing {
            file,
            expected,
            found: Found::of(bytes),
        },
        cause => Problem::Invalid {
            file,
            expected,
            cause: cause.to_string(),
        },
    }
}
