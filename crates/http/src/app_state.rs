//! The state shared by all handlers.

use std::sync::Arc;

use axum::http::StatusCode;
use tokio::sync::{Semaphore, SemaphorePermit};
use tokio_util::sync::CancellationToken;

use super::limits::{MAX_LISTENERS, MAX_LISTENERS_PER_ADDRESS};
use super::operating::cookies::Cookies;
use super::operating::state::Operating;
use super::reached::Reached;
use super::replies::{Replied, no_drive};
use drivegate_core::plant::{DriveHandle, SharedPlant};
use drivegate_north::NorthState;
use drivegate_north::connection_limit::{ConnectionLimit, Limits};

/// The state shared by all handlers.
#[derive(Debug)]
pub(super) struct AppState {
    pub(super) plant: SharedPlant,
    pub(super) north: Arc<NorthState>,
    pub(super) cancel: CancellationToken,
    /// Open event streams.
    pub(super) listeners: Arc<ConnectionLimit>,
    /// Large replies are created one at a time: a client that requests them continuously shares the turns with all
    /// others, and `/healthz` is not delayed.
    rendering: Semaphore,
    /// The permit for reading a recording: what waits for the disk holds up nothing else.
    files: Semaphore,
    pub(super) operating: Arc<Operating>,
}

impl AppState {
    pub(super) fn new(
        plant: SharedPlant,
        north: Arc<NorthState>,
        operating: Arc<Operating>,
        cancel: CancellationToken,
    ) -> AppState {
        AppState {
            plant,
            north,
            cancel,
            listeners: ConnectionLimit::new(Limits::new(MAX_LISTENERS, MAX_LISTENERS_PER_ADDRESS)),
            rendering: Semaphore::new(1),
            files: Semaphore::new(1),
            operating,
        }
    }

    /// A turn to render a large reply.
    pub(super) async fn turn(&self) -> Option<SemaphorePermit<'_>> {
        self.rendering.acquire().await.ok()
    }

    /// Reads files with `read`, away from the tasks of other clients, one reader at a time.
    ///
    /// # Errors
    /// Reply 503 if the gateway is shutting down.
    pub(super) async fn read_files<T: Send + 'static>(&self, read: impl FnOnce() -> T + Send + 'static) -> Replied<T> {
        let unavailable = StatusCode::SERVICE_UNAVAILABLE;
        let _permit = self.files.acquire().await.map_err(|_| unavailable)?;
        Ok(tokio::task::spawn_blocking(read).await.map_err(|_| unavailable)?)
    }

    /// The cookies of this gateway for a connection of this kind (with or without TLS).
    pub(super) fn cookies(&self, reached: &Reached) -> Cookies {
        Cookies::of(&self.plant.load().gateway, reached.tls)
    }

    /// The drive with this name.
    ///
    /// # Errors
    /// If no drive has this name: contains the reply.
    pub(super) fn drive(&self, name: &str) -> Replied<DriveHandle> {
        let plant = self.plant.load();
        plant.drive(name).ok_or_else(|| no_drive(&plant, name))
    }
}
