//! Orders that the clients of a world placed for each machine, and the resulting state that must be reached.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

/// Longest time from sending an order to its last effect: an order is started at most 2 s after it was sent, and
/// its effect may take several transactions.
const WANTED: Duration = Duration::from_millis(3_500);
/// A client that closed its connection at least this long before the order was read has given up; a shorter time
/// cannot be noticed.
pub const UNNOTICED: Duration = Duration::from_millis(160);
/// A stall longer than this is a pause: orders sent before its end start nothing.
const PAUSE: Duration = Duration::from_millis(1_010);

/// Time within which a motor starts after the write that makes it run was sent.
const FOLLOWS: Duration = Duration::from_millis(400);

/// Time between a write and the reading on which it depends: one transaction.
const LOOKED: Duration = Duration::from_millis(60);

/// Writes of two rounds of the refresh, reference and word: before that, the speed does not show the stop of another
/// master.
const TWO_ROUNDS: usize = 4;

/// Effect of an order on a motor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Does {
    Run,
    Stop,
    /// The order starts nothing.
    Other,
}

#[derive(Debug, Clone, Copy)]
pub struct Order {
    pub connection: usize,
    pub machine: u8,
    pub does: Does,
    /// When the first byte of the order was sent.
    pub sent: Instant,
    /// When the last byte of the order was sent.
    pub complete: Instant,
    /// When the last byte of the order was read.
    pub read: Option<Instant>,
    /// When the client closed the connection, if before that.
    pub closed: Option<Instant>,
    /// When the order was answered, and with which exception, if any.
    pub answer: Option<(Instant, Option<u8>)>,
}

/// Orders of all clients, and actions of the drives.
pub struct Promised {
    pub orders: Vec<Order>,
    /// When each write that a drive carried out was sent to it.
    told: BTreeMap<u8, Vec<Instant>>,
    running: Vec<bool>,
    /// When each motor started last.
    started: BTreeMap<u8, Instant>,
    /// When each motor began to run before it stood last, and since when it stood.
    ran: BTreeMap<u8, (Instant, Instant)>,
    /// When each drive was last stopped by an incident and not by a command on the line.
    befell: BTreeMap<u8, Instant>,
}

impl Promised {
    pub fn new(drives: u8) -> Promised {
        Promised {
            orders: Vec::new(),
            told: BTreeMap::new(),
            running: vec![false; usize::from(drives)],
            started: BTreeMap::new(),
            ran: BTreeMap::new(),
            befell: BTreeMap::new(),
        }
    }

    /// A client begins to send an order.
    pub fn wants(&mut self, connection: usize, machine: u8, does: Does, now: Instant) -> usize {
        self.orders.push(Order {
            connection,
            machine,
            does,
            sent: now,
            complete: now,
            read: None,
            closed: None,
            answer: None,
        });
        self.orders.len() - 1
    }

    /// Notes that the last byte of the order was sent.
    pub fn complete(&mut self, id: usize, now: Instant) {
        self.orders[id].complete = now;
    }

    /// Notes that the gateway has read the whole order.
    pub fn read(&mut self, id: usize, now: Instant) {
        self.orders[id].read = Some(now);
    }

    /// Records that the client has closed the connection.
    pub fn closed(&mut self, id: usize, now: Instant) {
        self.orders[id].closed.get_or_insert(now);
    }

    /// Notes that the rest of the order will never be sent.
    pub fn never_sent(&mut self, id: usize) {
        self.orders[id].does = Does::Other;
    }

    pub fn answered(&mut self, id: usize, now: Instant, exception: Option<u8>) {
        assert!(self.orders[id].answer.is_none(), "order {id} was answered twice");
        self.orders[id].answer = Some((now, exception));
    }

    /// The drive has carried out a write that was sent at `at`.
    pub fn told(&mut self, machine: u8, at: Instant) {
        self.told.entry(machine).or_default().push(at);
    }

    /// The drive was stopped by something else than the line.
    pub fn befell(&mut self, machine: u8, now: Instant) {
        self.befell.insert(machine, now);
    }

    /// Whether the drive was stopped by something else than the line since that time.
    pub fn befell_since(&self, machine: u8, at: Instant) -> bool {
        self.befell.get(&machine).is_some_and(|befell| *befell >= at)
    }

