//! Reads certificates and keys from PEM files.

use std::path::Path;

use rustls_pki_types::pem::{self, PemObject};
use rustls_pki_types::{CertificateDer, PrivateKeyDer};

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
