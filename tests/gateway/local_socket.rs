//! The local socket of a gateway: which gateway owns it, its file, and commands through it while others command too.

use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::fs::{FileTypeExt, PermissionsExt};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use serde_json::{Value, json};
use tempfile::TempDir;

use super::drive_access::{Line, Ran, ran};
use crate::support::mqtt::next_json;
use crate::support::process::{self, Running, free_port, mbpoll_read, mbpoll_write, until, write_registers};
use crate::support::site::curl;
use crate::support::tools::tool;

/// A client that writes and reads HTTP itself.
struct Client(BufReader<UnixStream>);

impl Client {
    fn connect(socket: &Path) -> Client {
        let stream = UnixStream::connect(socket).unwrap();
        stream.set_read_timeout(Some(process::PATIENCE)).unwrap();
        Client(BufReader::new(stream))
    }

    fn send(&mut self, text: &str) {
        self.0.get_mut().write_all(text.as_bytes()).unwrap();
    }

    /// The next line without its line end; `None` when the gateway has closed the connection.
    fn line(&mut self) -> Option<String> {
        let mut line = String::new();
        match self.0.read_line(&mut line) {
            Ok(0) | Err(_) => None,
            Ok(_) => Some(line.trim_end().to_string()),
        }
    }

    /// Status and body of the next reply; `None` when the gateway has closed the connection.
    fn next(&mut self) -> Option<(u16, Value)> {
        let status = self.line()?.split(' ').nth(1)?.parse().ok()?;
        let mut length = 0;
        while let Some(header) = self.line().filter(|line| !line.is_empty()) {
            if let Some(value) = header.to_ascii_lowercase().strip_prefix("content-length: ") {
                length = value.parse().unwrap();
            }
        }
        let mut body = vec![0; length];
        self.0.read_exact(&mut body).ok()?;
        Some((status, serde_json::from_slice(&body).unwrap_or_default()))
    }

    fn get(&mut self, path: &str) -> (u16, Value) {
        self.send(&get(path));
        self.next().unwrap()
    }

    fn post(&mut self, path: &str, body: &Value) -> (u16, Value) {
        self.send(&post(path, &body.to_string()));
        self.next().unwrap()
    }
}

fn get(path: &str) -> String {
    format!("GET {path} HTTP/1.1\r\nhost: gateway\r\n\r\n")
}

fn post(path: &str, body: &str) -> String {
    format!(
        "POST {path} HTTP/1.1\r\nhost: gateway\r\ncontent-length: {}\r\n\r\n{body}",
        body.len()
    )
}

fn exists(socket: &Path) -> bool {
    std::fs::symlink_metadata(socket).is_ok_and(|file| file.file_type().is_socket())
}

#[test]
fn its_file_is_for_owner_and_group_is_replaced_after_a_kill_and_removed_at_the_end() {
    let line = Line::start();
    let mut killed = line.gateway();
    let mode = std::fs::metadata(line.socket()).unwrap().permissions().mode();
    assert_eq!(mode & 0o777, 0o660);
    killed.signal("KILL");
    killed.ended();
    assert!(exists(&line.socket()), "left behind");
    let mut gateway = line.gateway();
    until("a read", || {
        (line.command("read", &["pump-1", "run"]).code == 0).then_some(())
    });
    let stop = line.command("write", &["pump-1", "run=false"]);
    assert!(stop.out.contains("through the gateway"), "{}{}", stop.out, stop.err);
    // A second gateway does not take the socket from the first one.
    let text = std::fs::read_to_string(line.config()).unwrap();
    let file = line.directory.path().join("second.toml");
    std::fs::write(&file, text.split("[modbus_tcp]").next().unwrap()).unwrap();
    let second = Running::drivegate(&["run", "--config", file.to_str().unwrap()]);
    let printed = second.until_printed("cannot listen on");
    assert!(printed.contains("another gateway listens there"), "{printed}");
    drop(second);
    let stop = line.command("write", &["pump-1", "run=false"]);
    assert!(stop.out.contains("through the gateway"), "{}{}", stop.out, stop.err);
    // One reload closes the socket, and the next one opens it again.
    line.reconfigure(|text| text.replace("own.sock", ""));
    gateway.signal("HUP");
    until("no socket", || (!exists(&line.socket())).then_some(()));
    line.reconfigure(|text| text.replace("socket = \"\"", "socket = \"own.sock\""));
    gateway.signal("HUP");
    until("the socket", || exists(&line.socket()).then_some(()));
    gateway.signal("TERM");
    assert!(gateway.ended().success());
    assert!(!line.socket().exists(), "removed");
}

