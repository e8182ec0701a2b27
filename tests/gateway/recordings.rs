//! Recordings of a running gateway: made by command and by fault, read by the command line, HTTP and MQTT.

use std::fs;

use drivegate_sim::wire::SimulatedBus;
use serde_json::Value;

use crate::support::process::{Running, drivegate, get, point, until};
use crate::support::site::{HTTP, LINE1, MODBUS_TCP, Site, drive};
use crate::support::tools::{run_well, tool};

/// A gateway that records a drive for a second before and after.
fn start(recordings: &str) -> (Site, Running, SimulatedBus) {
    let site = Site::new();
    let gateway = LINE1.replace(
        "[gateway]\n",
        &format!(
            "[gateway]\nstate_dir = \"state\"\nsocket = \"{}\"\n",
            site.path("socket")
        ),
    );
    let recordings = format!("[recordings]\nbefore = \"2s\"\nafter = \"300ms\"\n{recordings}");
    site.configure(&[&gateway, &drive("pump-1", 1, ""), HTTP, MODBUS_TCP, &recordings]);
    let line = site.line(&[1]);
    let gateway = site.run_ready();
    (site, gateway, line)
}

/// Standard output of a command that succeeds.
fn printed(site: &Site, arguments: &[&str]) -> String {
    let config = site.config();
    let arguments = [arguments, &["--config", &config]].concat();
    let output = drivegate(&arguments).output().unwrap();
    assert!(output.status.success(), "{arguments:?}: {output:?}");
    String::from_utf8(output.stdout).unwrap()
}

fn listed(site: &Site) -> Vec<Value> {
    let (status, body) = get(site.http, "/api/v1/recordings").expect("an answer");
    assert_eq!(status, 200);
    serde_json::from_str(&body).unwrap()
}

#[test]
fn a_recording_by_command_is_listed_shown_and_exported() {
    let (site, _gateway, _line) = start("");
    let id = printed(&site, &["record", "pump-1"]).trim().to_string();
    assert!(id.ends_with("-pump-1"), "{id}");
    until("the recording", || {
        listed(&site)
            .first()
            .cloned()
            .filter(|entry| entry["id"] == id.as_str())
    });
    assert!(printed(&site, &["recordings"]).contains(&id));
    let list: Value = serde_json::from_str(&printed(&site, &["recordings", "list", "--json"])).unwrap();
    assert_eq!(list, Value::from(listed(&site)));
    let shown = printed(&site, &["recordings", "show", &id]);
    assert!(
        shown.contains("trigger  command") && shown.contains("requested by uid "),
        "{shown}"
    );
    let json: Value = serde_json::from_str(&printed(&site, &["recordings", "export", &id, "--json"])).unwrap();
    assert!(json["samples"].as_array().unwrap().len() > 2 && !json["frames"].as_array().unwrap().is_empty());
    let (status, body) = get(site.http, &format!("/api/v1/recordings/{id}")).unwrap();
    assert_eq!((status, serde_json::from_str::<Value>(&body).unwrap()), (200, json));
    assert_eq!(get(site.http, "/api/v1/recordings/..%2Fx").unwrap().0, 404);
    let csv = printed(&site, &["recordings", "export", &id, "--csv"]);
    assert!(csv.starts_with("time,t_s,"), "{csv}");
    let capture = site.path("frames.pcapng");
    printed(&site, &["recordings", "export", &id, "--pcap", "--output", &capture]);
    assert_eq!(fs::read(&capture).unwrap()[..4], [0x0A, 0x0D, 0x0D, 0x0A]);
    // The commands run on a machine without the configuration.
    let url = format!("http://127.0.0.1:{}", site.http);
    for command in [
        &["recordings", "list", "--json"][..],
        &["recordings", "list"],
        &["recordings", "show", &id],
        &["recordings", "export", &id, "--csv"],
        &["recordings", "export", &id, "--json"],
    ] {
        let output = drivegate(&[command, &["--url", &url]].concat()).output().unwrap();
        assert_eq!(
            String::from_utf8(output.stdout).unwrap(),
            printed(&site, command),
            "{command:?}"
        );
    }
    let unknown = drivegate(&["recordings", "show", "x", "--url", &url]).output().unwrap();
    let told = String::from_utf8(unknown.stderr).unwrap();
    assert_eq!(unknown.status.code(), Some(1));
    assert!(told.contains("there is no recording `x`"), "{told}");
    // HTTP serves equal files, with a name.
    assert_eq!(
        get(site.http, &format!("/api/v1/recordings/{id}?format=csv")).unwrap(),
        (200, csv)
    );
    let url = format!("http://localhost:{}/api/v1/recordings/{id}?format=pcap", site.http);
    let file = site.path("over-http.pcapng");
    let headers = run_well(&tool("curl"), &["-sS", "-D", "-", "-o", &file, &url]);
    assert!(
        headers.contains(&format!("attachment; filename=\"{id}.pcapng\"")),
        "{headers}"
    );
    assert_eq!(fs::read(&file).unwrap(), fs::read(&capture).unwrap());
    let (status, refused) = get(site.http, &format!("/api/v1/recordings/{id}?format=xml")).unwrap();
    assert_eq!(status, 400);
    assert!(refused.contains("it is `json`, `csv`, `pcap` or `dgrec`"), "{refused}");
    site.until_metric("drivegate_recordings_total{trigger=\"command\"} 1");
    // A truncated file is reported, with the place.
    let file = site.file("state/recordings").join(format!("{id}.dgrec"));
    let bytes = fs::read(&file).unwrap();
    fs::write(site.file("half.dgrec"), &bytes[..bytes.len() / 2]).unwrap();
    let half = drivegate(&["recordings", "show", &site.path("half.dgrec")])
        .output()
        .unwrap();
    let told = String::from_utf8(half.stderr).unwrap();
    assert_eq!(half.status.code(), Some(1));
    assert!(told.contains("it is truncated, at byte "), "{told}");
    let unknown = drivegate(&["recordings", "show", "x", "--config", &site.config()])
        .output()
        .unwrap();
    assert_eq!(unknown.status.code(), Some(1));
}

