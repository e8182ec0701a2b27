use super::*;
use std::sync::Arc;

use crate::order::{Authority, Order, SourceKind};
use crate::plant::OrderRequest;
use crate::process_image::{BusImage, DriveSpec};
use crate::testkit::{STALE_AFTER, bus, bus_spec, image, monitored, nx, up};
use drivegate_model::drive::Value;

/// Buses `a` and `b`, each with a controlled drive in the group `pumps` and a monitored one in none.
fn plant() -> Plant {
    let profile = nx();
    let bus = |name: &str| {
        let drive = |address, access, group: Option<&str>| {
            image(DriveSpec {
                access,
                group: group.map(str::to_string),
                ..monitored(&format!("{name}{address}"), name, address, &profile)
            })
        };
        let drives = vec![
            drive(1, Access::Control, Some("pumps")),
            drive(2, Access::Monitor, None),
        ];
        up(bus(bus_spec(name), drives))
    };
    Plant::new("g", STALE_AFTER, vec![bus("a"), bus("b")])
}

fn waiting(plant: &Plant) -> [usize; 2] {
    [0, 1].map(|bus| plant.buses[bus].queue.lock().len())
}

#[test]
fn an_order_reaches_the_controlled_drives_of_its_scope() {
    let name = |name: &str| name.to_string();
    let (origin, now) = (Origin::new(SourceKind::Http, "alice"), Instant::now());
    for (scope, stops) in [
        (Scope::Gateway, [1, 1]),
        (Scope::Bus(name("a")), [1, 0]),
        (Scope::Buses(vec![name("b")]), [0, 1]),
        (Scope::Group(name("pumps")), [1, 1]),
    ] {
        let (plant, all) = (plant(), StopAll::default());
        let order = all.order(&plant, &scope, &origin, WAIT, now);
        assert!(order.is_ok() && waiting(&plant) == stops, "{scope:?}");
    }
    for (scope, says) in [
        (Scope::Bus(name("c")), "known: a, b"),
        (Scope::Group(name("fans")), "known: pumps"),
    ] {
        let (plant, all) = (plant(), StopAll::default());
        let error = all.order(&plant, &scope, &origin, WAIT, now).unwrap_err();
        assert!(error.to_string().ends_with(says), "{error}");
        assert_eq!(waiting(&plant), [0, 0]);
    }
    let (mut plant, all) = (plant(), StopAll::default());
    plant.buses.truncate(1);
    let monitored = plant.buses[0].image.drives[1].clone();
    let spec = plant.buses[0].image.spec.clone();
    plant.buses[0].image = Arc::new(BusImage::new(spec, vec![monitored]));
    let error = all.order(&plant, &Scope::Gateway, &origin, WAIT, now).unwrap_err();
    assert_eq!(error, NothingToStop::NotControlled);
}

/// A plant of one drive that runs, with a stop-all in progress that the drive has acknowledged; returns how many
/// stops a second order after `then` places.
fn second_order(then: impl Fn(&Plant, &StopAll, Instant)) -> (Plant, usize) {
    let (mut plant, all) = (plant(), StopAll::default());
    plant.buses.truncate(1);
    let (origin, now) = (Origin::new(SourceKind::Http, "alice"), Instant::now());
    let read = |at: Instant, words: &[u16]| {
        let drive = &plant.buses[0].image.drives[0];
        crate::testkit::read(drive, 2100, words, at);
        drive.update(|snapshot| snapshot.store(drivegate_proto::Table::Holding, 2000, &[words[0] & 2 >> 1, 0, 0], at));
    };
    read(now, &[0x03, 0, 0, 2500]);
    let order = |who: &Origin, now| all.order(&plant, &Scope::Gateway, who, WAIT, now);
    order(&origin, now).unwrap();
    let stop = crate::testkit::take_next(&plant.buses[0].queue, now).unwrap();
    stop.answer(
        &crate::order::Outcome::Acknowledged(drivegate_proto::Reply::Written),
        now,
    );
    assert!(all.advance(&plant, now));
    then(&plant, &all, now);
    let later = now + Duration::from_millis(900);
    all.advance(&plant, later);
    let bob = Origin::new(SourceKind::Http, "bob");
    order(&bob, later).unwrap();
    let placed = plant.buses[0].queue.lock().len();
    (plant, placed)
}

#[test]
fn a_second_order_joins_the_one_under_way_unless_the_motor_may_have_started() {
    let drive = |plant: &Plant| plant.drives().next().unwrap();
    let read = |plant: &Plant, at, status: u16, command: u16| {
        let image = &drive(plant).image;
        let hertz = if status & 2 == 0 { 0 } else { 2500 };
        crate::testkit::read(image, 2100, &[status, 0, 0, hertz], at);
        image.update(|snapshot| snapshot.store(drivegate_proto::Table::Holding, 2000, &[command, 0, 0], at));
    };
    let after = |now: Instant, millis| now + Duration::from_millis(millis);
    let (plant, placed) = second_order(|plant, _, now| read(plant, after(now, 500), 0x03, 0));
    assert_eq!(placed, 0, "it slows down");
    assert_eq!(
        drive(&plant).last_stop_by().unwrap().who,
        "bob",
        "the later stop counts"
    );
    let audited = plant.command_log.audit().recent(None);
    assert!(
        audited
            .iter()
            .any(|line| line.contains("bob") && line.contains("already in progress")),
        "{audited:?}"
    );
    let (_, placed) = second_order(|plant, all, now| {
        // The motor had been standing and now turns.
        read(plant, after(now, 200), 0x41, 0);
        all.advance(plant, after(now, 250));
        read(plant, after(now, 500), 0x03, 0);
    });
    assert_eq!(placed, 1, "somebody at the drive started it");
    let (_, placed) = second_order(|plant, _, now| read(plant, after(now, 500), 0x03, 1));
    assert_eq!(placed, 1, "it has a run command");
    let (_, placed) = second_order(|plant, _, _| {
        let image = &drive(plant).image;
        image.update(|snapshot| snapshot.link = crate::process_image::Link::Offline(std::time::SystemTime::now()));
    });
    assert_eq!(placed, 1, "nothing is known of it");
    for (point, value, expected) in [("run", 1.0, 1), ("speed_reference", 10.0, 0)] {
        let (plant, placed) = second_order(|plant, _, now| {
            read(plant, after(now, 500), 0x03, 0);
            let drive = drive(plant);
            let index = drive.image.spec.profile.point_index(point).unwrap();
            let order = Order::Points(vec![(index, Value::Number(value))]);
            let origin = Origin::new(SourceKind::Mqtt, "c");
            let mut placed = drive.place(OrderRequest::new(order, origin, Authority::Write), now);
            assert!(placed.answer().is_none());
        });
        assert_eq!(placed, expected, "{point}");
        let left = crate::testkit::take_next(&plant.buses[0].queue, Instant::now());
        assert!(left.is_none_or(|command| command.is_stop()), "{point} is purged");
    }
}

