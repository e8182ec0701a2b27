//! Four clients of four kinds that command one drive: for each holder, what each client sees, who is refused and
//! why, and what a stop of each leaves behind. pymodbus, curl, mosquitto, and a Sparkplug host with Eclipse Tahu's
//! encoder.

use std::cell::Cell;
use std::io::Write as _;
use std::process::{Command, Stdio};

use serde_json::{Value as Json, json};

use crate::support::mqtt::{client, next_json};
use crate::support::process::{Running, api, until};
use crate::support::site::{HTTP, LINE1, MQTT, Site, USERS, controlled};
use crate::support::tools::{python, root, run_well, tool};

const MODBUS_TCP: &str = "[modbus_tcp]\nlisten = [\"127.0.0.1:{modbus}\"]\nwrite = [\"127.0.0.0/8\"]\n";
const AUTHORITY: &str = r#"
[mqtt.sparkplug]
group = "plant"
alias = false
[authority]
mode = "exclusive"
lease = "2min"
[[authority.principal]]
name = "plc"
rank = "automation"
modbus_tcp = ["127.0.0.2/32"]
[[authority.principal]]
name = "alice"
rank = "operator"
http_user = "alice"
[[authority.principal]]
name = "cloud"
rank = "remote"
mqtt = "cloud"
[[authority.principal]]
name = "host"
rank = "automation"
sparkplug = true
"#;

/// The clients with their ranks, as Modbus TCP numbers them; the last one is not a principal.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum Client {
    Plc,
    Alice,
    Cloud,
    Host,
    Nobody,
}

const ALL: [Client; 5] = [Client::Plc, Client::Alice, Client::Cloud, Client::Host, Client::Nobody];

impl Client {
    fn name(self) -> &'static str {
        ["plc", "alice", "cloud", "host", "nobody"][self as usize]
    }

    /// Index of the client's rank among site, operator, automation, remote.
    fn rank(self) -> usize {
        [2, 1, 3, 2, usize::MAX][self as usize]
    }
}

struct Plant {
    site: Site,
    _others: [Running; 3],
    heard: Running,
    /// Number of commands that the Sparkplug host gave.
    commands: Cell<u64>,
}

fn plant() -> Plant {
    let site = Site::of(&[
        LINE1,
        &controlled("pump-1", 1, ""),
        MODBUS_TCP,
        MQTT,
        AUTHORITY,
        HTTP,
        USERS,
    ]);
    site.add_user("alice");
    let simulator = site.simulate(&["--addresses", "1", "--baud", "38400"]);
    let broker = site.broker();
    let mut client = client("mosquitto_sub", site.mqtt);
    let heard = Running::spawn(client.args(["-t", "spBv1.0/#", "-F", "%r|%q|%t|%x"]));
    broker.until_printed("New client connected");
    let gateway = site.run_ready();
    site.until_connected(true);
    site.until_state("pump-1", "ready");
    heard.until_printed("DBIRTH");
    Plant {
        site,
        _others: [simulator, broker, gateway],
        heard,
        commands: Cell::new(1),
    }
}

impl Plant {
    fn pymodbus(&self, register: u16, values: &[u16]) -> String {
        let peer = root().join("tests/peers/pymodbus_once.py").display().to_string();
        let (port, register) = (self.site.modbus.to_string(), register.to_string());
        let values: Vec<String> = values.iter().map(u16::to_string).collect();
        let mut arguments = vec![peer.as_str(), &port, "127.0.0.2", "1", &register];
        arguments.extend(values.iter().map(String::as_str));
        run_well(&python(), &arguments).trim().to_string()
    }

    fn curl(&self, what: &str, body: &Json) -> Json {
        let what = format!("drives/pump-1/{what}");
        self.site.curl("alice", &what, &["-d", &body.to_string()]).1
    }

    fn sparkplug(&self, arguments: &[&str], input: &str) -> String {
        let mut node = Command::new(tool("node"))
            .env("NODE_PATH", root().join(".tools/node/node_modules"))
            .arg(root().join("tests/peers/sparkplug.js"))
            .args(arguments)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        node.stdin.take().unwrap().write_all(input.as_bytes()).unwrap();
        let output = node.wait_with_output().unwrap();
        assert!(output.status.success(), "{output:?}");
        String::from_utf8(output.stdout).unwrap()
    }

    /// Gives a command as a Sparkplug host; returns the command's result from the audit.
    fn dcmd(&self, point: &str, value: &Json) -> String {
        let kind = if value.is_boolean() { "Boolean" } else { "Double" };
        // A payload with the time of an earlier one repeats that.
        let time = self.commands.replace(self.commands.get() + 1);
        let payload = json!({"timestamp": time, "metrics": [{"name": point, "type": kind, "value": value}]});
        let hex = self.sparkplug(&["encode", &payload.to_string()], "");
        let hex = hex.trim();
        let byte = |at: usize| u8::from_str_radix(&hex[at..at + 2], 16).unwrap();
        let bytes: Vec<u8> = (0..hex.len()).step_by(2).map(byte).collect();
        std::fs::write(self.site.file("payload"), bytes).unwrap();
        let before = self.site.audit().len();
        self.site
            .publish(&["-t", "spBv1.0/plant/DCMD/test/pump-1", "-f", &self.site.path("payload")]);
        until("the result of a DCMD", || {
            let audit = self.site.audit();
            let last = audit
                .get(before..)?
                .iter()
                .rfind(|entry| entry["source"] == "sparkplug")?;
            last["result"].as_str().map(String::from)
        })
    }

