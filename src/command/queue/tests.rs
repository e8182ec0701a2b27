use std::sync::Arc;
use std::time::Duration;

use tokio::sync::oneshot::Receiver;

use super::super::ticket::tests::ticket;
use super::super::{Answer, Origin, SourceKind, Ticket, WriteStats};
use super::*;
use crate::drive::Value;

struct Bench {
    pending: Pending,
    stats: Arc<WriteStats>,
    now: Instant,
}

impl Bench {
    fn new() -> Bench {
        Bench {
            pending: Pending::default(),
            stats: Arc::default(),
            now: Instant::now(),
        }
    }

    fn push(&mut self, drive: usize, urgency: Urgency, points: &[usize], reference_only: bool) -> Receiver<Answer> {
        let (ticket, receiver) = ticket(&self.stats, self.now);
        let order = Order::Points(points.iter().map(|p| (*p, Value::Bool(true))).collect());
        let expires = self.now + Duration::from_secs(2);
        self.pending.push(
            Command {
                drive,
                order,
                urgency,
                reference_only,
                expires,
                ticket,
            },
            self.now,
        );
        receiver
    }

    fn push_from(&mut self, who: &str, drive: usize, points: &[usize]) -> Receiver<Answer> {
        let origin = Origin {
            kind: SourceKind::Mqtt,
            who: who.to_string(),
        };
        let (ticket, receiver) = Ticket::new(origin, "d", String::new(), true, self.now, self.stats.clone());
        let order = Order::Points(points.iter().map(|p| (*p, Value::Bool(true))).collect());
        let command = Command {
            drive,
            order,
            urgency: Urgency::Command,
            reference_only: false,
            expires: self.now + Duration::from_secs(2),
            ticket,
        };
        self.pending.push(command, self.now);
        receiver
    }

    fn pop(&mut self) -> Option<(usize, Urgency)> {
        self.pending.pop(Urgency::Read, self.now).map(|c| (c.drive, c.urgency))
    }
}

fn outcome(receiver: &mut Receiver<Answer>) -> Option<Outcome> {
    receiver.try_recv().ok().map(|a| a.outcome)
}

#[test]
fn stop_first_and_it_purges_its_drive() {
    let mut bench = Bench::new();
    let mut read = bench.push(1, Urgency::Read, &[], false);
    let mut run = bench.push(1, Urgency::Command, &[1], false);
    let mut other = bench.push(2, Urgency::Command, &[1], false);
    let _stop = bench.push(1, Urgency::Stop, &[1], false);
    assert_eq!(outcome(&mut run), Some(Outcome::Purged));
    assert_eq!((outcome(&mut read), outcome(&mut other)), (None, None));
    assert_eq!(bench.pop(), Some((1, Urgency::Stop)));
    assert_eq!(bench.pop(), Some((2, Urgency::Command)));
    assert_eq!(bench.pop(), Some((1, Urgency::Read)));
    assert_eq!(bench.pop(), None);
}

#[test]
fn newer_references_replace_older_ones_of_the_same_points() {
    let mut bench = Bench::new();
    let mut old = bench.push(1, Urgency::Command, &[7], true);
    let mut other_point = bench.push(1, Urgency::Command, &[8], true);
    let mut other_drive = bench.push(2, Urgency::Command, &[7], true);
    let _new = bench.push(1, Urgency::Command, &[7], true);
    assert_eq!(outcome(&mut old), Some(Outcome::Replaced));
    assert_eq!((outcome(&mut other_point), outcome(&mut other_drive)), (None, None));
    assert_eq!(bench.pending.len(), 3);
}

#[test]
fn full_queue_refuses_all_but_a_stop() {
    let mut bench = Bench::new();
    let mut waiting: Vec<_> = (0..CAPACITY)
        .map(|_| bench.push(1, Urgency::Command, &[1], false))
        .collect();
    let mut refused = bench.push(1, Urgency::Command, &[1], false);
    assert_eq!(outcome(&mut refused), Some(Outcome::QueueFull));
    let mut stop = bench.push(2, Urgency::Stop, &[1], false);
    assert_eq!(outcome(&mut stop), None);
    assert_eq!(
        outcome(waiting.last_mut().unwrap()),
        Some(Outcome::QueueFull),
        "the youngest made room"
    );
    assert_eq!(outcome(waiting.first_mut().unwrap()), None);
    assert_eq!(bench.pending.len(), CAPACITY);
    assert_eq!(bench.pop(), Some((2, Urgency::Stop)));
}

