//! The bus against simulated drives with N2 boards, on a pseudo-terminal with true wire timing.
#![allow(
    clippy::unwrap_used,
    clippy::indexing_slicing,
    clippy::panic,
    reason = "a test may panic"
)]

mod common;

use std::time::Duration;

use common::{Rig, Setup, drive};
use drivegate::codec::{Exception, Protocol, Reply, RequestPdu, Table};
use drivegate::command::Outcome;
use drivegate::drive::profile::Profiles;
use drivegate::drive::{ModelPoint, Quality, State, Value};
use drivegate::event::EventKind;
use drivegate::sim::statistics::Direction;

fn setup(profile: &str, addresses: &[u8]) -> Setup {
    Setup {
        protocol: Protocol::N2,
        profile: Profiles::built_in().get(profile).unwrap().clone(),
        transcript: 100_000,
        ..Setup::new(addresses, 9600)
    }
}

/// Frames of the master as text.
fn requests(rig: &Rig) -> Vec<String> {
    let frames = rig.line.transcript();
    let own = frames.iter().filter(|frame| frame.direction == Direction::ToDrives);
    own.map(|frame| String::from_utf8_lossy(&frame.bytes).trim_end().to_string())
        .collect()
}

fn count(rig: &Rig, prefix: &str) -> usize {
    requests(rig).iter().filter(|frame| frame.starts_with(prefix)).count()
}

async fn is_good(rig: &Rig, point: ModelPoint, value: Value) {
    rig.until(&format!("{} = {value}", point.name()), |r| {
        r.good(1, point) == Some(value)
    })
    .await;
}

#[tokio::test]
async fn a_drive_is_identified_drained_read_and_commanded() {
    let rig = Rig::of(setup("vacon-nx-n2", &[1]), |_| {});
    rig.until("the drive answers", |r| r.state(1) == State::Ready).await;
    let begin = requests(&rig);
    assert_eq!(begin[0], ">01FA7");
    assert_eq!(begin[1], ">0104C5");
    assert_eq!(begin[2], ">0105C6");
    assert!(begin.iter().position(|frame| frame.starts_with(">011")).unwrap() < 16);
    assert!(rig.set(1, &[("run", 0.0)]).await.is_ok());
    assert!(rig.set(1, &[("speed_reference", 50.0), ("run", 1.0)]).await.is_ok());
    is_good(&rig, ModelPoint::Running, Value::Bool(true)).await;
    is_good(&rig, ModelPoint::OutputFrequency, Value::Number(25.0)).await;
    assert!(rig.set(1, &[("reverse", 1.0)]).await.is_ok());
    is_good(&rig, ModelPoint::Reversed, Value::Bool(true)).await;
    rig.line.with_drive(1, |drive, _| drive.trip(1));
    is_good(&rig, ModelPoint::FaultCode, Value::Integer(1)).await;
    assert_eq!(rig.state(1), State::Fault);
    assert!(rig.set(1, &[("fault_reset", 1.0)]).await.is_ok());
    is_good(&rig, ModelPoint::Fault, Value::Bool(false)).await;
    assert!(rig.set(1, &[("run", 0.0)]).await.is_ok());
    is_good(&rig, ModelPoint::Running, Value::Bool(false)).await;
    let frames = requests(&rig);
    for frame in [">017203014248000020", ">017303018F", ">0172040101F0", ">0172040100EF"] {
        assert!(frames.iter().any(|f| f == frame), "{frame}");
    }
    let statistics = rig.line.statistics();
    assert_eq!(
        (statistics.collisions, statistics.bad_crc, statistics.unanswered),
        (0, 0, 0)
    );
}

/// The speed reference of a simulated drive itself, in hundredths of a percent.
fn reference(rig: &Rig, address: u8) -> u16 {
    let (table, start, count) = (Table::Holding, 2002, 1);
    let read = RequestPdu::Read { table, start, count };
    match rig.line.with_drive(address, |drive, now| drive.answer(&read, now)) {
        Some(Some(Reply::Registers(words))) => words[0],
        other => unreachable!("{other:?}"),
    }
}

