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
mod parameter;
mod priorities;
mod queue;
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
pub use parameter::ParameterOrder;
pub use priorities::{
    Commanded, Effect, Entry, Follows, PRIORITIES, PROTECTING, Priorities, Protects, Settled, SlotWrite,
};
pub use queue::{CAPACITY, Chosen, CommandQueue, NotStopped, Pending, Stopping, Unheld};
pub use standing::{LastWritten, is_reference, limits_passed, still_keeps_limits};
pub use ticket::{Receipt, Ticket, WriteStats};
pub use touched::Touched;

use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::codec::{Exception, Reply, RequestPdu};
use crate::drive::{Profile, Value};
use crate::start_guard::Guarded;

/// Default time after which a command is no longer sent.
pub const DEFAULT_EXPIRY: Duration = Duration::from_secs(2);

/// The result code of an acknowledged command whose effect a read showed.
pub const CONFIRMED: &str = "confirmed";

/// Where a command comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum SourceKind {
    /// Modbus TCP client.
    ModbusTcp,
    /// MQTT topic.
    Mqtt,
    /// Command of a Sparkplug host.
    Sparkplug,
    /// HTTP: the status page, or a program.
    Http,
    /// Lease that expired.
    Supervision,
    /// The gateway stops.
    Shutdown,
    /// `drivegate write` through the socket of the gateway.
    LocalSocket,
    /// `drivegate write`, without a gateway.
    CommandLine,
    /// The other master of a line on which the gateway only listens.
    OtherMaster,
    /// The gateway's own periodic reads.
    Schedule,
    /// A tool at a slot of the bus.
    Slot,
    /// BACnet client.
    Bacnet,
    /// Interlock that does not hold.
    Interlock,
}

impl SourceKind {
    /// All kinds.
    pub const ALL: [SourceKind; 13] = [
        SourceKind::ModbusTcp,
        SourceKind::Mqtt,
        SourceKind::Sparkplug,
        SourceKind::Http,
        SourceKind::Supervision,
        SourceKind::Shutdown,
        SourceKind::LocalSocket,
        SourceKind::CommandLine,
        SourceKind::OtherMaster,
        SourceKind::Schedule,
        SourceKind::Slot,
        SourceKind::Bacnet,
        SourceKind::Interlock,
    ];

    /// The label of metrics and audit lines.
    pub fn name(self) -> &'static str {
        match self {
            SourceKind::ModbusTcp => "modbus_tcp",
            SourceKind::Mqtt => "mqtt",
            SourceKind::Sparkplug => "sparkplug",
            SourceKind::Http => "http",
            SourceKind::Supervision => "supervision",
            SourceKind::Shutdown => "shutdown",
            SourceKind::LocalSocket => "local_socket",
            SourceKind::CommandLine => "command_line",
            SourceKind::OtherMaster => "other_master",
            SourceKind::Schedule => "schedule",
            SourceKind::Slot => "slot",
            SourceKind::Bacnet => "bacnet",
            SourceKind::Interlock => "interlock",
        }
    }

    /// Whether a client commands; the gateway itself is none.
    pub fn is_client(self) -> bool {
        !matches!(
            self,
            SourceKind::Supervision | SourceKind::Shutdown | SourceKind::Schedule | SourceKind::Interlock
        )
    }
}

/// The authority of a client; the drive may allow less.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Authority {
    /// Read and write.
    Write,
    /// Read; every write is refused.
    ReadOnly,
}

/// Who commands: for the audit, and as a client among others.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Origin {
    /// Kind of the source.
    pub kind: SourceKind,
    /// Address, topic or certificate name, as the audit shows it.
    pub who: String,
    client: Arc<str>,
    login: Option<Arc<str>>,
    proof: Proof,
    insists: bool,
}

impl Origin {
    /// Who acts when a lease expires.
    pub const LEASE: &str = "supervision";
    /// The client name for the stop of a drive that was switched to local control with its run command set.
    pub const LOCAL: &str = "local control place";

    /// One that is a client by itself.
    pub fn new(kind: SourceKind, who: impl Into<String>) -> Origin {
        let who = who.into();
        let client = format!("{} {who}", kind.name()).into();
        Origin::of(client, kind, who)
    }