#[test]
fn clients_take_turns_and_each_keeps_its_order() {
    let mut bench = Bench::new();
    let mut flood: Vec<_> = (0..CAPACITY).map(|i| bench.push_from("flood", 1, &[i])).collect();
    let mut quiet: Vec<_> = (0..3).map(|i| bench.push_from("quiet", 2, &[i])).collect();
    assert_eq!(bench.pending.len(), CAPACITY);
    assert_eq!(flood.iter_mut().filter_map(outcome).count(), 3, "the flood made room");
    assert!(quiet.iter_mut().all(|q| outcome(q).is_none()));
    let popped: Vec<_> = (0..8)
        .map(|_| bench.pending.pop(Urgency::Read, bench.now).unwrap())
        .map(|c| (c.drive, c.order))
        .collect();
    let of = |drive: usize, point: usize| (drive, Order::Points(vec![(point, Value::Bool(true))]));
    assert_eq!(
        popped[..6],
        [of(1, 0), of(2, 0), of(1, 1), of(2, 1), of(1, 2), of(2, 2)]
    );
    assert_eq!(popped[6..], [of(1, 3), of(1, 4)]);
}

#[test]
fn many_clients_get_equal_places() {
    let mut bench = Bench::new();
    let mut all: Vec<(usize, Receiver<Answer>)> = Vec::new();
    for round in 0..CAPACITY {
        for client in 0..4 {
            all.push((client, bench.push_from(&client.to_string(), client, &[round])));
        }
    }
    for client in 0..4 {
        let waiting = all.iter_mut().filter(|(c, _)| *c == client);
        assert_eq!(
            waiting.filter_map(|(_, r)| outcome(r).is_none().then_some(())).count(),
            CAPACITY / 4
        );
    }
}

#[test]
fn before_the_end_only_stops_get_in() {
    let queue = CommandQueue::new().unwrap();
    let mut bench = Bench::new();
    std::mem::swap(&mut *queue.lock(), &mut bench.pending);
    queue.stops_only(bench.now);
    std::mem::swap(&mut *queue.lock(), &mut bench.pending);
    let mut run = bench.push(1, Urgency::Command, &[1], false);
    let mut stop = bench.push(1, Urgency::Stop, &[1], false);
    assert_eq!(
        (outcome(&mut run), outcome(&mut stop)),
        (Some(Outcome::ShuttingDown), None)
    );
}

#[test]
fn expired_commands_are_never_sent() {
    let mut bench = Bench::new();
    let mut late = bench.push(1, Urgency::Command, &[1], false);
    bench.now += Duration::from_secs(2);
    assert_eq!(bench.pop(), None);
    assert_eq!(outcome(&mut late), Some(Outcome::Expired));
}

#[test]
fn a_closed_queue_answers_at_once() {
    let queue = CommandQueue::new().unwrap();
    let mut bench = Bench::new();
    let (ticket_a, mut a) = ticket(&bench.stats, bench.now);
    let command = |ticket| Command {
        drive: 0,
        order: Order::Points(Vec::new()),
        urgency: Urgency::Command,
        reference_only: false,
        expires: bench.now + Duration::from_secs(1),
        ticket,
    };
    queue.submit(command(ticket_a), bench.now);
    queue.close(Outcome::BusDown, bench.now);
    assert_eq!(outcome(&mut a), Some(Outcome::BusDown));
    let (ticket_b, mut b) = ticket(&bench.stats, bench.now);
    queue.submit(command(ticket_b), bench.now);
    assert_eq!(outcome(&mut b), Some(Outcome::BusDown));
    bench.now += Duration::from_secs(1);
}
