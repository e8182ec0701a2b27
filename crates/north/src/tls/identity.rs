//! Certificate and private key of a server or a client: reads them from files and checks them.

use std::path::Path;
use std::sync::Arc;
use std::time::SystemTime;

use rustls::client::WantsClientCert;
use rustls::server::danger::ClientCertVerifier;
use rustls::{CertificateError, ClientConfig, ConfigBuilder, OtherError, ServerConfig};
use rustls_pki_types::{CertificateDer, PrivateKeyDer};

use super::certificate::{self, CertificateSummary};
use super::fault::{Problem, TlsFault, TlsFile};
use super::{pem, provider};

/// Certificate chain and key of a server or client, with the content of their files; equal while the content is.
#[derive(Debug, Clone, PartialEq)]
pub struct ServerIdentity {
    chain: Vec<CertificateDer<'static>>,
    key: Arc<PrivateKeyDer<'static>>,
}

/// An identity with warnings about it, or all faults of its files.
type Loaded = Result<(ServerIdentity, Vec<TlsFault>), Vec<TlsFault>>;

impl ServerIdentity {
    pub(super) fn new(chain: Vec<CertificateDer<'static>>, key: PrivateKeyDer<'static>) -> ServerIdentity {
        ServerIdentity {
            chain,
            key: Arc::new(key),
        }
    }

    /// Reads certificate and key of a server and checks that they match. A certificate that has expired, or soon
    /// will, is only a warning: clients will refuse it, but the drives must still be polled after a restart. A
    /// certificate that names no host is a warning as well.
    ///
    /// # Errors
    /// If certificate or key cannot be used; contains all faults.
    pub fn load(certificate: &Path, key: &Path, now: SystemTime) -> Loaded {
        let nameless = |own: CertificateSummary, file| {
            let name = own.name;
            own.names.is_empty().then_some(Problem::NoNames { name, file })
        };
        ServerIdentity::read(certificate, key, now, nameless)
    }

    /// Loads an identity like [`ServerIdentity::load`], for a client, which needs no names.
    ///
    /// # Errors
    /// If certificate or key cannot be used; contains all faults.
    pub fn load_of_client(certificate: &Path, key: &Path, now: SystemTime) -> Loaded {
        ServerIdentity::read(certificate, key, now, |_, _| None)
    }

    fn read(
        certificate: &Path,
        key: &Path,
        now: SystemTime,
        further: impl FnOnce(CertificateSummary, String) -> Option<Problem>,
    ) -> Loaded {
        let mut errors = Vec::new();
        let chain = pem::certificates(certificate).map_err(|why| errors.push(TlsFile::Certificate.fault(why)));
        let key = pem::private_key(key).map_err(|why| errors.push(TlsFile::Key.fault(why)));
        let (Ok(chain), Ok(key)) = (chain, key) else {
            return Err(errors);
        };
        let own = chain
            .first()
            .map(|own| certificate::problems(certificate, own, now, further));
        let warnings = own.into_iter().flatten();
        let warnings = warnings.map(|why| TlsFile::Certificate.fault(why)).collect();
        let identity = ServerIdentity::new(chain, key);
        match identity.server_config(None) {
            Ok(_) => Ok((identity, warnings)),
            Err(fault) => Err(vec![fault]),
        }
    }

    /// The configuration for rustls; with a verifier, clients must present certificates.
    ///
    /// # Errors
    /// If certificate and key cannot be used.
    pub fn server_config(&self, clients: Option<Arc<dyn ClientCertVerifier>>) -> Result<ServerConfig, TlsFault> {
        let builder = ServerConfig::builder_with_provider(provider())
            .with_safe_default_protocol_versions()
            .map_err(|error| self.unusable(&error))?;
        let builder = match clients {
            Some(verifier) => builder.with_client_cert_verifier(verifier),
            None => builder.with_no_client_auth(),
        };
        builder
            .with_single_cert(self.chain.clone(), self.key.clone_key())
            .map_err(|error| self.unusable(&error))
    }

    /// The configuration of a client with this identity.
    pub(super) fn client_config(
        &self,
        builder: ConfigBuilder<ClientConfig, WantsClientCert>,
    ) -> Result<ClientConfig, TlsFault> {
        builder
            .with_client_auth_cert(self.chain.clone(), self.key.clone_key())
            .map_err(|error| self.unusable(&error))
    }

    /// Why certificate and key cannot be used together.
    fn unusable(&self, error: &rustls::Error) -> TlsFault {
        let problem = |text: String| TlsFile::Certificate.fault(Problem::Unusable(text));
        let own = self.chain.first().and_then(|own| certificate::read(own).ok());
        let Some(CertificateSummary { name, is_old, key, .. }) = own else {
            return problem(error.to_string());
        };
        match error {
            rustls::Error::InconsistentKeys(_) => TlsFile::Key.fault(Problem::KeyMismatch),
            _ if is_old => TlsFile::Certificate.fault(Problem::OldVersion { name }),
            _ if !key.signs => TlsFile::Certificate.fault(Problem::UnsupportedKey { name, kind: key.name }),
            // The only message for a key that cannot be read.
            rustls::Error::General(_) => TlsFile::Key.fault(Problem::UnknownKey),
            rustls::Error::InvalidCertificate(CertificateError::Other(OtherError(cause))) => problem(cause.to_string()),
            error => problem(error.to_string()),
        }
    }
}
