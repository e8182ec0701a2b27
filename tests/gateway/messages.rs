//! Messages of the program for input that is nearly right.

use std::io::{Read, Write};
use std::net::TcpListener;

use super::drive_access::{Ran, ran};
use crate::support::process::{drivegate, until};
use crate::support::site::{LINE1, MODBUS_TCP, MQTT, Site, controlled};

fn command(arguments: &[&str]) -> Ran {
    ran(&mut drivegate(arguments))
}

#[test]
fn points_that_may_be_meant_are_named() {
    let site = Site::of(&[LINE1, &controlled("pump-1", 1, "")]);
    let config = site.config();
    for (arguments, wanted) in [
        (
            ["read", "pump-1", "speed"],
            "did you mean `zero_speed`, `motor_speed`, `actual_speed`, `motor_speed_id2`?",
        ),
        (["read", "pump-1", "motor_curent"], "did you mean `motor_current`?"),
        (["write", "pump-1", "speed_ref=5"], "did you mean `speed_reference`?"),
        (
            ["write", "pump-1", "state=5"],
            "profile `vacon-nx` has no point `state`",
        ),
    ] {
        let ended = command(&[&arguments[..], &["--config", &config]].concat());
        assert_eq!(ended.code, 2, "{arguments:?}: {}", ended.err);
        assert!(ended.err.contains(wanted), "{arguments:?}: {}", ended.err);
    }
}

#[test]
fn the_state_and_the_fault_text_are_read_like_points() {
    let site = Site::of(&[LINE1, &controlled("pump-1", 1, "")]);
    let _line = site.line(&[1]);
    let config = site.config();
    let words = ["read", "--config", &config, "pump-1", "state", "fault_text"];
    let directly = command(&words);
    assert_eq!(directly.code, 0, "{}", directly.err);
    let row = directly.out.lines().find(|line| line.starts_with(" state ")).unwrap();
    assert_eq!(row.split_whitespace().collect::<Vec<_>>(), ["state", "ready", "good"]);
    site.change("name = \"test\"", "name = \"test\"\nsocket = \"own.sock\"");
    let gateway = site.run();
    gateway.until_printed("drive pump-1 is online");
    let through = until("the state through the gateway", || {
        Some(command(&words)).filter(|ended| ended.code == 0)
    });
    assert_eq!(through.out, directly.out);
}

#[test]
fn a_file_is_checked_with_and_without_its_option() {
    let site = Site::of(&[LINE1, &controlled("pump-1", 1, "")]);
    let config = site.config();
    let by_option = command(&["check", "--config", &config]);
    let by_place = command(&["check", &config]);
    assert_eq!(
        (by_option.code, &by_option.out),
        (by_place.code, &by_place.out),
        "{}",
        by_place.err
    );
    assert_eq!(command(&["check", &config, "--config", &config]).code, 2);
}

/// A broker with MQTT 3.1.1 only answers in that version and closes; a newer one refuses in the format of version 5.
#[test]
fn a_broker_without_mqtt_5_is_named_as_such() {
    for (answer, wanted) in [
        (&[0x20, 2, 0, 1][..], "without accepting it: it does not support MQTT 5"),
        (&[0x20, 3, 0, 0x84, 0], "the broker refuses the protocol version"),
    ] {
        let site = Site::of(&[LINE1, &controlled("pump-1", 1, ""), MQTT]);
        let listener = TcpListener::bind(("127.0.0.1", site.mqtt)).unwrap();
        std::thread::spawn(move || {
            for mut stream in listener.incoming().map_while(Result::ok) {
                let mut connect = [0; 1024];
                let _ = stream.read(&mut connect);
                let _ = stream.write_all(answer);
            }
        });
        let gateway = site.run();
        let printed = gateway.until_printed(wanted);
        assert!(
            printed.contains("the gateway requires MQTT 5: use Mosquitto 1.6 or later"),
            "{printed}"
        );
    }
}

/// A server that is not a broker, or one behind TLS, answers in its own way; the remedy is the scheme of the address.
#[test]
fn another_server_at_the_port_leads_to_the_scheme() {
    let alert = &b"\x15\x03\x03\x00\x02\x02\x46"[..];
    let http = &b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n"[..];
    let scheme = "check the scheme in mqtt.url: mqtts:// for a port with TLS, usually 8883";
    for (url, answer, wanted) in [
        ("mqtt://", alert, "or expects TLS"),
        ("mqtt://", http, "there is no MQTT at this port"),
        ("mqtt://", b"", scheme),
        (
            "ws://",
            http,
            "404 Not Found: there is no MQTT over WebSocket at this port and path",
        ),
    ] {
        let site = Site::of(&[LINE1, &controlled("pump-1", 1, ""), MQTT]);
        site.change("mqtt://", url);
        let listener = TcpListener::bind(("127.0.0.1", site.mqtt)).unwrap();
        std::thread::spawn(move || {
            for mut stream in listener.incoming().map_while(Result::ok) {
                let mut first = [0; 1024];
                let _ = stream.read(&mut first);
                let _ = stream.write_all(answer);
            }
        });
        let gateway = site.run();
        gateway.until_printed(wanted);
        if url == "mqtt://" {
            gateway.until_printed(scheme);
        }
    }
}

