//! The bus against simulated drives on a pseudo-terminal with true wire timing: frames, order, faults, the port.

mod common;

use std::time::{Duration, Instant};

use common::{Rig, drive};
use drivegate::bus::transaction::{Ended, Step, Transaction};
use drivegate::cache::{Access, LeaseAction, Supervision};
use drivegate::codec::{Exception, Protocol, Reply, Request, RequestPdu, Table, rtu};
use drivegate::command::Outcome;
use drivegate::drive::{ModelPoint, Quality, State, Value};
use drivegate::event::EventKind;
use drivegate::sim::drive::ModelOptions;
use drivegate::sim::faults::FaultPlan;
use drivegate::sim::nx::NxOptions;
use drivegate::sim::statistics::{Direction, Recorded};

fn hex(frames: &[Recorded], direction: Direction) -> Vec<String> {
    let text = |bytes: &[u8]| bytes.iter().map(|b| format!("{b:02X}")).collect::<Vec<_>>().join(" ");
    frames
        .iter()
        .filter(|f| f.direction == direction)
        .map(|f| text(&f.bytes))
        .collect()
}

/// A byte count with which no frame exists does not hold the line until the deadline: the exchange ends, to be tried
/// again, once no more of it comes; and the reply is still found behind it.
#[test]
fn a_reply_of_impossible_length_ends_the_exchange_before_its_deadline() {
    let pdu = RequestPdu::Read {
        table: Table::Holding,
        start: 2100,
        count: 1,
    };
    let request = Request::new(1, pdu);
    let mut frame = Vec::new();
    rtu::encode_request(&request, &mut frame);
    let (now, ms) = (Instant::now(), Duration::from_millis);
    let begin = || {
        Transaction::new(
            Protocol::ModbusRtu,
            request.clone(),
            frame.clone(),
            now,
            ms(100),
            ms(7),
            false,
        )
    };
    let mut transaction = begin();
    let Step::Wait(until) = transaction.on_bytes(now, &[1, 3, 0xFF]) else {
        panic!("the rest may still be on the line")
    };
    assert!(
        until <= now + ms(8),
        "the time of a reply and a pause: {:?}",
        until - now
    );
    let why = "the reply announces more than 256 characters";
    assert_eq!(transaction.on_time(until), Step::Done(Ended::Corrupt(why)));
    let mut transaction = begin();
    transaction.on_bytes(now, &[1, 3, 0xFF]);
    let mut reply = Vec::new();
    rtu::encode_frame(1, &[3, 2, 0, 9], &mut reply);
    let ended = Ended::Reply(Reply::Registers(vec![9]));
    assert_eq!(transaction.on_bytes(now + ms(3), &reply), Step::Done(ended));
}

