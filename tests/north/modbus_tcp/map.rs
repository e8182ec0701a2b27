//! The register map is true: every register listed by `drivegate map` is answered under its unit id, in every table
//! that it names, and a write is accepted where the map says so.

use std::fmt::Write as _;
use std::sync::Arc;
use std::time::{Duration, Instant};

use drivegate_core::plant::Plant;
use drivegate_core::process_image::DriveImage;
use drivegate_gateway::config::Settings;
use drivegate_model::drive::profile::Profiles;
use drivegate_testkit as testkit;
use serde_json::Value;

use super::rig::{Rig, options, words};
use crate::support::tools;

/// A bus for each built-in profile, with one drive to command and one to monitor. The register values do not give every
/// family a frequency range, so the range is configured.
fn configuration() -> String {
    let mut text = "[gateway]\nname = \"all\"\n[modbus_tcp]\nwrite = [\"127.0.0.1\"]\n".to_string();
    for (place, profile) in Profiles::built_in().iter().enumerate() {
        let protocol = profile.protocols[0].name();
        let _ = writeln!(
            text,
            "[[bus]]\nname = \"line{place}\"\nport = \"/dev/line{place}\"\nprotocol = \"{protocol}\""
        );
        for (access, address) in [("control", 1), ("monitor", 2)] {
            let (unit, name) = (2 * place + address, &profile.name);
            let _ = writeln!(
                text,
                "[[bus.drive]]\nname = \"d{unit}\"\naddress = {address}\nunit = {unit}\nprofile = \"{name}\"\naccess = \"{access}\"\nfrequency_range = [0, 50]"
            );
        }
    }
    text
}

/// The plant of these settings, with every register read just before.
fn plant(settings: &Settings) -> Plant {
    let now = Instant::now();
    let buses = settings.buses.iter().map(|bus| {
        let drives: Vec<_> = bus
            .drives
            .iter()
            .map(|d| Arc::new(DriveImage::new(d.clone(), bus.spec.slow_cycle)))
            .collect();
        for drive in &drives {
            // Rising values would make a lowest frequency smaller than the highest one.
            testkit::read_all(drive, now, |address| address);
        }
        testkit::up(testkit::bus(bus.spec.clone(), drives))
    });
    Plant::new(settings.gateway.clone(), Duration::from_secs(3600), buses.collect())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_listed_register_is_answered() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("drivegate.toml");
    std::fs::write(&file, configuration()).unwrap();
    let arguments = ["map", "--json", "--config", file.to_str().unwrap()];
    let output = tools::run(env!("CARGO_BIN_EXE_drivegate").as_ref(), &arguments);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let map: Value = serde_json::from_slice(&output.stdout).unwrap();
    let settings = Settings::load(&file, std::iter::empty()).settings.unwrap();
    let rig = Rig::of(plant(&settings), options()).await;
    let mut client = rig.client().await;
    let registers = map["registers"].as_array().unwrap();
    let (mut answered, mut written) = (0, 0);
    for row in registers {
        let number = |key: &str| row[key].as_u64().unwrap() as u16;
        let (unit, address, count) = (number("unit") as u8, number("address"), number("registers"));
        for table in row["table"].as_str().unwrap().split(", ") {
            let function = match table {
                "coil" => 1,
                "discrete-input" => 2,
                "holding" => 3,
                "input" => 4,
                other => panic!("no table {other}"),
            };
            let answer = client.ask(unit, &words(function, &[address, count])).await;
            assert_eq!(answer[0], function, "{row}");
            let bytes = if function < 3 { count.div_ceil(8) } else { 2 * count };
            assert_eq!(
                (usize::from(answer[1]), answer.len()),
                (bytes.into(), 2 + usize::from(bytes)),
                "{row}"
            );
            answered += 1;
        }
        // Where the map promises a write, it must not be refused for lack of a right or an address; the rest
        // depends on its value.
        if row["view"] == "command" && row["source"] != "none" {
            let value = if row["name"] == "command" { 0 } else { 100 };
            let request = words(6, &[address, value]);
            let answer = client.ask(unit, &request).await;
            if row["access"] == "read, write" {
                assert!(answer == request || answer == [0x86, 3], "{row}: {answer:?}");
                written += 1;
            } else {
                assert_eq!(answer, [0x86, 1], "{row}");
            }
        }
    }
    let profiles = Profiles::built_in().iter().count();
    assert!(
        answered > registers.len() && registers.len() > profiles * 2 * 34,
        "{answered} of {}",
        registers.len()
    );
    assert!(written >= profiles * 2, "{written}");
    rig.end().await;
}
