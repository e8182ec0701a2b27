use std::collections::BTreeSet;

use serde_json::Value;

use super::super::{History, fixture};
use super::*;
use drivegate_core::process_image::{Access, DriveSpec};
use drivegate_model::drive::profile::{Profile, Profiles};

fn sources(base: &str, commands: bool, [state, points]: [bool; 2]) -> Sources {
    Sources {
        topics: Topics::new(base, "hall"),
        telemetry: Telemetry {
            state,
            points,
            history: History::Off,
        },
        commands,
    }
}

/// An announcer of drives with these names, and all updates that it publishes.
fn announced(names: &[&str]) -> (Announcer, Vec<Update>) {
    let mut announcer = Announcer::new("homeassistant", sources("drivegate", true, [true, true]));
    announcer.adopt(&fixture::plant(names));
    let updates = all(&mut announcer, Instant::now());
    (announcer, updates)
}

/// Returns the messages that are published while the broker accepts everything at once.
fn all(announcer: &mut Announcer, now: Instant) -> Vec<Update> {
    let next = || Some(announcer.next(now, |_| false)).filter(|updates| !updates.is_empty());
    std::iter::from_fn(next).flatten().collect()
}

fn json(payload: &[u8]) -> Value {
    serde_json::from_slice(payload).unwrap()
}

/// The entities of a drive with this profile.
fn entities(profile: &str, access: Access, sources: &Sources) -> Vec<(String, Value)> {
    let profile = Profiles::built_in().get(profile).unwrap().clone();
    let mut spec = DriveSpec::new("p1", "line1", 1, profile);
    spec.access = access;
    entity::of_drive(sources, "drivegate_hall_drive_p1", &spec)
}

/// The entities without those that are only removed.
fn present(entities: &[(String, Value)]) -> impl Iterator<Item = (&str, &Value)> {
    let described = entities.iter().filter(|(_, entity)| entity.get("uniq_id").is_some());
    described.map(|(key, entity)| (key.as_str(), entity))
}

#[test]
fn ids_have_allowed_characters_and_are_unique() {
    let topics = [
        "a/b", "a_b", "a__b", "a/_b", "a_/b", "ä", "A", "a", "a b", "a__2fb", "a-b",
    ];
    let ids: BTreeSet<String> = topics.iter().map(|topic| id_of(topic)).collect();
    assert_eq!(ids.len(), topics.len(), "{ids:?}");
    let allowed = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
    assert!(ids.iter().all(|id| id.chars().all(allowed)), "{ids:?}");
    assert_eq!(
        id_of("drivegate/pump-house/drive/pump-1"),
        "drivegate_pump-house_drive_pump-1"
    );
}

#[test]
fn each_device_has_one_message_and_the_drives_come_by_the_gateway() {
    let (announcer, updates) = announced(&["p1", "p_2"]);
    let topics: Vec<&str> = updates.iter().map(|update| update.topic.as_ref()).collect();
    let expected = ["gateway", "drive_p1", "drive_p__5f2"]
        .map(|name| format!("homeassistant/device/drivegate_hall/{name}/config"));
    assert_eq!(topics, expected);
    let kept: Vec<&str> = announcer.topics().map(AsRef::as_ref).collect();
    assert_eq!(kept, expected);
    assert!(topics.iter().all(|topic| announcer.is_own(topic)));
    assert!(!announcer.is_own("homeassistant/device/drivegate_hallway/gateway/config"));
    let [gateway, drive, _] = [0, 1, 2].map(|place: usize| json(&updates[place].payload));
    assert_eq!(gateway["dev"]["ids"][0], drive["dev"]["via_device"]);
    assert_eq!(
        (&drive["dev"]["name"], &drive["avty_mode"]),
        (&"p1".into(), &"all".into())
    );
    let availability: Vec<&str> = drive["avty"]
        .as_array()
        .unwrap()
        .iter()
        .map(|a| a["t"].as_str().unwrap())
        .collect();
    assert_eq!(
        availability,
        ["drivegate/hall/status", "drivegate/hall/drive/p1/point/state"]
    );
}

