//! The reads right before a word is written to a drive: the requests that show whether its motor runs, and their
//! evaluation. Pure.

use std::collections::BTreeMap;

use super::{CommandRun, MotorRead, Step, StepPurpose};
use drivegate_core::order::Outcome;
use drivegate_core::permit::{Motor, not_seen};
use drivegate_model::drive::model::Kind;
use drivegate_model::drive::{Derived, ModelPoint, Profile, Raw, Source, Value};
use drivegate_proto::{Protocol, Reply, RequestPdu, Table};

/// A state of the drive with the registers or bits that show it, as one bit, a masked register or a derived value.
#[derive(Debug, Clone, PartialEq)]
struct StateBits {
    parts: Vec<(Raw, Kind)>,
    derived: Option<Derived>,
}

impl StateBits {
    /// The bits that show a point; `None` if the profile does not have the point.
    fn of(profile: &Profile, point: ModelPoint) -> Option<StateBits> {
        let index = profile.model_index(point)?;
        let derived = match &profile.points.get(index)?.source {
            Source::Derived(derived) => Some(derived.clone()),
            Source::Raw(_) => None,
        };
        let sources = derived
            .as_ref()
            .map_or(vec![index], |derived| derived.sources().collect());
        let part = |index| {
            let point = profile.points.get(index)?;
            Some((point.raw()?.clone(), point.kind()))
        };
        let parts: Option<Vec<(Raw, Kind)>> = sources.into_iter().map(part).collect();
        parts.map(|parts| StateBits { parts, derived })
    }

    fn value(&self, words: &BTreeMap<(Table, u16), u16>) -> Option<bool> {
        let values = self
            .parts
            .iter()
            .map(|part| decoded(part, words))
            .collect::<Option<Vec<Value>>>()?;
        match &self.derived {
            Some(derived) => derived.value(values, None).map(Value::as_bool),
            None => values.first().copied().map(Value::as_bool),
        }
    }
}

/// A series of reads before a write: the remaining reads, and the words read so far.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct StateRead {
    running: StateBits,
    fault: Option<StateBits>,
    remote: Option<StateBits>,
    /// The speed of the motor, where it is read.
    speed: Option<(Raw, Kind)>,
    first: RequestPdu,
    more: Vec<RequestPdu>,
    /// Number of answered requests in this series.
    answered: usize,
    words: BTreeMap<(Table, u16), u16>,
}

impl StateRead {
    /// Reads that show whether the motor runs; `None` if the family does not report that.
    pub(super) fn at_running(profile: &Profile) -> Option<StateRead> {
        StateRead::of(profile, &[], None)
    }

    /// Reads that show whether the motor runs by a command from the bus: a faulted drive may still show the motor
    /// state from before the fault, and a drive under panel control does not run by a word of the gateway.
    pub(crate) fn at_motor(profile: &Profile) -> Option<StateRead> {
        StateRead::at_refresh(profile, None)
    }

    /// Reads as before a word, and of this point, which shows the speed of the motor.
    pub(crate) fn at_refresh(profile: &Profile, speed: Option<ModelPoint>) -> Option<StateRead> {
        StateRead::of(profile, &[ModelPoint::Fault, ModelPoint::Remote], speed)
    }

    /// Reads of these points and of the running bit, which is read last so that it is the newest.
    fn of(profile: &Profile, more: &[ModelPoint], speed: Option<ModelPoint>) -> Option<StateRead> {
        let shown = |point: ModelPoint| more.contains(&point).then(|| StateBits::of(profile, point)).flatten();
        let running = StateBits::of(profile, ModelPoint::Running)?;
        let (fault, remote) = (shown(ModelPoint::Fault), shown(ModelPoint::Remote));
        let all = [&fault, &remote].into_iter().flatten().chain([&running]);
        let speed = speed.and_then(|point| {
            let point = profile.points.get(profile.model_index(point)?)?;
            Some((point.raw()?.clone(), point.kind()))
        });
        let mut more = Vec::new();
        if let Some((raw, _)) = &speed {
            read_with(&mut more, profile, raw);
        }
        for (raw, _) in all.flat_map(|shown| &shown.parts) {
            read_with(&mut more, profile, raw);
        }
        if more.is_empty() {
            return None;
        }
        let first = more.remove(0);
        Some(StateRead {
            running,
            fault,
            remote,
            speed,
            first,
            more,
            answered: 0,
            words: BTreeMap::new(),
        })
    }

