//! `drivegate try`: from a port to values on a page, with a terminal and without one.

use std::fs::File;
use std::io::{Read, Write};
use std::net::TcpListener;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::process::{Child, Command, ExitStatus};
use std::sync::{Arc, Mutex};

use drivegate_sim::wire::SimulatedBus;
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use tempfile::TempDir;

use super::drive_access::ran;
use crate::support::process::{PATIENCE, Running, api, drivegate, get, until};
use crate::support::site::{functions, line_of};

/// A program that runs on its own pseudo-terminal.
struct OnTerminal {
    child: Child,
    keyboard: File,
    screen: Arc<Mutex<String>>,
}

impl OnTerminal {
    fn start(arguments: &[&str]) -> OnTerminal {
        let terminal = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
        grantpt(&terminal).unwrap();
        unlockpt(&terminal).unwrap();
        let name = ptsname(&terminal, Vec::new()).unwrap();
        let no_controlling_terminal = i32::try_from(rustix::fs::OFlags::NOCTTY.bits()).unwrap();
        let open = || {
            File::options()
                .read(true)
                .write(true)
                .custom_flags(no_controlling_terminal)
                .open(name.to_str().unwrap())
                .unwrap()
        };
        // Ctrl-C becomes a signal only for the session that the terminal controls.
        let program = drivegate(&[]);
        let mut command = Command::new("setsid");
        command
            .args(["--ctty", "--wait"])
            .arg(program.get_program())
            .args(arguments);
        command.stdin(open()).stdout(open()).stderr(open());
        let child = command.spawn().unwrap();
        let screen = Arc::new(Mutex::new(String::new()));
        let mut output = File::from(terminal.try_clone().unwrap());
        let shown = screen.clone();
        std::thread::spawn(move || {
            let mut bytes = [0; 4096];
            // A terminal whose other end is closed cannot be read.
            while let Some(count) = output.read(&mut bytes).ok().filter(|count| *count > 0) {
                shown
                    .lock()
                    .unwrap()
                    .push_str(&String::from_utf8_lossy(&bytes[..count]));
            }
        });
        OnTerminal {
            child,
            keyboard: File::from(terminal),
            screen,
        }
    }

    fn screen(&self) -> String {
        self.screen.lock().unwrap().clone()
    }

    fn until_shown(&self, text: &str) -> String {
        until(&format!("`{text}` on the terminal"), || {
            Some(self.screen()).filter(|screen| screen.contains(text))
        })
    }

    fn press(&mut self, keys: &str) {
        self.keyboard.write_all(keys.as_bytes()).unwrap();
    }

    fn ended(&mut self) -> ExitStatus {
        until("the end of the program", || self.child.try_wait().unwrap())
    }
}

impl Drop for OnTerminal {
    fn drop(&mut self) {
        // Ctrl-C ends the program on the terminal; `setsid` waits for that.
        let _ = self.keyboard.write_all(b"\x03");
        let _ = self.child.kill();
        let _ = self.child.wait();
        if std::thread::panicking() {
            eprintln!("--- the terminal\n{}", self.screen());
        }
    }
}

struct TwoDrives {
    folder: TempDir,
    line: SimulatedBus,
}

impl TwoDrives {
    /// Starts drives at addresses 3 and 7.
    fn start() -> TwoDrives {
        let folder = tempfile::tempdir().unwrap();
        let line = line_of(&folder.path().join("line"), &[3, 7]);
        TwoDrives { folder, line }
    }

    fn path(&self, name: &str) -> String {
        self.folder.path().join(name).display().to_string()
    }

    /// The command line that searches where the drives are.
    fn arguments(&self, more: &[&str]) -> Vec<String> {
        let port = self.path("line");
        let fixed = [
            "try",
            "--port",
            &port,
            "--protocol",
            "modbus-rtu",
            "--baud",
            "38400",
            "--addresses",
            "1-8",
            // On a busy machine a drive may answer later than within 100 ms.
            "--timeout",
            "1s",
        ];
        [&fixed[..], more].concat().iter().map(ToString::to_string).collect()
    }

    fn is_only_read(&self) {
        let functions = functions(&self.line);
        assert!(
            functions.len() > 20 && functions.iter().all(|function| (1..=4).contains(function)),
            "{functions:?}"
        );
    }
}

fn words(arguments: &[String]) -> Vec<&str> {
    arguments.iter().map(String::as_str).collect()
}

/// The port of the status page that was announced.
fn page(printed: &str) -> u16 {
    let (_, rest) = printed
        .split_once("http://127.0.0.1:")
        .unwrap_or_else(|| panic!("no page in\n{printed}"));
    rest.split('/').next().unwrap().parse().unwrap()
}

fn is_sound(config: &str) {
    let checked = ran(&mut drivegate(&["check", config]));
    assert_eq!(checked.code, 0, "{}", checked.err);
    assert!(checked.out.contains("1 bus, 2 drives, no warnings"), "{}", checked.out);
}

