//! Starts, replaces and stops the servers.

use std::sync::Arc;
use std::time::Duration;

use tokio_util::sync::CancellationToken;

use crate::north::{NorthStats, ServerError, http, local, modbus_tcp, mqtt};
use crate::plant::SharedPlant;

/// Time limit for a server to stop.
const STOP_TIMEOUT: Duration = Duration::from_secs(2);

/// A server that the daemon runs.
pub(super) trait Server: Sized + std::fmt::Debug {
    /// Name in messages.
    const NAME: &'static str;
    /// What it is configured by.
    type Options: Clone + PartialEq + std::fmt::Debug;

    /// Starts it; it runs until `cancel`.
    async fn start(
        options: Self::Options,
        plant: SharedPlant,
        stats: Arc<NorthStats>,
        cancel: CancellationToken,
    ) -> Result<Self, ServerError>;

    /// Applies new options to the running server; false if it must be restarted for them.
    fn update(&self, _old: &Self::Options, _new: &Self::Options) -> Result<bool, ServerError> {
        Ok(false)
    }

    /// Waits until it has stopped, after the cancellation.
    async fn stopped(self);
}

/// A server that runs with some options, or none.
#[derive(Debug)]
pub(super) struct ServerSlot<S: Server>(Option<Running<S>>);

#[derive(Debug)]
struct Running<S: Server> {
    options: S::Options,
    cancel: CancellationToken,
    server: S,
}

impl<S: Server> Default for ServerSlot<S> {
    fn default() -> ServerSlot<S> {
        ServerSlot(None)
    }
}

impl<S: Server> ServerSlot<S> {
    /// The server, if it runs.
    pub(super) fn server(&self) -> Option<&S> {
        self.0.as_ref().map(|running| &running.server)
    }

    /// Makes the server run as configured: unchanged options leave it alone, others are applied or restart it.
    ///
    /// # Errors
    /// It does not start, and does not run afterwards; or it refuses new options and runs on with the old ones.
    pub(super) async fn apply(
        &mut self,
        configured: Option<&S::Options>,
        plant: &SharedPlant,
        stats: &Arc<NorthStats>,
    ) -> Result<(), ServerError> {
        if let (Some(running), Some(options)) = (&mut self.0, configured)
            && (running.options == *options || running.server.update(&running.options, options)?)
        {
            running.options = options.clone();
            return Ok(());
        }
        // Its addresses, client id and files are free before its successor uses them.
        self.stop().await;
        if let Some(options) = configured.cloned() {
            let cancel = CancellationToken::new();
            let server = S::start(options.clone(), plant.clone(), stats.clone(), cancel.clone()).await?;
            self.0 = Some(Running {
                options,
                cancel,
                server,
            });
        }
        Ok(())
    }

    /// Stops the server if it runs.
    pub(super) async fn stop(&mut self) {
        if let Some(Running { cancel, server, .. }) = self.0.take() {
            cancel.cancel();
            within(STOP_TIMEOUT, S::NAME, server.stopped()).await;
        }
    }
}

/// Waits for `end`; logs a warning when it takes longer than `limit`.
pub(super) async fn within(limit: Duration, what: &str, end: impl Future<Output = ()>) {
    if tokio::time::timeout(limit, end).await.is_err() {
        tracing::warn!("{what} did not stop within {limit:?}; continuing without waiting");
    }
}

impl Server for modbus_tcp::Server {
    const NAME: &'static str = "Modbus TCP";
    type Options = modbus_tcp::Options;

    async fn start(
        options: Self::Options,
        plant: SharedPlant,
        stats: Arc<NorthStats>,
        cancel: CancellationToken,
    ) -> Result<Self, ServerError> {
        modbus_tcp::start(options, plant, stats, cancel).await
    }

    fn update(&self, old: &Self::Options, new: &Self::Options) -> Result<bool, ServerError> {
        let only_certificates = new.differs_in_certificates_only(old);
        if only_certificates {
            self.renew_certificates(new)?;
            tracing::info!("Modbus TCP: using the new certificates for new connections");
        }
        Ok(only_certificates)
    }

    async fn stopped(self) {
        modbus_tcp::Server::stopped(&self).await;
    }
}

impl Server for local::Local {
    const NAME: &'static str = "the local socket";
    type Options = local::SocketPath;

