//! A command on its way through the line, step by step: control words made from the known words, pulses, safe order
//! of writes. Pure.

mod awaited_state;
mod control;
mod ending;
mod functions;
mod known_words;
mod next;
mod next_direction;
mod parameter;
mod replies;
mod state_read;
mod steps;
mod word;

use std::collections::VecDeque;
use std::time::{Duration, Instant};

pub use self::known_words::{KnownWords, OrderedDirection};
pub(crate) use self::state_read::StateRead;
pub use self::steps::{Step, StepPurpose};
pub use self::word::read_place;

use self::next_direction::NextDirection;
pub(crate) use self::next_direction::names_no_direction;
use self::parameter::ParameterRun;
use self::steps::{
    Action, Check, Permit, RequestContext, actions, names_run, sets_all_bits, unsendable, write_on_change,
};
use self::word::Word;
use super::confirm::{self, Effect};
use super::start_gate::Start;
use drivegate_core::order::{Command, Intent, Interruption, Order, Origin, Outcome, SourceKind, Ticket, Urgency, Work};
use drivegate_core::permit::{Motor, Repeats, Verdict, running_unknown};
use drivegate_model::drive::Profile;
use drivegate_proto::{Reply, Table};

/// Maximum number of stops to a drive that are sent before the end of a pulse in progress.
const MOST_STOPS: u32 = 8;

/// The next thing a command needs.
#[derive(Debug, Clone, PartialEq)]
pub enum Next {
    /// The next request to send on the line.
    Send(Step),
    /// Nothing is sent before this time.
    Wait(Instant),
    Done,
}

/// What is needed of a command, or of the commands of a drive.
#[derive(Debug)]
pub(crate) enum Need<T> {
    Next(T),
    /// The gate first judges what the next word of the command would repeat ([`CommandRun::judged`]).
    Judge(Repeats),
}

/// The parts of the command that decide its steps.
#[derive(Debug)]
struct Scope {
    /// Whether the command sets every bit that can be commanded, except reset bits.
    whole: bool,
    /// Whether the command sets references only.
    reference_only: bool,
}

/// What shows that the drive carries out a command, once the command is acknowledged.
#[derive(Debug)]
enum Shown {
    /// Later reads show these effects.
    ByReads(Vec<Effect>),
    /// The command is acknowledged only when the drive has shown its effect.
    ReadBack,
    /// Nothing until the next start: the direction that the command orders takes effect then.
    AtNextStart,
}

/// How much of a command was sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum OnWire {
    Nothing,
    /// Only reads that prepare a write were sent so far.
    Reads,
    /// A write was sent, or the read of a command that reads.
    Command,
}

/// Steps that are left to send.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    /// The steps are sent as ordered.
    Steps,
    /// The motor runs by this command already: its last word is sent again, and no failure stops the motor.
    Repeats,
    /// The last word of a start sequence was sent, which starts the motor: if the rest fails, a stop follows.
    MotorStarted,
    /// The end of a pulse, or that stop, which is sent whatever happens.
    OnlyEnds,
}

/// Whether the drive may have executed a write whose reply is missing or not trusted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Doubt {
    No,
    /// A write of the command was not acknowledged.
    Unanswered,
    /// The acknowledgement may have been a late reply to another request: the write is repeated only when no late reply
    /// can arrive any more.
    LateReply,
}

/// How far the tries of the present step got.
#[derive(Debug)]
struct Tries {
    failures: u32,
    /// How the last attempt without a conclusive reply failed: [`Outcome::TimedOut`], [`Outcome::Garbled`] or
    /// [`Outcome::Unknown`].
    unanswered: Outcome,
    doubt: Doubt,
    /// Number of consecutive "busy" replies.
    busy: u32,
    /// When the last pause before a repetition ends, or has ended.
    due: Option<Instant>,
}

/// The pause before the next step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Pause {
    No,
    /// The step is repeated after this time, which begins when the next step is asked for.
    Repeat(Duration),
    /// Nothing is sent before this time.
    Until(Instant),
}

/// How a command ends when nothing is left to send.
#[derive(Debug)]
enum Ending {
    /// All was sent; with the reply to the order itself.
    Acknowledged(Reply),
    /// The command ends before all was sent, or could not be sent as a whole.
    Cut(Outcome),
}

impl Ending {
    /// The outcome of a command that is cut off.
    fn cut(&self) -> Option<&Outcome> {
        match self {
            Ending::Acknowledged(_) => None,
            Ending::Cut(outcome) => Some(outcome),
        }
    }
}

