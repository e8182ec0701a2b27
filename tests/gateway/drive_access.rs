//! `scan`, `read` and `write`: directly on a port, and through a gateway that owns the port.

use std::path::{Path, PathBuf};
use std::process::Command;

use tempfile::TempDir;

use crate::support::process::{self, Running, api, free_port, until, until_ready};
use crate::support::site::line_of;
use crate::support::tools::tool;

/// Exit code of a command, and its output on standard output and standard error.
pub(crate) struct Ran {
    pub(crate) code: i32,
    pub(crate) out: String,
    pub(crate) err: String,
}

pub(crate) fn drivegate(arguments: &[&str]) -> Ran {
    ran(&mut process::drivegate(arguments))
}

pub(crate) fn ran(command: &mut Command) -> Ran {
    let output = command.output().unwrap();
    Ran {
        code: output.status.code().unwrap_or(-1),
        out: String::from_utf8_lossy(&output.stdout).into_owned(),
        err: String::from_utf8_lossy(&output.stderr).into_owned(),
    }
}

/// Two simulated drives on a line, with the configuration of a gateway for them.
pub(crate) struct Line {
    pub(crate) directory: TempDir,
    _drives: Running,
    pub(crate) modbus: u16,
}

impl Line {
    pub(crate) fn start() -> Line {
        let directory = TempDir::new().unwrap();
        let link = directory.path().join("line1");
        let arguments = ["simulate", "--addresses", "1,5", "--baud", "38400", "--link"];
        let drives = Running::drivegate(&[&arguments[..], &[link.to_str().unwrap()]].concat());
        until("the line", || link.exists().then_some(()));
        let line = Line {
            directory,
            _drives: drives,
            modbus: free_port(),
        };
        let text = format!(
            "[gateway]\nname = \"plant\"\nsocket = \"own.sock\"\nstale_after = \"1min\"\n\
             [[bus]]\nname = \"line1\"\nport = \"line1\"\nbaud = 38400\nresponse_timeout = \"1s\"\n\
             [[bus.drive]]\nname = \"pump-1\"\naddress = 1\nprofile = \"vacon-nx\"\naccess = \"control\"\n\
             limits = {{ speed_reference = [0.0, 80.0] }}\nraw_writes = [[1998, 1998]]\n\
             [[bus.drive]]\nname = \"pump-5\"\naddress = 5\nprofile = \"vacon-nx\"\n\
             [modbus_tcp]\nlisten = [\"127.0.0.1:{}\"]\nwrite = [\"127.0.0.1/32\"]\n",
            line.modbus
        );
        std::fs::write(line.config(), text).unwrap();
        line
    }

    pub(crate) fn config(&self) -> PathBuf {
        self.directory.path().join("drivegate.toml")
    }

    pub(crate) fn socket(&self) -> PathBuf {
        self.directory.path().join("own.sock")
    }

    /// Starts a gateway with this configuration and waits until its socket listens.
    pub(crate) fn gateway(&self) -> Running {
        let gateway = Running::drivegate(&["run", "--config", self.config().to_str().unwrap()]);
        gateway.until_printed("drivegate is running");
        gateway
    }

    /// Writes a changed configuration.
    pub(crate) fn reconfigure(&self, change: impl FnOnce(String) -> String) {
        let text = std::fs::read_to_string(self.config()).unwrap();
        std::fs::write(self.config(), change(text)).unwrap();
    }

    fn port(&self) -> String {
        self.directory.path().join("line1").display().to_string()
    }

    pub(crate) fn command(&self, what: &str, rest: &[&str]) -> Ran {
        let config = self.config();
        drivegate(&[&[what, "--config", config.to_str().unwrap()], rest].concat())
    }

    /// Gives a command, and repeats it until it is carried out: on a busy machine it may expire.
    fn written(&self, rest: &[&str]) -> Ran {
        until("a command", || {
            Some(self.command("write", rest)).filter(|ran| ran.code == 0)
        })
    }

