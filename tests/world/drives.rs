//! The true state of a drive, as seen on its line and inside it, and the expectations that follow from it.

use std::collections::{HashMap, VecDeque};
use std::time::{Duration, Instant};

use drivegate_core::order::written;
use drivegate_proto::{RequestPdu, Table};

use super::orders::{Unique, sets};

/// Acts of a drive that are remembered.
const KEPT: usize = 400;

/// The true state of a drive in a world.
#[derive(Debug)]
pub struct Truth {
    /// The run command as it is in the drive.
    pub run: bool,
    /// Time until which a run command may be sent; `None` after a stop.
    pub may_run: Option<Instant>,
    /// End of the open orders that may change the run command to the opposite: stops, resets.
    pub last_stop_over: Option<Instant>,
    /// Only orders after this place may still be sent, apart from stops.
    pub last_place: usize,
    /// The last order with these words; the words repeat after several thousand orders.
    pub uniques: HashMap<Unique, usize>,
    /// Requests that the drive carried out, with the words of its replies.
    pub acts: VecDeque<(Instant, RequestPdu, Option<Vec<u16>>)>,
    /// Values that orders set last, as the drive took them.
    pub ordered: HashMap<(Table, u16), u16>,
    /// The run command was written last, by an order or again.
    pub fed: Option<Instant>,
    /// The last write that the drive's own timeout counts.
    pub counted: Option<Instant>,
    /// The drive tripped by its own timeout last.
    pub timed_out: Option<Instant>,
    /// When another master wrote the word that the drive has, unless an order or a refresh overwrote the word.
    pub foreign: Option<Instant>,
    /// The last write of an order.
    pub commanded: Option<Instant>,
    /// Time since which the motor runs by the bus.
    pub obeys_since: Option<Instant>,
    /// When the drive last was not under its local control.
    pub remote_at: Option<Instant>,
    /// When an order started the motor, if nothing has stopped it since.
    pub ran_by_order: Option<Instant>,
    /// When an order to the drive last waited.
    pub waited_until: Option<Instant>,
    /// The latest time at which a client was certainly alive, and the latest at which it may have been.
    pub heard: (Option<Instant>, Option<Instant>),
    /// Time since which the motor runs.
    pub running_since: Option<Instant>,
    pub ran_at: Option<Instant>,
    /// When the motor last turned, whether or not anything noticed.
    pub turned_at: Option<Instant>,
    /// Time since which the drive is online in the image.
    pub online_since: Option<Instant>,
    /// When supervision last acted.
    pub supervised: Option<Instant>,
    /// Time until which a disturbance of the drive excuses deviations.
    pub troubled_until: Option<Instant>,
    /// The bus was restarted: until this time that excuses some deviations.
    pub found_anew_until: Option<Instant>,
    /// When the word of the control register was changed by something other than the line.
    pub lost_word: Option<Instant>,
    /// The last order of a client that stops the drive.
    pub last_stop: Option<usize>,
    /// When a write that takes the drive's run command away was last on the wire.
    pub stop_sent: Option<Instant>,
    /// The action of supervision that was last on the wire, if nothing else was written since.
    pub action: Option<Tried>,
    /// The last write that the drive did as told, refreshes apart, was an action of supervision.
    pub acted: bool,
    /// Time until which a stop that the broker delivered again may be in progress.
    pub repeated_until: Option<Instant>,
    /// When a request to the drive was last on the wire.
    pub asked: Option<Instant>,
    /// Time since which the drive is offline in the image.
    pub offline_since: Option<Instant>,
    /// When the bus was restarted while the motor ran; the lease counts from then.
    pub carried: Option<Instant>,
    /// Maximum frequency in Hz, with the time from which it applies.
    pub maxima: Vec<(Instant, f64)>,
}

/// A write that is repeated until it is answered.
#[derive(Debug)]
pub struct Tried {
    pub pdu: RequestPdu,
    pub began: Instant,
    pub last: Instant,
    pub tries: u32,
}

impl Truth {
    /// Since when an action has been on the wire of which this write, at `now`, is an attempt. After it was given
    /// up, it comes again a second later as a new one.
    pub fn action_began(&mut self, pdu: &RequestPdu, retries: u32, now: Instant) -> Instant {
        let new = Tried {
            pdu: pdu.clone(),
            began: now,
            last: now,
            tries: 0,
        };
        let goes_on =
            |tried: &Tried| tried.pdu == *pdu && tried.tries <= retries && now - tried.last < Duration::from_secs(1);
        let action = self.action.take().filter(goes_on).unwrap_or(new);
        let action = self.action.insert(action);
        (action.last, action.tries) = (now, action.tries + 1);
        action.began
    }

