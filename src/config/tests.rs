use std::collections::BTreeSet;
use std::path::Path;
use std::sync::LazyLock;

use proptest::prelude::*;
use serde_json::Value;

use super::*;
use crate::config::schema::schema;

/// Every table of the configuration, so that the loader asks for every key it knows.
static FULL: LazyLock<String> = LazyLock::new(|| FORM.replace("DIR", &certificates().display().to_string()));

const FORM: &str = r#"
[gateway]
name = "g"
[[bus]]
name = "b"
port = "/dev/null"
[[bus.drive]]
name = "d"
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
roles = { operator = "control" }
[mqtt]
publish = {}
buffer = {}
[http]
[log]
"#;

/// Directory of a CA and a server certificate, made by the script of the documentation.
fn certificates() -> &'static Path {
    static DIR: LazyLock<tempfile::TempDir> = LazyLock::new(|| {
        let dir = tempfile::tempdir().unwrap();
        for arguments in [&["ca"][..], &["server", "gateway"], &["server", "other"]] {
            certificate(dir.path(), arguments, "30");
        }
        certificate(dir.path(), &["server", "expired"], "-1");
        dir
    });
    DIR.path()
}

fn certificate(dir: &Path, arguments: &[&str], days: &str) {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/modbus-tls-ca.sh");
    let output = std::process::Command::new(script)
        .arg(dir)
        .args(arguments)
        .env("DAYS", days)
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

fn load(source: &str) -> (Loaded, Vec<String>) {
    parse(Path::new("/etc/drivegate/t.toml"), source, std::iter::empty())
}

fn settings(source: &str) -> Settings {
    let (loaded, _) = load(source);
    assert_eq!(loaded.errors, []);
    loaded.settings.unwrap()
}

/// Paths of all properties below `node`, in the form of `Document::known_keys`.
fn properties(node: &Value, path: &str, found: &mut BTreeSet<String>) {
    for alternative in node["anyOf"].as_array().into_iter().flatten() {
        properties(alternative, path, found);
    }
    properties_of_table(node, path, found);
    if node["items"].is_object() {
        properties(&node["items"], &format!("{path}[]"), found);
    }
}

fn properties_of_table(node: &Value, path: &str, found: &mut BTreeSet<String>) {
    let join = |key: &str| {
        if path.is_empty() {
            key.to_string()
        } else {
            format!("{path}.{key}")
        }
    };
    for (key, property) in node["properties"].as_object().into_iter().flatten() {
        assert!(property["description"].is_string(), "{} has no description", join(key));
        found.insert(join(key));
        properties(property, &join(key), found);
    }
    match &node["additionalProperties"] {
        Value::Null | Value::Bool(false) => {}
        _ => {
            found.insert(join("*"));
        }
    }
}

#[test]
fn the_schema_has_the_keys_of_the_loader() {
    let mut described = BTreeSet::new();
    properties(&schema(), "", &mut described);
    let (loaded, known) = load(&FULL);
    assert_eq!(loaded.errors, []);
    let known: BTreeSet<String> = known
        .into_iter()
        .map(|key| {
            key.replace("limits.speed_reference", "limits.*")
                .replace("roles.operator", "roles.*")
        })
        .collect();
    assert_eq!(described, known);
}

/// Writes the defaults of the schema into `document` wherever its table is there and the key is not.
fn fill(document: &mut toml::Table, schema: &Value) {
    for (key, property) in schema["properties"].as_object().into_iter().flatten() {
        match document.get_mut(key) {
            Some(toml::Value::Table(table)) => fill(table, property),
            Some(toml::Value::Array(items)) => {
                for item in items {
                    if let toml::Value::Table(table) = item {
                        fill(table, &property["items"]);
                    }
                }
            }
            Some(_) => {}
            None => {
                if let Some(default) = property.get("default") {
                    document.insert(key.clone(), toml::Value::try_from(default).unwrap());
                }
            }
        }
    }
}

#[test]
fn the_defaults_of_the_schema_are_those_of_the_loader() {
    let mut document: toml::Table = FULL.parse().unwrap();
    fill(&mut document, &schema());
    let filled = toml::to_string(&document).unwrap();
    assert!(
        filled.contains("stale_after") && filled.contains("baud") && filled.contains("max_bytes"),
        "{filled}"
    );
    let mut filled = settings(&filled);
    assert!(
        filled.stale_after_written,
        "a default that is written down holds for slow lines too"
    );
    filled.stale_after_written = false;
    assert!(filled == settings(&FULL), "a default of the schema is not the loader's");
}

#[test]
fn a_full_configuration_says_what_is_meant() {
    let source = r#"
[gateway]
name = "pump-house"
[[bus]]
name = "line1"
port = "ttyS0"
baud = 38400
format = "8E1"
rs485 = "kernel-inverted"
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
supervision = { timeout = "5s", action = "hold" }
on_shutdown = "stop"
turnaround = "0.5ms"
frequency_range = [10, 50]
[[bus]]
name = "line2"
port = "tcp://10.0.0.9:4001"
[[bus.drive]]
name = "fan"
address = 7
unit = 8
profile = "vacon-nx"
[modbus_tcp]
listen = ["127.0.0.1:0", "[::1]:1502"]
write = ["127.0.0.1"]
uncached = "refuse"
stale_after = "2s"
[mqtt]
url = "mqtts://broker"
commands = true
publish = { min_interval = "0s" }
buffer = { dir = "spool", max_bytes = "1MiB" }
"#;
    let all = settings(source);
    assert_eq!(
        (all.gateway.as_str(), all.stale_after),
        ("pump-house", Duration::from_secs(2))
    );
    let line = &all.buses[0];
    assert_eq!(line.spec.port, "/etc/drivegate/ttyS0");
    assert_eq!(line.spec.format.to_string(), "38400 8E1");
    assert_eq!(
        line.options.silence,
        crate::codec::wire::Silence::Fixed(Duration::from_millis(3))
    );
    assert_eq!(line.options.rs485, crate::line::Rs485::KernelInverted);
    let drive = &line.drives[0];
    assert_eq!(
        (drive.unit, drive.bus.as_str(), drive.access),
        (7, "line1", Access::Control)
    );
    assert_eq!(drive.limits["speed_reference"], 0.0..=80.5);
    assert_eq!(drive.turnaround, Duration::from_micros(500));
    assert_eq!(drive.frequency_range, Some(10.0..=50.0));
    let fan = &all.buses[1].drives[0];
    assert_eq!(
        (fan.unit, fan.access, fan.turnaround),
        (8, Access::Monitor, fan.profile.turnaround)
    );
    assert_eq!(all.buses[1].spec.port, "tcp://10.0.0.9:4001");
    let modbus = all.modbus_tcp.as_ref().unwrap();
    assert_eq!(
        modbus.listeners[0]
            .allow
            .iter()
            .map(ToString::to_string)
            .collect::<Vec<_>>(),
        modbus_tcp::DEFAULT_ALLOW
    );
    assert_eq!(modbus.listeners[0].write[0].to_string(), "127.0.0.1/32");
    let mqtt = all.mqtt.as_ref().unwrap();
    assert_eq!((mqtt.host.as_str(), mqtt.port, mqtt.tls), ("broker", 8883, true));
    assert_eq!(mqtt.client_id, "drivegate-pump-house");
    assert_eq!(mqtt.buffer.as_ref().unwrap().dir, Path::new("/etc/drivegate/spool"));
    assert_eq!(all.http, None);
    assert_eq!(all.log, LogSettings::default());
}

#[test]
fn units_are_unique_where_modbus_tcp_serves_them() {
    let mut source = "[gateway]\nname = \"g\"\n".to_string();
    for bus in 1..=32 {
        source += &format!("[[bus]]\nname = \"b{bus}\"\nport = \"/dev/tty{bus}\"\n");
        for address in 1..=31 {
            source +=
                &format!("[[bus.drive]]\nname = \"d{bus}-{address}\"\naddress = {address}\nprofile = \"vacon-nx\"\n");
        }
    }
    assert_eq!(
        settings(&source).buses.iter().map(|b| b.drives.len()).sum::<usize>(),
        992
    );
    let (served, _) = load(&(source + "[modbus_tcp]\n"));
    assert_eq!(served.errors.len(), 961);
    assert!(
        served.errors[0].message.contains("unit 1 belongs to"),
        "{:?}",
        served.errors[0]
    );
}

/// Two lines with the same addresses, and what stands in `[modbus_tcp]`.
fn two_lines(modbus_tcp: &str) -> String {
    let mut source = "[gateway]\nname = \"g\"\n".to_string();
    for bus in ["line1", "line2"] {
        source += &format!("[[bus]]\nname = \"{bus}\"\nport = \"/dev/{bus}\"\n");
        for address in [1, 2] {
            source +=
                &format!("[[bus.drive]]\nname = \"{bus}-{address}\"\naddress = {address}\nprofile = \"vacon-nx\"\n");
        }
    }
    source + modbus_tcp
}

#[test]
fn a_listener_for_each_line() {
    let split = two_lines(
        "[modbus_tcp]\nallow = [\"10.0.0.0/8\"]\nwrite = [\"10.0.0.1\"]\n\
         [[modbus_tcp.listener]]\nlisten = [\"127.0.0.1:1503\"]\nbuses = [\"line1\"]\n\
         [[modbus_tcp.listener]]\nlisten = [\"127.0.0.1:1504\"]\nbuses = [\"line2\"]\nwrite = []\nallow = [\"10.2.0.0/16\"]\n",
    );
    let options = settings(&split).modbus_tcp.unwrap();
    assert_eq!(
        options.listeners.len(),
        2,
        "the short form is not there unless it is written"
    );
    let [one, two] = [&options.listeners[0], &options.listeners[1]];
    assert_eq!(one.buses.as_deref(), Some(&["line1".to_string()][..]));
    assert_eq!(
        (one.allow[0].to_string(), one.write[0].to_string()),
        ("10.0.0.0/8".into(), "10.0.0.1/32".into())
    );
    assert_eq!((two.allow[0].to_string(), two.write.len()), ("10.2.0.0/16".into(), 0));
    assert_eq!(options.idle_timeout, Some(modbus_tcp::DEFAULT_IDLE));
    let off = settings(&split.replace("[modbus_tcp]", "[modbus_tcp]\nidle_timeout = \"off\""))
        .modbus_tcp
        .unwrap();
    assert_eq!(off.idle_timeout, None);
    // Together they would share their units.
    let (both, _) = load(&split.replace("buses = [\"line2\"]", "buses = [\"line1\", \"line2\"]"));
    assert_eq!(both.errors.len(), 2, "{:?}", both.errors);
    assert!(
        both.errors[0].message.contains("unit 1 belongs to drive `line1-1`"),
        "{:?}",
        both.errors[0]
    );
    // Shown twice, told once.
    let (all, _) = load(&(split + "[modbus_tcp.tls]\ncertificate = \"a\"\n"));
    assert_eq!(
        all.errors
            .iter()
            .filter(|e| e.message.contains("belongs to drive"))
            .count(),
        2
    );
}

#[test]
fn faults_of_listeners() {
    let (loaded, _) = load(&two_lines(
        "[modbus_tcp]\nlisten = [\"127.0.0.1:1502\"]\nmax_connections_per_address = 0\nidle_timeout = \"0s\"\n\
         [[modbus_tcp.listener]]\nbuses = [\"lime1\", \"hall\"]\n\
         [[modbus_tcp.listener]]\nlisten = [\"127.0.0.1:1502\"]\nbuses = []\n",
    ));
    let told: Vec<String> = loaded.errors.iter().map(ToString::to_string).collect();
    for wanted in [
        "there is no bus `lime1`; /etc/drivegate/t.toml:30, modbus_tcp.listener[0].buses; did you mean `line1`?",
        "there is no bus `hall`; /etc/drivegate/t.toml:30, modbus_tcp.listener[0].buses; write one of line1, line2",
        "`listen` is missing; /etc/drivegate/t.toml:29, modbus_tcp.listener[0].listen; write for example [\"127.0.0.1:1502\"]",
        "the list is empty; /etc/drivegate/t.toml:33, modbus_tcp.listener[1].buses; name a bus, or leave the key out for all",
        "127.0.0.1:1502 collides with 127.0.0.1:1502 of modbus_tcp.listen (line 26); /etc/drivegate/t.toml:32, \
         modbus_tcp.listener[1].listen; give each server a port of its own",
        "0 is out of range; /etc/drivegate/t.toml:27, modbus_tcp.max_connections_per_address; write 1 to 10000",
        "0s is out of range; /etc/drivegate/t.toml:28, modbus_tcp.idle_timeout; write \"1s\" to \"168h\"",
    ] {
        assert!(
            told.iter().any(|t| t == wanted),
            "{wanted}\nis missing in\n{}",
            told.join("\n")
        );
    }
}

#[test]
fn faults_of_certificates_are_told_with_file_and_key() {
    let dir = certificates();
    let shown = dir.display();
    let of = |from: &str, to: &str| {
        let (loaded, _) = load(&FULL.replace(&format!("{shown}/{from}\""), &format!("{to}\"")));
        assert!(loaded.settings.is_none());
        loaded
            .errors
            .iter()
            .map(ToString::to_string)
            .collect::<Vec<_>>()
            .join("\n")
    };
    let file = |name: &str| dir.join(name).display().to_string();
    for (from, to, wanted) in [
        (
            "gateway.crt",
            file("nowhere.crt"),
            "nowhere.crt: No such file or directory (os error 2); /etc/drivegate/t.toml:18, \
          modbus_tcp.tls.certificate; check the path and its permissions",
        ),
        (
            "gateway.crt",
            file("gateway.key"),
            "gateway.key holds no certificate; /etc/drivegate/t.toml:18, modbus_tcp.tls.certificate; give a PEM file",
        ),
        (
            "gateway.crt",
            file("other.crt"),
            "the key does not belong to the certificate; /etc/drivegate/t.toml:19, \
          modbus_tcp.tls.key; give the key that the certificate was made for",
        ),
        ("gateway.key", file("gateway.crt"), "gateway.crt holds no private key: "),
        ("ca.crt", file(""), "modbus_tcp.tls.client_ca; "),
        ("gateway.crt", file("expired.crt"), "has expired on "),
    ] {
        let told = of(from, &to);
        assert!(told.contains(wanted), "{wanted}\nis not in\n{told}");
        assert_eq!(told.lines().count(), 1, "{told}");
    }
}

#[test]
fn new_certificates_in_the_same_files_are_seen() {
    let dir = tempfile::tempdir().unwrap();
    certificate(dir.path(), &["ca"], "30");
    let source = FORM.replace("DIR", &dir.path().display().to_string());
    let renewed = || {
        let _ = std::fs::remove_file(dir.path().join("gateway.key"));
        let _ = std::fs::remove_file(dir.path().join("gateway.crt"));
        certificate(dir.path(), &["server", "gateway"], "400");
        settings(&source).modbus_tcp.unwrap()
    };
    let (one, two) = (renewed(), renewed());
    assert!(two.differs_in_certificates_only(&one));
    assert!(!one.differs_in_certificates_only(&one.clone()));
    let mut other = two.clone();
    other.max_connections += 1;
    assert!(!other.differs_in_certificates_only(&one));
    let debug = format!("{one:?}");
    let key = std::fs::read_to_string(dir.path().join("gateway.key")).unwrap();
    assert!(
        debug.contains("elided") && !debug.contains(key.lines().nth(1).unwrap()),
        "{debug}"
    );
    // Thirty days before its end a certificate is worth a word.
    let (loaded, _) = load(&FULL);
    assert!(
        loaded.warnings.iter().any(|w| w.message.contains("expires on")),
        "{:?}",
        loaded.warnings
    );
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
        let told: Vec<_> = loaded.warnings.iter().map(|w| w.message.clone()).collect();
        let odd = told.iter().any(|text| text.contains("9 bits"));
        assert!(!told.iter().any(|text| text.contains("3.5 characters")), "{told:?}");
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
        let told = loaded
            .errors
            .iter()
            .find(|e| e.message.contains("N2 is 9600 8N1 always"))
            .unwrap();
        assert!(told.key.ends_with(key), "{told}");
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
fn the_environment_overrides_and_is_told_by_name() {
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
    assert_eq!(mqtt.password.as_ref().unwrap().0, "12345");
    assert!(!format!("{mqtt:?}").contains("12345"));

    let loaded = load(&[
        ("DRIVEGATE__BUS__0__BAUD", "fast"),
        ("DRIVEGATE__MQTT__PASWORD", "secret"),
        ("DRIVEGATE__BUSS__0__BAUD", "9600"),
    ]);
    let told: Vec<String> = loaded.errors.iter().map(ToString::to_string).collect();
    assert!(loaded.settings.is_none());
    assert_eq!(told.len(), 3, "{told:#?}");
    assert!(told.iter().all(|t| !t.contains("secret")), "{told:#?}");
    for name in [
        "DRIVEGATE__BUS__0__BAUD, bus[0].baud",
        "DRIVEGATE__MQTT__PASWORD, mqtt.pasword",
        "DRIVEGATE__BUSS__0__BAUD",
    ] {
        assert!(told.iter().any(|t| t.contains(name)), "{name} in {told:#?}");
    }
}

/// A value of any kind, sound or not.
fn any_value() -> impl Strategy<Value = String> {
    prop_oneof![
        any::<i64>().prop_map(|n| n.to_string()),
        any::<f64>().prop_map(|n| format!("{n:?}").replace("NaN", "nan")),
        "[a-z0-9:/.]{0,12}".prop_map(|text| format!("{text:?}")),
        "[0-9.]{1,25}(us|ms|s|min|h|MiB)".prop_map(|text| format!("{text:?}")),
        Just("true".to_string()),
        Just("[]".to_string()),
        Just("[1, 0.5]".to_string()),
        Just("{}".to_string()),
        Just("{ speed_reference = [0, 1] }".to_string()),
        Just("2026-11-21".to_string()),
        Just("= 1".to_string()),
    ]
}

proptest! {
    /// Whatever stands behind any key: no panic, and settings exactly when there is no error.
    #[test]
    fn any_value_of_any_key_is_judged(which in 0usize..100, value in any_value(), lines in 0usize..40) {
        let mut document: toml::Table = FULL.parse().unwrap();
        fill(&mut document, &schema());
        let filled = toml::to_string(&document).unwrap();
        let keys = filled.lines().filter(|line| line.contains('=')).count();
        let mut key = 0;
        let mut source = String::new();
        for line in filled.lines() {
            match line.split_once('=') {
                Some((name, _)) => {
                    source += &if key == which % keys { format!("{name}= {value}\n") } else { format!("{line}\n") };
                    key += 1;
                }
                None => source += &format!("{line}\n"),
            }
        }
        let (loaded, _) = load(&source);
        prop_assert_eq!(loaded.settings.is_some(), loaded.errors.is_empty());
        let half: Vec<&str> = source.lines().take(lines).collect();
        let (loaded, _) = load(&half.join("\n"));
        prop_assert_eq!(loaded.settings.is_some(), loaded.errors.is_empty());
    }
}