#[tokio::test]
async fn what_the_drive_has_already_is_not_written_again() {
    let rig = Rig::of(setup("vacon-nx-n2", &[1]), |_| {});
    rig.until("the drive answers", |r| r.state(1) == State::Ready).await;
    for _ in 0..3 {
        assert!(rig.set(1, &[("speed_reference", 40.0)]).await.is_ok());
        assert!(rig.set(1, &[("run", 1.0)]).await.is_ok());
    }
    assert_eq!(count(&rig, ">01720301"), 1, "override of AO 1");
    assert_eq!(count(&rig, ">0172040101"), 1, "override of BO 1");
    for _ in 0..2 {
        assert!(rig.set(1, &[("run", 0.0)]).await.is_ok());
    }
    assert_eq!(count(&rig, ">0172040100"), 2, "a stop is never left out");
    // A parameter that is read once: changed at the panel meanwhile, it is read before it is written.
    let name = "acceleration_time";
    assert!(rig.set(1, &[(name, 7.0)]).await.is_ok());
    assert!(rig.set(1, &[(name, 7.0)]).await.is_ok());
    assert_eq!(count(&rig, ">01720305"), 1);
    let panel = drivegate::codec::RequestPdu::WriteRegister {
        address: 102,
        value: 90,
    };
    rig.line.with_drive(1, |drive, now| drive.answer(&panel, now));
    assert!(rig.set(1, &[(name, 7.0)]).await.is_ok());
    assert_eq!(count(&rig, ">01720305"), 2);
}

#[tokio::test]
async fn what_was_changed_at_the_drive_is_written_again() {
    let rig = Rig::of(setup("vacon-nx-n2", &[1]), |_| {});
    rig.until("the drive answers", |r| r.state(1) == State::Ready).await;
    let at_the_drive = |address, value| {
        let panel = RequestPdu::WriteRegister { address, value };
        rig.line.with_drive(1, |drive, now| drive.answer(&panel, now));
    };
    assert!(rig.set(1, &[("speed_reference", 25.0)]).await.is_ok());
    assert!(rig.set(1, &[("run", 1.0)]).await.is_ok());
    for turn in 1..=3 {
        is_good(&rig, ModelPoint::SpeedReference, Value::Number(25.0)).await;
        is_good(&rig, ModelPoint::Running, Value::Bool(true)).await;
        // The gateway cannot have read it by the time of the command.
        at_the_drive(2002, 7700);
        assert!(rig.set(1, &[("speed_reference", 25.0)]).await.is_ok());
        assert_eq!(reference(&rig, 1), 2500, "turn {turn}");
        at_the_drive(2000, 0);
        assert!(rig.set(1, &[("run", 1.0)]).await.is_ok());
        assert_eq!(count(&rig, ">0172040101"), 1 + turn, "override of BO 1");
    }
}

#[tokio::test]
async fn a_drive_that_starts_anew_in_mid_run() {
    let rig = Rig::of(setup("vacon-nx-n2", &[1]), |_| {});
    rig.until("the drive answers", |r| r.state(1) == State::Ready).await;
    assert!(rig.set(1, &[("speed_reference", 50.0), ("run", 1.0)]).await.is_ok());
    is_good(&rig, ModelPoint::Running, Value::Bool(true)).await;
    let mut events = rig.events.subscribe();
    rig.line.with_board(1, |board, now| board.restart(now));
    rig.until("it is identified again", |r| count(r, ">01F") >= 2).await;
    let event = tokio::time::timeout(Duration::from_secs(5), events.recv())
        .await
        .unwrap()
        .unwrap();
    assert_eq!(event.kind, EventKind::Restarted);
    let before = count(&rig, ">01110203");
    rig.until("values are read again", |r| count(r, ">01110203") > before + 2)
        .await;
    is_good(&rig, ModelPoint::OutputFrequency, Value::Number(25.0)).await;
    assert!(rig.set(1, &[("run", 0.0)]).await.is_ok());
    assert!(rig.handle(1).image.snapshot().link.is_online());
    // Its supply fails for less time than it takes to be missed.
    let identified = count(&rig, ">01F");
    rig.line.with_drive(1, |drive, now| {
        drive.power_off();
        drive.power_on(now);
    });
    rig.until("it waits for Identify once more", |r| count(r, ">01F") > identified)
        .await;
    let event = tokio::time::timeout(Duration::from_secs(5), events.recv())
        .await
        .unwrap()
        .unwrap();
    assert_eq!(event.kind, EventKind::Restarted);
}

