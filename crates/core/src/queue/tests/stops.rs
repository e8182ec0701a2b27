//! Stops: at most two of a drive wait, none is refused, and a redundant one has no precedence.

use super::*;
use drivegate_proto::{Reply, RequestPdu};

fn raw(value: u16) -> Order {
    Order::Write(RequestPdu::write_register(2000, value))
}

impl Clients {
    fn stop(&mut self, drive: usize, order: Order) -> Receiver<Answer> {
        self.give((SourceKind::Mqtt, "t"), drive, Urgency::Stop, order, false)
    }

    /// Takes the only waiting stop and answers it.
    fn sent(&mut self) -> Order {
        let stop = self.take().expect("a stop");
        assert!(self.pending.is_empty());
        let order = stop.intent.order.clone();
        stop.answer(&acknowledged(), self.now);
        order
    }

    fn next(&mut self, rank: Urgency, redundant: &[usize]) -> Option<(usize, Urgency)> {
        let chosen = self
            .pending
            .next(
                rank,
                self.now,
                &(),
                |_| Ready::Now,
                |drive| redundant.contains(&drive.place()),
            )
            .chosen?;
        assert_eq!(chosen.rank, rank);
        let command = self.pending.take(chosen)?;
        Some((command.drive().unwrap().place(), command.urgency()))
    }
}

fn acknowledged() -> Outcome {
    Outcome::Acknowledged(Reply::Written)
}

#[test]
fn equal_stops_join_the_one_that_waits() {
    for order in [points(&[1]), raw(0), points(&[1, 2])] {
        let mut rig = Clients::new();
        let (mut a, mut b) = (rig.stop(1, order.clone()), rig.stop(1, order.clone()));
        assert_eq!(rig.pending.len(), 1);
        assert_eq!((outcome(&mut a), outcome(&mut b)), (None, None));
        assert_eq!(rig.sent(), order);
        assert_eq!(
            (outcome(&mut a), outcome(&mut b)),
            (Some(acknowledged()), Some(acknowledged())),
            "they share its answer"
        );
    }
}

#[test]
fn a_bare_stop_and_one_that_does_more_are_both_sent_however_many_come() {
    let mut rig = Clients::new();
    let mut stops: Vec<_> = (0..100)
        .map(|k| rig.stop(1, if k % 2 == 0 { points(&[1]) } else { raw(0) }))
        .collect();
    assert_eq!(rig.pending.len(), 2);
    for sent in [points(&[1]), raw(0)] {
        let stop = rig.take().unwrap();
        assert_eq!(stop.intent.order, sent);
        stop.answer(&acknowledged(), rig.now);
    }
    assert!(stops.iter_mut().all(|stop| outcome(stop) == Some(acknowledged())));
}

#[test]
fn of_two_stops_that_do_different_things_the_newer_one_is_sent() {
    let mut rig = Clients::new();
    let mut older = rig.stop(1, raw(0));
    let mut newer = rig.stop(1, raw(2));
    assert_eq!(outcome(&mut older), Some(Outcome::Replaced));
    assert_eq!(outcome(&mut newer), None);
    assert_eq!(rig.sent(), raw(2));
    assert_eq!(outcome(&mut newer), Some(acknowledged()));
}

#[test]
fn whoever_waits_for_a_stop_hears_of_it_however_long_it_takes() {
    let mut rig = Clients::new();
    let mut first = rig.stop(1, points(&[1]));
    rig.now += EXPIRY / 2;
    let mut second = rig.stop(1, points(&[1]));
    rig.now += EXPIRY / 2;
    assert_eq!(rig.sent(), points(&[1]));
    assert_eq!(
        (outcome(&mut first), outcome(&mut second)),
        (Some(acknowledged()), Some(acknowledged()))
    );
}

#[test]
fn no_stop_is_refused_and_none_takes_the_place_of_a_command() {
    let mut rig = Clients::new();
    let mut stops: Vec<_> = (0..3 * CAPACITY).map(|drive| rig.stop(drive, points(&[1]))).collect();
    let mut commands: Vec<_> = (0..CAPACITY)
        .map(|_| rig.push(1000, Urgency::Command, &[1], false))
        .collect();
    assert!(commands.iter_mut().all(|c| outcome(c).is_none()), "stops do not count");
    let mut more = rig.push(1000, Urgency::Command, &[1], false);
    assert_eq!(outcome(&mut more), Some(Outcome::QueueFull));
    stops.extend((0..CAPACITY).map(|drive| rig.stop(2000 + drive, points(&[1]))));
    assert!(stops.iter_mut().all(|s| outcome(s).is_none()));
    assert!(commands.iter_mut().all(|c| outcome(c).is_none()), "none made room");
    assert_eq!(rig.pending.len(), 5 * CAPACITY);
}

#[test]
fn a_stop_that_tells_nothing_new_has_the_rank_of_a_command() {
    let mut rig = Clients::new();
    let _stop = rig.stop(1, points(&[1]));
    let _other = rig.stop(2, points(&[1]));
    assert_eq!(
        rig.next(Urgency::Stop, &[1]),
        Some((2, Urgency::Stop)),
        "any doubt keeps precedence"
    );
    assert_eq!(rig.next(Urgency::Stop, &[1]), None);
    assert_eq!(rig.next(Urgency::Command, &[1]), Some((1, Urgency::Stop)));
    // A run command that waits behind the stop may start the motor; a reference does not.
    for (reference_only, rank) in [(false, Urgency::Stop), (true, Urgency::Command)] {
        let _stop = rig.stop(1, points(&[1]));
        let _behind = rig.push(1, Urgency::Command, &[7], reference_only);
        assert_eq!(rig.next(rank, &[1]), Some((1, Urgency::Stop)));
        assert_eq!(
            rig.next(Urgency::Command, &[1]),
            Some((1, Urgency::Command)),
            "behind the stop"
        );
    }
}

#[test]
fn redundant_stops_take_turns_with_the_commands_of_others() {
    let mut rig = Clients::new();
    let _stop = rig.stop(1, points(&[1]));
    assert_eq!(rig.next(Urgency::Command, &[1]), Some((1, Urgency::Stop)));
    for _ in 0..10 {
        let _again = rig.stop(1, points(&[1]));
        let _run = rig.push_from("other", 2, &[1]);
        assert_eq!(rig.next(Urgency::Command, &[1]), Some((2, Urgency::Command)));
        assert_eq!(rig.next(Urgency::Command, &[1]), Some((1, Urgency::Stop)));
    }
}
