//! `drivegate simulate` with user profiles: the examples of docs/profiles.md unchanged, one made from a register
//! list, and every built-in family.

use std::path::Path;
use std::process::Output;

use drivegate_model::drive::PollClass::{Fast, Once, Slow};
use drivegate_model::drive::profile::Profiles;
use drivegate_sim::simulated_drive::ModelOptions;
use serde_json::{Value, json};

use crate::support::process::{Running, api, read_registers, until, write_registers};
use crate::support::site::{HTTP, LINE1, MODBUS_TCP, Site};
use crate::support::tools::{root, run, run_well};

fn drivegate(arguments: &[&str]) -> Output {
    run(Path::new(env!("CARGO_BIN_EXE_drivegate")), arguments)
}

/// The site of one drive with a profile that is a file in its folder.
fn site_of(name: &str, text: &str) -> Site {
    let drive = format!(
        "cycle = \"50ms\"\nslow_cycle = \"200ms\"\n[[bus.drive]]\nname = \"drive\"\naddress = 1\nprofile = \"{name}\"\naccess = \"control\"\n"
    );
    let site = Site::of(&[LINE1, &drive, MODBUS_TCP, HTTP]);
    site.write(&format!("{name}.toml"), text);
    site
}

fn simulated(site: &Site, profile: &str, more: &[&str]) -> Running {
    let file = site.path(&format!("{profile}.toml"));
    site.simulate(&[&["--profile", &file], more].concat())
}

fn is_shown(site: &Site, point: &str, value: &Value) {
    let read = || Some(site.point("drive", point)).filter(|shown| shown == value);
    until(&format!("{point} = {value}"), read);
}

/// The profiles at the beginning of the page, each with its name.
fn examples() -> Vec<(String, String)> {
    let page = std::fs::read_to_string(root().join("docs/profiles.md")).unwrap();
    let (_, examples) = page.split_once("\n## Four examples\n").unwrap();
    let (examples, _) = examples.split_once("\n## ").unwrap();
    let blocks = examples
        .split("```toml\n")
        .skip(1)
        .filter_map(|rest| rest.split_once("\n```"));
    let name = |text: &str| {
        let line = text.lines().find_map(|line| line.strip_prefix("name = "));
        line.unwrap().trim_matches('"').to_string()
    };
    blocks.map(|(text, _)| (name(text), text.to_string())).collect()
}

