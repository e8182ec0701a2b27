//! Requests on the line when the gateway starts, is killed and starts again; and a port that does not exist.

use std::collections::BTreeSet;
use std::time::Duration;

use drivegate_sim::faults::FaultPlan;
use drivegate_sim::statistics::Direction;
use drivegate_sim::wire::SimulatedBus;

use crate::support::process::{Running, api, get, mbpoll_read, mbpoll_write, until, until_ready, write_registers};
use crate::support::site::{HTTP, LINE1, MODBUS_TCP, MQTT, Site, controlled, drive, functions};
use crate::support::tools::{run_well, tool};

/// A site with a gateway for `pump-1`; `keys` are further lines of the drive's section.
fn site(keys: &str) -> Site {
    Site::of(&[LINE1, &controlled("pump-1", 1, keys), MODBUS_TCP, HTTP])
}

/// Writes the control word as soon as that can be done.
fn command(site: &Site, word: u16) {
    write_registers(site.modbus, 1, 33_024, &[word]);
}

#[test]
fn no_control_word_is_written_at_start_after_a_kill_or_from_a_retained_message() {
    let site = Site::of(&[LINE1, &controlled("pump-1", 1, ""), MQTT, HTTP]);
    let line = site.line(&[1]);
    let _broker = site.broker();
    let set = ["-t", "drivegate/test/drive/pump-1/set", "-m", "{\"run\": true}", "-r"];
    site.publish(&set);
    for _ in 0..2 {
        line.record(100_000);
        let mut gateway = site.run_ready();
        site.until_metric("drivegate_writes_total{source=\"mqtt\"");
        until("slow points were read", || {
            site.point("pump-1", "run").is_boolean().then_some(())
        });
        until("many polls", || (functions(&line).len() > 10).then_some(()));
        gateway.signal("KILL");
        gateway.ended();
        let functions = functions(&line);
        assert!(functions.iter().all(|f| *f == 3), "only reads: {functions:?}");
    }
}

/// A gateway whose drive was commanded and runs; the line is recorded from then on.
struct Plant {
    site: Site,
    line: SimulatedBus,
    gateway: Running,
}

fn running(timeout: &str, keys: &str) -> Plant {
    let site = site(keys);
    site.change(
        "response_timeout = \"2s\"",
        &format!("response_timeout = \"{timeout}\""),
    );
    let line = site.line(&[1]);
    let gateway = site.run_ready();
    command(&site, 1);
    site.until_state("pump-1", "running");
    line.record(100_000);
    Plant { site, line, gateway }
}

#[test]
fn on_shutdown_stop_stops_and_hold_holds() {
    for (action, last) in [("stop", Some(6)), ("hold", None)] {
        let mut plant = running("5s", &format!("on_shutdown = \"{action}\""));
        plant.gateway.signal("TERM");
        let status = plant.gateway.ended();
        assert!(status.success(), "{status}");
        let frames = plant.line.transcript();
        let mut writes = frames.iter().filter(|f| f.bytes.get(1) != Some(&3));
        assert_eq!(
            writes.next().map(|f| (f.direction, f.bytes[1])),
            last.map(|function| (Direction::ToDrives, function)),
            "on_shutdown = {action}"
        );
        // The port closes after the acknowledgement, which repeats the request.
        assert_eq!(writes.next().map(|f| f.direction), last.map(|_| Direction::FromDrives));
        assert_eq!(writes.count(), 0);
    }
}

#[test]
fn a_stop_that_nobody_acknowledges_holds_up_the_shutdown_for_a_bounded_time() {
    let mut plant = running("100ms", "on_shutdown = \"stop\"");
    plant.line.set_faults(FaultPlan::new("deaf=1".parse().unwrap(), 1));
    plant.gateway.signal("TERM");
    let status = plant.gateway.ended();
    assert!(status.success(), "{status}");
    plant.gateway.until_printed("not every drive acknowledged its stop");
    let stops = functions(&plant.line).into_iter().filter(|f| *f == 6).count();
    assert!(stops >= 2, "tried again: {stops}");
}

