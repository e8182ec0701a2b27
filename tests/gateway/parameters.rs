//! Parameters read through a running gateway: changes at the drive are reported, writes of the gateway are not.

use std::fs;

use serde_json::Value;

use drivegate_proto::RequestPdu;

use crate::support::process::{drivegate, get, until};
use crate::support::site::{HTTP, LINE1, MODBUS_TCP, Site};
use crate::support::tools::root;

/// PDU addresses of parameters of the profile.
const MAXIMUM_FREQUENCY: u16 = 101;

/// The Vacon NX profile as `few`, which reads only the parameters with a name.
pub(super) fn few() -> String {
    let text = fs::read_to_string(root().join("profiles/vacon-nx.toml")).unwrap();
    let changed = text
        .replace("name = \"vacon-nx\"", "name = \"few\"")
        .replace("spans = [\"id 100 1998\"]\n", "");
    assert!(changed.contains("\"few\"") && !changed.contains("spans"));
    changed
}

fn ran(site: &Site, arguments: &[&str]) -> (Option<i32>, String, String) {
    let config = site.config();
    let output = drivegate(&[arguments, &["--config", &config]].concat())
        .output()
        .unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    (output.status.code(), text(output.stdout), text(output.stderr))
}

fn events(site: &Site) -> Vec<String> {
    let (status, body) = get(site.http, "/api/v1/events/log?kind=parameters_changed").unwrap();
    assert_eq!(status, 200, "{body}");
    let log: Value = serde_json::from_str(&body).unwrap();
    let listed = log.as_array().expect("events");
    let text = |event: &Value| event["text"].as_str().unwrap_or_default().to_string();
    listed.iter().map(text).collect()
}

#[test]
fn only_what_the_gateway_did_not_write_is_told_as_a_change() {
    let site = Site::new();
    site.write("few.toml", &few());
    let gateway = LINE1.replace(
        "[gateway]\n",
        &format!(
            "[gateway]\nstate_dir = \"state\"\nsocket = \"{}\"\n",
            site.path("socket")
        ),
    );
    let pump = "[[bus.drive]]\nname = \"pump-1\"\naddress = 1\nprofile = \"few\"\naccess = \"control\"\n";
    site.configure(&[&gateway, pump, HTTP, MODBUS_TCP]);
    let line = site.line(&[1]);
    let _gateway = site.run_ready();

    let first = site.path("first.params");
    let (code, _, said) = ran(&site, &["params", "read", "pump-1", "-o", &first]);
    assert_eq!(code, Some(0), "{said}");
    // Two files made within one second would get one name.
    let second = || std::thread::sleep(std::time::Duration::from_millis(1100));

    second();
    until("a command", || {
        let (code, ..) = ran(&site, &["write", "pump-1", "fieldbus_fault_response=2"]);
        (code == Some(0)).then_some(())
    });
    let (code, differs, said) = ran(&site, &["params", "diff", &first, "pump-1"]);
    assert_eq!(code, Some(1), "{said}");
    assert_eq!(
        (differs.lines().count(), differs.starts_with("733 ")),
        (1, true),
        "{differs}"
    );
    assert_eq!(events(&site), Vec::<String>::new(), "the gateway wrote it");

    second();
    let write = RequestPdu::write_register(MAXIMUM_FREQUENCY, 4321);
    line.with_drive(1, |drive, now| drive.answer(&write, now)).unwrap();
    let (code, text, said) = ran(&site, &["params", "read", "pump-1"]);
    assert_eq!(code, Some(0), "{said}");
    assert!(text.contains("\n102 = 4321 "), "{text}");
    let told = until("the event", || Some(events(&site)).filter(|told| !told.is_empty()));
    assert_eq!(told.len(), 1, "{told:?}");
    assert!(
        told[0].contains("102 Maximum frequency") && told[0].ends_with("→ 43.21 Hz"),
        "{told:?}"
    );
    site.until_metric("drivegate_parameters_changed_total{bus=\"line1\",drive=\"pump-1\"} 1");

    let (status, body) = get(site.http, "/api/v1/drives/pump-1/params").unwrap();
    let served: Value = serde_json::from_str(&body).unwrap();
    assert_eq!((status, &served["last"]["missing"]), (200, &Value::from(0)));
    let of_it = served["last"]["parameters"].as_array().unwrap();
    let maximum = of_it.iter().find(|parameter| parameter["id"] == "102").unwrap();
    assert_eq!(maximum["raw"], 4321.0);
    let kept = fs::read_dir(site.file("state/params/pump-1")).unwrap().count();
    assert_eq!(kept, 3);
    assert!(ran(&site, &["params", "list", "pump-1"]).1.contains("few"));
    assert!(ran(&site, &["params", "show", "pump-1"]).1.contains("43.21 Hz"));
    listed_from_elsewhere(&site);
}

/// The stored readings as a gateway lists them for a command without its configuration.
fn listed_from_elsewhere(site: &Site) {
    let url = format!("http://127.0.0.1:{}", site.http);
    let told = |arguments: &[&str]| {
        let output = drivegate(&[arguments, &["--url", &url]].concat()).output().unwrap();
        let [out, err] = [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
        (output.status.code(), out, err)
    };
    let list = |text: &str| -> Vec<Value> { serde_json::from_str(text).unwrap() };
    let mut here = list(&ran(site, &["params", "list", "--json"]).1);
    assert_eq!(here.len(), 3);
    for reading in &mut here {
        // The gateway reports only the name of the file.
        let name = std::path::Path::new(reading["file"].as_str().unwrap()).file_name();
        reading["file"] = name.unwrap().to_str().unwrap().into();
        assert_eq!((&reading["family"], &reading["missing"]), (&"few".into(), &0.into()));
    }
    assert_eq!(list(&told(&["params", "list", "--json"]).1), here);
    assert_eq!(list(&told(&["params", "list", "pump-1", "--json"]).1), here);
    assert_eq!(told(&["params", "list", "pump-9", "--json"]).1, "[]\n");
    let shown = ran(site, &["params", "show", "pump-1"]).1;
    assert_eq!(told(&["params", "show", "pump-1"]), (Some(0), shown, String::new()));
    let (code, _, why) = told(&["params", "show", "pump-9"]);
    assert!(code == Some(1) && why.contains("pump-9"), "{why}");
    // A reading that cannot be parsed is listed with the others.
    std::fs::write(site.file("state/params/pump-1/19700101T000000Z.params"), "no reading").unwrap();
    for (code, text, why) in [told(&["params", "list"]), ran(site, &["params", "list"])] {
        assert_eq!((code, text.matches("few").count()), (Some(0), 3), "{why}");
        assert!(why.contains("19700101T000000Z.params"), "{why}");
    }
    assert_eq!(list(&told(&["params", "list", "--json"]).1).len(), 4);
}
