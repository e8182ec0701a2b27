//! A command step by step: control words from a shadow, pulses, safe order. Pure.

use std::collections::{BTreeMap, VecDeque};
use std::time::{Duration, Instant};

use super::confirm::{self, Effect};
use crate::cache::Reading;
use crate::codec::n2::Session;
use crate::codec::{Exception, Reply, RequestPdu, Table};
use crate::command::{Command, Order, Outcome, Receipt, Ticket, Urgency, written};
use crate::drive::profile::Form;
use crate::drive::{ModelPoint, Point, PollClass, Profile, Raw, Value};

/// The registers of all drives of a bus whose bits are commanded, as the drives have them.
///
/// Filled by reading the drive's own words and by acknowledged writes, never by assumption.
#[derive(Debug, Default)]
pub struct Shadow(BTreeMap<(usize, Table, u16), u16>);

impl Shadow {
    /// A word that the drive has.
    pub fn learn(&mut self, drive: usize, table: Table, address: u16, word: u16) {
        if matches!(table, Table::Holding | Table::Coil) {
            self.0.insert((drive, table, address), word);
        }
    }

    /// The word, if it is known.
    pub fn get(&self, drive: usize, address: u16) -> Option<u16> {
        self.0.get(&(drive, Table::Holding, address)).copied()
    }

    /// Whether the drive is known to have all of that.
    fn has(&self, drive: usize, table: Table, items: &[(u16, u16)]) -> bool {
        let has = |(address, word): &(u16, u16)| self.0.get(&(drive, table, *address)) == Some(word);
        items.iter().all(has)
    }

    /// The drive may have started anew: its words are read again before a bit is changed.
    pub fn forget(&mut self, drive: usize) {
        self.0.retain(|(of, _, _), _| *of != drive);
    }
}

/// What a command needs next.
#[derive(Debug, Clone, PartialEq)]
pub enum Next {
    /// This request on the line.
    Send(RequestPdu),
    /// Nothing before then.
    Wait(Instant),
    /// It is done.
    Done,
}

#[derive(Debug, Clone, PartialEq)]
enum Action {
    /// A raw request, or a register of its own.
    Send(RequestPdu),
    /// A write of what the drive keeps: left out where it is known to have it already.
    Change {
        pdu: RequestPdu,
        table: Table,
        items: Vec<(u16, u16)>,
    },
    /// Gives what was overridden before back to the drive's own control; that it fails changes nothing.
    Release(RequestPdu),
    /// Bits of one word, merged into the shadow when they are sent.
    Bits { raw: Raw, changes: Vec<(u8, bool)> },
    /// Takes the run command away from a motor that stands, where it is no bit of the word with the reset bit.
    Disarm { raw: Raw, bit: u8, invert: bool },
    /// Takes the reset bit (and the run bit of a motor that stands) away, if set.
    PulseLow { raw: Raw, bit: u8, invert: bool },
    /// Sets the reset bit.
    PulseHigh { raw: Raw, bit: u8, invert: bool },
    /// Takes the reset bit away again.
    PulseEnd { raw: Raw, bit: u8, invert: bool },
    /// Two update periods of the drive.
    Hold(Duration),
}

/// Whether the drive was asked for what it has before it is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Check {
    NotYet,
    Read,
    /// It does not tell.
    InVain,
}

/// A command that the bus has begun.
#[derive(Debug)]
pub struct Execution {
    /// Index of the drive.
    pub drive: usize,
    /// Rank.
    pub urgency: Urgency,
    actions: VecDeque<Action>,
    not_before: Option<Instant>,
    ticket: Ticket,
    effects: Vec<Effect>,
    expires: Instant,
    /// Set when it ends before all was sent.
    cut: Option<Outcome>,
    /// Nothing is left but the end of a pulse, which is sent whatever happens.
    only_ends: bool,
    reply: Reply,
    failures: u32,
    /// A write was sent and not answered: whether the drive took it is not known.
    in_doubt: bool,
    /// It sets every bit that can be commanded, reset bits apart.
    whole: bool,
    /// What the drive last said of its motor.
    running: bool,
    /// Whether the drive was asked for what it has before it is written.
    check: Check,
    /// What is known of the words of the next step is as good as read just now.
    fresh: bool,
    /// The drive does not tell its own word: bits that the command does not set are written as 0.
    blind: bool,
}