#[test]
fn on_a_terminal_it_ends_with_values_and_a_configuration() {
    let rig = TwoDrives::start();
    let taken = rig.path("taken.toml");
    std::fs::write(&taken, "mine").unwrap();
    let mut trial = OnTerminal::start(&words(&rig.arguments(&[])));
    let shown = trial.until_shown("Save this as a configuration?");
    assert!(
        shown.contains("found modbus-rtu 38400 8N1, address 7: vacon-nx"),
        "{shown}"
    );
    // On a busy machine the drives may need a second request first.
    assert!(shown.contains(" state "), "values before the question: {shown}");
    // The first drive is shown before the next one is found.
    let place = |text: &str| shown.find(text).unwrap_or_else(|| panic!("{text} in {shown}"));
    let first = place("\u{20} address 3: ");
    assert!(
        first < place("address 7: vacon-nx") && first < place("Enter ends the search"),
        "{shown}"
    );
    let http = page(&shown);
    for drive in ["drive-1", "drive-2"] {
        until("the drive is read", || {
            (api(http, drive)["state"] == "ready").then_some(())
        });
    }
    assert_eq!(api(http, "drive-2")["access"], "monitor");
    trial.press(&format!("{taken}\n"));
    trial.until_shown("taken.toml exists already");
    let written = rig.path("plant.toml");
    trial.press(&format!("{written}\n"));
    trial.until_shown(&format!("Configuration written to {written}"));
    let users = rig.path("users");
    trial.until_shown(&format!("drivegate user add --file {users} alice"));
    assert_eq!(std::fs::read_to_string(&taken).unwrap(), "mine");
    is_sound(&written);
    assert!(get(http, "/").is_some_and(|(status, _)| status == 200));
    trial.press("\x03");
    assert!(trial.ended().success(), "{}", trial.screen());
    rig.is_only_read();
}

/// The whole range of addresses takes half a minute; who has seen enough does not wait for it.
#[test]
fn enter_ends_the_search() {
    let rig = TwoDrives::start();
    let port = rig.path("line");
    // A drive that the machine holds up is waited for.
    let line = [
        "--protocol",
        "modbus-rtu",
        "--baud",
        "38400",
        "--format",
        "8N1",
        "--timeout",
        "1s",
    ];
    let mut trial = OnTerminal::start(&[&["try", "--port", &port][..], &line].concat());
    trial.until_shown("Enter ends the search and opens the status page");
    trial.press("\n");
    let shown = trial.until_shown("Save this as a configuration?");
    assert!(
        shown.contains("stopped after ") && shown.contains(" of 247 addresses"),
        "{shown}"
    );
    assert!(shown.contains("\u{20} address 3: "), "{shown}");
    trial.press("\n");
    until("the page", || {
        get(page(&shown), "/").filter(|(status, _)| *status == 200)
    });
    trial.press("\x03");
    assert!(trial.ended().success(), "{}", trial.screen());
    let functions = functions(&rig.line);
    assert!(
        functions.iter().all(|function| (1..=4).contains(function)),
        "{functions:?}"
    );
}

/// A drive of a family that no read shows: its make is asked, or named on the command line.
#[test]
fn the_make_that_no_read_shows_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let link = folder.path().join("line");
    let port = link.display().to_string();
    let _drive = Running::drivegate(&[
        "simulate",
        "--profile",
        "delta-ms300",
        "--addresses",
        "2",
        "--baud",
        "9600",
        "--link",
        &port,
    ]);
    until("the line", || link.exists().then_some(()));
    let line = [
        "--protocol",
        "modbus-rtu",
        "--baud",
        "9600",
        "--format",
        "8N1",
        "--addresses",
        "2",
        "--timeout",
        "1s",
    ];
    let line = [&["try", "--port", &port][..], &line].concat();
    let unnamed = ran(drivegate(&line).stdin(std::process::Stdio::null()));
    assert_eq!(unnamed.code, 1, "{}", unnamed.err);
    for wanted in [
        "address 2: a device whose family no read shows",
        "name its profile: --profile NAME, with one of abb-acs550, ",
        "delta-ms300",
    ] {
        assert!(unnamed.err.contains(wanted), "{wanted}: {}", unnamed.err);
    }

    let mut trial = OnTerminal::start(&line);
    let shown = trial.until_shown("Number or name, or Enter for none of these:");
    assert!(
        shown.contains("at address 2. Which make is it") && shown.contains("Delta MS300"),
        "{shown}"
    );
    trial.press("delta\n");
    trial.until_shown("or a name of the list");
    trial.press("delta-ms300\n");
    let shown = trial.until_shown("Save this as a configuration?");
    until("values", || {
        (api(page(&shown), "drive-1")["profile"] == "delta-ms300").then_some(())
    });
    trial.press("\x03");
    assert!(trial.ended().success(), "{}", trial.screen());

    let written = folder.path().join("plant.toml").display().to_string();
    let mut named = Running::drivegate(&[&line[..], &["--profile", "delta-ms300", "--write", &written]].concat());
    named.until_printed("Configuration written to ");
    let config = std::fs::read_to_string(&written).unwrap();
    assert!(config.contains("profile = \"delta-ms300\"\n"), "{config}");
    assert!(config.contains("# Named, not identified: "), "{config}");
    named.signal("INT");
    assert!(named.ended().success());
    let wrong = ran(&mut drivegate(&[&line[..], &["--profile", "delta-300"]].concat()));
    assert_eq!(wrong.code, 2, "{}", wrong.err);
    assert!(wrong.err.contains("did you mean `delta-ms300`?"), "{}", wrong.err);
}

