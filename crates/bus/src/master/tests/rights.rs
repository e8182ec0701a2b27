//! A reload takes the right of a client away: its orders are not continued, except stops.

use std::sync::atomic::{AtomicBool, Ordering};

use super::*;
use drivegate_core::order::{Arrival, Right};
use drivegate_core::plant::{Exchange, OrderRequest, Plant, Question, Target};

struct Client {
    origin: Origin,
    right: Arc<AtomicBool>,
}

impl Client {
    fn new(kind: SourceKind) -> Client {
        let right = Arc::new(AtomicBool::new(true));
        Client {
            origin: Origin::new(kind, "x").with_right(Right::of(right.clone())),
            right,
        }
    }

    fn loses_it(&self) {
        self.right.store(false, Ordering::Release);
    }
}

fn rig() -> (Rig, Plant) {
    let rig = Rig::new(1);
    rig.bus.image.update_health(|health| health.up = true);
    let plant = Plant::new("g", Duration::from_secs(1), vec![rig.bus.clone()]);
    (rig, plant)
}

fn place(rig: &Rig, plant: &Plant, client: &Client, sets: &[(ModelPoint, Value)]) -> drivegate_core::plant::Placed {
    let drive = plant.drives().next().unwrap();
    let index = |point| drive.image.spec.profile.model_index(point).unwrap();
    let order = Order::Points(sets.iter().map(|(point, value)| (index(*point), *value)).collect());
    drive.place(
        OrderRequest::new(order, client.origin.clone(), Authority::Write),
        rig.now,
    )
}

fn code(placed: &mut drivegate_core::plant::Placed) -> &'static str {
    placed.answer().map_or("none", |answer| answer.outcome.code())
}

fn writes(rig: &Rig, from: usize) -> usize {
    let wire = rig.wire.get(from..).unwrap_or_default();
    wire.iter().filter(|(_, turn)| turn.pdu().is_write()).count()
}

const START: &[(ModelPoint, Value)] = &[(ModelPoint::Run, Value::Bool(true))];
const STOP: &[(ModelPoint, Value)] = &[(ModelPoint::Run, Value::Bool(false))];
const REFERENCE: &[(ModelPoint, Value)] = &[(ModelPoint::SpeedReference, Value::Number(20.0))];
const BOTH: &[(ModelPoint, Value)] = &[
    (ModelPoint::Run, Value::Bool(true)),
    (ModelPoint::SpeedReference, Value::Number(20.0)),
];
const RESET: &[(ModelPoint, Value)] = &[(ModelPoint::FaultReset, Value::Bool(true))];

/// When the right is removed: before the order is accepted, while it waits, or after its first write.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Goes {
    Before,
    Waiting,
    Begun,
}

#[test]
fn an_order_without_its_right_goes_no_further_and_an_accepted_stop_does() {
    use Goes::{Before, Begun, Waiting};
    // The result, the writes after the right was withdrawn, and whether the motor runs.
    let table = [
        (Before, START, "not_allowed", 0, false),
        (Before, REFERENCE, "not_allowed", 0, false),
        (Before, STOP, "not_allowed", 0, true),
        (Waiting, START, "not_allowed", 0, false),
        (Waiting, REFERENCE, "not_allowed", 0, false),
        (Waiting, BOTH, "not_allowed", 0, false),
        (Waiting, RESET, "not_allowed", 0, false),
        (Waiting, STOP, "acknowledged", 1, false),
        (Begun, BOTH, "interrupted", 0, false),
        // The bit that resets is taken back in any case.
        (Begun, RESET, "acknowledged", 1, false),
    ];
    for kind in [
        SourceKind::Mqtt,
        SourceKind::ModbusTcp,
        SourceKind::Http,
        SourceKind::Bacnet,
        SourceKind::Slot,
    ] {
        for (goes, sets, expected, written, runs) in table {
            let (mut rig, plant) = rig();
            let (client, other) = (Client::new(kind), Client::new(SourceKind::LocalSocket));
            if sets == STOP {
                drop(place(&rig, &plant, &other, START));
                rig.run(Duration::from_millis(100));
                assert!(rig.runs(0));
            }
            if goes == Before {
                client.loses_it();
            }
            let mut from = rig.wire.len();
            let mut placed = place(&rig, &plant, &client, sets);
            if goes == Begun {
                while writes(&rig, from) == 0 {
                    rig.step();
                }
                from = rig.wire.len();
            }
            client.loses_it();
            rig.run(Duration::from_millis(300));
            let what = format!("{kind:?} {goes:?} {sets:?}");
            assert_eq!((code(&mut placed), writes(&rig, from)), (expected, written), "{what}");
            assert_eq!(rig.runs(0), runs, "{what}");
            let mut next = place(&rig, &plant, &other, REFERENCE);
            rig.run(Duration::from_millis(300));
            assert_eq!(
                code(&mut next),
                "acknowledged",
                "another client has its own right: {what}"
            );
        }
    }
}

/// A turn is chosen and waits for silence on the line; the right is removed in between.
#[test]
fn what_was_chosen_is_not_sent_without_its_right() {
    let (mut rig, plant) = rig();
    let client = Client::new(SourceKind::Http);
    let mut placed = place(&rig, &plant, &client, START);
    let turn = loop {
        match rig.master.next(rig.now, &mut rig.news) {
            Ok(turn) if turn.pdu().is_write() => break turn,
            Ok(_) => panic!("a command goes before polls"),
            Err(until) => rig.now = until,
        }
    };
    assert!(rig.master.is_still_due(&turn, rig.now));
    client.loses_it();
    assert!(!rig.master.is_still_due(&turn, rig.now));
    rig.run(Duration::from_millis(100));
    assert_eq!((code(&mut placed), rig.runs(0)), ("not_allowed", false));
}

fn asked(rig: &Rig, client: &Client, target: Target, pdu: RequestPdu) -> Exchange {
    let question = Question {
        target,
        pdu,
        may_write: true,
        arrival: Arrival::now(rig.now),
        expires: rig.now + Duration::from_secs(1),
        origin: client.origin.clone(),
    };
    rig.bus.ask(question, rig.now)
}

fn outcome(exchange: &mut Exchange) -> Option<&'static str> {
    let mut cx = std::task::Context::from_waker(std::task::Waker::noop());
    match exchange.poll(&mut cx) {
        std::task::Poll::Ready((outcome, _)) => Some(outcome.code()),
        std::task::Poll::Pending => None,
    }
}

/// Unchecked requests of a tool: to one drive, to all drives, and to an address without a configured drive.
#[test]
fn what_is_passed_on_for_a_tool_needs_its_right_at_its_turn() {
    let run = RequestPdu::write_register(2000, 1);
    for target in [
        Target::Drive(DriveIndex::new(0)),
        Target::Address(0),
        Target::Address(77),
    ] {
        for waiting in [false, true] {
            let (mut rig, _plant) = rig();
            let client = Client::new(SourceKind::Slot);
            if !waiting {
                client.loses_it();
            }
            let from = rig.wire.len();
            let mut exchange = asked(&rig, &client, target, run.clone());
            client.loses_it();
            rig.run(Duration::from_millis(500));
            assert_eq!(
                outcome(&mut exchange),
                Some("not_allowed"),
                "{target:?} waiting {waiting}"
            );
            assert_eq!((writes(&rig, from), rig.runs(0)), (0, false), "{target:?}");
        }
    }
}
