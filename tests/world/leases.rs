//! Leases whose drive is read through a gateway that answers one read in place of the drive (exceptions 0A and 0B).

use std::time::Duration;

use drivegate_core::event::EventKind;
use drivegate_core::process_image::{LeaseAction, Supervision};
use drivegate_model::drive::{ModelPoint, State};
use drivegate_proto::{Exception, Protocol};
use drivegate_sim::faults::FaultPlan;

use super::rig::{Rig, line};
use super::scenario::Line;

const TIMEOUT: Duration = Duration::from_secs(5);
/// Longest time from the end of a lease to its action where the drive does not show whether its motor runs: a sample
/// becomes stale, and a round of reads goes by.
const ACTS: Duration = Duration::from_millis(2_500);
/// Functions that write.
const WRITES: [u8; 4] = [5, 6, 15, 16];

#[test]
fn a_lease_acts_in_its_time_whichever_read_is_not_answered() {
    for exception in [Exception::Modbus(0x0A), Exception::Modbus(0x0B)] {
        for point in [ModelPoint::MotorCurrent, ModelPoint::Running] {
            let about = format!("{exception:?} to the read of {}", point.name());
            let mut rig = Rig::of(&Line {
                supervision: Some(Supervision {
                    timeout: TIMEOUT,
                    action: LeaseAction::Stop,
                    adopt: false,
                }),
                ..line("vacon-cx", Protocol::ModbusRtu, 19_200, 1)
            });
            rig.until_state(1, State::Ready);
            assert!(rig.set(1, &[("frequency_reference", 20.0), ("run", 1.0)]).is_ok());
            let heard = rig.bus.sim(rig.now);
            rig.until_state(1, State::Running);
            let mut events = rig.plant.events.subscribe();
            let place = rig.bus.profile.model_point(point).unwrap().raw().unwrap();
            let (table, register) = (place.table, place.address);
            rig.set_faults(FaultPlan::default().refusing_with(exception, 1, table, register));
            rig.run(TIMEOUT + Duration::from_secs(20));
            let mut requests = rig.requests().into_iter();
            let stop = requests.find(|request| request.start > heard && WRITES.contains(&request.bytes[1]));
            let after = stop.map(|stop| stop.start - heard);
            assert!(
                after.is_some_and(|after| (TIMEOUT..TIMEOUT + ACTS).contains(&after)),
                "{about}: the stop came after {after:?}"
            );
            assert!(!rig.with_drive(1, |drive, _| drive.state().running), "{about}: it runs");
            let told: Vec<EventKind> = std::iter::from_fn(|| events.try_recv().ok())
                .map(|event| event.kind)
                .collect();
            // Until it is known that other reads are answered, the drive may count as offline once.
            let offline = told.iter().filter(|kind| **kind == EventKind::Offline).count();
            assert!(offline <= 1 && rig.is_online(0), "{about}: {told:?}");
            assert!(told.contains(&EventKind::Supervision), "{about}: {told:?}");
        }
    }
}