    pub(crate) fn value(&self, point: &str) -> serde_json::Value {
        let ran = until(point, || {
            Some(self.command("read", &["--json", "pump-1", point])).filter(|ran| ran.code == 0)
        });
        let rows: serde_json::Value = serde_json::from_str(&ran.out).unwrap();
        assert_eq!(rows[0]["quality"], "good");
        rows[0]["value"].clone()
    }

    /// Trips pump-1 by the simulators' own register, as another master would.
    fn trip(&self) {
        let gateway = std::net::TcpStream::connect(("127.0.0.1", self.modbus)).is_ok();
        let tcp = ["-m", "tcp", "-p", &self.modbus.to_string()].map(ToString::to_string);
        let rtu = ["-m", "rtu", "-b", "38400", "-P", "none", "-o", "10"].map(ToString::to_string);
        let mut arguments = if gateway { tcp.to_vec() } else { rtu.to_vec() };
        let place = if gateway { "127.0.0.1".to_string() } else { self.port() };
        arguments.extend(["-a", "1", "-0", "-r", "1998", "-1", &place, "1"].map(ToString::to_string));
        let output = Command::new(tool("mbpoll")).args(&arguments).output().unwrap();
        assert!(
            output.status.success(),
            "{arguments:?}: {}",
            String::from_utf8_lossy(&output.stderr)
        );
    }

    /// Checks that `why` explains why the motor is at standstill although its run command is on.
    fn is_explained(&self) {
        let why = self.command("why", &["pump-1"]);
        assert_eq!(why.code, 0, "{}", why.err);
        assert!(why.out.starts_with("pump-1 does not run\n\n  "), "{}", why.out);
        let json = self.command("why", &["pump-1", "--json"]);
        let json: serde_json::Value = serde_json::from_str(&json.out).unwrap();
        assert_eq!(json["runs"], false);
        let cause = &json["causes"][0];
        assert!(
            why.out.contains(cause["cause"].as_str().unwrap()),
            "{cause}\n{}",
            why.out
        );
        assert!(!cause["remedy"].as_str().unwrap().is_empty());
        assert_eq!(json["not_told"], serde_json::json!(["interlock", "enable input"]));
    }

    /// Starts, reads, refusals and a stop give equal results whether the gateway or the command has the port.
    fn operate(&self) {
        let all = self.command("read", &["pump-1"]);
        assert_eq!(all.code, 0, "{}{}", all.out, all.err);
        for row in ["ready", "output_frequency", "maximum_frequency", "frequency_reference"] {
            assert!(all.out.contains(row), "{row} is missing in\n{}", all.out);
        }
        let started = self.written(&["pump-1", "run=YES", "speed_reference=50"]);
        assert_eq!(started.code, 0, "{}", started.err);
        assert!(started.out.contains("acknowledged"), "{}", started.out);
        until("a motor that runs", || (self.value("running") == true).then_some(()));
        assert_eq!(self.value("speed_reference"), 50.0);
        assert_eq!(self.value("frequency_reference"), 25.0);
        for (arguments, code, wanted) in [
            (&["pump-1", "speed_reference=81"][..], 1, "limits"),
            (&["pump-5", "run=true"], 1, "monitored"),
            (&["pump-1", "ready=true"], 1, "`ready`"),
            (&["pump-1", "speed_reference=fast"], 2, "a number"),
            (&["pump-1", "speed_referenc=1"], 2, "did you mean `speed_reference`?"),
            (&["pump-1", "run"], 2, "POINT=VALUE"),
            (
                &["pump-1", "run=maybe"],
                2,
                "write true or false, on or off, yes or no, 1 or 0",
            ),
            (&["pump-2", "run=true"], 2, "did you mean `pump-1`?"),
        ] {
            let ran = self.command("write", arguments);
            assert_eq!(ran.code, code, "{arguments:?}: {}", ran.err);
            assert!(ran.err.contains(wanted), "{arguments:?}: {}", ran.err);
        }
        // Contradictory values are refused in equal words, directly and through the gateway.
        for (values, twice) in [
            (&["run=false", "run=true"][..], "run"),
            (&["run=true", "run=true"], "run"),
            (&["speed_reference=10", "speed_reference=20"], "speed_reference"),
            (&["speed_reference=10", "frequency_reference=10"], "speed_reference"),
            (
                &["fieldbus_fault_response=0", "fieldbus_fault_response=1"],
                "fieldbus_fault_response",
            ),
        ] {
            let ran = self.command("write", &[&["pump-1"], values].concat());
            assert_eq!(ran.code, 1, "{values:?}: {}", ran.err);
            let wanted = format!(
                ": the command sets `{twice}` twice; set each point once, and only one reference (bad_value)\n"
            );
            assert!(ran.err.ends_with(&wanted), "{values:?}: {}", ran.err);
        }
        assert_eq!(self.value("running"), true);
        assert_eq!(self.value("speed_reference"), 50.0, "refused is not written");
        // A fault while the motor runs (by the simulators' own register), and its reset: the motor stays stopped.
        self.trip();
        until("the fault", || (self.value("fault") == true).then_some(()));
        let reset = self.written(&["pump-1", "fault_reset=true"]);
        assert_eq!(reset.code, 0, "{}", reset.err);
        until("no fault", || (self.value("fault") == false).then_some(()));
        assert_eq!(self.value("running"), false, "a reset starts nothing");
        self.is_explained();
        let stopped = self.written(&["pump-1", "run=Off"]);
        assert_eq!(stopped.code, 0, "{}", stopped.err);
        until("a motor that stands", || (self.value("running") == false).then_some(()));
    }
}