#[test]
fn a_socket_that_cannot_be_bound_is_a_warning() {
    let line = Line::start();
    line.reconfigure(|text| text.replace("own.sock", "nowhere/own.sock"));
    let gateway = line.gateway();
    let printed = gateway.output();
    let warning = printed.lines().find(|line| line.contains("cannot listen on")).unwrap();
    assert!(
        warning.contains("WARN") && warning.contains("nowhere/own.sock"),
        "{warning}"
    );
    // The gateway serves all other clients, and the command does not become a second master.
    until("pump-1 by Modbus TCP", || mbpoll_read(line.modbus, 1, 32_768, 1).ok());
    let read = line.command("read", &["pump-1", "run"]);
    assert!(
        read.code == 1 && read.err.contains("no gateway listens at"),
        "{}",
        read.err
    );
    // A file that is not a socket is not removed.
    let file = line.directory.path().join("file");
    std::fs::write(&file, "precious").unwrap();
    line.reconfigure(|text| text.replace("nowhere/own.sock", "file"));
    gateway.signal("HUP");
    gateway.until_printed("not a socket");
    assert_eq!(std::fs::read_to_string(&file).unwrap(), "precious");
}

/// Two gateways of one user, both with the default path, and a configuration that no gateway runs.
#[test]
fn gateways_of_one_user_are_told_apart() {
    let session = TempDir::new().unwrap();
    let lines = [Line::start(), Line::start(), Line::start()];
    let command = |line: &Line, arguments: &[&str]| -> Command {
        let config = line.config().display().to_string();
        let mut command = process::drivegate(&[&[arguments[0], "--config", &config], &arguments[1..]].concat());
        command.env("XDG_RUNTIME_DIR", session.path());
        command
    };
    let write = |line: &Line| -> Ran { ran(&mut command(line, &["write", "pump-1", "run=false"])) };
    for line in &lines {
        // Both gateways get one name, as after two searches.
        line.reconfigure(|text| text.replace("socket = \"own.sock\"\n", ""));
    }
    lines[2].reconfigure(|text| text.replace("\"plant\"", "\"works\""));
    let start = |line: &Line| {
        let gateway = Running::spawn(&mut command(line, &["run"]));
        gateway.until_printed("drivegate is running");
        gateway
    };
    let gateways = [start(&lines[0]), start(&lines[1])];
    assert!(exists(&session.path().join("drivegate.sock")));
    assert!(exists(&session.path().join("drivegate-2.sock")));
    for line in &lines[..2] {
        until("a command through its own gateway", || {
            let ran = write(line);
            (ran.code == 0 && ran.out.contains("through the gateway")).then_some(())
        });
    }
    // The third configuration has another name and its own line, which is free.
    let direct = write(&lines[2]);
    // The notes may also mention another gateway of this machine.
    let notes = [
        "the gateway is `plant`, the file has `works`",
        "; the command opens the port itself",
    ];
    assert!(
        direct.code == 0 && !direct.out.contains("gateway") && notes.iter().all(|note| direct.err.contains(note)),
        "{}{}",
        direct.out,
        direct.err
    );
    // When the first gateway ends, the second is still found.
    let [first, _second] = gateways;
    drop(first);
    assert!(write(&lines[1]).out.contains("through the gateway"));
    let direct = write(&lines[0]);
    assert!(
        direct.code == 0 && !direct.out.contains("gateway"),
        "{}{}",
        direct.out,
        direct.err
    );
}

