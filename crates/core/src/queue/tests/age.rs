//! Orders that arrived while the threads that read were not running: orders of several clients, read in any sequence.

use super::*;
use crate::order::{Arrival, Connection, Effect, Effects};
use crate::stalls::Stall;

const MS: Duration = Duration::from_millis(1);

/// Order of a client to drive 1.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Gives {
    Run,
    Reference,
    Stop,
}
use Gives::{Reference, Run, Stop};

struct Bench {
    rig: Clients,
    began: Instant,
    stall: Stall,
    connections: [Connection; 2],
}

impl Bench {
    /// A bench whose reader of two connections did not run for this time, until now.
    fn after(stood: Duration) -> Bench {
        let mut rig = Clients::new();
        let began = rig.now;
        rig.now += stood;
        let stall = Stall::new(began, rig.now);
        Bench {
            rig,
            began,
            stall,
            connections: [Connection::opened(began), Connection::opened(began)],
        }
    }

    /// The reader reads an order that arrived during the stall over this connection.
    fn reads(&mut self, connection: usize, gives: Gives) -> Receiver<Answer> {
        let arrival = Arrival {
            asked: self.began,
            connection: self.connections[connection].clone(),
            stall: Some(self.stall),
            pause: Some(self.stall).filter(Stall::is_pause),
        };
        self.takes(gives, arrival)
    }

    fn takes(&mut self, gives: Gives, arrival: Arrival) -> Receiver<Answer> {
        let rig = &mut self.rig;
        let (ticket, receiver) = ticket(&rig.stats, rig.now);
        let admitted = Admitted {
            order: points(&[1]),
            urgency: if gives == Stop { Urgency::Stop } else { Urgency::Command },
            reference_only: gives == Reference,
            ranges: Vec::new(),
        };
        let drive = DriveIndex::new(1);
        let mut command = command(1, admitted, arrival.asked, ticket);
        let effect = Effect {
            stops: gives == Stop,
            run: (gives != Reference).then_some(gives == Run),
            reference: gives == Reference,
            ..Effect::default()
        };
        command.intent.effects = Effects::on_one(drive, effect, Touched::Anything);
        command.intent.window.arrival = arrival;
        rig.pending.push(command, &(), rig.now);
        receiver
    }

    /// Orders sent up to this time after the stall, in sequence.
    fn sent(&mut self, after: Duration) -> Vec<Urgency> {
        self.rig.now = self.stall.ended + after;
        std::iter::from_fn(|| self.rig.pop())
            .map(|(_, urgency)| urgency)
            .collect()
    }
}

/// Two orders that arrived during a stall, in the sequence in which they are read, with the connection of each;
/// their results, and what is sent 300 ms after the stall.
#[test]
fn a_stop_wins_over_what_came_with_it_over_other_connections() {
    let (sent, purged, expired) = ("", "purged", "expired");
    let stop = &[Urgency::Stop][..];
    let (both, command) = (&[Urgency::Stop, Urgency::Command][..], &[Urgency::Command][..]);
    let (short, long) = (200 * MS, 1500 * MS);
    for (stood, first, second, codes, is_sent) in [
        (short, (0, Run), (1, Stop), [purged, sent], stop),
        (short, (1, Stop), (0, Run), [sent, purged], stop),
        (short, (1, Stop), (0, Reference), [sent, purged], stop),
        (short, (0, Run), (0, Stop), [purged, sent], stop),
        (short, (0, Stop), (0, Run), [sent, sent], both),
        (short, (0, Run), (1, Reference), [sent, sent], &[Urgency::Command; 2]),
        (long, (0, Run), (1, Stop), [expired, sent], stop),
        (long, (1, Stop), (0, Run), [sent, purged], stop),
        (long, (0, Stop), (0, Run), [sent, expired], stop),
        (long, (0, Reference), (1, Run), [sent, expired], command),
        (3 * long, (0, Reference), (1, Stop), [expired, sent], stop),
    ] {
        let mut bench = Bench::after(stood);
        let mut answers = [first, second].map(|(connection, gives)| bench.reads(connection, gives));
        let what = format!("{stood:?}: {first:?}, {second:?}");
        assert_eq!(bench.sent(300 * MS), is_sent, "{what}");
        let codes_of = answers.each_mut().map(|answer| match outcome(answer) {
            // The command was taken from the queue for sending.
            None | Some(Outcome::ShuttingDown) => "",
            Some(outcome) => outcome.code(),
        });
        assert_eq!(codes_of, codes, "{what}");
    }
}

#[test]
fn a_start_waits_until_what_came_with_it_is_read() {
    let mut bench = Bench::after(200 * MS);
    let mut start = bench.reads(0, Run);
    let read_by = bench.stall.read_by();
    assert_eq!(bench.rig.wakes(), Some(read_by));
    assert_eq!(bench.sent(249 * MS), [], "a stop may be read yet");
    let _stop = bench.reads(1, Stop);
    assert_eq!(outcome(&mut start), Some(Outcome::Purged));
    let mut bench = Bench::after(200 * MS);
    let _start = bench.reads(0, Run);
    assert_eq!(bench.sent(250 * MS), [Urgency::Command]);
    assert_eq!(bench.rig.wakes(), None);
}

#[test]
fn what_waits_while_the_bus_stands_still_or_the_machine_sleeps_gets_older() {
    let mut bench = Bench::after(Duration::ZERO);
    let healthy = |bench: &Bench| Arrival::over(bench.connections[0].clone(), bench.rig.now);
    let arrival = healthy(&bench);
    let mut start = bench.takes(Run, arrival.clone());
    let mut reference = bench.takes(Reference, arrival);
    bench.rig.now += 1100 * MS;
    bench
        .rig
        .pending
        .gate
        .note_pause(Stall::new(bench.began, bench.rig.now));
    assert!(!bench.rig.pending.take_renewed(DriveIndex::new(1)));
    assert_eq!(bench.rig.pop(), Some((1, Urgency::Command)));
    assert_eq!(outcome(&mut start), Some(Outcome::Expired));
    assert!(outcome(&mut reference).is_none_or(|outcome| outcome == Outcome::ShuttingDown));
    assert!(
        bench.rig.pending.take_renewed(DriveIndex::new(1)),
        "its client was heard"
    );
    assert!(!bench.rig.pending.take_renewed(DriveIndex::new(1)));

    let mut bench = Bench::after(Duration::ZERO);
    let arrival = healthy(&bench);
    let mut asleep = bench.takes(Reference, arrival);
    bench.rig.pending.slept(EXPIRY);
    assert_eq!(bench.rig.pop(), None);
    assert_eq!(outcome(&mut asleep), Some(Outcome::Expired));
}

#[test]
fn what_a_client_gave_that_has_gone_since_is_not_sent() {
    for (gives, code) in [(Run, "expired"), (Reference, "expired"), (Stop, "")] {
        let mut bench = Bench::after(200 * MS);
        let mut answer = bench.reads(0, gives);
        bench.connections[0].hang_up();
        let sent = bench.sent(300 * MS);
        assert_eq!(sent.is_empty(), gives != Stop, "{gives:?}");
        let code_of = outcome(&mut answer).filter(|outcome| *outcome != Outcome::ShuttingDown);
        assert_eq!(code_of.map_or("", |outcome| outcome.code()), code, "{gives:?}");
    }
}
