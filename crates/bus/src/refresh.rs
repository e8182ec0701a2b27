//! The refresh of one drive: the last orders of its clients are written again at intervals, for a drive whose own
//! communication timeout counts only writes of its control word or reference. Pure: time is an argument.
//!
//! A refresh round first reads, then writes: the drive must show that it runs by the repeated word, or stands by a
//! stop, and that no other client has written to it. A contradiction ends the refresh, and only an acknowledged
//! order of a client starts it again. A refresh renews no lease, and does not count as an order or a start.

mod end;
mod ordered;
mod pace;
mod round;

use std::time::{Duration, Instant};

pub(crate) use self::end::End;
use self::ordered::{InForce, Ordered, in_force, reference_of};
use self::pace::Pace;
use self::round::Round;
pub(super) use self::round::requests;
use drivegate_core::order::written;
use drivegate_core::process_image::{Reading, RestoreLock};
use drivegate_model::drive::control::{Control, ControlItem};
use drivegate_model::drive::{ModelPoint, Profile, Repeats};
use drivegate_proto::{RequestPdu, Table};

/// Number of refresh intervals within which a drive that does not answer may return.
const PERIODS: u32 = 3;

/// Origin of the order that started a refresh.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Beginner {
    /// The order of a client, whose lease the refresh needs.
    Client,
    /// The order of a drill, which keeps the drive's timeout from acting until the drill goes silent to test it.
    Drill,
    /// The action of a lease that expired: it needs no lease.
    Action,
}

/// The state of a refresh in progress.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Going {
    does: InForce,
    /// When the order that started it ended: earlier reads are not valid.
    since: Instant,
    /// Stops of the drive that were accepted before.
    stops: u64,
    due: Instant,
    /// Whether the motor was seen to run by its run command, or to stand by its stop.
    seen: bool,
    /// Since when the drive has not answered, or its motor has slowed down without an order.
    lost: Option<Instant>,
    /// Speed of the motor in relation to its reference, where the word of the drive cannot be read.
    pace: Pace,
    /// Origin of the order that started the refresh.
    by: Beginner,
}

/// A refresh as it is handed over to the bus that replaces this one.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Repeated {
    ordered: Ordered,
    going: Option<Going>,
}

/// Result of an order, as far as a refresh depends on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum OrderEnd {
    /// A client's order was acknowledged by the drive.
    Done,
    /// A drill gave the order that ended.
    Drill,
    /// The speed reference of a lease that expired was.
    Action,
    /// The drive refused a step of the order, or its time was over before that: which part the drive took is known.
    Partly,
    /// Which part of the order the drive took is unknown.
    Unknown,
    /// An order of the gateway itself was sent to the drive.
    Other,
}

/// Facts about the drive besides its samples.
#[derive(Debug, Clone, Copy)]
pub(super) struct Around {
    /// Stops of the drive that were accepted so far.
    pub(super) stops: u64,
    /// Whether `min_run` delays the last stop.
    pub(super) delayed: bool,
    /// Whether the lease of the drive is running.
    pub(super) held: bool,
}

/// The refresh of one drive.
#[derive(Debug, Default)]
pub(super) struct Refresh {
    /// Interval of the refresh, and what is repeated; `None` if the drive is not refreshed.
    settings: Option<(Duration, Repeats)>,
    repeated: Repeated,
    round: Option<Round>,
    /// Stops that were accepted before the order that has started.
    stops: u64,
    /// Whether the order that has started decides whether the motor is to run.
    says_run: bool,
    /// The drive does not take word and reference in one request.
    apart: bool,
    /// Whether the lease ended the refresh: then only its action, or an order with a run command or stop, starts
    /// another one.
    by_lease: bool,
}

impl Refresh {
    /// The refresh of a drive of this profile, which has not started.
    pub(super) fn new(profile: &Profile, every: Option<Duration>) -> Refresh {
        Refresh {
            settings: every.and_then(|every| Some((every, profile.repeats().ok()?))),
            ..Refresh::default()
        }
    }

    /// Continues the refresh of the previous bus: the drive has to answer soon.
    pub(super) fn take_over(&mut self, repeated: Repeated, now: Instant) {
        if self.settings.is_some() {
            self.repeated = repeated;
            if let Some(going) = &mut self.repeated.going {
                going.lost.get_or_insert(now);
            }
        }
    }

