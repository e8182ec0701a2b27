//! Starts, changes and stops the servers of the gateway.

use std::sync::Arc;

use super::Daemon;
use super::server::{Prepared, ServerSlot};
use crate::config::Settings;
use drivegate_core::plant::SharedPlant;
use drivegate_north::{NorthState, ServerError, bacnet, modbus_tcp, slot};

/// Declares the servers that listen on the network, each by the name of its settings, in the order in which they are
/// prepared and committed.
macro_rules! listening_servers {
    ($($name:ident: $server:ty,)*) => {
        /// The servers that listen on the network.
        #[derive(Debug, Default)]
        pub(super) struct ListeningServers {
            $(pub(super) $name: ServerSlot<$server>,)*
        }

        /// What a reload has prepared for the servers that listen on the network.
        #[derive(Default)]
        pub(super) struct PreparedServers {
            $($name: Prepared<$server>,)*
        }

        impl ListeningServers {
            async fn prepare_each(
                &mut self,
                settings: &Settings,
                (plant, north): (&SharedPlant, &Arc<NorthState>),
                prepared: &mut PreparedServers,
            ) -> Result<(), ServerError> {
                $(prepared.$name = self.$name.prepare(settings.$name.as_ref(), plant, north).await?;)*
                Ok(())
            }

            async fn abort(&mut self, prepared: PreparedServers) {
                $(self.$name.abort(prepared.$name).await;)*
            }

            /// Makes the servers run as prepared.
            pub(super) async fn commit(&mut self, prepared: PreparedServers) {
                $(self.$name.commit(prepared.$name).await;)*
            }
        }
    };
}

listening_servers! {
    modbus_tcp: modbus_tcp::Server,
    slots: slot::Server,
    bacnet: bacnet::Server,
    http: drivegate_http::Http,
}

impl Daemon {
    /// Prepares the servers that listen on the network: either all of them or none.
    pub(super) async fn prepare_servers(&mut self, settings: &Settings) -> Result<PreparedServers, ServerError> {
        let mut prepared = PreparedServers::default();
        let common = (&self.plant, &self.north);
        match self.listening.prepare_each(settings, common, &mut prepared).await {
            Ok(()) => Ok(prepared),
            Err(error) => {
                self.listening.abort(prepared).await;
                Err(error)
            }
        }
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
