//! The program itself on serial lines: Modbus ASCII and Modbus RTU against an independent slave (pymodbus), and
//! Modbus ASCII against `drivegate simulate`, with faults on the line.

use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::support::process::{self, Running, get, mbpoll_read, read_registers, until, write_registers};
use crate::support::site::{HTTP, LINE1, MODBUS_TCP, Site, nx_in_ascii};
use crate::support::tools::{python, root, tool};

/// Output of `drivegate` on stdout and stderr.
fn drivegate(arguments: &[&str]) -> String {
    let ran = process::drivegate(arguments).output().unwrap();
    let (out, err) = (
        String::from_utf8_lossy(&ran.stdout),
        String::from_utf8_lossy(&ran.stderr),
    );
    assert!(ran.status.success(), "{arguments:?}: {err}{out}");
    format!("{err}{out}")
}

/// Gives a command, and repeats it until the drive acknowledges it.
fn command(site: &Site, points: &[&str]) {
    let config = site.config();
    let arguments = [&["write", "--config", &config, "drive"], points].concat();
    until("a command that is acknowledged", || {
        let ran = process::drivegate(&arguments).output().unwrap();
        eprint!("{}", String::from_utf8_lossy(&ran.stderr));
        ran.status.success().then_some(())
    });
}

/// A site with the drive `drive` of that profile; `bus` are the keys of its line.
fn site(bus: &str, profile: &str) -> Site {
    let line = LINE1.split("baud").next().unwrap();
    let drive = format!(
        "cycle = \"100ms\"\n{bus}\n\
         [[bus.drive]]\nname = \"drive\"\naddress = 1\naccess = \"control\"\nraw_writes = true\n\
         profile = \"{profile}\"\n"
    );
    Site::of(&[line, &drive, HTTP, MODBUS_TCP])
}

/// A transaction counter of the gateway; 0 while the metrics do not show the counter.
fn counted(http: u16, outcome: &str) -> f64 {
    let (_, text) = get(http, "/metrics").unwrap();
    let wanted = format!("outcome=\"{outcome}\"");
    let lines = text
        .lines()
        .filter(|l| l.starts_with("drivegate_drive_transactions_total{") && l.contains(&wanted));
    lines.filter_map(|l| l.rsplit_once(' ')?.1.parse::<f64>().ok()).sum()
}

/// Points of a slave with 20 items in each table, 4 in one request.
const PEER: &str = r#"
name = "peer"
protocols = ["modbus-rtu", "modbus-ascii"]
range = [
    { table = "holding", first = 0, last = 19, read = 4, write = 4 },
    { table = "input", first = 0, last = 19, read = 4 },
    { table = "coil", first = 0, last = 19, read = 8, write = 1 },
    { table = "discrete-input", first = 0, last = 19, read = 8 },
]
point = [
    { name = "set_point", at = "holding 3", class = "fast", write = true },
    { name = "low", at = "holding 0", class = "fast" },
    { name = "high", at = "holding 19", class = "fast" },
    { name = "measured", at = "input 7", class = "fast" },
    { name = "relay", at = "coil 4", class = "fast", write = true },
    { name = "third", at = "coil 3", class = "fast" },
    { name = "door", at = "discrete-input 6", class = "fast" },
]
"#;

/// Two pseudo-terminals joined by socat, with a pymodbus slave on one of them.
fn slave(site: &Site, framer: &str) -> (Running, Running) {
    let end = |name: &str| format!("pty,raw,echo=0,link={}", site.path(name));
    let socat = Running::start(&tool("socat"), &[&end("line1"), &end("far")]);
    let there = |name: &str| Path::new(&site.path(name)).exists().then_some(());
    until("the ends of the line", || there("line1").and(there("far")));
    let script: PathBuf = root().join("tests/peers/serial_slave.py");
    let slave = Running::start(&python(), &[&script.display().to_string(), &site.path("far"), framer]);
    slave.until_printed("connected");
    (socat, slave)
}

