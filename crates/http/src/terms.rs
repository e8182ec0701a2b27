//! The terms shared by the connections of a listener: access, certificates, and the end of both.

use std::sync::Arc;

use arc_swap::ArcSwap;
use tokio_rustls::TlsAcceptor;
use tokio_util::sync::CancellationToken;

use super::access::Access;
use super::hosts::Hosts;
use super::options::Options;
use drivegate_north::{ServerError, ServerKind};

/// The present terms of the server; a reload can replace them.
#[derive(Debug)]
pub struct Terms {
    pub(super) access: Arc<Access>,
    pub(super) tls: Option<Tls>,
    /// Cancelled when a reload has replaced these terms.
    pub(super) replaced: CancellationToken,
}

#[derive(Clone)]
pub(super) struct Tls(pub(super) TlsAcceptor);

impl std::fmt::Debug for Tls {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Tls")
    }
}

impl Terms {
    /// The terms that follow from the configuration.
    ///
    /// # Errors
    /// If the certificates cannot be used.
    pub(super) fn new(options: &Options) -> Result<Terms, ServerError> {
        let tls = options.identity.as_ref().map(|identity| {
            let mut config = identity.server_config(None)?;
            config.alpn_protocols = vec![b"http/1.1".to_vec()];
            Ok(Tls(TlsAcceptor::from(Arc::new(config))))
        });
        let name = rustix::system::uname();
        Ok(Terms {
            access: Arc::new(Access {
                hosts: Hosts::new(&name.nodename().to_string_lossy(), &options.hosts),
                tokens: options.tokens.clone(),
            }),
            tls: tls
                .transpose()
                .map_err(|fault| ServerError::Tls(ServerKind::Http.title(), fault))?,
            replaced: CancellationToken::new(),
        })
    }
    /// Replaces `current` by these terms. The connections of `current` end if hosts or tokens have changed.
    pub(super) fn replace(mut self, current: &ArcSwap<Terms>) {
        let old = current.load_full();
        if old.access == self.access {
            self.replaced = old.replaced.clone();
            current.store(Arc::new(self));
        } else {
            current.store(Arc::new(self));
            old.replaced.cancel();
        }
    }
}