#[test]
fn directly_and_through_the_gateway() {
    let line = Line::start();
    line.operate();
    let gateway = line.gateway();
    until("all points", || {
        let read = |drive| line.command("read", &[drive, "run", "slot_fault_response"]).code == 0;
        (read("pump-1") && read("pump-5")).then_some(())
    });
    let stop = line.command("write", &["pump-1", "run=false"]);
    assert!(stop.out.ends_with(", through the gateway\n"), "{}", stop.out);
    line.operate();
    // If the gateway is not found, its port is locked, and the message says so.
    let text = std::fs::read_to_string(line.config()).unwrap();
    let elsewhere = line.directory.path().join("elsewhere.toml");
    for (socket, wanted) in [
        ("", "`socket` of [gateway] is off".to_string()),
        (
            "other.sock",
            format!("no gateway listens at {}/other.sock", line.directory.path().display()),
        ),
    ] {
        std::fs::write(&elsewhere, text.replace("own.sock", socket)).unwrap();
        let ran = drivegate(&["read", "--config", elsewhere.to_str().unwrap(), "pump-1"]);
        assert_eq!(ran.code, 1, "{}", ran.out);
        let taken = ran.err.contains("another program has it; ");
        assert!(taken && ran.err.contains(&wanted), "{}", ran.err);
    }
    // A scan fails at a taken port, too.
    let ran = drivegate(&["scan", "--port", &line.port(), "--addresses", "1"]);
    assert_eq!(ran.code, 1);
    let owner = "the gateway `plant` has the port for its bus `line1`; ";
    assert!(ran.err.contains(owner), "{}", ran.err);
    drop(gateway);
}

/// The reason of a refusal is exact and identical by every way, and nothing of a command is written if a part of it
/// is refused.
#[test]
fn a_refusal_has_the_same_words_whichever_way() {
    let line = Line::start();
    let mut gateway = None;
    for through in [false, true] {
        if through {
            gateway = Some(line.gateway());
            until("both drives", || {
                let read = |drive| line.command("read", &[drive, "run"]).code == 0;
                (read("pump-1") && read("pump-5")).then_some(())
            });
        }
        for (arguments, wanted) in [
            (
                &["pump-5", "run=true"][..],
                "pump-5 run=true: drive `pump-5` is only monitored; set access = \"control\" for it (not_allowed)",
            ),
            (
                &["pump-1", "speed_reference=81"],
                "pump-1 speed_reference=81 %: `speed_reference` = 81 % is outside the limits 0 to 80 %; nothing was \
                 written (bad_value)",
            ),
            (
                &["pump-1", "ready=true"],
                "pump-1 ready=true: `ready` is read-only (not_writable)",
            ),
        ] {
            let ran = line.command("write", arguments);
            let last = ran.err.lines().last().unwrap();
            assert_eq!((ran.code, last), (1, &*format!("error: {wanted}")), "{arguments:?}");
        }
        let before = line.value("speed_reference");
        let ran = line.command("write", &["pump-1", "speed_reference=20", "fieldbus_fault_response=4"]);
        assert_eq!(ran.code, 1, "{}", ran.out);
        assert!(ran.err.ends_with("(bad_value)\n"), "{}", ran.err);
        assert_eq!(line.value("speed_reference"), before);
    }
    drop(gateway);
}

