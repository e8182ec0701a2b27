//! Parameters restored by a real gateway: the questions before, commands meanwhile, and a gateway that was killed in the
//! middle.

use std::fs;
use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::time::Duration;

use drivegate_proto::{Reply, RequestPdu, Table};
use drivegate_sim::wire::SimulatedBus;

use super::parameters::few;
use crate::support::process::{Running, api, drivegate, get, until, write_registers};
use crate::support::site::{HTTP, LINE1, MODBUS_TCP, Site};

struct Plant {
    site: Site,
    line: SimulatedBus,
}

/// Two drives, the second one with random parameters, and a file with those parameters.
fn plant(keys: &str) -> Plant {
    let site = Site::new();
    site.write("few.toml", &few());
    let gateway = format!(
        "[gateway]\nstate_dir = \"state\"\nsocket = \"{}\"\n",
        site.path("socket")
    );
    let gateway = LINE1.replace("[gateway]\n", &gateway);
    let drive = |name: &str, address: u8, keys: &str| {
        format!("[[bus.drive]]\nname = \"{name}\"\naddress = {address}\nprofile = \"few\"\n{keys}\n")
    };
    let pumps = [drive("pump-1", 1, keys), drive("pump-2", 2, "")].concat();
    site.configure(&[&gateway, &pumps, HTTP, MODBUS_TCP]);
    let line = site.line(&[1, 2]);
    line.with_drive(2, |drive, _| drive.fill_parameters(7)).unwrap();
    Plant { site, line }
}

const WRITABLE: &str = "access = \"control\"\nparams = \"write\"\n";

impl Plant {
    fn ran(&self, arguments: &[&str]) -> (Option<i32>, String, String) {
        let config = self.site.config();
        let output = drivegate(&[&["params"], arguments, &["--config", &config]].concat())
            .output()
            .unwrap();
        let text = |bytes| String::from_utf8(bytes).unwrap();
        (output.status.code(), text(output.stdout), text(output.stderr))
    }

    /// Runs a command that must succeed; returns its output.
    fn well(&self, arguments: &[&str]) -> (String, String) {
        let (code, printed, said) = self.ran(arguments);
        assert_eq!(code, Some(0), "{arguments:?}: {printed}{said}");
        (printed, said)
    }

    fn file(&self, drive: &str) -> String {
        let path = self.site.path(&format!("{drive}.params"));
        self.well(&["read", drive, "-o", &path]);
        path
    }

    /// Differences of two files, except for parameters that are only restored by name.
    fn differences(&self, before: &str, after: &str) -> Vec<String> {
        let (_, printed, said) = self.ran(&["diff", before, after]);
        assert!(!said.contains("error"), "{said}");
        let held_back = |line: &&str| {
            let id = line.split(' ').next().and_then(|id| id.parse::<u16>().ok());
            id.is_some_and(|id| [125, 731, 733, 734].contains(&id) || (850..=859).contains(&id))
        };
        printed
            .lines()
            .filter(|line| !held_back(line))
            .map(str::to_string)
            .collect()
    }

    fn held(&self) -> bool {
        api(self.site.http, "pump-1")["held"].is_string()
    }
}