#[test]
fn a_drive_that_is_offline_when_the_gateway_stops_is_told_to_stop_all_the_same() {
    for (back, timeout) in [(true, "2s"), (false, "100ms")] {
        let mut plant = running(timeout, "on_shutdown = \"stop\"");
        plant.line.set_faults(FaultPlan::new("deaf=1".parse().unwrap(), 1));
        plant.gateway.until_printed("drive pump-1 is offline");
        if back {
            plant.line.set_faults(FaultPlan::default());
        }
        plant.gateway.signal("TERM");
        let status = plant.gateway.ended();
        assert!(status.success(), "{status}");
        assert!(functions(&plant.line).contains(&6), "its stop is its probe");
        let output = plant.gateway.until_printed("drivegate has stopped");
        let named = output.contains("`pump-1` did not acknowledge its stop");
        assert_eq!(named, !back, "{output}");
    }
}

#[test]
fn a_reload_that_opens_the_line_anew_writes_no_control_word() {
    let Plant { site, line, gateway } = running("2s", "on_shutdown = \"stop\"");
    site.change("silence = \"chars\"", "silence = \"spec\"");
    gateway.signal("HUP");
    gateway.until_printed("configuration reloaded");
    site.until_point("pump-1", "run", true);
    let functions = functions(&line);
    assert!(
        functions.len() > 5 && functions.iter().all(|f| *f == 3),
        "only reads: {functions:?}"
    );
    site.until_state("pump-1", "running");
}

#[test]
fn a_port_that_is_not_there_is_waited_for() {
    let site = site("");
    let _gateway = site.run();
    let (_, reasons) = until("503 from /readyz", || {
        get(site.http, "/readyz").filter(|(status, _)| *status == 503)
    });
    assert!(reasons.contains("line1"), "{reasons}");
    assert_eq!(get(site.http, "/healthz").unwrap().0, 200);
    assert_eq!(api(site.http, "pump-1")["state"], "offline");
    let refused = mbpoll_read(site.modbus, 1, 2100, 11).unwrap_err();
    assert!(refused.contains("path unavailable"), "{refused}");
    let _line = site.line(&[1]);
    until_ready(site.http);
    until("values", || mbpoll_read(site.modbus, 1, 2100, 11).ok());
}

/// The address belongs to an interface that comes up after the gateway has started.
#[test]
fn an_address_that_is_not_there_keeps_no_drive_from_being_polled() {
    let site = site("");
    let _line = site.line(&[1]);
    let [here, nowhere] = ["127.0.0.1", "203.0.113.1"].map(|host| format!("\"{host}:{}\"", site.modbus));
    site.change(&here, &nowhere);
    let gateway = site.run();
    let log = gateway.until_printed("Modbus TCP: not listening: Cannot assign requested address");
    assert!(log.contains("the drives are polled"), "{log}");
    until("the drive", || {
        (api(site.http, "pump-1")["online"] == true).then_some(())
    });
    let (status, reasons) = until("readiness", || get(site.http, "/readyz"));
    assert_eq!(status, 503);
    assert!(
        reasons.contains("Modbus TCP does not listen on 203.0.113.1"),
        "{reasons}"
    );
    site.until_metric("drivegate_listener_up{server=\"modbus_tcp\"} 0");
    site.until_metric("drivegate_listener_up{server=\"http\"} 1");
    site.change(&nowhere, &here);
    gateway.signal("HUP");
    until_ready(site.http);
    site.until_metric("drivegate_listener_up{server=\"modbus_tcp\"} 1");
    until("values", || mbpoll_read(site.modbus, 1, 2100, 11).ok());
}

#[test]
fn a_reload_that_cannot_listen_changes_nothing() {
    let site = site("");
    let _line = site.line(&[1]);
    let gateway = site.run_ready();
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port();
    site.change(&site.modbus.to_string(), &port.to_string());
    site.change("pump-1", "pump-2");
    gateway.signal("HUP");
    let log = gateway.until_printed("reload rejected");
    assert!(log.contains("another program uses it"), "{log}");
    until("the old address", || mbpoll_read(site.modbus, 1, 2100, 1).ok());
    assert_eq!(api(site.http, "pump-1")["online"], true);
}

#[test]
fn a_reload_does_not_end_supervision() {
    let site = site("supervision = { timeout = \"3s\", action = \"stop\" }");
    let _line = site.line(&[1]);
    let gateway = site.run_ready();
    command(&site, 1);
    site.change("silence = \"chars\"", "silence = \"spec\"");
    gateway.signal("HUP");
    gateway.until_printed("configuration reloaded");
    gateway.until_printed("no client has commanded pump-1");
    site.until_point("pump-1", "run", false);
}

