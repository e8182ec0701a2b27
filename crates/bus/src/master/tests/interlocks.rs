//! A reference that would turn a motor at standstill whose run command is on needs its interlocks, in every family.

use super::family_drive::FamilyDrive;
use super::*;
use drivegate_core::queue::CommandQueue;
use drivegate_core::start_guard::{BusGuards, Guards, Interlock};
use drivegate_model::drive::profile::Profiles;
use drivegate_model::drive::{Plan, Profile};

const SECOND: Duration = Duration::from_secs(1);

/// Two drives of the family; the motor of the first one needs the second one to run.
fn interlocked(profile: &Arc<Profile>) -> Rig {
    let mut rig = Rig::empty(
        2,
        &profile.name,
        Protocol::ModbusRtu,
        Duration::from_millis(100),
        |spec| {
            let needs = Interlock {
                drive: "d2".to_string(),
                point: "running".to_string(),
                is: true,
                trip: false,
            };
            DriveSpec {
                supervision: None,
                interlocks: if spec.address == 1 { vec![needs] } else { Vec::new() },
                ..spec
            }
        },
    );
    let shared = Arc::new(Guards::default());
    let drives = &rig.bus.image.drives;
    let guards = BusGuards::of(&shared, &rig.bus.image.spec, drives.iter().map(|image| &image.spec));
    let machines = drives
        .iter()
        .map(|image| (rig.bus.image.spec.machine(&image.spec), image.clone()));
    shared.watch(machines, 10 * SECOND, rig.now);
    guards.iter().for_each(|guards| guards.begin());
    rig.bus.queue = Arc::new(CommandQueue::new().unwrap().guarded(guards));
    rig.begin_anew(&Handover::default());
    for drive in &mut rig.drives {
        drive.family = Some(FamilyDrive::new(profile));
    }
    rig.run(12 * SECOND);
    rig
}

/// The result of a reference to the first drive, and the number of writes for it.
fn reference(rig: &mut Rig, profile: &Profile) -> (String, usize) {
    let is_raw = |point: &ModelPoint| {
        profile
            .model_point(*point)
            .is_some_and(|of| of.write && of.raw().is_some())
    };
    let references = [ModelPoint::SpeedReference, ModelPoint::FrequencyReference];
    let point = references.into_iter().find(is_raw).unwrap();
    let from = rig.wire.len();
    let mut answer = rig.order(0, "client", point, Value::Number(10.0));
    rig.run(3 * SECOND);
    let written = rig.wire[from..].iter().filter(|(_, turn)| turn.pdu().is_write());
    (outcome(&mut answer).unwrap().code().to_string(), written.count())
}

fn switched(rig: &mut Rig, drive: usize, run: bool) {
    let mut answer = rig.switch(drive, "client", run);
    rig.run(3 * SECOND);
    assert!(outcome(&mut answer).is_some_and(|outcome| outcome.is_ok()));
}

#[test]
fn a_reference_that_turns_a_motor_needs_its_interlocks_in_every_family() {
    let refused = ("interlocked".to_string(), 0);
    let mut tried = 0;
    for profile in Profiles::built_in().iter() {
        let is_commanded = profile.control_table().is_some() && profile.protocols.contains(&Protocol::ModbusRtu);
        if profile.base.is_some() || !is_commanded && profile.name != "vacon-nx" {
            continue;
        }
        let name = &profile.name;
        let mut rig = interlocked(profile);
        switched(&mut rig, 1, true);
        switched(&mut rig, 0, true);
        assert_eq!(
            reference(&mut rig, profile).0,
            "acknowledged",
            "{name}: the other one runs"
        );
        switched(&mut rig, 1, false);
        let frequency = profile.model_index(ModelPoint::OutputFrequency);
        if frequency.is_some_and(|index| Plan::of(profile).shows(profile, index)) {
            assert_eq!(reference(&mut rig, profile), refused, "{name}: it runs at 0 Hz");
        }
        // In sleep mode the drive does not report that its motor runs.
        let drive = rig.drives[0].family.as_mut().unwrap();
        drive.show(ModelPoint::Running, false);
        rig.run(SECOND);
        assert_eq!(reference(&mut rig, profile), refused, "{name}: it sleeps");
        switched(&mut rig, 0, false);
        assert_eq!(reference(&mut rig, profile).0, "acknowledged", "{name}: it was stopped");
        tried += 1;
    }
    assert!(tried > 12, "{tried}");
}
