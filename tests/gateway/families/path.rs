//! A user's path for three families on the real gateway against independent drives: scan, values, start, fault, reset, stop all, over
//! the page in Chromium and over Modbus TCP by pymodbus.

use std::process::Command;

use super::cases::{Case, cases};
use crate::support::process::{Running, free_port, until};
use crate::support::site::{HTTP, LINE1, MODBUS_TCP, PASSWORD, Site, USERS};
use crate::support::tools::{python, root, run, tool};

/// Profile, and what `scan` prints about the drive at address 1.
const FAMILIES: [(&str, &str); 3] = [
    // No register tells this family from others.
    ("abb-acs580", "address 1: a device whose family no read shows"),
    ("danfoss-fc", "address 1: danfoss-fc"),
    ("schneider-altivar", "address 1: schneider-altivar"),
];

struct Plant {
    site: Site,
    drive: Running,
    _gateway: Running,
}

/// A drive that was found by `scan`, and the gateway that serves it.
fn scanned(case: &Case, found: &str) -> Plant {
    let port = free_port().to_string();
    let program = root().join("tests/peers/families/run.py").display().to_string();
    let drive = Running::start(&python(), &[&program, case.peer, &port]);
    drive.until_printed("ready");
    let line = format!("tcp://127.0.0.1:{port}");
    let scan = [
        "scan",
        "--port",
        &line,
        "--protocol",
        "modbus-rtu",
        "--addresses",
        "1-2",
    ];
    // On a busy machine the drive may answer too late for a search.
    until(found, || {
        let output = run(env!("CARGO_BIN_EXE_drivegate").as_ref(), &scan);
        let printed = String::from_utf8_lossy(&[output.stderr, output.stdout].concat()).into_owned();
        printed.contains(found).then_some(())
    });
    assert!(
        !drive.output().contains("wrote"),
        "a scan writes nothing: {}",
        drive.output()
    );
    let bus = LINE1.replace("port = \"line1\"", &format!("port = \"{line}\""));
    let of_drive = format!(
        "cycle = \"50ms\"\nslow_cycle = \"200ms\"\n[[bus.drive]]\nname = \"drive\"\naddress = 1\nprofile = \"{}\"\n\
         access = \"control\"\n",
        case.profile
    );
    let site = Site::of(&[&bus, &of_drive, MODBUS_TCP, HTTP, USERS]);
    site.add_user("alice");
    let gateway = site.run_ready();
    Plant {
        site,
        drive,
        _gateway: gateway,
    }
}

/// Takes the path of each family with a client, which prints `running`, waits for a fault, and prints `stopped` at its end.
fn take(client: impl Fn(&Site) -> Running) {
    for (profile, found) in FAMILIES {
        println!("{profile}");
        let cases = cases();
        let case = cases.iter().find(|case| case.profile == profile).expect("a family");
        let plant = scanned(case, found);
        let mut client = client(&plant.site);
        client.until_printed("running\n");
        plant.drive.signal("USR1");
        assert!(client.ended().success(), "{profile}: {}", client.output());
        client.until_printed("stopped\n");
        let seen = plant.drive.output();
        let order = [
            "motor forward",
            "tripped",
            "motor stopped",
            "reset",
            "motor forward",
            "motor stopped",
        ];
        let kept = seen.lines().filter(|line| order.contains(line));
        assert_eq!(kept.collect::<Vec<_>>(), order, "{profile}: {seen}");
    }
}

#[test]
fn three_families_over_the_page() {
    take(|site| {
        let script = root().join("tests/gateway/families/path.js");
        let url = format!("http://localhost:{}/", site.http);
        let mut node = Command::new(tool("node"));
        node.arg(script)
            .args([&url, "drive", PASSWORD])
            .env("NODE_PATH", root().join(".tools/node/node_modules"));
        Running::spawn(&mut node)
    });
}

#[test]
fn three_families_over_modbus_tcp() {
    take(|site| {
        let program = root().join("tests/peers/path_client.py").display().to_string();
        Running::start(&python(), &[&program, &site.modbus.to_string(), "1"])
    });
}
