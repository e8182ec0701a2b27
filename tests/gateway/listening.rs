//! The gateway listens on a line on which independent programs poll simulated drives.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Duration;

use drivegate_model::drive::profile::Profiles;
use drivegate_proto::{LineFormat, Protocol};
use drivegate_sim::half_duplex::LineRules;
use drivegate_sim::simulated_drive::{DriveOptions, ModelOptions};
use drivegate_sim::wire::{SimulatedBus, SimulatedBusOptions};
use drivegate_testkit as testkit;
use serde_json::Value as Json;
use tokio_modbus::client::{Reader as _, Writer as _};
use tokio_modbus::slave::{Slave, SlaveContext as _};

use crate::support::process::{Running, api, drivegate, get, until};
use crate::support::site::{HTTP, MODBUS_TCP, Site, nx_in_ascii};
use crate::support::tools::{python, root, run_well, tool};

/// Exchanges of each master; more with the variable `DRIVEGATE_EXCHANGES`.
fn exchanges(usual: &str) -> String {
    std::env::var("DRIVEGATE_EXCHANGES").unwrap_or_else(|_| usual.to_string())
}

/// Drives, another master's port and the gateway's, all one line.
struct Shared {
    site: Site,
    _drives: SimulatedBus,
    line: Running,
}

impl Shared {
    fn start(protocol: Protocol, baud: u32, profile: &str, drives: u8) -> Shared {
        let site = Site::new();
        let name = Profiles::built_in().get(profile).unwrap().simulator.clone().unwrap();
        let drives = (1..=drives).map(|address| DriveOptions::new(address, ModelOptions::by_name(&name).unwrap()));
        let format = LineFormat::new(baud, "8N1").unwrap();
        let mut rules = LineRules::of(protocol, format);
        rules.strict = false;
        let drives = SimulatedBus::start(SimulatedBusOptions::new("shared", rules, drives.collect())).unwrap();
        let script = root().join("tests/peers/shared_line.py");
        let [master, listener] = ["master", "line1"].map(|name| site.path(name));
        let arguments = [script.to_str().unwrap(), &drives.address(), &master, &listener];
        let line = Running::start(&python(), &arguments);
        line.until_printed("ready");
        Shared {
            site,
            _drives: drives,
            line,
        }
    }

    fn master(&self) -> String {
        self.site.path("master")
    }

    /// Starts a gateway that listens, and waits until it is up.
    fn gateway(&self, protocol: Protocol, baud: u32, profile: &str, drives: u8) -> Running {
        let mut text = format!(
            "[gateway]\nname = \"test\"\nprofile_dirs = [\".\"]\n[[bus]]\nname = \"line1\"\nport = \"line1\"\nmode = \"listen\"\nprotocol = \"{}\"\nbaud = {baud}\n\
             format = \"8N1\"\n",
            protocol.name()
        );
        let own = "nx-of-this-line";
        let profile = match protocol {
            Protocol::ModbusAscii => {
                self.site.write("own.toml", &nx_in_ascii(own));
                own
            }
            _ => profile,
        };
        for address in 1..=drives {
            text += &format!("[[bus.drive]]\nname = \"d{address}\"\naddress = {address}\nprofile = \"{profile}\"\n");
        }
        self.site.configure(&[&text, MODBUS_TCP, HTTP]);
        let gateway = self.site.run();
        until("an open port", || {
            let (_, buses) = get(self.site.http, "/api/v1/buses")?;
            let buses: Json = serde_json::from_str(&buses).ok()?;
            (buses[0]["state"] == "up").then_some(())
        });
        gateway
    }

    fn drive(&self, name: &str) -> Json {
        api(self.site.http, name)
    }

    /// Ends the line; returns the bytes that the gateway sent on it.
    fn sent_by_the_gateway(self) -> String {
        self.line.signal("TERM");
        self.line.until_printed("the listener sent")
    }
}

/// The lines that a master printed, as address or kind, number, values.
fn printed(text: &str) -> Vec<Block> {
    let line = |line: &str| {
        let mut words = line.split_whitespace();
        let (kind, number) = (words.next()?.to_string(), words.next()?.parse().ok()?);
        Some((kind, number, words.map(|word| word.parse().unwrap()).collect()))
    };
    text.lines().filter_map(line).collect()
}

/// A block of registers as a master last read it: address of the drive, first register, words.
type Block = (String, u16, Vec<f64>);

fn pymodbus(framer: &str, port: &str) -> Vec<Block> {
    let script = root().join("tests/peers/polling_master.py");
    let arguments = [script.to_str().unwrap(), port, framer, "115200", &exchanges("600")];
    printed(&run_well(&python(), &arguments))
}

