//! Commands: who may command what, and how each command gets exactly one result.
//!
//! The servers build an [`Order`], [`admit`] checks it against authority, profile and limits, and the [`CommandQueue`]
//! of the bus accepts it. The [`Ticket`] inside a command yields its result when it is used or dropped, so a command
//! can neither get two results nor be forgotten.
//!
//! [`Outcome`] has the code, the text and the Modbus exception of every result; the texts of refusals are where the
//! refusal is decided, mostly in `admit`.

mod admit;
mod audit;
mod background;
mod compound;
mod frequency_range;
mod holder;
mod origin;
mod outcome;
mod parameter;
mod priorities;
mod queue;
mod right;
mod standing;
mod ticket;
mod touched;

pub use admit::{Admitted, admit, authority, converted, may_restore, sets_twice, written};
pub use audit::{AUDIT_KEPT, Audit, AuditFile, AuditFileOptions, AuditRecord, Change, RunOrdered, chain};
pub use audit::{SENT, milliseconds, milliseconds_or_null};
pub use background::{
    BACKGROUND_CAPACITY, BACKGROUND_PER_CLIENT, Background, BackgroundRequest, NO_DRIVE, Pace, PassedOn,
};
pub use compound::{Parts, StopEnd, joined, stop_of};
pub use frequency_range::{FrequencyRange, is_range_end};
pub use holder::{
    Asks, Claim, Denial, HoldState, HoldView, Holding, KeptReservation, Mode, Principal, Proof, Rules, Told, Verb, What,
};
pub use origin::{Authority, Origin, SourceKind};
pub use outcome::{Answer, Holder, Interruption, Outcome, Refusal};
pub use parameter::ParameterOrder;
pub use priorities::{
    Commanded, Effect, Entry, Follows, PRIORITIES, PROTECTING, Priorities, Protects, Settled, SlotWrite, VoidSlot,
};
pub use queue::{CAPACITY, Chosen, CommandQueue, NotStopped, Pending, Stopping, Unheld};
pub use right::{Grants, Right};
pub use standing::{LastWritten, is_reference, limits_passed, still_keeps_limits};
pub use ticket::{Receipt, Ticket, WriteStats};
pub use touched::Touched;

use std::time::{Duration, Instant};

use crate::codec::RequestPdu;
use crate::drive::{DriveIndex, PointIndex, Profile, Value};

/// Default time after which a command is no longer sent.
pub const DEFAULT_EXPIRY: Duration = Duration::from_secs(2);

/// The result code of an acknowledged command whose effect a read showed.
pub const CONFIRMED: &str = "confirmed";

/// A command's content.
#[derive(Debug, Clone, PartialEq)]
pub enum Order {
    /// Points set as one command: index in the profile, value in engineering units.
    Points(Vec<(PointIndex, Value)>),
    /// A raw write, passed on as it is (except bits of a control word).
    Write(RequestPdu),
    /// A raw read outside the plan.
    Read(RequestPdu),
    /// One parameter set by a restore, while the motor is stopped.
    Parameter(ParameterOrder),
}

/// Rank of a command on the bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Urgency {
    /// Takes a run command away.
    Stop,
    /// Any other command.
    Command,
    /// Forwarded read.
    Read,
}

/// A command on its way to the bus.
#[derive(Debug)]
pub struct Command {
    /// Index of the drive on its bus.
    pub drive: DriveIndex,
    /// Its content.
    pub order: Order,
    /// Rank.
    pub urgency: Urgency,
    /// The order sets references only: a newer one of the same points replaces it.
    pub reference_only: bool,
    /// Frequency ranges on which it rests.
    pub ranges: Vec<FrequencyRange>,
    /// Not sent after this.
    pub expires: Instant,
    /// Its ticket.
    pub ticket: Ticket,
    /// Those who wait for the same stop, and until when.
    pub joined: Vec<(Ticket, Instant)>,
    /// It is the rest of a command whose stop goes first, and is not sent if that fails.
    pub behind: Option<StopEnd>,
    /// Younger commands that went before it.
    pub overtaken: usize,
    /// Its number in the queue.
    pub number: u64,
    /// When its request began to arrive: a command requested before a stop arrived is not sent after it.
    pub asked: Option<Instant>,
    /// The registers that it sets, and on which it rests.
    pub touched: Touched,
    /// What a write of a tool has besides that which may write anything, to one drive or to all that hear it.
    pub passed_on: Option<PassedOn>,
    /// A stop that another bus had started before this one took its place.
    pub was_begun: bool,
    /// Its effects on the priority arrays of the drives that it reaches.
    pub effects: Vec<(DriveIndex, Effect)>,
    /// The write to a slot from which it follows.
    pub slot: Option<SlotWrite>,
    /// A start that must wait does so, as long as it lives.
    pub waits: bool,
    /// An ordinary stop: it waits until the motor has run for a time.
    pub is_ordinary: bool,
    /// A stop that is never an ordinary one.
    pub is_urgent: bool,
}