#[test]
fn clients_that_fall_silent_flood_or_read_nothing_harm_nobody() {
    let line = Line::start();
    let _gateway = line.gateway();
    until("a read", || {
        (line.command("read", &["pump-1", "run"]).code == 0).then_some(())
    });
    let points = "/api/v1/drives/pump-1/points";
    // A client that never reads its answers must not delay others.
    let mut deaf = Client::connect(&line.socket());
    deaf.0
        .get_ref()
        .set_write_timeout(Some(Duration::from_millis(200)))
        .unwrap();
    while deaf.0.get_mut().write_all(get(points).as_bytes()).is_ok() {}
    assert_eq!(line.command("read", &["pump-1", "run"]).code, 0);
    // A client that does not send HTTP gets a hint.
    for rubbish in ["{\"v\":1,\"read\":{\"drive\":\"pump-1\"}}\n", "run\n", "\0"] {
        let mut client = Client::connect(&line.socket());
        client.send(rubbish);
        let told: Value = serde_json::from_str(&client.line().unwrap()).unwrap();
        assert!(told["error"].as_str().unwrap().contains("serves HTTP"), "{told}");
        assert_eq!(client.line(), None, "closed");
    }
    let mut client = Client::connect(&line.socket());
    for (path, status) in [
        ("/api/v1/drives/pump-9/points", 404),
        ("/api/v1/drives/pump-1/points?names=x", 404),
        ("/api/v1/drives/pump-1/points?name=run", 400),
        ("/api/v1/drives/pump-1/params/restore", 409),
        (points, 200),
    ] {
        let (given, reply) = client.get(path);
        assert_eq!(given, status, "{path}: {reply}");
    }
    assert_eq!(client.get(points).1[0]["point"], "ready");
    // A head without end, and a command that was not ended.
    client.send(&format!("GET /{}", "x".repeat(32 * 1024)));
    assert!(client.next().is_none_or(|(status, _)| (400..500).contains(&status)));
    assert_eq!(client.line(), None, "closed");
    let mut cut = Client::connect(&line.socket());
    let command = post("/api/v1/drives/pump-1/commands", "{\"run\":true}");
    cut.send(command.strip_suffix('}').unwrap());
    cut.0.get_ref().shutdown(std::net::Shutdown::Write).unwrap();
    assert!(cut.next().is_none_or(|(status, _)| status != 200));
    // Silent clients do not prevent other clients from connecting: the client that is silent for longest gets a
    // message and is disconnected.
    let mut silent: Vec<Client> = (0..40).map(|_| Client::connect(&line.socket())).collect();
    let (status, busy) = silent[0].next().unwrap();
    assert!(status == 503 && busy["error"].is_string(), "{busy}");
    assert_eq!(silent[0].line(), None, "closed");
    assert_eq!(line.value("run"), false);
    assert_eq!(silent[39].get(points).1[0]["point"], "ready");
    drop(silent);
}

/// The audit has the user of the client's process.
#[test]
fn a_command_is_audited_with_its_user() {
    let line = Line::start();
    let gateway = line.gateway();
    until("a stop", || {
        (line.command("write", &["pump-1", "run=false"]).code == 0).then_some(())
    });
    line.command("write", &["pump-5", "run=true"]);
    let uid = rustix::process::getuid().as_raw();
    gateway.until_printed("\"result\":\"not_allowed\"");
    let printed = gateway.output();
    for (result, drive) in [("confirmed", "pump-1"), ("not_allowed", "pump-5")] {
        let audited = printed.lines().any(|line| {
            let fields = [
                "\"source\":\"local_socket\"",
                &format!("\"client\":\"uid {uid}\""),
                result,
                drive,
            ];
            fields.iter().all(|field| line.contains(field))
        });
        assert!(audited, "{drive}: {printed}");
    }
}

/// Baud rate and other keys of a Metasys N2 line.
const N2: (&str, &str) = ("9600", "protocol = \"n2\"\ncycle = \"500ms\"\nslow_cycle = \"2s\"\n");

/// A simulated drive of each family with its gateway.
struct Family {
    directory: TempDir,
    _drive: Running,
    _gateway: Running,
    modbus: u16,
    has_reverse: bool,
}

