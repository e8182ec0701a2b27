//! Commands of local clients that concern the gateway itself and not a drive.

use std::path::{Path, PathBuf};

use tokio::sync::{mpsc, oneshot};

use crate::messages::ReloadOutcome;

/// Maximum number of waiting commands; no more than this many clients can exist.
const WAITING: usize = super::MAX_CLIENTS;

/// A request to reload the configuration.
#[derive(Debug)]
pub struct ReloadOrder {
    pub who: String,
    /// Receives the outcome of the reload.
    pub answer: oneshot::Sender<ReloadOutcome>,
}

/// The connection from the local socket to its gateway.
#[derive(Debug, Clone)]
pub struct Control {
    config: PathBuf,
    orders: mpsc::Sender<ReloadOrder>,
}

impl PartialEq for Control {
    fn eq(&self, other: &Control) -> bool {
        self.config == other.config && self.orders.same_channel(&other.orders)
    }
}

impl Control {
    /// Creates the control for a gateway with the configuration file `config`, and the receiver of its commands.
    pub fn new(config: &Path) -> (Control, mpsc::Receiver<ReloadOrder>) {
        let (orders, arrive) = mpsc::channel(WAITING);
        let config = absolute(config);
        (Control { config, orders }, arrive)
    }

    /// Configuration file, as [`absolute`] names it.
    pub(crate) fn config(&self) -> &Path {
        &self.config
    }
}

/// The absolute path of a configuration file, whatever directory or link it is named by.
pub fn absolute(config: &Path) -> PathBuf {
    let found = config.canonicalize().or_else(|_| std::path::absolute(config));
    found.unwrap_or_else(|_| config.to_path_buf())
}

/// Makes the gateway read its configuration again, and waits for the outcome.
///
/// # Errors
/// If the gateway has no configuration file, or is shutting down.
pub(crate) async fn reload(control: Option<&Control>, who: String) -> Result<ReloadOutcome, String> {
    let stops = || "the gateway is shutting down and no longer reads its configuration".to_string();
    let control = control.ok_or("the gateway has no configuration file to reload")?;
    let (answer, outcome) = oneshot::channel();
    let order = ReloadOrder { who, answer };
    control.orders.send(order).await.map_err(|_| stops())?;
    outcome.await.map_err(|_| stops())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn every_order_is_answered() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("drivegate.toml");
        std::fs::write(&file, "").unwrap();
        let link = folder.path().join("link.toml");
        std::os::unix::fs::symlink(&file, &link).unwrap();
        let (control, mut orders) = Control::new(&link);
        assert_eq!(control.config(), absolute(&file), "whatever it is called");
        let who = || "uid 0".to_string();
        assert!(reload(None, who()).await.is_err());
        let (outcome, ()) = tokio::join!(reload(Some(&control), who()), async {
            let order = orders.recv().await.unwrap();
            assert_eq!(order.who, "uid 0");
            order.answer.send(ReloadOutcome::default()).unwrap();
        });
        assert_eq!(outcome.unwrap(), ReloadOutcome::default());
        let (outcome, ()) = tokio::join!(reload(Some(&control), who()), async {
            drop(orders.recv().await);
        });
        assert!(outcome.unwrap_err().contains("the gateway is shutting down"));
    }
}