    /// Whether the motor of the machine has just started or stopped.
    pub fn runs(&mut self, machine: u8, running: bool, now: Instant) -> bool {
        let changed = std::mem::replace(&mut self.running[usize::from(machine) - 1], running) != running;
        if changed && running {
            self.started.insert(machine, now);
        } else if changed && let Some(started) = self.started.get(&machine) {
            self.ran.insert(machine, (*started, now));
        }
        changed
    }

    /// Whether the refresh could not know at `at` that another master had stopped the motor, where the drive does not show its
    /// word: the motor still turned at the last reading, and its speed was seen at the reference in fewer than two
    /// rounds before the stop.
    fn slowed_down_unseen(&self, machine: u8, at: Instant) -> bool {
        let (Some((started, stood)), Some(befell)) = (self.ran.get(&machine), self.befell.get(&machine)) else {
            return false;
        };
        let told = self.told.get(&machine).into_iter().flatten();
        let before = told.filter(|told| (started..=befell).contains(told)).count();
        (started..=stood).contains(&befell) && at.saturating_duration_since(*stood) < LOOKED && before < TWO_ROUNDS
    }

    /// Checks a motor that has started: a client must have wanted the causing write when it was sent. `hides_word`: the drive
    /// does not show its control word.
    pub fn must_want_start(&self, machine: u8, hides_word: bool, now: Instant) {
        let told = self.told.get(&machine).into_iter().flatten().rev();
        // The motor follows its drive after one or two updates.
        let told: Vec<Instant> = told.take_while(|at| now - **at < FOLLOWS).copied().collect();
        if !self.running[usize::from(machine) - 1] || told.iter().any(|at| self.is_wanted(machine, *at)) {
            return;
        }
        let at = told.first().copied().unwrap_or(now);
        // A reading just before showed that the motor runs, so a word that keeps the run bit is already being sent.
        if self
            .befell
            .get(&machine)
            .is_some_and(|befell| at.saturating_duration_since(*befell) < LOOKED)
        {
            return;
        }
        if hides_word && self.slowed_down_unseen(machine, at) {
            return;
        }
        let runs = self
            .orders
            .iter()
            .enumerate()
            .rev()
            .filter(|(_, order)| order.does == Does::Run);
        let why = runs.filter_map(|(id, order)| {
            let not = self.unwanted(id, order, machine, at)?;
            Some(format!("order {id} {not}: {order:?}"))
        });
        let why: Vec<String> = why.take(6).collect();
        panic!(
            "the motor of machine {machine} started, which nobody wants:\n{}",
            why.join("\n")
        );
    }

    fn is_wanted(&self, machine: u8, at: Instant) -> bool {
        let mut orders = self.orders.iter().enumerate().rev();
        orders.any(|(id, order)| order.does == Does::Run && self.unwanted(id, order, machine, at).is_none())
    }

    /// Why the order cannot be the cause of a run command to this machine that was sent at `at`.
    fn unwanted(&self, id: usize, order: &Order, machine: u8, at: Instant) -> Option<String> {
        let Some(read) = order.read.filter(|read| *read <= at) else {
            return Some("was not read yet".to_string());
        };
        if order.machine != machine {
            return Some("means another machine".to_string());
        }
        if let Some((answered, exception)) = order.answer.filter(|(answered, _)| *answered < at) {
            return Some(format!("was answered {exception:02X?} {:?} before", at - answered));
        }
        if at - order.sent > WANTED {
            return Some(format!("was sent {:?} before", at - order.sent));
        }
        let waited = read - order.complete;
        if order.closed.is_some_and(|closed| closed <= read) && waited > UNNOTICED {
            return Some("is of a client that has given up".to_string());
        }
        if waited > PAUSE {
            return Some(format!("lay unread for {waited:?}"));
        }
        let stops = self.orders.iter().enumerate();
        let mut stops = stops.filter(|(_, stop)| stop.does == Does::Stop && stop.machine == machine);
        let stopped = stops.find(|(place, stop)| {
            let later = if stop.connection == order.connection {
                *place > id
            } else {
                // A hiccup that is not noticed orders nothing across connections.
                let since = if waited > UNNOTICED { order.sent } else { read };
                stop.read.is_some_and(|stopped| stopped > since)
            };
            later && stop.read.is_some_and(|read| read < at)
        });
        stopped.map(|(place, _)| format!("was stopped by order {place}"))
    }
}
