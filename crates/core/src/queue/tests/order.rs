//! One order of commands for each drive: requests passed on to several drives among the others, and orders given
//! before a stop.

use super::*;
use crate::order::{Effect, Effects, Intent, PassedOn, Target};
use crate::permit::DrillLock;
use drivegate_model::drive::{DriveIndex, PointIndex};
use drivegate_proto::{Reply, RequestPdu};

const START: u16 = 1;
const STOP: u16 = 0;

impl Clients {
    /// A broadcast that a tool passes on to drives 1 and 2.
    fn broadcast(&mut self, value: u16) -> Receiver<Answer> {
        let origin = Origin::new(SourceKind::Slot, "tool");
        let (ticket, receiver) = Ticket::new(origin, "all", String::new(), true, self.now, self.stats.clone());
        let (frame, wanted) = tokio::sync::oneshot::channel();
        std::mem::forget(wanted);
        let effect = Effect {
            stops: value == STOP,
            run: Some(value == START),
            ..Effect::default()
        };
        let effects = [1, 2].map(|drive| (DriveIndex::new(drive), effect)).to_vec();
        let window = Window {
            arrival: Arrival::now(self.now),
            expires: self.now + EXPIRY,
            waits: false,
        };
        let order = Order::Write(RequestPdu::write_register(2000, value));
        let effects = Effects::on_all(effects, Touched::Anything);
        let intent = Intent::new(Target::Address(0), order, effects, window);
        let passed_on = PassedOn {
            may_write: true,
            first: false,
            frame,
        };
        self.pending
            .push(Command::passed_on(intent, passed_on, ticket), &(), self.now);
        receiver
    }

    fn run_asked(&mut self, drive: usize, asked: Instant) -> Receiver<Answer> {
        let (ticket, receiver) = ticket(&self.stats, self.now);
        let admitted = Admitted {
            order: points(&[1]),
            urgency: Urgency::Command,
            reference_only: false,
            ranges: Vec::new(),
        };
        let mut command = command(drive, admitted, self.now, ticket);
        command.intent.window.arrival.asked = asked;
        self.pending.push(command, &(), self.now);
        receiver
    }

    fn passes_on(&mut self) -> bool {
        self.pending
            .next_passed_on(self.now, &(), |_| Ready::Now)
            .chosen
            .is_some()
    }
}

fn reference(percent: f64) -> Order {
    Order::Points(vec![(PointIndex::new(7), Value::Number(percent))])
}

#[test]
fn a_newer_reference_keeps_behind_an_order_that_sets_the_same() {
    let mut rig = Clients::new();
    let give = |rig: &mut Clients, order: Order, only: bool| {
        rig.give((SourceKind::Mqtt, "t"), 1, Urgency::Command, order, only)
    };
    let mut first = give(&mut rig, reference(10.0), true);
    let both = Order::Points(vec![
        (PointIndex::new(1), Value::Bool(true)),
        (PointIndex::new(7), Value::Number(20.0)),
    ]);
    let _both = give(&mut rig, both.clone(), false);
    let mut second = give(&mut rig, reference(30.0), true);
    assert_eq!((outcome(&mut first), outcome(&mut second)), (None, None));
    // Behind the other order, the newest reference replaces the previous one.
    let _third = give(&mut rig, reference(40.0), true);
    assert_eq!(outcome(&mut second), Some(Outcome::Replaced));
    // An order for other points changes nothing.
    let _other = give(&mut rig, points(&[8]), false);
    let _fourth = give(&mut rig, reference(50.0), true);
    let sent: Vec<Order> = std::iter::from_fn(|| rig.take()).map(|c| c.intent.order).collect();
    assert_eq!(sent, [reference(10.0), both, reference(50.0), points(&[8])]);
}

#[test]
fn a_newer_reference_keeps_behind_what_it_rests_on() {
    let range = |sets: &[usize], rests_on: &[usize]| {
        let items = |points: &[usize]| points.iter().map(|point| (Table::Holding, *point as u16)).collect();
        Touched::These {
            sets: items(sets),
            rests_on: items(rests_on),
        }
    };
    let reference = range(&[7], &[9]);
    assert!(reference.commutes(&range(&[1], &[])) && reference.commutes(&range(&[1], &[9])));
    for other in [range(&[7], &[]), range(&[9], &[]), range(&[1], &[7]), Touched::Anything] {
        assert!(!reference.commutes(&other) && !other.commutes(&reference), "{other:?}");
    }
}