    async fn start(
        options: Self::Options,
        plant: SharedPlant,
        _stats: Arc<NorthStats>,
        cancel: CancellationToken,
    ) -> Result<Self, ServerError> {
        local::start(&options, plant, cancel).await.map_err(ServerError::Local)
    }

    async fn stopped(self) {
        local::Local::stopped(self).await;
    }
}

impl Server for http::Http {
    const NAME: &'static str = "HTTP";
    type Options = http::Options;

    async fn start(
        options: Self::Options,
        plant: SharedPlant,
        stats: Arc<NorthStats>,
        cancel: CancellationToken,
    ) -> Result<Self, ServerError> {
        http::start(options, plant, stats, cancel).await
    }

    async fn stopped(self) {
        http::Http::stopped(self).await;
    }
}

impl Server for mqtt::Mqtt {
    const NAME: &'static str = "MQTT";
    type Options = mqtt::Options;

    async fn start(
        options: Self::Options,
        plant: SharedPlant,
        stats: Arc<NorthStats>,
        cancel: CancellationToken,
    ) -> Result<Self, ServerError> {
        Ok(mqtt::start(options, plant, stats, cancel))
    }

    async fn stopped(self) {
        mqtt::Mqtt::stopped(self).await;
    }
}

#[cfg(test)]
mod tests {
    use std::io;
    use std::sync::Mutex;

    use super::*;

    /// What the test server did.
    static LOG: Mutex<Vec<String>> = Mutex::new(Vec::new());

    #[derive(Debug)]
    struct Recorder(CancellationToken);

    impl Server for Recorder {
        const NAME: &'static str = "test";
        /// Name, and a part that can be applied while it runs.
        type Options = (&'static str, u8);

        async fn start(
            (name, part): Self::Options,
            _: SharedPlant,
            _: Arc<NorthStats>,
            cancel: CancellationToken,
        ) -> Result<Self, ServerError> {
            LOG.lock().unwrap().push(format!("start {name} {part}"));
            match name {
                "taken" => Err(ServerError::Thread(io::ErrorKind::AddrInUse.into())),
                _ => Ok(Recorder(cancel)),
            }
        }

        fn update(&self, old: &Self::Options, new: &Self::Options) -> Result<bool, ServerError> {
            LOG.lock().unwrap().push(format!("update {}", new.1));
            match new.1 {
                0 => Err(ServerError::Thread(io::ErrorKind::InvalidInput.into())),
                _ => Ok(old.0 == new.0),
            }
        }

        async fn stopped(self) {
            assert!(self.0.is_cancelled());
            LOG.lock().unwrap().push("stopped".to_string());
        }
    }

    #[tokio::test]
    async fn a_server_is_started_compared_and_stopped() {
        let plant = crate::plant::Plant {
            gateway: "test".to_string(),
            stale_after: Duration::from_secs(1),
            buses: Vec::new(),
            events: Default::default(),
            writes: Default::default(),
            recordings: Default::default(),
        };
        let (plant, stats): (SharedPlant, _) = (Arc::new(arc_swap::ArcSwap::from_pointee(plant)), Arc::default());
        let mut slot = ServerSlot::<Recorder>::default();
        let log = || std::mem::take(&mut *LOG.lock().unwrap());
        for (configured, succeeds, runs, expected) in [
            (None, true, false, &[][..]),
            (Some(("a", 1)), true, true, &["start a 1"]),
            (Some(("a", 1)), true, true, &[]),
            (Some(("a", 2)), true, true, &["update 2"]),
            (Some(("a", 0)), false, true, &["update 0"]),
            (Some(("a", 2)), true, true, &[]),
            (Some(("b", 2)), true, true, &["update 2", "stopped", "start b 2"]),
            (
                Some(("taken", 2)),
                false,
                false,
                &["update 2", "stopped", "start taken 2"],
            ),
            (Some(("b", 2)), true, true, &["start b 2"]),
            (None, true, false, &["stopped"]),
        ] {
            let applied = slot.apply(configured.as_ref(), &plant, &stats).await;
            assert_eq!(
                (applied.is_ok(), slot.server().is_some()),
                (succeeds, runs),
                "{configured:?}"
            );
            assert_eq!(log(), expected, "{configured:?}");
        }
    }
}
