//! The view of a reader on another thread while the image changes.

use drivegate_testkit::{bus_spec, monitored, nx};

use super::*;
use crate::confirm::Unconfirmed;
use drivegate_core::process_image::{DriveSpec, LeaseAction};
use drivegate_model::drive::DriveIndex;

fn bus(drives: u8) -> BusHandle {
    let profile = nx();
    let drive = |address| drivegate_testkit::image(monitored(&format!("d{address}"), "b", address, &profile));
    drivegate_testkit::bus(bus_spec("b"), (1..=drives).map(drive).collect())
}

fn options() -> BusOptions {
    BusOptions {
        response_timeout: Duration::from_millis(100),
        retries: 1,
        silence: Default::default(),
        line: Default::default(),
        mode: Default::default(),
        allow: Vec::new(),
    }
}

/// A reader that sees the bus down must find no good values of its drives; a good value would show a motor running
/// on a bus that is down.
#[test]
fn whoever_sees_the_bus_down_sees_every_drive_offline() {
    let bus = bus(200);
    let image = bus.image.clone();
    let now = Instant::now();
    let mut report = Report::new(&bus, &options(), Events::default(), now);
    for _ in 0..20 {
        report.bus_up(now);
        for index in image.drives.indexes() {
            report.apply(&News::Online(index), now);
        }
        let looking = image.clone();
        let reader = std::thread::spawn(move || {
            while looking.health().up {
                std::hint::spin_loop();
            }
            let offline = |drive: &&Arc<DriveImage>| matches!(drive.snapshot().link, Link::Offline(_));
            looking.drives.iter().filter(offline).count()
        });
        report.bus_down("unplugged", now);
        assert_eq!(reader.join().unwrap(), image.drives.len());
    }
}

#[test]
fn a_bus_that_goes_down_is_reported_before_its_drives_and_once() {
    let bus = bus(2);
    let image = bus.image.clone();
    let now = Instant::now();
    let events = Events::default();
    let mut report = Report::new(&bus, &options(), events.clone(), now);
    report.bus_up(now);
    report.apply(&News::Online(DriveIndex::new(0)), now);
    report.bus_down("unplugged", now);
    report.bus_down("cannot be opened", now);
    report.bus_down("no such device", now);
    assert_eq!(image.health().reason.as_deref(), Some("no such device"), "the newest");
    let kinds: Vec<EventKind> = events.recent().iter().map(|event| event.kind).collect();
    let expected = [
        EventKind::BusUp,
        EventKind::Online,
        EventKind::BusDown,
        EventKind::Offline,
        EventKind::Offline,
    ];
    assert_eq!(kinds, expected, "also a drive of which nothing was heard");
    report.bus_up(now);
    report.bus_down("cannot be opened", now);
    let down = events
        .recent()
        .iter()
        .filter(|event| event.kind == EventKind::BusDown)
        .count();
    assert_eq!(down, 2, "another loss is another one");
}

/// Stores this fault bit and this code in the drive's image, `ms` after the report began.
fn show_fault(report: &mut Report, image: &BusImage, (fault, code): (bool, u16), now: Instant) {
    let profile = &image.drives[0].spec.profile;
    for (point, word) in [
        (ModelPoint::FaultCode, code),
        (ModelPoint::Fault, u16::from(fault) << 3),
    ] {
        let raw = profile.model_point(point).unwrap().raw().unwrap();
        let read = image.drives[0]
            .plan
            .reads
            .iter()
            .find(|read| read.covers(raw.table, raw.address));
        let read = *read.unwrap();
        let mut words = image.drives[0]
            .reading(now, RECENT)
            .words(read.table, read.start, read.count)
            .unwrap_or_else(|_| vec![0; usize::from(read.count)]);
        words[usize::from(raw.address - read.start)] = word;
        let news = News::Read {
            drive: DriveIndex::new(0),
            read,
            words,
            at: now,
        };
        report.apply(&news, now);
    }
}

#[test]
fn a_code_that_goes_before_its_bit_is_no_other_fault() {
    let bus = bus(1);
    let image = bus.image.clone();
    let mut now = Instant::now();
    let events = Events::default();
    let mut report = Report::new(&bus, &options(), events.clone(), now);
    report.apply(&News::Online(DriveIndex::new(0)), now);
    for shown in [
        (false, 0),
        (true, 1),
        (true, 0),
        (true, 0),
        (false, 0),
        (true, 0),
        (true, 2),
        (false, 0),
    ] {
        now += Duration::from_millis(10);
        show_fault(&mut report, &image, shown, now);
    }
    let recent = events.recent();
    let faults = recent
        .iter()
        .filter(|e| matches!(e.kind, EventKind::Fault | EventKind::FaultEnd));
    let told: Vec<(EventKind, Option<i64>)> = faults.map(|event| (event.kind, event.fault_code)).collect();
    let expected = [
        (EventKind::Fault, Some(1)),
        (EventKind::FaultEnd, None),
        (EventKind::Fault, None),
        (EventKind::Fault, Some(2)),
        (EventKind::FaultEnd, None),
    ];
    assert_eq!(told, expected, "{recent:?}");
    assert!(recent.iter().all(|event| !event.text.contains("fault 0")), "{recent:?}");
}