fn libmodbus(site: &Site, port: &str) -> Vec<Block> {
    let program = site.path("polling_master");
    let source = root().join("tests/peers/polling_master.c");
    run_well(
        &tool("gcc"),
        &["-O1", "-o", &program, source.to_str().unwrap(), "-lmodbus"],
    );
    printed(&run_well(Path::new(&program), &[port, "115200", &exchanges("600")]))
}

/// Requests of the two programs above, sent with tokio-modbus.
#[tokio::main(flavor = "current_thread")]
async fn tokio_modbus(port: &str) -> Vec<Block> {
    let stream = tokio_serial::SerialStream::open(&tokio_serial::new(port, 115_200)).unwrap();
    let mut client = tokio_modbus::client::rtu::attach(stream);
    client.set_slave(Slave(1));
    client
        .write_multiple_registers(2000, &[1, 0, 4000])
        .await
        .unwrap()
        .unwrap();
    let mut read = BTreeMap::new();
    let mut left: u32 = exchanges("600").parse().unwrap();
    while left > 1 {
        for address in [1, 2] {
            client.set_slave(Slave(address));
            for (first, count) in [(2100, 11), (2000, 3), (7, 2)] {
                let words = client.read_holding_registers(first, count).await.unwrap().unwrap();
                read.insert((address.to_string(), first), words);
                left = left.saturating_sub(1);
            }
        }
    }
    let blocks = read.into_iter();
    let blocks = blocks.map(|((address, first), words)| (address, first, words.into_iter().map(f64::from).collect()));
    blocks.collect()
}

/// The gateway shows the values that a program reads and commands on the line.
fn polled(protocol: Protocol, master: impl FnOnce(&Site, &str) -> Vec<Block>) {
    let shared = Shared::start(protocol, 115_200, "vacon-nx", 2);
    let gateway = shared.gateway(protocol, 115_200, "vacon-nx", 2);
    let said = master(&shared.site, &shared.master());
    assert_eq!(said.len(), 6, "{said:?}");
    let port = shared.site.modbus.to_string();
    for (address, first, words) in &said {
        // A SCADA client reads from the gateway the values that the master read from the drive.
        let count = words.len().to_string();
        let first = first.to_string();
        let mbpoll = [
            "-m",
            "tcp",
            "-p",
            &port,
            "-a",
            address,
            "-0",
            "-1",
            "-t",
            "4",
            "-r",
            &first,
            "-c",
            &count,
            "127.0.0.1",
        ];
        let text = run_well(&tool("mbpoll"), &mbpoll);
        let values: Vec<f64> = text
            .lines()
            .filter_map(|line| line.split_once("]:")?.1.split_whitespace().next()?.parse().ok())
            .collect();
        assert_eq!(&values, words, "{address} {first}: {text}");
    }
    let drive = shared.drive("d1");
    assert_eq!(
        (&drive["quality"], &drive["online"]),
        (&"good".into(), &true.into()),
        "{drive}"
    );
    let transactions = &drive["transactions"];
    assert_eq!(
        (&transactions["timeout"], &transactions["corrupt"]),
        (&0.into(), &0.into()),
        "{drive}"
    );
    let audit = shared.site.audit();
    assert_eq!(audit[0]["source"], "other_master", "{audit:?}");
    // Clients try to write meanwhile.
    let write = [
        "-m",
        "tcp",
        "-p",
        &port,
        "-a",
        "1",
        "-0",
        "-1",
        "-t",
        "4",
        "-r",
        "2000",
        "127.0.0.1",
        "0",
    ];
    let refused = crate::support::tools::run(&tool("mbpoll"), &write);
    let refused = [refused.stdout, refused.stderr].concat();
    assert!(String::from_utf8_lossy(&refused).contains("Illegal function"));
    let mut write = drivegate(&["write", "--config", &shared.site.config(), "d1", "run=false"]);
    let refused = write.output().unwrap();
    let text = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(
        !refused.status.success() && text.contains("mode = \"listen\""),
        "{text}"
    );
    drop(gateway);
    assert!(shared.sent_by_the_gateway().contains("the listener sent 0 bytes"));
}

#[test]
fn what_pymodbus_reads_by_rtu_is_shown() {
    polled(Protocol::ModbusRtu, |_, port| pymodbus("rtu", port));
}

#[test]
fn what_pymodbus_reads_by_ascii_is_shown() {
    polled(Protocol::ModbusAscii, |_, port| pymodbus("ascii", port));
}

