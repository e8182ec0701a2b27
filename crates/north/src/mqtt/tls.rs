//! TLS towards the broker.

use std::sync::Arc;

use rustls::ClientConfig;

use super::Options;
use crate::identity::{self, RootsError, provider};
use crate::pem::{self, PemError};

/// Why TLS towards the broker cannot be set up, and what to do.
#[derive(Debug, thiserror::Error)]
pub(super) enum TlsConfigError {
    #[error(transparent)]
    Pem(#[from] PemError),
    #[error(transparent)]
    Roots(#[from] RootsError),
    #[error("{file}: certificate and key cannot be used: {cause}")]
    UnusableIdentity { file: String, cause: rustls::Error },
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
    let builder = ClientConfig::builder_with_provider(provider())
        .with_safe_default_protocol_versions()
        .map_err(TlsConfigError::Protocol)?
        .with_root_certificates(identity::roots(options.ca.as_deref())?);
    let config = match &options.identity {
        None => builder.with_no_client_auth(),
        Some((certificate, key)) => builder
            .with_client_auth_cert(pem::certificates(certificate)?, pem::private_key(key)?)
            .map_err(|cause| TlsConfigError::UnusableIdentity {
                file: certificate.display().to_string(),
                cause,
            })?,
    };
    Ok(Some(Arc::new(config)))
}