#[test]
fn nothing_is_restored_without_leave_and_nothing_is_left_to_differ_with_it() {
    let plant = plant("access = \"control\"\n");
    let _gateway = plant.site.run_ready();
    let (before, wanted) = (plant.file("pump-1"), plant.file("pump-2"));
    let (code, _, said) = plant.ran(&["restore", &wanted, "pump-1", "--force", "--yes"]);
    assert_eq!((code, said.contains("params = \"write\"")), (Some(1), true), "{said}");
    plant.site.change("access = \"control\"\n", WRITABLE);
    let reload = drivegate(&["reload", "--config", &plant.site.config()])
        .output()
        .unwrap();
    assert!(reload.status.success(), "{reload:?}");
    until("the drive is read again", || {
        (api(plant.site.http, "pump-1")["online"] == true).then_some(())
    });

    let (code, _, said) = plant.ran(&["restore", &wanted, "pump-1", "--yes"]);
    assert_eq!((code, said.contains("--force")), (Some(1), true), "{said}");
    let (code, told, said) = plant.ran(&["restore", &wanted, "pump-1", "--force"]);
    assert_eq!(
        (code, said.contains("--yes")),
        (Some(1), true),
        "no terminal to ask on: {said}"
    );
    let (dry, _) = plant.well(&["restore", &wanted, "pump-1", "--force", "--dry-run"]);
    assert_eq!(dry, told);
    assert!(dry.contains("102 Maximum frequency: 50.00 Hz → "), "{dry}");
    assert_eq!(
        plant.differences(&before, "pump-1"),
        Vec::<String>::new(),
        "nothing was written"
    );

    let (_, said) = plant.well(&["restore", &wanted, "pump-1", "--force", "--yes"]);
    assert!(said.contains("`pump-1` has all "), "{said}");
    assert!(!plant.held());
    assert_eq!(plant.differences(&wanted, "pump-1"), Vec::<String>::new());
    let audit = plant.site.audit();
    let line = audit.iter().find(|line| line["points"][0]["point"] == "102").unwrap();
    assert_eq!(
        (&line["source"], &line["result"]),
        (&"local_socket".into(), &"confirmed".into()),
        "{line}"
    );
    assert_eq!(line["points"][0]["old"], 5000);
    let writes = plant.line.with_drive(1, |drive, _| drive.parameter_writes()).unwrap();
    assert!(writes.len() > 10);
    assert!(
        writes.values().all(|writes| (writes.taken, writes.while_fed) == (1, 0)),
        "{writes:?}"
    );
    let (_, said) = plant.well(&["restore", &wanted, "pump-1", "--force", "--yes"]);
    assert!(said.contains("nothing to restore"), "{said}");

    // The motor runs: nothing is written, and no client is locked out.
    write_registers(plant.site.modbus, 1, 33_024, &[1]);
    plant.site.until_state("pump-1", "running");
    let (code, _, said) = plant.ran(&["restore", &before, "pump-1", "--force", "--yes"]);
    assert_eq!((code, said.contains("the motor is running")), (Some(1), true), "{said}");
    assert!(!plant.held());
    write_registers(plant.site.modbus, 1, 33_024, &[0]);
}

/// How often the gateway is killed; the world test does it some hundred times.
const KILLS: u64 = 3;

#[test]
fn a_gateway_that_was_killed_in_the_middle_holds_the_drive_until_that_is_settled() {
    let plant = plant(WRITABLE);
    let mut gateway = plant.site.run_ready();
    let files = [plant.file("pump-1"), plant.file("pump-2")];
    let journal = plant.site.file("state/params/pump-1/restore.journal");
    let kills = std::env::var("RESTORE_KILLS").map_or(KILLS, |text| text.parse().unwrap());
    for kill in 0..kills {
        // The drive has the values of one file, and the values of the other are to be restored.
        let at_first = plant.differences(&files[0], "pump-1").is_empty();
        let (former, wanted) = if at_first {
            (&files[0], &files[1])
        } else {
            (&files[1], &files[0])
        };
        let command = [
            "params",
            "restore",
            wanted,
            "pump-1",
            "--force",
            "--yes",
            "--config",
            &plant.site.config(),
        ];
        let mut restore = Running::drivegate(&command);
        until("the journal", || journal.exists().then_some(()));
        let (code, _, said) = settle(&plant, &["write", "pump-1", "run=true"]);
        if code == Some(0) && !journal.exists() {
            // On a busy machine the restore may end before the order arrives.
            assert_eq!(settle(&plant, &["write", "pump-1", "run=false"]).0, Some(0));
            assert!(restore.ended().success());
            continue;
        }
        assert_eq!((code, said.contains("being restored")), (Some(1), true), "{said}");
        std::thread::sleep(Duration::from_millis(kill * 397 % 2000));
        gateway.signal("KILL");
        gateway.ended();
        restore.ended();
        if !journal.exists() {
            gateway = plant.site.run_ready();
            assert_eq!(plant.differences(wanted, "pump-1"), Vec::<String>::new());
            continue;
        }
        gateway = plant.site.run_ready();
        assert!(plant.held());
        let (code, _, said) = settle(&plant, &["write", "pump-1", "run=true"]);
        assert_eq!((code, said.contains("--resume pump-1")), (Some(1), true), "{said}");
        assert_eq!(
            function_6(plant.site.modbus, 0x8100, 1),
            [0x86, 0x01],
            "refused by Modbus TCP, too"
        );
        let (code, _, said) = settle(&plant, &["write", "pump-1", "run=false"]);
        assert_eq!(code, Some(0), "a stop is carried out: {said}");
        let (code, _, said) = plant.ran(&["restore", wanted, "pump-1", "--force", "--yes"]);
        assert_eq!((code, said.contains("half restored")), (Some(1), true), "{said}");
        let (how, expected) = match kill % 2 {
            0 => ("--resume", wanted),
            _ => ("--undo", former),
        };
        plant.well(&["restore", how, "pump-1"]);
        assert!(!plant.held() && !journal.exists());
        assert_eq!(plant.differences(expected, "pump-1"), Vec::<String>::new(), "{how}");
    }
    let writes = plant.line.with_drive(1, |drive, _| drive.parameter_writes()).unwrap();
    assert!(writes.values().all(|writes| writes.while_fed == 0), "{writes:?}");

    // A journal that cannot be read locks the drive, and is kept when it is set aside.
    gateway.signal("TERM");
    gateway.ended();
    fs::write(&journal, "# drivegate restore 7\n").unwrap();
    let _gateway = plant.site.run_ready();
    let (code, _, said) = settle(&plant, &["write", "pump-1", "run=true"]);
    assert_eq!((code, said.contains("cannot be read")), (Some(1), true), "{said}");
    let (code, _, said) = plant.ran(&["restore", "--resume", "pump-1"]);
    assert_eq!((code, said.contains("--release pump-1")), (Some(1), true), "{said}");
    let (_, said) = plant.well(&["restore", "--release", "pump-1"]);
    assert!(said.contains("restore.released"), "{said}");
    assert_eq!(
        fs::read_to_string(plant.site.file("state/params/pump-1/restore.released")).unwrap(),
        "# drivegate restore 7\n"
    );
    assert!(!plant.held());
    let (code, _, said) = settle(&plant, &["write", "pump-1", "run=true"]);
    assert_eq!(code, Some(0), "{said}");
}