/// The motor as the drive shows it in this command, right before a write.
#[derive(Debug)]
#[expect(
    clippy::large_enum_variant,
    reason = "there are few commands, and a look needs no allocation of its own"
)]
enum MotorRead {
    NotTaken,
    /// The reads in progress that show whether the motor runs.
    UnderWay(StateRead),
    Seen(Motor),
}

impl MotorRead {
    /// State of the motor; `None` if it was not read.
    fn motor(&self) -> Option<Motor> {
        match self {
            MotorRead::NotTaken | MotorRead::UnderWay(_) => None,
            MotorRead::Seen(motor) => Some(*motor),
        }
    }

    /// The state of the motor counts no longer. Returns whether it was known; reads in progress go on.
    fn forget(&mut self) -> bool {
        let seen = matches!(self, MotorRead::Seen(_));
        if seen {
            *self = MotorRead::NotTaken;
        }
        seen
    }
}

/// A command that the bus has started.
#[derive(Debug)]
pub struct CommandRun {
    urgency: Urgency,
    /// Rank by which the command competes for the line; a redundant stop has the rank of an ordinary command.
    pub rank: Urgency,
    scope: Scope,
    actions: VecDeque<Action>,
    pause: Pause,
    expires: Instant,
    /// The ticket of the client that gave the command.
    ticket: Ticket,
    /// The tickets of clients that joined the command, and wait for its result too.
    joined: Vec<Ticket>,
    shown: Shown,
    tries: Tries,
    ending: Ending,
    phase: Phase,
    on_wire: OnWire,
    known: RequestContext,
    /// The drive refused the function code of the present step, so the alternative function is being tried.
    by_other_function: bool,
    /// The register, or coil, of the run command.
    control: Option<(Table, u16)>,
    look: MotorRead,
    next_direction: NextDirection,
    /// Whether the command waited for a late reply since its last step was chosen.
    held_up: bool,
    /// Stops that were done since the command's last write.
    overtaken: u32,
    /// The command in the form in which it was ordered.
    intent: Intent,
    /// The start that the command causes, of a motor whose starts are counted.
    pub(super) start: Option<Start>,
    /// Whether supervision follows the client of the command.
    pub renews: bool,
}

impl CommandRun {
    /// Arranges the steps in a safe order: a stop first, references before run, a reset before a new run edge. A
    /// command that cannot be sent as a whole is refused; a stop is sent as far as possible.
    pub fn new(command: Command, profile: &Profile) -> CommandRun {
        let urgency = command.urgency();
        let Command {
            intent, work, ticket, ..
        } = command;
        let order = intent.order.clone();
        let (reference_only, behind, was_begun, joined) = match work {
            Work::Stop(stop) => (false, false, stop.was_begun, stop.joined),
            Work::Set(set) => (set.reference_only, set.behind.is_some(), false, Vec::new()),
            Work::Read | Work::PassedOn(_) => (false, false, false, Vec::new()),
        };
        let expires = intent.window.expires;
        let shown = match &order {
            Order::Parameter(order) if order.from.is_some() => Shown::ReadBack,
            order => Shown::ByReads(confirm::effects(profile, order)),
        };
        let scope = Scope {
            whole: matches!(&order, Order::Points(values) if sets_all_bits(profile, values)),
            reference_only,
        };
        let next_direction = NextDirection::of(profile, &order, urgency);
        let known = RequestContext {
            check: Check::NotYet,
            blind: false,
            names_run: matches!(&order, Order::Points(values) if names_run(profile, values)),
            stopped: false,
            running: true,
            masks: false,
            permit: None,
        };
        let parameter = match &order {
            Order::Parameter(order) => ParameterRun::new(order.clone(), profile),
            Order::Points(_) | Order::Write(_) | Order::Read(_) => None,
        };
        let unsendable = match &order {
            Order::Points(values) => unsendable(profile, values),
            Order::Write(_) | Order::Read(_) => None,
            Order::Parameter(_) => parameter.is_none().then(|| running_unknown(&profile.name)),
        };
        let actions = match order {
            Order::Parameter(_) => parameter
                .map(|run| Action::Parameter(Box::new(run)))
                .into_iter()
                .collect(),
            Order::Write(pdu) | Order::Read(pdu) => VecDeque::from([Action::Send(pdu)]),
            Order::Points(_) if unsendable.is_some() && urgency != Urgency::Stop => VecDeque::new(),
            Order::Points(values) => actions(profile, &values, urgency == Urgency::Stop, behind),
        };
        let actions = actions
            .into_iter()
            .flat_map(|action| write_on_change(action, profile))
            .collect();
        CommandRun {
            urgency,
            rank: urgency,
            scope,
            actions,
            pause: Pause::No,
            expires: joined.iter().map(|(_, joined)| *joined).fold(expires, Instant::max),
            ticket,
            joined: joined.into_iter().map(|(ticket, _)| ticket).collect(),
            shown,
            tries: Tries {
                failures: 0,
                unanswered: Outcome::TimedOut,
                doubt: Doubt::No,
                busy: 0,
                due: None,
            },
            ending: match unsendable {
                Some(refusal) => Ending::Cut(Outcome::Refused(refusal)),
                None => Ending::Acknowledged(Reply::Written),
            },
            phase: Phase::Steps,
            on_wire: if was_begun { OnWire::Command } else { OnWire::Nothing },
            known,
            by_other_function: false,
            control: profile.run_place().map(|place| (place.table, place.address)),
            look: MotorRead::NotTaken,
            next_direction,
            held_up: false,
            overtaken: 0,
            intent,
            start: None,
            renews: true,
        }
    }