impl Execution {
    /// Lays the command out in the order that is safe: a stop before anything, references before run, a reset
    /// before a new run edge.
    pub fn new(command: Command, profile: &Profile) -> Execution {
        let Command {
            drive,
            order,
            urgency,
            ticket,
            expires,
            ..
        } = command;
        let effects = confirm::effects(profile, &order);
        let whole = matches!(&order, Order::Points(values) if sets_all_bits(profile, values));
        let actions = match order {
            Order::Write(pdu) | Order::Read(pdu) => VecDeque::from([Action::Send(pdu)]),
            Order::Points(values) => actions(profile, &values, urgency == Urgency::Stop),
        };
        let actions = actions
            .into_iter()
            .flat_map(|action| sparing(action, profile))
            .collect();
        Execution {
            drive,
            urgency,
            actions,
            not_before: None,
            ticket,
            effects,
            expires,
            cut: None,
            only_ends: false,
            reply: Reply::Written,
            failures: 0,
            in_doubt: false,
            whole,
            running: true,
            check: Check::NotYet,
            fresh: false,
            blind: false,
        }
    }

    /// Looks at how good the knowledge of the words is that the next step would write: read often enough, and good.
    pub fn look(&mut self, reading: &Reading<'_>) {
        let (table, addresses): (Table, Vec<u16>) = match self.actions.front() {
            Some(Action::Change { table, items, .. }) => (*table, items.iter().map(|(a, _)| *a).collect()),
            _ => return,
        };
        let points = &reading.spec.profile.points;
        let is_read = |p: &Point| p.on_change && matches!(p.class, PollClass::Fast | PollClass::Slow);
        self.fresh = addresses.iter().all(|address| {
            let covers = |p: &Point| p.write && p.raw().is_some_and(|raw| raw.covers(table, *address));
            let mut those = points.iter().enumerate().filter(|(_, p)| covers(p)).peekable();
            those.peek().is_some() && those.all(|(index, p)| is_read(p) && reading.sample(index).good().is_some())
        });
    }

    /// What the command needs next. `running` is what the drive last said. Once its time ran out nothing of it is
    /// sent any more, but a reset bit that is set is taken away.
    pub fn next(&mut self, shadow: &Shadow, profile: &Profile, running: bool, now: Instant) -> Next {
        self.running = running;
        if self.is_late(now) {
            let outcome = if self.failures > 0 || self.in_doubt {
                Outcome::TimedOut
            } else {
                Outcome::Expired
            };
            self.cut_off(outcome);
        }
        if let Some(at) = self.not_before {
            if now < at {
                return Next::Wait(at);
            }
            self.not_before = None;
        }
        loop {
            let Some(action) = self.actions.front() else {
                return Next::Done;
            };
            if let Action::Hold(time) = action {
                let until = now + *time;
                self.actions.pop_front();
                self.not_before = Some(until);
                return Next::Wait(until);
            }
            let known = (self.check, self.fresh, self.blind);
            match request(action, self.drive, shadow, profile, running, known) {
                Some(pdu) => return Next::Send(pdu),
                // Nothing to take away: the pulse starts at once, without the pause behind. Nothing to change: nothing is
                // overridden that would have to be released.
                None => {
                    self.pop();
                    if matches!(self.actions.front(), Some(Action::Hold(_) | Action::Release(_))) {
                        self.pop();
                    }
                }
            }
        }
    }

    fn pop(&mut self) {
        self.actions.pop_front();
        self.check = Check::NotYet;
        self.fresh = false;
    }

    /// Its time ran out, and what is left of it was not cut off yet.
    pub fn is_late(&self, now: Instant) -> bool {
        now >= self.expires && !self.only_ends
    }