/// A gateway that has the port and runs with another configuration gets no request, and is not bypassed.
#[test]
fn a_gateway_with_another_configuration_is_reported_and_not_commanded() {
    let line = Line::start();
    let folder = line.directory.path().join("profiles");
    std::fs::create_dir(&folder).unwrap();
    let profile = |name: &str, scale: &str| {
        let text = format!("name = \"{name}\"\nbase = \"vacon-nx\"\npoints.output_frequency.scale = {scale}\n");
        std::fs::write(folder.join(format!("{name}.toml")), text).unwrap();
    };
    profile("ours", "0.01");
    profile("others", "0.1");
    line.reconfigure(|text| {
        let text = text.replace("[gateway]\n", "[gateway]\nprofile_dirs = [\"profiles\"]\n");
        text.replacen("profile = \"vacon-nx\"", "profile = \"ours\"", 1)
    });
    let text = std::fs::read_to_string(line.config()).unwrap();
    let gateway = line.gateway();
    let sound = || {
        until("a command through the gateway", || {
            let ran = line.command("write", &["pump-1", "run=false"]);
            (ran.code == 0 && ran.out.contains("through the gateway")).then_some(())
        });
    };
    sound();
    let refused = |what: &str| {
        let wanted = format!(
            "error: {what}; {}; the gateway there runs with another configuration: reload it, or name its file with --config\n",
            line.socket().display()
        );
        for arguments in [&["read", "pump-1"][..], &["write", "pump-1", "run=true"]] {
            let ran = line.command(arguments[0], &arguments[1..]);
            assert_eq!((ran.code, ran.err.as_str()), (1, wanted.as_str()), "{arguments:?}");
        }
    };
    let edited = |from: &str, to: &str| std::fs::write(line.config(), text.replacen(from, to, 1)).unwrap();
    edited("\"plant\"", "\"works\"");
    refused("the gateway is `plant`, the file has `works`");
    edited("address = 1\n", "address = 9\n");
    refused("the gateway has `pump-1` with address `1`, the file with `9`");
    edited("\"ours\"", "\"others\"");
    refused("the gateway has `pump-1` with profile `ours`, the file with `others`");
    edited("name = \"pump-1\"", "name = \"pump-one\"");
    let ran = line.command("write", &["pump-one", "run=true"]);
    assert!(
        ran.err.starts_with("error: the gateway has no drive `pump-one`; "),
        "{}",
        ran.err
    );
    gateway.signal("HUP");
    until("the reload", || {
        (line.command("read", &["pump-one", "run"]).code == 0).then_some(())
    });
    std::fs::write(line.config(), &text).unwrap();
    gateway.signal("HUP");
    sound();
    // A profile of this name was edited since: the gateway answers with its own version, so nothing is misread.
    assert_eq!(
        line.command("write", &["pump-1", "run=true", "speed_reference=50"])
            .code,
        0
    );
    until("25 Hz", || (line.value("output_frequency") == 25.0).then_some(()));
    profile("ours", "0.1");
    assert_eq!(line.value("output_frequency"), 25.0);
}

