//! The refresh of one drive: what its clients ordered last is written again every so often, for a drive whose own timeout counts only
//! writes of its control word or reference. Pure: time is an argument.
//!
//! A round reads first and writes then: the drive must show that it runs by the word that is repeated, or stands by a stop, and
//! that nobody else has written to it. What does not fit ends the refresh, and only an acknowledged order of a client begins it again.
//! A refresh renews no lease, and counts as no order and no start.

use std::fmt;
use std::time::{Duration, Instant};

use super::command_run::{Look, Motor};
use crate::codec::{Reply, RequestPdu, Table};
use crate::drive::control::{Control, ControlItem};
use crate::drive::{ModelPoint, Profile, Repeats};
use crate::order::written;
use crate::process_image::{Hold, Reading};

/// Periods in which a drive that does not answer may come back.
const PERIODS: u32 = 3;
/// Registers of the longest reference.
const LONGEST: usize = 2;

/// Which command stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Does {
    Run,
    Stop,
}

/// The registers of a reference.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Reference {
    start: u16,
    words: [u16; LONGEST],
    count: u16,
}

impl Reference {
    fn words(&self) -> &[u16] {
        self.words.get(..usize::from(self.count)).unwrap_or(&self.words)
    }
}

/// Whose order began a refresh.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Beginner {
    /// A client's, whose lease it needs.
    Client,
    /// A drill's, which feeds the timeout until it falls silent to try it.
    Drill,
    /// The action of a lease that expired: it needs none.
    Action,
}

/// What the orders of the gateway wrote last, as far as the drive acknowledged it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
struct Ordered {
    does: Option<Does>,
    /// The control word, without a reset.
    word: Option<u16>,
    reference: Option<Reference>,
    /// The last write of what feeds the timeout.
    fed: Option<Instant>,
    /// When the reference was written last.
    referred: Option<Instant>,
    /// The drive was seen to tell that reference.
    tells_reference: bool,
}

/// A refresh that has begun.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Going {
    does: Does,
    /// The order that began it ended then: what was read before says nothing.
    since: Instant,
    /// Stops of the drive that were accepted before.
    stops: u64,
    due: Instant,
    /// The motor was seen to run by its run command, or to stand by its stop.
    seen: bool,
    /// The drive has not answered since.
    lost: Option<Instant>,
    /// Whose order began it.
    by: Beginner,
}

/// A refresh, as handed over to the bus that takes the place of this one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Repeated {
    ordered: Ordered,
    going: Option<Going>,
}

/// Why a refresh ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum End {
    Stop,
    Stands,
    Starts,
    Fault,
    Local,
    Foreign,
    Silent,
    Unknown,
    Lease,
    Passed,
    Other,
    Restore,
    Restart,
    Refused(String),
}

impl fmt::Display for End {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            End::Stop => "a stop was accepted",
            End::Stands => "the motor was seen to stand",
            End::Starts => "the motor was seen to start",
            End::Fault => "the drive has a fault",
            End::Local => "the drive is commanded at its local control place",
            End::Foreign => "the drive has another word or reference than the one that was written here",
            End::Silent => "the drive did not answer for three periods",
            End::Unknown => "it is not known what the drive took of an order",
            End::Lease => "the lease expired",
            End::Passed => "a tool or a broadcast commanded the drive",
            End::Other => "the gateway itself commanded the drive",
            End::Restore => "parameters of the drive are being restored",
            End::Restart => "the drive has restarted",
            End::Refused(why) => why,
        })
    }
}

/// How an order ended, as far as a refresh depends on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum OrderEnd {
    /// A client's order was acknowledged.
    Done,
    /// A drill's order was.
    Drill,
    /// The speed reference of a lease that expired was.
    Action,
    /// What the drive took of it is unknown.
    Unknown,
    /// An order of the gateway itself was sent.
    Other,
}

/// What is known beside the samples of the drive.
#[derive(Debug, Clone, Copy)]
pub(super) struct Around {
    /// Stops of the drive that were accepted so far.
    pub(super) stops: u64,
    /// The last one waits by `min_run`.
    pub(super) delayed: bool,
    /// The lease runs.
    pub(super) held: bool,
}

/// A step of a round.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stage {
    /// A reference that does not lie beside the control word.
    Reference,
    /// The control word of the drive, and the reference beside it.
    Own,
    /// How the motor stands.
    Look,
    Write,
}

/// A round that has begun.
#[derive(Debug)]
struct Round {
    stage: Stage,
    look: Look,
}