    /// The drive answered the request that [`Execution::next`] gave. The outcome, when the command is over.
    pub fn answered(&mut self, sent: &RequestPdu, reply: Reply, shadow: &mut Shadow) -> Option<Outcome> {
        self.failures = 0;
        // An exception tells nothing of an earlier try that was not answered.
        if sent.is_write() && !matches!(reply, Reply::Exception(_)) {
            self.in_doubt = false;
        }
        if let (Some(Action::Release(_)), Reply::Exception(code)) = (self.actions.front(), &reply) {
            return self.not_released(&code.to_string());
        }
        if self.checks(sent) {
            self.check = learn(self.drive, sent, &reply, shadow);
            return None;
        }
        if let Reply::Exception(code) = reply {
            let kept_back = [Exception::FUNCTION, Exception::ADDRESS, Exception::VALUE].contains(&code);
            if self.reads_word(sent) && (kept_back || self.urgency == Urgency::Stop) {
                return self.without_word(Outcome::Exception(code));
            }
            return Some(Outcome::Exception(code));
        }
        note_write(self.drive, sent, shadow);
        if let RequestPdu::Read { table, start, .. } = sent
            && self.reads_word(sent)
        {
            // The drive's own word, read because the shadow did not have it.
            return match reply {
                Reply::Registers(words) => {
                    let word = words.first().copied()?;
                    shadow.learn(self.drive, *table, *start, word);
                    None
                }
                _ => Some(Outcome::Exception(Exception::DEVICE_FAILURE)),
            };
        }
        if !matches!(self.actions.front(), Some(Action::Release(_))) {
            self.reply = reply;
        }
        self.pop();
        self.actions.is_empty().then(|| self.success())
    }

    /// Whether that request asks for what the drive has before it is written.
    fn checks(&self, sent: &RequestPdu) -> bool {
        matches!(
            (sent, self.actions.front()),
            (RequestPdu::Read { .. }, Some(Action::Change { .. }))
        )
    }

    /// The value stands all the same: a supervisor that looks away does not see changes at the panel, no more.
    fn not_released(&mut self, why: &str) -> Option<Outcome> {
        tracing::warn!("an output was written but not released to the drive's own control: {why}");
        self.failures = 0;
        self.pop();
        self.actions.is_empty().then(|| self.success())
    }

    /// No believable answer came. The outcome, when the tries are used up.
    pub fn failed(&mut self, sent: &RequestPdu, retries: u32) -> Option<Outcome> {
        self.failures += 1;
        self.in_doubt |= sent.is_write();
        let over = self.failures > retries;
        if over && matches!(self.actions.front(), Some(Action::Release(_))) {
            return self.not_released("no answer");
        }
        if self.checks(sent) && self.urgency == Urgency::Stop {
            self.check = Check::InVain;
            return None;
        }
        if self.checks(sent) {
            return over.then(|| self.cut.clone().unwrap_or(Outcome::TimedOut));
        }
        if self.reads_word(sent) && (over || self.urgency == Urgency::Stop) {
            return self.without_word(Outcome::TimedOut);
        }
        over.then(|| self.cut.clone().unwrap_or(Outcome::TimedOut))
    }

    /// What was sent was acknowledged, perhaps by a late reply to something else.
    pub fn doubted(&mut self) {
        self.in_doubt = true;
    }

    /// Whether the drive may have taken a write that it did not answer: its words are not known then.
    pub fn in_doubt(&self) -> bool {
        self.in_doubt
    }

    /// Whether that request reads the drive's own word, which the shadow did not have.
    fn reads_word(&self, sent: &RequestPdu) -> bool {
        matches!(sent, RequestPdu::Read { .. }) && !matches!(self.actions.front(), Some(Action::Send(_)) | None)
    }

    /// The drive does not tell its own word. A stop goes out all the same: no read stands in its way. So does a
    /// command to a motor that stands, and one that sets every bit; another one could stop or turn a motor that runs,
    /// and ends with `outcome`.
    fn without_word(&mut self, outcome: Outcome) -> Option<Outcome> {
        if self.urgency != Urgency::Stop && self.running && !self.whole {
            return Some(outcome);
        }
        self.blind = true;
        self.failures = 0;
        None
    }

    /// A stop came in: what is not sent yet is not sent any more, but a reset bit that is set is taken away.
    /// Whether the command is over by that.
    pub fn purge(&mut self) -> bool {
        self.cut_off(Outcome::Purged);
        self.actions.is_empty()
    }

