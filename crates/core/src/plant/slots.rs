//! Voids slots of BACnet priority arrays whose client has lost its right to write, by a reload or before a start.

use std::time::SystemTime;

use super::BusHandle;
use crate::event::{Event, EventKind, Events};
use crate::order::{Commanded, Entry};
use crate::permit::{Mode, Rules, VoidSlot};
use crate::process_image::{Access, DriveImage};

impl BusHandle {
    /// Empties the slots of its drives whose client may no longer write, and publishes an event for each: no client
    /// could release such a slot any more. Without `events` nothing is published, because another bus has the
    /// drives now. Nothing is written to a drive.
    pub fn void_slots(&self, events: Option<&Events>, time: SystemTime) {
        for (index, image) in self.image.drives.enumerate() {
            let mut queue = self.queue.lock();
            let rules = queue
                .gate
                .rules()
                .filter(|rules| rules.mode == Mode::Exclusive)
                .cloned();
            let stays = |what: Commanded, entry: &Entry| {
                // A client that is not a principal may still stop, and therefore release an entry `inactive`.
                let is_stop = what == Commanded::Run && !entry.value.as_bool();
                let is_known = |rules: &Rules| rules.claim_of(&entry.origin).is_some();
                image.spec.access == Access::Control
                    && entry.origin.right().allows(&self.image.spec.name)
                    && (is_stop || rules.as_deref().is_none_or(is_known))
            };
            let void = queue.gate.priorities(index).end_without_right(stays);
            drop(queue);
            if void.is_empty() {
                continue;
            }
            if let Some(events) = events {
                void.iter()
                    .for_each(|slot| events.publish(self.void_event(image, slot, time)));
            }
            // An update of the image makes the interfaces show the slots again.
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

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicBool, Ordering};
    use std::time::{Duration, Instant};

    use super::*;
    use crate::order::{Origin, Proof, Right, SourceKind};
    use crate::permit::Principal;
    use crate::testkit::{bus, bus_spec, controlled, image, monitored, profile};
    use drivegate_model::drive::Value;

    const NOW: SystemTime = SystemTime::UNIX_EPOCH;

    /// The slots of a drive after the sweep, and the number of events about emptied ones.
    fn left(bus: &BusHandle, events: &Events) -> (Vec<(Commanded, u8)>, usize) {
        bus.void_slots(Some(events), NOW);
        let mut queue = bus.queue.lock();
        let all = &*queue.gate.priorities(drivegate_model::drive::DriveIndex::new(0));
        let stand = |what| {
            (1..=16)
                .filter(move |priority| all.entry(what, *priority).is_some())
                .map(move |p| (what, p))
        };
        let left = Commanded::ALL.into_iter().flat_map(stand).collect();
        (left, events.recent().len())
    }

    /// Enters three values of this client into the slots: `run` inactive, `run` active, and a reference.
    fn occupied(bus: &BusHandle, origin: &Origin) {
        let mut queue = bus.queue.lock();
        let all = queue.gate.priorities(drivegate_model::drive::DriveIndex::new(0));
        let mut put = |what, priority, value| {
            all.restore(what, priority, Entry::new(value, origin.clone(), Instant::now()));
        };
        put(Commanded::Run, 3, Value::Bool(false));
        put(Commanded::Run, 8, Value::Bool(true));
        put(Commanded::SpeedReference, 8, Value::Number(20.0));
    }

    #[test]
    fn a_slot_ends_with_the_right_the_access_of_its_drive_and_its_principal() {
        let all = vec![(Commanded::Run, 3), (Commanded::Run, 8), (Commanded::SpeedReference, 8)];
        let rules = |mode, name: &str| {
            let principal = Principal {
                bacnet: vec!["10.0.0.5/32".parse().unwrap()],
                ..Principal::new(name, 1)
            };
            Arc::new(Rules {
                mode,
                ranks: ["site", "plant"].map(Into::into).to_vec(),
                lease: Duration::from_secs(30),
                stop_at_local: true,
                principals: if name.is_empty() { Vec::new() } else { vec![principal] },
            })
        };
        type Case = (bool, bool, Option<Arc<Rules>>, Vec<(Commanded, u8)>);
        let table: [Case; 6] = [
            (true, true, None, all.clone()),
            (false, true, None, vec![]),
            (true, false, None, vec![]),
            (true, true, Some(rules(Mode::Exclusive, "plc")), all.clone()),
            // A client that is no longer a principal may only stop, and therefore release an entry `inactive`.
            (true, true, Some(rules(Mode::Exclusive, "")), vec![(Commanded::Run, 3)]),
            (true, true, Some(rules(Mode::Advisory, "")), all.clone()),
        ];
        for (place, (right, is_controlled, rules, expected)) in table.into_iter().enumerate() {
            let profile = profile("vacon-nx");
            let spec = if is_controlled {
                controlled("p1", "line1", 1, &profile)
            } else {
                monitored("p1", "line1", 1, &profile)
            };
            let (bus, events) = (bus(bus_spec("line1"), vec![image(spec)]), Events::of_drives(1));
            bus.queue.set_authority(rules);
            let grants = Arc::new(AtomicBool::new(true));
            let origin = Origin::new(SourceKind::Bacnet, "10.0.0.5:47808")
                .proven(Proof::Bacnet([10, 0, 0, 5].into(), 8))
                .with_right(Right::of(grants.clone()));
            occupied(&bus, &origin);
            grants.store(right, Ordering::Release);
            let told = all.len() - expected.len();
            assert_eq!(left(&bus, &events), (expected.clone(), told), "case {place}");
            grants.store(true, Ordering::Release);
            assert_eq!(
                left(&bus, &events),
                (expected, told),
                "a right that comes back revives none: case {place}"
            );
        }
    }
}