/// The refresh of one drive.
#[derive(Debug, Default)]
pub(super) struct Refresh {
    /// How often, and what is repeated; none where nothing is.
    settings: Option<(Duration, Repeats)>,
    repeated: Repeated,
    round: Option<Round>,
    /// Stops that were accepted before the order that has begun.
    stops: u64,
    /// That order has said whether the motor is to run.
    says_run: bool,
    /// The drive does not take word and reference in one request.
    apart: bool,
    /// It ended by the lease: only the action of that lease begins it again.
    by_lease: bool,
}

impl Refresh {
    /// The refresh of a drive of that profile, which has not begun.
    pub(super) fn new(profile: &Profile, every: Option<Duration>) -> Refresh {
        Refresh {
            settings: every.and_then(|every| Some((every, profile.repeats().ok()?))),
            ..Refresh::default()
        }
    }

    /// Goes on where the bus before this one ended: the drive has to answer soon.
    pub(super) fn take_over(&mut self, repeated: Repeated, now: Instant) {
        if self.settings.is_some() {
            self.repeated = repeated;
            if let Some(going) = &mut self.repeated.going {
                going.lost.get_or_insert(now);
            }
        }
    }

    /// What the next bus goes on with.
    pub(super) fn handed_over(&self) -> Repeated {
        self.repeated
    }

    /// Whether it has begun, and neither ended nor is the drive away.
    pub(super) fn is_going(&self) -> bool {
        self.repeated.going.is_some_and(|going| going.lost.is_none())
    }

    /// Whether it has begun.
    pub(super) fn has_begun(&self) -> bool {
        self.repeated.going.is_some()
    }