fn reads_and_writes_pymodbus(protocol: &str, framer: &str, format: &str) {
    let bus = format!("protocol = \"{protocol}\"\nbaud = 19200\nformat = \"{format}\"\nresponse_timeout = \"2s\"");
    let site = site(&bus, "peer");
    site.write("peer.toml", PEER);
    let _line = slave(&site, framer);
    let file = site.config();

    // Without a gateway, the command opens the line itself.
    let read = |points: &[&str]| -> Value {
        let arguments = [&["read", "--config", &file, "drive", "--json"], points].concat();
        let output = until("values", || {
            Some(process::drivegate(&arguments).output().unwrap()).filter(|output| output.status.success())
        });
        serde_json::from_slice(&output.stdout).unwrap()
    };
    let text = read(&["measured", "door"]).to_string();
    assert!(text.contains("207") && text.contains("true"), "{text}");
    command(&site, &["set_point=4711"]);

    let gateway = site.run_ready();
    let value = |name: &str| site.point("drive", name);
    for (name, wanted) in [
        ("set_point", Value::from(4711)),
        ("low", Value::from(100)),
        ("high", Value::from(119)),
        ("measured", Value::from(207)),
        ("third", Value::from(true)),
        ("relay", Value::from(false)),
        ("door", Value::from(true)),
    ] {
        let same = |got: &Value| *got == wanted || (got.is_number() && got.as_f64() == wanted.as_f64());
        until(&format!("{name} = {wanted}"), || same(&value(name)).then_some(()));
    }
    // Through the gateway: a command, a coil, and a raw write of several registers.
    command(&site, &["set_point=815", "relay=true"]);
    until("the new values", || {
        (value("set_point").as_f64() == Some(815.0) && value("relay") == true).then_some(())
    });
    write_registers(site.modbus, 1, 0, &[1, 2, 3]);
    assert_eq!(read_registers(site.modbus, 1, 0, 4), [1, 2, 3, 815]);
    let refused = mbpoll_read(site.modbus, 1, 30, 1).unwrap_err();
    assert!(refused.contains("Illegal data address"), "{refused}");
    assert_eq!(counted(site.http, "corrupt"), 0.0, "{}", gateway.output());
    assert!(counted(site.http, "ok") > 10.0);
}

#[test]
fn a_pymodbus_slave_in_ascii() {
    for format in ["7E1", "8N1"] {
        reads_and_writes_pymodbus("modbus-ascii", "ascii", format);
    }
}

#[test]
fn a_pymodbus_slave_in_rtu() {
    reads_and_writes_pymodbus("modbus-rtu", "rtu", "8N1");
}

#[test]
fn simulated_drives_in_ascii_run_and_meet_faults() {
    let site = site(
        "protocol = \"modbus-ascii\"\nbaud = 38400\nretries = 2\nresponse_timeout = \"1s\"",
        "nx-ascii",
    );
    site.write("nx-ascii.toml", &nx_in_ascii("nx-ascii"));
    let file = site.config();
    let simulate = |faults: &str| {
        let arguments = ["simulate", "--config", &file, "--turnaround", "15ms", "--fault", faults];
        let running = Running::drivegate(&arguments);
        until("the simulated line", || site.file("line1").exists().then_some(()));
        running
    };
    let checked = drivegate(&["check", "--config", &file]);
    assert!(checked.contains("modbus-ascii, 38400 7N2"), "{checked}");

    let mut line = simulate("");
    let _gateway = site.run_ready();
    let value = |name: &str| site.point("drive", name);
    until("the drive's own commands", || (!value("run").is_null()).then_some(()));
    command(&site, &["speed_reference=50", "run=true"]);
    until("half the speed", || {
        (value("actual_speed").as_f64() == Some(50.0)).then_some(())
    });
    // A test in virtual time proves that a line without faults has no failures.
    assert!(counted(site.http, "ok") > 10.0);

    let url = format!("http://127.0.0.1:{}", site.http);
    let trace = drivegate(&["trace", "--url", &url, "--count", "60"]);
    let frame = |start: &str| trace.lines().find(|line| line.contains(start)).unwrap_or_default();
    let (asked, replied) = (frame(":01030834000BB5"), frame(":010316"));
    assert!(
        asked.contains(":01030834000BB5\u{240D}\u{240A}") && asked.contains("read holding 2100..2110"),
        "{trace}"
    );
    assert!(replied.contains("11 registers: ") && replied.ends_with("ok"), "{trace}");
    let gap: u64 = replied.split_whitespace().nth(1).unwrap().parse().unwrap();
    assert!(gap > 14_000, "the turnaround stands as the gap: {replied}");

    // The line disappears and returns with faults; reads and commands still work.
    line.signal("TERM");
    line.ended();
    until("the drive to be missed", || {
        value("actual_speed").is_null().then_some(())
    });
    let line =
        simulate("corrupt=0.1,truncate=0.03,noise-before=0.1,noise-after=0.05,drop=0.03,stray-address=0.05,echo=0.02");
    let before = counted(site.http, "ok");
    until("replies, whole and broken ones", || {
        (counted(site.http, "ok") > before + 50.0 && counted(site.http, "corrupt") > 3.0).then_some(())
    });
    command(&site, &["speed_reference=20", "run=true"]);
    until("a fifth of the speed", || {
        (value("actual_speed").as_f64() == Some(20.0)).then_some(())
    });
    drop(line);
}