#[test]
fn ctrl_c_ends_it_at_any_moment() {
    let rig = TwoDrives::start();
    // Interrupted while it listens to the line, and while it searches.
    for moment in ["looking for drives", " left, "] {
        let port = rig.path("line");
        let mut trial = OnTerminal::start(&["try", "--port", &port, "--addresses", "100-247"]);
        trial.until_shown(moment);
        trial.press("\x03");
        let status = trial.ended();
        assert_eq!(status.code(), Some(1), "{}", trial.screen());
        // The thread that reads the terminal may finish after the end of the program.
        trial.until_shown("stopped; nothing was written");
    }
    // The key is pressed at the question.
    let mut trial = OnTerminal::start(&words(&rig.arguments(&[])));
    trial.until_shown("Save this as a configuration?");
    trial.press("\x03");
    assert!(trial.ended().success(), "{}", trial.screen());
}

#[test]
fn a_script_has_an_option_for_the_question() {
    let rig = TwoDrives::start();
    let written = rig.path("plant.toml");
    let mut trial = Running::drivegate(&words(&rig.arguments(&["--write", &written])));
    let printed = trial.until_printed("Configuration written to ");
    until("the drive", || {
        (api(page(&printed), "drive-1")["state"] == "ready").then_some(())
    });
    is_sound(&written);
    trial.signal("TERM");
    assert!(trial.ended().success());
    let again = ran(&mut drivegate(&words(&rig.arguments(&["--write", &written]))));
    assert_eq!(again.code, 2, "{}", again.err);
    assert!(again.err.contains("exists already"), "{}", again.err);
    // Without a terminal and without an option, nothing is written.
    let mut silent = Running::drivegate(&words(&rig.arguments(&[])));
    silent.until_printed("no configuration was written; --write FILE writes one");
    silent.signal("INT");
    assert!(silent.ended().success());
    rig.is_only_read();
}

#[test]
fn what_was_heard_tells_a_dead_line_from_a_wrong_setting() {
    let nobody = TwoDrives::start();
    let port = nobody.path("line");
    let fast = ["--protocol", "modbus-rtu", "--baud", "38400", "--format", "8N1"];
    let silent = ran(drivegate(&["try", "--port", &port, "--addresses", "1,2"]).args(fast));
    assert_eq!(silent.code, 1, "{}", silent.err);
    assert!(
        silent.err.contains("after 2 requests no byte was received"),
        "{}",
        silent.err
    );

    let folder = tempfile::tempdir().unwrap();
    let link = folder.path().join("line").display().to_string();
    let _noisy = Running::drivegate(&["simulate", "--link", &link, "--fault", "corrupt=1"]);
    until("the line", || Path::new(&link).exists().then_some(()));
    let wrong = ran(drivegate(&["try", "--port", &link, "--addresses", "1", "--timeout", "1s"]).args(fast));
    assert_eq!(wrong.code, 1, "{}", wrong.err);
    assert!(
        wrong
            .err
            .contains("that are not a valid reply, most of them at modbus-rtu 38400 8N1"),
        "{}",
        wrong.err
    );
}

#[test]
fn another_master_is_not_disturbed() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = format!("tcp://{}", listener.local_addr().unwrap());
    let received = std::thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let mut got = Vec::new();
        // Polls of another master, until the other side has closed the connection.
        while stream.write_all(&[1, 3, 8, 0x34, 0, 11, 0x47, 0xA3]).is_ok() {
            std::thread::sleep(std::time::Duration::from_millis(20));
        }
        let _ = stream.read_to_end(&mut got);
        got
    });
    let ended = ran(&mut drivegate(&["try", "--port", &port]));
    assert_eq!(ended.code, 1, "{}", ended.err);
    assert!(
        ended
            .err
            .contains("before anything was sent, so nothing was sent: another master sends"),
        "{}",
        ended.err
    );
    assert_eq!(received.join().unwrap(), [0; 0], "not one byte was sent");
}

#[test]
fn without_a_port_somebody_must_be_there_to_choose() {
    let ended = ran(drivegate(&["try"]).stdin(std::process::Stdio::null()));
    assert_ne!(ended.code, 0);
    assert!(ended.err.contains("--port"), "{}", ended.err);
}
