//! A device server that answers in place of a drive which does not reply (exceptions 0A and 0B).

use std::time::Duration;

use drivegate_core::event::EventKind;
use drivegate_core::order::Outcome;
use drivegate_model::drive::{ModelPoint, State};
use drivegate_proto::{Exception, Protocol};
use drivegate_sim::faults::FaultPlan;

use super::rig::{PATIENCE, Rig, line};

/// Longest time until a drive that does not reply is offline.
const OFFLINE: Duration = Duration::from_secs(3);

#[test]
fn a_drive_for_which_only_the_server_answers_is_offline_until_it_replies() {
    for (profile, protocol, baud) in [
        ("vacon-nx", Protocol::ModbusRtu, 38_400),
        ("vacon-cx", Protocol::ModbusRtu, 19_200),
        ("weg-cfw", Protocol::ModbusRtu, 19_200),
        ("teco-7300pa", Protocol::ModbusAscii, 19_200),
    ] {
        for code in [0x0A, 0x0B] {
            let about = format!("{profile}, exception {code:02X}");
            let mut rig = Rig::of(&line(profile, protocol, baud, 2));
            for address in [1, 2] {
                rig.until_state(address, State::Ready);
            }
            assert!(rig.set(1, &[("run", 1.0)]).is_ok(), "{about}");
            rig.until_state(1, State::Running);
            let mut events = rig.plant.events.subscribe();
            let faults = FaultPlan::new(format!("exception:{code}=1").parse().unwrap(), 1);
            rig.set_faults(faults.only(&[1]));
            rig.until(&about, OFFLINE, |rig| rig.state(1) == State::Offline);
            assert_eq!(rig.good(1, ModelPoint::Running), None, "{about}");
            // A stop is sent all the same; what the server answers does not acknowledge it.
            let stop = rig.set(1, &[("run", 0.0)]);
            assert_eq!(stop, Outcome::Unknown(Exception::Modbus(code)), "{about}");
            rig.run(Duration::from_secs(60));
            assert!(!rig.is_online(0) && rig.is_online(1), "{about}");
            assert!(
                rig.with_drive(1, |drive, _| drive.state().running),
                "{about}: the drive received nothing"
            );
            rig.set_faults(FaultPlan::default());
            rig.until(&about, PATIENCE, |rig| rig.is_online(0));
            let told: Vec<EventKind> = std::iter::from_fn(|| events.try_recv().ok())
                .filter(|event| event.drive.is_some())
                .map(|event| event.kind)
                .filter(|kind| [EventKind::Offline, EventKind::Online].contains(kind))
                .collect();
            assert_eq!(told, [EventKind::Offline, EventKind::Online], "{about}");
        }
    }
}
