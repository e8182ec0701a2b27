//! Rights and displays of clients while one of them holds a drive: mbpoll, mosquitto, curl.

use serde_json::{Value as Json, json};

use crate::support::process::{Running, api, mbpoll_read, mbpoll_write, until, write_registers};
use crate::support::site::{HTTP, LINE1, MODBUS_TCP, MQTT, Site, USERS, controlled};

mod clients;

const AUTHORITY: &str = r#"
[authority]
mode = "exclusive"
lease = "30s"
[[authority.principal]]
name = "plc"
rank = "automation"
modbus_tcp = ["127.0.0.1/32"]
[[authority.principal]]
name = "alice"
rank = "operator"
http_user = "alice"
[[authority.principal]]
name = "cloud"
rank = "remote"
mqtt = "cloud"
"#;

struct Plant {
    site: Site,
    _others: [Running; 3],
}

fn plant() -> Plant {
    let drives = controlled("pump-1", 1, "");
    let site = Site::of(&[LINE1, &drives, MODBUS_TCP, MQTT, HTTP, USERS, AUTHORITY]);
    site.add_user("alice");
    let simulator = site.simulate(&["--addresses", "1", "--baud", "38400"]);
    let broker = site.broker();
    let gateway = site.run_ready();
    site.until_connected(true);
    site.until_state("pump-1", "ready");
    Plant {
        site,
        _others: [simulator, broker, gateway],
    }
}

impl Plant {
    fn curl(&self, what: &str, body: &str) -> (u16, Json) {
        self.site.curl("alice", &format!("drives/pump-1/{what}"), &["-d", body])
    }

    /// Registers 0x8013 and 0x8104 as the PLC reads them, and the state over HTTP.
    fn seen(&self) -> (u16, u16, Json, Json) {
        let read = |address| until("registers", || mbpoll_read(self.site.modbus, 1, address, 1).ok())[0];
        let (holder, own) = (read(0x8013), read(0x8104));
        let drive = api(self.site.http, "pump-1");
        (holder, own, drive["hold"].clone(), drive["holder"].clone())
    }

    fn write(&self, address: u16, values: &[u16]) -> Result<(), String> {
        mbpoll_write(self.site.modbus, 1, address, values).map(|_| ())
    }
}

fn busy(written: Result<(), String>) {
    let error = written.unwrap_err();
    assert!(error.to_lowercase().contains("busy"), "{error}");
}

#[test]
fn who_sees_and_may_what() {
    let plant = plant();
    assert_eq!(plant.seen(), (0, 0, json!("free"), json!(null)));
    // The first command takes the drive, and all clients see this.
    write_registers(plant.site.modbus, 1, 0x8100, &[1, 5000]);
    plant.site.until_point("pump-1", "output_frequency", 25.0);
    assert_eq!(plant.seen(), (1, 1, json!("held"), json!("plc")));
    let left = until("the time", || mbpoll_read(plant.site.modbus, 1, 0x8014, 1).ok())[0];
    assert!((1..=30).contains(&left), "{left}");
    // No other client can command the drive, whatever its rank; each refusal names the holder.
    let (status, answer) = plant.curl("commands", r#"{"run": true, "speed_reference": 10}"#);
    assert_eq!((status, &answer["result"]), (409, &json!("held_by_other")), "{answer}");
    assert_eq!(
        (&answer["holder"], &answer["holder_rank"]),
        (&json!("plc"), &json!("automation"))
    );
    let answer = plant.site.ask("pump-1/as/cloud/set", r#"{"speed_reference": 10}"#);
    assert_eq!(
        (&answer["result"], &answer["holder"]),
        (&json!("held_by_other"), &json!("plc")),
        "{answer}"
    );
    // A client without a principal is refused, even with the right drive name.
    for topic in ["set", "as/stranger/set"] {
        let answer = plant.site.ask(&format!("pump-1/{topic}"), r#"{"speed_reference": 10}"#);
        assert_eq!(answer["result"], "not_allowed", "{answer}");
    }
    assert_eq!(
        plant.site.ask("pump-1/as/cloud/hold", "break")["result"],
        "held_by_other"
    );
    assert_eq!(plant.site.ask("pump-1/hold", "take")["result"], "not_allowed");
    assert_eq!(plant.site.point("pump-1", "output_frequency"), 25.0);
    // A higher rank takes the drive over; the motor keeps running.
    assert_eq!(plant.curl("hold", r#"{"action": "take"}"#).0, 409);
    let (status, answer) = plant.curl("hold", r#"{"action": "break"}"#);
    assert_eq!(
        (status, &answer["holder"], &answer["own"]),
        (200, &json!("alice"), &json!(true)),
        "{answer}"
    );
    assert_eq!(plant.seen(), (2, 0, json!("held"), json!("alice")));
    assert_eq!(plant.site.point("pump-1", "running"), true);
    busy(plant.write(0x8100, &[1, 4000]));
    busy(plant.write(0x8104, &[1]));
    busy(plant.write(0x8104, &[2]));
    let refused = plant.write(0x8104, &[3]).unwrap_err();
    assert!(refused.contains("Illegal data value"), "{refused}");
    plant.write(0x8104, &[0]).unwrap();
    plant.write(0x8103, &[1]).unwrap();
    assert_eq!(
        plant.seen(),
        (2, 0, json!("held"), json!("alice")),
        "a release by another has no effect"
    );
    // A stop of any client passes and ends the hold; a stop of a client without a principal reserves nothing.
    let answer = plant.site.ask("pump-1/set", r#"{"run": false}"#);
    assert_eq!(answer["ok"], true, "{answer}");
    assert_eq!(plant.seen(), (0, 0, json!("free"), json!(null)));
    // After the stop of the operator, the PLC does not start the motor by repeating its command.
    plant.write(0x8100, &[1, 5000]).unwrap();
    plant.site.until_point("pump-1", "running", true);
    let (status, answer) = plant.curl("commands", r#"{"run": false}"#);
    assert_eq!(status, 200, "{answer}");
    assert_eq!(plant.seen(), (4, 0, json!("reserved"), json!("alice")));
    busy(plant.write(0x8100, &[1, 5000]));
    let answer = plant.site.ask("pump-1/as/cloud/set", r#"{"run": true}"#);
    assert_eq!(
        (&answer["result"], &answer["holder"]),
        (&json!("held_by_other"), &json!("alice")),
        "{answer}"
    );
    assert_eq!(plant.curl("hold", r#"{"action": "release"}"#).1["hold"], "free");
    let (_, answer) = plant.curl("hold", r#"{"action": "renew"}"#);
    assert_eq!(answer["result"], "needs_take", "{answer}");
    plant.write(0x8103, &[1, 1]).unwrap();
    assert_eq!(plant.seen(), (1, 1, json!("held"), json!("plc")));
    plant.write(0x8100, &[1, 5000]).unwrap();
    plant.site.until_point("pump-1", "running", true);
    plant.write(0x8104, &[0]).unwrap();
    assert_eq!(plant.seen(), (0, 0, json!("free"), json!(null)));
    assert_eq!(
        plant.site.point("pump-1", "running"),
        true,
        "the motor runs on when a hold ends"
    );
}