    fn cut_off(&mut self, outcome: Outcome) {
        let before = self.actions.len();
        // A bit whose setting was sent and not answered may be set.
        if self.failures > 0 && matches!(self.actions.front(), Some(Action::PulseHigh { .. })) {
            self.actions.pop_front();
        }
        let high = self.actions.iter().any(|a| matches!(a, Action::PulseHigh { .. }));
        self.actions
            .retain(|a| !high && matches!(a, Action::PulseEnd { .. } | Action::Hold(_)));
        // A hold without the end of a pulse behind it holds nothing.
        if !self.actions.iter().any(|a| matches!(a, Action::PulseEnd { .. })) {
            self.actions.clear();
        }
        self.only_ends = true;
        if before != self.actions.len() {
            self.cut = Some(outcome);
            self.failures = 0;
        }
    }

    /// How the command ends when nothing is left to do.
    pub fn success(&self) -> Outcome {
        match &self.cut {
            Some(outcome) => outcome.clone(),
            None => Outcome::Acknowledged(self.reply.clone()),
        }
    }

    /// Answers a command that the drive took; what a read must show, and the receipt that tells so.
    pub fn acknowledge(self, outcome: Outcome, now: Instant) -> (Vec<Effect>, Receipt) {
        (self.effects, self.ticket.acknowledge(outcome, now))
    }

    /// Answers the command.
    pub fn finish(self, outcome: Outcome, now: Instant) {
        self.ticket.answer(outcome, now);
    }
}

/// A word and the bits of it that change.
type WordChange = (Raw, Vec<(u8, bool)>);

/// Whether a command sets every bit of the profile that can be commanded, reset bits apart.
fn sets_all_bits(profile: &Profile, values: &[(usize, Value)]) -> bool {
    let level = |p: &Point| p.write && !p.pulse && p.raw().is_some_and(|r| matches!(r.form, Form::Bit { .. }));
    let mut bits = profile.points.iter().enumerate().filter(|(_, p)| level(p));
    bits.all(|(bit, _)| values.iter().any(|(index, _)| *index == bit))
}

fn actions(profile: &Profile, values: &[(usize, Value)], stop: bool) -> VecDeque<Action> {
    let mut numbers = VecDeque::new();
    let mut pulses = VecDeque::new();
    let mut words: BTreeMap<(Table, u16), WordChange> = BTreeMap::new();
    for (index, value) in values {
        let Some(point) = profile.points.get(*index) else {
            continue;
        };
        let Some(raw) = point.raw() else { continue };
        match raw.form {
            Form::Bit { bit, invert } if point.pulse => {
                if value.as_bool() {
                    let hold = Action::Hold(2 * profile.update_period);
                    let elsewhere = |run: &Raw| (run.table, run.address) != (raw.table, raw.address);
                    if let Some((run, bit, invert)) = profile.run_bit().filter(|(run, ..)| elsewhere(run)) {
                        let raw = run.clone();
                        pulses.push_back(Action::Disarm { raw, bit, invert });
                    }
                    pulses.push_back(Action::PulseLow {
                        raw: raw.clone(),
                        bit,
                        invert,
                    });
                    pulses.push_back(hold.clone());
                    pulses.push_back(Action::PulseHigh {
                        raw: raw.clone(),
                        bit,
                        invert,
                    });
                    pulses.push_back(hold);
                    pulses.push_back(Action::PulseEnd {
                        raw: raw.clone(),
                        bit,
                        invert,
                    });
                }
            }
            Form::Bit { bit, invert } => {
                let entry = words
                    .entry((raw.table, raw.address))
                    .or_insert_with(|| (raw.clone(), Vec::new()));
                entry.1.push((bit, value.as_bool() != invert));
            }
            Form::Bits { first, count } => {
                let Some(word) = raw.encode(*value, 0).ok().and_then(|words| words.first().copied()) else {
                    continue;
                };
                let entry = words
                    .entry((raw.table, raw.address))
                    .or_insert_with(|| (raw.clone(), Vec::new()));
                let bits = first..first.saturating_add(count);
                entry.1.extend(bits.map(|bit| (bit, (word >> bit) & 1 == 1)));
            }
            _ => {
                // Admitted values fit; one that does not is left out rather than sent wrong.
                let pdu = raw
                    .encode(*value, 0)
                    .ok()
                    .and_then(|words| write_of(raw.address, words));
                numbers.extend(pdu.map(Action::Send));
            }
        }
    }
    // The run command of a drive whose bits are coils goes first in a stop, and last, behind the direction, otherwise.
    let run = profile.run_bit().map(|(raw, ..)| (raw.table, raw.address));
    let run = run.and_then(|place| words.remove(&place));
    let others = words.into_values();
    let action = |(raw, changes): WordChange| Action::Bits { raw, changes };
    if stop {
        let bits = run.into_iter().chain(others).map(action);
        bits.chain(numbers).chain(pulses).collect()
    } else {
        let bits = others.chain(run).map(action);
        numbers.into_iter().chain(pulses).chain(bits).collect()
    }
}