    /// The next read of this series.
    pub(crate) fn request(&self) -> RequestPdu {
        let more = self.answered.checked_sub(1).and_then(|number| self.more.get(number));
        more.unwrap_or(&self.first).clone()
    }

    /// All requests of this series of reads.
    pub(crate) fn requests(&self) -> impl Iterator<Item = &RequestPdu> {
        [&self.first].into_iter().chain(&self.more)
    }

    /// The reply to that. Whether all were answered.
    pub(crate) fn take_reply(&mut self, reply: &Reply) -> bool {
        if let RequestPdu::Read { table, start, .. } = self.request() {
            let words = reply.words().unwrap_or_default();
            let words = (start..=u16::MAX).zip(words);
            self.words.extend(words.map(|(address, word)| ((table, address), word)));
        }
        self.answered += 1;
        self.answered > self.more.len()
    }

    /// Starts the reads again from the first one.
    pub(crate) fn begin_again(&mut self) {
        self.answered = 0;
        self.words.clear();
    }

    /// Whether the motor runs; `None` if the replies do not show it.
    pub(super) fn runs(&self) -> Option<bool> {
        self.running.value(&self.words)
    }

    /// Speed of the motor; `None` if it is not read, or the replies do not show it.
    pub(crate) fn speed(&self) -> Option<f64> {
        decoded(self.speed.as_ref()?, &self.words).map(Value::as_f64)
    }

    /// State of the motor in relation to the gateway's word.
    pub(crate) fn motor(&self) -> Motor {
        let is = |shown: &Option<StateBits>| shown.as_ref().and_then(|shown| shown.value(&self.words));
        match (self.runs(), is(&self.fault), is(&self.remote)) {
            (None, ..) => Motor::NotShown,
            (Some(false), ..) | (_, Some(true), _) => Motor::Stands,
            (Some(true), _, Some(false)) => Motor::RunsElsewise,
            (Some(true), ..) => Motor::Runs,
        }
    }
}

impl CommandRun {
    /// The next request of the reads that show the motor state; `None` if the family does not report it.
    pub(super) fn state_request(&mut self, profile: &Profile) -> Option<Step> {
        if !matches!(self.look, MotorRead::UnderWay(_)) {
            self.look = StateRead::at_motor(profile).map_or(MotorRead::Seen(Motor::NotShown), MotorRead::UnderWay);
        }
        match &self.look {
            MotorRead::UnderWay(read) => Some(Step::new(StepPurpose::Look, read.request())),
            MotorRead::NotTaken | MotorRead::Seen(_) => None,
        }
    }

    /// The drive answered a request of a look.
    pub(super) fn looked(&mut self, reply: &Reply) {
        if let MotorRead::UnderWay(read) = &mut self.look
            && read.take_reply(reply)
        {
            self.look = MotorRead::Seen(read.motor());
        }
    }

    /// Sets the result of a look without a reply to decode.
    pub(crate) fn set_motor_state(&mut self, runs: bool) {
        self.look = MotorRead::Seen(if runs { Motor::Runs } else { Motor::Stands });
    }

    /// Handles reads without a result: nothing is written except the end of a pulse, which then contains no run command.
    pub(super) fn not_seen(&mut self, why: &str, begun: Outcome) -> Option<Outcome> {
        self.look = MotorRead::NotTaken;
        if self.ends_pulse() {
            // An attempt that is not acknowledged may have stopped the motor, which then still turns.
            self.known.stopped = true;
            self.look = MotorRead::Seen(Motor::NotShown);
            self.tries.failures = 0;
            return None;
        }
        let unsent = Outcome::Refused(not_seen(why));
        let outcome = if self.has_begun() { begun } else { unsent };
        Some(
            self.ending
                .cut()
                .cloned()
                .unwrap_or_else(|| self.unless_in_doubt(outcome)),
        )
    }

    /// This outcome, unless an earlier attempt that was not answered determines the outcome.
    pub(super) fn unless_in_doubt(&self, outcome: Outcome) -> Outcome {
        if self.in_doubt() {
            self.tries.unanswered.clone()
        } else {
            outcome
        }
    }
}

/// The value of a point in these words.
fn decoded((raw, kind): &(Raw, Kind), words: &BTreeMap<(Table, u16), u16>) -> Option<Value> {
    let of = raw.addresses().map(|address| words.get(&(raw.table, address)).copied());
    raw.decode(&of.collect::<Option<Vec<u16>>>()?, *kind)
}

