//! A command without a gateway obeys what the gateway left on disk to forbid starts. These files stay as they are: the
//! command knows only one drive, and the gateway needs them for all.

use std::time::{Instant, SystemTime};

use super::Daemon;
use crate::config::{Settings, WithoutGateway};
use drivegate_core::files::State as _;
use drivegate_core::files::names::RESERVATIONS;
use drivegate_core::permit::KeptReservations;
use drivegate_north::bacnet;

impl Daemon {
    /// Takes up the reservations and BACnet priorities that an earlier run left. While a file of them cannot be read, no
    /// motor is started.
    pub(super) async fn obey_files(&self, settings: &Settings, rest: &WithoutGateway) {
        if settings.authority.is_some() {
            self.obey_reservations(settings).await;
        }
        if let Some(options) = rest.bacnet.as_ref().filter(|options| options.keep_priorities) {
            bacnet::obey_kept_slots(&self.north, options, &self.plant).await;
        }
    }

    async fn obey_reservations(&self, settings: &Settings) {
        let path = settings.state_dir.join(RESERVATIONS);
        let awaited = &self.north.awaited.reservations;
        awaited.begin(path.clone());
        let reading = self.north.patience.read(move || KeptReservations::load(&path));
        if let Ok(Ok(found)) = reading.await {
            let KeptReservations(kept) = found.unwrap_or_default();
            let plant = self.plant.load();
            plant.restore_reservations(&kept, Instant::now(), SystemTime::now());
            awaited.end();
        }
    }
}
