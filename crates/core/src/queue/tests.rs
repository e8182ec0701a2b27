use std::sync::Arc;
use std::time::Duration;

use tokio::sync::oneshot::Receiver;

use super::*;
use crate::order::{Admitted, Answer, Arrival, CommandLog, SourceKind, Ticket, Touched, Window};
use crate::testkit::{next_command, nx, ticket};
use drivegate_model::drive::{DriveIndex, PointIndex, Value};
use drivegate_proto::Table;

mod age;
mod order;
mod slots;
mod stops;

const EXPIRY: Duration = Duration::from_secs(2);

/// Commands of several clients, and the time.
struct Clients {
    pending: Pending,
    stats: Arc<CommandLog>,
    now: Instant,
}

fn points(points: &[usize]) -> Order {
    Order::Points(
        points
            .iter()
            .map(|p| (PointIndex::new(*p), Value::Bool(true)))
            .collect(),
    )
}

/// Registers of an order whose points each have a register of their own.
fn touched(order: &Order) -> Touched {
    match order {
        Order::Points(values) => Touched::These {
            sets: values
                .iter()
                .map(|(point, _)| (Table::Holding, point.place() as u16))
                .collect(),
            rests_on: Vec::new(),
        },
        _ => Touched::Anything,
    }
}

/// A command that arrived at `now` over a separate connection.
fn command(drive: usize, admitted: Admitted, now: Instant, ticket: Ticket) -> Command {
    let window = Window {
        arrival: Arrival::now(now),
        expires: now + EXPIRY,
        waits: false,
    };
    Command::new(DriveIndex::new(drive), admitted, &nx(), window, ticket)
}

impl Clients {
    fn new() -> Clients {
        Clients {
            pending: Pending::default(),
            stats: Arc::default(),
            now: Instant::now(),
        }
    }

    /// Gives an order of this client.
    fn give(
        &mut self,
        (kind, who): (SourceKind, &str),
        drive: usize,
        urgency: Urgency,
        order: Order,
        reference_only: bool,
    ) -> Receiver<Answer> {
        let origin = Origin::new(kind, who);
        let (ticket, receiver) = Ticket::new(origin, "d", String::new(), true, self.now, self.stats.clone());
        let admitted = Admitted {
            order,
            urgency,
            reference_only,
            ranges: Vec::new(),
        };
        let mut command = command(drive, admitted, self.now, ticket);
        command.intent.effects.touches = touched(&command.intent.order);
        self.pending.push(command, &(), self.now);
        receiver
    }

    fn push(&mut self, drive: usize, urgency: Urgency, of: &[usize], reference_only: bool) -> Receiver<Answer> {
        self.give((SourceKind::Mqtt, "t"), drive, urgency, points(of), reference_only)
    }

    fn push_from(&mut self, who: &str, drive: usize, of: &[usize]) -> Receiver<Answer> {
        self.give((SourceKind::Mqtt, who), drive, Urgency::Command, points(of), false)
    }

    /// When another waiting command may be sent.
    fn wakes(&mut self) -> Option<Instant> {
        let now = self.now;
        self.pending
            .next(Urgency::Command, now, &(), |_| Ready::Now, |_| false)
            .wake_at
    }

    fn take(&mut self) -> Option<Command> {
        next_command(&mut self.pending, Urgency::Read, self.now)
    }

    fn pop(&mut self) -> Option<(usize, Urgency)> {
        self.take().map(|c| (c.drive().unwrap().place(), c.urgency()))
    }

    /// All waiting commands in the order in which they would be sent: client, drive and first point.
    fn drain(&mut self) -> Vec<(String, usize, usize)> {
        let mut all = Vec::new();
        while let Some(command) = self.take() {
            let Order::Points(values) = &command.intent.order else {
                panic!("{command:?}")
            };
            all.push((
                command.ticket.origin().who.clone(),
                command.drive().unwrap().place(),
                values[0].0.place(),
            ));
        }
        all
    }
}

fn of(who: &str, drive: usize, point: usize) -> (String, usize, usize) {
    (who.to_string(), drive, point)
}

fn outcome(receiver: &mut Receiver<Answer>) -> Option<Outcome> {
    receiver.try_recv().ok().map(|a| a.outcome)
}

#[test]
fn no_number_of_a_command_is_used_twice_in_the_process() {
    let mut numbers = std::collections::BTreeSet::new();
    for _ in 0..3 {
        // A reload that restarts the bus gives it a new queue.
        let mut clients = Clients::new();
        for drive in 0..2 {
            clients.give((SourceKind::Mqtt, "a"), drive, Urgency::Command, points(&[1]), false);
        }
        numbers.extend(clients.pending.waiting.iter().map(|command| command.intent.number));
    }
    assert_eq!(numbers.len(), 6);
}