/// Adds the read of a raw value, joined with the previous read if one request can read both.
fn read_with(reads: &mut Vec<RequestPdu>, profile: &Profile, raw: &Raw) {
    let (table, start, count) = (raw.table, raw.address, raw.form.items());
    let end = start.saturating_add(count);
    let covers = |read: &RequestPdu| matches!(read, RequestPdu::Read { table: of, start: first, count } if *of == table && *first <= start && first.saturating_add(*count) >= end);
    if reads.iter().any(covers) {
        return;
    }
    let most = profile.range(table, start).map_or(0, |range| range.read);
    let is_n2 = profile.protocols.contains(&Protocol::N2);
    if let Some(RequestPdu::Read {
        table: of,
        start: first,
        count: before,
    }) = reads.last_mut()
        && *of == table
        && first.saturating_add(*before) == start
        && before.saturating_add(count) <= most
        && profile.range(table, *first) == profile.range(table, start)
        && !is_n2
    {
        *before += count;
        return;
    }
    reads.push(RequestPdu::Read { table, start, count });
}

#[cfg(test)]
mod tests {
    use super::*;
    use drivegate_model::drive::profile::Profiles;

    fn look(name: &str) -> StateRead {
        StateRead::at_motor(Profiles::built_in().get(name).unwrap()).unwrap()
    }

    /// Simulates a drive that answers each request with these words at these addresses; returns the motor state
    /// found, and the requests.
    fn motor(name: &str, at: &[(u16, u16)]) -> (Motor, Vec<(u16, u16)>) {
        let (mut look, mut asked) = (look(name), Vec::new());
        loop {
            let RequestPdu::Read { table, start, count } = look.request() else {
                panic!("{look:?}");
            };
            asked.push((start, count));
            let word = |address| at.iter().find(|(of, _)| *of == address).map_or(0, |(_, word)| *word);
            let words = (start..start + count).map(word);
            let reply = if table.is_bits() {
                Reply::Bits(words.map(|word| word != 0).collect())
            } else {
                Reply::Registers(words.collect())
            };
            if look.take_reply(&reply) {
                return (look.motor(), asked);
            }
        }
    }

    /// Cases written by hand from the manuals: a bit, a masked register, alternatives, a stopped drive whose motor
    /// still turns, coils, bits of N2.
    #[test]
    fn every_kind_of_family_shows_its_motor() {
        use Motor::{Runs, RunsElsewise, Stands};
        for (name, at, expected) in [
            ("vacon-10", &[(2100, 0x03)][..], Runs),
            ("vacon-10", &[(2100, 0x01)], Stands),
            ("vacon-10", &[(2100, 0x0B)], Stands),
            ("danfoss-fc", &[(50199, 0x0A00)], Runs),
            ("danfoss-fc", &[(50199, 0x0800)], RunsElsewise),
            ("danfoss-fc", &[(50199, 0x0A08)], Stands),
            ("schneider-altivar", &[(3201, 0x0237)], Runs),
            ("schneider-altivar", &[(3201, 0x0233)], Stands),
            ("abb-acs550", &[(3, 0x0207)], Runs),
            ("abb-acs550", &[(3, 0x0201)], Stands),
            ("delta-ms300", &[(0x2101, 0x0403)], Runs),
            ("delta-ms300", &[(0x2101, 0x0401)], Runs),
            ("delta-ms300", &[(0x2101, 0x0003)], RunsElsewise),
            ("delta-ms300", &[(0x2101, 0x0403), (0x2100, 4)], Stands),
            ("invt-goodrive", &[(0x2100, 1)], Runs),
            ("invt-goodrive", &[(0x2100, 2)], Runs),
            ("invt-goodrive", &[(0x2100, 3)], Stands),
            ("invt-goodrive", &[(0x2100, 4)], Stands),
            ("hitachi-wj200", &[(14, 1)], Runs),
            ("hitachi-wj200", &[(14, 1), (23, 1)], Stands),
            ("hitachi-wj200", &[(23, 0)], Stands),
        ] {
            assert_eq!(motor(name, at).0, expected, "{name} {at:x?}");
        }
        assert_eq!(motor("danfoss-fc", &[]).1, [(50199, 1)], "all in one request");
    }

    #[test]
    fn every_family_that_is_commanded_is_asked_in_few_requests_and_a_lost_word_shows_nothing() {
        for profile in Profiles::built_in().iter().filter(|profile| profile.control.is_some()) {
            let mut look = look(&profile.name);
            assert!(look.more.len() < 3, "{}: {look:?}", profile.name);
            while !look.take_reply(&Reply::Registers(Vec::new())) {}
            assert_eq!(look.motor(), Motor::NotShown, "{}", profile.name);
        }
    }
}