    /// One that is `client` in all that is shared among clients: turns and places in the queue, records of the audit. A
    /// client gains nothing there by more connections or topics, as long as they all name the same `client`.
    pub fn of(client: Arc<str>, kind: SourceKind, who: impl Into<String>) -> Origin {
        let who = who.into();
        Origin {
            kind,
            who,
            client,
            login: None,
            proof: Proof::Nothing,
            insists: false,
        }
    }

    /// The same, of whom its connection proves that.
    pub fn proven(mut self, proof: Proof) -> Origin {
        self.proof = proof;
        self
    }

    /// The same client, which appears under that name in audit and events.
    pub fn acting(mut self, who: String) -> Origin {
        self.who = who;
        self
    }

    /// The same; a stop of it is a new one, also where its client repeats its word all the time.
    pub fn insisting(mut self) -> Origin {
        self.insists = true;
        self
    }

    /// The proof from its connection.
    pub fn proof(&self) -> &Proof {
        &self.proof
    }

    /// The same with a login, which may renew the lease of the drive until another client commands it.
    pub fn with_login(mut self, login: Arc<str>) -> Origin {
        self.login = Some(login);
        self
    }

    /// The login, if the client has one.
    pub fn login(&self) -> Option<&Arc<str>> {
        self.login.as_ref()
    }

    /// Whether it is the lease of a drive, and no other stop of the gateway's own.
    pub fn is_lease(&self) -> bool {
        self.kind == SourceKind::Supervision && self.who == Origin::LEASE
    }

    /// The client, whatever connection or topic it uses.
    pub fn client(&self) -> &Arc<str> {
        &self.client
    }
}