#[test]
fn stop_first_and_it_purges_its_drive() {
    let mut rig = Clients::new();
    let mut read = rig.push(1, Urgency::Read, &[], false);
    let mut run = rig.push(1, Urgency::Command, &[1], false);
    let mut other = rig.push(2, Urgency::Command, &[1], false);
    let _stop = rig.push(1, Urgency::Stop, &[1], false);
    assert_eq!(outcome(&mut run), Some(Outcome::Purged));
    assert_eq!((outcome(&mut read), outcome(&mut other)), (None, None));
    assert_eq!(rig.pop(), Some((1, Urgency::Stop)));
    assert_eq!(rig.pop(), Some((2, Urgency::Command)));
    assert_eq!(rig.pop(), Some((1, Urgency::Read)));
    assert_eq!(rig.pop(), None);
}

#[test]
fn newer_references_replace_older_ones_of_the_same_points() {
    let mut rig = Clients::new();
    let mut old = rig.push(1, Urgency::Command, &[7], true);
    let mut other_point = rig.push(1, Urgency::Command, &[8], true);
    let mut other_drive = rig.push(2, Urgency::Command, &[7], true);
    let _new = rig.push(1, Urgency::Command, &[7], true);
    assert_eq!(outcome(&mut old), Some(Outcome::Replaced));
    assert_eq!((outcome(&mut other_point), outcome(&mut other_drive)), (None, None));
    assert_eq!(rig.pending.len(), 3);
}

#[test]
fn a_newer_reference_takes_the_place_of_the_older_one() {
    let mut rig = Clients::new();
    let reference = |rig: &mut Clients, percent: f64| {
        let order = Order::Points(vec![(PointIndex::new(7), Value::Number(percent))]);
        rig.give((SourceKind::Mqtt, "t"), 1, Urgency::Command, order, true)
    };
    let mut old = reference(&mut rig, 10.0);
    let _run = rig.push(1, Urgency::Command, &[1], false);
    let mut new = reference(&mut rig, 12.0);
    assert_eq!(outcome(&mut old), Some(Outcome::Replaced));
    assert_eq!(outcome(&mut new), None);
    let sent: Vec<Order> = std::iter::from_fn(|| rig.take()).map(|c| c.intent.order).collect();
    let wanted = Order::Points(vec![(PointIndex::new(7), Value::Number(12.0))]);
    assert_eq!(
        sent,
        [wanted, points(&[1])],
        "before the run that followed the older one"
    );
    // A newer reference of another client replaces an older one, too: the last writer counts.
    let mut old = reference(&mut rig, 10.0);
    let order = Order::Points(vec![(PointIndex::new(7), Value::Number(15.0))]);
    let _new = rig.give((SourceKind::ModbusTcp, "10.0.0.1:1"), 1, Urgency::Command, order, true);
    assert_eq!(outcome(&mut old), Some(Outcome::Replaced));
    assert_eq!(rig.pending.len(), 1);
}

#[test]
fn to_one_drive_it_is_the_order_of_acceptance_whoever_the_client_is() {
    let mut rig = Clients::new();
    // The first client was served last, so the others would be next.
    let _served = rig.push_from("a", 9, &[0]);
    assert!(rig.take().is_some());
    let _all = [("a", 1), ("b", 2), ("a", 3), ("c", 4)].map(|(who, point)| rig.push_from(who, 1, &[point]));
    assert_eq!(
        rig.drain(),
        [of("a", 1, 1), of("b", 1, 2), of("a", 1, 3), of("c", 1, 4)]
    );
}

#[test]
fn later_commands_wait_behind_the_oldest_of_their_drive_that_cannot_begin() {
    let mut rig = Clients::new();
    let _all = [(1, 1), (1, 2), (2, 3)].map(|(drive, point)| rig.push_from("t", drive, &[point]));
    let mut asked = Vec::new();
    let chosen = rig.pending.next(
        Urgency::Command,
        rig.now,
        &(),
        |command: &Command| {
            asked.push(command.intent.order.clone());
            if command.intent.target == DriveIndex::new(1) {
                Ready::No
            } else {
                Ready::Now
            }
        },
        |_| false,
    );
    assert_eq!(asked, [points(&[1]), points(&[3])], "the second one is not asked for");
    let command = rig.pending.take(chosen.chosen.unwrap()).unwrap();
    assert_eq!(command.intent.order, points(&[3]));
    assert_eq!(rig.drain(), [of("t", 1, 1), of("t", 1, 2)]);
}

