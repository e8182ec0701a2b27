use super::*;
use crate::config::Settings;

/// A bus with `count` drives of which every second is stopped.
fn bus(keys: &str, profile: &str, count: usize) -> BusSettings {
    let mut source = format!("[gateway]\nname = \"g\"\n[[bus]]\nname = \"b\"\nport = \"/dev/null\"\n{keys}\n");
    for drive in 1..=count {
        let stop = if drive % 2 == 1 { "stop" } else { "hold" };
        source += &format!(
            "[[bus.drive]]\nname = \"d{drive}\"\naddress = {drive}\nprofile = \"{profile}\"\naccess = \"control\"\n\
             turnaround = \"2ms\"\non_shutdown = \"{stop}\"\n"
        );
    }
    let loaded = Settings::parse("t.toml", &source, std::iter::empty());
    assert_eq!(loaded.errors, []);
    loaded.settings.unwrap().buses.remove(0)
}

fn near(time: Duration, milliseconds: f64) {
    let found = time.as_secs_f64() * 1e3;
    assert!(
        (found - milliseconds).abs() < 0.05,
        "{found} ms, {milliseconds} ms by hand"
    );
}

/// The longest transaction at 9600 8N1, 1.0417 ms a character: 8 + 3.5 + 255 + 3.5 characters for 125 registers.
const LONGEST: f64 = 270.0 * 1.0417 + 100.0;

/// Reading the word takes 8 + 3.5 + 7 + 3.5 characters, writing it 8 + 3.5 + 8 + 3.5.
#[test]
fn a_stop_by_hand() {
    let time = bus("retries = 2", "vacon-nx", 3).shutdown_time();
    assert_eq!(time.drives, 2);
    near(time.answered, 2.0 * (22.0 * 1.0417 + 2.0 + 23.0 * 1.0417 + 2.0));
    near(
        time.unanswered,
        LONGEST + 2.0 * (22.0 * 1.0417 + 100.0 + 3.0 * (23.0 * 1.0417 + 100.0)),
    );
}

/// The poll of a slow drive, which is not stopped, may be on the line when the gateway ends.
#[test]
fn the_transaction_on_the_line_is_that_of_the_slowest_drive() {
    let mut bus = bus("", "vacon-cx", 2);
    let stop = 2.0 * (23.0 * 1.0417 + 100.0);
    near(bus.shutdown_time().unanswered, LONGEST + stop);
    bus.drives[1].timing.response_timeout = Some(Duration::from_secs(2));
    near(bus.shutdown_time().unanswered, LONGEST + 1900.0 + stop);
    // 50 ms before the request, and beyond the silence of the line after the reply.
    bus.drives[1].timing.silence = Some(Duration::from_millis(50));
    near(
        bus.shutdown_time().unanswered,
        LONGEST + 1900.0 + 2.0 * (50.0 - 3.5 * 1.0417) + stop,
    );
}

/// A coil needs no read: 8 + 3.5 + 8 + 3.5 characters.
#[test]
fn a_coil_is_written_at_once() {
    let time = bus("", "vacon-cx", 1).shutdown_time();
    near(time.answered, 23.0 * 1.0417 + 2.0);
    near(time.unanswered, LONGEST + 2.0 * (23.0 * 1.0417 + 100.0));
}

#[test]
fn nothing_to_stop_takes_no_time() {
    let mut bus = bus("", "vacon-nx", 3);
    for drive in &mut bus.drives {
        drive.access = Access::Monitor;
    }
    assert_eq!(bus.shutdown_time(), ShutdownTime::default());
    assert_eq!(bus.shutdown_time().beyond_unit("b"), None);
}

#[test]
fn a_large_slow_line_takes_longer_than_the_unit_gives() {
    let sixty = bus("protocol = \"n2\"", "vacon-nx-n2", 120).shutdown_time();
    assert_eq!(sixty.drives, 60);
    assert_eq!(sixty.beyond_unit("b"), None, "{sixty:?}");
    let slow = bus("protocol = \"n2\"\nresponse_timeout = \"1s\"", "vacon-nx-n2", 120).shutdown_time();
    assert!(slow.beyond_unit("b").is_some(), "{slow:?}");
}

/// The figure that `check` compares with is that of the files that ship.
#[test]
fn the_shipped_files_give_that_time() {
    let read = |file: &str| std::fs::read_to_string(format!("{}/../../{file}", env!("CARGO_MANIFEST_DIR"))).unwrap();
    let seconds = UNIT_STOP_TIME.as_secs();
    assert!(read("systemd/drivegate.service").contains(&format!("\nTimeoutStopSec={seconds}s\n")));
    assert!(read("deploy/compose.yaml").contains(&format!("\n    stop_grace_period: {seconds}s\n")));
}