#[test]
fn supervision_tells_what_it_is_about_to_do_and_what_came_of_it() {
    let mut bus = bus(1);
    let drive = &bus.image.drives[0];
    let spec = DriveSpec {
        supervision: Some(drivegate_core::process_image::Supervision {
            timeout: Duration::from_secs(5),
            action: LeaseAction::Stop,
            adopt: false,
        }),
        ..drive.spec.clone()
    };
    let drive = Arc::new(DriveImage::new(spec, Duration::from_secs(1)));
    bus.image = Arc::new(BusImage::new(bus.image.spec.clone(), vec![drive.clone()]));
    let now = Instant::now();
    let events = Events::default();
    let mut report = Report::new(&bus, &options(), events.clone(), now);
    let failed = |why: Option<&str>| News::ActionFailed {
        drive: DriveIndex::new(0),
        why: why.map(str::to_string),
    };
    let unseen = Unconfirmed {
        text: "acknowledged run=false but did not show it within 5s: the motor does not stop".to_string(),
        does_not_run: false,
        own: true,
    };
    for news in [
        News::LeaseRanOut(DriveIndex::new(0)),
        failed(Some("the drive refused it with exception 04 (device failure)")),
        failed(None),
        News::ActionTaken {
            drive: DriveIndex::new(0),
            failures: 2,
        },
        News::NotConfirmed(DriveIndex::new(0), unseen),
    ] {
        report.apply(&news, now);
    }
    let told: Vec<(EventKind, String)> = events.recent().into_iter().map(|e| (e.kind, e.text)).collect();
    let kinds: Vec<EventKind> = told.iter().map(|(kind, _)| *kind).collect();
    let expected = [
        EventKind::Supervision,
        EventKind::SupervisionFailed,
        EventKind::Supervision,
        EventKind::SupervisionFailed,
        EventKind::NotConfirmed,
    ];
    assert_eq!(kinds, expected, "{told:?}");
    assert!(told[0].1.ends_with("the drive is being stopped"), "{told:?}");
    assert!(
        told[1]
            .1
            .contains("the stop failed: the drive refused it with exception 04"),
        "{told:?}"
    );
    assert_eq!((drive.supervisions(), drive.supervision_failures()), (1, 3));
}

/// A motor that starts and stops: the words of the status register, and the client reported as the cause.
#[test]
fn an_event_tells_who_started_and_stopped_a_motor() {
    use drivegate_core::order::{Origin, Outcome, SourceKind, Ticket};
    const SECOND: Duration = Duration::from_secs(1);
    let bus = bus(1);
    let image = bus.image.clone();
    let events = Events::default();
    let mut now = Instant::now();
    let mut report = Report::new(&bus, &options(), events.clone(), now);
    let status = image.drives[0]
        .plan
        .reads
        .iter()
        .find(|read| read.table == Table::Holding && read.covers(Table::Holding, 2100))
        .copied()
        .unwrap();
    report.apply(&News::Online(DriveIndex::new(0)), now);
    let order = |run: bool, outcome: Outcome, now: Instant| {
        let origin = Origin::new(SourceKind::Mqtt, "operator");
        let (ticket, _) = Ticket::new(origin, "d1", "run".to_string(), true, now, bus.command_log.clone());
        let change = drivegate_core::order::Change {
            point: "run".to_string(),
            old: None,
            new: Value::Bool(run),
            run: Some(run),
            resets: false,
        };
        ticket.with_changes(vec![change]).answer(outcome, now);
    };
    let mut read = |word: u16, now: Instant| {
        let mut words = vec![0; usize::from(status.count)];
        words[usize::from(2100 - status.start)] = word;
        report.apply(
            &News::Read {
                drive: DriveIndex::new(0),
                read: status,
                words,
                at: now,
            },
            now,
        );
    };
    let acknowledged = || Outcome::Acknowledged(Reply::Written);
    let refused = || Outcome::Exception(Exception::Modbus(4));
    // Order and status, and the client that is named.
    let (stands, runs, faults) = (1u16, 3u16, 8u16);
    read(stands, now);
    for (ordered, after, word, expected) in [
        (Some((true, acknowledged())), 2, runs, Some("mqtt operator")),
        (Some((false, Outcome::TimedOut)), 200, stands, Some("mqtt operator")),
        (None, 2, runs, None),
        (Some((true, acknowledged())), 1, stands, None),
        (None, 1, runs, None),
        (Some((false, refused())), 2, faults, None),
        (Some((true, acknowledged())), 100, runs, None),
    ] {
        if let Some((run, outcome)) = ordered {
            now += SECOND;
            order(run, outcome, now);
        }
        now += SECOND * after;
        read(word, now);
        let wanted = if word == runs {
            EventKind::Started
        } else {
            EventKind::Stopped
        };
        let event = events.recent().into_iter().rfind(|event| event.kind == wanted).unwrap();
        assert_eq!(event.by.as_deref(), expected, "{}", event.text);
        let named = expected.unwrap_or_default();
        assert!(event.text.contains(named), "{}", event.text);
        assert_eq!(
            event.text.contains("without a command"),
            expected.is_none() && word != faults,
            "{}",
            event.text
        );
    }
    let kinds = |kind| events.recent().iter().filter(|event| event.kind == kind).count();
    assert_eq!((kinds(EventKind::Started), kinds(EventKind::Stopped)), (4, 3));
    // The bit flaps: a few events, then one now and then that counts the rest.
    for n in 0..1000 {
        now += Duration::from_millis(100);
        read(if n % 2 == 0 { stands } else { runs }, now);
    }
    let all = kinds(EventKind::Started) + kinds(EventKind::Stopped);
    assert!((15..30).contains(&all), "{all}");
    let last = events.recent().pop().unwrap();
    assert!(last.text.contains("changes before it omitted"), "{}", last.text);
}