#[test]
fn what_was_chosen_and_is_gone_is_not_taken() {
    let mut rig = Clients::new();
    let mut run = rig.push(1, Urgency::Command, &[1], false);
    let chosen = rig
        .pending
        .next(Urgency::Command, rig.now, &(), |_| Ready::Now, |_| false);
    let _stop = rig.push(1, Urgency::Stop, &[1], false);
    assert_eq!(outcome(&mut run), Some(Outcome::Purged));
    assert!(rig.pending.take(chosen.chosen.unwrap()).is_none());
    assert_eq!(rig.pop(), Some((1, Urgency::Stop)));
}

#[test]
fn a_full_queue_refuses_commands_and_reads() {
    let mut rig = Clients::new();
    let mut waiting: Vec<_> = (0..CAPACITY)
        .map(|_| rig.push(1, Urgency::Command, &[1], false))
        .collect();
    for urgency in [Urgency::Command, Urgency::Read] {
        let mut refused = rig.push(1, urgency, &[1], false);
        assert_eq!(outcome(&mut refused), Some(Outcome::QueueFull));
    }
    assert!(waiting.iter_mut().all(|w| outcome(w).is_none()));
    assert_eq!(rig.pending.len(), CAPACITY);
}

#[test]
fn clients_take_turns_and_each_keeps_its_order() {
    let mut rig = Clients::new();
    let mut flood: Vec<_> = (0..CAPACITY).map(|i| rig.push_from("flood", 1, &[i])).collect();
    let mut quiet: Vec<_> = (0..3).map(|i| rig.push_from("quiet", 2, &[i])).collect();
    assert_eq!(rig.pending.len(), CAPACITY);
    assert_eq!(flood.iter_mut().filter_map(outcome).count(), 3, "the flood made room");
    assert!(quiet.iter_mut().all(|q| outcome(q).is_none()));
    let turns = rig.drain();
    let (flood, quiet) = (|point| of("flood", 1, point), |point| of("quiet", 2, point));
    assert_eq!(turns[..6], [flood(0), quiet(0), flood(1), quiet(1), flood(2), quiet(2)]);
    assert_eq!(turns[6..8], [flood(3), flood(4)]);
}

#[test]
fn a_flood_on_one_drive_takes_no_places_of_another() {
    let mut rig = Clients::new();
    let mut flood: Vec<_> = (0..CAPACITY).map(|i| rig.push_from("a", 1, &[i])).collect();
    let mut other: Vec<_> = (0..CAPACITY).map(|i| rig.push_from("a", 2, &[i])).collect();
    let refused = |many: &mut Vec<Receiver<Answer>>| many.iter_mut().filter_map(outcome).count();
    assert_eq!((refused(&mut flood), refused(&mut other)), (CAPACITY / 2, CAPACITY / 2));
    assert!(outcome(&mut flood[0]).is_none() && outcome(&mut other[0]).is_none());
    assert_eq!(rig.pending.len(), CAPACITY);
}

#[test]
fn within_a_client_its_drives_take_turns() {
    let mut rig = Clients::new();
    let _many: Vec<_> = (0..3).map(|i| rig.push_from("a", 1, &[i])).collect();
    let _few: Vec<_> = (0..2).map(|i| rig.push_from("a", 2, &[i])).collect();
    let _other = rig.push_from("b", 3, &[0]);
    assert_eq!(
        rig.drain(),
        [
            of("a", 1, 0),
            of("b", 3, 0),
            of("a", 2, 0),
            of("a", 1, 1),
            of("a", 2, 1),
            of("a", 1, 2)
        ]
    );
}