/// A command's content.
#[derive(Debug, Clone, PartialEq)]
pub enum Order {
    /// Points set as one command: index in the profile, value in engineering units.
    Points(Vec<(usize, Value)>),
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
    pub drive: usize,
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
    pub effects: Vec<(usize, Effect)>,
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
    pub fn new(drive: usize, admitted: Admitted, expires: Instant, ticket: Ticket) -> Command {
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

    /// The same to a drive of that profile, asked for at `asked`.
    pub fn asked_of(mut self, profile: &Profile, asked: Instant) -> Command {
        self.effects = vec![(self.drive, Effect::of(&self.order, profile))];
        self.touched = Touched::of(&self.order, &self.ranges, profile);
        self.asked = Some(asked);
        self
    }

    /// The drives that it reaches.
    pub fn reach(&self) -> &[usize] {
        match &self.passed_on {
            Some(passed_on) => &passed_on.reach,
            None => std::slice::from_ref(&self.drive),
        }
    }

    /// Whether it reaches that drive.
    pub fn reaches(&self, drive: usize) -> bool {
        self.reach().contains(&drive)
    }

    /// The same as what follows from a write to a slot.
    pub fn of_slot(mut self, slot: Option<SlotWrite>) -> Command {
        self.slot = slot;
        self
    }

    /// Its effect on the priority arrays of that drive.
    pub fn effect(&self, drive: usize) -> Effect {
        let of_drive = self.effects.iter().find(|(of, _)| *of == drive);
        of_drive.map(|(_, effect)| *effect).unwrap_or_default()
    }

    /// Whether it takes the run command of that drive away.
    pub fn stops(&self, drive: usize) -> bool {
        match &self.passed_on {
            Some(passed_on) => passed_on.stops.contains(&drive),
            None => self.urgency == Urgency::Stop && self.drive == drive,
        }
    }

    /// Whether it may go while the gateway ends: a stop, and the broadcast that stops a whole line.
    pub fn ends_the_gateway(&self) -> bool {
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

/// What interrupted a started command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Interruption {
    /// A stop arrived.
    Stop,
    /// Its time expired.
    Expired,
    /// The port was lost.
    BusDown,
    /// The drive no longer replies.
    Offline,
    /// The gateway stops, or its bus restarts.
    ShuttingDown,
    /// Another client took the drive.
    Taken,
}

/// How a command ended.
#[derive(Debug, Clone, PartialEq)]
pub enum Outcome {
    /// The drive acknowledged it (a read: its reply).
    Acknowledged(Reply),
    /// The drive refused it.
    Exception(Exception),
    /// What was answered leaves open the result: 05, or a gateway's 0A or 0B.
    Unknown(Exception),
    /// Refused before it reached the bus.
    Refused(Refusal),
    /// The drive did not reply.
    TimedOut,
    /// The drive's reply was invalid: wrong check code or length.
    Garbled,
    /// It expired before its turn; not sent.
    Expired,
    /// A newer reference took its place; not sent.
    Replaced,
    /// A stop removed it; not sent.
    Purged,
    /// A supervision action withdrawn because a client returned; not sent.
    Withdrawn,
    /// The drive acknowledged it and shows another value.
    NotTaken(String),
    /// It was started and was interrupted: whether the drive took it, or a part of it, is not known.
    Interrupted(Interruption),
    /// The rest of a command whose stop failed; not sent.
    NotStopped,
    /// Of a command that stops and does more, the drive acknowledged the stop; the result of the rest.
    StopOnly(Box<Outcome>),
    /// The stop of such a command failed, in that way, and the rest was not sent.
    StopFailed(Box<Outcome>),
    /// The port is not open.
    BusDown,
    /// The drive is offline.
    Offline,
    /// 64 commands wait already.
    QueueFull,
    /// The gateway stops.
    ShuttingDown,
}

impl Outcome {
    /// The code in results, audit lines and metrics.
    pub fn code(&self) -> &'static str {
        match self {
            Outcome::Acknowledged(_) => "acknowledged",
            Outcome::Exception(_) => "refused_by_drive",
            Outcome::Unknown(_) => "unknown",
            Outcome::Refused(refusal) => refusal.code(),
            Outcome::TimedOut => "timeout",
            Outcome::Garbled => "garbled",
            Outcome::Expired => "expired",
            Outcome::Replaced => "replaced",
            Outcome::Purged => "purged",
            Outcome::Withdrawn => "withdrawn",
            Outcome::NotTaken(_) => "not_taken",
            Outcome::Interrupted(_) => "interrupted",
            Outcome::NotStopped => "not_stopped",
            Outcome::StopOnly(_) => "stop_only",
            Outcome::StopFailed(stop) => stop.code(),
            Outcome::BusDown => "bus_down",
            Outcome::Offline => "offline",
            Outcome::QueueFull => "queue_full",
            Outcome::ShuttingDown => "shutting_down",
        }
    }

    /// How far the command got.
    fn reach(&self) -> audit::Reach {
        use audit::Reach;
        match self {
            Outcome::Acknowledged(_)
            | Outcome::Exception(_)
            | Outcome::Unknown(_)
            | Outcome::TimedOut
            | Outcome::Garbled
            | Outcome::NotTaken(_)
            | Outcome::Interrupted(_)
            | Outcome::StopOnly(_) => Reach::Sent,
            Outcome::StopFailed(stop) => stop.reach(),
            Outcome::Expired
            | Outcome::Replaced
            | Outcome::Purged
            | Outcome::Withdrawn
            | Outcome::NotStopped
            | Outcome::ShuttingDown => Reach::Queued,
            Outcome::Refused(_) | Outcome::BusDown | Outcome::Offline | Outcome::QueueFull => Reach::Refused,
        }
    }

    /// The outcome of a write refused with that exception.
    pub fn of_exception(code: Exception) -> Outcome {
        match code.leaves_open() {
            true => Outcome::Unknown(code),
            false => Outcome::Exception(code),
        }
    }

    /// Whether the drive took it.
    pub fn is_ok(&self) -> bool {
        matches!(self, Outcome::Acknowledged(_))
    }

    /// The exception for a Modbus TCP client (`docs/modbus-tcp.md`); `None` for success.
    pub fn exception(&self) -> Option<Exception> {
        match self {
            Outcome::Acknowledged(_) => None,
            Outcome::Exception(code) | Outcome::Unknown(code) if code.0 <= 0x0B => Some(*code),
            Outcome::Exception(_) | Outcome::Unknown(_) | Outcome::Garbled | Outcome::NotTaken(_) => {
                Some(Exception::DEVICE_FAILURE)
            }
            Outcome::Refused(refusal) => Some(refusal.exception()),
            Outcome::QueueFull => Some(Exception::BUSY),
            Outcome::BusDown | Outcome::ShuttingDown => Some(Exception::GATEWAY_PATH),
            Outcome::TimedOut | Outcome::Offline | Outcome::Expired | Outcome::NotStopped => {
                Some(Exception::GATEWAY_TARGET)
            }
            // What was not done is what the client must know of; never success, which would be both parts.
            Outcome::StopOnly(part) | Outcome::StopFailed(part) => {
                Some(part.exception().unwrap_or(Exception::DEVICE_FAILURE))
            }
            Outcome::Replaced | Outcome::Purged | Outcome::Withdrawn => Some(Exception::BUSY),
            Outcome::Interrupted(Interruption::BusDown | Interruption::ShuttingDown) => Some(Exception::GATEWAY_PATH),
            Outcome::Interrupted(_) => Some(Exception::GATEWAY_TARGET),
        }
    }
}

impl fmt::Display for Outcome {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Outcome::Acknowledged(_) => f.write_str("the drive acknowledged it"),
            Outcome::Exception(code) => write!(f, "the drive refused it with {code}"),
            Outcome::Unknown(code) => {
                write!(
                    f,
                    "the drive replied {code}; whether it executed the command is unknown"
                )
            }
            Outcome::Refused(refusal) => refusal.fmt(f),
            Outcome::TimedOut => f.write_str("the drive did not reply; whether it executed the command is unknown"),
            Outcome::Garbled => {
                f.write_str("the drive's reply was garbled; whether it executed the command is unknown")
            }
            Outcome::Expired => f.write_str("it expired before its turn came; it was not sent"),
            Outcome::Replaced => f.write_str("a newer command replaced it; it was not sent"),
            Outcome::Purged => f.write_str("a stop arrived after it was requested; it was not sent"),
            Outcome::Withdrawn => f.write_str("a client commands the drive again; it was not sent"),
            Outcome::NotTaken(shown) => write!(f, "the drive acknowledged it, but {shown}"),
            Outcome::Interrupted(why) => {
                let why = match why {
                    Interruption::Stop => "a stop arrived",
                    Interruption::Expired => "it expired",
                    Interruption::BusDown => "the bus went down",
                    Interruption::Offline => "the drive went offline",
                    Interruption::ShuttingDown => "the gateway is shutting down",
                    Interruption::Taken => "another client took the drive",
                };
                write!(
                    f,
                    "it was started, then {why}; whether the drive executed it is unknown"
                )
            }
            Outcome::NotStopped => f.write_str("the stop of the same command failed; it was not sent"),
            Outcome::StopOnly(rest) => {
                let rest = rest
                    .to_string()
                    .replace("nothing was written", "nothing else was written");
                write!(
                    f,
                    "the drive acknowledged the stop; the rest was not carried out: {rest}"
                )
            }
            Outcome::StopFailed(stop) => write!(f, "{stop}; the rest of the command was not sent"),
            Outcome::BusDown => f.write_str("the bus is down; it was not sent"),
            Outcome::Offline => f.write_str("the drive is offline; it was not sent"),
            Outcome::QueueFull => write!(f, "{CAPACITY} commands are already waiting; it was not sent, try again"),
            Outcome::ShuttingDown => f.write_str("the gateway is shutting down; it was not sent"),
        }
    }
}

