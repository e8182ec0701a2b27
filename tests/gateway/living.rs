//! A gateway in service: the watchdog while a line is silent, reloads that are requested and refused, health, backups.

use std::fs;

use super::drive_access::{Ran, ran};
use crate::support::process::{Notifications, PATIENCE, Running, drivegate, get, until};
use crate::support::site::{HTTP, LINE1, Site, controlled};

fn site() -> Site {
    let site = Site::of(&[LINE1, &controlled("pump-1", 1, ""), HTTP]);
    site.change(
        "name = \"test\"",
        "name = \"test\"\nsocket = \"own.sock\"\nstate_dir = \"state\"",
    );
    site
}

fn command(site: &Site, arguments: &[&str]) -> Ran {
    ran(drivegate(arguments).args(["--config", &site.config()]))
}

#[test]
fn an_absent_drive_with_a_long_timeout_holds_up_neither_the_watchdog_nor_a_reload_nor_a_stop() {
    let site = site();
    site.change("response_timeout = \"2s\"", "response_timeout = \"20s\"");
    let line = site.line(&[]);
    let notified = Notifications::at(site.file("notify"));
    let mut command = drivegate(&["run", "--config", &site.config()]);
    let mut gateway = Running::spawn(notified.of(&mut command));
    gateway.until_printed("20s is longer than any drive takes to start its reply; 5s is used");
    notified.until("STATUS=1 of 1 buses up, 0 of 1 drives online");
    // The watchdog is looked at twice a second, an exchange takes 5 s.
    until("two requests", || (line.transcript().len() > 1).then_some(()));
    notified.until("WATCHDOG=1");
    // A pause of the machine may look like a stall once; an exchange that held up the watchdog would do so nine times.
    let printed = gateway.output();
    assert!(printed.matches("stalled").count() < 3, "{printed}");
    // The exchange that waits is broken off for a reload of its bus, and for a stop.
    site.change("silence = \"chars\"", "silence = \"spec\"");
    gateway.signal("HUP");
    notified.until("RELOADING=1");
    notified.until("READY=1\nSTATUS=");
    notified.until("WATCHDOG=1");
    let sound = site.change("baud = 38400", "baud = 1");
    gateway.signal("HUP");
    notified.until("0 of 1 drives online; reload refused at ");
    site.configure(&[&sound]);
    gateway.signal("HUP");
    notified.until("READY=1\nSTATUS=1 of 1 buses up, 0 of 1 drives online");
    notified.until("WATCHDOG=1");
    gateway.signal("TERM");
    assert!(gateway.ended().success());
}

#[test]
fn a_reload_is_asked_for_and_a_refused_one_is_seen() {
    let site = site();
    let _line = site.line(&[1]);
    let not_running = command(&site, &["reload"]);
    assert_eq!(not_running.code, 1, "{}", not_running.err);
    assert!(
        not_running.err.contains("no running gateway was found"),
        "{}",
        not_running.err
    );
    let _gateway = site.run_ready();
    site.until_metric("drivegate_config_last_reload_successful 1");
    let same = command(&site, &["reload"]);
    assert_eq!(
        (same.code, same.out.as_str()),
        (0, "reloaded, nothing changed\n"),
        "{}",
        same.err
    );

    let before = site.change("baud = 38400", "baud = 1");
    let refused = command(&site, &["reload"]);
    assert_eq!(refused.code, 78, "{}", refused.err);
    assert!(
        refused.err.contains("bus[0].baud") && refused.out.is_empty(),
        "{}",
        refused.err
    );
    site.until_metric("drivegate_config_last_reload_successful 0");
    let seen = drivegate_events(&site);
    assert!(
        seen.contains("\"event\":\"reload_refused\"") && seen.contains("bus[0].baud"),
        "{seen}"
    );

    site.configure(&[&before]);
    site.change("silence = \"chars\"", "silence = \"spec\"");
    let changed = command(&site, &["reload"]);
    let expected = "changed: bus `line1`, restarted\n";
    assert_eq!((changed.code, changed.out.as_str()), (0, expected), "{}", changed.err);
    site.until_metric("drivegate_config_last_reload_successful 1");
    // Another configuration file belongs to another gateway.
    site.write("other.conf", &fs::read_to_string(site.config()).unwrap());
    let other = ran(&mut drivegate(&["reload", "--config", &site.path("other.conf")]));
    assert!(
        other.code == 1 && other.err.contains("the gateway runs with"),
        "{}",
        other.err
    );
}