    pub fn new(maximum: Option<(Instant, f64)>) -> Truth {
        Truth {
            run: false,
            may_run: None,
            last_stop_over: None,
            last_place: 0,
            uniques: HashMap::new(),
            acts: VecDeque::new(),
            ordered: HashMap::new(),
            fed: None,
            counted: None,
            timed_out: None,
            foreign: None,
            commanded: None,
            obeys_since: None,
            remote_at: None,
            ran_by_order: None,
            waited_until: None,
            heard: (None, None),
            running_since: None,
            ran_at: None,
            turned_at: None,
            online_since: None,
            supervised: None,
            troubled_until: None,
            found_anew_until: None,
            lost_word: None,
            last_stop: None,
            stop_sent: None,
            action: None,
            acted: false,
            repeated_until: None,
            asked: None,
            offline_since: None,
            carried: None,
            maxima: maximum.into_iter().collect(),
        }
    }

    /// The last order that sets a word of this write to a value that only that order writes.
    pub fn order_of(&self, pdu: &RequestPdu) -> Option<usize> {
        let (table, items) = written(pdu)?;
        let tails = (0..items.len()).flat_map(|from| (from + 1..=items.len()).map(move |to| from..to));
        let unique = |range: std::ops::Range<usize>| {
            let part = items.get(range)?;
            let words = part.iter().map(|(_, word)| *word).collect();
            self.uniques.get(&(table, part.first()?.0, words)).copied()
        };
        tails.filter_map(unique).max()
    }

    pub fn act(&mut self, at: Instant, pdu: RequestPdu, words: Option<Vec<u16>>) {
        if self.acts.len() == KEPT {
            self.acts.pop_front();
        }
        self.acts.push_back((at, pdu, words));
    }

    /// Whether the drive did since `since` what `which` looks for.
    pub fn did(&self, since: Instant, which: impl Fn(&RequestPdu, Option<&Vec<u16>>) -> bool) -> bool {
        let forgotten = self.acts.len() == KEPT && self.acts.front().is_some_and(|(at, ..)| *at > since);
        forgotten
            || self
                .acts
                .iter()
                .rev()
                .take_while(|(at, ..)| *at >= since)
                .any(|(_, pdu, words)| which(pdu, words.as_ref()))
    }

    /// Whether the last write of these registers set exactly this, however long ago: stored values are written only
    /// when they change.
    pub fn was_set_last(&self, unique: &Unique) -> bool {
        let (table, address, _) = unique;
        let touches = |pdu: &RequestPdu| {
            written(pdu).is_some_and(|(of, items)| of == *table && items.iter().any(|(at, _)| at == address))
        };
        let last = self.acts.iter().rev().find(|(_, pdu, _)| touches(pdu));
        last.is_some_and(|(_, pdu, _)| sets(pdu, unique))
    }

    /// The gateway was killed, and a new one knows of no client.
    pub fn forget_the_gateway(&mut self, now: Instant) {
        self.ordered.clear();
        (self.heard, self.online_since, self.carried) = ((None, None), None, None);
        (self.ran_by_order, self.supervised, self.action) = (None, None, None);
        self.acted = false;
        self.trouble(now + AFTERMATH);
    }

    pub fn trouble(&mut self, until: Instant) {
        self.troubled_until = self.troubled_until.max(Some(until));
    }

    pub fn is_troubled(&self, since: Instant) -> bool {
        self.befell_since(since) || self.found_anew_until.is_some_and(|until| until >= since)
    }

    /// Whether something disturbed the drive or its line since then, apart from the gateway.
    pub fn befell_since(&self, since: Instant) -> bool {
        self.troubled_until.is_some_and(|until| until >= since)
    }

    pub fn heard_for_certain(&mut self, at: Instant) {
        self.heard.0 = self.heard.0.max(Some(at));
        self.heard.1 = self.heard.1.max(Some(at));
    }

    pub fn maybe_heard(&mut self, at: Instant) {
        self.heard.1 = self.heard.1.max(Some(at));
    }
}

/// Time for the consequences of an incident.
pub const AFTERMATH: Duration = Duration::from_secs(12);