/// Checked for every family, with every kind of telemetry and both kinds of access.
#[test]
fn there_is_one_entity_for_each_published_point() {
    for profile in Profiles::built_in().iter() {
        for telemetry in [[true, true], [true, false], [false, true]] {
            for access in [Access::Monitor, Access::Control] {
                let sources = sources("drivegate", true, telemetry);
                let all = entities(&profile.name, access, &sources);
                let keys: BTreeSet<&str> = all.iter().map(|(key, _)| key.as_str()).collect();
                assert_eq!(keys.len(), all.len(), "{}: a key is there twice", profile.name);
                let published = super::super::payload::published_points(profile);
                let is_shown = published.iter().any(|(_, name)| *name == "fault_reset");
                let has_reset = profile
                    .model_index(drivegate_model::drive::ModelPoint::FaultReset)
                    .is_some();
                let reset = usize::from(access == Access::Control && has_reset && !is_shown);
                let code = usize::from(
                    profile
                        .model_index(drivegate_model::drive::ModelPoint::FaultCode)
                        .is_some(),
                );
                let expected = published.len() + code + reset + 2;
                assert_eq!(present(&all).count(), expected, "{} {access:?}", profile.name);
                let ids: BTreeSet<&str> = present(&all).map(|(_, e)| e["uniq_id"].as_str().unwrap()).collect();
                assert_eq!(ids.len(), expected, "{}: an id is there twice", profile.name);
            }
        }
    }
}

/// The rules of Home Assistant's schema that a message could break.
#[test]
fn entities_keep_the_rules_of_home_assistant() {
    let units = |class: &str| -> &[&str] {
        match class {
            "current" => &["A", "mA"],
            "voltage" => &["V", "mV"],
            "frequency" => &["Hz", "kHz", "MHz", "GHz"],
            "temperature" => &["°C", "°F", "K"],
            "energy" => &["Wh", "kWh", "MWh"],
            "power" => &["W", "kW", "MW"],
            "duration" => &["d", "h", "min", "s", "ms"],
            other => panic!("device class {other}"),
        }
    };
    for profile in Profiles::built_in().iter() {
        for telemetry in [[true, true], [true, false], [false, true]] {
            for access in [Access::Monitor, Access::Control] {
                let sources = sources("drivegate", true, telemetry);
                for (key, entity) in entities(&profile.name, access, &sources) {
                    let what = format!("{} {key}: {entity}", profile.name);
                    let platform = entity["p"].as_str().unwrap();
                    if entity.get("uniq_id").is_none() {
                        assert_eq!(entity.as_object().unwrap().len(), 1, "{what}");
                        continue;
                    }
                    let has = |name: &str| entity.get(name).is_some();
                    let class = entity.get("dev_cla").and_then(Value::as_str);
                    let unit = entity.get("unit_of_meas").and_then(Value::as_str);
                    assert!(has("name") && (has("stat_t") || platform == "button"), "{what}");
                    match platform {
                        "sensor" if class == Some("enum") => {
                            assert!(has("ops") && !has("stat_cla") && unit.is_none(), "{what}");
                        }
                        "sensor" | "number" => {
                            let fits = class.is_none_or(|class| unit.is_some_and(|unit| units(class).contains(&unit)));
                            assert!(fits, "{what}");
                            assert!(
                                class != Some("energy") || entity["stat_cla"] == "total_increasing",
                                "{what}"
                            );
                        }
                        "binary_sensor" => {
                            assert!(has("pl_on") && has("pl_off"), "{what}");
                            assert!([None, Some("running"), Some("problem")].contains(&class), "{what}");
                        }
                        "event" => assert_eq!(
                            entity["evt_typ"].as_array().unwrap().len(),
                            drivegate_core::event::EventKind::ALL.len()
                        ),
                        "switch" | "button" => {}
                        other => panic!("platform {other}"),
                    }
                    if platform == "number" {
                        assert!(entity["min"].as_f64() < entity["max"].as_f64(), "{what}");
                    }
                    let commanded = ["switch", "button", "number"].contains(&platform);
                    assert_eq!(has("cmd_t"), commanded, "{what}");
                    assert!(!commanded || access == Access::Control, "{what}");
                }
            }
        }
    }
}

#[test]
fn controls_are_there_only_where_the_drive_may_be_commanded() {
    let keys = |access, commands| -> Vec<String> {
        let all = entities("vacon-nx", access, &sources("drivegate", commands, [true, true]));
        let controls = ["switch_", "button_", "number_"];
        let present = present(&all).map(|(key, _)| key.to_string());
        present
            .filter(|key| controls.iter().any(|c| key.starts_with(c)))
            .collect()
    };
    let all = [
        "switch_run",
        "switch_reverse",
        "button_fault_reset",
        "number_speed_reference",
    ];
    assert_eq!(keys(Access::Control, true), all);
    assert!(keys(Access::Monitor, true).is_empty());
    assert!(keys(Access::Control, false).is_empty());
    let monitored = entities("vacon-nx", Access::Monitor, &sources("drivegate", true, [true, true]));
    for key in all {
        let gone = monitored.iter().find(|(k, _)| k == key).unwrap();
        assert_eq!(gone.1.as_object().unwrap().len(), 1, "taken away: {gone:?}");
    }
}

