//! Slots of BACnet's arrays whose client has lost its right to write, by a reload or before a start: they are void.

use std::time::SystemTime;

use super::BusHandle;
use crate::command::{Commanded, Entry, Mode, Rules, VoidSlot};
use crate::event::{Event, EventKind, Events};
use crate::process_image::{Access, DriveImage};

impl BusHandle {
    /// Empties the slots of its drives whose client may no longer write, and publishes an event for each: such a slot
    /// could not be released any more. Without `events` nobody is told: another bus has the drives now. Nothing is written to
    /// a drive.
    pub fn void_slots(&self, events: Option<&Events>, time: SystemTime) {
        for (index, image) in self.image.drives.enumerate() {
            let mut queue = self.queue.lock();
            let rules = queue.rules().filter(|rules| rules.mode == Mode::Exclusive).cloned();
            let stays = |what: Commanded, entry: &Entry| {
                // Who is no principal may stop, and so release an inactive.
                let is_stop = what == Commanded::Run && !entry.value.as_bool();
                let is_known = |rules: &Rules| rules.claim_of(&entry.origin).is_some();
                image.spec.access == Access::Control
                    && entry.origin.right().allows(&self.image.spec.name)
                    && (is_stop || rules.as_deref().is_none_or(is_known))
            };
            let void = queue.priorities(index).end_without_right(stays);
            drop(queue);
            if void.is_empty() {
                continue;
            }
            if let Some(events) = events {
                void.iter()
                    .for_each(|slot| events.publish(self.void_event(image, slot, time)));
            }
            // Whoever shows the drive shows its slots.
            image.update(|_| {});
        }
    }

    fn void_event(&self, image: &DriveImage, slot: &VoidSlot, time: SystemTime) -> Event {
        let (drive, bus) = (&image.spec.name, &self.image.spec.name);
        let (who, point, priority) = (&slot.entry.origin.who, slot.what.point().name(), slot.priority);
        let value = slot.entry.value;
        let text = format!(
            "BACnet client {who} may no longer write to drive {drive}: its `{point}` = {value} at priority {priority} is \
             void; nothing was written to the drive"
        );
        Event {
            bus: bus.clone(),
            drive: Some(drive.clone()),
            ..Event::new(EventKind::SlotVoid, time, text)
        }
    }
}
