//! Stop all over every interface, each by a different client: mbpoll, mosquitto, curl and the command line.

use serde_json::{Value as Json, json};

use crate::support::mqtt::client;
use crate::support::process::{Running, drivegate, get, mbpoll_read, mbpoll_write, until, write_registers};
use crate::support::site::{HTTP, LINE1, MODBUS_TCP, MQTT, PASSWORD, Site, USERS, controlled, drive};
use crate::support::tools::{run, tool};

const STOP_ALL: u16 = 0x0100;
const NOT_STANDING: u16 = 0x8101;

/// Drives 1 and 2 take commands, 3 is monitored; 2 is in the group `fans`.
struct Plant {
    site: Site,
    _others: [Running; 3],
}

fn plant() -> Plant {
    let drives = controlled("pump-1", 1, "") + &controlled("fan-1", 2, "group = \"fans\"") + &drive("pump-3", 3, "");
    let site = Site::of(&[LINE1, &drives, MODBUS_TCP, MQTT, HTTP, USERS]);
    site.add_user("alice");
    let simulator = site.simulate(&["--addresses", "1-3", "--baud", "38400"]);
    let broker = site.broker();
    let gateway = site.run_ready();
    site.until_connected(true);
    Plant {
        site,
        _others: [simulator, broker, gateway],
    }
}

impl Plant {
    fn start(&self) {
        for (unit, name) in [(1, "pump-1"), (2, "fan-1")] {
            self.site.until_state(name, "ready");
            write_registers(self.site.modbus, unit, 0x8101, &[5000]);
            write_registers(self.site.modbus, unit, 0x8100, &[1]);
        }
        for name in ["pump-1", "fan-1"] {
            self.site.until_point(name, "output_frequency", 25.0);
        }
    }

    fn not_standing(&self) -> u16 {
        until("the count", || mbpoll_read(self.site.modbus, 255, NOT_STANDING, 1).ok())[0]
    }

    fn curl(&self, body: &str) -> (u16, Json) {
        self.site.curl("alice", "stop", &["-d", body])
    }

    fn mosquitto(&self, payload: &str) -> Json {
        self.site.respond("drivegate/test/set/stop", payload)
    }

    fn command_line(&self, arguments: &[&str]) -> (i32, String) {
        let config = self.site.config();
        let output = drivegate(&[&["stop-all", "--config", &config], arguments].concat())
            .output()
            .unwrap();
        let text = String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr);
        (output.status.code().unwrap(), text)
    }

    fn all_stand(&self) {
        assert_eq!(self.not_standing(), 0);
        for name in ["pump-1", "fan-1"] {
            assert_eq!(self.site.point(name, "running"), false, "{name}");
        }
    }
}

fn both_stand() -> Json {
    json!({ "ok": true, "drives": [
        { "drive": "pump-1", "outcome": "standing", "reason": null },
        { "drive": "fan-1", "outcome": "standing", "reason": null },
    ] })
}