#[test]
fn the_number_has_the_configured_limits() {
    let sources = sources("drivegate", true, [true, true]);
    let profile = Profiles::built_in().get("vacon-nx").unwrap().clone();
    let mut spec = DriveSpec::new("p1", "line1", 1, profile);
    spec.access = Access::Control;
    spec.limits.insert("speed_reference".to_string(), 10.0..=80.0);
    let all = entity::of_drive(&sources, "id", &spec);
    let number = present(&all)
        .find(|(key, _)| *key == "number_speed_reference")
        .unwrap()
        .1;
    assert_eq!((&number["min"], &number["max"]), (&10.0.into(), &80.0.into()));
    assert_eq!(number["unit_of_meas"], "%");
    assert_eq!(number["cmd_t"], "drivegate/hall/drive/p1/set");
    assert_eq!(
        number["cmd_tpl"],
        "{\"id\": \"{{ now().timestamp() }}\", \"speed_reference\": {{ value }} }"
    );
    assert_eq!(
        number["val_tpl"],
        "{% set v = value or none %}{{ v if v is not none and 10 <= v | float <= 80 else none }}"
    );
}

#[test]
fn a_broker_with_small_packets_gets_a_device_in_parts() {
    let (mut announcer, whole) = announced(&["p1"]);
    let limit = 2500;
    announcer.restart(limit);
    let now = Instant::now();
    let parts = all(&mut announcer, now);
    assert!(announcer.take_changed());
    let components = |updates: &[Update]| -> BTreeSet<String> {
        let of = |update: &Update| {
            json(&update.payload)["cmps"]
                .as_object()
                .unwrap()
                .keys()
                .cloned()
                .collect::<Vec<_>>()
        };
        updates
            .iter()
            .filter(|u| u.topic.contains("drive_p1"))
            .flat_map(of)
            .collect()
    };
    assert!(parts.len() > 4);
    assert!(
        parts
            .iter()
            .all(|part| part.topic.len() + part.payload.len() + 24 <= limit)
    );
    assert_eq!(components(&parts), components(&whole));
    let topics: BTreeSet<&str> = parts.iter().map(|part| part.topic.as_ref()).collect();
    assert_eq!(topics.len(), parts.len());
    assert!(topics.contains("homeassistant/device/drivegate_hall/drive_p1__2/config"));
    // If packets may be larger, the topics of further parts are cleared.
    announcer.restart(usize::MAX);
    let again = all(&mut announcer, now);
    assert_eq!(
        again.iter().filter(|update| update.payload.is_empty()).count(),
        parts.len() - 2
    );
    assert!(announcer.take_changed());
    assert_eq!(announcer.topics().count(), 2);
}

#[test]
fn a_birth_of_many_drives_waits_for_the_broker() {
    let names: Vec<String> = (0..200).map(|n| format!("d{n}")).collect();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let mut announcer = Announcer::new("homeassistant", sources("drivegate", true, [true, true]));
    announcer.adopt(&fixture::plant(&names));
    let now = Instant::now();
    let mut given = 0;
    for _ in 0..100 {
        given += announcer.next(now, |_| true).len();
    }
    assert_eq!(given, UNDER_WAY);
    assert_eq!(announcer.next(now, |_| false).len(), 1);
}

#[test]
fn a_flood_of_births_announces_everything_twice() {
    let (mut announcer, updates) = announced(&["p1"]);
    let start = Instant::now();
    let mut again = 0;
    for milliseconds in 0..9000 {
        let now = start + Duration::from_millis(milliseconds);
        announcer.born(now);
        again += announcer.next(now, |_| false).len();
    }
    assert_eq!(again, updates.len(), "once at the first");
    let rest = all(&mut announcer, start + BIRTHS);
    assert_eq!(rest.len(), updates.len(), "and once for all others");
    assert!(all(&mut announcer, start + 2 * BIRTHS).is_empty());
}

