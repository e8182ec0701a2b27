//! A drive operated from the status page: the real gateway, a simulated drive, a real browser.

use std::io::{BufRead, BufReader, Write};
use std::path::PathBuf;
use std::process::{Child, ChildStdout, Command, Stdio};

use crate::support::process::{Running, api, drivegate, get, mbpoll_write, until, write_registers};
use crate::support::site::{HTTP, LINE1, MODBUS_TCP, PASSWORD, Site, USERS, controlled, drive};
use crate::support::tools::{root, run, tool};

const COMMANDS: &str = "commands = true\nusers_file = \"users\"\n";

/// A gateway with commands, of a drive whose lease is short, and one that is monitored.
fn site() -> Site {
    let keys = "limits = { speed_reference = [0.0, 80.0] }\nsupervision = { timeout = \"8s\", action = \"stop\" }";
    let drives = [controlled("pump-1", 1, keys), drive("fan-2", 2, "")].concat();
    let site = Site::of(&[LINE1, &drives, HTTP, COMMANDS]);
    user(&site, &["add"], "alice", "correct horse\n");
    site
}

/// `drivegate user`, with that on standard input.
fn user(site: &Site, action: &[&str], name: &str, input: &str) -> String {
    let file = site.path("users");
    let arguments = [&["user"], action, &["--file", &file, name]].concat();
    let mut child = drivegate(&arguments)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    child.stdin.take().unwrap().write_all(input.as_bytes()).unwrap();
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success(), "{output:?}");
    String::from_utf8(output.stdout).unwrap()
}

fn axe() -> PathBuf {
    let script = root().join(".tools/node/node_modules/axe-core/axe.min.js");
    assert!(
        script.exists(),
        "{} is missing; run tests/tools/install.sh",
        script.display()
    );
    script
}

fn arguments(site: &Site, what: &str) -> [String; 4] {
    [
        root().join("tests/north/http/operate.js").display().to_string(),
        format!("http://localhost:{}/", site.http),
        axe().display().to_string(),
        what.to_string(),
    ]
}

fn audit(site: &Site) -> String {
    get(site.http, "/api/v1/audit").expect("an answer").1
}

fn state(site: &Site) -> String {
    api(site.http, "pump-1")["state"].to_string()
}

#[test]
fn a_drive_is_operated_from_the_page_by_the_keyboard() {
    let site = site();
    let _line = site.simulate(&["--addresses", "1-2", "--baud", "38400"]);
    let _gateway = site.run_ready();
    let arguments = arguments(&site, "operate");
    let browser = run(&tool("node"), &arguments.each_ref().map(String::as_str));
    assert!(browser.status.success(), "{}", String::from_utf8_lossy(&browser.stderr));
    let audit: serde_json::Value = serde_json::from_str(&audit(&site)).unwrap();
    let of = |record: &serde_json::Value| {
        assert_eq!(
            (&record["source"], &record["drive"]),
            (&"http".into(), &"pump-1".into())
        );
        assert!(record["client"].as_str().unwrap().starts_with("alice "), "{record}");
        record["command"].as_str().unwrap().to_string()
    };
    let commands: Vec<String> = audit.as_array().unwrap().iter().map(of).collect();
    assert_eq!(
        commands,
        [
            "speed_reference=50",
            "run=true reverse=false",
            "run=false",
            // Started once more, and stopped with all drives.
            "run=true reverse=false",
            "run=false"
        ],
        "these, and no more"
    );
}

/// A user is removed while its page is open, and the lease of the drive that it started expires.
#[test]
fn a_removed_user_stops_nothing_and_the_lease_does() {
    let site = site();
    let _line = site.simulate(&["--addresses", "1-2", "--baud", "38400"]);
    let gateway = site.run_ready();
    let mut browser = Command::new(tool("node"))
        .args(arguments(&site, "ended"))
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut printed = BufReader::new(browser.stdout.take().unwrap());
    let mut line = String::new();
    printed.read_line(&mut line).unwrap();
    assert_eq!(line, "logged in\n");
    let curl = |body: &str| {
        let url = format!("http://localhost:{}/api/v1/drives/pump-1/commands", site.http);
        let ran = run(&tool("curl"), &["-sS", "-u", "alice:correct horse", "-d", body, &url]);
        String::from_utf8(ran.stdout).unwrap()
    };
    until("the start", || {
        curl("{\"run\": true, \"speed_reference\": 40}")
            .contains("\"ok\":true")
            .then_some(())
    });
    assert!(user(&site, &["remove"], "alice", "").contains("was removed"));
    gateway.signal("HUP");
    until("alice is out", || {
        curl("{\"speed_reference\": 40}")
            .contains("wrong user or password")
            .then_some(())
    });
    browser.stdin.take().unwrap().write_all(b"\n").unwrap();
    assert!(browser.wait().unwrap().success());
    until("the lease runs out", || (state(&site) == "\"ready\"").then_some(()));
    let audit = audit(&site);
    assert!(audit.contains("\"supervision\""), "{audit}");
}

const AUTHORITY: &str = r#"
[authority]
mode = "exclusive"
lease = "10min"
[[authority.principal]]
name = "alice"
rank = "operator"
http_user = "alice"
[[authority.principal]]
name = "plc"
rank = "automation"
modbus_tcp = ["127.0.0.1/32"]
[[authority.principal]]
name = "bob"
rank = "remote"
http_user = "bob"
"#;

/// The page of a user, which prints each step that it has done and waits for a line.
struct Hand {
    browser: Child,
    printed: BufReader<ChildStdout>,
}

