//! Tests of the loader: values of a file, defaults, reload, the environment; tests of listeners and the schema are
//! in separate files.

use std::path::Path;
use std::sync::{Arc, LazyLock};
use std::time::Duration;

use super::load::parse;
use super::*;
use drivegate_core::process_image::{Access, TriggerLimit};
use drivegate_model::document::Problem;
use drivegate_model::drive::profile::Profiles;
use drivegate_model::drive::{ModelPoint, Profile};

mod certificates;
mod files;
mod listeners;
mod page;
mod schema;

use self::listeners::certificates;

/// Every table of the configuration, so that the loader requests every key that it knows.
static FULL: LazyLock<String> = LazyLock::new(|| FORM.replace("DIR", &certificates().display().to_string()));

const FORM: &str = r#"
[gateway]
name = "g"
[[bus]]
name = "b"
port = "/dev/null"
[[bus.drive]]
name = "d"
access = "control"
address = 1
profile = "vacon-nx"
limits = { speed_reference = [0.0, 100.0] }
supervision = { timeout = "5s", action = { speed_reference = 20.0 } }
[modbus_tcp]
listen = ["127.0.0.1:1502"]
[[modbus_tcp.listener]]
listen = ["127.0.0.1:1503"]
[modbus_tcp.tls]
certificate = "DIR/gateway.crt"
key = "DIR/gateway.key"
client_ca = "DIR/ca.crt"
client_crl = "DIR/ca.crl"
roles = { operator = "control" }
[mqtt]
publish = {}
qos = {}
buffer = {}
sparkplug = { group = "plant" }
home_assistant = {}
[http]
hosts = ["gateway.example.com"]
tokens_file = "DIR/tokens"
certificate = "DIR/gateway.crt"
key = "DIR/gateway.key"
[bacnet]
listen = "127.0.0.1:47808"
device = 200
network = 2000
offline = "fault"
commands = true
allow = ["127.0.0.0/8"]
write = ["127.0.0.1"]
keep_priorities = true
bbmd = "bbmd.example.com"
vendor = 999
dcc_password_file = ""
buses = []
[authority]
mode = "exclusive"
[[authority.principal]]
name = "plc-1"
rank = "automation"
modbus_tcp = ["127.0.0.1/32"]
[drill]
max_speed = 15.0
limit = "12s"
every = "720h"
[audit]
[params]
[log]
[bus.drive.guard]
starts_per_hour = 12
[[bus.drive.interlocks]]
drive = "valve"
point = "at_reference"
[[bus.drive.trigger]]
point = "motor_current"
above = 120.0
[[bus.drive]]
name = "valve"
address = 99
profile = "vacon-nx"
[[bus.slot]]
listen = "127.0.0.1:4001"
"#;

fn load(source: &str) -> (Loaded, Vec<String>) {
    parse(Path::new("/etc/drivegate/t.toml"), source, std::iter::empty())
}

fn settings(source: &str) -> Settings {
    let (loaded, _) = load(source);
    assert_eq!(loaded.errors, []);
    loaded.settings.unwrap()
}

#[test]
fn slots_read_only_and_take_this_machine_unless_told_otherwise() {
    use drivegate_north::slot::SlotAccess;
    let all = settings(&FULL);
    let slot = &all.slots.as_ref().unwrap().slots[0];
    assert_eq!(
        (slot.bus.as_str(), slot.protocol.name(), slot.format.baud),
        ("b", "modbus-rtu", 9600)
    );
    assert_eq!(
        (slot.access, slot.idle_timeout),
        (SlotAccess::Read, Some(Duration::from_secs(600)))
    );
    assert!(slot.allow.iter().all(|network| network.network().is_loopback()));
    assert_eq!((slot.rfc2217, slot.pty.as_ref()), (None, None));
    let without = FULL.replace("[[bus.slot]]\nlisten = \"127.0.0.1:4001\"\n", "");
    let without = settings(&without);
    assert_eq!(without.slots, None);
    assert_eq!(
        without.buses, all.buses,
        "a slot is no part of its bus, which a reload leaves alone"
    );
}