    /// The part with which the next bus continues.
    pub(super) fn handed_over(&self) -> Repeated {
        self.repeated
    }

    /// Whether the refresh has started, and has neither ended nor lost its drive.
    pub(super) fn is_going(&self) -> bool {
        self.repeated.going.is_some_and(|going| going.lost.is_none())
    }

    /// Whether the refresh has started.
    pub(super) fn has_begun(&self) -> bool {
        self.repeated.going.is_some()
    }

    /// An order to the drive has started, after this many stops.
    pub(super) fn order_begins(&mut self, stops: u64) {
        (self.stops, self.says_run) = (stops, false);
    }

    /// The drive acknowledged a write of an order.
    pub(super) fn ordered(&mut self, profile: &Profile, pdu: &RequestPdu, now: Instant) {
        let (Some((_, repeats)), Some(control)) = (self.settings, &profile.control) else {
            return;
        };
        let Some((table, items)) = written(pdu) else {
            self.forget();
            return;
        };
        let by_reference = self.is_fed_by_reference(control, repeats);
        let ordered = &mut self.repeated.ordered;
        let mut of_reference: Vec<(u16, u16)> = Vec::new();
        for (address, word) in items {
            let place = ControlItem { table, address };
            if place == control.at && table == Table::Holding {
                ordered.word = Some(control.without_reset(word));
                if !by_reference {
                    ordered.fed = Some(now);
                }
            }
            if let Some(does) = in_force(control, place, word) {
                ordered.does = does;
                self.says_run = true;
            }
            if table == Table::Holding && profile.is_repeated_reference(address) {
                of_reference.push((address, word));
            }
        }
        if let Some(reference) = reference_of(&of_reference) {
            if let Some(going) = self
                .repeated
                .going
                .as_mut()
                .filter(|_| ordered.reference != Some(reference))
            {
                going.pace = Pace::Free;
            }
            ordered.reference = Some(reference);
            (ordered.referred, ordered.tells_reference) = (Some(now), false);
            if by_reference {
                ordered.fed = Some(now);
            }
        }
    }

    /// Whether the refresh writes only the reference.
    fn is_fed_by_reference(&self, control: &Control, repeats: Repeats) -> bool {
        !repeats.word || (control.refresh_with_reference && self.repeated.ordered.reference.is_some())
    }

    /// Notes the end of an order that was sent. Returns why the refresh ends, if it does.
    pub(super) fn order_over(&mut self, profile: &Profile, how: OrderEnd, held: bool, now: Instant) -> Option<End> {
        self.round = None;
        let (begins, by) = match how {
            OrderEnd::Done if self.by_lease && !self.says_run => (false, Beginner::Client),
            OrderEnd::Done => (held, Beginner::Client),
            OrderEnd::Drill => (held, Beginner::Drill),
            OrderEnd::Action => (self.by_lease, Beginner::Action),
            // The part taken before may be another command than the repeated one.
            OrderEnd::Partly if self.repeats_what_was_ordered() => return None,
            OrderEnd::Partly | OrderEnd::Unknown => return self.end(End::Unknown),
            OrderEnd::Other => return self.end(End::Other),
        };
        self.by_lease = false;
        if begins {
            self.begin(profile, by, now);
        } else {
            self.forget();
        }
        None
    }

    fn repeats_what_was_ordered(&self) -> bool {
        let Repeated { ordered, going } = self.repeated;
        going.is_none_or(|going| ordered.does == Some(going.does))
    }

    fn begin(&mut self, profile: &Profile, by: Beginner, now: Instant) {
        let (Some((every, repeats)), Some(control)) = (self.settings, &profile.control) else {
            return;
        };
        let ordered = self.repeated.ordered;
        let by_reference = self.is_fed_by_reference(control, repeats);
        let fits = if by_reference {
            ordered.reference.is_some()
        } else {
            ordered.word.is_some_and(|word| word & !control.known_bits() == 0)
        };
        let due = ordered.fed.unwrap_or(now) + every;
        // Orders that only set a reference do not change the observed state of the motor, however often they come.
        let goes_on = |going: &Going| !self.says_run && Some(going.does) == ordered.does && going.by == by;
        let before = self.repeated.going.filter(goes_on);
        let anew = |does| Going {
            does,
            since: now,
            stops: self.stops,
            due,
            seen: false,
            lost: None,
            pace: Pace::Free,
            by,
        };
        let going = before.map(|going| Going {
            due: going.due.max(due),
            ..going
        });
        self.repeated.going = going.or(ordered.does.map(anew)).filter(|_| fits);
    }

