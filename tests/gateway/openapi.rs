//! The description of the API, by the validators that npm has.

use std::process::Command;

use serde_json::{Value, json};

use super::parameters::few;
use crate::support::process::{drivegate, get, until};
use crate::support::site::{HTTP, LINE1, MODBUS_TCP, MQTT, Site};
use crate::support::tools::{python, root, tool};

#[test]
fn every_answer_is_as_the_description_says() {
    let site = Site::new();
    site.write("few.toml", &few());
    let keys = format!(
        "[gateway]\nstate_dir = \"state\"\nsocket = \"{}\"\n",
        site.path("socket")
    );
    let gateway = LINE1.replace("[gateway]\n", &keys);
    let pump = "[[bus.drive]]\nname = \"pump-1\"\naddress = 1\nprofile = \"few\"\naccess = \"control\"\n";
    let recordings = "[recordings]\nbefore = \"1s\"\nafter = \"1s\"\n";
    site.configure(&[&gateway, pump, HTTP, MODBUS_TCP, MQTT, recordings]);
    let _line = site.line(&[1]);
    let _gateway = site.run_ready();
    let done = |arguments: &[&str]| {
        let config = site.config();
        let output = drivegate(&[arguments, &["--config", &config]].concat())
            .output()
            .unwrap();
        assert!(output.status.success(), "{arguments:?}: {output:?}");
        String::from_utf8(output.stdout).unwrap().trim().to_string()
    };
    // The site has one of each kind of data.
    done(&["write", "pump-1", "run=true", "speed_reference=40"]);
    done(&["params", "read", "pump-1", "--brisk"]);
    let recording = done(&["record", "pump-1"]);
    until("the recording", || {
        let (_, listed) = get(site.http, "/api/v1/recordings")?;
        listed.contains(&recording).then_some(())
    });
    // No broker runs.
    until("why there is no connection", || {
        let (_, links) = get(site.http, "/api/v1/mqtt")?;
        (links.contains("\"connected\":false") && links.contains("is running")).then_some(())
    });
    let names = json!({"drives": "pump-1", "buses": "line1", "recordings": recording, "assets": "x"});
    let checked = Command::new(tool("node"))
        .arg("tests/tools/node/check_openapi.js")
        .args([site.path("socket"), names.to_string()])
        .current_dir(root())
        .env("NODE_PATH", root().join(".tools/node/node_modules"))
        .output()
        .unwrap();
    assert!(checked.status.success(), "{}", String::from_utf8_lossy(&checked.stderr));
    let checked: Value = serde_json::from_slice(&checked.stdout).unwrap();
    let answered = checked["answered"].as_object().unwrap();
    let others: Vec<_> = answered.iter().filter(|(_, status)| **status != 200).collect();
    // 404 and 409: `[authority]` is off, no restore was made, and the socket has no logins.
    let expected = [
        ("/api/v1/drills/{id}", 404),
        ("/api/v1/drives/{name}/hold", 409),
        ("/api/v1/drives/{name}/params/restore", 409),
        ("/api/v1/session", 404),
    ];
    assert_eq!(json!(others), json!(expected));
    assert!(answered.len() > 15, "{answered:?}");
    let described: Vec<&str> = checked["described"]
        .as_array()
        .unwrap()
        .iter()
        .filter_map(Value::as_str)
        .collect();
    for path in [
        "/",
        "/metrics",
        "/api/v1/stop",
        "/api/v1/reload",
        "/api/v1/drives/{name}/commands",
    ] {
        assert!(described.contains(&path), "{path}: {described:?}");
    }
    read_by_a_generated_client(&site, &names);
    // The description can be read with the right to read.
    let (status, text) = get(site.http, "/api/v1/openapi.json").unwrap();
    assert!(status == 200 && text.contains("\"openapi\":\"3.1"), "{text}");
}

/// A client generated from the description understands every answer of the API, refusals included.
fn read_by_a_generated_client(site: &Site, names: &Value) {
    let read = Command::new(python())
        .arg("tests/tools/openapi_client.py")
        .args([
            format!("http://127.0.0.1:{}", site.http),
            site.path("socket"),
            names.to_string(),
            site.path("client"),
        ])
        .current_dir(root())
        .output()
        .unwrap();
    assert!(read.status.success(), "{}", String::from_utf8_lossy(&read.stderr));
    let read: Value = serde_json::from_slice(&read.stdout).unwrap();
    let answers = read["answers"].as_object().unwrap();
    assert!(answers.len() > 20, "{answers:?}");
    for (operation, answer) in answers {
        assert_ne!(answer[1], "NoneType", "{operation} says nothing: {answer}");
    }
    assert_eq!(answers["get_api_v1_recordings_id"], json!([200, "RecordingObject"]));
    assert_eq!(answers["get_api_v1_drives_name_why"], json!([200, "Why"]));
    // An unknown drive, point and value, a stop, and an order without the right to command.
    let result = |status: u16| json!([status, "CommandResult"]);
    let expected = [
        result(404),
        result(422),
        result(422),
        result(200),
        json!([405, "ErrorReply"]),
    ];
    assert_eq!(read["commands"], json!(expected));
}