#[tokio::test]
async fn the_frames_on_the_line_are_those_of_the_reference() {
    let rig = Rig::start(&[1], 38_400).await;
    rig.until("the drive answers", |r| r.state(1) == State::Ready).await;
    rig.line.record(10_000);
    assert!(rig.set(1, &[("speed_reference", 50.0)]).await.is_ok());
    assert!(rig.set(1, &[("run", 1.0)]).await.is_ok());
    rig.until("it runs at its reference", |r| {
        r.good(1, ModelPoint::AtReference) == Some(Value::Bool(true))
    })
    .await;
    assert_eq!(rig.good(1, ModelPoint::OutputFrequency), Some(Value::Number(25.0)));
    assert_eq!(rig.good(1, ModelPoint::ActualSpeed), Some(Value::Number(50.0)));
    assert!(rig.set(1, &[("run", 1.0), ("reverse", 1.0)]).await.is_ok());
    assert!(rig.set(1, &[("speed_reference", -50.0)]).await.is_ok());
    assert!(rig.set(1, &[("run", 0.0), ("reverse", 0.0)]).await.is_ok());
    rig.until("it stands", |r| r.state(1) == State::Ready).await;
    assert!(rig.set(1, &[("fault_reset", 1.0)]).await.is_ok());
    let frames = rig.line.transcript();
    let requests = hex(&frames, Direction::ToDrives);
    // drives.md 7.1 and 7.4, misprints corrected.
    for (meaning, frame) in [
        ("read 2101..2111", "01 03 08 34 00 0B 47 A3"),
        ("read 42001..42003", "01 03 07 D0 00 03 05 46"),
        ("reference 50 %", "01 06 07 D2 13 88 25 D1"),
        ("run", "01 06 07 D0 00 01 48 87"),
        ("run reverse", "01 06 07 D0 00 03 C9 46"),
        ("reference -50 %", "01 06 07 D2 EC 78 64 65"),
        ("stop", "01 06 07 D0 00 00 89 47"),
        ("fault reset", "01 06 07 D0 00 04 88 84"),
    ] {
        assert!(
            requests.iter().any(|r| r == frame),
            "{meaning}: {frame} was not on the line"
        );
    }
    let writes: Vec<&String> = requests.iter().filter(|r| r.starts_with("01 06 07 D0")).collect();
    assert_eq!(
        writes.last().map(|w| w.as_str()),
        Some("01 06 07 D0 00 00 89 47"),
        "the pulse ends"
    );
    let at = |frame: &str| {
        frames
            .iter()
            .rev()
            .find(|f| hex(std::slice::from_ref(f), Direction::ToDrives) == [frame])
    };
    let (high, low) = (
        at("01 06 07 D0 00 04 88 84").unwrap(),
        at("01 06 07 D0 00 00 89 47").unwrap(),
    );
    assert!(
        low.start - high.end >= Duration::from_millis(20),
        "held for two update periods"
    );
    let statistics = rig.line.statistics();
    assert_eq!(
        (statistics.silence_violations, statistics.collisions, statistics.bad_crc),
        (0, 0, 0)
    );
}

#[tokio::test]
async fn nothing_is_written_at_start() {
    let rig = Rig::start_recorded(&[1, 2], 38_400).await;
    rig.until("both drives answer", |r| {
        r.state(1) == State::Ready && r.state(2) == State::Ready
    })
    .await;
    rig.until("all classes were read", |r| {
        r.good(2, ModelPoint::FrequencyReference).is_some()
    })
    .await;
    let requests = hex(&rig.line.transcript(), Direction::ToDrives);
    assert!(requests.len() > 10);
    for request in requests {
        assert_eq!(&request[3..5], "03", "{request}");
    }
}

#[tokio::test]
async fn a_fault_is_told_and_reset() {
    // With a lease, so that nothing is told of a missing one.
    let rig = Rig::start_with(&[1], 115_200, |spec| {
        spec.supervision = Some(Supervision {
            timeout: Duration::from_secs(60),
            action: LeaseAction::Hold,
            adopt: false,
        });
    })
    .await;
    rig.until("the drive answers", |r| r.state(1) == State::Ready).await;
    let mut events = rig.events.subscribe();
    rig.line.with_drive(1, |drive, _| drive.trip(1));
    rig.until("the fault shows", |r| r.state(1) == State::Fault).await;
    assert_eq!(rig.good(1, ModelPoint::FaultCode), Some(Value::Integer(1)));
    let event = events.recv().await.unwrap();
    assert_eq!((event.kind, event.fault_code), (EventKind::Fault, Some(1)));
    assert!(event.text.contains("overcurrent"), "{}", event.text);
    assert!(rig.set(1, &[("fault_reset", 1.0)]).await.is_ok());
    rig.until("the fault is gone", |r| r.state(1) == State::Ready).await;
    assert_eq!(events.recv().await.unwrap().kind, EventKind::FaultEnd);
}