#[test]
fn a_full_configuration_says_what_is_meant() {
    let source = r#"
[gateway]
name = "pump-house"
stale_after = "2s"
[[bus]]
name = "line1"
port = "ttyS0"
baud = 38400
format = "8E1"
rs485 = "kernel-inverted"
rts_before_send = "1ms"
rts_after_send = "2ms"
rx_during_tx = true
termination = true
dtr = "off"
spin = "off"
cycle = "20ms"
slow_cycle = "2s"
response_timeout = "50ms"
retries = 2
silence = "3ms"
[[bus.drive]]
name = "pump-1"
address = 7
profile = "vacon-nx"
access = "control"
limits = { speed_reference = [0, 80.5] }
supervision = { timeout = "5s", action = "hold", adopt = true }
on_shutdown = "stop"
turnaround = "0.5ms"
frequency_range = [10, 50]
[[bus]]
name = "line2"
port = "rfc2217://10.0.0.9:4001"
[[bus.drive]]
name = "fan"
address = 7
unit = 8
profile = "vacon-nx"
[modbus_tcp]
listen = ["127.0.0.1:0", "[::1]:1502"]
write = ["127.0.0.1"]
uncached = "refuse"
[mqtt]
url = "mqtts://broker"
commands = true
publish = { min_interval = "0s" }
buffer = { dir = "spool", max_bytes = "1MiB" }
sparkplug = { group = "plant", primary_host = "scada" }
"#;
    let all = settings(source);
    assert_eq!(
        (all.gateway.as_str(), all.stale_after.limit),
        ("pump-house", Duration::from_secs(2))
    );
    let line = &all.buses[0];
    assert_eq!(line.spec.port, "/etc/drivegate/ttyS0");
    assert_eq!(line.spec.format.to_string(), "38400 8E1");
    assert_eq!(
        line.options.silence,
        drivegate_proto::wire::Silence::Fixed(Duration::from_millis(3))
    );
    let options = drivegate_line::LineOptions {
        rs485: drivegate_line::Rs485::KernelInverted,
        rts_before_send: Duration::from_millis(1),
        rts_after_send: Duration::from_millis(2),
        rx_during_tx: true,
        termination: true,
        rts: drivegate_line::Level::Driver,
        dtr: drivegate_line::Level::Off,
        spin: drivegate_line::Spin::Off,
        receives_only: false,
    };
    assert_eq!(line.options.line, options);
    let drive = &line.drives[0];
    assert_eq!(
        (drive.unit, drive.bus.as_str(), drive.access),
        (7, "line1", Access::Control)
    );
    assert_eq!(drive.limits["speed_reference"], 0.0..=80.5);
    assert_eq!(drive.turnaround, Duration::from_micros(500));
    assert_eq!(drive.frequency_range, Some(10.0..=50.0));
    let lease = drivegate_core::process_image::Supervision {
        timeout: Duration::from_secs(5),
        action: drivegate_core::process_image::LeaseAction::LeaveRunning,
        adopt: true,
    };
    assert_eq!(drive.supervision, Some(lease));
    let usual = settings(&FULL).buses.remove(0).drives.remove(0);
    assert!(!usual.supervision.unwrap().adopt, "only where it is written");
    let fan = &all.buses[1].drives[0];
    assert_eq!(
        (fan.unit, fan.access, fan.turnaround),
        (8, Access::Monitor, fan.profile.turnaround)
    );
    assert_eq!(all.buses[1].spec.port, "rfc2217://10.0.0.9:4001");
    assert_eq!(all.buses[1].options.line, drivegate_line::LineOptions::default());
    let modbus = all.modbus_tcp.as_ref().unwrap();
    assert_eq!(
        modbus.listeners[0]
            .allow
            .iter()
            .map(ToString::to_string)
            .collect::<Vec<_>>(),
        ["127.0.0.0/8", "::1/128"]
    );
    assert_eq!(modbus.listeners[0].write[0].to_string(), "127.0.0.1/32");
    let mqtt = all.mqtt.as_ref().unwrap();
    assert_eq!((mqtt.brokers[0].to_string().as_str(), mqtt.tls), ("broker:8883", true));
    assert_eq!(mqtt.client_id, "drivegate-pump-house");
    assert_eq!(mqtt.buffer.as_ref().unwrap().dir, Path::new("/etc/drivegate/spool"));
    let node = mqtt.sparkplug.as_ref().unwrap();
    assert_eq!(
        (node.group.as_str(), node.node.as_str(), node.primary_host.as_str()),
        ("plant", "pump-house", "scada")
    );
    assert_eq!(
        (node.alias, node.history, node.state_dir.as_path()),
        (true, true, all.state_dir.as_path())
    );
    assert_eq!(all.http, None);
    assert_eq!((all.log.level.as_str(), all.log.format), ("info", LogFormat::Auto));
}

