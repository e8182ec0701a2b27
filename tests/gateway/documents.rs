//! Commands whose output is for programs: JSON, completions, manual pages; and the variable that names the configuration.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader};
use std::process::Stdio;

use serde_json::{Value, json};

use crate::support::process::{drivegate, until};
use crate::support::site::{HTTP, LINE1, Site, controlled};

/// The exit code of a command, the document that it prints, and its messages.
fn told(arguments: &[&str]) -> (Option<i32>, Value, String) {
    let output = drivegate(arguments).output().unwrap();
    let document = serde_json::from_slice(&output.stdout);
    let document = document.unwrap_or_else(|error| panic!("{arguments:?}: {error}: {output:?}"));
    (
        output.status.code(),
        document,
        String::from_utf8(output.stderr).unwrap(),
    )
}

/// A gateway with two drives; one of them does not answer.
fn site() -> Site {
    let gateway = LINE1.replace("[gateway]\n", "[gateway]\nstate_dir = \"state\"\n");
    let rest = "[drill]\n[authority]\nmode = \"exclusive\"\nlease = \"30s\"\n";
    Site::of(&[
        &gateway.replace("\"2s\"", "\"200ms\""),
        &controlled("pump-1", 1, ""),
        &controlled("fan-2", 2, ""),
        HTTP,
        rest,
    ])
}

#[test]
fn every_command_with_a_list_or_a_result_prints_it_as_json() {
    let site = site();
    let config = site.config();
    let with = |command: &[&'static str]| told(&[command, &["--json", "--config", &config]].concat());
    let commands: BTreeMap<&str, Vec<&'static str>> = BTreeMap::from([
        ("health", vec!["health"]),
        ("hold", vec!["hold", "pump-1"]),
        ("drills", vec!["drill", "list"]),
        ("stop-all", vec!["stop-all"]),
        ("write", vec!["write", "pump-1", "run=true"]),
        ("watch", vec!["watch", "--once"]),
    ]);
    // Refusals are JSON documents as well. Without a gateway, `write` opens the port itself; the port does not exist here.
    for (name, command) in &commands {
        let (code, document, said) = with(command);
        assert_eq!(code, Some(1), "{name}: {document}");
        match *name {
            "health" => assert_eq!(document["ready"], false),
            _ => assert!(
                document["error"].as_str().is_some_and(|why| said.contains(why)),
                "{name}: {document}: {said}"
            ),
        }
    }
    let _line = site.line(&[1]);
    let _gateway = site.run_ready();
    let ready = until("both drives to be known", || {
        let (code, document, said) = with(&commands["health"]);
        (code == Some(0)).then_some((document, said))
    });
    assert_eq!(ready, (json!({"ready": true, "reasons": []}), String::new()));
    let (code, held, _) = with(&commands["hold"]);
    assert_eq!(
        (code, &held["drive"], &held["hold"]),
        (Some(0), &json!("pump-1"), &json!("free"))
    );
    assert_eq!(with(&commands["drills"]), (Some(0), json!([]), String::new()));
    let taken = told(&["hold", "pump-1", "take", "--json", "--config", &config]);
    assert_eq!((taken.0, &taken.1["hold"]), (Some(0), &json!("held")));
    let (code, run, said) = with(&commands["write"]);
    assert_eq!(
        (code, &run["ok"], &run["drive"]),
        (Some(0), &json!(true), &json!("pump-1")),
        "{said}"
    );
    let (code, refused, said) = with(&["write", "pump-1", "speed_reference=900"]);
    assert_eq!((code, &refused["ok"]), (Some(1), &json!(false)), "{refused}");
    assert!(said.contains(refused["error"]["message"].as_str().unwrap()), "{said}");
    let (code, mistaken, said) = with(&["write", "pump-1", "nonsense=1"]);
    assert!(
        code != Some(0) && !said.is_empty() && mistaken["error"].is_string(),
        "{mistaken}"
    );
    // One of the drives does not answer, so not all are proven to stand.
    let (code, stopped, _) = with(&commands["stop-all"]);
    assert_eq!((code, &stopped["ok"]), (Some(1), &json!(false)), "{stopped}");
    assert_eq!(stopped["drives"].as_array().map(Vec::len), Some(2));
    let (code, once, _) = with(&commands["watch"]);
    assert_eq!((code, &once["drives"][0]["name"]), (Some(0), &json!("pump-1")));
    // Without --once, lines are printed continuously until the reader closes the pipe.
    let mut live = drivegate(&["watch", "--json", "--config", &config])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(live.stdout.take().unwrap()).lines();
    for _ in 0..3 {
        let line: Value = serde_json::from_str(&lines.next().unwrap().unwrap()).unwrap();
        assert_eq!(line["buses"][0]["name"], "line1");
    }
    drop(lines);
    assert!(live.wait().unwrap().success());
}