impl Hand {
    fn new(site: &Site, user: &str, what: &str) -> Hand {
        let script = root().join("tests/north/http/page/takeover.js");
        let url = format!("http://localhost:{}/", site.http);
        let mut browser = Command::new(tool("node"))
            .arg(script)
            .args([&url, user, PASSWORD, what])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let printed = BufReader::new(browser.stdout.take().unwrap());
        Hand { browser, printed }
    }

    fn until(&mut self, step: &str) {
        let mut line = String::new();
        self.printed.read_line(&mut line).unwrap();
        assert_eq!(line.trim_end(), step);
    }

    fn goes_on(&mut self) {
        self.browser.stdin.as_mut().unwrap().write_all(b"\n").unwrap();
    }

    fn ends(mut self) {
        self.goes_on();
        assert!(self.browser.wait().unwrap().success());
    }
}

/// A higher rank takes a running drive over and releases it on the page, and its motor goes on; a lower one can only stop it.
#[test]
fn a_running_drive_is_taken_over_on_the_page() {
    let pump = controlled("pump-1", 1, "");
    let site = Site::of(&[LINE1, &pump, MODBUS_TCP, HTTP, USERS, AUTHORITY]);
    site.add_user("alice");
    site.add_user("bob");
    let _line = site.simulate(&["--addresses", "1", "--baud", "38400"]);
    let _gateway = site.run_ready();
    site.until_state("pump-1", "ready");
    write_registers(site.modbus, 1, 0x8100, &[1, 5000]);
    site.until_point("pump-1", "output_frequency", 25.0);
    let holder = || api(site.http, "pump-1")["holder"].clone();
    assert_eq!(holder(), "plc");
    let mut alice = Hand::new(&site, "alice", "take");
    alice.until("taken");
    assert_eq!(holder(), "alice");
    let refused = mbpoll_write(site.modbus, 1, 0x8100, &[1, 4000]).unwrap_err();
    assert!(refused.to_lowercase().contains("busy"), "{refused}");
    assert_eq!(site.point("pump-1", "output_frequency"), 25.0);
    alice.goes_on();
    alice.until("released");
    assert_eq!(holder(), serde_json::Value::Null);
    alice.ends();
    write_registers(site.modbus, 1, 0x8100, &[1, 4000]);
    site.until_point("pump-1", "output_frequency", 20.0);
    assert_eq!(api(site.http, "pump-1")["starts"], 1, "the motor was not stopped by it");
    let mut bob = Hand::new(&site, "bob", "stop");
    bob.until("stopped");
    bob.ends();
    let seen = api(site.http, "pump-1");
    assert_eq!((&seen["hold"], &seen["holder"]), (&"reserved".into(), &"bob".into()));
    let stops: Vec<_> = site
        .audit()
        .into_iter()
        .filter(|entry| entry["command"] == "run=false")
        .collect();
    assert_eq!(stops.len(), 1, "{stops:?}");
    assert!(stops[0]["client"].as_str().unwrap().starts_with("bob "), "{stops:?}");
}

/// Messages of `check` about commands that cannot work.
#[test]
fn commands_need_users_and_a_private_way() {
    let site = site();
    let check = || {
        let output = run(
            env!("CARGO_BIN_EXE_drivegate").as_ref(),
            &["check", "--config", &site.config()],
        );
        (
            output.status.code(),
            String::from_utf8([output.stdout, output.stderr].concat()).unwrap(),
        )
    };
    let (code, said) = check();
    assert_eq!(code, Some(0), "{said}");
    for (from, to, wanted) in [
        ("users_file = \"users\"\n", "", "there is no `users_file`"),
        ("127.0.0.1", "0.0.0.0", "passwords in clear text"),
        ("\"users\"", "\"nowhere\"", "nowhere"),
    ] {
        let before = site.change(from, to);
        let (code, said) = check();
        assert_eq!(code, Some(78), "{said}");
        assert!(
            said.contains(wanted) && said.contains("drivegate.conf:"),
            "{wanted}: {said}"
        );
        site.write("drivegate.conf", &before);
    }
    let mut gateway = Running::drivegate(&["run", "--config", &site.config()]);
    gateway.until_printed("drivegate is running");
    assert!(gateway.runs());
}

/// A bus that a reload restarts keeps the last commander of each drive, and the leases.
#[test]
fn a_bus_that_starts_anew_knows_who_commanded_last() {
    let site = site();
    let _line = site.simulate(&["--addresses", "1-2", "--baud", "38400"]);
    let gateway = site.run_ready();
    let post = |what: &str, body: &str| {
        let url = format!("http://localhost:{}/api/v1/drives/pump-1/{what}", site.http);
        let login = "alice:correct horse";
        let ran = run(
            &tool("curl"),
            &[
                "-sS",
                "-o",
                "/dev/null",
                "-w",
                "%{http_code}",
                "-u",
                login,
                "-d",
                body,
                &url,
            ],
        );
        String::from_utf8(ran.stdout).unwrap()
    };
    assert_eq!(post("heartbeat", ""), "409");
    assert_eq!(post("commands", "{\"speed_reference\": 20}"), "200");
    assert_eq!(post("heartbeat", ""), "204");
    site.change("response_timeout = \"2s\"", "response_timeout = \"1900ms\"");
    gateway.signal("HUP");
    gateway.until_printed("configuration reloaded");
    assert!(
        gateway.output().matches("starting the bus").count() >= 2,
        "the bus starts anew"
    );
    assert_eq!(post("heartbeat", ""), "204");
}