#[test]
fn the_format_without_a_word_is_that_of_the_protocol() {
    for (protocol, format) in [
        ("modbus-rtu", "9600 8N1"),
        ("modbus-ascii", "9600 7N2"),
        ("n2", "9600 8N1"),
    ] {
        let bus = format!(
            "[gateway]\nname = \"g\"\n[[bus]]\nname = \"b\"\nport = \"/dev/tty1\"\nprotocol = \"{protocol}\"\n"
        );
        assert_eq!(settings(&bus).buses[0].spec.format.to_string(), format);
    }
    let ascii = |format: &str| {
        let (loaded, _) = load(&format!(
            "[gateway]\nname = \"g\"\n[[bus]]\nname = \"b\"\nport = \"/dev/tty1\"\nprotocol = \"modbus-ascii\"\n\
             format = \"{format}\"\nsilence = \"1ms\"\n"
        ));
        let found: Vec<_> = loaded.warnings.iter().map(|w| w.to_string()).collect();
        let odd = found.iter().any(|text| text.contains("9 bits"));
        assert!(!found.iter().any(|text| text.contains("3.5 characters")), "{found:?}");
        (loaded.settings.is_some(), odd)
    };
    for sound in ["7N2", "7E1", "7O1", "8N1", "8E1", "8N2"] {
        assert_eq!(ascii(sound), (true, false), "{sound}");
    }
    assert_eq!(ascii("7N1"), (true, true));
}

#[test]
fn a_bus_of_n2_has_its_own_defaults() {
    let bus = |more: &str| {
        format!("[gateway]\nname = \"g\"\n[[bus]]\nname = \"b\"\nport = \"/dev/tty1\"\nprotocol = \"n2\"\n{more}")
    };
    let options = settings(&bus("")).buses[0].options.clone();
    assert_eq!(
        (options.response_timeout, options.retries),
        (Duration::from_millis(250), 2)
    );
    for (more, key) in [("baud = 38400\n", "baud"), ("format = \"8E1\"\n", "format")] {
        let (loaded, _) = load(&bus(more));
        let found = loaded
            .errors
            .iter()
            .find(|e| e.finding.what.contains("N2 is always 9600 8N1"))
            .unwrap();
        assert!(found.key.ends_with(key), "{found}");
    }
    let drive = |address: u8, more: &str| {
        bus(&format!(
            "[[bus.drive]]\nname = \"d\"\naddress = {address}\nprofile = \"teco-7300pa-n2\"\n{more}"
        ))
    };
    assert!(load(&drive(254, "")).0.settings.is_some());
    assert!(load(&drive(255, "unit = 1\n")).0.settings.is_some());
    assert!(load(&drive(255, "")).0.settings.is_none(), "unit 255 is the gateway");
    let nx = drive(248, "").replace("teco-7300pa-n2", "vacon-nx-n2");
    assert!(load(&nx).0.settings.is_none(), "the family's range decides");
}

#[test]
fn a_reload_sees_what_changed() {
    let one = settings(&FULL);
    assert_eq!(one, settings(&FULL));
    let two = settings(&FULL.replace("address = 1", "address = 2"));
    assert_ne!(one.buses, two.buses);
    assert_eq!(
        (&one.mqtt, &one.modbus_tcp, &one.http),
        (&two.mqtt, &two.modbus_tcp, &two.http)
    );
    let three = settings(&FULL.replace("[mqtt]", "[mqtt]\ncommands = true"));
    assert_ne!(one.mqtt, three.mqtt);
    assert_eq!(one.buses, three.buses);
}