/// Last values of an absent drive are stale and values never read are bad, with `read` as over HTTP.
#[test]
fn a_drive_that_is_away_has_the_quality_that_http_tells() {
    let folder = TempDir::new().unwrap();
    let line = line_of(&folder.path().join("line1"), &[1]);
    let http = free_port();
    let drives = [("pump-1", 1), ("pump-2", 2)].map(|(name, address)| {
        format!("[[bus.drive]]\nname = \"{name}\"\naddress = {address}\nprofile = \"vacon-nx\"\n")
    });
    let text = format!(
        "[gateway]\nname = \"plant\"\nsocket = \"own.sock\"\n[[bus]]\nname = \"line1\"\nport = \"line1\"\nbaud = 38400\n\
         response_timeout = \"1s\"\n{}[http]\nlisten = \"127.0.0.1:{http}\"\n",
        drives.concat()
    );
    let config = folder.path().join("drivegate.toml");
    std::fs::write(&config, text).unwrap();
    let config = config.display().to_string();
    let _gateway = Running::drivegate(&["run", "--config", &config]);
    until_ready(http);
    until("all that is known of pump-1", || {
        let known = |name| api(http, "pump-1")["points"][name]["quality"] == "good";
        (known("frequency_reference") && known("fieldbus_fault_response")).then_some(())
    });
    line.set_alive(1, false);
    for (drive, wanted) in [("pump-1", "stale"), ("pump-2", "bad")] {
        let reported = until("a drive that is away", || {
            let reported = api(http, drive);
            (reported["online"] == false).then_some(reported)
        });
        let ran = drivegate(&["read", "--json", "--config", &config, drive]);
        assert_eq!(ran.code, 1, "{}", ran.err);
        let rows: serde_json::Value = serde_json::from_str(&ran.out).unwrap();
        let rows = rows.as_array().unwrap();
        assert!(rows.len() > 20, "{rows:?}");
        let mut others = Vec::new();
        for row in rows {
            let point = row["point"].as_str().unwrap();
            let over_http = &reported["points"][point]["quality"];
            if row["quality"] != wanted || over_http != wanted || !row["value"].is_null() {
                others.push(format!("{drive}: {over_http} over HTTP: {row}"));
            }
        }
        assert!(others.is_empty(), "{others:#?}");
    }
    // A reason that all of its points share is reported once.
    let ran = drivegate(&["read", "--config", &config, "pump-2"]);
    let wanted = format!(
        "error: no point of `pump-2` has a value: the drive does not reply; check power, wiring and address; `drivegate \
         diagnose line1 --config {config}` shows what is wrong with the line\n"
    );
    assert_eq!((ran.code, ran.out.as_str(), ran.err), (1, "", wanted));
    // This point was never requested, so it has no old value.
    let ran = drivegate(&["read", "--json", "--config", &config, "pump-1", "fault_code_id99"]);
    assert!(ran.out.contains("\"bad\""), "{}{}", ran.out, ran.err);
}

#[test]
fn what_a_search_prints_passes_check() {
    let line = Line::start();
    let scan = [
        "scan",
        "--protocol",
        "modbus-rtu",
        "--baud",
        "38400",
        "--addresses",
        "1-6",
        "--port",
    ];
    // On a busy machine a drive may answer too late for a search.
    let ran = until("both drives", || {
        let ran = drivegate(&[&scan[..], &[&line.port()]].concat());
        let found = ran.err.contains("found modbus-rtu 38400 8N1, address 5: vacon-nx");
        (ran.code == 0 && found && ran.out.contains("drive-2")).then_some(ran)
    });
    assert!(ran.err.contains(" left, "), "no estimate in {}", ran.err);
    let found = line.directory.path().join("found.toml");
    std::fs::write(&found, &ran.out).unwrap();
    let checked = drivegate(&["check", "--json", "--config", found.to_str().unwrap()]);
    assert_eq!(checked.code, 0, "{}\n{}", ran.out, checked.out);
    let report: serde_json::Value = serde_json::from_str(&checked.out).unwrap();
    let requests = report["buses"][0]["requests"].as_array().unwrap();
    assert!(requests.iter().any(|r| r["drive"] == "drive-2"), "{}", checked.out);
    let nobody = drivegate(&[
        "scan",
        "--port",
        &line.port(),
        "--addresses",
        "2-3",
        "--protocol",
        "modbus-rtu",
        "--baud",
        "38400",
    ]);
    assert_eq!(nobody.code, 1);
    assert!(
        nobody.out.is_empty() && nobody.err.contains("no drive answered"),
        "{}",
        nobody.err
    );
    assert!(Path::new(&line.port()).exists());
}

