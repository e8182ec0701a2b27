//! Starts, replaces and stops the servers.

use std::sync::Arc;
use std::time::Duration;

use tokio_util::sync::CancellationToken;

use drivegate_core::plant::SharedPlant;
use drivegate_north::{NorthState, Reconfigure, Server, ServerError};

/// Time for orders in progress of a server that a reload removes, longer than any order waits for its bus; and the
/// interval of checks whether they have ended.
const RETIRE: (Duration, Duration) = (Duration::from_secs(60), Duration::from_millis(20));
/// Result of [`ServerSlot::prepare`].
#[derive(Default)]
pub(super) enum Prepared<S: Reconfigure> {
    /// The server stays unchanged.
    #[default]
    Same,
    /// The server stops.
    Stop,
    /// The server was started.
    Started(Running<S>),
    /// The server runs on with other options.
    Changed(S::Options, S::Change),
}

/// A place for a server: contains the running server and its options, or no server.
#[derive(Debug)]
pub(super) struct ServerSlot<S: Server>(Option<Running<S>>);

#[derive(Debug)]
pub(super) struct Running<S: Server> {
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
    /// The server if it is running.
    pub(super) fn server(&self) -> Option<&S> {
        self.0.as_ref().map(|running| &running.server)
    }

    /// Makes the server run as configured: unchanged options keep it running, others restart it.
    ///
    /// # Errors
    /// If the server cannot start: no such server runs afterwards.
    pub(super) async fn apply(
        &mut self,
        configured: Option<&S::Options>,
        plant: &SharedPlant,
        stats: &Arc<NorthState>,
    ) -> Result<(), ServerError> {
        if self.0.as_ref().map(|running| &running.options) == configured {
            return Ok(());
        }
        // The server stops first: its client id and files must be free before the next one uses them.
        self.stop().await;
        if let Some(options) = configured {
            self.0 = Some(Running::start(options, plant, stats).await?);
        }
        Ok(())
    }

    /// Ends rights that clients lose, when a reload is about to make the server run with the options `configured`.
    pub(super) fn end_rights(&self, configured: Option<&S::Options>) {
        if let Some(running) = self.0.as_ref().filter(|running| Some(&running.options) != configured) {
            running.server.end_rights(configured);
        }
    }

    /// Stops the server if it is running.
    pub(super) async fn stop(&mut self) {
        if let Some(running) = self.0.take() {
            running.stop().await;
        }
    }
}

impl<S: Server> Running<S> {
    async fn start(
        options: &S::Options,
        plant: &SharedPlant,
        stats: &Arc<NorthState>,
    ) -> Result<Running<S>, ServerError> {
        let cancel = CancellationToken::new();
        let server = S::start(options.clone(), plant.clone(), stats.clone(), cancel.clone()).await?;
        Ok(Running {
            options: options.clone(),
            cancel,
            server,
        })
    }

    async fn stop(self) {
        self.cancel.cancel();
        within(S::STOP_TIMEOUT, S::NAME, self.server.stopped()).await;
    }
}

impl<S: Reconfigure + Send + 'static> Running<S>
where
    S::Options: Send + Sync,
{
    /// Stops the server after the requests that clients have started, without waiting for that.
    async fn retire(mut self) {
        self.server.retire().await;
        if self.server.is_drained() {
            return self.stop().await;
        }
        tokio::spawn(async move {
            let until = tokio::time::Instant::now() + RETIRE.0;
            while !self.server.is_drained() && tokio::time::Instant::now() < until {
                tokio::time::sleep(RETIRE.1).await;
            }
            self.cancel.cancel();
        });
    }
}

impl<S: Reconfigure + Send + 'static> ServerSlot<S>
where
    S::Options: Send + Sync,
{
    /// Prepares the server to run as configured. [`ServerSlot::commit`] cannot fail after that.
    ///
    /// # Errors
    /// If the server cannot run with these options; it runs as before.
    pub(super) async fn prepare(
        &mut self,
        configured: Option<&S::Options>,
        plant: &SharedPlant,
        stats: &Arc<NorthState>,
    ) -> Result<Prepared<S>, ServerError> {
        Ok(match (&mut self.0, configured) {
            (None, None) => Prepared::Same,
            (Some(_), None) => Prepared::Stop,
            (None, Some(options)) => Prepared::Started(Running::start(options, plant, stats).await?),
            (Some(running), Some(options)) if running.options == *options => Prepared::Same,
            (Some(running), Some(options)) => {
                let change = running.server.prepare(options.clone()).await?;
                Prepared::Changed(options.clone(), change)
            }
        })
    }

    /// Makes the server run as prepared.
    pub(super) async fn commit(&mut self, prepared: Prepared<S>) {
        match (prepared, &mut self.0) {
            (Prepared::Stop, slot) => {
                if let Some(running) = slot.take() {
                    running.retire().await;
                }
            }
            (Prepared::Started(running), slot) => *slot = Some(running),
            (Prepared::Changed(options, change), Some(running)) => {
                running.server.commit(change);
                running.options = options;
            }
            (Prepared::Same | Prepared::Changed(..), _) => {}
        }
    }

    /// Restores the state of the server from before the preparation.
    pub(super) async fn abort(&mut self, prepared: Prepared<S>) {
        match (prepared, &mut self.0) {
            (Prepared::Started(running), _) => running.stop().await,
            (Prepared::Changed(_, change), Some(running)) => running.server.abort(change),
            _ => {}
        }
    }
}

