//! Starts, changes and stops the servers of the gateway.

use super::Daemon;
use super::server::Prepared;
use crate::config::Settings;
use drivegate_north::{ServerError, bacnet, modbus_tcp, slot};

/// The servers that listen on the network, prepared.
#[derive(Default)]
pub(super) struct PreparedServers {
    modbus_tcp: Prepared<modbus_tcp::Server>,
    slots: Prepared<slot::Server>,
    bacnet: Prepared<bacnet::Server>,
    http: Prepared<drivegate_http::Http>,
}

impl Daemon {
    /// Prepares the servers that listen on the network: either all of them or none.
    pub(super) async fn prepare_servers(&mut self, settings: &Settings) -> Result<PreparedServers, ServerError> {
        let mut prepared = PreparedServers::default();
        match self.prepare_each(settings, &mut prepared).await {
            Ok(()) => Ok(prepared),
            Err(error) => {
                self.abort_servers(prepared).await;
                Err(error)
            }
        }
    }

    async fn prepare_each(&mut self, settings: &Settings, prepared: &mut PreparedServers) -> Result<(), ServerError> {
        let (plant, stats) = (&self.plant, &self.north);
        let modbus_tcp = settings.modbus_tcp.as_ref();
        prepared.modbus_tcp = self.modbus_tcp.prepare(modbus_tcp, plant, stats).await?;
        prepared.slots = self.slots.prepare(settings.slots.as_ref(), plant, stats).await?;
        prepared.bacnet = self.bacnet.prepare(settings.bacnet.as_ref(), plant, stats).await?;
        prepared.http = self.http.prepare(settings.http.as_ref(), plant, stats).await?;
        Ok(())
    }

    pub(super) async fn abort_servers(&mut self, prepared: PreparedServers) {
        self.modbus_tcp.abort(prepared.modbus_tcp).await;
        self.slots.abort(prepared.slots).await;
        self.bacnet.abort(prepared.bacnet).await;
        self.http.abort(prepared.http).await;
    }

    pub(super) async fn commit_servers(&mut self, prepared: PreparedServers) {
        self.modbus_tcp.commit(prepared.modbus_tcp).await;
        self.slots.commit(prepared.slots).await;
        self.bacnet.commit(prepared.bacnet).await;
        self.http.commit(prepared.http).await;
    }

    /// Starts, replaces or stops the MQTT client. If it cannot start, the gateway runs without it, and the next reload tries
    /// again.
    pub(super) async fn apply_mqtt(&mut self, settings: &Settings) {
        // The name of the gateway is part of all topics.
        if settings.gateway != self.settings.gateway {
            self.mqtt.stop().await;
        }
        if let Err(error) = self.mqtt.apply(settings.mqtt.as_ref(), &self.plant, &self.north).await {
            tracing::error!(target: "drivegate::daemon", "{error}; the gateway runs without MQTT; reload the configuration to try again");
        }
        // Events that occurred while no client was configured are not published later.
        drivegate_mqtt::Handover::of(&self.north).discard();
    }

    /// Opens the local socket if one is configured. If it cannot be opened, the gateway runs without it, and the
    /// next reload tries again.
    pub(super) async fn apply_local(&mut self, settings: &Settings) {
        let options = self.local_options(settings);
        if let Err(error) = self.local.apply(options.as_ref(), &self.plant, &self.north).await {
            tracing::warn!(
                target: "drivegate::local",
                "{error}; `drivegate read`, `write`, `reload` and `health` cannot reach this gateway; set `socket` of [gateway], or \
                 socket = \"\" to do without"
            );
        }
    }
}