/// The first events of the stream.
fn drivegate_events(site: &Site) -> String {
    use std::io::{BufRead, BufReader, Write};
    let mut stream = std::net::TcpStream::connect(("127.0.0.1", site.http)).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    write!(stream, "GET /api/v1/events HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
    let mut text = String::new();
    for line in BufReader::new(stream).lines().map_while(Result::ok) {
        text += &line;
        if line.contains("reload_refused") {
            break;
        }
    }
    text
}

#[test]
fn health_is_an_exit_code() {
    let site = site();
    let gateway = site.run();
    gateway.until_printed("drivegate is running");
    let unready = command(&site, &["health"]);
    assert_eq!(unready.code, 1);
    assert!(unready.err.contains("bus line1"), "{}", unready.err);
    let url = format!("http://127.0.0.1:{}", site.http);
    let over_http = || ran(&mut drivegate(&["health", "--url", &url]));
    assert_eq!(over_http().code, 1);
    let _line = site.line(&[1]);
    until("readiness", || (command(&site, &["health"]).code == 0).then_some(()));
    let ready = over_http();
    assert_eq!((ready.code, ready.out.as_str()), (0, "ready\n"), "{}", ready.err);
    // Without the local socket, the command finds the HTTP address in the file.
    site.change("own.sock", "");
    gateway.signal("HUP");
    gateway.until_printed("configuration reloaded");
    assert_eq!(command(&site, &["health"]).code, 0);
    drop(gateway);
    assert_eq!(command(&site, &["health"]).code, 1);
    assert!(get(site.http, "/readyz").is_none());
}

#[test]
fn a_gateway_is_set_up_again_from_its_backup() {
    let site = site();
    let text = fs::read_to_string(site.config()).unwrap() + "[audit]\n";
    site.write("drivegate.conf", &text);
    site.write("own.toml", "name = \"own\"\nbase = \"vacon-nx\"\ntitle = \"Own\"\n");
    fs::create_dir_all(site.file("state/recordings")).unwrap();
    site.write("state/audit.jsonl", "{}\n");
    site.write("state/mqtt.lock", "");
    fs::create_dir_all(site.file("state/params/pump-1")).unwrap();
    let journal = "state/params/pump-1/restore.journal";
    site.write(journal, "# drivegate restore 1\n");
    let file = site.path("backup.tar");
    site.write("backup.tar.partial", "left behind by a backup that was killed");
    let made = command(&site, &["backup", &file]);
    assert_eq!(made.code, 0, "{}", made.err);
    assert!(made.out.contains("4 files"), "{}", made.out);
    let again = command(&site, &["backup", &file]);
    assert!(again.code == 1 && again.err.contains("exists already"), "{}", again.err);

    let place = tempfile::tempdir().unwrap();
    let config = place.path().join("etc/drivegate.conf");
    let restore = |state: &str, more: &[&str]| {
        let config = config.to_str().unwrap();
        let state = place.path().join("etc").join(state);
        let mut command = drivegate(&[
            "restore",
            &file,
            "--config",
            config,
            "--state-dir",
            state.to_str().unwrap(),
        ]);
        ran(command.args(more))
    };
    let elsewhere = restore("other", &[]);
    assert!(
        elsewhere.code == 1 && elsewhere.err.contains("--state-dir"),
        "{}",
        elsewhere.err
    );
    assert!(!config.exists());
    let restored = restore("state", &[]);
    // A relative state directory is below the configuration, wherever that is.
    assert_eq!(restored.code, 0, "{}", restored.err);
    assert_eq!(fs::read_to_string(&config).unwrap(), text);
    assert_eq!(
        fs::read_to_string(place.path().join("etc/state/audit.jsonl")).unwrap(),
        "{}\n"
    );
    let kept = fs::read_to_string(place.path().join("etc").join(journal)).unwrap();
    assert_eq!(
        kept, "# drivegate restore 1\n",
        "what a restore of parameters left undone"
    );
    assert!(place.path().join("etc/own.toml").exists());
    let refused = restore("state", &[]);
    assert!(refused.code == 1 && refused.err.contains("--force"), "{}", refused.err);
    assert_eq!(restore("state", &["--force"]).code, 0);
    // The restore leaves no other files behind.
    let names = fs::read_dir(place.path().join("etc")).unwrap();
    let mut names: Vec<_> = names.map(|file| file.unwrap().file_name()).collect();
    names.sort();
    assert_eq!(names, ["drivegate.conf", "own.toml", "state"]);
}
