//! Drives with a timeout of their own, which counts only writes: it stops their motor, with a fault or without one.

use drivegate_model::drive::Profile;
use drivegate_proto::RequestPdu;

use super::*;
use crate::orders::is_counted;

/// When the timeout of each drive began anew.
pub struct Own {
    fed: Vec<Option<Instant>>,
}

impl Own {
    pub fn new(drives: u8) -> Own {
        Own {
            fed: vec![None; usize::from(drives)],
        }
    }

    /// A drive has carried out a write, which its timeout may count.
    pub fn wrote(&mut self, profile: &Profile, machine: u8, pdu: &RequestPdu, now: Instant) {
        if is_counted(profile, pdu) {
            self.fed[usize::from(machine) - 1] = Some(now);
        }
    }

    /// How long the timeout of a motor that runs was not fed.
    fn waits(&mut self, machine: u8, runs: bool, now: Instant) -> Duration {
        let fed = &mut self.fed[usize::from(machine) - 1];
        *fed = runs.then(|| fed.unwrap_or(now));
        fed.map_or(Duration::ZERO, |fed| now - fed)
    }
}

impl World {
    /// Motors stop that were not fed in time; a drive without a fault starts with the next run command that it gets.
    pub(super) fn own_timeouts(&mut self) {
        let Some(timeout) = self.bus.line.own_timeout else {
            return;
        };
        let now = self.now;
        for machine in 1..=self.bus.line.drives {
            let drive = self.bus.wire.slaves().drive(machine).unwrap();
            let state = drive.state();
            if self.own.waits(machine, state.running, now) <= timeout {
                continue;
            }
            if self.seed.is_multiple_of(2) {
                drive.trip(1);
            } else {
                drive.command(Command {
                    run: false,
                    reverse: false,
                    reference: 0,
                });
            }
            self.promised.runs(machine, drive.state().running, now);
            self.befell(machine);
            self.note(move || format!("drive {machine} stops by its own timeout"));
        }
    }
}