#[tokio::test]
async fn a_motor_that_was_stopped_elsewhere_is_not_started_by_a_command_that_does_not_name_run() {
    let rig = Rig::start(&[1], 38_400).await;
    rig.until("the drive answers", |r| r.state(1) == State::Ready).await;
    let word = |pdu: RequestPdu| match rig.line.with_drive(1, |drive, now| drive.answer(&pdu, now)) {
        Some(Some(Reply::Registers(words))) => words.first().copied(),
        _ => None,
    };
    let address = 2000;
    for (points, left) in [(("reverse", 1.0), 2), (("fault_reset", 1.0), 0), (("reverse", 1.0), 2)] {
        assert!(rig.set(1, &[("run", 1.0), ("reverse", 0.0)]).await.is_ok());
        rig.until("it runs", |r| r.state(1) == State::Running).await;
        // The gateway cannot have read it by the time of the command.
        word(RequestPdu::WriteRegister { address, value: 0 });
        rig.line.record(1_000);
        assert!(rig.set(1, &[points]).await.is_ok());
        let has = word(RequestPdu::Read {
            table: Table::Holding,
            start: address,
            count: 1,
        });
        assert_eq!(has, Some(left), "{points:?}");
        let written = hex(&rig.line.transcript(), Direction::ToDrives);
        let runs = |frame: &&String| frame.starts_with("01 06 07 D0 00 0") && "1357".contains(&frame[16..17]);
        assert_eq!(written.iter().find(runs), None, "{points:?}");
    }
}

#[tokio::test]
async fn a_dead_drive_is_stale_at_once_and_comes_back() {
    let rig = Rig::start(&[1, 2], 115_200).await;
    rig.until("both drives answer", |r| {
        r.state(1) == State::Ready && r.state(2) == State::Ready
    })
    .await;
    rig.line.set_alive(2, false);
    rig.until("it is offline", |r| r.state(2) == State::Offline).await;
    let sample = rig.sample(2, ModelPoint::OutputFrequency);
    assert_eq!(sample.quality, Quality::Stale);
    assert_eq!(rig.state(1), State::Ready);
    assert_eq!(rig.set(2, &[("run", 1.0)]).await, Outcome::Offline);
    rig.line.set_alive(2, true);
    rig.until("it is back", |r| r.state(2) == State::Ready).await;
}

#[tokio::test]
async fn the_port_vanishes_and_returns() {
    let rig = Rig::start(&[1], 115_200).await;
    rig.until("the drive answers", |r| r.state(1) == State::Ready).await;
    rig.line.vanish();
    rig.until("the bus is down", |r| !r.bus_up()).await;
    assert_eq!(rig.sample(1, ModelPoint::OutputFrequency).quality, Quality::Stale);
    assert_eq!(rig.set(1, &[("run", 1.0)]).await, Outcome::BusDown);
    rig.line.restore().unwrap();
    rig.until("it is back", |r| r.bus_up() && r.state(1) == State::Ready)
        .await;
}

#[tokio::test]
async fn a_stop_overtakes_and_purges() {
    let rig = Rig::start(&[1, 2, 3, 4], 9_600).await;
    rig.until("the drives answer", |r| (1..=4).all(|d| r.state(d) == State::Ready))
        .await;
    let references = (0..20).map(|i| {
        rig.set(
            1,
            if i % 2 == 0 {
                &[("speed_reference", 10.0)]
            } else {
                &[("run", 1.0)]
            },
        )
    });
    let all = futures_util::future::join_all(references);
    let stop = async {
        tokio::task::yield_now().await;
        rig.set(1, &[("run", 0.0)]).await
    };
    let (outcomes, stopped) = tokio::join!(all, stop);
    assert!(stopped.is_ok());
    let purged = outcomes
        .iter()
        .filter(|o| matches!(o, Outcome::Purged | Outcome::Replaced))
        .count();
    assert!(purged >= 17, "{outcomes:?}");
    tokio::time::sleep(Duration::from_millis(200)).await;
    assert_eq!(
        rig.good(1, ModelPoint::Running),
        Some(Value::Bool(false)),
        "nothing runs behind a stop"
    );
}

#[tokio::test]
async fn a_lease_that_runs_out_stops_the_drive_once() {
    let rig = Rig::start_with(&[1], 115_200, |spec| {
        spec.supervision = Some(drivegate::cache::Supervision {
            timeout: Duration::from_millis(300),
            action: drivegate::cache::LeaseAction::Stop,
            adopt: false,
        });
    })
    .await;
    rig.until("the drive answers", |r| r.state(1) == State::Ready).await;
    let mut events = rig.events.subscribe();
    assert!(rig.set(1, &[("speed_reference", 20.0), ("run", 1.0)]).await.is_ok());
    rig.until("it runs", |r| r.state(1) == State::Running).await;
    rig.until("it was stopped", |r| r.state(1) == State::Ready).await;
    let supervision = std::iter::from_fn(|| events.try_recv().ok())
        .filter(|e| e.kind == EventKind::Supervision)
        .count();
    assert_eq!(supervision, 1);
}