/// A read that reaches a gateway at the moment of its end is still done.
#[test]
fn a_gateway_that_just_ends_is_asked_again() {
    let line = Line::start();
    let socket = line.socket();
    let listener = std::os::unix::net::UnixListener::bind(&socket).unwrap();
    let ends = std::thread::spawn(move || {
        let (client, _) = listener.accept().unwrap();
        until("its request", || {
            let waits = rustix::io::ioctl_fionread(&client).unwrap();
            (waits > 0).then_some(())
        });
        std::fs::remove_file(&socket).unwrap();
    });
    let read = line.command("read", &["pump-1", "ready"]);
    ends.join().unwrap();
    assert_eq!(read.code, 0, "{}{}", read.out, read.err);
}

/// Each family is found on the line of its simulator; the printed configuration passes `check`, and the drive can
/// be read with it.
#[test]
fn every_family_is_found_by_reading() {
    // SVX and HVX answer alike to every read.
    let families = [
        ("vacon-nx", "modbus-rtu", "38400", "8N1"),
        ("eaton-svx", "modbus-rtu", "38400", "8N1"),
        ("eaton-hvx", "modbus-rtu", "38400", "8N1"),
        ("vacon-cx", "modbus-rtu", "19200", "8N2"),
        ("teco-7300pa", "modbus-ascii", "19200", "7N2"),
        ("vacon-nx-n2", "n2", "9600", "8N1"),
        ("eaton-hvx-n2", "n2", "9600", "8N1"),
        ("teco-7300pa-n2", "n2", "9600", "8N1"),
    ];
    for (profile, protocol, baud, format) in families {
        let directory = TempDir::new().unwrap();
        let link = directory.path().join("line");
        let port = link.to_str().unwrap();
        let _drives = Running::drivegate(&["simulate", "--profile", profile, "--addresses", "2", "--link", port]);
        until("the line", || link.exists().then_some(()));
        let line = ["--protocol", protocol, "--baud", baud, "--format", format];
        // On a busy machine the drive may answer too late for a search.
        let ran = until(&format!("{profile} is found"), || {
            let ran = drivegate(&[&["scan", "--port", port, "--addresses", "1-3"], &line[..]].concat());
            (ran.code == 0 && ran.err.contains(profile)).then_some(ran)
        });
        assert!(
            ran.out.contains(&format!("protocol = \"{protocol}\"")),
            "{profile}: {}",
            ran.out
        );
        let found = directory.path().join("found.toml");
        std::fs::write(&found, &ran.out).unwrap();
        let config = found.to_str().unwrap();
        assert_eq!(
            drivegate(&["check", "--config", config]).code,
            0,
            "{profile}: {}",
            ran.out
        );
        until(&format!("values of {profile}"), || {
            let read = drivegate(&["read", "--config", config, "drive-1", "ready", "output_frequency"]);
            (read.code == 0).then_some(())
        });
    }
}

/// N2 has addresses that Modbus lacks; 255 is not a valid unit id, so the snippet gives such a drive another one.
#[test]
fn drives_at_the_last_addresses_of_n2_are_found() {
    let directory = TempDir::new().unwrap();
    let link = directory.path().join("line");
    let port = link.to_str().unwrap();
    let drives = ["--profile", "teco-7300pa-n2", "--addresses", "248,255"];
    let _drives = Running::drivegate(&[&["simulate", "--link", port][..], &drives].concat());
    until("the line", || link.exists().then_some(()));
    let ran = until("both drives", || {
        let ran = drivegate(&["scan", "--port", port, "--protocol", "n2", "--addresses", "247-255"]);
        let found = ran.out.contains("address = 248\n") && ran.out.contains("address = 255\nunit = 254\n");
        (ran.code == 0 && found).then_some(ran)
    });
    let found = directory.path().join("found.toml");
    std::fs::write(&found, &ran.out).unwrap();
    let config = found.to_str().unwrap();
    until("its values", || {
        let read = drivegate(&["read", "--config", config, "drive-2", "ready", "output_frequency"]);
        (read.code == 0).then_some(())
    });
}