    /// Sets a point as this client; returns the code of the result.
    fn set(&self, client: Client, point: &str, value: &Json) -> String {
        let payload = json!({ point: value });
        let code = |answer: Json| {
            answer["result"]
                .as_str()
                .unwrap_or_else(|| panic!("{answer}"))
                .to_string()
        };
        match client {
            Client::Plc => {
                let (register, word) = match point {
                    "run" => (0x8100, u16::from(value == true)),
                    "speed_reference" => (0x8101, (value.as_f64().unwrap() * 100.0) as u16),
                    point => unreachable!("{point}"),
                };
                match self.pymodbus(register, &[word]).as_str() {
                    "ok" => "confirmed".to_string(),
                    "exception 6" => "held_by_other".to_string(),
                    other => other.to_string(),
                }
            }
            Client::Alice => code(self.curl("commands", &payload)),
            Client::Cloud => code(self.site.ask("pump-1/as/cloud/set", &payload.to_string())),
            Client::Host => self.dcmd(point, value),
            Client::Nobody => code(self.site.ask("pump-1/set", &payload.to_string())),
        }
    }

    fn reference(&self, client: Client) -> String {
        // Each client sets a different value: a value that is already set would be confirmed at once.
        self.set(client, "speed_reference", &json!(10.0 + client as usize as f64))
    }

    /// All clients see this state and this holder.
    fn all_see(&self, state: &str, holder: &Json) {
        let plc: u16 = self.pymodbus(0x8013, &[]).parse().unwrap();
        let rank = ALL
            .iter()
            .find(|client| holder == client.name())
            .map(|client| client.rank());
        let expected = match (state, rank) {
            ("free", _) => 0,
            ("reserved", _) => 4,
            // 1: the client itself holds the drive, 2: another client.
            (_, _) if holder == "plc" => 1,
            (_, _) => 2,
        };
        assert_eq!(plc, expected, "0x8013 while {state} for {holder}");
        let (_, seen) = self.site.curl("alice", "drives/pump-1/hold", &[]);
        assert_eq!((&seen["hold"], &seen["holder"]), (&json!(state), holder), "{seen}");
        until("the state by MQTT", || {
            let message = next_json(self.site.mqtt, "drivegate/test/drive/pump-1/state")?;
            (message["hold"] == state && message["holder"] == *holder).then_some(())
        });
        until("the metrics of the host", || {
            let text = self.sparkplug(&["check"], &self.heard.output());
            let checked: Json = serde_json::from_str(&text).ok()?;
            let messages = checked["messages"].as_array()?.iter();
            let metrics: Vec<&Json> = messages.filter_map(|m| m["metrics"].as_array()).flatten().collect();
            let last = |name: &str| metrics.iter().rfind(|m| m["name"] == name).map(|m| m["value"].clone());
            let shown = holder.as_str().unwrap_or_default();
            let is_holder = last("Hold/Holder").is_some_and(|value| value.as_str().unwrap_or_default() == shown);
            (last("Hold/State")? == state && is_holder).then_some(())
        });
    }

    /// The operator takes the drive from any holder, and releases it.
    fn free(&self) {
        self.curl("hold", &json!({"action": "break"}));
        let freed = self.curl("hold", &json!({"action": "release"}));
        assert_eq!(freed["hold"], "free", "{freed}");
    }
}

#[test]
fn each_client_sees_and_may_what_the_table_says() {
    let plant = plant();
    for holder in ALL {
        plant.free();
        plant.all_see("free", &Json::Null);
        if holder == Client::Nobody {
            assert_eq!(plant.reference(holder), "not_allowed");
            continue;
        }
        assert_eq!(plant.reference(holder), "confirmed", "{holder:?}");
        plant.all_see("held", &json!(holder.name()));
        for other in ALL {
            let expected = match other {
                _ if other == holder => "confirmed",
                Client::Nobody => "not_allowed",
                _ => "held_by_other",
            };
            assert_eq!(plant.reference(other), expected, "{other:?} while {holder:?} holds");
            assert_eq!(api(plant.site.http, "pump-1")["holder"], holder.name());
        }
        for stopper in ALL {
            plant.free();
            assert_eq!(plant.reference(holder), "confirmed", "{holder:?}");
            assert_eq!(plant.set(stopper, "run", &json!(false)), "confirmed", "{stopper:?}");
            let (state, left) = match stopper {
                _ if stopper == holder => ("held", json!(holder.name())),
                Client::Nobody => ("free", Json::Null),
                _ => ("reserved", json!(stopper.name())),
            };
            let (_, seen) = plant.site.curl("alice", "drives/pump-1/hold", &[]);
            assert_eq!(
                (&seen["hold"], &seen["holder"]),
                (&json!(state), &left),
                "{stopper:?} stops {holder:?}: {seen}"
            );
            // A client that ranks below the stopper does not take the drive.
            for next in ALL.into_iter().filter(|next| *next != Client::Nobody) {
                if state == "reserved" && next.rank() > stopper.rank() {
                    assert_eq!(plant.reference(next), "held_by_other", "{next:?} behind {stopper:?}");
                }
            }
        }
    }
}
