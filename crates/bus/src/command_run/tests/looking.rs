//! An order that does not say whether the motor is to run reads the motor state before it writes a remembered run
//! command: checked for every family whose drive is commanded, stopped or restarted by another source.

use super::super::word::{self, Made};
use super::*;
use drivegate_core::order::{Arrival, Window, written};
use drivegate_model::drive::control::{Control, ControlItem, OwnWord, Run};
use drivegate_model::drive::{Derived, ModelPoint, PointIndex, Raw, Source};

/// What happened at a drive since its last poll, when its motor ran by a word of the gateway.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Since {
    /// Nothing: the motor still runs.
    Nothing,
    /// The motor was stopped at the panel, and the control word is unchanged.
    Stopped,
    /// The drive restarted and lost its control word.
    Restarted,
    Faulted,
}

/// A drive of any family: answers status reads with the state of its motor, and runs whenever its word is a run command.
struct AnyDrive<'p> {
    profile: &'p Profile,
    control: &'p Control,
    words: BTreeMap<(Table, u16), u16>,
    /// Run commands written while the motor does not run.
    started: Vec<(u16, u16)>,
    reads: usize,
}

impl<'p> AnyDrive<'p> {
    fn new(profile: &'p Profile) -> AnyDrive<'p> {
        let control = profile.control.as_ref().unwrap();
        AnyDrive {
            profile,
            control,
            words: BTreeMap::new(),
            started: Vec::new(),
            reads: 0,
        }
    }

    /// The word for running forward, and its register.
    fn run_word(&self) -> (ControlItem, u16) {
        let run = self.control.runs()[0];
        let word = run.applied(self.control.always.applied(0));
        (
            run.place.unwrap_or(self.control.at),
            self.control.with_direction(word, false),
        )
    }

    fn sets(&mut self, raw: &Raw, on: bool) {
        let address = raw.address;
        let word = self.words.entry((raw.table, address)).or_default();
        let flipped = (0..16).map(|bit| *word ^ (1 << bit));
        for candidate in [*word].into_iter().chain(flipped).chain([0]) {
            let read = raw.decode(&[candidate], drivegate_model::drive::model::Kind::Bool);
            if read == Some(Value::Bool(on)) {
                *word = candidate;
                return;
            }
        }
        panic!("{raw:?} is never {on}");
    }

    /// Sets the status of the drive to this state.
    fn shows(&mut self, point: ModelPoint, on: bool) {
        let Some(index) = self.profile.model_index(point) else {
            return;
        };
        let raw = |point: PointIndex| self.profile.points.get(point).unwrap().raw().unwrap().clone();
        match &self.profile.points.get(index).unwrap().source {
            Source::Raw(raw) => self.sets(&raw.clone(), on),
            Source::Derived(Derived::All { of }) => {
                let all: Vec<Raw> = of.iter().map(|of| raw(*of)).collect();
                all.iter().for_each(|raw| self.sets(raw, on));
            }
            Source::Derived(Derived::State { any }) => {
                let (place, mask, is) = (raw(any[0].point), any[0].mask as u16, any[0].is as u16);
                let word = self.words.entry((place.table, place.address)).or_default();
                *word = *word & !mask | if on { is } else { !is & mask };
            }
            Source::Derived(other) => panic!("{}: {other:?}", self.profile.name),
        }
    }

    fn replies(&mut self, pdu: &RequestPdu) -> Reply {
        if let RequestPdu::Read { table, start, count } = pdu {
            self.reads += 1;
            let words = (*start..start + count).map(|address| self.words.get(&(*table, address)).copied().unwrap_or(0));
            return if table.is_bits() {
                Reply::Bits(words.map(|word| word != 0).collect())
            } else {
                Reply::Registers(words.collect())
            };
        }
        let Some((table, items)) = written(pdu) else {
            return Reply::Written;
        };
        for (address, word) in items {
            let place = ControlItem { table, address };
            self.words.insert((table, address), word);
            let (run_place, _) = self.run_word();
            let stands = self
                .words
                .get(&(run_place.table, run_place.address))
                .copied()
                .unwrap_or(0);
            let is_place = [
                Some(self.control.at),
                Some(run_place),
                self.control.reverse.and_then(|reverse| reverse.place),
            ];
            let reset = self.control.fault_reset.and_then(|reset| reset.setting.place);
            if (is_place.contains(&Some(place)) || reset == Some(place)) && self.control.is_run(run_place, stands) {
                self.started.push((address, word));
            }
        }
        Reply::Written
    }
}

/// The words that started a motor, each with its register.
type Started = Vec<(u16, u16)>;

/// Runs the order against the drive, whose state was polled before the events.
fn carries_out(
    profile: &Arc<Profile>,
    since: Since,
    points: &[(ModelPoint, f64)],
) -> Option<(Outcome, Started, CommandRun)> {
    let mut drive = AnyDrive::new(profile);
    let (place, word) = drive.run_word();
    let mut bench = ObedientDrive::new(0);
    bench.profile = profile.clone();
    bench.words.learn(place.table, place.address, word);
    if since != Since::Restarted {
        let reads_back = drive.control.own_word != OwnWord::Shadow;
        drive.words.insert((place.table, place.address), word);
        assert!(reads_back || place == drive.control.at);
    }
    drive.shows(ModelPoint::Fault, since == Since::Faulted);
    drive.shows(ModelPoint::Remote, true);
    drive.shows(ModelPoint::Running, since == Since::Nothing);
    let values = points.iter().map(|(point, on)| {
        let index = profile.model_index(*point)?;
        let index = profile.points.get(index)?.write_to.unwrap_or(index);
        let of_raw = profile.points.get(index)?;
        let value = match point {
            ModelPoint::SpeedReference | ModelPoint::FrequencyReference => Value::Number(*on),
            _ => Value::Bool(*on != 0.0),
        };
        let is_sent = of_raw.raw().is_some() || matches!(value, Value::Bool(_)) && profile.control_table().is_some();
        is_sent.then_some((index, value))
    });
    let values: Vec<(PointIndex, Value)> = values.collect::<Option<_>>()?;
    let origin = Origin::new(SourceKind::Mqtt, "t");
    let (ticket, _receiver) = Ticket::new(
        origin,
        "d",
        String::new(),
        true,
        bench.now,
        Arc::new(CommandLog::default()),
    );
    let admitted = Admitted {
        order: Order::Points(values),
        urgency: Urgency::Command,
        reference_only: false,
        ranges: Vec::new(),
    };
    let expires = bench.now + Duration::from_secs(60);
    let window = Window {
        arrival: Arrival::now(bench.now),
        expires,
        waits: false,
    };
    let command = Command::new(DriveIndex::new(0), admitted, profile, window, ticket);
    let mut run = CommandRun::new(command, profile);
    for _ in 0..100 {
        match run.next(&bench.words, profile, true, bench.now) {
            Next::Done => return Some((run.success(), drive.started, run)),
            Next::Wait(until) => bench.now = until,
            Next::Send(step) => {
                run.sent(&step);
                let reply = drive.replies(&step.pdu);
                if let Some(outcome) = run.answered(&step, reply, &mut bench.words) {
                    return Some((outcome, drive.started, run));
                }
            }
        }
    }
    panic!("{}: it does not end", profile.name);
}

const ORDERS: [&[(ModelPoint, f64)]; 8] = [
    &[(ModelPoint::Reverse, 1.0)],
    &[(ModelPoint::Reverse, 0.0)],
    &[(ModelPoint::FaultReset, 1.0)],
    &[(ModelPoint::FaultReset, 1.0), (ModelPoint::Reverse, 1.0)],
    &[(ModelPoint::SpeedReference, 20.0), (ModelPoint::Reverse, 1.0)],
    &[(ModelPoint::FrequencyReference, 20.0), (ModelPoint::Reverse, 1.0)],
    &[(ModelPoint::FrequencyReference, 20.0), (ModelPoint::FaultReset, 1.0)],
    &[(ModelPoint::SpeedReference, 20.0), (ModelPoint::FaultReset, 1.0)],
];

fn families() -> impl Iterator<Item = Arc<Profile>> {
    let commanded = |profile: &&Arc<Profile>| profile.control.is_some();
    let all: Vec<Arc<Profile>> = Profiles::built_in().iter().filter(commanded).cloned().collect();
    all.into_iter()
}

#[test]
fn no_order_without_run_starts_a_motor_that_has_ceased_to_run() {
    let mut tried = 0;
    for profile in families() {
        for since in [Since::Stopped, Since::Restarted, Since::Faulted] {
            for order in ORDERS {
                let Some((outcome, started, run)) = carries_out(&profile, since, order) else {
                    continue;
                };
                tried += 1;
                assert_eq!(started, [], "{}: {since:?}, {order:?}", profile.name);
                let turns = order.iter().any(|(point, _)| *point == ModelPoint::Reverse);
                assert!(outcome.is_ok(), "{}: {since:?}, {order:?}: {outcome:?}", profile.name);
                let waits = run.waits_for_start();
                assert!(turns || !waits, "{}: {since:?}, {order:?}", profile.name);
            }
        }
    }
    assert!(tried > 300, "{tried}");
}

#[test]
fn a_motor_that_is_seen_to_run_is_turned() {
    for profile in families() {
        for reverse in [1.0, 0.0] {
            let Some((outcome, written, run)) =
                carries_out(&profile, Since::Nothing, &[(ModelPoint::Reverse, reverse)])
            else {
                continue;
            };
            assert!(
                outcome.is_ok() && !run.waits_for_start(),
                "{}: {outcome:?}",
                profile.name
            );
            // On N2, a value that the drive already has is not written.
            let is_there = reverse == 0.0 && written.is_empty();
            assert!(written.len() == 1 || is_there, "{}: {written:x?}", profile.name);
        }
    }
}

/// The next start uses the kept direction, in every form in which families encode it.
#[test]
fn the_next_start_has_the_direction_that_was_kept() {
    for profile in families() {
        let Some((outcome, _, run)) = carries_out(&profile, Since::Stopped, &[(ModelPoint::Reverse, 1.0)]) else {
            continue;
        };
        assert!(outcome.is_ok(), "{}", profile.name);
        if !run.waits_for_start() {
            continue;
        }
        let control = profile.control.as_ref().unwrap();
        let mut drive = AnyDrive::new(&profile);
        let (place, word) = drive.run_word();
        let mut bench = ObedientDrive::new(0);
        bench.profile = profile.clone();
        for known in [true, false] {
            let mut words = KnownWords::default();
            if known {
                words.learn(place.table, place.address, word);
            }
            run.note_direction(&mut words);
            let order = vec![(profile.model_index(ModelPoint::Run).unwrap(), Value::Bool(true))];
            let mut next: VecDeque<Action> = actions(&profile, &order, false, false);
            let mut turned = None;
            while let Some(action) = next.pop_front() {
                let Action::Word(word) = action else { continue };
                let known = RequestContext {
                    check: Check::InVain,
                    blind: true,
                    names_run: true,
                    stopped: false,
                    running: false,
                    masks: false,
                    permit: None,
                };
                let Made::Send(step) = word::made(word, &words, &profile, known, None) else {
                    continue;
                };
                for (address, word) in written(&step.pdu).unwrap().1 {
                    turned = control.direction_of(word).or(turned);
                    let elsewhere = control
                        .reverse
                        .filter(|reverse| reverse.place.is_some_and(|of| of.address == address));
                    turned = elsewhere.map(|reverse| reverse.holds(word)).or(turned);
                }
                drive.replies(&step.pdu);
            }
            assert_eq!(turned, Some(true), "{}: known {known}", profile.name);
            words.forget_direction();
            assert_eq!(words.at_next_start(), None);
        }
        assert!(matches!(control.run, Run::One(_) | Run::Pair { .. } | Run::Steps(_)));
    }
}

/// If the reads before an order are lost or refused, the order is not sent, and the outcome reports that.
#[test]
fn an_order_whose_look_is_lost_is_not_sent() {
    let mut bench = ObedientDrive::new(1);
    bench.running = true;
    bench.profile = Profiles::built_in().get("danfoss-fc").unwrap().clone();
    bench.words.learn(Table::Holding, 49999, 0x047C);
    for answer in [None, Some(Exception::ADDRESS)] {
        let (mut command, _a) = bench.begin(&[("reverse", 1.0)], Urgency::Command);
        let look = sends(&bench, &mut command);
        assert_eq!(look.purpose, StepPurpose::Look);
        command.sent(&look);
        let ended = match answer {
            None => {
                assert_eq!(command.failed(&look, Outcome::TimedOut, 1), None);
                assert_eq!(sends(&bench, &mut command), look, "it is asked again");
                command.failed(&look, Outcome::TimedOut, 1)
            }
            Some(code) => command.answered(&look, Reply::Exception(code), &mut bench.words),
        };
        let Some(Outcome::Refused(refusal @ Refusal::NotKnown(_))) = ended else {
            panic!("{ended:?}");
        };
        assert!(refusal.to_string().contains("the word was not sent"), "{refusal}");
        assert!(!command.has_begun());
    }
}

/// If another transaction comes between the reads and the write, the reads are repeated.
#[test]
fn nothing_goes_between_the_look_and_the_write() {
    let mut bench = ObedientDrive::new(1);
    bench.running = true;
    bench.words.learn(Table::Holding, 2000, 1);
    bench.profile = Profiles::built_in().get("eaton-svx").unwrap().clone();
    let (mut command, _a) = bench.begin(&[("reverse", 1.0)], Urgency::Command);
    let read = sends(&bench, &mut command);
    assert!(asks(&read));
    let told = Reply::Registers(vec![1]);
    assert_eq!(command.answered(&read, told.clone(), &mut bench.words), None);
    looks(&mut bench, &mut command);
    assert!(command.is_checked());
    command.others_go_first();
    assert!(asks(&sends(&bench, &mut command)), "the word as well");
    assert_eq!(command.answered(&read, told, &mut bench.words), None);
    bench.running = false;
    looks(&mut bench, &mut command);
    let next = command.next(&bench.words, &bench.profile, true, bench.now);
    assert_eq!(next, Next::Done);
    assert!(command.waits_for_start());
}