#[test]
fn the_environment_overrides_and_problems_name_the_variable() {
    let load = |vars: &[(&str, &str)]| {
        let vars: Vec<_> = vars.iter().map(|(k, v)| (k.to_string(), v.to_string())).collect();
        Settings::parse(Path::new("t.toml"), &FULL, vars.into_iter())
    };
    let set = [
        ("DRIVEGATE__GATEWAY__NAME", "other"),
        ("DRIVEGATE__BUS__0__DRIVE__0__ADDRESS", "9"),
        ("DRIVEGATE__MODBUS_TCP__LISTEN", "127.0.0.1:7000, 127.0.0.2:7000"),
        ("DRIVEGATE__MQTT__USERNAME", "me"),
        ("DRIVEGATE__MQTT__PASSWORD", "12345"),
        ("DRIVEGATE__LOG__LEVEL", "debug"),
    ];
    let loaded = load(&set);
    assert_eq!(loaded.errors, []);
    let all = loaded.settings.unwrap();
    assert_eq!(all.gateway, "other");
    assert_eq!(all.buses[0].drives[0].address, 9);
    assert_eq!(all.modbus_tcp.unwrap().listeners[0].listen.len(), 2);
    assert_eq!(all.log.level, "debug");
    let mqtt = all.mqtt.unwrap();
    let secret = drivegate_mqtt::Secret("12345".to_string());
    assert_eq!(mqtt.password, Some(drivegate_mqtt::Password::Fixed(secret)));
    assert!(!format!("{mqtt:?}").contains("12345"));

    let loaded = load(&[
        ("DRIVEGATE__BUS__0__BAUD", "fast"),
        ("DRIVEGATE__MQTT__PASWORD", "secret"),
        ("DRIVEGATE__BUSS__0__BAUD", "9600"),
    ]);
    let found: Vec<String> = loaded.errors.iter().map(ToString::to_string).collect();
    assert!(loaded.settings.is_none());
    assert_eq!(found.len(), 3, "{found:#?}");
    assert!(found.iter().all(|t| !t.contains("secret")), "{found:#?}");
    for name in [
        "DRIVEGATE__BUS__0__BAUD, bus[0].baud",
        "DRIVEGATE__MQTT__PASWORD, mqtt.pasword",
        "DRIVEGATE__BUSS__0__BAUD",
    ] {
        assert!(found.iter().any(|t| t.contains(name)), "{name} in {found:#?}");
    }
}

/// Every built-in family reports whether its drive runs and whether it is present.
#[test]
fn every_family_can_be_supervised() {
    let tells = |profile: &&Arc<Profile>| profile.model_index(ModelPoint::Run).is_some();
    for profile in Profiles::built_in().iter().filter(tells) {
        for protocol in &profile.protocols {
            let (family, protocol) = (&profile.name, protocol.name());
            let source = format!(
                "[gateway]\nname = \"g\"\n[[bus]]\nname = \"b\"\nport = \"/dev/null\"\nprotocol = \"{protocol}\"\n\
                 [[bus.drive]]\nname = \"d\"\naddress = 1\nprofile = \"{family}\"\naccess = \"control\"\n\
                 on_shutdown = \"stop\"\nsupervision = {{ timeout = \"5s\" }}\n"
            );
            let time = settings(&source).buses[0].shutdown_time();
            assert!(
                time.drives == 1 && time.answered < time.unanswered,
                "{family}: {time:?}"
            );
        }
    }
}

