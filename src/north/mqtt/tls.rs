//! TLS towards the broker.

use std::path::Path;
use std::sync::Arc;

use rustls::{ClientConfig, RootCertStore};
use rustls_pki_types::pem::PemObject;
use rustls_pki_types::{CertificateDer, PrivateKeyDer};

use super::Options;

/// Reads the certificates and keys of `options`; `None` without TLS. Blocking: it reads files.
///
/// # Errors
/// What is wrong with which file, and what to do.
pub(super) fn client_config(options: &Options) -> Result<Option<Arc<ClientConfig>>, String> {
    if !options.tls {
        return Ok(None);
    }
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let builder = ClientConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .map_err(|e| format!("TLS: {e}"))?
        .with_root_certificates(roots(options.ca.as_deref())?);
    let config = match &options.identity {
        None => builder.with_no_client_auth(),
        Some((certificate, key)) => {
            let chain = certificates(certificate)?;
            let key = PrivateKeyDer::from_pem_file(key)
                .map_err(|e| format!("{}: no private key can be read: {e}; give a PEM file", key.display()))?;
            builder
                .with_client_auth_cert(chain, key)
                .map_err(|e| format!("{}: certificate and key cannot be used: {e}", certificate.display()))?
        }
    };
    Ok(Some(Arc::new(config)))
}

fn roots(ca: Option<&Path>) -> Result<RootCertStore, String> {
    let mut store = RootCertStore::empty();
    match ca {
        Some(file) => {
            for certificate in certificates(file)? {
                store
                    .add(certificate)
                    .map_err(|e| format!("{}: not a usable CA certificate: {e}", file.display()))?;
            }
        }
        None => {
            // One odd certificate in the system's store must not cut off the broker.
            store.add_parsable_certificates(rustls_native_certs::load_native_certs().certs);
            if store.is_empty() {
                return Err("the system has no CA certificates; install them or set mqtt.ca".to_string());
            }
        }
    }
    Ok(store)
}

fn certificates(file: &Path) -> Result<Vec<CertificateDer<'static>>, String> {
    let bad = |e: rustls_pki_types::pem::Error| {
        format!("{}: no certificate can be read: {e}; give a PEM file", file.display())
    };
    let found: Vec<_> = CertificateDer::pem_file_iter(file)
        .map_err(bad)?
        .collect::<Result<_, _>>()
        .map_err(bad)?;
    if found.is_empty() {
        return Err(format!("{}: holds no certificate; give a PEM file", file.display()));
    }
    Ok(found)
}
