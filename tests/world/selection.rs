//! Process data whose selector was changed at the drive: the value is taken from its monitoring register, after one
//! event, and returns to process data with the selection.

use std::time::Duration;

use drivegate_core::event::EventKind;
use drivegate_model::drive::{ModelPoint, State};
use drivegate_proto::Protocol;
use drivegate_sim::faults::{Fault, FaultPlan};

use super::rig::{PATIENCE, Rig, line};

/// IDs of the selectors of process data out 4 (torque) and 8 (fault code), less 1.
const OUT_4: u16 = 854;
const OUT_8: u16 = 858;
/// IDs of the values that the drive may select.
const TORQUE: u16 = 4;
const DC_LINK: u16 = 7;
const FAULT: u16 = 37;

fn running(family: &'static str) -> Rig {
    let mut rig = Rig::of(&line(family, Protocol::ModbusRtu, 38_400, 2));
    rig.until_state(1, State::Ready);
    rig.until_state(2, State::Ready);
    assert!(rig.set(1, &[("speed_reference", 60.0), ("run", 1.0)]).is_ok());
    rig.until_state(1, State::Running);
    rig
}

fn good(rig: &Rig, point: ModelPoint) -> Option<f64> {
    rig.good(1, point).map(|value| value.as_f64())
}

fn differing(
    rig: &mut Rig,
    events: &mut tokio::sync::broadcast::Receiver<std::sync::Arc<drivegate_core::event::Event>>,
) -> Vec<String> {
    let end = rig.now + Duration::from_secs(20);
    rig.until("time passes", PATIENCE, |rig| rig.now >= end);
    let mut told = Vec::new();
    while let Ok(event) = events.try_recv() {
        if event.kind == EventKind::SelectionDiffers {
            told.push(event.text.clone());
        }
    }
    told
}

/// The drive comes online again with another selection.
fn back_with(rig: &mut Rig, selector: u16, item: u16) {
    rig.set_alive(1, false);
    rig.until_state(1, State::Offline);
    rig.set_alive(1, true);
    rig.at_the_drive(1, selector, item);
    rig.until("it is back", PATIENCE, |rig| {
        rig.drive(1).image.snapshot().link.is_online()
    });
}

#[test]
fn a_drive_as_it_comes_from_the_works_differs_in_nothing() {
    for family in ["vacon-nx", "eaton-svx", "eaton-hvx"] {
        let mut rig = running(family);
        let mut events = rig.plant.events.subscribe();
        assert_eq!(differing(&mut rig, &mut events), [""; 0], "{family}");
        assert_eq!(rig.drive(1).image.snapshot().monitored, [0usize; 0], "{family}");
        assert!(good(&rig, ModelPoint::MotorTorque).is_some());
    }
}

#[test]
fn the_fault_code_is_right_whatever_process_data_out_8_holds() {
    for family in ["vacon-nx", "eaton-svx", "eaton-hvx"] {
        let mut rig = running(family);
        let mut events = rig.plant.events.subscribe();
        rig.at_the_drive(1, OUT_8, DC_LINK);
        let told = differing(&mut rig, &mut events);
        let wanted = usize::from(family != "eaton-hvx");
        assert_eq!(told.len(), wanted, "{family}: {told:?}");
        assert_eq!(good(&rig, ModelPoint::FaultCode), Some(0.0), "{family}");
        rig.with_drive(1, |drive, _| drive.trip(1));
        rig.until_state(1, State::Fault);
        rig.until("its code is told", PATIENCE, |rig| {
            good(rig, ModelPoint::FaultCode) == Some(1.0)
        });
        // The selection is restored while there is a fault, so that there are values to compare.
        rig.at_the_drive(1, OUT_8, FAULT);
        rig.until("process data is believed again", PATIENCE, |rig| {
            rig.drive(1).image.snapshot().monitored.is_empty()
        });
        assert_eq!(good(&rig, ModelPoint::FaultCode), Some(1.0), "{family}");
    }
}

#[test]
fn a_changed_selection_is_told_once_and_the_value_is_that_of_the_monitoring_register() {
    let mut rig = running("vacon-nx");
    let mut events = rig.plant.events.subscribe();
    back_with(&mut rig, OUT_4, DC_LINK);
    // The command of the gateway did not end with the outage.
    rig.until_state(1, State::Running);
    let told = differing(&mut rig, &mut events);
    assert_eq!(told.len(), 1, "{told:?}");
    assert!(told[0].contains("motor_torque"), "{told:?}");
    let torque = good(&rig, ModelPoint::MotorTorque).expect("a value");
    let monitored = f64::from(rig.word(1, TORQUE - 1) as i16) / 10.0;
    assert!((torque - monitored).abs() <= 5.0, "{torque} {monitored}");
    // The event comes once per drive and start, however often the selection goes wrong.
    back_with(&mut rig, OUT_4, DC_LINK);
    rig.until_state(1, State::Running);
    assert_eq!(differing(&mut rig, &mut events), [""; 0]);
    // The selection is restored.
    rig.at_the_drive(1, OUT_4, TORQUE);
    rig.until("process data is believed again", PATIENCE, |rig| {
        rig.drive(1).image.snapshot().monitored.is_empty()
    });
}

#[test]
fn a_monitoring_register_that_the_drive_refuses_changes_nothing() {
    let mut rig = running("vacon-nx");
    let mut events = rig.plant.events.subscribe();
    let refusing = FaultPlan::default()
        .refusing(1, drivegate_proto::Table::Holding, 98)
        .refusing(1, drivegate_proto::Table::Holding, TORQUE - 1);
    rig.set_faults(refusing);
    back_with(&mut rig, OUT_8, FAULT);
    rig.until_state(1, State::Running);
    assert_eq!(differing(&mut rig, &mut events), [""; 0]);
    for point in [ModelPoint::FaultCode, ModelPoint::MotorTorque, ModelPoint::MotorCurrent] {
        assert!(good(&rig, point).is_some(), "{}", point.name());
    }
}

#[test]
fn replies_that_are_lost_make_no_selection_differ() {
    let mut rig = running("vacon-nx");
    let mut events = rig.plant.events.subscribe();
    for round in 0..6 {
        let lossy = (0..40).fold(FaultPlan::default(), |plan, at| {
            plan.on_request(3 * at + 1 + round, Fault::Drop)
        });
        rig.set_faults(lossy);
        let reference = f64::from(20 + 10 * (round as u32 % 5));
        let _outcome = rig.set(1, &[("speed_reference", reference)]);
        assert_eq!(differing(&mut rig, &mut events), [""; 0]);
    }
    rig.set_faults(FaultPlan::default());
    let end = rig.now + Duration::from_secs(30);
    rig.until("time passes", PATIENCE, |rig| rig.now >= end);
    assert_eq!(rig.drive(1).image.snapshot().monitored, [0usize; 0]);
}