#[test]
fn a_scan_and_the_profiles_as_json() {
    let site = site();
    let _line = site.line(&[3]);
    let port = site.path("line1");
    let scan = [
        "scan",
        "--json",
        "--port",
        &port,
        "--protocol",
        "modbus-rtu",
        "--baud",
        "38400",
        "--format",
        "8N1",
    ];
    // On a busy machine the drive may answer too late for a search.
    let found = until("the drive", || {
        let (code, found, _) = told(&[&scan[..], &["--addresses", "1-4"]].concat());
        (code == Some(0)).then_some(found)
    });
    assert_eq!(found["drives"][0]["address"], 3, "{found}");
    assert_eq!(
        (&found["drives"][0]["baud"], &found["drives"][0]["format"]),
        (&json!(38400), &json!("8N1"))
    );
    let (code, empty, said) = told(&[&scan[..], &["--addresses", "8-9"]].concat());
    assert_eq!((code, &empty["drives"]), (Some(1), &json!([])));
    assert!(!said.is_empty());
    let (code, refused, _) = told(&["scan", "--json", "--port", &site.path("nowhere")]);
    assert!(code == Some(1) && refused["error"].is_string(), "{refused}");
    let (code, profiles, _) = told(&["profiles", "--json"]);
    let names: Vec<_> = profiles
        .as_array()
        .unwrap()
        .iter()
        .map(|profile| &profile["name"])
        .collect();
    assert!(code == Some(0) && names.contains(&&json!("vacon-cx")), "{names:?}");
}

#[test]
fn completions_and_manual_pages_of_every_command() {
    for shell in ["bash", "zsh", "fish"] {
        let output = drivegate(&["completions", shell]).output().unwrap();
        let text = String::from_utf8(output.stdout).unwrap();
        assert!(output.status.success() && text.contains("stop-all"), "{shell}: {text}");
    }
    assert_eq!(
        drivegate(&["completions", "tcsh"]).output().unwrap().status.code(),
        Some(2)
    );
    let site = Site::new();
    let output = drivegate(&["man", &site.path("pages")]).output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let page = std::fs::read_to_string(site.file("pages/drivegate-stop-all.1")).unwrap();
    assert!(page.contains("Stops every controlled drive"), "{page}");
    site.write("file", "");
    let refused = drivegate(&["man", &site.path("file")]).output().unwrap();
    assert_eq!(refused.status.code(), Some(1));
}

#[test]
fn the_variable_names_the_configuration_where_the_option_is_missing() {
    let site = site();
    let run = |arguments: &[&str]| {
        let output = drivegate(arguments)
            .env("DRIVEGATE_CONFIG", site.config())
            .output()
            .unwrap();
        let text = String::from_utf8(output.stdout).unwrap() + &String::from_utf8(output.stderr).unwrap();
        (output.status.code(), text)
    };
    let (code, text) = run(&["check"]);
    assert!(code == Some(0) && text.contains("line1"), "{text}");
    let (code, text) = run(&["map"]);
    assert!(code == Some(0), "{text}");
    let (code, text) = run(&["health"]);
    assert!(code == Some(1) && text.contains(&site.config()), "{text}");
    // The option takes precedence over the configuration; `--url` needs no configuration.
    let (code, text) = run(&["check", "--config", &site.path("other.toml")]);
    assert!(code == Some(78) && text.contains("other.toml"), "{text}");
    let (code, text) = run(&["health", "--url", "http://127.0.0.1:9"]);
    assert!(code == Some(1) && text.contains("127.0.0.1:9"), "{text}");
}
