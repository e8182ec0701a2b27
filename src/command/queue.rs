//! The command queue of a bus: bounded, ordered, with replacing, purging and expiry.

use std::collections::VecDeque;
use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use rustix::event::{EventfdFlags, eventfd};

use super::{Command, Order, Outcome, Urgency};

/// Commands that may wait on one bus.
pub const CAPACITY: usize = 64;

/// The waiting commands: pure, time is an argument.
#[derive(Debug, Default)]
pub struct Pending {
    waiting: VecDeque<Command>,
    /// Set when the queue takes nothing any more: the answer that every command gets.
    closed: Option<Outcome>,
    /// The gateway is about to stop: only stops get in.
    stops_only: bool,
    /// Clients in the order in which they were served, the last one last.
    served: VecDeque<String>,
    /// Drives for which a stop came in since the bus last asked, each once.
    stopped: Vec<usize>,
}

impl Pending {
    /// Takes a command in. A stop removes the queued run and reference commands of its drive; a newer
    /// reference takes the place of an older one. When 64 wait, a stop takes the place of the youngest command or
    /// forwarded read of the client that has the most of them; anything takes the place of the youngest of a client
    /// that has more waiting than its own client would have.
    pub fn push(&mut self, command: Command, now: Instant) {
        if let Some(outcome) = &self.closed {
            command.ticket.answer(outcome.clone(), now);
            return;
        }
        if self.stops_only && command.urgency != Urgency::Stop {
            command.ticket.answer(Outcome::ShuttingDown, now);
            return;
        }
        if command.urgency == Urgency::Stop {
            self.remove(now, &Outcome::Purged, |c| {
                c.drive == command.drive && c.urgency == Urgency::Command
            });
            if !self.stopped.contains(&command.drive) {
                self.stopped.push(command.drive);
            }
        }
        if command.reference_only {
            self.remove(now, &Outcome::Replaced, |c| {
                c.drive == command.drive && c.reference_only && same_points(&c.order, &command.order)
            });
        }
        if self.waiting.len() >= CAPACITY {
            match self.victim(&command).and_then(|index| self.waiting.remove(index)) {
                Some(victim) => victim.ticket.answer(Outcome::QueueFull, now),
                None => {
                    command.ticket.answer(Outcome::QueueFull, now);
                    return;
                }
            }
        }
        self.waiting.push_back(command);
    }

    /// Whose place a command takes in a full queue.
    fn victim(&self, command: &Command) -> Option<usize> {
        let held = |client: &str, least: Urgency| {
            let of_client = |c: &&Command| c.ticket.client() == client && c.urgency >= least;
            self.waiting.iter().filter(of_client).count()
        };
        let youngest = |least: Urgency| {
            let candidates = self.waiting.iter().enumerate().filter(|(_, c)| c.urgency >= least);
            candidates.max_by_key(|(index, c)| (held(c.ticket.client(), least), *index))
        };
        if command.urgency == Urgency::Stop
            && let Some((index, _)) = youngest(Urgency::Command)
        {
            return Some(index);
        }
        // Stops are never pushed out by less than a stop.
        let least = if command.urgency == Urgency::Stop {
            Urgency::Stop
        } else {
            Urgency::Command
        };
        let own = held(command.ticket.client(), Urgency::Stop) + 1;
        youngest(least)
            .filter(|(_, c)| held(c.ticket.client(), least) > own)
            .map(|(index, _)| index)
    }

    /// Drives for which a stop came in since the last call: nothing that was begun for them goes on, whatever becomes of
    /// the stop itself.
    pub fn take_stopped(&mut self) -> Vec<usize> {
        std::mem::take(&mut self.stopped)
    }

    /// Rank of the command that would come next of those that `may`, expired ones answered and removed.
    pub fn next_urgency(&mut self, now: Instant, mut may: impl FnMut(&Command) -> bool) -> Option<Urgency> {
        self.remove(now, &Outcome::Expired, |c| c.expires <= now);
        self.waiting.iter().filter(|c| may(c)).map(|c| c.urgency).min()
    }

    /// Takes the next command of at least that rank: of the highest rank, the oldest of the client that was served
    /// longest ago.
    pub fn pop(&mut self, at_least: Urgency, now: Instant) -> Option<Command> {
        self.pop_of(at_least, now, |_| true)
    }

