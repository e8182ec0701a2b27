//! Reads certificates, keys and revocation lists from files.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use rustls_pki_types::pem::{self, PemObject};
use rustls_pki_types::{CertificateDer, CertificateRevocationListDer, PrivateKeyDer};

/// Why a PEM file cannot be used.
#[derive(Debug, thiserror::Error)]
pub(super) enum PemError {
    #[error("cannot read {file}: {cause}; check the path and its permissions")]
    Unreadable { file: String, cause: String },
    #[error("{file} contains no {expected}; specify a PEM file")]
    Missing { file: String, expected: &'static str },
    #[error("{file} contains no valid {expected}: {cause}; specify a PEM file")]
    Invalid {
        file: String,
        expected: &'static str,
        cause: String,
    },
}

/// All certificates of a file, at least one.
pub(super) fn certificates(file: &Path) -> Result<Vec<CertificateDer<'static>>, PemError> {
    let read = CertificateDer::pem_file_iter(file).and_then(Iterator::collect::<Result<Vec<_>, _>>);
    let certificates = read.map_err(|error| pem_error(file, "certificate", &error))?;
    if certificates.is_empty() {
        return Err(pem_error(file, "certificate", &pem::Error::NoItemsFound));
    }
    Ok(certificates)
}

/// The first private key of a file.
pub(super) fn private_key(file: &Path) -> Result<PrivateKeyDer<'static>, PemError> {
    PrivateKeyDer::from_pem_file(file).map_err(|error| pem_error(file, "private key", &error))
}

/// Largest file of revocation lists, bytes: some hundred thousand entries.
const MOST_REVOCATIONS: u64 = 16 << 20;

/// All certificate revocation lists of a file, at least one: PEM, or a single one in DER as CAs publish it.
pub(super) fn revocation_lists(file: &Path) -> Result<Vec<CertificateRevocationListDer<'static>>, PemError> {
    const EXPECTED: &str = "CRL";
    let mut bytes = Vec::new();
    File::open(file)
        .and_then(|open| open.take(MOST_REVOCATIONS).read_to_end(&mut bytes))
        .map_err(|error| pem_error(file, EXPECTED, &pem::Error::Io(error)))?;
    // A DER file begins with the tag of a sequence, which is no letter of PEM.
    if bytes.first() == Some(&0x30) && bytes.get(1).is_some_and(|length| *length >= 0x80) {
        return Ok(vec![bytes.into()]);
    }
    let read: Result<Vec<_>, _> = CertificateRevocationListDer::pem_slice_iter(&bytes).collect();
    let lists = read.map_err(|error| pem_error(file, EXPECTED, &error))?;
    match lists.is_empty() {
        true => Err(pem_error(file, EXPECTED, &pem::Error::NoItemsFound)),
        false => Ok(lists),
    }
}

fn pem_error(file: &Path, expected: &'static str, error: &pem::Error) -> PemError {
    let file = file.display().to_string();
    match error {
        pem::Error::Io(cause) => PemError::Unreadable {
            file,
            cause: cause.to_string(),
        },
        pem::Error::NoItemsFound => PemError::Missing { file, expected },
        cause => PemError::Invalid {
            file,
            expected,
            cause: cause.to_string(),
        },
    }
}