#[tokio::test]
async fn a_profile_of_what_is_read_once_and_a_device_of_another_type() {
    let text = r#"
name = "names-only"
title = "What is read once"
protocols = ["n2"]
[n2]
poll = "1s"
device_type = 0x12
[[range]]
table = "input"
first = 2
last = 3
read = 2
[[point]]
name = "output_frequency"
at = "input 2"
type = "f32"
class = "once"
"#;
    let profile = drivegate::drive::Profile::parse("once.toml", text, false).unwrap();
    let setup = Setup {
        profile: std::sync::Arc::new(profile),
        ..setup("vacon-nx-n2", &[1])
    };
    let rig = Rig::of(setup, |_| {});
    is_good(&rig, ModelPoint::OutputFrequency, Value::Number(0.0)).await;
    let unlike = |event: &drivegate::event::Event| event.kind == EventKind::UnlikeProfile;
    let told: Vec<_> = rig.events.recent().into_iter().filter(|event| unlike(event)).collect();
    assert_eq!(told.len(), 1);
    assert!(told[0].text.contains("type 10h") && told[0].text.contains("expects 12h"));
    let before = count(&rig, ">0104");
    rig.until("it is polled though nothing is read", |r| {
        count(r, ">0104") > before + 2
    })
    .await;
    rig.line.set_alive(1, false);
    rig.until("and missed", |r| !r.handle(1).image.snapshot().link.is_online())
        .await;
}

#[tokio::test]
async fn both_forms_of_replies_and_what_is_no_number() {
    let rig = Rig::of(setup("vacon-nx-n2", &[1]), |_| {});
    rig.line.with_board(1, |board, _| board.options.leading_byte = true);
    rig.until("the drive answers", |r| r.state(1) == State::Ready).await;
    is_good(&rig, ModelPoint::OutputFrequency, Value::Number(0.0)).await;
    let current = |r: &Rig| r.sample(1, ModelPoint::MotorCurrent).quality;
    rig.until("the current is good", |r| current(r) == Quality::Good).await;
    for no_number in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        // The bus overrides the AI with what is no number.
        let command = drivegate::codec::n2::Command::Override {
            object: drivegate::codec::n2::Object {
                region: drivegate::codec::n2::Region::Ai,
                number: 6,
            },
            data: no_number.to_be_bytes().to_vec(),
        };
        rig.line.with_board(1, |board, now| {
            board.answer(&Ok(command), now, &mut |_| None, &mut Vec::new());
        });
        rig.until("no number is bad", |r| {
            current(r) == Quality::Bad && r.sample(1, ModelPoint::MotorCurrent).value.is_none()
        })
        .await;
    }
}

#[tokio::test]
async fn a_dead_drive_is_probed_by_identify_and_comes_back() {
    let rig = Rig::of(setup("vacon-nx-n2", &[1, 2]), |_| {});
    rig.until("both answer", |r| {
        r.state(1) == State::Ready && r.state(2) == State::Ready
    })
    .await;
    rig.line.set_alive(2, false);
    rig.until("one is offline", |r| {
        r.state(2) == State::Offline && !r.handle(2).image.snapshot().link.is_online()
    })
    .await;
    rig.line.record(10_000);
    rig.until("it is probed", |r| count(r, ">02F") >= 1).await;
    assert_eq!(
        requests(&rig)
            .iter()
            .filter(|f| f.starts_with(">02") && !f.starts_with(">02F"))
            .count(),
        0
    );
    rig.until("the other one is read on", |r| r.state(1) == State::Ready)
        .await;
    rig.line.set_alive(2, true);
    rig.until("it is back", |r| r.state(2) == State::Ready).await;
}

