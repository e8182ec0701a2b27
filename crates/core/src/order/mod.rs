//! An order: its content, its effect on each drive that it reaches, when it arrived and until when it may be sent,
//! its origin, and the ticket by which it gets exactly one result.
//!
//! A server creates an [`Order`]; [`crate::permit::admit`] checks and converts it; the resulting [`Command`] waits
//! in the [`crate::queue`] of its bus. The [`Ticket`] inside a command yields its result when it is used or
//! dropped, so a command can neither get two results nor be forgotten.
//!
//! [`Outcome`] has the code, the text and the Modbus exception of every result; the texts of refusals are where the
//! refusal is decided, in [`crate::permit`].

mod arrival;
mod audit;
mod conversion;
mod effect;
mod frequency_range;
mod guarded;
mod last_stops;
mod origin;
mod outcome;
mod parameter;
mod parts;
mod passed_on;
mod raw;
mod right;
mod slot_write;
mod target;
mod ticket;
mod touched;

pub use arrival::{Arrival, Connection};
pub use audit::{AUDIT_KEPT, Audit, AuditFile, AuditFileOptions, AuditRecord, Change, RunOrdered, chain};
pub use audit::{SENT, milliseconds, milliseconds_or_null};
pub(crate) use conversion::{Becomes, as_held, becomes};
pub use effect::{Asks, Effect, Effects};
pub(crate) use frequency_range::rests_on;
pub use frequency_range::{FrequencyRange, is_range_end};
pub use guarded::{Guarded, Reason};
pub use last_stops::LastStops;
pub use origin::{Acting, Authority, Origin, Proof, SourceKind};
pub use outcome::{Answer, Holder, Interruption, Outcome, Refusal};
pub use parameter::ParameterOrder;
pub use parts::{Parts, StopEnd, joined, stop_of};
pub use passed_on::{BackgroundRequest, Pace, PassedOn};
pub use raw::written;
pub use right::{Grants, Right};
pub use slot_write::{Commanded, Entry, SlotWrite};
pub use target::Target;
pub use ticket::{CommandLog, Receipt, Ticket};
pub use touched::Touched;

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use drivegate_model::drive::{DriveIndex, PointIndex, Profile, Value};
use drivegate_proto::RequestPdu;

/// Default time after which a command is no longer sent.
pub const DEFAULT_EXPIRY: Duration = Duration::from_secs(2);

/// Commands and forwarded reads that may wait on one bus, in addition to two stops per drive.
pub const CAPACITY: usize = 64;

/// The result code of an acknowledged command whose effect a read showed.
pub const CONFIRMED: &str = "confirmed";

/// The content of a command.
#[derive(Debug, Clone, PartialEq)]
pub enum Order {
    /// Points set as one command: index in the profile, value in engineering units.
    Points(Vec<(PointIndex, Value)>),
    /// A raw write that is passed on unchanged (except bits of a control word).
    Write(RequestPdu),
    /// A raw read that is not polled.
    Read(RequestPdu),
    /// A parameter that a restore sets, while the motor is stopped.
    Parameter(ParameterOrder),
}

/// Rank of a command on the bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Urgency {
    /// The order takes a run command away.
    Stop,
    /// The order is a command other than a stop.
    Command,
    /// A read that was forwarded.
    Read,
}

/// A command that was checked and converted, and may now wait in the queue.
#[derive(Debug, Clone, PartialEq)]
pub struct Admitted {
    /// The order, with derived points replaced by their sources.
    pub order: Order,
    /// Rank of the order.
    pub urgency: Urgency,
    /// Whether the order sets references only.
    pub reference_only: bool,
    /// Frequency ranges on which the order depends.
    pub ranges: Vec<FrequencyRange>,
}

/// Whether `min_run` of the drive may delay a stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Haste {
    /// Without delay: the stop of a person or of the gateway itself, or a second stop.
    AtOnce,
    /// A delay is possible if this is the first stop of the client that started the motor.
    Usual,
    /// The stop waits until the motor has run for the minimum time.
    Delayed,
}

/// A command that takes the run command away.
#[derive(Debug)]
pub struct Stop {
    /// Whether `min_run` may delay the stop.
    pub haste: Haste,
    /// Clients that wait for the same stop, each with the time until which it waits.
    pub joined: Vec<(Ticket, Instant)>,
    /// Whether another bus accepted the stop before a reload: the consequences for holds and priorities were noted
    /// there.
    pub is_inherited: bool,
    /// Whether another bus had started the stop before a reload.
    pub was_begun: bool,
}

impl Stop {
    fn new() -> Stop {
        Stop {
            haste: Haste::Usual,
            joined: Vec::new(),
            is_inherited: false,
            was_begun: false,
        }
    }
}