    /// The client's stop in the form in which it was ordered: the bus that replaces this one sends it completely.
    ///
    /// # Errors
    /// If the command is not a stop of a client.
    pub fn into_stop(mut self) -> Result<Command, Box<CommandRun>> {
        if self.urgency != Urgency::Stop || !self.is_of_client() {
            return Err(Box::new(self));
        }
        let (expires, was_begun) = (self.expires, self.has_begun());
        let joined = self.joined.into_iter().map(|ticket| (ticket, expires)).collect();
        self.intent.window.expires = expires;
        Ok(Command::begun_stop(self.intent, was_begun, self.ticket, joined))
    }

    /// The command in the form in which it was ordered.
    pub fn intent(&self) -> &Intent {
        &self.intent
    }

    /// The ticket of the client that gave the command.
    pub fn ticket(&self) -> &Ticket {
        &self.ticket
    }

    /// The tickets of all clients that wait for the result.
    fn tickets(&self) -> impl Iterator<Item = &Ticket> {
        std::iter::once(&self.ticket).chain(&self.joined)
    }

    /// Rank of the command.
    pub fn urgency(&self) -> Urgency {
        self.urgency
    }

    /// Whether the command sets references only, which starts no motor.
    pub fn is_reference_only(&self) -> bool {
        self.scope.reference_only
    }

    /// When the time of the command expires.
    pub fn expires(&self) -> Instant {
        self.expires
    }

    /// Handles a long stall of the bus thread; `slept` is the part during which the machine was suspended. A
    /// command in progress is not continued.
    pub fn interrupted(&mut self, slept: Duration, now: Instant) {
        let expires = self.expires.checked_sub(slept).unwrap_or(now);
        self.expires = if self.reached_the_wire() {
            expires.min(now)
        } else {
            expires
        };
    }

    /// Whether a client gave the command, and not the gateway itself.
    pub fn is_of_client(&self) -> bool {
        let kind = |ticket: &Ticket| ticket.origin().kind;
        self.urgency != Urgency::Read && self.tickets().any(|ticket| kind(ticket).is_client())
    }

    /// Whether the command renews the lease of its drive.
    pub fn is_heard(&self) -> bool {
        self.renews && self.is_of_client()
    }

    /// The clients that wait for the command.
    pub fn origins(&self) -> impl Iterator<Item = &Origin> {
        self.tickets().map(Ticket::origin)
    }

    /// Whether a tool sent the command, which then has the line share of background transactions.
    pub fn is_of_tool(&self) -> bool {
        self.tickets().any(|ticket| ticket.origin().kind == SourceKind::Slot)
    }

    /// Whether all parts of the command come from supervision.
    pub fn is_of_supervision(&self) -> bool {
        self.tickets().all(|ticket| ticket.origin().is_lease())
    }

    /// Whether the rules judge the frames of the command: stops and the ends of pulses are always sent.
    pub fn is_judged(&self) -> bool {
        self.urgency == Urgency::Command && self.may_write_on()
    }

    /// Takes the verdict about what the next word would repeat. With [`Verdict::LookFirst`], the next step reads the motor.
    pub(crate) fn judged(&mut self, repeats: Repeats, verdict: Verdict) {
        match verdict {
            Verdict::Go => self.known.permit = Some(Permit::Write(repeats)),
            Verdict::LookFirst => self.known.permit = Some(Permit::Look(repeats)),
            Verdict::Refuse(outcome) => self.give_up(self.unless_in_doubt(outcome)),
            Verdict::Wait(_) => {}
        }
    }

    /// Whether the command may write more than the end of a pulse.
    pub fn may_write_on(&self) -> bool {
        self.phase != Phase::OnlyEnds
    }

    /// Whether at least a part of the command was on the wire; a preparatory read does not count.
    pub fn has_begun(&self) -> bool {
        self.on_wire == OnWire::Command
    }