/// Why a command was refused before it reached the bus.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Refusal {
    /// Writing is off for that client or drive.
    #[error("{0}")]
    NotAllowed(String),
    /// The point or address cannot be written, or does not exist.
    #[error("{0}")]
    NotWritable(String),
    /// It depends on a value that was not read from the drive yet; for a silent drive, its absence is the reason
    /// instead.
    #[error("{0}")]
    NotKnown(String),
    /// The value is outside the type, the profile or the limits, or the command contradicts itself.
    #[error("{0}")]
    BadValue(String),
    /// Someone else has a right to the drive that goes before that of the client.
    #[error("{0}")]
    HeldByOther(Box<Holder>),
    /// The motor may not be started yet.
    #[error("{0}; it was not sent")]
    Guarded(Box<Guarded>),
    /// An interlock is not satisfied.
    #[error("{0}; it was not sent")]
    Interlocked(String),
    /// A client refused after a stop repeats run, or renews a hold it does not have.
    #[error("{0}")]
    NeedsTake(Box<Holder>),
    /// There is no drive of that name.
    #[error("{0}")]
    UnknownDrive(String),
    /// The drive reports that its motor runs: no parameter is written.
    #[error("{0}")]
    MotorRuns(String),
    /// The drive has neither the value that a restore found nor the one to be written.
    #[error("{0}")]
    OtherValue(String),
}