/// Waits for `end`; logs a warning if that takes longer than `limit`.
pub(super) async fn within(limit: Duration, what: &str, end: impl Future<Output = ()>) {
    if tokio::time::timeout(limit, end).await.is_err() {
        tracing::warn!(target: "drivegate::daemon::server", "{what} did not stop within {limit:?}; continuing without waiting");
    }
}

#[cfg(test)]
mod tests {
    use std::cell::RefCell;
    use std::io;

    use super::*;

    thread_local! {
        /// Actions of the test server.
        static LOG: RefCell<Vec<String>> = const { RefCell::new(Vec::new()) };
    }

    fn log(text: String) {
        LOG.with_borrow_mut(|log| log.push(text));
    }

    fn logged() -> Vec<String> {
        LOG.take()
    }

    #[derive(Debug)]
    struct Recorder(CancellationToken);

    impl Server for Recorder {
        const NAME: &'static str = "test";
        type Options = &'static str;

        async fn start(
            name: Self::Options,
            _: SharedPlant,
            _: Arc<NorthState>,
            cancel: CancellationToken,
        ) -> Result<Self, ServerError> {
            log(format!("start {name}"));
            possible(name).map(|_| Recorder(cancel))
        }

        async fn stopped(self) {
            assert!(self.0.is_cancelled());
            log("stopped".to_string());
        }
    }

    impl Reconfigure for Recorder {
        type Change = &'static str;

        async fn prepare(&mut self, name: Self::Options) -> Result<Self::Change, ServerError> {
            log(format!("prepare {name}"));
            possible(name)
        }

        fn commit(&mut self, name: Self::Change) {
            log(format!("commit {name}"));
        }

        fn abort(&mut self, name: Self::Change) {
            log(format!("abort {name}"));
        }

        async fn retire(&mut self) {
            log("retired".to_string());
        }

        fn is_drained(&self) -> bool {
            true
        }
    }

    fn possible(name: &'static str) -> Result<&'static str, ServerError> {
        match name {
            "taken" => Err(ServerError::Thread(io::ErrorKind::AddrInUse.into())),
            name => Ok(name),
        }
    }

    fn world() -> (SharedPlant, Arc<NorthState>) {
        let plant = drivegate_core::plant::Plant::new("test", Duration::from_secs(1), Vec::new());
        (Arc::new(arc_swap::ArcSwap::from_pointee(plant)), Arc::default())
    }

    #[tokio::test]
    async fn a_server_is_started_compared_and_stopped() {
        let (plant, stats) = world();
        let mut slot = ServerSlot::<Recorder>::default();
        for (configured, succeeds, runs, expected) in [
            (None, true, false, &[][..]),
            (Some("a"), true, true, &["start a"]),
            (Some("a"), true, true, &[]),
            (Some("b"), true, true, &["stopped", "start b"]),
            (Some("taken"), false, false, &["stopped", "start taken"]),
            (Some("b"), true, true, &["start b"]),
            (None, true, false, &["stopped"]),
        ] {
            let applied = slot.apply(configured.as_ref(), &plant, &stats).await;
            let state = (applied.is_ok(), slot.server().is_some());
            assert_eq!(state, (succeeds, runs), "{configured:?}");
            assert_eq!(logged(), expected, "{configured:?}");
        }
    }

    #[tokio::test]
    async fn a_running_server_changes_in_two_steps() {
        let (plant, stats) = world();
        let mut slot = ServerSlot::<Recorder>::default();
        for (configured, commit, expected, runs) in [
            (Some("a"), false, &["start a", "stopped"][..], None),
            (Some("a"), true, &["start a"], Some("a")),
            (Some("a"), true, &[], Some("a")),
            (Some("b"), false, &["prepare b", "abort b"], Some("a")),
            (Some("taken"), true, &["prepare taken"], Some("a")),
            (Some("b"), true, &["prepare b", "commit b"], Some("b")),
            (None, false, &[], Some("b")),
            (None, true, &["retired", "stopped"], None),
            (Some("taken"), true, &["start taken"], None),
        ] {
            match slot.prepare(configured.as_ref(), &plant, &stats).await {
                Ok(prepared) if commit => slot.commit(prepared).await,
                Ok(prepared) => slot.abort(prepared).await,
                Err(_) => assert_eq!(configured, Some("taken")),
            }
            assert_eq!(logged(), expected, "{configured:?}");
            assert_eq!(slot.0.as_ref().map(|running| running.options), runs, "{configured:?}");
        }
    }
}