    /// Whether any step of the command was on the wire.
    pub fn reached_the_wire(&self) -> bool {
        self.on_wire != OnWire::Nothing
    }

    /// The state of a parameter write, if the command is one.
    fn parameter(&mut self) -> Option<&mut ParameterRun> {
        match self.actions.front_mut() {
            Some(Action::Parameter(run)) => Some(run),
            _ => None,
        }
    }

    /// Whether the write must be the very next transaction: the drive has just reported whether its motor runs (for
    /// a parameter, or a word that does not decide that), or a settings register was just read to change one of its
    /// bits.
    pub fn is_checked(&mut self) -> bool {
        let settings = self.known.check == Check::Read && self.settings().is_some();
        settings || self.look.motor().is_some() || self.parameter().is_some_and(|run| run.is_checked())
    }

    /// Notes that another transaction goes first: the motor state, or the other settings of the register, must then
    /// be read again before the write.
    pub fn others_go_first(&mut self) {
        if self.settings().is_some() || self.look.forget() {
            self.known.check = Check::NotYet;
        }
        if let Some(run) = self.parameter() {
            run.check_again();
        }
    }

    /// The register of the present step, if the step changes one bit and must leave other settings of the register
    /// unchanged.
    fn settings(&self) -> Option<(Table, u16)> {
        let raw = match self.actions.front()? {
            Action::Bits { raw, .. } | Action::PulseLow { raw, .. } | Action::PulseHigh { raw, .. } => raw,
            _ => return None,
        };
        let place = (raw.table, raw.address);
        (raw.table == Table::Holding && self.control != Some(place)).then_some(place)
    }

    /// Records that a step of the command is on the wire.
    pub fn sent(&mut self, step: &Step) {
        if let Some(run) = self.parameter().filter(|_| step.purpose == StepPurpose::Execute) {
            run.written();
        }
        let sent = if step.pdu.is_write() || self.urgency == Urgency::Read {
            OnWire::Command
        } else {
            OnWire::Reads
        };
        self.on_wire = self.on_wire.max(sent);
        if step.pdu.is_write() {
            if let Some(Action::Word(Word::Sequence(word, _))) = self.actions.front()
                && self.phase == Phase::Steps
                && word.is_last
            {
                self.phase = Phase::MotorStarted;
            }
            self.overtaken = 0;
            // The motor must be read again before the next write.
            self.look.forget();
        }
    }

    /// Records that a stop to the drive was done first.
    pub fn overtaken(&mut self) {
        self.overtaken = self.overtaken.saturating_add(1);
    }

    /// Whether the end of the pulse is sent before the next stop, because enough stops were sent before it.
    pub fn is_deferred(&self) -> bool {
        !self.may_write_on() && self.overtaken >= MOST_STOPS
    }

    /// The outcome `unbegun` if no part of the command was sent; otherwise the command was cut short, and its
    /// result is unknown.
    fn unless_begun(&self, unbegun: Outcome, why: Interruption) -> Outcome {
        if self.has_begun() {
            Outcome::Interrupted(why)
        } else {
            unbegun
        }
    }

    /// The reply to the last step may be a late reply to an earlier request: the step is repeated when no late
    /// reply can arrive any more.
    pub fn wait_for_late_replies(&mut self) {
        self.ask_before_repeating();
        self.tries.doubt = Doubt::LateReply;
    }

    fn ask_before_repeating(&mut self) {
        if let Some(run) = self.parameter() {
            run.begin_again();
        }
    }

    /// Whether the command waits because a late reply could be mistaken for the reply to its step. A stop is sent
    /// first and waits only afterwards.
    pub fn waits_for_late(&self) -> bool {
        self.urgency != Urgency::Stop || self.tries.doubt == Doubt::LateReply
    }

    /// Notes that the command must wait for a late reply: the values that it has read are outdated afterwards.
    pub fn hold_up(&mut self) {
        self.held_up = true;
    }

    /// Continues the command after a wait. Returns whether it first repeats its reads: the motor may have been
    /// stopped meanwhile.
    pub fn asks_again(&mut self) -> bool {
        let held_up = std::mem::take(&mut self.held_up);
        if held_up && self.is_checked() {
            self.others_go_first();
            return true;
        }
        let again = held_up && self.known.check == Check::Read;
        if again {
            self.known.check = Check::NotYet;
        }
        again
    }

    fn pop(&mut self) {
        self.actions.pop_front();
        self.known.check = Check::NotYet;
        self.by_other_function = false;
    }

    /// Whether the command has expired while steps remain that were not cancelled yet.
    pub fn is_late(&self, now: Instant) -> bool {
        now >= self.expires && self.may_write_on()
    }
}

#[cfg(test)]
mod tests;