    /// As [`Pending::pop`], of those that `may`.
    pub fn pop_of(
        &mut self,
        at_least: Urgency,
        now: Instant,
        mut may: impl FnMut(&Command) -> bool,
    ) -> Option<Command> {
        let urgency = self.next_urgency(now, &mut may).filter(|u| *u <= at_least)?;
        let served = |c: &Command| self.served.iter().position(|s| s == c.ticket.client());
        let of_rank = self
            .waiting
            .iter()
            .enumerate()
            .filter(|(_, c)| c.urgency == urgency && may(c));
        // `None`, never served, comes before any place.
        let (index, _) = of_rank.min_by_key(|(index, c)| (served(c), *index))?;
        let command = self.waiting.remove(index)?;
        let client = command.ticket.client();
        self.served.retain(|s| s != client);
        // Only clients that wait are told apart; more of them than commands can wait there are not.
        if self.served.len() >= CAPACITY {
            self.served.pop_front();
        }
        self.served.push_back(client.to_string());
        Some(command)
    }

    /// Answers and removes the commands that `which` names.
    pub fn remove(&mut self, now: Instant, outcome: &Outcome, which: impl Fn(&Command) -> bool) {
        let mut kept = VecDeque::with_capacity(self.waiting.len());
        for command in self.waiting.drain(..) {
            if which(&command) {
                command.ticket.answer(outcome.clone(), now);
            } else {
                kept.push_back(command);
            }
        }
        self.waiting = kept;
    }

    /// Commands that wait.
    pub fn len(&self) -> usize {
        self.waiting.len()
    }

    /// Commands that wait to write, forwarded reads left out.
    pub fn writes(&self) -> usize {
        self.waiting.iter().filter(|c| c.urgency < Urgency::Read).count()
    }

    /// Whether none waits.
    pub fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }
}

fn same_points(older: &Order, newer: &Order) -> bool {
    match (older, newer) {
        (Order::Points(a), Order::Points(b)) => {
            a.len() == b.len() && a.iter().zip(b).all(|((left, _), (right, _))| left == right)
        }
        _ => false,
    }
}

/// The queue between the north sides and one bus.
#[derive(Debug)]
pub struct CommandQueue {
    pending: Mutex<Pending>,
    wake: OwnedFd,
}

impl CommandQueue {
    /// An empty queue.
    ///
    /// # Errors
    /// When the system gives no event descriptor.
    pub fn new() -> io::Result<CommandQueue> {
        let wake = eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?;
        Ok(CommandQueue {
            pending: Mutex::default(),
            wake,
        })
    }

    /// Takes a command in and wakes the bus.
    pub fn submit(&self, command: Command, now: Instant) {
        self.lock().push(command, now);
        self.wake();
    }

    /// The waiting commands, for the bus.
    pub fn lock(&self) -> MutexGuard<'_, Pending> {
        self.pending.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Answers everything that waits, and all that comes from now on, with `outcome`.
    pub fn close(&self, outcome: Outcome, now: Instant) {
        let mut pending = self.lock();
        pending.remove(now, &outcome, |_| true);
        pending.closed = Some(outcome);
    }

    /// From now on only stops get in: the gateway is about to stop, and nothing may start a drive again. What waits
    /// is answered, stops apart.
    pub fn stops_only(&self, now: Instant) {
        let mut pending = self.lock();
        pending.remove(now, &Outcome::ShuttingDown, |c| c.urgency != Urgency::Stop);
        pending.stops_only = true;
    }

    /// Takes commands again.
    pub fn open(&self) {
        self.lock().closed = None;
    }

    /// Wakes the bus from its wait.
    pub fn wake(&self) {
        // A full counter means that the bus is being woken already.
        let _ = rustix::io::write(&self.wake, &1u64.to_ne_bytes());
    }

    /// Readable when the bus is to look at the queue.
    pub fn wake_fd(&self) -> BorrowedFd<'_> {
        self.wake.as_fd()
    }

    /// Clears the wake-up.
    pub fn clear_wake(&self) {
        let mut count = [0u8; 8];
        // Nothing to read means that nobody woke the bus.
        let _ = rustix::io::read(&self.wake, &mut count);
    }
}

#[cfg(test)]
mod tests {
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
            let origin = Origin::new(SourceKind::Mqtt, who);
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
}