/// A command that sets something and is not a stop.
#[derive(Debug, Default)]
pub struct Set {
    /// Whether the command sets references only: a newer one of the same points replaces it.
    pub reference_only: bool,
    /// Result of the stop that was split off from this command; if that stop fails, this rest is not sent.
    pub behind: Option<StopEnd>,
}

/// Kind of a command among the commands of its bus.
#[derive(Debug)]
pub enum Work {
    /// The command takes the run command away.
    Stop(Stop),
    /// The command sets something else.
    Set(Set),
    /// The command reads registers that are not polled.
    Read,
    /// A tool's write, or a broadcast, which reaches every drive that listens to its address.
    PassedOn(PassedOn),
}

/// When a command arrived, and until when it may be sent.
#[derive(Debug, Clone, PartialEq)]
pub struct Window {
    /// When the first byte of the command arrived.
    pub arrival: Arrival,
    /// The command is not sent after this time.
    pub expires: Instant,
    /// Whether a start may wait until the command expires; otherwise it is refused.
    pub waits: bool,
}

/// The part of a command that the rules judge: its identity, its effect on each drive, and when it arrived.
#[derive(Debug, Clone)]
pub struct Intent {
    /// Identifies the command: no other command of the process has this number.
    pub number: u64,
    /// Receiver of the command: an address only for a broadcast.
    pub target: Target,
    /// Content of the command.
    pub order: Order,
    /// Effects on each drive that the order reaches.
    pub effects: Effects,
    /// Frequency ranges on which the values depend.
    pub ranges: Vec<FrequencyRange>,
    /// When the order arrived, and until when it may be sent.
    pub window: Window,
    /// The write to a BACnet slot that caused the order.
    pub slot: Option<SlotWrite>,
}

/// A command on its way from a client to the bus.
#[derive(Debug)]
pub struct Command {
    /// Content, effects and time of the command.
    pub intent: Intent,
    /// Kind of the command among the commands of its bus.
    pub work: Work,
    /// Ticket that gives the command its result.
    pub ticket: Ticket,
    /// Number of younger commands that were sent first.
    pub(crate) overtaken: usize,
}

/// A new number that no other command of the process has, so that data kept for one command never matches another one.
fn next_number() -> u64 {
    static LAST: AtomicU64 = AtomicU64::new(0);
    LAST.fetch_add(1, Ordering::Relaxed) + 1
}

impl Intent {
    /// The intent of a new command.
    pub fn new(target: impl Into<Target>, order: Order, effects: Effects, window: Window) -> Intent {
        Intent {
            number: next_number(),
            target: target.into(),
            order,
            effects,
            ranges: Vec::new(),
            window,
            slot: None,
        }
    }

    /// Time until which the start must wait; `None` if the command need not wait.
    pub fn waits_until(&self) -> Option<Instant> {
        self.window.waits.then_some(self.window.expires)
    }
}

impl Command {
    /// A command to the drive with this profile at this index of its bus.
    pub fn new(drive: DriveIndex, admitted: Admitted, profile: &Profile, window: Window, ticket: Ticket) -> Command {
        let Admitted {
            order,
            urgency,
            reference_only,
            ranges,
        } = admitted;
        let effect = Effect::of_command(&order, urgency, profile);
        let effects = Effects::on_one(drive, effect, Touched::of(&order, &ranges, profile));
        let work = match urgency {
            Urgency::Stop => Work::Stop(Stop::new()),
            Urgency::Read => Work::Read,
            Urgency::Command => Work::Set(Set {
                reference_only,
                behind: None,
            }),
        };
        Command {
            intent: Intent {
                ranges,
                ..Intent::new(drive, order, effects, window)
            },
            work,
            ticket,
            overtaken: 0,
        }
    }

    /// A tool's write, or a broadcast, which is ordered among the commands of every drive that it reaches.
    pub fn passed_on(intent: Intent, passed_on: PassedOn, ticket: Ticket) -> Command {
        Command {
            intent,
            work: Work::PassedOn(passed_on),
            ticket,
            overtaken: 0,
        }
    }

    /// A stop that a bus had started when it ended, for the bus that replaces it.
    pub fn begun_stop(intent: Intent, was_begun: bool, ticket: Ticket, joined: Vec<(Ticket, Instant)>) -> Command {
        Command {
            intent,
            work: Work::Stop(Stop {
                haste: Haste::AtOnce,
                joined,
                is_inherited: true,
                was_begun,
            }),
            ticket,
            overtaken: 0,
        }
    }

    /// Rank of the command on the bus. A request passed on for a tool always has the rank of a command.
    pub fn urgency(&self) -> Urgency {
        match self.work {
            Work::Stop(_) => Urgency::Stop,
            Work::Set(_) | Work::PassedOn(_) => Urgency::Command,
            Work::Read => Urgency::Read,
        }
    }

