//! What is on the line when the gateway starts, dies and starts again; and a port that is not there.

use std::path::Path;

use drivegate::codec::LineFormat;
use drivegate::sim::drive::DriveOptions;
use drivegate::sim::endpoint::EndpointOptions;
use drivegate::sim::faults::FaultPlan;
use drivegate::sim::half_duplex::LineRules;
use drivegate::sim::statistics::Direction;
use drivegate::sim::wire::{SimulatedBus, SimulatedBusOptions};

use crate::process::{Running, api, free_port, get, mbpoll_read, until, until_ready};
use crate::tools::{run_well, tool};

fn line(path: &Path) -> SimulatedBus {
    line_of(path, &[1])
}

/// Simulated drives whose line is written down.
pub(crate) fn line_of(path: &Path, addresses: &[u8]) -> SimulatedBus {
    let rules = LineRules::new(LineFormat::new(38_400, "8N1").unwrap());
    let drives = addresses.iter().map(|a| DriveOptions::nx(*a)).collect();
    let options = SimulatedBusOptions::new("line1", rules, drives);
    let endpoint = EndpointOptions::Pty {
        link: Some(path.to_path_buf()),
    };
    SimulatedBus::start(SimulatedBusOptions {
        endpoint,
        transcript: 100_000,
        ..options
    })
    .unwrap()
}

fn configure(folder: &Path, extra: &str) -> (String, u16, u16) {
    let (modbus, http) = (free_port(), free_port());
    let file = folder.join("drivegate.toml");
    let text = format!(
        "[gateway]\nname = \"test\"\n[[bus]]\nname = \"line1\"\nport = \"{}\"\nbaud = 38400\nsilence = \"chars\"\n\
         [[bus.drive]]\nname = \"pump-1\"\naddress = 1\nprofile = \"vacon-nx\"\naccess = \"control\"\n{extra}\
         [modbus_tcp]\nlisten = [\"127.0.0.1:{modbus}\"]\nwrite = [\"127.0.0.1/32\"]\n\
         [http]\nlisten = \"127.0.0.1:{http}\"\n",
        folder.join("line1").display()
    );
    std::fs::write(&file, text).unwrap();
    (file.display().to_string(), modbus, http)
}

/// Function codes of the requests on the line.
pub(crate) fn functions(line: &SimulatedBus) -> Vec<u8> {
    let frames = line.transcript();
    frames
        .iter()
        .filter(|f| f.direction == Direction::ToDrives)
        .filter_map(|f| f.bytes.get(1).copied())
        .collect()
}

#[test]
fn no_control_word_is_written_at_start_after_a_kill_or_from_a_retained_message() {
    let folder = tempfile::tempdir().unwrap();
    let line = line(&folder.path().join("line1"));
    let mqtt = free_port();
    let broker_file = folder.path().join("mosquitto.conf");
    std::fs::write(
        &broker_file,
        format!("listener {mqtt} 127.0.0.1\nallow_anonymous true\n"),
    )
    .unwrap();
    let _broker = Running::start(&tool("mosquitto"), &["-c", &broker_file.display().to_string()]);
    until("the broker listens", || {
        std::net::TcpStream::connect(("127.0.0.1", mqtt)).ok()
    });
    let set = [
        "-t",
        "drivegate/test/drive/pump-1/set",
        "-m",
        "{\"run\": true}",
        "-r",
        "-q",
        "1",
    ];
    run_well(
        &tool("mosquitto_pub"),
        &[&["-h", "127.0.0.1", "-p", &mqtt.to_string()], &set[..]].concat(),
    );

    let (file, _, http) = configure(folder.path(), "");
    let text = std::fs::read_to_string(&file).unwrap();
    std::fs::write(
        &file,
        format!("{text}[mqtt]\nurl = \"mqtt://127.0.0.1:{mqtt}\"\ncommands = true\n"),
    )
    .unwrap();
    for _ in 0..2 {
        line.record(100_000);
        let mut gateway = Running::drivegate(&["run", "--config", &file]);
        until_ready(http);
        until("the refused retained message", || {
            get(http, "/metrics")?
                .1
                .contains("drivegate_writes_total{source=\"mqtt\"")
                .then_some(())
        });
        until("slow points were read", || {
            api(http, "pump-1")["points"]["run"]["value"].is_boolean().then_some(())
        });
        until("many polls", || (functions(&line).len() > 10).then_some(()));
        gateway.signal("KILL");
        gateway.ended();
        let functions = functions(&line);
        assert!(functions.iter().all(|f| *f == 3), "only reads: {functions:?}");
    }
    assert_eq!(line.statistics().silence_violations, 0);
}

/// A gateway whose drive was commanded and runs; the line is recorded from then on.
struct Plant {
    line: SimulatedBus,
    file: String,
    http: u16,
    gateway: Running,
    _folder: tempfile::TempDir,
}