/// Who keeps others from a drive.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Holder {
    /// Who.
    pub who: String,
    /// By which right.
    pub rank: String,
    /// What is held, and how that ends.
    pub keeps: String,
    /// Seconds until it ends by itself, if it does.
    pub left_s: Option<u64>,
}

impl fmt::Display for Holder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Holder { who, rank, keeps, .. } = self;
        write!(f, "{who} ({rank}) {keeps}; it was not sent")
    }
}

impl Refusal {
    const UNKNOWN_DRIVE: &str = "unknown_drive";

    /// The code in results.
    pub fn code(&self) -> &'static str {
        match self {
            Refusal::NotAllowed(_) | Refusal::MotorRuns(_) | Refusal::OtherValue(_) => "not_allowed",
            Refusal::NotWritable(_) | Refusal::NotKnown(_) => "not_writable",
            Refusal::BadValue(_) => "bad_value",
            Refusal::HeldByOther(_) => "held_by_other",
            Refusal::Guarded(_) => "guarded",
            Refusal::Interlocked(_) => "interlocked",
            Refusal::NeedsTake(_) => "needs_take",
            Refusal::UnknownDrive(_) => Refusal::UNKNOWN_DRIVE,
        }
    }

    /// Who keeps the client from the drive, where someone does.
    pub fn holder(&self) -> Option<&Holder> {
        match self {
            Refusal::HeldByOther(holder) | Refusal::NeedsTake(holder) => Some(holder),
            _ => None,
        }
    }

    /// The Modbus exception.
    pub fn exception(&self) -> Exception {
        match self {
            Refusal::NotAllowed(_) | Refusal::MotorRuns(_) | Refusal::OtherValue(_) => Exception::FUNCTION,
            Refusal::NotWritable(_) | Refusal::NotKnown(_) => Exception::ADDRESS,
            Refusal::BadValue(_) => Exception::VALUE,
            Refusal::HeldByOther(_) | Refusal::NeedsTake(_) | Refusal::Guarded(_) | Refusal::Interlocked(_) => {
                Exception::BUSY
            }
            Refusal::UnknownDrive(_) => Exception::GATEWAY_PATH,
        }
    }
}

/// The one result of a command.
#[derive(Debug, Clone, PartialEq)]
pub struct Answer {
    /// How it ended.
    pub outcome: Outcome,
    /// From acceptance to result.
    pub latency: Duration,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_has_every_result() {
        let page = include_str!("../../../../docs/commands.md");
        let refusals = [
            Refusal::NotAllowed,
            Refusal::NotWritable,
            Refusal::BadValue,
            Refusal::UnknownDrive,
        ];
        let mut outcomes: Vec<Outcome> = refusals.iter().map(|r| Outcome::Refused(r(String::new()))).collect();
        let held = [Refusal::HeldByOther(Box::default()), Refusal::NeedsTake(Box::default())];
        outcomes.extend(held.map(Outcome::Refused));
        outcomes.extend([
            Outcome::Refused(Refusal::Interlocked(String::new())),
            Outcome::Acknowledged(Reply::Written),
            Outcome::TimedOut,
            Outcome::Garbled,
            Outcome::Expired,
            Outcome::Replaced,
            Outcome::Purged,
            Outcome::Withdrawn,
            Outcome::NotTaken(String::new()),
            Outcome::Interrupted(Interruption::Stop),
            Outcome::NotStopped,
            Outcome::BusDown,
            Outcome::Offline,
            Outcome::QueueFull,
            Outcome::ShuttingDown,
        ]);
        for outcome in outcomes {
            let exception = outcome
                .exception()
                .map_or("none".to_string(), |e| format!("{:02X}", e.0));
            let row = format!("| `{}` | {exception} |", outcome.code());
            assert!(page.contains(&row), "docs/commands.md lacks {row}");
        }
        assert!(page.contains("| `guarded` | 06 | 409 |"));
        for with_code in [Outcome::Exception, Outcome::Unknown] {
            assert!(page.contains(&format!("| `{}` |", with_code(Exception::BUSY).code())));
        }
        assert!(page.contains(&format!(
            "| `{}` |",
            Outcome::StopOnly(Box::new(Outcome::Purged)).code()
        )));
        assert_eq!(
            Outcome::Exception(Exception(0x33)).exception(),
            Some(Exception::DEVICE_FAILURE)
        );
        assert_eq!(Outcome::Exception(Exception::BUSY).exception(), Some(Exception::BUSY));
    }
}