/// Permanently limits a process to `more` open files beyond the present ones.
fn leave_room_for(pid: u32, more: usize) {
    let open = || -> BTreeSet<u32> {
        let files = std::fs::read_dir(format!("/proc/{pid}/fd")).unwrap();
        files
            .map(|entry| entry.unwrap().file_name().to_string_lossy().parse().unwrap())
            .collect()
    };
    // A file that is open for a moment would leave more room.
    let mut before = BTreeSet::new();
    let open = until("the same files at two moments", || {
        std::thread::sleep(Duration::from_millis(200));
        let now = open();
        let same = now == before;
        before.clone_from(&now);
        same.then_some(now)
    });
    let free = (0..).filter(|number| !open.contains(number));
    let limit = free.take(more).last().unwrap() + 1;
    let (pid, limit) = (pid.to_string(), format!("--nofile={limit}"));
    run_well(&tool("prlimit"), &["--pid", &pid, &limit]);
}

#[test]
fn a_reload_without_room_for_a_new_bus_changes_nothing() {
    let site = site("");
    let _line = site.line(&[1]);
    let gateway = site.run_ready();
    let more: String = (2..10)
        .map(|n| {
            format!(
                "[[bus]]\nname = \"line{n}\"\nport = \"/nowhere/line{n}\"\n[[bus.drive]]\nname = \"pump-{n}\"\n\
                 address = {n}\nprofile = \"vacon-nx\"\n"
            )
        })
        .collect();
    let more = format!("{more}[modbus_tcp]");
    let before = site.change("[modbus_tcp]", &more);
    leave_room_for(gateway.pid(), 6);
    let refusals = || gateway.output().matches("reload rejected").count();
    // The second time, another bus is running; it must not be ended for a bus that never starts.
    for refused in 1..=2 {
        gateway.signal("HUP");
        until("the refusal", || (refusals() == refused).then_some(()));
        let log = gateway.output();
        assert!(
            log.contains("cannot start bus") && !log.contains("stopping the bus"),
            "{log}"
        );
        command(&site, 1);
        assert_eq!(api(site.http, "pump-1")["online"], true);
        assert!(site.point("pump-1", "output_frequency").is_number());
        if refused == 1 {
            site.change("silence = \"chars\"", "silence = \"spec\"");
        }
    }
    site.configure(&[&before.replace("silence = \"chars\"", "silence = \"spec\"")]);
    gateway.signal("HUP");
    gateway.until_printed("configuration reloaded");
    command(&site, 0);
}

#[test]
fn a_reload_carries_stale_after_to_the_buses_that_run() {
    let site = site("");
    let _line = site.line(&[1]);
    let slow = LINE1.replace("silence =", "cycle = \"1h\"\nsilence =");
    let patient = slow.replace("[gateway]\n", "[gateway]\nstale_after = \"1h\"\n");
    site.configure(&[&patient, &controlled("pump-1", 1, ""), MODBUS_TCP, HTTP]);
    let gateway = site.run_ready();
    let is_good = || site.point("pump-1", "output_frequency").is_number();
    until("values", || is_good().then_some(()));
    let before = site.change("stale_after = \"1h\"", "stale_after = \"100ms\"");
    gateway.signal("HUP");
    until("stale values", || (!is_good()).then_some(()));
    assert!(!gateway.output().contains("stopping the bus"));
    site.configure(&[&before]);
    gateway.signal("HUP");
    until("good values", || is_good().then_some(()));
    assert!(!gateway.output().contains("the bus ends"));
}

/// The run bits of the control words that were written to `pump-1`.
fn words(line: &SimulatedBus) -> Vec<u8> {
    let mut frames = line.transcript();
    frames.retain(|frame| frame.direction == Direction::ToDrives && frame.bytes.starts_with(&[1, 6, 0x07, 0xD0]));
    frames.iter().map(|frame| frame.bytes[5] & 1).collect()
}

/// Whether an order to the only drive that is commanded waits or was written.
fn is_accepted(site: &Site, line: &SimulatedBus) -> bool {
    let (_, buses) = get(site.http, "/api/v1/buses").unwrap();
    !buses.contains("\"queue_depth\":0") || !words(line).is_empty()
}

/// Waits until the last frame on the line is one of the second drive: a request, unless its last reply came this moment.
fn until_the_other_is_asked(line: &SimulatedBus) {
    until("a request to the other drive", || {
        (line.transcript().last()?.bytes.first() == Some(&2)).then_some(())
    });
}