/// `keys` stand in the section of the drive.
fn running(keys: &str) -> Plant {
    let folder = tempfile::tempdir().unwrap();
    let line = line(&folder.path().join("line1"));
    let (file, modbus, http) = configure(folder.path(), keys);
    let gateway = Running::drivegate(&["run", "--config", &file]);
    until_ready(http);
    crate::process::mbpoll_write(modbus, 1, 33_024, &[1]).unwrap();
    until("it runs", || (api(http, "pump-1")["state"] == "running").then_some(()));
    line.record(100_000);
    Plant {
        line,
        file,
        http,
        gateway,
        _folder: folder,
    }
}

#[test]
fn on_shutdown_stop_stops_and_hold_holds() {
    for (action, last) in [("stop", Some(6)), ("hold", None)] {
        let Plant {
            line,
            mut gateway,
            _folder,
            ..
        } = running(&format!("on_shutdown = \"{action}\"\n"));
        gateway.signal("TERM");
        let (status, _) = gateway.ended();
        assert!(status.success(), "{status}");
        let frames = line.transcript();
        let mut writes = frames.iter().filter(|f| f.bytes.get(1) != Some(&3));
        assert_eq!(
            writes.next().map(|f| (f.direction, f.bytes[1])),
            last.map(|function| (Direction::ToDrives, function)),
            "on_shutdown = {action}"
        );
        // The port closes behind the acknowledgement, which repeats the request.
        assert_eq!(writes.next().map(|f| f.direction), last.map(|_| Direction::FromDrives));
        assert_eq!(writes.count(), 0);
    }
}

#[test]
fn a_stop_that_nobody_acknowledges_holds_up_the_shutdown_for_a_bounded_time() {
    let Plant {
        line,
        mut gateway,
        _folder,
        ..
    } = running("on_shutdown = \"stop\"\n");
    line.set_faults(FaultPlan::new("deaf=1".parse().unwrap(), 1));
    gateway.signal("TERM");
    let (status, time) = gateway.ended();
    assert!(status.success(), "{status}");
    assert!(time < std::time::Duration::from_secs(5), "{time:?}");
    assert!(gateway.output().contains("not every drive acknowledged its stop"));
    let stops = functions(&line).into_iter().filter(|f| *f == 6).count();
    assert!(stops >= 2, "tried again: {stops}");
}

#[test]
fn a_drive_that_is_offline_when_the_gateway_stops_is_told_to_stop_all_the_same() {
    for back in [true, false] {
        let Plant {
            line,
            mut gateway,
            _folder,
            ..
        } = running("on_shutdown = \"stop\"\n");
        line.set_faults(FaultPlan::new("deaf=1".parse().unwrap(), 1));
        gateway.until_printed("drive pump-1 is offline");
        if back {
            line.set_faults(FaultPlan::default());
        }
        gateway.signal("TERM");
        let (status, _) = gateway.ended();
        assert!(status.success(), "{status}");
        assert!(functions(&line).contains(&6), "its stop is its probe");
        let named = gateway.output().contains("`pump-1` did not acknowledge its stop");
        assert_eq!(named, !back, "{}", gateway.output());
    }
}

#[test]
fn a_reload_that_opens_the_line_anew_writes_no_control_word() {
    let Plant {
        line,
        file,
        http,
        gateway,
        _folder,
    } = running("on_shutdown = \"stop\"\n");
    let text = std::fs::read_to_string(&file).unwrap();
    std::fs::write(&file, text.replace("silence = \"chars\"", "silence = \"spec\"")).unwrap();
    gateway.signal("HUP");
    gateway.until_printed("configuration reloaded");
    until("the control word was read again", || {
        (crate::process::point(http, "pump-1", "run") == true).then_some(())
    });
    let functions = functions(&line);
    assert!(
        functions.len() > 5 && functions.iter().all(|f| *f == 3),
        "only reads: {functions:?}"
    );
    assert_eq!(api(http, "pump-1")["state"], "running");
}

#[test]
fn a_port_that_is_not_there_is_waited_for() {
    let folder = tempfile::tempdir().unwrap();
    let (file, modbus, http) = configure(folder.path(), "");
    let _gateway = Running::drivegate(&["run", "--config", &file]);
    let (_, reasons) = until("503 from /readyz", || {
        get(http, "/readyz").filter(|(status, _)| *status == 503)
    });
    assert!(reasons.contains("line1"), "{reasons}");
    assert_eq!(get(http, "/healthz").unwrap().0, 200);
    assert_eq!(api(http, "pump-1")["state"], "offline");
    let refused = mbpoll_read(modbus, 1, 2100, 11).unwrap_err();
    assert!(refused.contains("path unavailable"), "{refused}");
    let _line = line(&folder.path().join("line1"));
    until_ready(http);
    until("values", || mbpoll_read(modbus, 1, 2100, 11).ok());
}

#[test]
fn a_reload_that_cannot_listen_changes_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let line = line(&folder.path().join("line1"));
    let (file, modbus, http) = configure(folder.path(), "");
    let gateway = Running::drivegate(&["run", "--config", &file]);
    until_ready(http);
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let text = std::fs::read_to_string(&file).unwrap();
    let other = text
        .replace(&modbus.to_string(), &taken.local_addr().unwrap().port().to_string())
        .replace("pump-1", "pump-2");
    std::fs::write(&file, other).unwrap();
    gateway.signal("HUP");
    let log = gateway.until_printed("reload rejected");
    assert!(log.contains("another program uses it"), "{log}");
    until("the old address", || mbpoll_read(modbus, 1, 2100, 1).ok());
    assert_eq!(api(http, "pump-1")["online"], true);
    drop(line);
}

