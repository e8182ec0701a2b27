//! The interface of all servers: start, change and stop.

use std::sync::Arc;
use std::time::Duration;

use tokio_util::sync::CancellationToken;

use super::{NorthState, ServerError};
use drivegate_core::plant::SharedPlant;

/// Time limit for a server to stop.
const STOP_TIMEOUT: Duration = Duration::from_secs(2);

/// A server that the daemon runs.
#[allow(async_fn_in_trait, reason = "the daemon awaits it in its own task")]
pub trait Server: Sized + std::fmt::Debug {
    /// Name of the server in messages.
    const NAME: &'static str;
    /// Time limit for the server to stop.
    const STOP_TIMEOUT: Duration = STOP_TIMEOUT;
    /// Configuration of the server.
    type Options: Clone + PartialEq + std::fmt::Debug;

    /// Starts the server, which runs until `cancel`.
    ///
    /// # Errors
    /// If the server cannot run with these options: an address, a certificate or a thread is not available.
    async fn start(
        options: Self::Options,
        plant: SharedPlant,
        stats: Arc<NorthState>,
        cancel: CancellationToken,
    ) -> Result<Self, ServerError>;

    /// Notes that a reload is about to replace this server by one with the options `next`, or by none: rights that
    /// clients would not have under the new options end now.
    fn end_rights(&self, _next: Option<&Self::Options>) {}

    /// Waits until the cancelled server has stopped.
    async fn stopped(self);
}

/// A server that applies new options while it runs, in two steps.
#[allow(async_fn_in_trait, reason = "the daemon awaits it in its own task")]
pub trait Reconfigure: Server {
    /// A prepared change of the options.
    type Change;

    /// Does all that can fail; changes nothing for any client.
    ///
    /// # Errors
    /// If the server cannot run with these options; it continues with the old ones.
    async fn prepare(&mut self, options: Self::Options) -> Result<Self::Change, ServerError>;

    /// Applies a prepared change.
    fn commit(&mut self, change: Self::Change);

    /// Discards a prepared change.
    fn abort(&mut self, change: Self::Change);

    /// Accepts no more requests; requests in progress complete.
    async fn retire(&mut self);

    /// Whether, after the server stopped accepting clients, all requests are completed and all clients have disconnected.
    fn is_drained(&self) -> bool;
}