/// An action in percent keeps the limits in Hz: 10 % of 0 to 50 Hz are 5 Hz.
#[test]
fn an_action_that_the_limits_of_another_unit_refuse_is_reported() {
    let (nx, teco) = (("vacon-nx", "modbus-rtu"), ("teco-7300pa", "modbus-ascii"));
    let (error, warning) = ((1, 0), (0, 1));
    let band = "frequency_range = [0, 50]";
    for ((family, protocol), limits, band, action, found) in [
        (nx, "frequency_reference = [20, 50]", band, 10.0, error),
        (nx, "frequency_reference = [20, 50]", band, 60.0, (0, 0)),
        (nx, "frequency_reference = [20, 50]", "", 10.0, warning),
        (nx, "speed_reference = [0, 50]", "", 10.0, (0, 0)),
        (teco, "frequency_reference = [0, 40]", band, 90.0, error),
        (teco, "frequency_command = [0, 40]", band, 90.0, error),
        (teco, "frequency_reference = [0, 40]", band, 60.0, (0, 0)),
        (teco, "frequency_reference = [0, 40]", "", 90.0, warning),
        (teco, "speed_reference = [0, 50]", "", 10.0, (0, 0)),
    ] {
        let source = format!(
            "[gateway]\nname = \"g\"\n[[bus]]\nname = \"b\"\nport = \"/dev/null\"\nprotocol = \"{protocol}\"\n\
             [[bus.drive]]\nname = \"d\"\naddress = 1\nprofile = \"{family}\"\naccess = \"control\"\n{band}\n\
             limits = {{ {limits} }}\nsupervision = {{ timeout = \"5s\", action = {{ speed_reference = {action:.1} }} }}\n"
        );
        let (loaded, _) = load(&source);
        let of = |problems: &[Problem]| {
            let mut texts = problems.iter().map(ToString::to_string).collect::<Vec<_>>();
            texts.retain(|text| text.contains("refuse the action"));
            texts
        };
        let (errors, warnings) = (of(&loaded.errors), of(&loaded.warnings));
        assert_eq!((errors.len(), warnings.len()), found, "{source}{errors:?}{warnings:?}");
        assert!(
            errors
                .iter()
                .chain(&warnings)
                .all(|text| text.contains("bus[0].drive[0].supervision"))
        );
    }
}

#[test]
fn the_recorder_keeps_its_files_in_the_state_directory() {
    let all = settings(&FULL.replace("name = \"g\"", "name = \"g\"\nstate_dir = \"state\""));
    assert_eq!(all.recordings.dir, Path::new("/etc/drivegate/state/recordings"));
    assert_eq!(
        (all.recordings.before.as_secs(), all.recordings.after.as_secs()),
        (30, 10)
    );
    assert_eq!((all.recordings.max_bytes, all.recordings.max_count), (256 << 20, 200));
    let trigger = &all.buses[0].drives[0].triggers[0];
    assert_eq!(trigger.limit, TriggerLimit::Above(120.0));
    assert_eq!(trigger.lasts, Duration::ZERO);
    let elsewhere = settings("[gateway]\nname = \"g\"\nstate_dir = \"/srv\"\n[recordings]\nmax_count = 0\n");
    assert_eq!(
        (elsewhere.recordings.max_count, elsewhere.state_dir.as_path()),
        (0, Path::new("/srv"))
    );
}

#[test]
fn what_mqtt_publishes_and_accepts() {
    let mqtt = |more: &str| {
        let (loaded, _) = load(&format!("[gateway]\nname = \"hall\"\n[mqtt]\n{more}"));
        let first = |problems: Vec<Problem>| problems.first().map(|p| p.to_string()).unwrap_or_default();
        let options = loaded.settings.and_then(|settings| settings.mqtt);
        (options, first(loaded.errors), first(loaded.warnings))
    };
    let prefix = |more: &str| mqtt(more).0.unwrap().home_assistant;
    assert_eq!(prefix(""), None);
    assert_eq!(prefix("home_assistant = false"), None);
    assert_eq!(prefix("[mqtt.home_assistant]").as_deref(), Some("homeassistant"));
    assert_eq!(
        prefix("home_assistant = { discovery_prefix = \"ha/1\" }").as_deref(),
        Some("ha/1")
    );
    let (options, ..) = mqtt("");
    let options = options.unwrap();
    assert!(options.telemetry.state && options.telemetry.points && !options.require_id);
    assert_eq!(options.telemetry.history, drivegate_mqtt::History::Off);
    assert_eq!(options.telemetry_qos, drivegate_mqtt::Qos::AtMostOnce);
    assert_eq!(options.event_qos, drivegate_mqtt::Qos::AtLeastOnce);
    assert_eq!(options.expiry, Some(Duration::from_secs(300)));
    let (options, ..) = mqtt(
        "topics = [\"state\"]\nqos = { telemetry = 1, events = 0 }\nexpiry = \"0s\"\nhistory = \"all\"\n\
         response_topics = [\"drivegate/answers/#\"]\nrequire_id = true\n",
    );
    let options = options.unwrap();
    assert!(options.telemetry.state && !options.telemetry.points && options.require_id);
    assert_eq!(options.telemetry_qos, drivegate_mqtt::Qos::AtLeastOnce);
    assert_eq!(
        (options.event_qos, options.expiry),
        (drivegate_mqtt::Qos::AtMostOnce, None)
    );
    assert_eq!(options.response_topics, ["drivegate/answers/#"]);
    for (key, why) in [
        ("topics = []", "the list is empty"),
        ("topics = [\"point\"]", "did you mean \"points\"?"),
        ("qos = { telemetry = 2 }", "2 is out of range"),
        ("history = \"some\"", "unknown word"),
        ("response_topics = [\"a/#/b\"]", "not a topic filter"),
        ("response_topics = [\"a+\"]", "not a topic filter"),
        ("response_topics = [\"drivegate/hall/x\"]", "the gateway's own topics"),
    ] {
        let (_, error, _) = mqtt(key);
        assert!(error.contains(why), "{key}: {error}");
    }
    assert!(mqtt("expiry = \"10s\"").2.contains("expires before"));
    let dir = certificates().display();
    let pair = |key| format!("url = \"mqtts://b\"\ncertificate = \"{dir}/gateway.crt\"\nkey = \"{dir}/{key}.key\"");
    assert!(mqtt(&pair("gateway")).0.is_some());
    assert!(
        mqtt(&pair("other"))
            .1
            .contains("the key does not match the certificate"),
        "{:?}",
        mqtt(&pair("other"))
    );
}