#[test]
fn many_clients_get_equal_places() {
    let mut rig = Clients::new();
    let mut all: Vec<(usize, Receiver<Answer>)> = Vec::new();
    for round in 0..CAPACITY {
        for client in 0..4 {
            all.push((client, rig.push_from(&client.to_string(), client, &[round])));
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
fn nobody_is_overtaken_without_a_bound() {
    let mut rig = Clients::new();
    let _served = rig.push_from("old", 1, &[0]);
    assert!(rig.take().is_some());
    let _old = rig.push_from("old", 1, &[1]);
    // Commands of new clients are sent before this order, one after the other, up to the limit.
    let mut turns = 0;
    loop {
        let _new = rig.push_from(&format!("new {turns}"), 2, &[2]);
        if rig.take().unwrap().intent.target == DriveIndex::new(1) {
            break;
        }
        turns += 1;
        assert!(turns <= CAPACITY, "it waits for ever");
    }
    assert_eq!(turns, CAPACITY);
}

#[test]
fn before_the_end_only_stops_get_in() {
    let queue = CommandQueue::new().unwrap();
    let mut rig = Clients::new();
    let mut waiting = rig.push(2, Urgency::Command, &[1], false);
    let mut stops = rig.push(3, Urgency::Stop, &[1], false);
    std::mem::swap(&mut *queue.lock(), &mut rig.pending);
    let deadline = rig.now + Duration::from_secs(3);
    let mut missing = queue.begin_shutdown(deadline, rig.now);
    std::mem::swap(&mut *queue.lock(), &mut rig.pending);
    assert_eq!(
        (outcome(&mut waiting), outcome(&mut stops)),
        (Some(Outcome::ShuttingDown), None)
    );
    let mut run = rig.push(1, Urgency::Command, &[1], false);
    let mut stop = rig.push(1, Urgency::Stop, &[1], false);
    assert_eq!(
        (outcome(&mut run), outcome(&mut stop)),
        (Some(Outcome::ShuttingDown), None)
    );
    let stopping = rig.pending.take_stopping().unwrap();
    assert!(rig.pending.take_stopping().is_none(), "once");
    assert_eq!(stopping.deadline(), deadline);
    let one = NotStopped {
        drive: "one".to_string(),
        why: "did not acknowledge its stop".to_string(),
    };
    stopping.report(vec![one.clone()]);
    assert_eq!(missing.try_recv(), Ok(vec![one]));
}

/// The end of the gateway waits for stops of clients that wait or are begun, not for those of the gateway itself.
#[test]
fn the_queue_does_not_close_at_the_end_before_the_stops_of_clients_are_done() {
    let queue = CommandQueue::new().unwrap();
    let mut rig = Clients::new();
    let closes = |rig: &mut Clients| {
        std::mem::swap(&mut *queue.lock(), &mut rig.pending);
        let closed = queue.close_after_stops(rig.now);
        std::mem::swap(&mut *queue.lock(), &mut rig.pending);
        closed
    };
    let stop = |rig: &mut Clients, kind, drive| rig.give((kind, "t"), drive, Urgency::Stop, points(&[1]), false);
    let mut own = stop(&mut rig, SourceKind::Shutdown, 1);
    let mut of_client = stop(&mut rig, SourceKind::Mqtt, 2);
    assert!(!closes(&mut rig), "the stop waits");
    let own_begun = rig.take().unwrap();
    let begun = rig.take().unwrap();
    assert_eq!(
        (own_begun.drive(), begun.drive()),
        (Some(DriveIndex::new(1)), Some(DriveIndex::new(2)))
    );
    assert!(!closes(&mut rig), "the stop is begun");
    rig.pending.settle_stops(|drive| drive == DriveIndex::new(1));
    assert_eq!((outcome(&mut own), outcome(&mut of_client)), (None, None));
    assert!(closes(&mut rig), "only the gateway's own stop is left");
    let mut late = stop(&mut rig, SourceKind::Mqtt, 3);
    assert_eq!(outcome(&mut late), Some(Outcome::ShuttingDown));
}

#[test]
fn expired_commands_are_never_sent_and_a_stop_does_not_expire() {
    let mut rig = Clients::new();
    let mut late = rig.push(1, Urgency::Command, &[1], false);
    let mut stop = rig.push(2, Urgency::Stop, &[1], false);
    rig.now += 10 * EXPIRY;
    assert_eq!(rig.pop(), Some((2, Urgency::Stop)));
    assert_eq!(rig.pop(), None);
    assert_eq!(outcome(&mut late), Some(Outcome::Expired));
    assert_ne!(outcome(&mut stop), Some(Outcome::Expired));
}

#[test]
fn a_closed_queue_answers_at_once() {
    let queue = CommandQueue::new().unwrap();
    let mut rig = Clients::new();
    let (ticket_a, mut a) = ticket(&rig.stats, rig.now);
    let admitted = |urgency| Admitted {
        order: Order::Points(Vec::new()),
        urgency,
        reference_only: false,
        ranges: Vec::new(),
    };
    let command = |urgency, ticket| self::command(0, admitted(urgency), rig.now, ticket);
    queue.submit(command(Urgency::Command, ticket_a), &(), rig.now);
    queue.close(Outcome::BusDown, rig.now);
    assert_eq!(outcome(&mut a), Some(Outcome::BusDown));
    for urgency in [Urgency::Command, Urgency::Stop] {
        let (ticket_b, mut b) = ticket(&rig.stats, rig.now);
        queue.submit(command(urgency, ticket_b), &(), rig.now);
        assert_eq!(outcome(&mut b), Some(Outcome::BusDown));
    }
    queue.open();
    let (ticket_c, mut c) = ticket(&rig.stats, rig.now);
    queue.submit(command(Urgency::Command, ticket_c), &(), rig.now);
    assert_eq!(outcome(&mut c), None);
    rig.now += Duration::from_secs(1);
}

#[test]
fn supervision_is_withdrawn_and_nothing_else() {
    let mut rig = Clients::new();
    let own = (SourceKind::Supervision, "supervision");
    let mut action = rig.give(own, 1, Urgency::Command, points(&[7]), false);
    let mut elsewhere = rig.give(own, 2, Urgency::Stop, points(&[1]), false);
    assert_eq!(
        rig.pending.client_waits_until(DriveIndex::new(1)),
        None,
        "no client is behind it"
    );
    let mut client = rig.push(1, Urgency::Command, &[1], false);
    let _read = rig.push(2, Urgency::Read, &[], false);
    assert_eq!(
        rig.pending.client_waits_until(DriveIndex::new(1)),
        Some(rig.now + EXPIRY)
    );
    assert_eq!(
        rig.pending.client_waits_until(DriveIndex::new(2)),
        None,
        "a read is no command"
    );
    rig.pending.withdraw_supervision(DriveIndex::new(1), rig.now);
    assert_eq!(outcome(&mut action), Some(Outcome::Withdrawn));
    assert_eq!((outcome(&mut elsewhere), outcome(&mut client)), (None, None));
    // A stop that a client has joined is the client's too.
    let mut stop = rig.give(own, 3, Urgency::Stop, points(&[1]), false);
    rig.now += EXPIRY / 2;
    let mut joined = rig.push(3, Urgency::Stop, &[1], false);
    assert_eq!(
        rig.pending.client_waits_until(DriveIndex::new(3)),
        Some(rig.now + EXPIRY),
        "as long as the client's own time"
    );
    rig.pending.withdraw_supervision(DriveIndex::new(3), rig.now);
    assert_eq!((outcome(&mut stop), outcome(&mut joined)), (None, None));
}

#[test]
fn the_login_that_commanded_last_is_kept_until_another_client_commands() {
    let mut rig = Clients::new();
    let commander = |rig: &Clients, drive| rig.pending.gate.commander(drive).map(ToString::to_string);
    let push = |rig: &mut Clients, kind, login: Option<&str>, urgency, reference_only| {
        let origin = Origin::new(kind, "c");
        let origin = login.map_or(origin.clone(), |login| origin.with_login(login.into()));
        let (ticket, _answer) = Ticket::new(origin, "d", String::new(), true, rig.now, rig.stats.clone());
        let admitted = Admitted {
            order: points(&[0]),
            urgency,
            reference_only,
            ranges: Vec::new(),
        };
        let command = command(1, admitted, rig.now, ticket);
        rig.pending.push(command, &(), rig.now);
    };
    use SourceKind::{Http, ModbusTcp, Shutdown, Supervision};
    use Urgency::{Read, Stop};
    let order = Urgency::Command;
    push(&mut rig, Http, Some("alice#1"), order, true);
    assert_eq!(commander(&rig, DriveIndex::new(1)).as_deref(), Some("alice#1"));
    assert_eq!(commander(&rig, DriveIndex::new(2)), None);
    // Reads and stops of the gateway itself are not commands of a client.
    push(&mut rig, ModbusTcp, None, Read, false);
    push(&mut rig, Supervision, None, Stop, false);
    push(&mut rig, Shutdown, None, Stop, false);
    assert_eq!(commander(&rig, DriveIndex::new(1)).as_deref(), Some("alice#1"));
    // A command is recorded whether it waits, replaces an older one, or joins another one.
    push(&mut rig, Http, Some("bob#2"), order, true);
    push(&mut rig, Http, Some("carol#3"), order, true);
    assert_eq!(commander(&rig, DriveIndex::new(1)).as_deref(), Some("carol#3"));
    push(&mut rig, Http, Some("bob#2"), Stop, false);
    push(&mut rig, Http, Some("alice#1"), Stop, false);
    assert_eq!(commander(&rig, DriveIndex::new(1)).as_deref(), Some("alice#1"));
    push(&mut rig, ModbusTcp, None, Stop, false);
    assert_eq!(commander(&rig, DriveIndex::new(1)), None);
    // A command that is not accepted does not count.
    rig.pending.closed = Some(Outcome::BusDown);
    push(&mut rig, Http, Some("alice#1"), Stop, false);
    assert_eq!(commander(&rig, DriveIndex::new(1)), None);
}