/// The drive whose slow poll is on the line when the gateway ends has a time limit of its own.
#[test]
fn a_slow_drive_on_the_line_costs_no_other_drive_its_stop_at_the_end() {
    let slow = drive("meter-2", 2, "response_timeout = \"5s\"");
    let line = LINE1.replace("response_timeout = \"2s\"", "response_timeout = \"200ms\"");
    let site = Site::of(&[
        &line,
        &controlled("pump-1", 1, "on_shutdown = \"stop\""),
        &slow,
        MODBUS_TCP,
        HTTP,
    ]);
    let line = site.line(&[1, 2]);
    let mut gateway = site.run_ready();
    command(&site, 1);
    site.until_state("pump-1", "running");
    line.record(100_000);
    line.set_faults(FaultPlan::new("late:3s=1".parse().unwrap(), 1).only(&[2]));
    until_the_other_is_asked(&line);
    gateway.signal("TERM");
    let status = gateway.ended();
    assert!(status.success(), "{status}");
    assert_eq!(words(&line).first(), Some(&0), "the motor runs on");
    assert!(!gateway.output().contains("its bus is down"), "{}", gateway.output());
}

/// A reload that removes the drive waits as long.
#[test]
fn a_slow_drive_on_the_line_costs_no_removed_drive_its_last_stop() {
    let slow = drive("meter-2", 2, "response_timeout = \"5s\"");
    let removed = controlled("pump-1", 1, "");
    let site = Site::of(&[LINE1, &removed, &slow, MODBUS_TCP, HTTP]);
    let line = site.line(&[1, 2]);
    let gateway = site.run_ready();
    command(&site, 1);
    site.until_state("pump-1", "running");
    line.record(100_000);
    line.set_faults(FaultPlan::new("late:3s=1".parse().unwrap(), 1).only(&[2]));
    site.change(&removed, "");
    let stopped = std::thread::scope(|scope| {
        until_the_other_is_asked(&line);
        let stop = scope.spawn(|| mbpoll_write(site.modbus, 1, 33_024, &[0]));
        until("the stop waits", || is_accepted(&site, &line).then_some(()));
        gateway.reload();
        stop.join().unwrap()
    });
    assert_eq!(words(&line).last(), Some(&0), "the motor runs on: {stopped:?}");
}

/// A gateway whose `pump-1` runs by an order over MQTT; nothing is configured to stop it with the gateway. `faults` begin
/// then, and `waits` says when the stop, which follows over MQTT, is accepted and waits: the gateway is ended at that moment.
fn ends_before_a_stop(keys: &str, faults: FaultPlan, waits: impl Fn(&Site, &SimulatedBus) -> bool) {
    let line = LINE1.replace("profile_dirs", "state_dir = \"state\"\nprofile_dirs");
    let site = Site::of(&[&line, &controlled("pump-1", 1, keys), MQTT, HTTP]);
    let line = site.line(&[1]);
    let _broker = site.broker();
    let mut gateway = site.run_ready();
    site.until_connected(true);
    site.order("pump-1/set", "{\"run\": true}");
    site.until_state("pump-1", "running");
    line.record(100_000);
    line.set_faults(faults);
    let answer = std::thread::scope(|scope| {
        let stop = scope.spawn(|| site.ask("pump-1/set", "{\"run\": false}"));
        until("the stop waits", || waits(&site, &line).then_some(()));
        gateway.signal("TERM");
        let status = gateway.ended();
        assert!(status.success(), "{status}");
        stop.join().unwrap()
    });
    assert_eq!(words(&line).last(), Some(&0), "the motor runs on: {answer}");
    assert_eq!(answer["ok"], true, "{answer}");
}

#[test]
fn an_accepted_stop_that_min_run_delays_is_sent_before_the_gateway_ends() {
    let waits = |site: &Site, _: &SimulatedBus| api(site.http, "pump-1")["stop_waits_ms"].is_u64();
    ends_before_a_stop("guard = { min_run = \"1h\" }", FaultPlan::default(), waits);
}

#[test]
fn an_accepted_stop_behind_a_slow_transaction_is_sent_before_the_gateway_ends() {
    let slow = FaultPlan::new("late:900ms=1".parse().unwrap(), 1);
    ends_before_a_stop("", slow, is_accepted);
}