#[tokio::test]
async fn commands_are_checked_against_the_drive() {
    let rig = Rig::start(&[1], 115_200).await;
    rig.until("the drive answers", |r| {
        r.good(1, ModelPoint::FrequencyReference).is_some()
    })
    .await;
    assert!(matches!(
        rig.set(1, &[("speed_reference", 101.0)]).await,
        Outcome::Refused(_)
    ));
    assert!(rig.set(1, &[("frequency_reference", 30.0)]).await.is_ok());
    rig.until("it is read back", |r| {
        r.good(1, ModelPoint::SpeedReference) == Some(Value::Number(60.0))
    })
    .await;
    assert_eq!(rig.good(1, ModelPoint::FrequencyReference), Some(Value::Number(30.0)));
    let unknown = rig.read(drive(1), 6000, 5).await;
    assert_eq!(unknown, Outcome::Exception(drivegate::codec::Exception::ADDRESS));
}

#[tokio::test]
async fn a_garbled_answer_is_told_apart_from_silence() {
    let rig = Rig::start(&[1], 38_400).await;
    for (fault, outcome, code) in [
        ("corrupt=1", Outcome::Garbled, Exception::DEVICE_FAILURE),
        ("truncate=1", Outcome::Garbled, Exception::DEVICE_FAILURE),
        ("deaf=1", Outcome::TimedOut, Exception::GATEWAY_TARGET),
    ] {
        rig.until("the drive answers", |r| r.state(1) == State::Ready).await;
        rig.line.set_faults(FaultPlan::new(fault.parse().unwrap(), 1));
        let told = rig.set(1, &[("speed_reference", 20.0)]).await;
        assert_eq!((told.exception(), &told), (Some(code), &outcome), "{fault}");
        rig.line.set_faults(FaultPlan::default());
    }
}

/// Parameter P2.7.22 of the drive.
const FIELDBUS_FAULT_RESPONSE: u16 = 733;

#[tokio::test]
async fn a_drive_that_nothing_stops_is_told_each_time_it_comes() {
    for (access, lease, response, wanted) in [
        (Access::Control, false, 0, 1),
        (Access::Control, true, 0, 0),
        (Access::Control, false, 2, 0),
        (Access::Monitor, false, 0, 0),
    ] {
        let mut setup = common::Setup::new(&[1], 115_200);
        setup.drives[0].model = ModelOptions::Nx(NxOptions {
            parameters: vec![(FIELDBUS_FAULT_RESPONSE, response)],
            ..NxOptions::default()
        });
        let rig = Rig::of(setup, |spec| {
            spec.access = access;
            spec.supervision = lease.then_some(Supervision {
                timeout: Duration::from_secs(5),
                action: LeaseAction::Stop,
                adopt: false,
            });
        });
        let told = |rig: &Rig| {
            let events = rig.events.recent();
            let of_kind = events.iter().filter(|e| e.kind == EventKind::Unsupervised);
            of_kind.map(|e| e.text.clone()).collect::<Vec<_>>()
        };
        let known = |r: &Rig| {
            let handle = r.handle(1);
            let point = handle.image.spec.profile.point_index("fieldbus_fault_response");
            handle
                .reading(std::time::Instant::now())
                .sample(point.unwrap())
                .good()
                .is_some()
        };
        rig.until("the parameter is read", known).await;
        rig.until("it was told", |r| told(r).len() == wanted).await;
        // It goes and comes: told again, once.
        rig.line.set_alive(1, false);
        rig.until("it is away", |r| r.state(1) == State::Offline).await;
        rig.line.set_alive(1, true);
        rig.until("the parameter is read again", known).await;
        tokio::time::sleep(Duration::from_millis(100)).await;
        let texts = told(&rig);
        assert_eq!(texts.len(), 2 * wanted, "{texts:?}");
        for text in texts {
            assert!(
                text.contains("nothing stops drive drive-1") && text.contains("fieldbus_fault_response = 0"),
                "{text}"
            );
        }
    }
}
