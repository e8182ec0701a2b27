use super::*;
use drivegate_bacnet::{Kind, Mac};
use drivegate_core::process_image::Access;
use drivegate_model::drive::profile::Profiles;
use std::collections::{BTreeMap, HashSet};

use crate::bacnet::ede;
use crate::bacnet::listing;
use crate::bacnet::objects::of_drive;

#[test]
fn a_number_means_the_same_point_at_every_family_and_names_are_unique() {
    let mut meant: BTreeMap<ObjectId, String> = BTreeMap::new();
    for profile in Profiles::built_in().iter() {
        for access in [Access::Monitor, Access::Control] {
            let spec = DriveSpec {
                access,
                ..spec(&profile.name)
            };
            let shown = of_drive(&spec, ("hall", 100));
            let device = &shown.device;
            assert_eq!(
                (device.instance, device.station, device.name.as_str()),
                (101, Mac::new(&[1]), "hall.p1")
            );
            assert_eq!(device.objects().len(), shown.meanings.len());
            let (mut ids, mut names) = (HashSet::new(), HashSet::new());
            for object in device.objects() {
                assert!(
                    ids.insert(object.id) && names.insert(object.name.clone()),
                    "{} {}",
                    profile.name,
                    object.id
                );
                if object.id.instance < 100 {
                    let known = meant.entry(object.id).or_insert_with(|| object.name.to_string());
                    assert_eq!(known.as_str(), &*object.name, "{}", profile.name);
                }
                if let Kind::Analog {
                    resolution, increment, ..
                } = object.kind
                {
                    assert!(
                        resolution > 0.0 && increment >= resolution.min(1.0),
                        "{} {}",
                        profile.name,
                        object.name
                    );
                }
            }
            let commands = device
                .objects()
                .iter()
                .filter(|object| object.access != drivegate_bacnet::Access::Read)
                .count();
            let takes = access == Access::Control && profile.points.iter().any(|point| point.write);
            assert_eq!(commands > 0, takes, "{}", profile.name);
        }
    }
    let fixed = [
        ((ObjectType::ANALOG_INPUT, 1), "actual_speed"),
        ((ObjectType::ANALOG_INPUT, 12), "fault_code"),
        ((ObjectType::BINARY_INPUT, 2), "running"),
        ((ObjectType::BINARY_INPUT, 8), "remote"),
        ((ObjectType::MULTI_STATE_INPUT, 1), "state"),
        ((ObjectType::BINARY_VALUE, 3), "fault_reset"),
        ((ObjectType::ANALOG_VALUE, 2), "frequency_reference"),
        ((ObjectType::CHARACTERSTRING_VALUE, 1), "fault_text"),
    ];
    for ((kind, instance), name) in fixed {
        assert_eq!(meant[&ObjectId::new(kind, instance)], name);
    }
}

#[test]
fn quality_is_told_and_never_better_than_it_is() {
    let mut rig = ControlledDrive::new();
    let speed = rig.place(ObjectId::new(ObjectType::ANALOG_INPUT, 1));
    let reliability = |rig: &ControlledDrive| rig.view.sample(DEVICE, speed).reliability;
    assert_eq!(reliability(&rig), Reliability::NoFault);
    assert!(rig.view.sample(DEVICE, speed).at.is_some() && rig.view.answers(DEVICE));
    rig.now += Duration::from_secs(5);
    rig.view.set_time(rig.now);
    assert_eq!(reliability(&rig), Reliability::CommunicationFailure, "stale");
    rig.read(1);
    assert_eq!(reliability(&rig), Reliability::NoFault);
    let drive = rig.drive();
    let Some(raw) = drive
        .image
        .spec
        .profile
        .model_point(ModelPoint::ActualSpeed)
        .unwrap()
        .raw()
        .cloned()
    else {
        panic!("it has a register");
    };
    drive
        .image
        .update(|snapshot| snapshot.refuse(raw.table, raw.address, 1, drivegate_proto::Exception::ADDRESS));
    assert_eq!(reliability(&rig), Reliability::UnreliableOther, "refused");
    rig.read(1);
    drive
        .image
        .update(|snapshot| snapshot.link = Link::Offline(std::time::SystemTime::now()));
    assert_eq!(reliability(&rig), Reliability::CommunicationFailure);
    assert!(!rig.view.answers(DEVICE), "away");
    assert_eq!(raw.table, Table::Holding);
}

#[test]
fn the_tables_for_the_integrator_are_whole() {
    let drives = [spec("vacon-nx")];
    let bus = bus_spec("line1");
    let devices = listing::devices("hall", &options(), [(&bus, &drives[..])].into_iter());
    assert_eq!(
        devices.iter().map(|shown| shown.device.instance).collect::<Vec<_>>(),
        [100, 101]
    );
    let lines = listing::lines(&devices);
    let line = |object: &str| {
        lines
            .iter()
            .find(|line| line.device == 101 && line.object == object)
            .unwrap()
            .cells()
    };
    assert_eq!(
        line("AI 2"),
        ["101", "hall.p1", "AI 2", "output_frequency", "number", "Hz", "read"]
    );
    assert_eq!(line("BV 1")[3..], ["run", "inactive, active", "", "command"]);
    let ede = ede::tables("hall", &devices);
    let rows: Vec<&str> = ede.objects.lines().filter(|line| line.starts_with("hall")).collect();
    assert_eq!(rows.len(), lines.len() + 2);
    let columns = ede
        .objects
        .lines()
        .find(|line| line.starts_with("#Keyname"))
        .unwrap()
        .split(';')
        .count();
    assert!(
        rows.iter()
            .all(|row| row.contains('"') || row.split(';').count() == columns),
        "{rows:#?}"
    );
    let speed = rows
        .iter()
        .find(|row| row.starts_with("hall.p1.actual_speed;"))
        .unwrap();
    assert_eq!(
        speed.split(';').nth(12),
        Some("0.1"),
        "ten times the resolution, as it is read"
    );
    assert!(ede.state_texts.contains("offline;not_ready;ready;running;fault"));
    assert!(ede.units.contains("27;Hz"));
}

#[test]
fn buses_and_hosts_are_those_of_the_configuration() {
    let rig = ControlledDrive::new();
    assert!(rig.view.admits("127.0.0.1".parse().unwrap()) && !rig.view.admits("10.0.0.1".parse().unwrap()));
    let none = Options {
        buses: Some(vec!["other".to_string()]),
        ..options()
    };
    let view = View::new(rig.view.plant.clone(), Arc::new(none), rig.view.rights.clone());
    assert_eq!(view.devices().len(), 1, "the gateway alone");
    let off = Options {
        commands: false,
        ..options()
    };
    let view = View::new(rig.view.plant.clone(), Arc::new(off), rig.view.rights.clone());
    assert!(!view.may_write("127.0.0.1".parse().unwrap()));
}