fn write_of(address: u16, words: Vec<u16>) -> Option<RequestPdu> {
    match words.as_slice() {
        [] => None,
        [value] => Some(RequestPdu::WriteRegister { address, value: *value }),
        _ => Some(RequestPdu::WriteRegisters {
            start: address,
            values: words,
        }),
    }
}

/// The request of an action with the shadow as it is now; a read where the shadow does not know the word;
/// `None` where there is nothing to do. `blind`: the word cannot be read.
fn request(
    action: &Action,
    drive: usize,
    shadow: &Shadow,
    profile: &Profile,
    running: bool,
    (check, fresh, blind): (Check, bool, bool),
) -> Option<RequestPdu> {
    let (raw, changes) = match action {
        Action::Send(pdu) | Action::Release(pdu) => return Some(pdu.clone()),
        Action::Change { pdu, table, items } => {
            let has = shadow.has(drive, *table, items);
            return match check {
                Check::NotYet if fresh && has => None,
                Check::NotYet if fresh => Some(pdu.clone()),
                Check::NotYet => read_of(*table, items).or_else(|| Some(pdu.clone())),
                Check::Read => (!has).then(|| pdu.clone()),
                Check::InVain => Some(pdu.clone()),
            };
        }
        Action::Hold(_) => return None,
        Action::Bits { raw, changes } => (raw, changes.clone()),
        Action::Disarm { .. } if running => return None,
        Action::Disarm { raw, bit, invert } => (raw, vec![(*bit, *invert)]),
        Action::PulseHigh { raw, bit, invert } => (raw, vec![(*bit, !invert)]),
        Action::PulseEnd { raw, bit, invert } => (raw, vec![(*bit, *invert)]),
        Action::PulseLow { raw, bit, invert } => {
            let mut changes = vec![(*bit, *invert)];
            // A reset must not start the motor: a run bit left over from before the fault is taken away.
            if !running && let Some(run) = standing_run_bit(profile, raw) {
                changes.push(run);
            }
            (raw, changes)
        }
    };
    if raw.table == Table::Coil {
        let on = changes.first().is_some_and(|(_, on)| *on);
        return Some(RequestPdu::WriteCoil {
            address: raw.address,
            on,
        });
    }
    let Some(old) = shadow.get(drive, raw.address).or(blind.then_some(0)) else {
        return Some(RequestPdu::Read {
            table: raw.table,
            start: raw.address,
            count: 1,
        });
    };
    let value = changes.iter().fold(
        old,
        |word, (bit, on)| if *on { word | (1 << bit) } else { word & !(1 << bit) },
    );
    let idle = matches!(action, Action::PulseLow { .. } | Action::Disarm { .. }) && value == old;
    (!idle).then_some(RequestPdu::WriteRegister {
        address: raw.address,
        value,
    })
}

fn standing_run_bit(profile: &Profile, of: &Raw) -> Option<(u8, bool)> {
    let run = profile.model_point(ModelPoint::Run)?.raw()?;
    match run.form {
        Form::Bit { bit, invert } if run.table == of.table && run.address == of.address => Some((bit, invert)),
        _ => None,
    }
}

/// A write that spares the drive's memory, where its words are such that wear: left out when the drive has them, and
/// what N2 overrides is released afterwards, where the profile says so. A stop is never left out.
fn sparing(action: Action, profile: &Profile) -> Vec<Action> {
    let written = match &action {
        Action::Send(pdu) => written(pdu).map(|(table, items)| (pdu.clone(), table, items)),
        Action::Bits { raw, changes } if raw.table == Table::Coil => changes.first().map(|(_, on)| {
            let (address, on) = (raw.address, *on);
            let pdu = RequestPdu::WriteCoil { address, on };
            (pdu, raw.table, vec![(address, u16::from(on))])
        }),
        _ => None,
    };
    let Some((pdu, table, items)) = written.filter(|(_, table, items)| profile.writes_on_change(*table, items)) else {
        return vec![action];
    };
    let address = items.first().map(|(address, _)| *address);
    let release = address
        .filter(|_| profile.releases(table))
        .map(|address| Action::Release(RequestPdu::N2(Session::Release { table, address })));
    let change = Action::Change { pdu, table, items };
    [change].into_iter().chain(release).collect()
}

