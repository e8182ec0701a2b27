//! A gateway's site: its folder with the configuration, free ports for its servers, a simulated line, a broker.

use std::net::TcpStream;
use std::path::{Path, PathBuf};

use drivegate_proto::LineFormat;
use drivegate_sim::endpoint::EndpointOptions;
use drivegate_sim::half_duplex::LineRules;
use drivegate_sim::simulated_drive::DriveOptions;
use drivegate_sim::statistics::Direction;
use drivegate_sim::wire::{SimulatedBus, SimulatedBusOptions};
use tempfile::TempDir;

use super::mqtt::client;
use super::process::{Running, api, free_port, get, until, until_ready};
use super::tools::{feed, root, run, tool};

/// The gateway and its bus `line1`; its time limits tolerate replies that a busy machine delays.
pub(crate) const LINE1: &str = "[gateway]\nname = \"test\"\nprofile_dirs = [\".\"]\n\
     [[bus]]\nname = \"line1\"\nport = \"line1\"\nbaud = 38400\nsilence = \"chars\"\nresponse_timeout = \"2s\"\n";
pub(crate) const MODBUS_TCP: &str = "[modbus_tcp]\nlisten = [\"127.0.0.1:{modbus}\"]\nwrite = [\"127.0.0.1/32\"]\n";
pub(crate) const MQTT: &str = "[mqtt]\nurl = \"mqtt://127.0.0.1:{mqtt}\"\ncommands = true\n";
pub(crate) const HTTP: &str = "[http]\nlisten = \"127.0.0.1:{http}\"\n";
/// Commands over HTTP, by users in the file `users`.
pub(crate) const USERS: &str = "commands = true\nusers_file = \"users\"\n";
/// Password of every user.
pub(crate) const PASSWORD: &str = "correct horse battery";

/// The section of a Vacon NX; `keys` are further lines of the section.
pub(crate) fn drive(name: &str, address: u8, keys: &str) -> String {
    format!("[[bus.drive]]\nname = \"{name}\"\naddress = {address}\nprofile = \"vacon-nx\"\n{keys}\n")
}

/// Configuration of a drive that may be commanded.
pub(crate) fn controlled(name: &str, address: u8, keys: &str) -> String {
    drive(name, address, &format!("access = \"control\"\n{keys}"))
}

/// The Vacon NX profile under another name, changed to Modbus ASCII.
pub(crate) fn nx_in_ascii(name: &str) -> String {
    let text = std::fs::read_to_string(root().join("profiles/vacon-nx.toml")).unwrap();
    let changed = text
        .replace("name = \"vacon-nx\"", &format!("name = \"{name}\""))
        .replace("protocols = [\"modbus-rtu\"]", "protocols = [\"modbus-ascii\"]");
    assert!(changed.contains(name) && changed.contains("modbus-ascii"));
    changed
}

const OWN_SOCKET: &str = "socket = \"own.sock\"\n";

/// The configuration with a local socket of its own, unless it names another one.
fn with_own_socket(text: &str) -> String {
    let without = text.replacen(OWN_SOCKET, "", 1);
    if without.contains("\nsocket = ") {
        without
    } else {
        without.replacen("[gateway]\n", &format!("[gateway]\n{OWN_SOCKET}"), 1)
    }
}

/// With this limit, no value becomes stale because the test machine is busy.
const PATIENT: &str = "stale_after = \"1min\"\n";

/// The configuration as the gateway reads it: a local socket of its own, and patience where Modbus TCP shows values.
fn completed(text: &str) -> String {
    let text = with_own_socket(text);
    if text.contains("[modbus_tcp]") && !text.contains("\nstale_after = ") {
        text.replacen("[gateway]\n", &format!("[gateway]\n{PATIENT}"), 1)
    } else {
        text
    }
}

pub(crate) struct Site {
    pub(crate) folder: TempDir,
    pub(crate) modbus: u16,
    pub(crate) mqtt: u16,
    pub(crate) http: u16,
}