#[test]
fn guards_and_interlocks_of_a_drive() {
    let drive = |name: &str, address: u8, more: &str| {
        format!("[[bus.drive]]\nname = \"{name}\"\naddress = {address}\nprofile = \"vacon-nx\"\n{more}\n")
    };
    let of = |pump: &str, valve: &str| {
        let (pump, valve) = (drive("pump", 1, pump), drive("valve", 2, valve));
        format!("[gateway]\nname = \"g\"\n[[bus]]\nname = \"b\"\nport = \"/dev/ttyS1\"\nbaud = 19200\n{pump}{valve}")
    };
    let control = "access = \"control\"\n";
    let all = settings(&of(
        &format!(
            "{control}group = \"wet\"\nguard = {{ starts_per_hour = 12, min_off = \"30s\", stagger = \"5s\" }}\n\
             interlocks = [{{ drive = \"valve\", point = \"at_reference\", trip = true }}]"
        ),
        "group = \"wet\"",
    ));
    let [pump, valve] = &all.buses[0].drives[..] else {
        unreachable!()
    };
    let guard = pump.guard.unwrap();
    assert_eq!(
        (guard.starts_per_hour, guard.min_off.as_secs(), guard.stagger.as_secs()),
        (Some(12), 30, 5)
    );
    assert!(guard.min_run.is_zero() && pump.interlocks[0].is && pump.interlocks[0].trip);
    assert!(
        pump.staggers && valve.staggers,
        "the valve is of the group whose starts are apart"
    );
    let alone = settings(&of(
        &format!("{control}group = \"wet\"\nguard = {{ stagger = \"5s\" }}"),
        "",
    ));
    assert!(!alone.buses[0].drives[1].counts_starts());
    for (pump, says) in [
        ("guard = { min_off = \"1s\" }", "the drive is only monitored"),
        (
            "access = \"control\"\nguard = { starts_per_hour = 0 }",
            "0 is out of range",
        ),
        (
            "access = \"control\"\ninterlocks = [{ drive = \"pump\", point = \"ready\" }]",
            "`pump` is an interlock on itself",
        ),
        (
            "access = \"control\"\ninterlocks = [{ drive = \"valv\", point = \"ready\" }]",
            "there is no drive `valv`",
        ),
        (
            "access = \"control\"\ninterlocks = [{ drive = \"valve\", point = \"motor_current\" }]",
            "has no point `motor_current` that is true or false and polled",
        ),
        (
            "access = \"control\"\ninterlocks = [{ drive = \"valve\" }]",
            "`point` is missing",
        ),
    ] {
        let errors = load(&of(pump, "")).0.errors;
        let first = errors.first().map(ToString::to_string).unwrap_or_default();
        assert!(first.contains(says), "{pump}: {first}");
    }
}