#[test]
fn a_reload_does_not_end_supervision() {
    let folder = tempfile::tempdir().unwrap();
    let _line = line(&folder.path().join("line1"));
    let (file, modbus, http) = configure(folder.path(), "supervision = { timeout = \"3s\", action = \"stop\" }\n");
    let gateway = Running::drivegate(&["run", "--config", &file]);
    until_ready(http);
    crate::process::mbpoll_write(modbus, 1, 33_024, &[1]).unwrap();
    let text = std::fs::read_to_string(&file).unwrap();
    std::fs::write(&file, text.replace("silence = \"chars\"", "silence = \"spec\"")).unwrap();
    gateway.signal("HUP");
    gateway.until_printed("configuration reloaded");
    gateway.until_printed("no commanding client of pump-1");
    until("the stop", || {
        (crate::process::point(http, "pump-1", "run") == false).then_some(())
    });
}

/// Leaves a process room for that many open files more; `None` takes the limit back.
fn leave_room_for(pid: u32, more: Option<usize>) {
    let open: Vec<u32> = std::fs::read_dir(format!("/proc/{pid}/fd"))
        .unwrap()
        .map(|entry| entry.unwrap().file_name().to_string_lossy().parse().unwrap())
        .collect();
    let free = (0..).filter(|number| !open.contains(number));
    let limit = more.map_or(1024, |more| free.take(more).last().unwrap() + 1);
    let (pid, limit) = (pid.to_string(), format!("--nofile={limit}:"));
    run_well(&tool("prlimit"), &["--pid", &pid, &limit]);
}

#[test]
fn a_reload_without_room_for_a_new_bus_changes_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let _line = line(&folder.path().join("line1"));
    let (file, modbus, http) = configure(folder.path(), "");
    let gateway = Running::drivegate(&["run", "--config", &file]);
    until_ready(http);
    let text = std::fs::read_to_string(&file).unwrap();
    let more: String = (2..10)
        .map(|n| {
            format!(
                "[[bus]]\nname = \"line{n}\"\nport = \"/nowhere/line{n}\"\n[[bus.drive]]\nname = \"pump-{n}\"\n\
                 address = {n}\nprofile = \"vacon-nx\"\n"
            )
        })
        .collect();
    // The bus that runs is another one, too: it must not be ended for one that never comes.
    for silence in ["chars", "spec"] {
        let old = text.replace("[modbus_tcp]", &format!("{more}[modbus_tcp]"));
        std::fs::write(&file, old.replace("\"chars\"", &format!("\"{silence}\""))).unwrap();
        let refused = gateway.output().matches("reload rejected").count();
        leave_room_for(gateway.pid(), Some(3));
        gateway.signal("HUP");
        until("the refusal", || {
            (gateway.output().matches("reload rejected").count() > refused).then_some(())
        });
        leave_room_for(gateway.pid(), None);
        let log = gateway.output();
        assert!(
            log.contains("cannot start bus") && !log.contains("stopping the bus"),
            "{log}"
        );
        crate::process::mbpoll_write(modbus, 1, 33_024, &[1]).unwrap();
        assert_eq!(api(http, "pump-1")["online"], true);
        assert!(crate::process::point(http, "pump-1", "output_frequency").is_number());
    }
    gateway.signal("HUP");
    gateway.until_printed("configuration reloaded");
    until("the bus with its new settings", || {
        crate::process::mbpoll_write(modbus, 1, 33_024, &[0]).ok()
    });
}

#[test]
fn a_reload_carries_stale_after_to_the_buses_that_run() {
    let folder = tempfile::tempdir().unwrap();
    let _line = line(&folder.path().join("line1"));
    let (file, _, http) = configure(folder.path(), "");
    let slow = std::fs::read_to_string(&file)
        .unwrap()
        .replace("silence =", "cycle = \"2s\"\nsilence =");
    std::fs::write(&file, &slow).unwrap();
    let gateway = Running::drivegate(&["run", "--config", &file]);
    until_ready(http);
    let is_good = || crate::process::point(http, "pump-1", "output_frequency").is_number();
    until("values", || is_good().then_some(()));
    let written = slow.replace("[modbus_tcp]", "[modbus_tcp]\nstale_after = \"100ms\"");
    std::fs::write(&file, written).unwrap();
    gateway.signal("HUP");
    until("stale values", || (!is_good()).then_some(()));
    assert!(!gateway.output().contains("stopping the bus"));
    std::fs::write(&file, slow).unwrap();
    let taken = || gateway.output().matches("configuration reloaded").count();
    gateway.signal("HUP");
    until("the old file again", || (taken() == 2).then_some(()));
    assert!(is_good(), "three rounds of this bus are six seconds");
}