/// A journal in the format of an earlier version, which names no machine, from a process killed in the middle of a
/// restore of 7 parameters.
const EARLIER: &str = include_str!("restore_1.journal");

#[test]
fn a_restore_that_an_earlier_version_began_is_resumed_and_undone() {
    for (how, place) in [("--resume", 2), ("--undo", 1)] {
        let plant = plant(WRITABLE);
        let journal = plant.site.file("state/params/pump-1/restore.journal");
        fs::create_dir_all(journal.parent().unwrap()).unwrap();
        fs::write(&journal, EARLIER).unwrap();
        let _gateway = plant.site.run_ready();
        assert!(plant.held());
        // Some of the values were written before the gateway was killed.
        let rows: Vec<Vec<u16>> = EARLIER
            .lines()
            .filter_map(|line| line.split_once(" kept "))
            .map(|(row, _)| row.split(' ').map(|word| word.parse().unwrap()).collect())
            .collect();
        assert_eq!(rows.len(), 7);
        for row in &rows[..3] {
            let write = RequestPdu::write_register(row[0], row[2]);
            let written = plant.line.with_drive(1, |drive, now| drive.answer(&write, now));
            assert_eq!(written.unwrap(), Some(Reply::Written));
        }
        plant.well(&["restore", how, "pump-1"]);
        assert!(!plant.held() && !journal.exists(), "{how}");
        for row in &rows {
            let read = RequestPdu::read(Table::Holding, row[0], 1);
            let has = plant.line.with_drive(1, |drive, now| drive.answer(&read, now));
            assert_eq!(has.unwrap(), Some(Reply::Registers(vec![row[place]])), "{how} {row:?}");
        }
    }
}

/// Function and first byte of the answer to a write of one register by Modbus TCP.
fn function_6(port: u16, register: u16, value: u16) -> [u8; 2] {
    let mut stream = TcpStream::connect(("127.0.0.1", port)).unwrap();
    let ([a, b], [c, d]) = (register.to_be_bytes(), value.to_be_bytes());
    stream.write_all(&[0, 1, 0, 0, 0, 6, 1, 6, a, b, c, d]).unwrap();
    let mut answer = [0; 9];
    stream.read_exact(&mut answer).unwrap();
    [answer[7], answer[8]]
}

/// Runs a `drivegate` command; returns exit code, standard output and standard error.
fn settle(plant: &Plant, arguments: &[&str]) -> (Option<i32>, String, String) {
    let config = plant.site.config();
    let output = drivegate(&[arguments, &["--config", &config]].concat())
        .output()
        .unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    (output.status.code(), text(output.stdout), text(output.stderr))
}

