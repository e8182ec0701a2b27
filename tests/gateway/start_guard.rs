//! Guards and interlocks over every interface, across a kill and a reload, and with a disk that accepts nothing.

use serde_json::{Value as Json, json};

use crate::support::process::{Running, api, get, mbpoll_write, until, until_ready, write_registers};
use crate::support::site::{HTTP, LINE1, MODBUS_TCP, MQTT, Site, USERS, controlled};

const COMMAND: u16 = 0x8100;

/// `pump-1` is guarded, and needs `fan-2` to run.
fn site(guard: &str) -> Site {
    let line = LINE1.replace("profile_dirs", "state_dir = \"state\"\nprofile_dirs");
    let guarded = format!("guard = {guard}\ninterlocks = [{{ drive = \"fan-2\", point = \"running\" }}]");
    let drives = controlled("pump-1", 1, &guarded) + &controlled("fan-2", 2, "");
    let site = Site::of(&[&line, &drives, MODBUS_TCP, MQTT, HTTP, USERS]);
    site.add_user("alice");
    site
}

fn curl(site: &Site, drive: &str, body: &str) -> (u16, Json) {
    site.curl("alice", &format!("drives/{drive}/commands"), &["-d", body])
}

/// Stops `pump-1` and waits until its motor is at standstill.
fn stop(site: &Site) {
    write_registers(site.modbus, 1, COMMAND, &[0]);
    site.until_point("pump-1", "running", false);
}

fn starts(site: &Site, drive: &str) {
    let (status, answer) = until("a start", || {
        Some(curl(site, drive, "{\"run\": true}")).filter(|(status, _)| *status != 409)
    });
    assert_eq!((status, &answer["result"]), (200, &json!("confirmed")), "{answer}");
}

fn metric(site: &Site, reason: &str) -> Option<u64> {
    let (_, text) = get(site.http, "/metrics")?;
    let is_it = |line: &&str| {
        line.starts_with("drivegate_starts_refused_total{") && line.contains("pump-1") && line.contains(reason)
    };
    text.lines().find(is_it)?.rsplit(' ').next()?.parse().ok()
}

#[test]
fn starts_are_refused_and_wait_and_stops_pass() {
    let site = site("{ starts_per_hour = 3, min_off = \"4s\" }");
    let _simulator = site.simulate(&["--addresses", "1-2", "--baud", "38400"]);
    let _broker = site.broker();
    let mut gateway = site.run_ready();
    site.until_connected(true);
    site.until_state("pump-1", "ready");
    site.until_state("fan-2", "ready");

    // The interlock refuses the start, and every interface names the interlock in its own form.
    let (status, answer) = curl(&site, "pump-1", "{\"run\": true}");
    assert_eq!((status, &answer["result"]), (409, &json!("interlocked")), "{answer}");
    let message = answer["error"]["message"].as_str().unwrap();
    assert!(
        message.contains("`running` of fan-2 must be true, but is false"),
        "{message}"
    );
    let refused = mbpoll_write(site.modbus, 1, COMMAND, &[1]).unwrap_err();
    assert!(refused.to_lowercase().contains("busy"), "{refused}");
    let answer = site.ask("pump-1/set", "{\"run\": true}");
    assert_eq!(answer["result"], "interlocked", "{answer}");
    let shown = api(site.http, "pump-1");
    let words = shown["blocked_by"].as_array().unwrap();
    assert!(words.contains(&json!("interlocked")), "{shown}");

    starts(&site, "fan-2");
    site.until_point("fan-2", "running", true);
    starts(&site, "pump-1");
    stop(&site);

    // A start that comes too soon is refused with the time to wait, or waits for that time.
    let (status, answer) = curl(&site, "pump-1", "{\"run\": true}");
    assert_eq!((status, &answer["result"]), (409, &json!("guarded")), "{answer}");
    let retry = answer["retry_after_ms"].as_u64().unwrap();
    assert!((1..=4000).contains(&retry), "{answer}");
    let answer = site.ask("pump-1/set", "{\"run\": true}");
    assert!(
        answer["result"] == "guarded" && answer["retry_after_ms"].is_u64(),
        "{answer}"
    );
    let refused = mbpoll_write(site.modbus, 1, COMMAND, &[1]).unwrap_err();
    assert!(refused.to_lowercase().contains("busy"), "{refused}");
    let shown = api(site.http, "pump-1");
    let words = shown["blocked_by"].as_array().unwrap();
    assert!(words.contains(&json!("guarded")), "{shown}");
    let (status, answer) = curl(
        &site,
        "pump-1",
        "{\"run\": true, \"wait\": true, \"expires_ms\": 20000}",
    );
    assert_eq!((status, &answer["result"]), (200, &json!("confirmed")), "{answer}");
    assert!(answer["latency_ms"].as_f64().unwrap() > 100.0, "{answer}");
    assert!(metric(&site, "min_off") >= Some(3) && metric(&site, "interlock") >= Some(3));
    let (_, events) = get(site.http, "/api/v1/events/log?limit=100").unwrap();
    assert!(
        events.contains("\"guarded\"") && events.contains("\"interlock\""),
        "{events}"
    );

    // A gateway that was killed and started again has not forgotten the starts.
    stop(&site);
    gateway.signal("KILL");
    gateway.ended();
    assert!(site.file("state/starts.json").exists());
    let gateway = site.run();
    until_ready(site.http);
    site.until_state("pump-1", "ready");
    site.until_point("fan-2", "running", true);
    starts(&site, "pump-1");
    stop(&site);
    let (status, answer) = until("the hour", || {
        let (status, answer) = curl(&site, "pump-1", "{\"run\": true}");
        Some((status, answer)).filter(|(_, answer)| answer["retry_after_ms"].as_u64() > Some(60_000))
    });
    assert_eq!((status, &answer["result"]), (409, &json!("guarded")), "{answer}");
    // Under another name, the drive still has the same motor.
    site.change("name = \"pump-1\"", "name = \"pump-9\"");
    gateway.signal("HUP");
    until("the new name", || {
        get(site.http, "/api/v1/drives/pump-9").filter(|(status, _)| *status == 200)
    });
    site.until_state("pump-9", "ready");
    // The interlock needs fan-2, which the bus of the new configuration reads only after pump-9.
    site.until_point("fan-2", "running", true);
    let (status, answer) = curl(&site, "pump-9", "{\"run\": true}");
    assert!(
        status == 409 && answer["retry_after_ms"].as_u64() > Some(60_000),
        "{answer}"
    );
    drop::<Running>(gateway);
}