#[test]
fn what_libmodbus_reads_is_shown() {
    polled(Protocol::ModbusRtu, libmodbus);
}

#[test]
fn what_tokio_modbus_reads_is_shown() {
    polled(Protocol::ModbusRtu, |_, port| tokio_modbus(port));
}

#[test]
fn what_another_master_of_n2_reads_is_shown() {
    let shared = Shared::start(Protocol::N2, 9600, "vacon-nx-n2", 1);
    let gateway = shared.gateway(Protocol::N2, 9600, "vacon-nx-n2", 1);
    let script = root().join("tests/peers/n2_master.py");
    let said = printed(&run_well(
        &python(),
        &[script.to_str().unwrap(), &shared.master(), &exchanges("200")],
    ));
    assert_eq!(said.len(), 8, "{said:?}");
    let drive = shared.drive("d1");
    let profile = testkit::profile("vacon-nx-n2");
    let mut compared = 0;
    for (kind, number, values) in said.iter().filter(|(kind, _, _)| kind == "AI") {
        let at = 2 * (number - 1);
        let point = profile.points.iter().find(|point| {
            point
                .raw()
                .is_some_and(|raw| raw.table.name() == "input" && raw.address == at && raw.scale == 1.0)
        });
        let Some(point) = point else { continue };
        let shown = drive["points"][&point.name]["value"].as_f64();
        assert!(
            shown.is_some_and(|shown| (shown - values[0]).abs() < 0.01),
            "{kind} {number}: {drive}"
        );
        compared += 1;
    }
    assert!(compared > 0, "{said:?}");
    drop(gateway);
    assert!(shared.sent_by_the_gateway().contains("the listener sent 0 bytes"));
}

#[test]
fn a_line_is_found_without_a_byte() {
    let shared = Shared::start(Protocol::ModbusRtu, 38_400, "vacon-nx", 2);
    let script = root().join("tests/peers/polling_master.py");
    let master = shared.master();
    let _master = Running::start(
        &python(),
        &[script.to_str().unwrap(), &master, "rtu", "38400", "1000000"],
    );
    let port = shared.site.path("line1");
    let arguments = ["listen", "--port", &port, "--baud", "38400", "--seconds", "3"];
    let output = drivegate(&arguments).output().unwrap();
    let (found, told) = (
        String::from_utf8_lossy(&output.stdout).into_owned(),
        String::from_utf8_lossy(&output.stderr).into_owned(),
    );
    assert!(output.status.success(), "{told}");
    assert!(
        told.contains("modbus-rtu 38400 8N1") && told.contains("read holding 2100..2110"),
        "{told}"
    );
    for wanted in ["mode = \"listen\"", "address = 1", "address = 2", "vacon-nx"] {
        assert!(found.contains(wanted), "{wanted}: {found}\n{told}");
    }
    let config = shared.site.path("found.toml");
    std::fs::write(&config, &found).unwrap();
    let checked = drivegate(&["check", "--config", &config]).output().unwrap();
    assert!(checked.status.success(), "{}", String::from_utf8_lossy(&checked.stderr));
    std::thread::sleep(Duration::from_millis(100));
    assert!(shared.sent_by_the_gateway().contains("the listener sent 0 bytes"));
}

#[test]
fn check_refuses_what_needs_a_byte() {
    let site = Site::new();
    let drive = "[[bus.drive]]\nname = \"a\"\naddress = 1\nprofile = \"vacon-nx\"\n";
    let keys = "access = \"control\"\non_shutdown = \"stop\"\nsupervision = { timeout = \"5s\" }\n";
    let bus = "[gateway]\nname = \"test\"\nprofile_dirs = [\".\"]\n[[bus]]\nname = \"line1\"\nport = \"line1\"\nmode = \"listen\"\ncycle = \"20ms\"\n";
    site.configure(&[bus, drive, keys, HTTP]);
    let output = drivegate(&["check", "--config", &site.config()]).output().unwrap();
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(78), "{told}");
    for wish in ["access = \"control\"", "on_shutdown = \"stop\"", "supervision"] {
        let wanted = format!("error: `{wish}` of drive `a` needs a gateway that writes, but this bus only listens");
        assert!(told.contains(&wanted), "{wanted}: {told}");
    }
    site.configure(&[bus, drive, HTTP]);
    let output = drivegate(&["check", "--config", &site.config()]).output().unwrap();
    assert!(output.status.success());
    let (shown, told) = (
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr),
    );
    assert!(
        told.contains("`cycle` has no effect on a bus that only listens"),
        "{told}"
    );
    assert!(
        shown.contains("listens only: another master polls these drives"),
        "{shown}"
    );
}
