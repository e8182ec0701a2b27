//! Discovery: Who-Is and Who-Has (clauses 16.9, 16.10).

use std::sync::Arc;
use std::time::Instant;

use super::{Application, Delivery, Server, Source, Target, To};
use crate::apdu::{self, MAX_APDU};
use crate::encoding::Writer;
use crate::object::Device;
use crate::services::{self, Range, Sought, unconfirmed};

impl Server {
    pub(super) fn unconfirmed(
        &mut self,
        source: Source,
        target: Target,
        service: u8,
        data: &[u8],
        app: &dyn Application,
        now: Instant,
    ) {
        match service {
            unconfirmed::WHO_IS => match services::who_is(data) {
                Ok(range) => self.who_is(source, target, range, app, now),
                Err(_) => self.counters.discarded += 1,
            },
            unconfirmed::WHO_HAS => match services::who_has(data) {
                Ok((range, sought)) => self.who_has(source, target, range, &sought, app, now),
                Err(_) => self.counters.discarded += 1,
            },
            // The clock is the host's; announcements of other devices are not needed.
            unconfirmed::TIME_SYNCHRONIZATION | unconfirmed::UTC_TIME_SYNCHRONIZATION => {}
            _ => {}
        }
    }

    /// The devices to which a request is addressed, without those that do not answer.
    fn asked(&self, target: Target, range: Range, app: &dyn Application) -> Vec<Arc<Device>> {
        let (low, high) = range.0.unwrap_or((0, u32::MAX));
        let in_range = self.by_instance.range(low..=high).map(|(_, place)| *place);
        let devices = in_range.filter(|place| match target {
            Target::Own => *place == 0,
            Target::All => true,
            Target::Network => *place != 0,
            Target::Device(one) => *place == one,
        });
        let devices = devices.filter_map(|place| self.devices.get(place));
        devices.filter(|device| app.answers(device.instance)).cloned().collect()
    }

    fn who_is(&mut self, source: Source, target: Target, range: Range, app: &dyn Application, now: Instant) {
        if !self.has_room(source) {
            return;
        }
        for device in self.asked(target, range, app) {
            let apdu = self.i_am(&device);
            self.answer_source(source, device.instance, &apdu, now);
        }
    }

    fn who_has(
        &mut self,
        source: Source,
        target: Target,
        range: Range,
        sought: &Sought,
        app: &dyn Application,
        now: Instant,
    ) {
        if !self.has_room(source) {
            return;
        }
        for device in self.asked(target, range, app) {
            let found = match sought {
                Sought::Object(id) => device.object_list().find(|own| own == id),
                Sought::Name(name) => device.named(name),
            };
            let Some(id) = found else { continue };
            let mut content = Writer::default();
            content.object(device.id()).object(id);
            match device.find(id).and_then(|place| device.objects().get(place)) {
                Some(object) => content.text(&object.name),
                None if id == device.id() => content.text(&device.name),
                None => content.text(crate::object::PORT_NAME),
            };
            let apdu = apdu::unconfirmed(unconfirmed::I_HAVE, content.bytes());
            self.answer_source(source, device.instance, &apdu, now);
        }
    }

    fn has_room(&self, source: Source) -> bool {
        self.traffic.has_room(match source.way {
            Delivery::Unicast => To::Host(source.address.host),
            Delivery::Broadcast => To::Broadcast,
        })
    }

    /// Sends the answer to the sender of the question.
    fn answer_source(&mut self, source: Source, device: u32, apdu: &[u8], now: Instant) {
        match source.way {
            Delivery::Unicast => self.send(source.address, device, apdu, now),
            Delivery::Broadcast => {
                let network = source.address.remote.map(|(network, _)| network);
                self.send_to_all(device, network, apdu, now);
            }
        }
    }

    fn i_am(&self, device: &Device) -> Vec<u8> {
        let mut content = Writer::default();
        content.object(device.id()).unsigned(MAX_APDU as u64);
        // The value means: segmented transmit.
        content.enumerated(1).unsigned(self.environment.vendor.into());
        apdu::unconfirmed(unconfirmed::I_AM, content.bytes())
    }

    /// Sends I-Am for a device without a Who-Is.
    pub fn announce(&mut self, device: u32, app: &dyn Application, now: Instant) {
        let Some(known) = self.device(device).filter(|_| app.answers(device)) else {
            return;
        };
        if !self.quiet.contains_key(&device) {
            let apdu = self.i_am(&known);
            self.send_to_all(device, None, &apdu, now);
        }
    }
}