    /// Ends the refresh, and forgets what it repeats. Returns the reason if the refresh had started.
    pub(super) fn end(&mut self, why: End) -> Option<End> {
        let had_begun = self.has_begun();
        match why {
            End::Lease => {
                (self.repeated.going, self.round) = (None, None);
                self.by_lease = true;
            }
            // The reference stays in force, and may be repeated together with the word of the stop.
            End::Stop => {
                (self.repeated.going, self.round) = (None, None);
                (self.repeated.ordered.does, self.repeated.ordered.word) = (None, None);
            }
            _ => self.forget(),
        }
        had_begun.then_some(why)
    }

    fn forget(&mut self) {
        (self.repeated, self.round, self.by_lease) = (Repeated::default(), None, false);
    }

    /// Checks a drive to which no order is in progress. Returns why the refresh ends, if it does.
    pub(super) fn check(&mut self, reading: &Reading<'_>, around: Around) -> Option<End> {
        let (every, _) = self.settings?;
        let going = self.repeated.going.as_mut()?;
        let now = reading.now;
        let end = if !around.held && going.by != Beginner::Action {
            Some(End::Lease)
        } else if going
            .lost
            .is_some_and(|lost| now.saturating_duration_since(lost) > PERIODS * every)
        {
            Some(going.silence())
        } else if reading.restore_lock.and_then(RestoreLock::reason).is_some() {
            Some(End::Restore)
        } else if going.does == InForce::Run && around.stops != going.stops && !around.delayed {
            Some(End::Stop)
        } else {
            going.is_contradicted(reading)
        };
        let end = end.or_else(|| self.repeated.ordered.is_foreign(reading).then_some(End::Foreign));
        end.and_then(|end| self.end(end))
    }

    /// When the next round is due; `None` if no round is planned.
    pub(super) fn due(&self) -> Option<Instant> {
        let going = self.repeated.going?;
        // A run command is only repeated to a motor that was seen to run by it.
        (going.does == InForce::Stop || going.seen).then_some(going.due)
    }

    /// Whether the values to be refreshed contain a run command.
    pub(super) fn runs(&self) -> bool {
        self.repeated.going.is_some_and(|going| going.does == InForce::Run)
    }

    /// Whether a drill's order started the refresh.
    pub(super) fn is_of_drill(&self) -> bool {
        self.repeated.going.is_some_and(|going| going.by == Beginner::Drill)
    }

    /// Stops that were accepted before the order that started the refresh.
    pub(super) fn stops_before(&self) -> u64 {
        self.repeated.going.map_or(0, |going| going.stops)
    }
}

impl Going {
    /// Why a refresh ends that could not be written for three periods.
    fn silence(&self) -> End {
        match self.pace {
            Pace::Falls(_) => End::Slows,
            _ => End::Silent,
        }
    }

    /// Checks the samples since the order for a contradiction.
    fn is_contradicted(&mut self, reading: &Reading<'_>) -> Option<End> {
        let shown = |point: ModelPoint| {
            let sample = reading.model(point);
            let is_new = sample.at.is_some_and(|at| at > self.since);
            sample.good().filter(|_| is_new).map(|value| value.as_bool())
        };
        if shown(ModelPoint::Fault) == Some(true) {
            return Some(End::Fault);
        }
        if shown(ModelPoint::Remote) == Some(false) {
            return Some(End::Local);
        }
        match (self.does, shown(ModelPoint::Running)) {
            (InForce::Run, Some(false)) if self.seen => return Some(End::Stands),
            (InForce::Stop, Some(true)) if self.seen => return Some(End::Starts),
            (InForce::Run, Some(true)) | (InForce::Stop, Some(false)) => self.seen = true,
            _ => {}
        }
        None
    }
}