#[test]
fn a_disk_that_takes_nothing_refuses_starts_and_no_stops() {
    let site = site("{ starts_per_hour = 3 }");
    let _simulator = site.simulate(&["--addresses", "1-2", "--baud", "38400"]);
    let _broker = site.broker();
    let _gateway = site.run_ready();
    site.until_state("pump-1", "ready");
    site.until_state("fan-2", "ready");
    starts(&site, "fan-2");
    site.until_point("fan-2", "running", true);
    starts(&site, "pump-1");
    // A folder of this name prevents the file of starts from being written.
    until("the folder", || {
        std::fs::create_dir(site.file("state/starts.partial")).ok()
    });
    stop(&site);
    let (status, answer) = curl(&site, "pump-1", "{\"run\": true}");
    assert_eq!((status, &answer["result"]), (409, &json!("guarded")), "{answer}");
    let message = answer["error"]["message"].as_str().unwrap();
    assert!(
        message.contains("its start cannot be counted") && message.contains("starts.json"),
        "{message}"
    );
    // A refused start did not count.
    std::fs::remove_dir(site.file("state/starts.partial")).unwrap();
    starts(&site, "pump-1");
    stop(&site);
    starts(&site, "pump-1");
}

/// A reload that is refused, with another group, another stagger and another directory for the starts, changes none
/// of them.
#[test]
fn a_refused_reload_leaves_the_guards_as_they_were() {
    let line = LINE1.replace("profile_dirs", "state_dir = \"state\"\nprofile_dirs");
    let guarded = "group = \"both\"\nguard = { starts_per_hour = 5, stagger = \"20s\" }";
    let drives = controlled("pump-1", 1, guarded) + &controlled("fan-2", 2, guarded);
    let site = Site::of(&[&line, &drives, MODBUS_TCP, HTTP, USERS]);
    site.add_user("alice");
    let _simulator = site.simulate(&["--addresses", "1-2", "--baud", "38400"]);
    let gateway = site.run_ready();
    site.until_state("pump-1", "ready");
    site.until_state("fan-2", "ready");
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    site.change(
        &format!("127.0.0.1:{}", site.modbus),
        &taken.local_addr().unwrap().to_string(),
    );
    // Each drive gets a separate group.
    let text = std::fs::read_to_string(site.config()).unwrap();
    site.write(
        "drivegate.conf",
        &text.replacen("group = \"both\"", "group = \"own\"", 1),
    );
    site.change("stagger = \"20s\"", "stagger = \"1s\"");
    site.change("state_dir = \"state\"", "state_dir = \"elsewhere\"");
    gateway.signal("HUP");
    let log = gateway.until_printed("keeping the current configuration");
    assert!(log.contains("another program uses it"), "{log}");
    starts(&site, "pump-1");
    let (status, answer) = curl(&site, "fan-2", "{\"run\": true}");
    assert_eq!((status, &answer["result"]), (409, &json!("guarded")), "{answer}");
    assert!(answer["retry_after_ms"].as_u64() > Some(5_000), "{answer}");
    assert!(
        site.file("state/starts.json").exists(),
        "its starts are counted where they were"
    );
    assert!(!site.file("elsewhere/starts.json").exists());
}
