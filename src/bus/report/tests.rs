//! What a reader on another thread sees while the image changes.

use super::*;
use crate::codec::{LineFormat, Protocol};
use crate::drive::profile::Profiles;
use crate::process_image::{BusSpec, DriveSpec};

fn image(drives: u8) -> Arc<BusImage> {
    let profile = Profiles::built_in().get("vacon-nx").unwrap().clone();
    let drive = |address| {
        let spec = DriveSpec::new(&format!("d{address}"), "b", address, profile.clone());
        Arc::new(DriveImage::new(spec, Duration::from_secs(1)))
    };
    let bus = BusSpec {
        name: "b".to_string(),
        port: "none".to_string(),
        protocol: Protocol::ModbusRtu,
        format: LineFormat::new(38_400, "8N1").unwrap(),
        cycle: Duration::from_millis(10),
        slow_cycle: Duration::from_secs(1),
    };
    Arc::new(BusImage::new(bus, (1..=drives).map(drive).collect()))
}

fn options() -> BusOptions {
    BusOptions {
        response_timeout: Duration::from_millis(100),
        retries: 1,
        silence: Default::default(),
        line: Default::default(),
        mode: Default::default(),
    }
}

/// A reader that saw the bus down found values of its drives good (a motor that runs on a bus that is down).
#[test]
fn whoever_sees_the_bus_down_sees_every_drive_offline() {
    let image = image(200);
    let now = Instant::now();
    let mut report = Report::new(image.clone(), &options(), Events::default(), Default::default(), now);
    for _ in 0..20 {
        report.bus_up(now);
        for index in 0..image.drives.len() {
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
    let image = image(2);
    let now = Instant::now();
    let events = Events::default();
    let mut report = Report::new(image, &options(), events.clone(), Default::default(), now);
    report.bus_up(now);
    report.apply(&News::Online(0), now);
    report.bus_down("unplugged", now);
    report.bus_down("unplugged", now);
    let kinds: Vec<EventKind> = events.recent().iter().map(|event| event.kind).collect();
    let expected = [
        EventKind::BusUp,
        EventKind::Online,
        EventKind::BusDown,
        EventKind::Offline,
        EventKind::Offline,
    ];
    assert_eq!(kinds, expected, "also a drive of which nothing was heard");
}

/// A motor that starts and stops: the words of the status register, and who is told to have been the cause.
#[test]
fn an_event_tells_who_started_and_stopped_a_motor() {
    use crate::command::{Origin, Outcome, SourceKind, Ticket};
    const SECOND: Duration = Duration::from_secs(1);
    let image = image(1);
    let (events, writes) = (Events::default(), Arc::<WriteStats>::default());
    let mut now = Instant::now();
    let mut report = Report::new(image.clone(), &options(), events.clone(), writes.clone(), now);
    let status = image.drives[0]
        .plan
        .reads
        .iter()
        .find(|read| read.table == Table::Holding && read.covers(Table::Holding, 2100))
        .copied()
        .unwrap();
    report.apply(&News::Online(0), now);
    let order = |run: bool, outcome: Outcome, now: Instant| {
        let origin = Origin::new(SourceKind::Mqtt, "operator");
        let (ticket, _) = Ticket::new(origin, "d1", "run".to_string(), true, now, writes.clone());
        let change = crate::command::Change {
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
                drive: 0,
                read: status,
                words,
                at: now,
            },
            now,
        );
    };
    let acknowledged = || Outcome::Acknowledged(Reply::Written);
    let refused = || Outcome::Exception(Exception(4));
    // What happens, and who is named after it.
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
            event.text.contains("by no order"),
            expected.is_none() && word != faults,
            "{}",
            event.text
        );
    }
    let kinds = |kind| events.recent().iter().filter(|event| event.kind == kind).count();
    assert_eq!((kinds(EventKind::Started), kinds(EventKind::Stopped)), (4, 3));
    // It flaps: a few events, then one now and then that counts the rest.
    for n in 0..1000 {
        now += Duration::from_millis(100);
        read(if n % 2 == 0 { stands } else { runs }, now);
    }
    let all = kinds(EventKind::Started) + kinds(EventKind::Stopped);
    assert!((15..30).contains(&all), "{all}");
    let last = events.recent().pop().unwrap();
    assert!(last.text.contains("changes before it are left out"), "{}", last.text);
}
