//! TLS towards the broker.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use rustls::{ClientConfig, RootCertStore};

use super::Options;
use crate::north::pem::{self, PemError};

/// Why TLS towards the broker cannot be set up, and what to do.
#[derive(Debug, thiserror::Error)]
pub(super) enum TlsConfigError {
    #[error(transparent)]
    Pem(#[from] PemError),
    #[error("{file}: not a usable CA certificate: {cause}")]
    UnusableCa { file: String, cause: rustls::Error },
    #[error("{file}: certificate and key cannot be used: {cause}")]
    UnusableIdentity { file: String, cause: rustls::Error },
    #[error("the system has no CA certificates; install them or set mqtt.ca")]
    NoSystemRoots,
    #[error("TLS: {0}")]
    Protocol(rustls::Error),
}

/// Reads the certificates and keys of `options`; `None` without TLS. Blocking: it reads files.
///
/// # Errors
/// Which file is at fault, and what to do.
pub(super) fn client_config(options: &Options) -> Result<Option<Arc<ClientConfig>>, TlsConfigError> {
    if !options.tls {
        return Ok(None);
    }
    let config = with_identity(options.identity.as_ref(), roots(options.ca.as_deref())?)?;
    Ok(Some(Arc::new(config)))
}

fn with_identity(identity: Option<&(PathBuf, PathBuf)>, roots: RootCertStore) -> Result<ClientConfig, TlsConfigError> {
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let builder = ClientConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .map_err(TlsConfigError::Protocol)?
        .with_root_certificates(roots);
    let Some((certificate, key)) = identity else {
        return Ok(builder.with_no_client_auth());
    };
    builder
        .with_client_auth_cert(pem::certificates(certificate)?, pem::private_key(key)?)
        .map_err(|cause| TlsConfigError::UnusableIdentity {
            file: certificate.display().to_string(),
            cause,
        })
}

/// Why a certificate cannot be used with a key, such as that of another certificate. Files that cannot be read are no
/// fault here. Blocking: it reads files.
pub(crate) fn identity_fault(identity: &(PathBuf, PathBuf)) -> Option<String> {
    match with_identity(Some(identity), RootCertStore::empty()) {
        Err(fault @ TlsConfigError::UnusableIdentity { .. }) => Some(fault.to_string()),
        _ => None,
    }
}

fn roots(ca: Option<&Path>) -> Result<RootCertStore, TlsConfigError> {
    let mut store = RootCertStore::empty();
    match ca {
        Some(file) => {
            for certificate in pem::certificates(file)? {
                store.add(certificate).map_err(|cause| TlsConfigError::UnusableCa {
                    file: file.display().to_string(),
                    cause,
                })?;
            }
        }
        None => {
            // One certificate of the system that rustls cannot parse must not disable TLS.
            store.add_parsable_certificates(rustls_native_certs::load_native_certs().certs);
            if store.is_empty() {
                return Err(TlsConfigError::NoSystemRoots);
            }
        }
    }
    Ok(store)
}