/// The read of the words of a write.
fn read_of(table: Table, items: &[(u16, u16)]) -> Option<RequestPdu> {
    let (start, _) = *items.first()?;
    let count = u16::try_from(items.len()).ok()?;
    Some(RequestPdu::Read { table, start, count })
}

/// What the drive has, as it says.
fn learn(drive: usize, sent: &RequestPdu, reply: &Reply, shadow: &mut Shadow) -> Check {
    let (RequestPdu::Read { table, start, count }, Some(words)) = (sent, reply.words()) else {
        return Check::InVain;
    };
    for (address, word) in (*start..).zip(&words) {
        shadow.learn(drive, *table, address, *word);
    }
    if words.len() == usize::from(*count) {
        Check::Read
    } else {
        Check::InVain
    }
}

/// Acknowledged words are known from then on.
fn note_write(drive: usize, sent: &RequestPdu, shadow: &mut Shadow) {
    if let Some((table, items)) = written(sent) {
        for (address, word) in items {
            shadow.learn(drive, table, address, word);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use tokio::sync::oneshot::Receiver;

    use super::*;
    use crate::command::{Answer, Origin, SourceKind, WriteStats};
    use crate::drive::profile::Profiles;

    struct Bench {
        profile: Arc<Profile>,
        shadow: Shadow,
        now: Instant,
        /// Control word and reference as the drive has them.
        drive: BTreeMap<u16, u16>,
        running: bool,
    }

    impl Bench {
        fn new(control_word: u16) -> Bench {
            let profile = Profiles::built_in().get("vacon-nx").unwrap().clone();
            let drive = BTreeMap::from([(2000, control_word), (2002, 0)]);
            Bench {
                profile,
                shadow: Shadow::default(),
                now: Instant::now(),
                drive,
                running: false,
            }
        }

        fn begin(&self, points: &[(&str, f64)], urgency: Urgency) -> (Execution, Receiver<Answer>) {
            let values = points
                .iter()
                .map(|(name, v)| {
                    let index = self.profile.point_index(name).unwrap();
                    let bool = matches!(*name, "run" | "reverse" | "fault_reset");
                    (
                        index,
                        if bool {
                            Value::Bool(*v != 0.0)
                        } else {
                            Value::Number(*v)
                        },
                    )
                })
                .collect();
            let origin = Origin {
                kind: SourceKind::Mqtt,
                who: "t".into(),
            };
            let stats = Arc::new(WriteStats::default());
            let (ticket, receiver) = Ticket::new(origin, "d", String::new(), true, self.now, stats);
            let expires = self.now + Duration::from_secs(1);
            let command = Command {
                drive: 0,
                order: Order::Points(values),
                urgency,
                reference_only: false,
                expires,
                ticket,
            };
            (Execution::new(command, &self.profile), receiver)
        }

        /// Runs the command against a drive that does as it is told; the writes as (ms, address, value).
        fn run(&mut self, execution: &mut Execution) -> Vec<(u128, u16, u16)> {
            let start = self.now;
            let mut writes = Vec::new();
            for _ in 0..50 {
                match execution.next(&self.shadow, &self.profile, self.running, self.now) {
                    Next::Done => return writes,
                    Next::Wait(until) => self.now = until,
                    Next::Send(pdu) => {
                        let reply = match pdu {
                            RequestPdu::Read { start, .. } => Reply::Registers(vec![self.drive[&start]]),
                            RequestPdu::WriteRegister { address, value } => {
                                writes.push(((self.now - start).as_millis(), address, value));
                                self.drive.insert(address, value);
                                Reply::Written
                            }
                            _ => unreachable!(),
                        };
                        if execution.answered(&pdu, reply, &mut self.shadow).is_some() {
                            return writes;
                        }
                    }
                }
            }
            panic!("the command does not end");
        }
    }

    #[test]
    fn bits_of_others_are_kept_and_the_word_is_read_first() {
        let mut bench = Bench::new(0x0800);
        let (mut execution, _answer) = bench.begin(&[("run", 1.0)], Urgency::Command);
        assert!(matches!(
            execution.next(&bench.shadow, &bench.profile, false, bench.now),
            Next::Send(RequestPdu::Read {
                start: 2000,
                count: 1,
                ..
            })
        ));
        assert_eq!(bench.run(&mut execution), [(0, 2000, 0x0801)]);
        assert_eq!(execution.success(), Outcome::Acknowledged(Reply::Written));
    }

    #[test]
    fn safe_order() {
        let mut bench = Bench::new(0);
        let (mut start, _a) = bench.begin(
            &[("run", 1.0), ("reverse", 1.0), ("speed_reference", 50.0)],
            Urgency::Command,
        );
        assert_eq!(
            bench.run(&mut start),
            [(0, 2002, 5000), (0, 2000, 3)],
            "reference before run, one control word"
        );
        let (mut stop, _b) = bench.begin(&[("speed_reference", 0.0), ("run", 0.0)], Urgency::Stop);
        assert_eq!(
            bench.run(&mut stop),
            [(0, 2000, 2), (0, 2002, 0)],
            "stop before anything"
        );
    }

    #[test]
    fn reset_is_a_pulse_whatever_the_level_and_starts_nothing() {
        let mut bench = Bench::new(0);
        let (mut reset, _a) = bench.begin(&[("fault_reset", 1.0)], Urgency::Command);
        assert_eq!(bench.run(&mut reset), [(0, 2000, 4), (20, 2000, 0)]);
        // The bit is set already, and so is the run bit of a motor that stands with a fault.
        let mut bench = Bench::new(0x0005);
        let (mut reset, _a) = bench.begin(&[("fault_reset", 1.0)], Urgency::Command);
        assert_eq!(bench.run(&mut reset), [(0, 2000, 0), (20, 2000, 4), (40, 2000, 0)]);
        // A motor that runs keeps its run bit.
        let mut bench = Bench::new(0x0001);
        bench.running = true;
        let (mut reset, _a) = bench.begin(&[("fault_reset", 1.0)], Urgency::Command);
        assert_eq!(bench.run(&mut reset), [(0, 2000, 5), (20, 2000, 1)]);
        // Reset and run in one command: a new edge after the pulse.
        let mut bench = Bench::new(0x0001);
        let (mut both, _a) = bench.begin(&[("run", 1.0), ("fault_reset", 1.0)], Urgency::Command);
        assert_eq!(
            bench.run(&mut both),
            [(0, 2000, 0), (20, 2000, 4), (40, 2000, 0), (40, 2000, 1)]
        );
    }

    #[test]
    fn a_stop_purges_what_was_begun() {
        let mut bench = Bench::new(0);
        bench.shadow.learn(0, Table::Holding, 2000, 0);
        let (mut start, _a) = bench.begin(&[("run", 1.0), ("speed_reference", 50.0)], Urgency::Command);
        let sent = RequestPdu::WriteRegister {
            address: 2002,
            value: 5000,
        };
        assert_eq!(
            start.next(&bench.shadow, &bench.profile, false, bench.now),
            Next::Send(sent.clone())
        );
        assert_eq!(start.answered(&sent, Reply::Written, &mut bench.shadow), None);
        assert!(start.purge(), "the run bit is not sent any more");
        assert_eq!(start.success(), Outcome::Purged);
    }

    #[test]
    fn a_stop_lets_a_pulse_end() {
        let mut bench = Bench::new(0);
        bench.shadow.learn(0, Table::Holding, 2000, 0);
        let (mut both, _a) = bench.begin(&[("run", 1.0), ("fault_reset", 1.0)], Urgency::Command);
        let high = RequestPdu::WriteRegister {
            address: 2000,
            value: 4,
        };
        assert_eq!(
            both.next(&bench.shadow, &bench.profile, false, bench.now),
            Next::Send(high.clone())
        );
        assert_eq!(both.answered(&high, Reply::Written, &mut bench.shadow), None);
        assert!(!both.purge());
        assert_eq!(bench.run(&mut both), [(20, 2000, 0)], "no run behind the stop");
        assert_eq!(both.success(), Outcome::Purged);
    }

    #[test]
    fn exceptions_and_silence_end_it() {
        let bench = Bench::new(0);
        let mut shadow = Shadow::default();
        let (mut command, _a) = bench.begin(&[("speed_reference", 1.0)], Urgency::Command);
        let sent = RequestPdu::WriteRegister {
            address: 2002,
            value: 100,
        };
        let refused = command.answered(&sent, Reply::Exception(Exception::BUSY), &mut shadow);
        assert_eq!(refused, Some(Outcome::Exception(Exception::BUSY)));
        let (mut command, _a) = bench.begin(&[("speed_reference", 1.0)], Urgency::Command);
        assert_eq!(command.failed(&sent, 1), None);
        assert_eq!(command.failed(&sent, 1), Some(Outcome::TimedOut));
    }

    /// What the command sends next.
    fn sends(bench: &Bench, command: &mut Execution) -> RequestPdu {
        match command.next(&bench.shadow, &bench.profile, bench.running, bench.now) {
            Next::Send(pdu) => pdu,
            other => panic!("{other:?}"),
        }
    }

    fn word(value: u16) -> RequestPdu {
        RequestPdu::WriteRegister { address: 2000, value }
    }

    #[test]
    fn a_stop_does_not_depend_on_a_read() {
        let mut bench = Bench::new(1);
        bench.running = true;
        let refused = Reply::Exception(Exception::BUSY);
        for answer in [Some(refused), None] {
            let (mut stop, _a) = bench.begin(&[("run", 0.0)], Urgency::Stop);
            let read = sends(&bench, &mut stop);
            assert!(!read.is_write());
            let ended = match answer {
                Some(reply) => stop.answered(&read, reply, &mut bench.shadow),
                None => stop.failed(&read, 3),
            };
            assert_eq!(ended, None);
            assert_eq!(sends(&bench, &mut stop), word(0));
        }
    }

    #[test]
    fn a_drive_that_keeps_its_word_to_itself_is_commanded_all_the_same() {
        let mut bench = Bench::new(0);
        let refused = || Reply::Exception(Exception::ADDRESS);
        let (mut start, _a) = bench.begin(&[("run", 1.0)], Urgency::Command);
        let read = sends(&bench, &mut start);
        assert_eq!(start.answered(&read, refused(), &mut bench.shadow), None);
        assert_eq!(sends(&bench, &mut start), word(1));
        assert!(start.answered(&word(1), Reply::Written, &mut bench.shadow).is_some());
        assert_eq!(
            bench.shadow.get(0, 2000),
            Some(1),
            "known from the acknowledged write on"
        );
        // A read that is never answered: after the tries.
        let mut bench = Bench::new(0);
        let (mut start, _a) = bench.begin(&[("run", 1.0)], Urgency::Command);
        assert_eq!(start.failed(&read, 1), None);
        assert_eq!(sends(&bench, &mut start), read);
        assert_eq!(start.failed(&read, 1), None);
        assert_eq!(sends(&bench, &mut start), word(1));
        // A drive that is only busy is not overruled.
        let (mut start, _a) = bench.begin(&[("run", 1.0)], Urgency::Command);
        let busy = start.answered(&read, Reply::Exception(Exception::BUSY), &mut bench.shadow);
        assert_eq!(busy, Some(Outcome::Exception(Exception::BUSY)));
    }

    #[test]
    fn an_unknown_word_is_not_guessed_while_the_motor_runs() {
        let mut bench = Bench::new(1);
        bench.running = true;
        let refused = || Reply::Exception(Exception::ADDRESS);
        for points in [&[("reverse", 1.0)][..], &[("run", 1.0)], &[("fault_reset", 1.0)]] {
            let (mut command, _a) = bench.begin(points, Urgency::Command);
            let read = sends(&bench, &mut command);
            let ended = command.answered(&read, refused(), &mut bench.shadow);
            assert_eq!(ended, Some(Outcome::Exception(Exception::ADDRESS)), "{points:?}");
        }
        let (mut both, _a) = bench.begin(&[("run", 1.0), ("reverse", 1.0)], Urgency::Command);
        let read = sends(&bench, &mut both);
        assert_eq!(both.answered(&read, refused(), &mut bench.shadow), None);
        assert_eq!(sends(&bench, &mut both), word(3));
    }
}