impl Family {
    fn start(profile: &str, (baud, line): (&str, &str), more: &str) -> Family {
        let directory = TempDir::new().unwrap();
        let link = directory.path().join("line1");
        let drive = Running::drivegate(&[
            "simulate",
            "--profile",
            profile,
            "--addresses",
            "2",
            "--baud",
            baud,
            "--link",
            link.to_str().unwrap(),
        ]);
        until("the line", || link.exists().then_some(()));
        let config = directory.path().join("drivegate.toml");
        let text = format!(
            "[gateway]\nname = \"plant\"\nsocket = \"own.sock\"\nstale_after = \"10s\"\n[[bus]]\nname = \"line1\"\nport = \"line1\"\nbaud = {baud}\n\
             response_timeout = \"500ms\"\nretries = 5\n{line}\
             [[bus.drive]]\nname = \"fan-1\"\naddress = 2\nprofile = \"{profile}\"\naccess = \"control\"\n{more}\n\
             [modbus_tcp]\nlisten = [\"127.0.0.1:0\"]\nwrite = [\"127.0.0.1/32\"]\n"
        );
        std::fs::write(&config, text).unwrap();
        let gateway = Running::drivegate(&["run", "--config", config.to_str().unwrap()]);
        let printed = gateway.until_printed("drivegate is running");
        let listening = printed
            .split("\"message\":\"Modbus TCP: listening\",\"address\":\"127.0.0.1:")
            .nth(1);
        let modbus = listening.unwrap().split('"').next().unwrap().parse().unwrap();
        let shown = ran(&mut process::drivegate(&["profiles", "show", profile]));
        let family = Family {
            directory,
            _drive: drive,
            _gateway: gateway,
            modbus,
            has_reverse: shown.out.contains("reverse "),
        };
        until("all that is polled", || {
            let rows = family.rows(&[]);
            let good = rows.iter().all(|row| row["quality"] == "good");
            (good && !rows.is_empty()).then_some(())
        });
        family
    }

    fn command(&self, what: &str, rest: &[&str]) -> Ran {
        let config = self.directory.path().join("drivegate.toml");
        ran(&mut process::drivegate(
            &[&[what, "--config", config.to_str().unwrap()], rest].concat(),
        ))
    }

    fn rows(&self, points: &[&str]) -> Vec<Value> {
        let ran = self.command("read", &[&["--json", "fan-1"], points].concat());
        serde_json::from_str(&ran.out).unwrap_or_default()
    }

    fn value(&self, point: &str) -> Value {
        self.rows(&[point]).pop().unwrap_or_default()["value"].clone()
    }

    fn write(&self, values: &[&str]) {
        let ran = until("a command that no pause of the machine held up", || {
            Some(self.command("write", &[&["fan-1"], values].concat())).filter(|ran| !ran.err.contains("(expired)"))
        });
        assert_eq!(ran.code, 0, "{values:?}: {}", ran.err);
        assert!(ran.out.contains("through the gateway"), "{}", ran.out);
    }

    fn until_running(&self, running: bool) {
        until(&format!("running is {running}"), || {
            (self.value("running") == running).then_some(())
        });
    }

    /// A command without `run` leaves `run` unchanged, whichever client stopped the motor.
    fn only_run_runs(&self) {
        self.write(&["run=true", "speed_reference=40"]);
        self.until_running(true);
        let scada = |word| write_registers(self.modbus, 2, 33_024, &[word]);
        scada(0);
        // The stop is accepted, the motor still slows down.
        self.write(&["fault_reset=true"]);
        if self.has_reverse {
            self.write(&["reverse=true"]);
        }
        self.until_running(false);
        assert_eq!(self.value("run"), false);
        if self.has_reverse {
            self.write(&["reverse=false"]);
        }
        self.write(&["fault_reset=true"]);
        assert_eq!((self.value("run"), self.value("running")), (false.into(), false.into()));
        // A command without `run` does not stop a motor that a SCADA client has started, either.
        scada(1);
        self.until_running(true);
        if self.has_reverse {
            self.write(&["reverse=false"]);
            assert_eq!(self.value("run"), true);
        }
        self.write(&["run=false"]);
        self.until_running(false);
    }
}

#[test]
fn a_command_without_run_never_carries_it_on_any_family() {
    let rtu = ("19200", "cycle = \"200ms\"\n");
    let cx = ("19200", "format = \"8N2\"\ncycle = \"200ms\"\n");
    let ascii = ("19200", "protocol = \"modbus-ascii\"\ncycle = \"200ms\"\n");
    for some in [
        &[
            ("vacon-nx", rtu),
            ("eaton-svx", rtu),
            ("eaton-hvx", rtu),
            ("vacon-cx", cx),
        ][..],
        &[
            ("teco-7300pa", ascii),
            ("vacon-nx-n2", N2),
            ("eaton-hvx-n2", N2),
            ("teco-7300pa-n2", N2),
        ],
    ] {
        std::thread::scope(|scope| {
            for (profile, line) in some {
                scope.spawn(|| Family::start(profile, *line, "").only_run_runs());
            }
        });
    }
}

