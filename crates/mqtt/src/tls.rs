//! TLS towards the broker.

use std::sync::Arc;

use rustls::ClientConfig;

use super::Options;
use drivegate_north::identity::{self, IdentityFault, RootsError};
use drivegate_north::pem::{self, PemError};

/// Why TLS to the broker cannot be set up, and the remedy.
#[derive(Debug, thiserror::Error)]
pub(super) enum TlsConfigError {
    #[error(transparent)]
    Pem(#[from] PemError),
    #[error(transparent)]
    Roots(#[from] RootsError),
    #[error("{file}: {cause}")]
    UnusableIdentity { file: String, cause: Box<IdentityFault> },
}

/// Reads the certificates and keys of `options`; `None` without TLS. Blocking, because it reads files.
///
/// # Errors
/// If a file is not usable: contains the file and the remedy.
pub(super) fn client_config(options: &Options) -> Result<Option<Arc<ClientConfig>>, TlsConfigError> {
    if !options.tls {
        return Ok(None);
    }
    let builder = identity::client_builder(options.ca.as_deref())?;
    let config = match &options.identity {
        None => builder.with_no_client_auth(),
        Some((certificate, key)) => {
            let chain = pem::certificates(certificate)?;
            builder
                .with_client_auth_cert(chain.clone(), pem::private_key(key)?)
                .map_err(|cause| TlsConfigError::UnusableIdentity {
                    file: certificate.display().to_string(),
                    cause: Box::new(identity::unusable(&cause, &chain)),
                })?
        }
    };
    Ok(Some(Arc::new(config)))
}
