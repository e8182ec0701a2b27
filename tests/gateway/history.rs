//! History of a gateway: trends in memory; run hours, starts and events that survive a kill.

use std::fs;

use serde_json::Value;

use crate::support::process::{get, until, write_registers};
use crate::support::site::{HTTP, LINE1, MODBUS_TCP, Site, controlled};

fn site() -> Site {
    let gateway = LINE1.replace("[gateway]\n", "[gateway]\nstate_dir = \"state\"\n");
    Site::of(&[&gateway, &controlled("pump-1", 1, ""), MODBUS_TCP, HTTP])
}

fn json(site: &Site, path: &str) -> Value {
    let (status, body) = get(site.http, path).expect("an answer");
    assert_eq!(status, 200, "{path}: {body}");
    serde_json::from_str(&body).unwrap()
}

fn log(site: &Site, query: &str) -> Vec<Value> {
    let log = json(site, &format!("/api/v1/events/log{query}"));
    log.as_array().unwrap().clone()
}

/// The control word of a client that starts and stops the motor.
fn start_and_stop(site: &Site, times: usize) {
    for _ in 0..times {
        for (word, state) in [(1, "running"), (0, "ready")] {
            write_registers(site.modbus, 1, 33_024, &[word]);
            site.until_state("pump-1", state);
        }
    }
}

#[test]
fn counters_and_events_survive_a_kill() {
    let site = site();
    let _line = site.line(&[1]);
    let mut gateway = site.run_ready();
    start_and_stop(&site, 2);
    let drive = || json(&site, "/api/v1/drives/pump-1");
    until("two starts", || (drive()["starts"] == 2).then_some(()));
    site.until_metric("drivegate_drive_starts_total{bus=\"line1\",drive=\"pump-1\"} 2");
    let ran = drive()["running_seconds"].as_f64().unwrap();
    assert!(ran > 0.0);
    let started = log(&site, "?kind=started&limit=1").remove(0);
    assert!(
        started["by"].as_str().unwrap().starts_with("modbus_tcp 127.0.0.1"),
        "{started}"
    );
    until("the event on disk", || {
        let text = fs::read_to_string(site.file("state/events.jsonl")).ok()?;
        text.matches("\"stopped\"").nth(1).map(drop)
    });
    // An orderly end writes the counters; a later kill only loses what was counted since.
    gateway.signal("TERM");
    gateway.ended();
    let mut gateway = site.run_ready();
    assert_eq!(drive()["starts"], 2);
    assert!(drive()["running_seconds"].as_f64() >= Some(ran));
    start_and_stop(&site, 1);
    until("the third start", || (drive()["starts"] == 3).then_some(()));
    until("the event on disk", || {
        let text = fs::read_to_string(site.file("state/events.jsonl")).ok()?;
        text.matches("\"stopped\"").nth(2).map(drop)
    });
    gateway.signal("KILL");
    gateway.ended();
    let _gateway = site.run_ready();
    assert_eq!(drive()["starts"], 2, "the last whole file counts");
    let boots = |events: &[Value]| {
        let mut boots: Vec<String> = events.iter().map(|event| event["boot"].to_string()).collect();
        boots.dedup();
        boots.len()
    };
    let all = log(&site, "?limit=1000");
    assert_eq!(boots(&all), 3, "three runs, one after the other");
    assert_eq!(log(&site, "?kind=stopped&drive=pump-1").len(), 3);
    // The pages together contain every event once.
    let mut paged = all[..1].to_vec();
    while let Some(last) = paged.last().cloned() {
        let [boot, id] = ["boot", "id"].map(|key| last[key].to_string().replace('"', ""));
        let more = log(&site, &format!("?limit=3&before={boot}-{id}"));
        if more.is_empty() {
            break;
        }
        paged.extend(more);
    }
    assert_eq!(paged, all);
    assert!(log(&site, "?text=no%20such%20words").is_empty());
    assert_eq!(get(site.http, "/api/v1/events/log?kind=nonsense").unwrap().0, 400);
}

#[test]
fn a_state_directory_that_cannot_be_written_costs_the_history_only() {
    let site = site();
    fs::write(site.file("state"), "in the way").unwrap();
    let _line = site.line(&[1]);
    let gateway = site.run_ready();
    gateway.until_printed("cannot save events and counters");
    start_and_stop(&site, 1);
    assert_eq!(log(&site, "?kind=started").len(), 1, "they are in memory");
    fs::remove_file(site.file("state")).unwrap();
    gateway.until_printed("writing events and counters again; 0 events are missing");
    let text = fs::read_to_string(site.file("state/events.jsonl")).unwrap();
    assert!(text.contains("\"started\"") && text.contains("\"stopped\""), "{text}");
}

#[test]
fn a_trend_shows_the_motor_coming_up() {
    let site = site();
    let _line = site.line(&[1]);
    let _gateway = site.run_ready();
    write_registers(site.modbus, 1, 33_024, &[1, 5000]);
    site.until_state("pump-1", "running");
    let path = "/api/v1/drives/pump-1/trend?point=output_frequency,motor_current";
    let trend = until("a speed", || {
        let trend = json(&site, path);
        let samples = trend[0]["samples"].as_array().unwrap().clone();
        samples
            .iter()
            .any(|sample| sample[2].as_f64() > Some(1.0))
            .then_some(trend)
    });
    assert_eq!((&trend[0]["unit"], &trend[1]["unit"]), (&"Hz".into(), &"A".into()));
    assert_eq!(
        trend[0]["samples"].as_array().unwrap().len(),
        trend[1]["samples"].as_array().unwrap().len()
    );
    for sample in trend[0]["samples"]
        .as_array()
        .unwrap()
        .iter()
        .filter(|sample| !sample.is_null())
    {
        let [min, max, last] = [1, 2, 3].map(|place| sample[place].as_f64().unwrap());
        assert!(
            min <= last && last <= max && sample[0].as_u64().unwrap() % 1000 == 0,
            "{sample}"
        );
    }
    let kept = json(&site, "/api/v1/drives/pump-1/trend");
    assert_eq!(
        (
            kept["points"].as_array().unwrap().len(),
            kept["ranges"].as_array().unwrap().len()
        ),
        (10, 3)
    );
    let (_, csv) = get(site.http, "/api/v1/drives/pump-1/trend?format=csv&point=motor_current").unwrap();
    assert!(
        csv.starts_with("time,motor_current min [A],motor_current max [A],motor_current last [A]\r\n"),
        "{csv}"
    );
    for (query, status) in [
        ("?point=nonsense", 404),
        ("?from=tomorrow", 400),
        ("?from=1min&to=2min", 400),
        ("?span=1h", 400),
    ] {
        assert_eq!(
            get(site.http, &format!("/api/v1/drives/pump-1/trend{query}"))
                .unwrap()
                .0,
            status,
            "{query}"
        );
    }
    let line = json(&site, "/api/v1/buses/line1");
    assert_eq!(
        (
            line["hour"]["load_ratio"].as_array().unwrap().len(),
            line["by_drive"].as_array().unwrap().len()
        ),
        (60, 1)
    );
    assert_eq!(line["by_drive"][0]["errors"].as_array().unwrap().len(), 60);
    assert!(line["turnaround"]["count"].as_u64() > Some(0));
    assert_eq!(get(site.http, "/api/v1/buses/line9").unwrap().0, 404);
    assert_eq!(get(site.http, "/api/v1/audit?drive=pump-9").unwrap().0, 404);
    until("the order in the audit", || {
        json(&site, "/api/v1/audit?drive=pump-1").as_array()?.first().map(drop)
    });
}
