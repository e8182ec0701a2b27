//! Actions that end with a right that a reload takes away.

use std::time::SystemTime;

use super::Daemon;
use crate::config::{Settings, StateFiles};
use drivegate_http::local;
use drivegate_north::bacnet;

impl Daemon {
    /// Ends the rights that clients of the broker and of the local socket lose, before anything else changes; by
    /// then the new configuration is certain to be applied. Servers that listen on the network end rights
    /// themselves when they take their options.
    pub(super) fn end_rights(&self, settings: &Settings) {
        self.mqtt.end_rights(settings.mqtt.as_ref());
        self.local.end_rights(self.local_options(settings).as_ref());
    }

    /// Voids slots that no BACnet client may release any more, including those of drives that an earlier reload
    /// removed and a later one may bring back.
    pub(super) fn void_slots(&self) {
        let time = SystemTime::now();
        let there = self.buses.iter().map(|(_, task)| task.handle());
        there.for_each(|bus| bus.void_slots(Some(&self.events), time));
        self.parted.buses().iter().for_each(|bus| bus.void_slots(None, time));
    }

    /// Expects the slots of an earlier run, or discards them if the gateway does not save slots. Must be called before
    /// any interface accepts orders.
    pub(super) async fn expect_kept_slots(&self, settings: &Settings) {
        match (&settings.state_files, &settings.bacnet) {
            (StateFiles::Unused, _) => {}
            (StateFiles::Obeyed(rest), _) => self.obey_files(settings, rest).await,
            (StateFiles::Owned, Some(options)) if options.keep_priorities => {
                bacnet::expect_kept_slots(&self.north, &options.state_dir);
            }
            (StateFiles::Owned, _) => {
                bacnet::discard_kept_slots(&self.north, &settings.state_dir, &self.events).await;
            }
        }
    }

    pub(super) fn local_options(&self, settings: &Settings) -> Option<local::Options> {
        (settings.socket != local::SocketPath::Off).then(|| local::Options {
            socket: settings.socket.clone(),
            control: self.control.clone(),
        })
    }
}