/// A program that reads the port without a lock takes the replies.
#[test]
fn another_program_at_the_port_is_named() {
    let site = Site::new();
    let _line = site.line(&[9]);
    let port = site.path("line1");
    let reader = std::fs::File::open(site.file("line1")).unwrap();
    let mut reader = std::process::Command::new("sleep")
        .arg("600")
        .stdin(reader)
        .spawn()
        .unwrap();
    let reading = format!("/proc/{}/fd/0", reader.id());
    until("the reader", || {
        std::fs::read_link(&reading)
            .ok()
            .filter(|link| link.starts_with("/dev/pts"))
    });
    let scan = [
        "scan",
        "--port",
        &port,
        "--protocol",
        "modbus-rtu",
        "--baud",
        "38400",
        "--format",
        "8N1",
        "--addresses",
        "1",
    ];
    let ended = until("the name of the reader", || {
        let ended = command(&scan);
        ended.err.contains("sleep (pid ").then_some(ended)
    });
    reader.kill().unwrap();
    reader.wait().unwrap();
    assert_eq!(ended.code, 1, "{}", ended.err);
    let wanted = format!(
        "error: no drive answered, but sleep (pid {0}) has the port open, too, and takes replies from it; {port}; end that \
         program (kill {0}) and try again\n",
        reader.id()
    );
    assert!(ended.err.ends_with(&wanted), "{}", ended.err);
}

/// A port that a gateway has is not that of an unknown program, and `diagnose` names one that reads it, too.
#[test]
fn the_gateway_at_the_port_is_named() {
    let site = Site::of(&[LINE1, &controlled("pump-1", 1, "")]);
    // Not in a runtime directory: the process of the gateway shows the path.
    site.change("[gateway]\n", "[gateway]\nsocket = \"own.sock\"\n");
    let _line = site.line(&[1]);
    let gateway = site.run();
    gateway.until_printed("drivegate is running");
    let (port, config) = (site.path("line1"), site.config());
    let ended = command(&["scan", "--port", &port, "--addresses", "1"]);
    assert_eq!(ended.code, 1, "{}", ended.err);
    let wanted = format!(
        "error: the gateway `test` has the port for its bus `line1`; {port}; `drivegate diagnose line1 --config {config}` \
         shows what it reads there, or stop the gateway first"
    );
    assert!(ended.err.contains(&wanted), "{}", ended.err);

    let diagnose = ["diagnose", "line1", "--config", &config];
    let alone = command(&diagnose);
    assert_eq!(alone.code, 0, "{}", alone.err);
    assert!(!alone.out.contains("has the port of this bus open"), "{}", alone.out);
    // The exclusive mode of a port does not keep root out.
    let Ok(reader) = std::fs::File::open(site.file("line1")) else {
        return;
    };
    let mut reader = std::process::Command::new("sleep")
        .arg("600")
        .stdin(reader)
        .spawn()
        .unwrap();
    let shared = until("the reader in the diagnosis", || {
        let ended = command(&diagnose);
        ended.out.contains("sleep (pid ").then_some(ended)
    });
    reader.kill().unwrap();
    reader.wait().unwrap();
    let wanted = format!(
        "sleep (pid {}) has the port of this bus open, too, and takes replies from it",
        reader.id()
    );
    assert!(shared.out.contains(&wanted), "{}", shared.out);
}

/// What is wrong comes first, what is doubtful after it.
#[test]
fn warnings_come_after_errors() {
    let site = Site::of(&[
        LINE1,
        &controlled("pump-1", 1, "limits = { speed_reference = [0.0, 80,0] }"),
    ]);
    let config = site.config();
    for arguments in [["check", "--config", &config], ["run", "--config", &config]] {
        let ended = command(&arguments);
        assert_eq!(ended.code, 78, "{}", ended.err);
        let kinds: Vec<&str> = ended
            .err
            .lines()
            .filter_map(|line| line.split_once(':'))
            .map(|(kind, _)| kind)
            .collect();
        let first = kinds.iter().position(|kind| *kind == "warning").unwrap();
        assert!(kinds[..first].iter().all(|kind| *kind == "error"), "{}", ended.err);
        assert!(kinds[first..].iter().all(|kind| *kind == "warning"), "{}", ended.err);
        assert!(
            ended.err.contains("write the decimals with a point: [0.0, 80.0]"),
            "{}",
            ended.err
        );
    }
}

/// In an exclusive plant a drill needs the hold; the refusal has the command that takes it.
#[test]
fn a_drill_without_the_hold_says_how_to_take_it() {
    let supervised = "supervision = { timeout = \"2s\", action = \"stop\" }";
    let authority = "[authority]\nmode = \"exclusive\"\n[[authority.principal]]\nname = \"plc\"\nrank = \"automation\"\n\
        modbus_tcp = [\"127.0.0.1/32\"]\n[drill]\nmax_speed = 20.0\n";
    let site = Site::of(&[LINE1, &controlled("pump-1", 1, supervised), MODBUS_TCP, authority]);
    site.change(
        "name = \"test\"",
        &format!(
            "name = \"test\"\nstate_dir = \"{}\"\nsocket = \"own.sock\"",
            site.path("state")
        ),
    );
    let _line = site.line(&[1]);
    let gateway = site.run();
    gateway.until_printed("drive pump-1 is online");
    let config = site.config();
    let words = ["drill", "pump-1", "--order", "--config", &config];
    let drill = || ran(drivegate(&words).stdin(std::process::Stdio::null()));
    // The drive may be online before it is ready.
    let refused = until("the refusal", || {
        Some(drill()).filter(|ended| ended.err.contains("nobody holds"))
    });
    assert_eq!(refused.code, 1, "{}", refused.err);
    assert!(
        refused
            .err
            .contains("nobody holds the drive; take it first: drivegate hold pump-1 take"),
        "{}",
        refused.err
    );
    let taken = command(&["hold", "pump-1", "take", "--config", &config]);
    assert_eq!(taken.code, 0, "{}", taken.err);
    // The motor is not started: nobody types its name.
    let asked = drill();
    assert!(!asked.err.contains("nobody holds"), "{}", asked.err);
}