/// Words sent to a drive of an example, in the order listed in the comment in the test.
type Words = (u16, u16, u16, &'static [u16], u16, f64);

/// The meter on the page whose values depend on other registers, with the register contents of its example.
fn ratios_sums_and_bytes((name, text): &(String, String)) {
    let site = site_of(name, text);
    let set = [
        "ct_ratio=40",
        "pt_ratio=2",
        "active_power=12.5",
        "energy_kwh=999.9",
        "energy_mwh=3",
        "supply_temperature=-5",
        "return_temperature=60",
    ];
    let options: Vec<&str> = set.iter().flat_map(|one| ["--set", one]).collect();
    let _line = simulated(&site, name, &options);
    let _gateway = site.run_ready();
    for (point, value) in [
        ("active_power", json!(12.5)),
        ("energy", json!(3999.9)),
        ("supply_temperature", json!(-5.0)),
        ("return_temperature", json!(60.0)),
    ] {
        is_shown(&site, point, &value);
    }
    // The registers as the device has them: both ratios, both temperatures in one.
    let raw = |start: u16, count: u16| read_registers(site.modbus, 1, start, count);
    assert_eq!(raw(0x0006, 2), [40, 20]);
    assert_eq!(raw(31, 3), [9999, 3, 0xFB3C]);
}

#[test]
fn the_examples_of_the_page_are_simulated() {
    let examples = examples();
    let names: Vec<&str> = examples.iter().map(|(name, _)| name.as_str()).collect();
    assert_eq!(names, ["small-meter", "ratio-meter", "bit-drive", "cia402-drive"]);
    let (name, meter) = &examples[0];
    let site = site_of(name, meter);
    let _line = simulated(
        &site,
        name,
        &["--set", "voltage_l1=231.5", "--set", "serial_number=SN-42"],
    );
    let _gateway = site.run_ready();
    is_shown(&site, "voltage_l1", &json!(231.5));
    is_shown(&site, "serial_number", &json!("SN-42"));
    ratios_sums_and_bytes(&examples[1]);
    // Fields: address of the reference, its count at 25 Hz, the words that start, a word that stops, and the
    // frequency in reverse.
    let drives: [Words; 2] = [
        (0x2502, 2500, 0x2501, &[1], 0, 25.0),
        (8502, 250, 8501, &[6, 7, 15], 7, 25.0),
    ];
    for ((name, text), (reference, count, at, words, stop, hertz)) in examples[2..].iter().zip(drives) {
        let site = site_of(name, text);
        let line = simulated(&site, name, &[]);
        let _gateway = site.run_ready();
        until("the first reading", || {
            (api(site.http, "drive")["state"] != "offline").then_some(())
        });
        write_registers(site.modbus, 1, reference, &[count]);
        for word in words {
            write_registers(site.modbus, 1, at, &[*word]);
            std::thread::sleep(std::time::Duration::from_millis(150));
        }
        site.until_state("drive", "running");
        is_shown(&site, "output_frequency", &json!(hertz));
        write_registers(site.modbus, 1, at, &[stop]);
        is_shown(&site, "output_frequency", &json!(0.0));
        until("its stop", || {
            (api(site.http, "drive")["state"] != "running").then_some(())
        });
        line.signal("USR1");
        site.until_state("drive", "fault");
        // The common model gives the commands: reset, run, reverse, stop.
        let command = |word: u16| write_registers(site.modbus, 1, 0x8100, &[word]);
        command(0);
        command(4);
        until("the reset", || {
            (api(site.http, "drive")["state"] != "fault").then_some(())
        });
        command(1);
        is_shown(&site, "output_frequency", &json!(hertz));
        command(3);
        is_shown(&site, "reverse", &json!(true));
        site.until_state("drive", "running");
        command(0);
        is_shown(&site, "output_frequency", &json!(0.0));
    }
}

/// A list read by `profiles import` is simulated, and the gateway reads the values that the registers hold.
#[test]
fn a_register_list_becomes_a_device_that_is_read() {
    let site = Site::new();
    let list = "name;address;type;order;scale;unit;class;bit;write;min;max\n\
                Voltage L1;30001;f32;;;V;fast;;;;\n\
                Power;30003;i32;CDAB;0,001;kW;fast;;;;\n\
                Energy;30005;u64;;0.01;kWh;fast;;;;\n\
                Alarm;30009;;;;;fast;3;;;\n\
                Digits;30010;bcd16;;0.1;A;fast;;;;\n\
                Serial;30011;string:4;;;;once;;;;\n\
                Ratio;40257;u16;;;;slow;;yes;1;1000\n";
    site.write("our meter.csv", list);
    let made = drivegate(&["profiles", "import", &site.path("our meter.csv")]);
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let text = String::from_utf8(made.stdout).unwrap();
    let site = site_of("our-meter", &text);
    run_well(
        Path::new(env!("CARGO_BIN_EXE_drivegate")),
        &["check", "--config", &site.config()],
    );
    let given = [
        ("voltage_l1", "229.75", json!(229.75)),
        ("power", "-12.345", json!(-12.345)),
        ("energy", "98765.43", json!(98_765.43)),
        ("alarm", "true", json!(true)),
        ("digits", "12.3", json!(12.3)),
        ("serial", "A1-7", json!("A1-7")),
        ("ratio", "40", json!(40.0)),
    ];
    let set: Vec<String> = given.iter().map(|(name, value, _)| format!("{name}={value}")).collect();
    let arguments: Vec<&str> = set.iter().flat_map(|set| ["--set", set.as_str()]).collect();
    let _line = simulated(&site, "our-meter", &arguments);
    let _gateway = site.run_ready();
    for (name, _, value) in &given {
        is_shown(&site, name, value);
    }
    // The registers hold IEEE 754 numbers, the low word first, and digits.
    let raw = |start: u16, count: u16| read_input(&site, start, count);
    assert_eq!(raw(0, 2), [0x4365, 0xC000]);
    assert_eq!(raw(2, 2), [0xCFC7, 0xFFFF]);
    assert_eq!(raw(8, 2), [0x0008, 0x0123]);
    assert_eq!(raw(10, 4), [0x4131, 0x2D37, 0, 0]);
    write_registers(site.modbus, 1, 256, &[55]);
    is_shown(&site, "ratio", &json!(55.0));
}

/// Input registers of the drive, by function 04 over Modbus TCP.
fn read_input(site: &Site, start: u16, count: u16) -> Vec<u16> {
    use std::io::{Read, Write};
    let mut stream = std::net::TcpStream::connect(("127.0.0.1", site.modbus)).unwrap();
    let [start, count] = [start.to_be_bytes(), count.to_be_bytes()];
    let frame = [&[0, 1, 0, 0, 0, 6, 1, 4][..], &start, &count].concat();
    stream.write_all(&frame).unwrap();
    let mut head = [0; 9];
    stream.read_exact(&mut head).unwrap();
    assert_eq!(head[7], 4, "exception {}", head[8]);
    let mut words = vec![0; usize::from(head[8])];
    stream.read_exact(&mut words).unwrap();
    words
        .chunks(2)
        .map(|pair| u16::from_be_bytes([pair[0], pair[1]]))
        .collect()
}

/// All families without a dedicated simulator on one line: every read of the gateway is answered.
#[test]
fn every_family_is_read_whole() {
    let profiles = Profiles::built_in();
    let families: Vec<_> = profiles
        .iter()
        .filter(|profile| matches!(ModelOptions::of_profile(profile), Some(ModelOptions::Profile(_))))
        .collect();
    assert!(families.len() >= 19, "{}", families.len());
    let drives: String = (1..)
        .zip(&families)
        .map(|(address, profile)| {
            let name = &profile.name;
            format!("[[bus.drive]]\nname = \"{name}\"\naddress = {address}\nprofile = \"{name}\"\n")
        })
        .collect();
    let site = Site::of(&[LINE1, &drives, HTTP]);
    let simulator = Running::drivegate(&["simulate", "--config", &site.config(), "--speed", "max"]);
    simulator.until_printed("Ctrl-C ends");
    let _gateway = site.run_ready();
    for profile in families {
        let polled = |name: &str| {
            let point = &api(site.http, &profile.name)["points"][name];
            (point["quality"] == "good").then_some(())
        };
        for point in profile.points.iter().filter(|point| !point.hidden) {
            if matches!(point.class, Fast | Slow | Once) && point.raw().is_some() {
                until(&format!("{} {}", profile.name, point.name), || polled(&point.name));
            }
        }
    }
}
