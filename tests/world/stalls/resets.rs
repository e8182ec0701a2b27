//! Families in which a reset starts a motor that has tripped while its run command is on: the run command is taken away
//! before the reset.

use std::collections::BTreeMap;

use drivegate_core::order::written;
use drivegate_model::drive::Profile;
use drivegate_proto::RequestPdu;

/// The control word last written to each drive; a drive that was stopped by something else has none.
#[derive(Default)]
pub struct Resets(BTreeMap<u8, u16>);

impl Resets {
    /// Checks a write that a drive has carried out.
    pub fn check(&mut self, profile: &Profile, machine: u8, pdu: &RequestPdu) {
        let starts_by_reset = |control: &&drivegate_model::drive::control::Control| control.restarts_on_reset;
        let Some(control) = profile.control.as_ref().filter(starts_by_reset) else {
            return;
        };
        let (table, items) = written(pdu).unwrap_or((control.at.table, Vec::new()));
        for (address, word) in items {
            let is_at =
                |place: drivegate_model::drive::control::ControlItem| (place.table, place.address) == (table, address);
            if is_at(control.at) {
                self.0.insert(machine, word);
            }
            let reset = control.fault_reset.map(|reset| reset.setting);
            let resets = reset.is_some_and(|reset| is_at(reset.place.unwrap_or(control.at)) && reset.holds(word));
            let runs = self
                .0
                .get(&machine)
                .is_some_and(|word| control.is_run(control.at, *word));
            assert!(
                !(resets && runs),
                "a reset reaches drive {machine} while its run command is on, by which it may start: {pdu:?}"
            );
        }
    }

    /// The drive was stopped by something other than the line.
    pub fn befell(&mut self, machine: u8) {
        self.0.remove(&machine);
    }
}