#[test]
fn a_stop_drops_a_broadcast_that_reaches_its_drive_but_for_one_that_stops_it() {
    let mut rig = Clients::new();
    let (mut start, mut stops) = (rig.broadcast(START), rig.broadcast(STOP));
    let _stop = rig.push(2, Urgency::Stop, &[1], false);
    assert_eq!(outcome(&mut start), Some(Outcome::Purged));
    assert_eq!(outcome(&mut stops), None);
    // The order was delayed at the tool meanwhile.
    let asked = rig.now;
    rig.now += Duration::from_millis(5);
    let _stop = rig.push(1, Urgency::Stop, &[1], false);
    let later = std::mem::replace(&mut rig.now, asked);
    let mut held = rig.broadcast(START);
    assert_eq!(outcome(&mut held), Some(Outcome::Purged));
    rig.now = later;
    assert_eq!(outcome(&mut rig.broadcast(START)), None);
}

#[test]
fn a_broadcast_has_its_place_among_the_orders_of_each_drive() {
    let mut rig = Clients::new();
    let _before = rig.push_from("a", 1, &[1]);
    let _broadcast = rig.broadcast(START);
    assert!(!rig.passes_on(), "an older order waits for drive 1");
    let _behind = rig.push_from("a", 2, &[2]);
    let _beside = rig.push_from("a", 3, &[3]);
    let order: Vec<Target> = std::iter::from_fn(|| rig.take()).map(|c| c.intent.target).collect();
    let place = |target| order.iter().position(|of| *of == target);
    let (broadcast, drive) = (place(Target::Address(0)), |drive| place(DriveIndex::new(drive).into()));
    assert!(drive(1) < broadcast && broadcast < drive(2), "{order:?}");
    assert_eq!(order.len(), 4);
    // A broadcast waits for idle time if no order waits for it.
    let _broadcast = rig.broadcast(STOP);
    assert_eq!(rig.pop(), None);
    assert!(rig.passes_on());
}

#[test]
fn a_broadcast_that_was_not_sent_is_not_put_back_behind_a_stop() {
    let mut rig = Clients::new();
    let mut broadcast = rig.broadcast(START);
    let chosen = rig.pending.next_passed_on(rig.now, &(), |_| Ready::Now).chosen.unwrap();
    let taken = rig.pending.take(chosen).unwrap();
    rig.pending.put_back(taken, rig.now);
    assert_eq!(outcome(&mut broadcast), None);
    let chosen = rig.pending.next_passed_on(rig.now, &(), |_| Ready::Now).chosen.unwrap();
    let taken = rig.pending.take(chosen).unwrap();
    let _stop = rig.push(1, Urgency::Stop, &[1], false);
    rig.pending.put_back(taken, rig.now);
    assert_eq!(outcome(&mut broadcast), Some(Outcome::Purged));
}

#[test]
fn what_was_asked_for_before_a_stop_does_not_go_behind_it() {
    let mut rig = Clients::new();
    let asked = rig.now;
    rig.now += Duration::from_millis(50);
    let _stop = rig.push(1, Urgency::Stop, &[1], false);
    assert_eq!(rig.pop(), Some((1, Urgency::Stop)));
    rig.now += Duration::from_millis(50);
    assert_eq!(outcome(&mut rig.run_asked(1, asked)), Some(Outcome::Purged));
    assert_eq!(outcome(&mut rig.run_asked(2, asked)), None, "another drive");
    let now = rig.now;
    assert_eq!(outcome(&mut rig.run_asked(1, now)), None, "asked for since");
}

#[test]
fn a_stop_waits_for_the_bus_that_takes_the_place_of_its_own() {
    let stats: Arc<CommandLog> = Arc::default();
    let now = Instant::now();
    let give = |queue: &CommandQueue, drive: usize, urgency: Urgency| {
        let (ticket, receiver) = ticket(&stats, now);
        let admitted = Admitted {
            order: points(&[1]),
            urgency,
            reference_only: false,
            ranges: Vec::new(),
        };
        queue.submit(command(drive, admitted, now, ticket), &(), now);
        receiver
    };
    let (old, new) = (CommandQueue::new().unwrap(), Arc::new(CommandQueue::new().unwrap()));
    let mut waits = give(&old, 3, Urgency::Stop);
    let mut run = give(&old, 2, Urgency::Command);
    old.begin_handover(Vec::new(), now);
    assert_eq!(outcome(&mut run), Some(Outcome::ShuttingDown));
    let (mut late, mut gone) = (give(&old, 2, Urgency::Stop), give(&old, 4, Urgency::Stop));
    // The port may be lost and opened again shortly before the bus ends.
    old.close(Outcome::BusDown, now);
    old.open();
    old.hand_over(DriveIndex::new(3), &new, DriveIndex::new(0), now);
    old.hand_over(DriveIndex::new(2), &new, DriveIndex::new(1), now);
    let mut last = give(&old, 2, Urgency::Stop);
    let mut refused = give(&old, 2, Urgency::Command);
    assert!(outcome(&mut refused).is_some());
    old.close(Outcome::ShuttingDown, now);
    assert_eq!(outcome(&mut gone), Some(Outcome::ShuttingDown), "nobody takes it over");
    let mut sent = Vec::new();
    while let Some(stop) = crate::testkit::take_next(&new, now) {
        sent.extend(stop.drive());
        stop.answer(&Outcome::Acknowledged(Reply::Written), now);
    }
    assert_eq!(sent, [0, 1]);
    for answer in [&mut waits, &mut late, &mut last] {
        assert!(outcome(answer).is_some_and(|outcome| outcome.is_ok()));
    }
}