    /// An order to the drive has begun, after so many stops.
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
            if let Some(does) = does(control, place, word) {
                ordered.does = does;
                self.says_run = true;
            }
            if table == Table::Holding && profile.is_repeated_reference(address) {
                of_reference.push((address, word));
            }
        }
        if let Some(reference) = reference_of(&of_reference) {
            ordered.reference = Some(reference);
            (ordered.referred, ordered.tells_reference) = (Some(now), false);
            if by_reference {
                ordered.fed = Some(now);
            }
        }
    }

    /// Whether the reference alone is written.
    fn is_fed_by_reference(&self, control: &Control, repeats: Repeats) -> bool {
        !repeats.word || (control.refresh_with_reference && self.repeated.ordered.reference.is_some())
    }

    /// An order that was sent is over. Why that ends the refresh, if it does.
    pub(super) fn order_over(&mut self, profile: &Profile, how: OrderEnd, held: bool, now: Instant) -> Option<End> {
        self.round = None;
        let (begins, by) = match how {
            OrderEnd::Done if self.by_lease && !self.says_run => (false, Beginner::Client),
            OrderEnd::Done => (held, Beginner::Client),
            OrderEnd::Drill => (held, Beginner::Drill),
            OrderEnd::Action => (self.by_lease, Beginner::Action),
            OrderEnd::Unknown => return self.end(End::Unknown),
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

    fn begin(&mut self, profile: &Profile, by: Beginner, now: Instant) {
        let (Some((every, repeats)), Some(control)) = (self.settings, &profile.control) else {
            return;
        };
        let ordered = self.repeated.ordered;
        let by_reference = self.is_fed_by_reference(control, repeats);
        let fits = match by_reference {
            true => ordered.reference.is_some(),
            false => ordered.word.is_some_and(|word| word & !control.known_bits() == 0),
        };
        self.repeated.going = ordered.does.filter(|_| fits).map(|does| Going {
            does,
            since: now,
            stops: self.stops,
            due: ordered.fed.unwrap_or(now) + every,
            seen: false,
            lost: None,
            by,
        });
    }

    /// Ends it, and forgets what it repeats. The reason where it had begun.
    pub(super) fn end(&mut self, why: End) -> Option<End> {
        let had_begun = self.has_begun();
        match why {
            End::Lease => {
                (self.repeated.going, self.round) = (None, None);
                self.by_lease = true;
            }
            // The reference stands, and may be repeated beside the word of the stop.
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

    /// Looks at the drive, to which no order is under way. Why that ends the refresh, if it does.
    pub(super) fn look(&mut self, reading: &Reading<'_>, around: Around) -> Option<End> {
        let (every, _) = self.settings?;
        let going = self.repeated.going.as_mut()?;
        let now = reading.now;
        let end = if !around.held && going.by != Beginner::Action {
            Some(End::Lease)
        } else if going
            .lost
            .is_some_and(|lost| now.saturating_duration_since(lost) > PERIODS * every)
        {
            Some(End::Silent)
        } else if reading.hold.and_then(Hold::why).is_some() {
            Some(End::Restore)
        } else if going.does == Does::Run && around.stops != going.stops && !around.delayed {
            Some(End::Stop)
        } else {
            going.is_contradicted(reading)
        };
        let end = end.or_else(|| self.repeated.ordered.is_foreign(reading).then_some(End::Foreign));
        end.and_then(|end| self.end(end))
    }

    /// When the next round is due; none while there is none to wait for.
    pub(super) fn due(&self) -> Option<Instant> {
        let going = self.repeated.going?;
        // A run command is repeated to a motor that was seen to run by it.
        (going.does == Does::Stop || going.seen).then_some(going.due)
    }

    /// Whether a run command is what stands.
    pub(super) fn runs(&self) -> bool {
        self.repeated.going.is_some_and(|going| going.does == Does::Run)
    }

    /// Whether a drill's order began it.
    pub(super) fn is_of_drill(&self) -> bool {
        self.repeated.going.is_some_and(|going| going.by == Beginner::Drill)
    }

    /// Stops that were accepted before the order that began it.
    pub(super) fn stops_before(&self) -> u64 {
        self.repeated.going.map_or(0, |going| going.stops)
    }

    /// The next round is not due before then.
    pub(super) fn put_off(&mut self, until: Instant) {
        self.round = None;
        if let Some(going) = &mut self.repeated.going {
            going.due = going.due.max(until);
        }
    }

    /// Whether a round has begun, and its next step must follow at once.
    pub(super) fn is_under_way(&self) -> bool {
        self.round.is_some()
    }

    /// Another transaction goes first: what the round has read is read again.
    pub(super) fn others_go_first(&mut self, profile: &Profile) {
        if let Some(round) = self.round.as_mut().filter(|round| round.stage != Stage::Reference) {
            round.stage = first_read(profile);
            round.look.begin_again();
        }
    }

    /// The request of the present step of the round, which begins where none has.
    pub(super) fn request(&mut self, profile: &Profile) -> Option<RequestPdu> {
        let control = profile.control.as_ref()?;
        if self.round.is_none() {
            let apart = self.reference_apart(profile, control);
            self.round = Some(Round {
                stage: apart.map_or(first_read(profile), |_| Stage::Reference),
                look: Look::at_motor(profile)?,
            });
        }
        let round = self.round.as_ref()?;
        match round.stage {
            Stage::Reference => self
                .reference_apart(profile, control)
                .map(|r| write(profile, r.start, r.words())),
            Stage::Own => Some(self.read_own(profile, control)),
            Stage::Look => Some(round.look.request()),
            Stage::Write => self.write(profile, control),
        }
    }

    /// What the round writes, as far as the rules of the gate ask: word and reference.
    pub(super) fn writes(&self, profile: &Profile) -> Option<RequestPdu> {
        let control = profile.control.as_ref()?;
        match self.reference_apart(profile, control) {
            Some(reference) => Some(write(profile, reference.start, reference.words())),
            None => self.write(profile, control),
        }
    }

    /// What is written behind the reads.
    fn write(&self, profile: &Profile, control: &Control) -> Option<RequestPdu> {
        let (_, repeats) = self.settings?;
        let ordered = &self.repeated.ordered;
        if self.is_fed_by_reference(control, repeats) {
            return ordered.reference.map(|r| write(profile, r.start, r.words()));
        }
        let word = ordered.word?;
        Some(match self.together(profile, control) {
            None => write(profile, control.at.address, &[word]),
            Some(r) if r.start > control.at.address => {
                let words: Vec<u16> = [word].iter().chain(r.words()).copied().collect();
                write(profile, control.at.address, &words)
            }
            Some(r) => {
                let words: Vec<u16> = r.words().iter().copied().chain([word]).collect();
                write(profile, r.start, &words)
            }
        })
    }

    /// The reference, where it lies beside the control word and one request writes both.
    fn together(&self, profile: &Profile, control: &Control) -> Option<Reference> {
        let at = control.at.address;
        let reference = self.repeated.ordered.reference?;
        let beside = reference.start == at.wrapping_add(1) || reference.start.wrapping_add(reference.count) == at;
        let first = reference.start.min(at);
        (beside && !self.apart && profile.writes_together(first, reference.count + 1)).then_some(reference)
    }

    /// The reference that is written before the control word.
    fn reference_apart(&self, profile: &Profile, control: &Control) -> Option<Reference> {
        let (_, repeats) = self.settings?;
        let alone = self.is_fed_by_reference(control, repeats);
        let reference = self.repeated.ordered.reference?;
        (!alone && self.together(profile, control).is_none()).then_some(reference)
    }

    /// The read of the control word of the drive, with the reference beside it.
    fn read_own(&self, profile: &Profile, control: &Control) -> RequestPdu {
        let at = control.at.address;
        let beside = self.together(profile, control).filter(|r| r.start > at);
        let count = 1 + beside.map_or(0, |r| r.count);
        let may = profile
            .ranges
            .iter()
            .any(|range| range.table == Table::Holding && range.addresses.contains(&at) && range.read >= count);
        RequestPdu::Read {
            table: Table::Holding,
            start: at,
            count: if may { count } else { 1 },
        }
    }

    /// The drive answered the present step. Whether the round is over, or why the refresh has ended.
    pub(super) fn answered(&mut self, profile: &Profile, reply: &Reply, now: Instant) -> Result<bool, End> {
        let (Some((every, _)), Some(control)) = (self.settings, profile.control.as_ref()) else {
            return Ok(true);
        };
        let Some(stage) = self.round.as_ref().map(|round| round.stage) else {
            return Ok(true);
        };
        if let Reply::Exception(code) = reply {
            if *code == crate::codec::Exception::FUNCTION && stage == Stage::Write && !self.apart {
                self.apart = true;
                self.round = None;
                return Ok(true);
            }
            if code.is_busy() || code.leaves_open() || code.is_no_answer() {
                self.not_answered(now);
                return Ok(true);
            }
            return Err(End::Refused(format!("the drive refused it with {code}")));
        }
        let next = match stage {
            Stage::Reference => first_read(profile),
            Stage::Own => match self.judge_own(control, reply) {
                Fits::Yes => Stage::Look,
                Fits::NotNow => {
                    self.put_off(now + every);
                    return Ok(true);
                }
                Fits::No => return Err(End::Foreign),
            },
            Stage::Look => {
                let Some(round) = &mut self.round else { return Ok(true) };
                if !round.look.hears(reply) {
                    return Ok(false);
                }
                let motor = round.look.motor();
                match self.judge_motor(motor) {
                    Ok(true) => Stage::Write,
                    Ok(false) => {
                        self.not_answered(now);
                        return Ok(true);
                    }
                    Err(end) => return Err(end),
                }
            }
            Stage::Write => {
                if let Some(going) = &mut self.repeated.going {
                    (going.due, going.lost) = (now + every, None);
                }
                self.round = None;
                return Ok(true);
            }
        };
        if let Some(round) = &mut self.round {
            round.stage = next;
        }
        Ok(false)
    }

    /// Whether the drive has the word, and the reference, that were written.
    fn judge_own(&mut self, control: &Control, reply: &Reply) -> Fits {
        let words = reply.words().unwrap_or_default();
        let (Some(read), Some(word)) = (words.first().copied(), self.repeated.ordered.word) else {
            return Fits::NotNow;
        };
        let released = control.without_reset(read);
        if released != word {
            return Fits::No;
        }
        let reference = words.get(1..).unwrap_or_default();
        let told = self.repeated.ordered.tells(reference);
        match (read == released, told) {
            (_, false) => Fits::No,
            (false, true) => Fits::NotNow,
            (true, true) => Fits::Yes,
        }
    }

    /// Whether the motor stands as the word says: that is written, or nothing this time.
    fn judge_motor(&mut self, motor: Motor) -> Result<bool, End> {
        let Some(going) = &mut self.repeated.going else {
            return Ok(false);
        };
        match (going.does, motor) {
            (_, Motor::RunsElsewise) => Err(End::Local),
            (_, Motor::NotShown) => Ok(false),
            (Does::Run, Motor::Runs) => {
                going.seen = true;
                Ok(true)
            }
            (Does::Run, Motor::Stands) => Err(End::Stands),
            (Does::Stop, Motor::Runs) if going.seen => Err(End::Starts),
            // It comes down.
            (Does::Stop, Motor::Runs) => Ok(true),
            (Does::Stop, Motor::Stands) => {
                going.seen = true;
                Ok(true)
            }
        }
    }

    /// No reply to a step, or none that is believed: it goes on with the next period, by what the drive shows then.
    pub(super) fn not_answered(&mut self, now: Instant) {
        self.round = None;
        let Some((every, _)) = self.settings else { return };
        if let Some(going) = &mut self.repeated.going {
            going.lost.get_or_insert(now);
            going.due = now + every;
        }
    }

    /// The thread stood still for that time, in which nothing was written.
    pub(super) fn stood(&mut self, time: Duration, now: Instant) {
        self.round = None;
        if let Some(going) = &mut self.repeated.going {
            going.lost.get_or_insert(now.checked_sub(time).unwrap_or(now));
        }
    }
}

/// Whether what the drive has is what was written.
enum Fits {
    Yes,
    No,
    /// A reset stands in it.
    NotNow,
}

impl Going {
    /// What the samples since the order say against it.
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
            (Does::Run, Some(false)) if self.seen => return Some(End::Stands),
            (Does::Stop, Some(true)) if self.seen => return Some(End::Starts),
            (Does::Run, Some(true)) | (Does::Stop, Some(false)) => self.seen = true,
            _ => {}
        }
        None
    }
}

impl Ordered {
    /// Whether the registers of the reference were read since it was written, and say something else though they said it before.
    fn is_foreign(&mut self, reading: &Reading<'_>) -> bool {
        let (Some(reference), Some(referred)) = (self.reference, self.referred) else {
            return false;
        };
        let is_new = |at: Instant| at > referred;
        if !reading
            .snapshot
            .read_at(Table::Holding, reference.start)
            .is_some_and(is_new)
        {
            return false;
        }
        match reading.words(Table::Holding, reference.start, reference.count) {
            Ok(words) => !self.tells(&words),
            Err(_) => false,
        }
    }

    /// The registers of the reference are these, or were not read. Whether that is what was written, as far as the drive tells it.
    fn tells(&mut self, read: &[u16]) -> bool {
        let Some(reference) = self.reference.filter(|r| read.len() == r.words().len()) else {
            return true;
        };
        let is_told = reference.words() == read;
        let fits = is_told || !self.tells_reference;
        self.tells_reference |= is_told;
        fits
    }
}

/// What a word at that place says of run and stop; none where it says nothing.
fn does(control: &Control, place: ControlItem, word: u16) -> Option<Option<Does>> {
    let word = if place == control.at {
        control.without_reset(word)
    } else {
        word
    };
    if control.is_own_stop(place, word) {
        return Some(Some(Does::Stop));
    }
    if control.is_run(place, word) {
        return Some(Some(Does::Run));
    }
    // Behind a word that stops by other means, or that is neither, nothing is repeated.
    (place == control.at || place == control.run_place()).then_some(None)
}

/// The registers that lie side by side.
fn reference_of(items: &[(u16, u16)]) -> Option<Reference> {
    let (start, _) = *items.first()?;
    let mut words = [0; LONGEST];
    let mut count = 0;
    for ((address, word), place) in items.iter().zip(&mut words) {
        if *address != start.wrapping_add(count) {
            break;
        }
        *place = *word;
        count += 1;
    }
    Some(Reference { start, words, count })
}

/// The first read of a round.
fn first_read(profile: &Profile) -> Stage {
    match profile.control.as_ref().is_some_and(Control::is_read) && profile.repeats().is_ok_and(|r| r.word) {
        true => Stage::Own,
        false => Stage::Look,
    }
}

fn write(profile: &Profile, start: u16, words: &[u16]) -> RequestPdu {
    match words {
        [word] => profile.functions.write_register(start, *word),
        words => RequestPdu::WriteRegisters {
            start,
            values: words.to_vec(),
        },
    }
}

/// The requests of a round of a drive of that profile, with a reference of one register, for the prediction.
pub(super) fn requests(profile: &Profile) -> Vec<RequestPdu> {
    let (Ok(repeats), Some(control)) = (profile.repeats(), profile.control.as_ref()) else {
        return Vec::new();
    };
    let mut refresh = Refresh {
        settings: Some((Duration::from_secs(1), repeats)),
        ..Refresh::default()
    };
    let address = (0..=u16::MAX).find(|address| profile.is_repeated_reference(*address));
    refresh.repeated.ordered = Ordered {
        word: repeats.word.then_some(0),
        reference: address.and_then(|address| reference_of(&[(address, 0)])),
        ..Ordered::default()
    };
    let apart = refresh.reference_apart(profile, control);
    let own = (first_read(profile) == Stage::Own).then(|| refresh.read_own(profile, control));
    let looks = Look::at_motor(profile).map(|look| look.requests().cloned().collect::<Vec<_>>());
    apart
        .map(|r| write(profile, r.start, r.words()))
        .into_iter()
        .chain(own)
        .chain(looks.into_iter().flatten())
        .chain(refresh.write(profile, control))
        .collect()
}
