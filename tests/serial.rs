//! The program itself on serial lines: Modbus ASCII and Modbus RTU against an independent slave (pymodbus), and Modbus
//! ASCII against `drivegate simulate`, with faults on the line.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::indexing_slicing)]

#[allow(dead_code, reason = "made for another test too")]
#[path = "gateway/process.rs"]
mod process;
mod tools;

use std::path::{Path, PathBuf};

use process::{Running, free_port, get, point, until, until_ready};
use serde_json::Value;
use tools::{python, root, run, run_well, tool};

const DRIVEGATE: &str = env!("CARGO_BIN_EXE_drivegate");

/// What `drivegate` printed on stdout and stderr.
fn drivegate(arguments: &[&str]) -> String {
    run_well(Path::new(DRIVEGATE), arguments)
}

/// A folder with a configuration of one bus and the profiles that are written into it.
struct Site {
    folder: tempfile::TempDir,
    http: u16,
    modbus: u16,
}

impl Site {
    fn new() -> Site {
        Site {
            folder: tempfile::tempdir().unwrap(),
            http: free_port(),
            modbus: free_port(),
        }
    }

    fn path(&self, name: &str) -> String {
        self.folder.path().join(name).display().to_string()
    }

    fn profile(&self, text: &str) {
        std::fs::write(self.path("profile.toml"), text).unwrap();
    }

    /// Writes the configuration: `bus` is the rest of `[[bus]]`, `drive` of `[[bus.drive]]`.
    fn configure(&self, bus: &str, drive: &str) -> String {
        let (file, port) = (self.path("drivegate.conf"), self.path("line"));
        let (http, modbus) = (self.http, self.modbus);
        let text = format!(
            "[gateway]\nname = \"test\"\nprofile_dirs = [\".\"]\n\
             [[bus]]\nname = \"line\"\nport = \"{port}\"\ncycle = \"100ms\"\n{bus}\n\
             [[bus.drive]]\nname = \"drive\"\naddress = 1\naccess = \"control\"\n{drive}\n\
             [http]\nlisten = \"127.0.0.1:{http}\"\n\
             [modbus_tcp]\nlisten = [\"127.0.0.1:{modbus}\"]\nwrite = [\"127.0.0.1/32\"]\n"
        );
        std::fs::write(&file, text).unwrap();
        file
    }
}

/// A transaction counter of the gateway, 0 while it does not stand there.
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

/// Two pseudo-terminals joined by socat, one with a pymodbus slave behind it.
fn slave(site: &Site, framer: &str) -> (Running, Running) {
    let end = |name: &str| format!("pty,raw,echo=0,link={}", site.path(name));
    let socat = Running::start(&tool("socat"), &[&end("line"), &end("far")]);
    let there = |name: &str| Path::new(&site.path(name)).exists().then_some(());
    until("the ends of the line", || there("line").and(there("far")));
    let script: PathBuf = root().join("tests/peers/serial_slave.py");
    let slave = Running::start(&python(), &[&script.display().to_string(), &site.path("far"), framer]);
    slave.until_printed("connected");
    (socat, slave)
}

fn reads_and_writes_pymodbus(protocol: &str, framer: &str, format: &str) {
    let site = Site::new();
    site.profile(PEER);
    let _line = slave(&site, framer);
    let bus = format!("protocol = \"{protocol}\"\nbaud = 19200\nformat = \"{format}\"\nresponse_timeout = \"500ms\"");
    let file = site.configure(&bus, "profile = \"peer\"");

    // Alone: the command opens the line itself.
    let read = |points: &[&str]| -> Value {
        let arguments = [&["read", "--config", &file, "drive", "--json"], points].concat();
        let output = run(Path::new(DRIVEGATE), &arguments);
        assert!(output.status.success(), "{output:?}");
        serde_json::from_slice(&output.stdout).unwrap()
    };
    let text = read(&["measured", "door"]).to_string();
    assert!(text.contains("207") && text.contains("true"), "{text}");
    drivegate(&["write", "--config", &file, "drive", "set_point=4711"]);

    let gateway = Running::drivegate(&["run", "--config", &file]);
    until_ready(site.http);
    let value = |name: &str| point(site.http, "drive", name);
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
    drivegate(&["write", "--config", &file, "drive", "set_point=815", "relay=true"]);
    until("the new values", || {
        (value("set_point").as_f64() == Some(815.0) && value("relay") == true).then_some(())
    });
    process::mbpoll_write(site.modbus, 1, 0, &[1, 2, 3]).unwrap();
    assert_eq!(process::mbpoll_read(site.modbus, 1, 0, 4).unwrap(), [1, 2, 3, 815]);
    let refused = process::mbpoll_read(site.modbus, 1, 30, 1).unwrap_err();
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

/// The Vacon NX profile, said to speak Modbus ASCII.
fn nx_in_ascii() -> String {
    let text = std::fs::read_to_string(root().join("profiles/vacon-nx.toml")).unwrap();
    let changed = text
        .replace("name = \"vacon-nx\"", "name = \"nx-ascii\"")
        .replace("protocols = [\"modbus-rtu\"]", "protocols = [\"modbus-ascii\"]");
    assert!(changed.contains("nx-ascii") && changed.contains("modbus-ascii"));
    changed
}

#[test]
fn simulated_drives_in_ascii_run_and_meet_faults() {
    let site = Site::new();
    site.profile(&nx_in_ascii());
    let bus = "protocol = \"modbus-ascii\"\nbaud = 38400\nretries = 2";
    let file = site.configure(bus, "profile = \"nx-ascii\"");
    let simulate = |faults: &str| {
        let arguments = ["simulate", "--config", &file, "--turnaround", "15ms", "--fault", faults];
        let running = Running::drivegate(&arguments);
        until("the simulated line", || {
            Path::new(&site.path("line")).exists().then_some(())
        });
        running
    };
    let checked = drivegate(&["check", "--config", &file]);
    assert!(checked.contains("modbus-ascii, 38400 7N2"), "{checked}");

    let mut line = simulate("");
    let gateway = Running::drivegate(&["run", "--config", &file]);
    until_ready(site.http);
    let value = |name: &str| point(site.http, "drive", name);
    until("the drive's own commands", || (!value("run").is_null()).then_some(()));
    drivegate(&["write", "--config", &file, "drive", "speed_reference=50", "run=true"]);
    until("half the speed", || {
        (value("actual_speed").as_f64() == Some(50.0)).then_some(())
    });
    // Only what a busy machine holds up fails; that a sound line has no failures is proved in virtual time.
    let failed = counted(site.http, "corrupt") + counted(site.http, "timeout");
    assert!(counted(site.http, "ok") > 10.0 * failed, "{failed} failed");

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

    // The line goes away and comes back with faults: read and commanded all the same.
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
    let told = (0..10).any(|_| {
        let command = ["write", "--config", &file, "drive", "speed_reference=20", "run=true"];
        run(Path::new(DRIVEGATE), &command).status.success()
    });
    assert!(told, "{}", gateway.output());
    until("a fifth of the speed", || {
        (value("actual_speed").as_f64() == Some(20.0)).then_some(())
    });
    drop(line);
}