#[test]
fn a_fault_makes_a_recording_and_a_directory_that_cannot_be_written_costs_that_only() {
    let (site, gateway, line) = start("");
    fs::create_dir_all(site.file("state")).unwrap();
    fs::write(site.file("state/recordings"), "in the way").unwrap();
    let trip = |code| assert!(line.with_drive(1, |drive, _| drive.trip(code)).is_some());
    trip(1);
    gateway.until_printed("cannot write the recording of pump-1");
    fs::remove_file(site.file("state/recordings")).unwrap();
    let unasked = until("the recording that could not be written", || {
        listed(&site).first().cloned()
    });
    assert!(
        unasked["summary"].as_str().unwrap().starts_with("fault 1: "),
        "{unasked}"
    );
    line.with_drive(1, |drive, _| drive.set_reset(true));
    until("the end of the fault", || {
        (point(site.http, "pump-1", "fault") == false).then_some(())
    });
    line.with_drive(1, |drive, _| drive.set_reset(false));
    trip(2);
    let entry = until("the recording", || {
        listed(&site).into_iter().find(|entry| *entry != unasked)
    });
    assert_eq!(entry["trigger"], "fault");
    let summary = entry["summary"].as_str().unwrap();
    assert!(summary.starts_with("fault 2: "), "{summary}");
    // The event of the fault already has the cause.
    let made = format!("recording {}", entry["id"].as_str().unwrap());
    let log = until("the event", || {
        let (_, events) = get(site.http, "/api/v1/events/log?kind=recording").expect("an answer");
        events.contains(&made).then_some(events)
    });
    let events: Value = serde_json::from_str(&log).unwrap();
    assert_eq!(events[0]["text"], made.as_str());
    assert_eq!(events[0]["recording"]["summary"], summary);
}