#[test]
fn from_every_side() {
    let plant = plant();
    plant.start();
    assert_eq!(plant.not_standing(), 2);
    assert_eq!(plant.curl("{}"), (200, both_stand()));
    plant.all_stand();

    plant.start();
    assert_eq!(plant.mosquitto(""), both_stand());
    plant.all_stand();

    plant.start();
    mbpoll_write(plant.site.modbus, 255, STOP_ALL, &[1]).unwrap();
    until("standstill", || (plant.not_standing() == 0).then_some(()));
    plant.all_stand();

    plant.start();
    let (code, text) = plant.command_line(&[]);
    assert_eq!((code, text.as_str()), (0, "pump-1: standing\nfan-1: standing\n"));
    plant.all_stand();

    // A group can be stopped alone.
    plant.start();
    let (status, answer) = plant.curl("{\"group\": \"fans\"}");
    assert_eq!(
        (status, &answer["drives"][0]["drive"]),
        (200, &json!("fan-1")),
        "{answer}"
    );
    assert_eq!(plant.not_standing(), 1);
    assert_eq!(plant.site.point("pump-1", "running"), true);

    // A request that is not understood stops nothing and is refused.
    let refused = mbpoll_write(plant.site.modbus, 255, STOP_ALL, &[2]).unwrap_err();
    assert!(refused.contains("Illegal data value"), "{refused}");
    assert_eq!(plant.curl("{\"bus\": \"line9\"}").0, 404);
    assert_eq!(plant.curl("[]").0, 422);
    assert_eq!(plant.mosquitto("{\"drive\": 1}")["ok"], false);
    let (code, text) = plant.command_line(&["--bus", "line9"]);
    assert!(code == 1 && text.contains("known: line1"), "{code} {text}");
    assert_eq!(plant.site.point("pump-1", "running"), true);

    // A login is required for this request.
    let url = format!("http://127.0.0.1:{}/api/v1/stop", plant.site.http);
    let nobody = run(
        &tool("curl"),
        &["-s", "-o", "/dev/null", "-d", "{}", "-w", "%{http_code}", &url],
    );
    assert_eq!(nobody.stdout, b"401");
    // The command line over the network, with and without a user.
    let (url, login) = (
        format!("http://127.0.0.1:{}", plant.site.http),
        plant.site.path("login"),
    );
    std::fs::write(&login, format!("alice:{PASSWORD}\n")).unwrap();
    let ran = |arguments: &[&str], login: &[&str]| {
        let output = drivegate(&[arguments, &["--url", &url], login].concat())
            .output()
            .unwrap();
        let text = String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr);
        (output.status.code().unwrap(), text)
    };
    let alice = ["--token-file", &login];
    let (code, text) = ran(&["write", "pump-1", "speed_reference=30"], &alice);
    assert!(code == 0 && text.contains("through the gateway"), "{text}");
    // A point that is not polled is read only for users who may command.
    let (code, text) = ran(&["read", "pump-1", "running", "process_data_in_8"], &[]);
    assert!(code == 1 && text.contains("it is not polled"), "{text}");
    let (_, text) = ran(&["read", "pump-1", "running", "process_data_in_8"], &alice);
    assert!(text.contains("good") && !text.contains("it is not polled"), "{text}");
    let (code, text) = ran(&["why", "pump-1"], &[]);
    assert_eq!((code, text.as_str()), (0, "pump-1 runs\n"));
    for refused in [
        &["write", "pump-1", "run=false"][..],
        &["stop-all"],
        &["record", "pump-1"],
    ] {
        let (code, text) = ran(refused, &[]);
        assert!(code == 1 && text.contains("USER:PASSWORD"), "{refused:?}: {text}");
    }
    assert_eq!(plant.site.point("pump-1", "running"), true);
    let (code, text) = ran(&["stop-all"], &alice);
    assert_eq!((code, text.as_str()), (0, "pump-1: standing\nfan-1: standing\n"));
    plant.all_stand();
}

/// The broker would repeat a retained stop at each connection of the gateway. The topic is cleared by such a message, too.
#[test]
fn a_retained_stop_of_all_stops_nothing_and_is_told() {
    let plant = plant();
    plant.start();
    let heard = |topic| Running::spawn(client("mosquitto_sub", plant.site.mqtt).args(["-t", topic, "-F", "%p"]));
    let results = heard("drivegate/test/result");
    // An answer to an invalid stop shows that the subscription is active.
    until("the subscription", || {
        plant.site.publish(&["-t", "drivegate/test/set/stop", "-m", "[]"]);
        results.output().contains("no stop was sent").then_some(())
    });
    for (times, payload) in [(1, &["-n"][..]), (2, &["-m", "{}"]), (3, &["-n"])] {
        plant
            .site
            .publish(&[&["-r", "-t", "drivegate/test/set/stop"], payload].concat());
        until("a result", || {
            (results.output().matches("the message was retained").count() == times).then_some(())
        });
    }
    // Further refusals of this client are only counted.
    let of_all = |record: &Json| record["drive"] == "all drives" && record["result"] == "not_allowed";
    assert!(plant.site.audit().iter().any(of_all));
    let (_, log) = get(plant.site.http, "/api/v1/events/log?kind=refused_command").unwrap();
    let log: Json = serde_json::from_str(&log).unwrap();
    let told = |event: &&Json| {
        event["text"]
            .as_str()
            .is_some_and(|text| text.contains("the message was retained"))
    };
    let entry = log.as_array().unwrap().iter().find(told);
    let entry = entry.unwrap_or_else(|| panic!("{log}"));
    assert!(entry["drive"].is_null(), "it is for no drive in particular: {entry}");
    for name in ["pump-1", "fan-1"] {
        assert_eq!(plant.site.point(name, "running"), true, "{name}");
    }
}