/// Carries out the steps of docs/commissioning.md with a CX board that counts from 1.
#[test]
fn a_board_that_counts_from_one_shows_by_reading() {
    let directory = TempDir::new().unwrap();
    let link = directory.path().join("line1");
    let _drive = Running::drivegate(&[
        "simulate",
        "--profile",
        "vacon-cx",
        "--cx-address-offset",
        "holding=1,discrete-input=1",
        "--link",
        link.to_str().unwrap(),
    ]);
    until("the line", || link.exists().then_some(()));
    let profiles = directory.path().join("profiles");
    std::fs::create_dir(&profiles).unwrap();
    let shifted = "name = \"cx-from-one\"\nbase = \"vacon-cx\"\naddress_offset = { holding = 1, discrete-input = 1 }\n";
    std::fs::write(profiles.join("cx-from-one.toml"), shifted).unwrap();
    let config = directory.path().join("drivegate.toml");
    let read = |profile: &str| {
        let text = format!(
            "[gateway]\nname = \"plant\"\nprofile_dirs = [\"profiles\"]\n[[bus]]\nname = \"line1\"\nport = \"line1\"\n\
             baud = 19200\nformat = \"8N2\"\n[[bus.drive]]\nname = \"fan-1\"\naddress = 1\nprofile = \"{profile}\"\n[http]\n"
        );
        std::fs::write(&config, text).unwrap();
        let config = config.to_str().unwrap();
        let points = ["ready", "minimum_frequency", "maximum_frequency", "frequency_reference"];
        drivegate(&[&["read", "--config", config, "--json", "fan-1"][..], &points].concat())
    };
    let values = |ran: &Ran| -> Vec<serde_json::Value> {
        let rows: Vec<serde_json::Value> = serde_json::from_str(&ran.out).unwrap();
        rows.into_iter().map(|row| row["value"].clone()).collect()
    };
    let from_one = until("its values", || Some(read("cx-from-one")).filter(|ran| ran.code == 0));
    let truth = values(&from_one);
    assert_eq!(truth[0], true);
    assert_eq!(truth[2], 50.0);
    let from_zero = read("vacon-cx");
    assert_eq!(from_zero.code, 1, "{}{}", from_zero.out, from_zero.err);
    assert_ne!(values(&from_zero)[1..], truth[1..]);
}

#[test]
fn watch_shows_a_running_gateway_and_says_when_there_is_none() {
    let line = Line::start();
    let http = free_port();
    let text = std::fs::read_to_string(line.config()).unwrap();
    std::fs::write(line.config(), format!("{text}[http]\nlisten = \"127.0.0.1:{http}\"\n")).unwrap();
    let url = format!("http://127.0.0.1:{http}");
    let none = drivegate(&["watch", "--url", &url]);
    assert_eq!(none.code, 1);
    assert!(none.err.contains("cannot reach the gateway"), "{}", none.err);
    let _gateway = Running::drivegate(&["run", "--config", line.config().to_str().unwrap()]);
    until("both drives and their line", || {
        let ran = drivegate(&["watch", "--url", &url]);
        let drives = ran.out.matches(" ready ").count() == 2;
        let line = ran.out.contains("modbus-rtu 38400 8N1") && ran.out.contains("2 of 2");
        (ran.code == 0 && drives && line).then_some(())
    });
    // The commands also work at the socket of the configuration.
    for arguments in [
        &["watch", "--once"][..],
        &["diagnose"],
        &["trace", "--count", "1"],
        &["health"],
    ] {
        let ran = line.command(arguments[0], &arguments[1..]);
        assert_eq!(ran.code, 0, "{arguments:?}: {}", ran.err);
    }
}
