//! Messages of the program for input that is nearly right.

use std::io::{Read, Write};
use std::net::TcpListener;

use super::drive_access::{Ran, ran};
use crate::support::process::drivegate;
use crate::support::site::{LINE1, MQTT, Site, controlled};

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
    let through = crate::support::process::until("the state through the gateway", || {
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