#[test]
fn without_a_gateway_the_command_restores_by_itself() {
    let plant = plant(WRITABLE);
    let (before, wanted) = (plant.file("pump-1"), plant.file("pump-2"));
    let (told, said) = plant.well(&["clone", "pump-2", "pump-1", "--force", "--yes"]);
    assert!(
        told.contains("102 Maximum frequency") && said.contains("has all"),
        "{told}{said}"
    );
    assert_eq!(plant.differences(&wanted, "pump-1"), Vec::<String>::new());
    // An interrupted restore also locks the drive for commands without a gateway.
    let command = [
        "params",
        "restore",
        &before,
        "pump-1",
        "--force",
        "--yes",
        "--config",
        &plant.site.config(),
    ];
    let mut restore = Running::drivegate(&command);
    let journal = plant.site.file("state/params/pump-1/restore.journal");
    until("the journal", || journal.exists().then_some(()));
    restore.signal("KILL");
    restore.ended();
    if journal.exists() {
        let (code, _, said) = settle(&plant, &["write", "pump-1", "run=true"]);
        assert_eq!((code, said.contains("--undo pump-1")), (Some(1), true), "{said}");
        plant.well(&["restore", "--undo", "pump-1"]);
        assert_eq!(plant.differences(&wanted, "pump-1"), Vec::<String>::new());
    }
    let (code, _, said) = plant.ran(&["restore", "--resume", "pump-1"]);
    assert_eq!((code, said.contains("nothing to resume")), (Some(1), true), "{said}");
}

/// A reload that gives the names of two drives to each other ends the restore; the drive that is half restored is held under its new
/// name, and the other one is neither held nor written to.
#[test]
fn a_restore_does_not_go_on_at_another_machine() {
    let plant = plant(WRITABLE);
    let _gateway = plant.site.run_ready();
    let (before, wanted) = (plant.file("pump-1"), plant.file("pump-2"));
    let config = plant.site.config();
    let command = [
        "params", "restore", &wanted, "pump-1", "--force", "--yes", "--config", &config,
    ];
    let mut restore = Running::drivegate(&command);
    let journal = plant.site.file("state/params/pump-1/restore.journal");
    until("a parameter", || {
        let writes = plant.line.with_drive(1, |drive, _| drive.parameter_writes()).unwrap();
        (!writes.is_empty()).then_some(())
    });
    let reload = || {
        let reloaded = drivegate(&["reload", "--config", &config]).output().unwrap();
        assert!(reloaded.status.success(), "{reloaded:?}");
    };
    for (from, to) in [("pump-1", "pump-x"), ("pump-2", "pump-1"), ("pump-x", "pump-2")] {
        plant.site.change(&format!("\"{from}\""), &format!("\"{to}\""));
    }
    reload();
    restore.ended();
    let held = until("the restore is over", || {
        let held = api(plant.site.http, "pump-2")["held"].as_str()?.to_string();
        held.contains("--undo pump-2").then_some(held)
    });
    assert!(held.contains("`pump-1` at address 1 on "), "{held}");
    assert!(journal.exists());
    assert!(
        api(plant.site.http, "pump-1")["held"].is_null(),
        "another machine has the name"
    );
    let others = plant.line.with_drive(2, |drive, _| drive.parameter_writes()).unwrap();
    assert!(others.is_empty(), "{others:?}");

    // While the drive is not configured, its journal belongs to no drive.
    let there = "name = \"pump-2\"\naddress = 1\n";
    plant.site.change(there, "name = \"pump-2\"\naddress = 3\n");
    let check = drivegate(&["check", "--config", &config]).output().unwrap();
    let said = String::from_utf8(check.stderr).unwrap();
    assert!(said.contains("belongs to `pump-1` at address 1 on "), "{said}");
    reload();
    let (_, events) = get(plant.site.http, "/api/v1/events/log?kind=restore_unfinished").unwrap();
    assert!(events.contains("which is not configured"), "{events}");
    plant.site.change("name = \"pump-2\"\naddress = 3\n", there);
    reload();
    until("the drive is read again", || {
        (api(plant.site.http, "pump-2")["online"] == true).then_some(())
    });
    plant.well(&["restore", "--undo", "pump-2"]);
    assert!(!journal.exists() && api(plant.site.http, "pump-2")["held"].is_null());
    assert_eq!(plant.differences(&before, "pump-2"), Vec::<String>::new());
}