/// A meter, with points of these names, types and units.
fn meter(points: &[(&str, &str, &str, &str)]) -> DriveSpec {
    let point = |(place, (name, form, unit, more)): (usize, &(&str, &str, &str, &str))| {
        let at = 2 * place;
        let unit = if unit.is_empty() {
            String::new()
        } else {
            format!("unit = \"{unit}\"\n")
        };
        format!("[[point]]\nname = \"{name}\"\nat = \"holding {at}\"\ntype = \"{form}\"\n{unit}{more}\n")
    };
    let head = "name = \"meter\"\ntitle = \"A meter\"\nprotocols = [\"modbus-rtu\"]\n\
                [[range]]\ntable = \"holding\"\nfirst = 0\nlast = 99\nread = 100\n";
    let source: String = std::iter::once(head.to_string())
        .chain(points.iter().enumerate().map(point))
        .collect();
    let profile = Profile::parse("meter.toml", &source, false).unwrap_or_else(|problems| panic!("{problems:?}"));
    DriveSpec::new("p1", "line1", 1, Arc::new(profile))
}

#[test]
fn a_count_that_may_fall_is_a_total_and_units_have_their_classes() {
    let cases = [
        (("energy", "u32", "", ""), ("energy", "total_increasing")),
        (("imported", "u32", "kWh", ""), ("energy", "total_increasing")),
        (("balance", "i32", "kWh", ""), ("energy", "total")),
        (("float_balance", "f32", "MWh", ""), ("energy", "total")),
        (
            ("float_meter", "f32", "MWh", "range = [0.0, 1e9]"),
            ("energy", "total_increasing"),
        ),
        (("reactive_balance", "i32", "kvarh", ""), ("", "total")),
        (("reactive", "u32", "kvarh", ""), ("", "total_increasing")),
        (("water", "u32", "m³", ""), ("volume", "total_increasing")),
        (("flow", "u16", "m³/h", ""), ("volume_flow_rate", "measurement")),
        (("apparent", "u16", "VA", ""), ("apparent_power", "measurement")),
        (("reactive_power", "i16", "var", ""), ("reactive_power", "measurement")),
        (("active_power", "i16", "kW", ""), ("power", "measurement")),
        (("share", "i16", "%", ""), ("", "measurement")),
    ];
    let spec = meter(&cases.map(|(point, _)| point));
    let sources = sources("drivegate", true, [true, true]);
    let all = entity::of_drive(&sources, "id", &spec);
    for ((name, ..), (class, state)) in cases {
        let key = format!("sensor_{name}");
        let (_, entity) = all.iter().find(|(k, _)| *k == key).unwrap();
        let seen = (
            entity["dev_cla"].as_str().unwrap_or(""),
            entity["stat_cla"].as_str().unwrap_or(""),
        );
        assert_eq!(seen, (class, state), "{name}");
    }
}

#[test]
fn names_are_written_as_people_do_and_drives_have_a_manufacturer() {
    for (name, expected) in [
        ("dc_link_voltage", "DC link voltage"),
        ("io_control", "IO control"),
        ("motor_current", "Motor current"),
        ("run", "Run"),
    ] {
        assert_eq!(entity::title(name), expected);
    }
    let (_, updates) = announced(&["p1"]);
    let [gateway, drive] = [0, 1].map(|place: usize| json(&updates[place].payload)["dev"].clone());
    assert_eq!((&drive["mf"], &gateway["mf"]), (&"Vacon".into(), &"drivegate".into()));
    assert!(drive["mdl"].as_str().unwrap().starts_with("NX, "), "{drive}");
    for profile in Profiles::built_in().iter() {
        assert!(!device::made(&profile.title).0.is_empty(), "{}", profile.title);
    }
    assert_eq!(device::made("Vaconic 3000"), ("", "Vaconic 3000"));
}

#[test]
fn a_reference_with_one_value_is_no_number() {
    let profile = Profiles::built_in().get("vacon-nx").unwrap().clone();
    let mut spec = DriveSpec::new("p1", "line1", 1, profile);
    spec.access = Access::Control;
    spec.limits.insert("speed_reference".to_string(), 50.0..=50.0);
    let all = entity::of_drive(&sources("drivegate", true, [true, true]), "id", &spec);
    let keys: Vec<&str> = present(&all).map(|(key, _)| key).collect();
    assert!(keys.contains(&"sensor_speed_reference") && !keys.contains(&"number_speed_reference"));
}