#[test]
fn orders_without_end_are_all_answered() {
    let (plant, all) = (plant(), StopAll::default());
    let (origin, now) = (Origin::new(SourceKind::Http, "alice"), Instant::now());
    let mut orders: Vec<StopOrder> = (0..MOST_ORDERS + 10)
        .map(|_| all.order(&plant, &Scope::Gateway, &origin, WAIT, now).unwrap())
        .collect();
    assert_eq!(waiting(&plant), [1, 1], "they join");
    let answered = orders.iter_mut().filter_map(|order| order.report.try_recv().ok());
    let answered: Vec<StopReport> = answered.collect();
    assert_eq!(answered.len(), 10, "the oldest");
    assert!(answered.iter().all(|report| !report.ok && report.drives.len() == 2));
    assert!(all.advance(&plant, now));
    assert!(!all.advance(&plant, now + WAIT));
    let left = orders.iter_mut().filter_map(|order| order.report.try_recv().ok());
    assert_eq!(left.count(), MOST_ORDERS);
}

/// The plant behind a reload that left only these of its drives, monitored ones with `false`.
fn reloaded(left: &[(&str, u8, bool)]) -> Plant {
    let profile = nx();
    let bus = |name: &str| {
        let of_bus = left.iter().filter(|(bus, ..)| *bus == name);
        let drive = |(_, address, control): &(&str, u8, bool)| {
            image(DriveSpec {
                access: if *control { Access::Control } else { Access::Monitor },
                ..monitored(&format!("new-{name}{address}"), name, *address, &profile)
            })
        };
        up(bus(bus_spec(name), of_bus.map(drive).collect()))
    };
    Plant::new("g", STALE_AFTER, vec![bus("a"), bus("b")])
}

#[test]
fn a_drive_that_the_name_meant_and_that_is_out_of_reach_is_not_proven_to_stand() {
    let (origin, now) = (Origin::new(SourceKind::Http, "alice"), Instant::now());
    let earlier = NamedDrives::of(&plant());
    let of_then = |scope: Scope| scope.as_of(&earlier).unwrap();
    let group = || of_then(Scope::Group("pumps".to_string()));
    let (removed, monitored) = ("a reload removed the drive", "access = \"control\" away");
    for (left, lost, code) in [
        (&[("a", 1, true)][..], removed, "unknown_drive"),
        (&[("a", 1, true), ("b", 1, false)], monitored, "not_allowed"),
        (&[("a", 1, true), ("b", 2, true)], removed, "unknown_drive"),
    ] {
        let (plant, all) = (reloaded(left), StopAll::default());
        let mut order = all.order(&plant, &group(), &origin, WAIT, now).unwrap();
        assert_eq!(waiting(&plant), [1, 0], "{left:?}");
        let stop = crate::testkit::take_next(&plant.buses[0].queue, now).unwrap();
        stop.answer(
            &crate::order::Outcome::Acknowledged(drivegate_proto::Reply::Written),
            now,
        );
        let later = now + Duration::from_millis(50);
        crate::testkit::read(&plant.buses[0].image.drives[0], 2100, &[1, 0, 0, 0], later);
        assert!(all.advance(&plant, later), "{left:?}: it waits for the other");
        all.advance(&plant, now + WAIT);
        let report = order.report.try_recv().unwrap();
        assert!(!report.ok && report.drives.len() == 2, "{report:?}");
        assert_eq!(report.drives[0].drive, "new-a1");
        assert_eq!(
            (&*report.drives[1].drive, report.drives[1].outcome),
            ("b1", Stopped::Unproven)
        );
        let why = report.drives[1].reason.as_deref();
        assert!(why.is_some_and(|why| why.contains(lost)), "{report:?}");
        let audit = plant.command_log.audit().recent(None);
        let has_lost = audit.iter().any(|line| line.contains("\"b1\"") && line.contains(code));
        assert!(has_lost, "{audit:?}");
    }
    for (scope, left) in [
        (group(), &[][..]),
        (group(), &[("a", 1, false), ("b", 2, true)]),
        (of_then(Scope::Bus("a".to_string())), &[("b", 1, true)]),
    ] {
        let (plant, all) = (reloaded(left), StopAll::default());
        let error = all.order(&plant, &scope, &origin, WAIT, now).unwrap_err();
        assert!(matches!(error, NothingToStop::Unknown { .. }), "{error}");
        assert!(error.to_string().contains("no controlled drive left of the"), "{error}");
        assert_eq!(waiting(&plant), [0, 0]);
    }
}