    /// The drive to which the command is sent; `None` for a broadcast.
    pub fn drive(&self) -> Option<DriveIndex> {
        self.intent.target.drive()
    }

    /// The drives that the command reaches.
    pub fn reach(&self) -> impl Iterator<Item = DriveIndex> + '_ {
        self.intent.effects.drives()
    }

    /// Whether the command reaches this drive.
    pub fn reaches(&self, drive: DriveIndex) -> bool {
        self.reach().any(|reached| reached == drive)
    }

    /// Effect of the command on this drive.
    pub fn effect(&self, drive: DriveIndex) -> Effect {
        self.intent.effects.on(drive)
    }

    /// Whether the command takes away the run command of this drive.
    pub fn stops(&self, drive: DriveIndex) -> bool {
        self.effect(drive).stops
    }

    /// Whether the command is a stop, which goes ahead of everything else for its drive.
    pub fn is_stop(&self) -> bool {
        matches!(self.work, Work::Stop(_))
    }

    /// Whether the bus before a reload accepted the command and already noted its consequences.
    pub(crate) fn is_inherited(&self) -> bool {
        matches!(&self.work, Work::Stop(stop) if stop.is_inherited)
    }

    /// Whether the command sets something and is not a stop.
    pub(crate) fn is_command(&self) -> bool {
        self.urgency() == Urgency::Command
    }

    /// Whether the command sets references only.
    pub(crate) fn is_reference_only(&self) -> bool {
        matches!(&self.work, Work::Set(set) if set.reference_only)
    }

    /// Whether the command may start a drive that it does not stop.
    pub(crate) fn may_start(&self) -> bool {
        self.is_command() && !self.is_reference_only()
    }

    /// The request passed on for a tool, where the command is one.
    pub fn as_passed_on(&self) -> Option<&PassedOn> {
        match &self.work {
            Work::PassedOn(passed_on) => Some(passed_on),
            Work::Stop(_) | Work::Set(_) | Work::Read => None,
        }
    }

    /// Whether the command is a stop that `min_run` delays.
    pub fn is_delayed_stop(&self) -> bool {
        matches!(&self.work, Work::Stop(stop) if stop.haste == Haste::Delayed)
    }

    /// Whether the command may still be sent while the gateway shuts down: a stop, and the broadcast that stops a whole
    /// line.
    pub(crate) fn ends_the_gateway(&self) -> bool {
        let is_shutdown = self.ticket.origin().kind == SourceKind::Shutdown;
        self.is_stop() || (is_shutdown && self.as_passed_on().is_some())
    }

    /// The clients of the command: the one that gave the order, then those that joined it.
    pub fn origins(&self) -> impl Iterator<Item = &Origin> {
        let joined = match &self.work {
            Work::Stop(stop) => stop.joined.as_slice(),
            Work::Set(_) | Work::Read | Work::PassedOn(_) => &[],
        };
        let joined = joined.iter().map(|(ticket, _)| ticket);
        std::iter::once(&self.ticket).chain(joined).map(Ticket::origin)
    }

    /// Until when a client waits for the command; `None` for the gateway's own commands.
    pub(crate) fn client_waits_until(&self) -> Option<Instant> {
        let joined = match &self.work {
            Work::Stop(stop) => stop.joined.as_slice(),
            Work::Set(_) | Work::Read | Work::PassedOn(_) => &[],
        };
        let joined = joined.iter().map(|(ticket, expires)| (ticket, *expires));
        let tickets = std::iter::once((&self.ticket, self.intent.window.expires)).chain(joined);
        let of_clients = tickets.filter(|(ticket, _)| ticket.origin().kind.is_client());
        of_clients.map(|(_, expires)| expires).max()
    }

    /// Reports the outcome to the client and to all that joined.
    pub fn answer(self, outcome: &Outcome, now: Instant) {
        let (was_begun, joined) = match self.work {
            Work::Stop(stop) => (stop.was_begun, stop.joined),
            Work::Set(_) | Work::Read | Work::PassedOn(_) => (false, Vec::new()),
        };
        let outcome = &match outcome {
            Outcome::Expired if was_begun => Outcome::Interrupted(Interruption::Expired),
            Outcome::BusDown if was_begun => Outcome::Interrupted(Interruption::BusDown),
            Outcome::ShuttingDown if was_begun => Outcome::Interrupted(Interruption::ShuttingDown),
            Outcome::Offline if was_begun => Outcome::Interrupted(Interruption::Offline),
            Outcome::Replaced if was_begun => Outcome::Interrupted(Interruption::Stop),
            outcome => outcome.clone(),
        };
        let joined = joined.into_iter().map(|(ticket, _)| ticket);
        let tickets = [self.ticket].into_iter().chain(joined);
        tickets.for_each(|ticket| ticket.answer(outcome.clone(), now));
    }
}