/// The lease of a drive may be shorter than the wait for the last stops of its bus.
#[test]
fn an_order_that_a_handover_keeps_from_its_drive_renews_the_lease() {
    let (stats, now): (Arc<CommandLog>, _) = (Arc::default(), Instant::now());
    let queue = CommandQueue::new().unwrap();
    let give = |kind: SourceKind, drive: usize, urgency| {
        let origin = Origin::new(kind, "a");
        let (ticket, receiver) = Ticket::new(origin, "d", String::new(), true, now, stats.clone());
        let admitted = Admitted {
            order: points(&[1]),
            urgency,
            reference_only: false,
            ranges: Vec::new(),
        };
        queue.submit(command(drive, admitted, now, ticket), &(), now);
        receiver
    };
    let renewed = |drive: usize| queue.lock().take_renewed(DriveIndex::new(drive));
    let mut waits = give(SourceKind::Mqtt, 1, Urgency::Command);
    let _stop = give(SourceKind::Mqtt, 3, Urgency::Stop);
    assert!(!renewed(1));
    queue.begin_handover(vec![DriveIndex::new(3)], now);
    assert_eq!(outcome(&mut waits), Some(Outcome::ShuttingDown));
    assert!(renewed(1) && queue.has_last_stops());
    let drill = DrillLock {
        who: "d".to_string(),
        quiet_until: None,
    };
    queue.set_drill(DriveIndex::new(4), Some(drill));
    for (kind, drive, urgency, renews) in [
        (SourceKind::ModbusTcp, 2, Urgency::Command, true),
        (SourceKind::ModbusTcp, 2, Urgency::Read, false),
        (SourceKind::Schedule, 2, Urgency::Command, false),
        // An order that the gate would refuse.
        (SourceKind::ModbusTcp, 4, Urgency::Command, false),
    ] {
        let mut refused = give(kind, drive, urgency);
        let what = format!("{kind:?}, drive {drive}, {urgency:?}");
        assert_eq!(outcome(&mut refused), Some(Outcome::ShuttingDown), "{what}");
        assert_eq!(renewed(drive), renews, "{what}");
        assert!(!renewed(drive), "{what}: once");
    }
    assert!(!renewed(2) && !renewed(3), "a silent client's lease ends");
    queue.close(Outcome::ShuttingDown, now);
    let _late = give(SourceKind::ModbusTcp, 2, Urgency::Command);
    assert!(!renewed(2), "the bus has ended");
}

/// A client whose handle is idle keeps only the first queue: the last queue gets its stop, and the queues between are
/// freed.
#[test]
fn a_stop_finds_the_last_of_many_buses_and_keeps_none_between() {
    let (stats, now): (Arc<CommandLog>, _) = (Arc::default(), Instant::now());
    let first = Arc::new(CommandQueue::new().unwrap());
    let (mut last, mut between) = (first.clone(), Vec::new());
    for place in 0..20 {
        let next = Arc::new(CommandQueue::new().unwrap());
        last.begin_handover(Vec::new(), now);
        last.hand_over(DriveIndex::new(place), &next, DriveIndex::new(place + 1), now);
        last.close(Outcome::ShuttingDown, now);
        between.push(Arc::downgrade(&last));
        last = next;
    }
    assert_eq!(between.iter().filter(|queue| queue.strong_count() > 0).count(), 1);
    let give = || {
        let (ticket, receiver) = ticket(&stats, now);
        let admitted = Admitted {
            order: points(&[1]),
            urgency: Urgency::Stop,
            reference_only: false,
            ranges: Vec::new(),
        };
        first.submit(command(0, admitted, now, ticket), &(), now);
        receiver
    };
    let _answer = give();
    assert_eq!(
        crate::testkit::take_next(&last, now).unwrap().intent.target,
        DriveIndex::new(20)
    );
    drop(last);
    assert_eq!(
        outcome(&mut give()),
        Some(Outcome::ShuttingDown),
        "no bus serves it any more"
    );
}