#[tokio::test]
async fn what_means_no_object_and_what_the_drive_refuses() {
    let rig = Rig::of(setup("vacon-nx-n2", &[1]), |_| {});
    rig.until("the drive answers", |r| r.state(1) == State::Ready).await;
    assert_eq!(rig.read(drive(1), 1, 2).await, Outcome::Exception(Exception::ADDRESS));
    assert_eq!(rig.read(drive(1), 0, 4).await, Outcome::Exception(Exception::ADDRESS));
    assert_eq!(rig.read(drive(1), 98, 2).await, Outcome::Exception(Exception::n2(0x10)));
    assert!(rig.read(drive(1), 0, 2).await.is_ok());
}

/// The objects that the independent slave has.
const PEER: &str = r#"
name = "peer"
title = "An N2 slave in another language"
protocols = ["n2"]
[[range]]
table = "input"
first = 0
last = 3
read = 2
[[range]]
table = "discrete-input"
first = 0
last = 1
read = 1
[[range]]
table = "holding"
first = 0
last = 1
read = 2
write = 2
[[point]]
name = "output_frequency"
at = "input 2"
type = "f32"
class = "fast"
[[point]]
name = "running"
at = "discrete-input 1"
class = "fast"
[[point]]
name = "speed_reference"
at = "holding 0"
type = "f32"
range = [0.0, 100.0]
class = "fast"
write = true
"#;

/// A slave in Python, ended with the test.
struct Peer(std::process::Child);

impl Drop for Peer {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The slave, its port, and the frames that it hears.
fn peer(form: &str) -> (Peer, String, std::sync::Arc<std::sync::Mutex<Vec<String>>>) {
    use std::io::{BufRead, BufReader};
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/peers/n2_slave.py");
    let mut child = std::process::Command::new("python3")
        .args([script, form])
        .stdout(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    let port = format!("tcp://127.0.0.1:{}", lines.next().unwrap().unwrap());
    let heard = std::sync::Arc::new(std::sync::Mutex::new(Vec::new()));
    let all = heard.clone();
    std::thread::spawn(move || {
        lines
            .map_while(Result::ok)
            .for_each(|line| all.lock().unwrap().push(line))
    });
    (Peer(child), port, heard)
}

#[tokio::test]
async fn a_slave_that_was_written_elsewhere() {
    for form in ["plain", "byte"] {
        let (_peer, port, heard) = peer(form);
        let profile = drivegate::drive::Profile::parse("peer.toml", PEER, false).unwrap();
        let setup = Setup {
            profile: std::sync::Arc::new(profile),
            port: Some(port),
            ..setup("vacon-nx-n2", &[1])
        };
        let rig = Rig::of(setup, |_| {});
        is_good(&rig, ModelPoint::OutputFrequency, Value::Number(25.0)).await;
        is_good(&rig, ModelPoint::Running, Value::Bool(true)).await;
        assert!(rig.set(1, &[("speed_reference", 50.0)]).await.is_ok());
        assert!(rig.set(1, &[("speed_reference", 50.0)]).await.is_ok());
        is_good(&rig, ModelPoint::SpeedReference, Value::Number(50.0)).await;
        let heard = heard.lock().unwrap().clone();
        assert_eq!(heard[..3], ["01FA7", "0104C5", "0105C6"].map(String::from)[..]);
        for read in ["0111020388", "0112020288"] {
            assert!(heard.iter().any(|frame| frame == read), "{read}");
        }
        let count = |frame: &str| heard.iter().filter(|line| *line == frame).count();
        assert_eq!((count("017203014248000020"), count("017303018F")), (1, 1));
    }
}