impl Site {
    /// A site without a configuration.
    pub(crate) fn new() -> Site {
        Site {
            folder: tempfile::tempdir().unwrap(),
            modbus: free_port(),
            mqtt: free_port(),
            http: free_port(),
        }
    }

    /// A site whose configuration consists of these parts.
    pub(crate) fn of(parts: &[&str]) -> Site {
        let site = Site::new();
        site.configure(parts);
        site
    }

    pub(crate) fn file(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    pub(crate) fn path(&self, name: &str) -> String {
        self.file(name).display().to_string()
    }

    pub(crate) fn config(&self) -> String {
        self.path("drivegate.conf")
    }

    pub(crate) fn write(&self, name: &str, text: &str) {
        std::fs::write(self.file(name), text).unwrap();
    }

    /// Writes the configuration; `{modbus}`, `{mqtt}` and `{http}` are replaced by the ports of the site.
    pub(crate) fn configure(&self, parts: &[&str]) {
        let ports = [("{modbus}", self.modbus), ("{mqtt}", self.mqtt), ("{http}", self.http)];
        let text = ports.iter().fold(parts.concat(), |text, (place, port)| {
            text.replace(place, &port.to_string())
        });
        self.write("drivegate.conf", &completed(&text));
    }

    /// Replaces a part of the configuration and writes it; returns the previous configuration.
    pub(crate) fn change(&self, from: &str, to: &str) -> String {
        let text = std::fs::read_to_string(self.config()).unwrap();
        assert!(text.contains(from), "{from} does not stand in\n{text}");
        self.write("drivegate.conf", &completed(&text.replace(from, to)));
        text
    }

    /// Adds a user to the file `users`.
    pub(crate) fn add_user(&self, name: &str) {
        let program = Path::new(env!("CARGO_BIN_EXE_drivegate"));
        let arguments = ["user", "add", "--file", &self.path("users"), name];
        let added = feed(program, &arguments, &format!("{PASSWORD}\n"));
        assert!(added.status.success(), "{added:?}");
    }

    /// Status and reply of a user's request to the HTTP API, by curl; `more` has the method or the body.
    pub(crate) fn curl(&self, user: &str, path: &str, more: &[&str]) -> (u16, serde_json::Value) {
        let url = format!("http://127.0.0.1:{}/api/v1/{path}", self.http);
        let login = format!("{user}:{PASSWORD}");
        curl(&[&["-u", &login][..], more, &[&url]].concat())
    }

    /// Simulated drives at the port of `line1`, at 38400 baud; the traffic on their line is recorded.
    pub(crate) fn line(&self, addresses: &[u8]) -> SimulatedBus {
        line_of(&self.file("line1"), addresses)
    }

    /// Simulates the line in a separate process.
    pub(crate) fn simulate(&self, arguments: &[&str]) -> Running {
        let line = self.path("line1");
        let running = Running::drivegate(&[&["simulate", "--link", &line], arguments].concat());
        running.until_printed("Ctrl-C ends");
        running
    }

    /// Starts the gateway.
    pub(crate) fn run(&self) -> Running {
        Running::drivegate(&["run", "--config", &self.config()])
    }

    /// Starts the gateway and waits until it is ready.
    pub(crate) fn run_ready(&self) -> Running {
        let gateway = self.run();
        until_ready(self.http);
        // The local socket opens last.
        gateway.until_printed("drivegate is running");
        gateway
    }

    /// Starts a Mosquitto broker.
    pub(crate) fn broker(&self) -> Running {
        let text = format!("listener {} 127.0.0.1\nallow_anonymous true\n", self.mqtt);
        self.write("mosquitto.conf", &text);
        let broker = Running::start(&tool("mosquitto"), &["-c", &self.path("mosquitto.conf")]);
        until("mosquitto", || TcpStream::connect(("127.0.0.1", self.mqtt)).ok());
        broker
    }

    pub(crate) fn until_connected(&self, connected: bool) {
        self.until_metric(&format!("drivegate_mqtt_connected {}", u8::from(connected)));
    }

    pub(crate) fn until_metric(&self, line: &str) {
        until(line, || get(self.http, "/metrics")?.1.contains(line).then_some(()));
    }

    pub(crate) fn until_state(&self, drive: &str, state: &str) {
        until(&format!("{drive} is {state}"), || {
            (api(self.http, drive)["state"] == state).then_some(())
        });
    }

    pub(crate) fn until_point(&self, drive: &str, point: &str, wanted: impl Into<serde_json::Value>) {
        let wanted = wanted.into();
        until(&format!("{point} of {drive} is {wanted}"), || {
            (self.point(drive, point) == wanted).then_some(())
        });
    }

    /// The good value of a point, else null.
    pub(crate) fn point(&self, drive: &str, point: &str) -> serde_json::Value {
        super::process::point(self.http, drive, point)
    }

    pub(crate) fn audit(&self) -> Vec<serde_json::Value> {
        serde_json::from_str(&get(self.http, "/api/v1/audit").unwrap().1).unwrap()
    }

    /// Runs `mosquitto_pub`; the message is with the broker when this returns.
    pub(crate) fn publish(&self, arguments: &[&str]) {
        let published = client("mosquitto_pub", self.mqtt)
            .args(["-q", "1"])
            .args(arguments)
            .output();
        let published = published.unwrap();
        assert!(published.status.success(), "{published:?}");
    }

    /// The response to a message to a set topic of a drive, received by a separate client.
    pub(crate) fn ask(&self, topic: &str, payload: &str) -> serde_json::Value {
        self.respond(&format!("drivegate/test/drive/{topic}"), payload)
    }

    /// The response to a message that a separate client sends.
    pub(crate) fn respond(&self, topic: &str, payload: &str) -> serde_json::Value {
        let mut client = client("mosquitto_rr", self.mqtt);
        client.args(["-q", "1", "-W", "60", "-t", topic, "-e", "answers/1", "-m", payload]);
        let output = client.output().unwrap();
        serde_json::from_slice(&output.stdout).unwrap_or_else(|error| panic!("{topic} {payload}: {error}: {output:?}"))
    }

    /// Repeats the command until it is carried out: on a busy machine it may expire.
    pub(crate) fn order(&self, topic: &str, payload: &str) -> serde_json::Value {
        until(payload, || {
            Some(self.ask(topic, payload)).filter(|result| result["ok"] == true)
        })
    }
}

/// Status and reply, JSON or a text, of a request by curl; repeated where an order expired: after a pause of the machine
/// of more than a second, starts are refused.
pub(crate) fn curl(arguments: &[&str]) -> (u16, serde_json::Value) {
    until("a request that no pause of the machine held up", || {
        let output = run(
            &tool("curl"),
            &[&["-sS", "-w", "\n%{http_code}"][..], arguments].concat(),
        );
        let text = String::from_utf8(output.stdout).unwrap();
        let (body, status) = text.rsplit_once('\n').unwrap();
        let reply: serde_json::Value = serde_json::from_str(body).unwrap_or_else(|_| body.into());
        (reply["result"] != "expired").then(|| (status.parse().unwrap(), reply))
    })
}

/// Simulated drives at the port `link`, at 38400 baud; the traffic on their line is recorded.
pub(crate) fn line_of(link: &Path, addresses: &[u8]) -> SimulatedBus {
    let rules = LineRules::new(LineFormat::new(38_400, "8N1").unwrap());
    let drives = addresses.iter().map(|address| DriveOptions::nx(*address)).collect();
    let endpoint = EndpointOptions::Pty {
        link: Some(link.to_path_buf()),
    };
    SimulatedBus::start(SimulatedBusOptions {
        endpoint,
        transcript: 100_000,
        ..SimulatedBusOptions::new("line1", rules, drives)
    })
    .unwrap()
}

/// Function codes of the requests on the line.
pub(crate) fn functions(line: &SimulatedBus) -> Vec<u8> {
    let mut frames = line.transcript();
    frames.retain(|frame| frame.direction == Direction::ToDrives);
    frames.iter().filter_map(|frame| frame.bytes.get(1).copied()).collect()
}