impl Command {
    /// A command to the drive at that place of its bus.
    pub fn new(drive: DriveIndex, admitted: Admitted, expires: Instant, ticket: Ticket) -> Command {
        Command {
            drive,
            order: admitted.order,
            urgency: admitted.urgency,
            reference_only: admitted.reference_only,
            ranges: admitted.ranges,
            expires,
            ticket,
            joined: Vec::new(),
            behind: None,
            overtaken: 0,
            number: 0,
            asked: None,
            touched: Touched::Anything,
            passed_on: None,
            was_begun: false,
            effects: Vec::new(),
            slot: None,
            waits: false,
            is_ordinary: false,
            is_urgent: false,
        }
    }

    /// The same to a drive of that profile, requested at `asked`.
    pub(crate) fn asked_of(mut self, profile: &Profile, asked: Instant) -> Command {
        self.effects = vec![(self.drive, Effect::of(&self.order, profile))];
        self.touched = Touched::of(&self.order, &self.ranges, profile);
        self.asked = Some(asked);
        self
    }

    /// The drives that it reaches.
    pub fn reach(&self) -> &[DriveIndex] {
        match &self.passed_on {
            Some(passed_on) => &passed_on.reach,
            None => std::slice::from_ref(&self.drive),
        }
    }

    /// Whether it reaches that drive.
    pub fn reaches(&self, drive: DriveIndex) -> bool {
        self.reach().contains(&drive)
    }

    /// The same as what follows from a write to a slot.
    pub fn of_slot(mut self, slot: Option<SlotWrite>) -> Command {
        self.slot = slot;
        self
    }

    /// Its effect on the priority arrays of that drive.
    pub fn effect(&self, drive: DriveIndex) -> Effect {
        let of_drive = self.effects.iter().find(|(of, _)| *of == drive);
        of_drive.map(|(_, effect)| *effect).unwrap_or_default()
    }

    /// Whether it takes the run command of that drive away.
    pub fn stops(&self, drive: DriveIndex) -> bool {
        match &self.passed_on {
            Some(passed_on) => passed_on.stops.contains(&drive),
            None => self.urgency == Urgency::Stop && self.drive == drive,
        }
    }

    /// Whether it may go while the gateway ends: a stop, and the broadcast that stops a whole line.
    pub(crate) fn ends_the_gateway(&self) -> bool {
        let is_broadcast = self.passed_on.is_some() && self.ticket.origin().kind == SourceKind::Shutdown;
        self.urgency == Urgency::Stop || is_broadcast
    }

    /// The same as the rest of a command, after its stop.
    pub fn behind(mut self, stop: StopEnd) -> Command {
        self.behind = Some(stop);
        self
    }

    /// Reports the outcome to its client and all that joined.
    pub fn answer(self, outcome: &Outcome, now: Instant) {
        let outcome = &match outcome {
            Outcome::Expired if self.was_begun => Outcome::Interrupted(Interruption::Expired),
            Outcome::BusDown if self.was_begun => Outcome::Interrupted(Interruption::BusDown),
            Outcome::ShuttingDown if self.was_begun => Outcome::Interrupted(Interruption::ShuttingDown),
            Outcome::Offline if self.was_begun => Outcome::Interrupted(Interruption::Offline),
            Outcome::Replaced if self.was_begun => Outcome::Interrupted(Interruption::Stop),
            outcome => outcome.clone(),
        };
        let joined = self.joined.into_iter().map(|(ticket, _)| ticket);
        let tickets = [self.ticket].into_iter().chain(joined);
        tickets.for_each(|ticket| ticket.answer(outcome.clone(), now));
    }
}