/// A stop between two commands without `run` remains in effect, however the commands interleave with it.
#[test]
fn a_stop_that_comes_in_between_is_not_undone() {
    let family = Family::start("vacon-nx", ("38400", "silence = \"chars\"\n"), "");
    let socket = family.directory.path().join("own.sock");
    for _ in 0..5 {
        family.write(&["run=true", "speed_reference=20"]);
        family.until_running(true);
        std::thread::scope(|scope| {
            for point in ["reverse", "fault_reset"] {
                let socket = &socket;
                scope.spawn(move || {
                    let mut client = Client::connect(socket);
                    for on in [true, false, true, false] {
                        // A stop may cut the command short; that reply is also an answer.
                        client.post("/api/v1/drives/fan-1/commands", &json!({ point: on }));
                    }
                });
            }
            mbpoll_write(family.modbus, 2, 33_024, &[0]).unwrap();
        });
        family.until_running(false);
        assert_eq!(family.value("run"), false);
    }
}

/// Derived points are computed like the gateway's: `frequency_range` counts, as over MQTT.
#[test]
fn a_configured_frequency_range_counts_as_over_mqtt() {
    let folder = TempDir::new().unwrap();
    let port = free_port();
    let file = folder.path().join("mosquitto.conf");
    std::fs::write(&file, format!("listener {port} 127.0.0.1\nallow_anonymous true\n")).unwrap();
    let _broker = Running::start(&tool("mosquitto"), &["-c", &file.display().to_string()]);
    let more = format!("frequency_range = [0.0, 50.0]\n[mqtt]\nurl = \"mqtt://127.0.0.1:{port}\"\n");
    let family = Family::start("teco-7300pa-n2", N2, &more);
    family.write(&["frequency_reference=25"]);
    until("the reference", || {
        (family.value("frequency_reference") == 25.0).then_some(())
    });
    assert_eq!(family.value("speed_reference"), 50.0);
    until("the same over MQTT", || {
        let value = next_json(port, "drivegate/plant/drive/fan-1/point/speed_reference")?;
        (value == 50.0).then_some(())
    });
}

/// The HTTP API at the socket, by curl: status and reply.
fn http(line: &Line, arguments: &[&str], path: &str) -> (u16, Value) {
    let socket = line.socket().display().to_string();
    let url = format!("http://gateway{path}");
    curl(&[&["--unix-socket", &socket][..], arguments, &[&url]].concat())
}

#[test]
fn it_serves_the_http_api_to_whoever_may_open_it() {
    let line = Line::start();
    let _gateway = line.gateway();
    until("ready", || {
        (http(&line, &[], "/api/v1/health").1 == json!({"ready": true, "reasons": []})).then_some(())
    });
    let (status, drive) = http(&line, &[], "/api/v1/drives/pump-1");
    assert_eq!((status, &drive["online"]), (200, &json!(true)));
    // No login, no token, any host; the audit has the user's id.
    let command = "/api/v1/drives/pump-1/commands";
    let (status, started) = http(&line, &["-d", r#"{"run":true,"speed_reference":40}"#], command);
    assert_eq!((status, &started["result"]), (200, &json!("confirmed")), "{started}");
    let (status, stopped) = http(&line, &["-d", r#"{"run":false}"#], command);
    assert_eq!((status, &stopped["result"]), (200, &json!("confirmed")), "{stopped}");
    let (_, audit) = http(&line, &[], "/api/v1/audit?drive=pump-1");
    let last = audit.as_array().unwrap().last().unwrap();
    assert_eq!(last["source"], "local_socket");
    assert!(last["client"].as_str().unwrap().starts_with("uid "), "{last}");
    assert_eq!(http(&line, &["-d", r#"{"speed_reference":140}"#], command).0, 422);
    assert_eq!(
        http(&line, &["-d", "{}"], "/api/v1/login").0,
        405,
        "nobody logs in here"
    );
    // The gateway reloads its configuration, or reports why it did not.
    let (status, outcome) = http(&line, &["-d", "{}"], "/api/v1/reload");
    assert_eq!((status, &outcome["changes"]), (200, &json!([])), "{outcome}");
    line.reconfigure(|text| text.replace("address = 1", "address = 999"));
    let (status, outcome) = http(&line, &["-d", "{}"], "/api/v1/reload");
    assert_eq!(status, 422, "{outcome}");
    assert!(outcome["errors"][0].as_str().unwrap().contains("999"), "{outcome}");
    assert_eq!(http(&line, &[], "/api/v1/nothing").0, 404);
}
