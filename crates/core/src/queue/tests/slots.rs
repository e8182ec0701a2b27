//! Orders of other sides and the slots of BACnet's clients: accepted, refused and withdrawn in one order.

use super::*;
use crate::order::{Commanded, Effect, Effects, Entry, Intent, PassedOn, SlotWrite, Target};
use crate::permit::Settled;
use drivegate_model::drive::DriveIndex;
use drivegate_proto::RequestPdu;

fn effect(run: bool) -> Effect {
    Effect {
        stops: !run,
        run: Some(run),
        ..Effect::default()
    }
}

/// Enters a value of `run` at this priority.
fn stand(pending: &mut Pending, drive: usize, priority: u8, run: bool, now: Instant) {
    let origin = Origin::new(SourceKind::Bacnet, "10.0.0.5:47808");
    let write = SlotWrite::new(
        Commanded::Run,
        priority,
        Some(Entry::new(Value::Bool(run), origin, now)),
    );
    let all = pending.gate.priorities(DriveIndex::new(drive));
    all.ask(&write);
    all.settle(write.id, Settled::Done, now);
}

fn stands(pending: &mut Pending, drive: usize) -> Vec<u8> {
    let all = pending.gate.priorities(DriveIndex::new(drive));
    (1..=16)
        .filter(|priority| all.entry(Commanded::Run, *priority).is_some())
        .collect()
}

fn order(kind: SourceKind, drive: usize, run: bool, now: Instant) -> (Command, Receiver<Answer>) {
    let stats = Arc::default();
    let (ticket, receiver) = Ticket::new(Origin::new(kind, "x"), "d", String::new(), true, now, stats);
    let admitted = Admitted {
        order: points(&[1]),
        urgency: if run { Urgency::Command } else { Urgency::Stop },
        reference_only: false,
        ranges: Vec::new(),
    };
    let mut command = command(drive, admitted, now, ticket);
    command.intent.effects = Effects::on_one(DriveIndex::new(drive), effect(run), Touched::Anything);
    (command, receiver)
}

#[test]
fn a_start_is_judged_when_it_is_accepted_and_a_stop_passes() {
    let mut rig = Clients::new();
    let now = rig.now;
    stand(&mut rig.pending, 1, 3, false, now);
    let (start, mut answer) = order(SourceKind::Mqtt, 1, true, now);
    rig.pending.push(start, &(), now);
    let refused = outcome(&mut answer).unwrap();
    assert_eq!(refused.code(), "held_by_other");
    assert!(refused.to_string().contains("10.0.0.5"), "{refused}");
    let (elsewhere, mut answer) = order(SourceKind::Mqtt, 2, true, now);
    rig.pending.push(elsewhere, &(), now);
    assert_eq!(outcome(&mut answer), None, "another drive");
    for kind in [SourceKind::Mqtt, SourceKind::Supervision] {
        let (stop, mut answer) = order(kind, 1, false, now);
        rig.pending.push(stop, &(), now);
        assert_eq!(outcome(&mut answer), None);
    }
    assert_eq!(
        rig.pending.gate.priorities(DriveIndex::new(1)).orders(),
        2,
        "what was refused is no order"
    );
}

#[test]
fn what_a_tool_sends_to_all_is_refused_for_one_and_its_stop_withdraws() {
    let mut rig = Clients::new();
    let now = rig.now;
    stand(&mut rig.pending, 1, 3, false, now);
    stand(&mut rig.pending, 2, 8, true, now);
    let broadcast = |run: bool| {
        let (ticket, answer) = ticket(&Arc::default(), now);
        let passed_on = PassedOn {
            may_write: true,
            first: false,
            frame: tokio::sync::oneshot::channel().0,
        };
        let effects = [1, 2].map(|drive| (DriveIndex::new(drive), effect(run))).to_vec();
        let effects = Effects::on_all(effects, Touched::Anything);
        let window = Window {
            arrival: Arrival::now(now),
            expires: now + EXPIRY,
            waits: false,
        };
        let order = Order::Write(RequestPdu::write_register(1, 0));
        let intent = Intent::new(Target::Address(0), order, effects, window);
        (Command::passed_on(intent, passed_on, ticket), answer)
    };
    let (start, mut answer) = broadcast(true);
    rig.pending.push(start, &(), now);
    assert_eq!(outcome(&mut answer).unwrap().code(), "held_by_other");
    assert_eq!(stands(&mut rig.pending, 2), [8]);
    let (stop, mut answer) = broadcast(false);
    rig.pending.push(stop, &(), now);
    assert_eq!(outcome(&mut answer), None);
    assert_eq!(
        (stands(&mut rig.pending, 1), stands(&mut rig.pending, 2)),
        (vec![3], vec![])
    );
}

#[test]
fn a_stop_that_another_bus_takes_over_withdraws_there() {
    let now = Instant::now();
    let (old, new) = (CommandQueue::new().unwrap(), Arc::new(CommandQueue::new().unwrap()));
    stand(&mut old.lock(), 3, 8, true, now);
    old.begin_handover(Vec::new(), now);
    let inheritance = old.lock().gate.inheritance(DriveIndex::new(3));
    new.lock().gate.inherit(DriveIndex::new(0), inheritance);
    old.hand_over(DriveIndex::new(3), &new, DriveIndex::new(0), now);
    assert_eq!(stands(&mut new.lock(), 0), [8]);
    let (stop, mut answer) = order(SourceKind::Mqtt, 3, false, now);
    old.submit(stop, &(), now);
    assert_eq!(outcome(&mut answer), None);
    assert_eq!(stands(&mut new.lock(), 0), Vec::<u8>::new());
}
