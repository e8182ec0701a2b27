//! The state of a drive at one time: raw words with their times, and their conversion to points.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use super::{DriveSpec, Hold};
use crate::codec::{Exception, Table};
use crate::drive::model::Kind;
use crate::drive::profile::MOST_REGISTERS;
use crate::drive::{Bound, ModelPoint, Plan, Point, PointIndex, PollClass, Quality, Raw, Sample, Source, State, Value};

/// Oldest age of a parameter of the drive on which a command may rest, where the line can renew it faster.
const PARAMETER_AGE: Duration = Duration::from_secs(5);

/// Whether a drive answers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Link {
    /// Not asked yet.
    Untried,
    /// Answers since.
    Online(SystemTime),
    /// Does not answer since.
    Offline(SystemTime),
}

impl Link {
    /// Whether the drive answers.
    pub fn is_online(self) -> bool {
        matches!(self, Link::Online(_))
    }

    /// Whether the drive was asked at least once to an end.
    pub fn is_tried(self) -> bool {
        self != Link::Untried
    }
}

/// How often something is received on a line that another master owns, learned from the times between; tenths of a
/// second, 0 is not known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Cadence(u16);

impl Cadence {
    /// Longest interval that counts as one.
    pub const LONGEST: Duration = Duration::from_secs(600);

    /// Heard again after `interval`. A longer interval than so far is learned at four times the last at most, so that a pause
    /// of the other master makes no slow cadence; a shorter one by a quarter each time.
    #[must_use]
    pub fn after(self, interval: Duration) -> Cadence {
        let tenths = |time: Duration| u16::try_from(time.as_millis().div_ceil(100)).unwrap_or(u16::MAX);
        let interval = tenths(interval.min(Cadence::LONGEST));
        let most = self.0.max(10).saturating_mul(4);
        Cadence(interval.max(self.0 - self.0.div_ceil(4)).min(most))
    }

    /// Three intervals: a value not read again within this time is no longer good.
    pub fn good_for(self) -> Duration {
        Duration::from_millis(300) * u32::from(self.0)
    }
}

/// One register (or bit as 0 and 1) of the drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
struct Cell {
    word: u16,
    at: Option<Instant>,
    refused: Option<Exception>,
    /// Read before the drive went away, and not since.
    outlived: bool,
    /// How often another master reads it, where one does.
    cadence: Cadence,
}

impl Cell {
    /// Whether everything but the word is the same.
    fn is_like(&self, other: &Cell) -> bool {
        let alike = |cell: &Cell| (cell.at, cell.refused, cell.outlived, cell.cadence);
        alike(self) == alike(other)
    }
}

/// Cells that lie together and are polled alike.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Span {
    table: Table,
    start: u16,
    class: PollClass,
    cells: Vec<Cell>,
}

impl Span {
    fn offset(&self, table: Table, address: u16) -> Option<usize> {
        let offset = usize::from(address.checked_sub(self.start)?);
        (self.table == table && offset < self.cells.len()).then_some(offset)
    }
}

/// The state of a drive.
#[derive(Debug, Clone)]
pub struct Snapshot {
    /// Whether it answers.
    pub link: Link,
    /// When the process data (fast class) was last read.
    pub fast_at: Option<Instant>,
    /// Filled by what another master reads: how often it reads process data.
    pub heard: Option<Cadence>,
    /// Points whose value is that of their monitoring register, because a selector of the drive gives them another content
    /// than the profile states: see [`crate::drive::Point::monitor`].
    pub monitored: Vec<PointIndex>,
    /// Shared with the snapshots before, as far as nothing in them changed.
    spans: Vec<Arc<Span>>,
}

/// Why words cannot be served.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unavailable {
    /// Not part of the plan: only the drive itself knows.
    NotPolled,
    /// Too old, never read, or the drive is offline.
    Stale,
    /// The drive refuses the address with this exception.
    Refused(Exception),
}

impl Snapshot {
    /// Nothing is known of the plan's addresses yet.
    pub fn empty(plan: &Plan) -> Snapshot {
        let spans = plan.reads.iter().chain(&plan.monitors).map(|read| {
            Arc::new(Span {
                table: read.table,
                start: read.start,
                class: read.class,
                cells: vec![Cell::default(); usize::from(read.count)],
            })
        });
        Snapshot {
            link: Link::Untried,
            fast_at: None,
            heard: None,
            monitored: Vec::new(),
            spans: spans.collect(),
        }
    }

    /// Words that the drive answered.
    pub fn store(&mut self, table: Table, start: u16, words: &[u16], now: Instant) {
        self.each(table, start, words.len(), |cell, offset| {
            let word = words.get(offset).copied().unwrap_or_default();
            *cell = Cell {
                word,
                at: Some(now),
                refused: None,
                outlived: false,
                cadence: Cadence::default(),
            };
        });
    }

    /// Words that the drive answered another master. Whether process data was among them.
    pub fn hear(&mut self, table: Table, start: u16, words: &[u16], now: Instant) -> bool {
        let (mut fast, mut before) = (false, None::<Instant>);
        for span in self.spans.iter().filter(|span| span.class == PollClass::Fast) {
            let of = |offset: usize| start.checked_add(u16::try_from(offset).ok()?);
            let places = (0..words.len()).filter_map(|offset| span.offset(table, of(offset)?));
            for cell in places.filter_map(|place| span.cells.get(place)) {
                fast = true;
                before = cell.at.map(|at| before.map_or(at, |before| before.min(at))).or(before);
            }
        }
        self.each(table, start, words.len(), |cell, offset| {
            let interval = cell.at.map(|before| now.saturating_duration_since(before));
            *cell = Cell {
                word: words.get(offset).copied().unwrap_or_default(),
                at: Some(now),
                refused: None,
                outlived: false,
                cadence: interval.map_or(cell.cadence, |interval| cell.cadence.after(interval)),
            };
        });
        if fast {
            // Between two reads of the same registers: where each takes a read of its own, those of one round follow each
            // other closely, and the pause until the next round is what counts.
            let interval = before.map(|before| now.saturating_duration_since(before));
            let cadence = self.heard.unwrap_or_default();
            self.heard = Some(interval.map_or(cadence, |interval| cadence.after(interval)));
            self.fast_at = Some(now);
        }
        fast
    }

    /// The machine was suspended for that time, in which its clock stood: all is older by it.
    pub fn slept(&mut self, time: Duration) {
        let earlier = |at: &mut Option<Instant>| *at = at.map(|at| at.checked_sub(time).unwrap_or(at));
        earlier(&mut self.fast_at);
        for cell in self.spans.iter_mut().flat_map(|span| &mut Arc::make_mut(span).cells) {
            earlier(&mut cell.at);
        }
    }

    /// The drive refused these addresses.
    pub fn refuse(&mut self, table: Table, start: u16, count: u16, exception: Exception) {
        self.each(table, start, usize::from(count), |cell, _| {
            cell.refused = Some(exception)
        });
    }

    /// The drive went away: what is read seldom may be otherwise when it returns, and is stale until it was read again.
    pub fn outlive(&mut self) {
        let seldom = self.spans.iter_mut().filter(|span| span.class != PollClass::Fast);
        for cell in seldom.flat_map(|span| &mut Arc::make_mut(span).cells) {
            cell.outlived = true;
        }
    }

    fn each(&mut self, table: Table, start: u16, count: usize, mut change: impl FnMut(&mut Cell, usize)) {
        let start = usize::from(start);
        for span in self.spans.iter_mut().filter(|span| span.table == table) {
            let first = usize::from(span.start);
            let (from, to) = (first.max(start), (first + span.cells.len()).min(start + count));
            if from >= to {
                continue;
            }
            let cells = Arc::make_mut(span).cells.get_mut(from - first..to - first);
            for (place, cell) in cells.into_iter().flatten().enumerate() {
                change(cell, from - start + place);
            }
        }
    }

    /// When the word at an address was last read.
    pub fn read_at(&self, table: Table, address: u16) -> Option<Instant> {
        self.cell(table, address).and_then(|(_, cell)| cell.at)
    }

    /// The last word read at an address, whatever its age.
    pub fn word(&self, table: Table, address: u16) -> Option<u16> {
        self.cell(table, address)
            .filter(|(_, c)| c.at.is_some())
            .map(|(_, c)| c.word)
    }

    fn cell(&self, table: Table, address: u16) -> Option<(PollClass, &Cell)> {
        self.spans
            .iter()
            .find_map(|s| Some((s.class, s.cells.get(s.offset(table, address)?)?)))
    }
}

/// A drive as a reader sees it at one time.
#[derive(Debug, Clone)]
pub struct Reading<'d> {
    /// As configured.
    pub spec: &'d DriveSpec,
    /// Why it accepts only stops, if so; none for a past state.
    pub hold: Option<&'d Hold>,
    /// The snapshot.
    pub snapshot: Arc<Snapshot>,
    /// When the reader looks.
    pub now: Instant,
    /// Age from which a sample of the fast class is stale.
    pub stale_after: Duration,
    /// Cadence of the slow class.
    pub slow_cycle: Duration,
    /// From when on a sample is not stale yet: one of the fast class, and one of the slow class.
    fresh_from: [Fresh; 2],
}

/// The earliest time of a sample that is not stale yet; `None`: any, as the clock has not run for so long.
type Fresh = Option<Instant>;

impl<'d> Reading<'d> {
    /// A snapshot as seen at `now`. A sample of the fast class is stale beyond the age `stale_after`, one of the slow class
    /// two slow cycles later.
    pub fn new(
        spec: &'d DriveSpec,
        snapshot: Arc<Snapshot>,
        now: Instant,
        stale_after: Duration,
        slow_cycle: Duration,
    ) -> Reading<'d> {
        let limits = [stale_after, stale_after + 2 * slow_cycle];
        Reading {
            spec,
            hold: None,
            snapshot,
            now,
            stale_after,
            slow_cycle,
            fresh_from: limits.map(|limit| now.checked_sub(limit)),
        }
    }

    /// The reading of a drive that accepts only stops while `hold` says so.
    pub fn held(self, hold: &'d Hold) -> Reading<'d> {
        Reading {
            hold: Some(hold),
            ..self
        }
    }
}

impl Reading<'_> {
    /// Age from which a sample of that class is stale: slow points get two of their cycles on top, points
    /// read once stay good while the drive is online.
    fn age_limit(&self, class: PollClass) -> Option<Duration> {
        match class {
            PollClass::Fast => Some(self.stale_after),
            PollClass::Slow | PollClass::Monitor => Some(self.stale_after + 2 * self.slow_cycle),
            PollClass::Once | PollClass::Fault | PollClass::Never => None,
        }
    }

    /// For how long a value of that point is good once it was read, as long as the drive answers: that of its registers that
    /// age first.
    pub fn good_for(&self, point: PointIndex) -> Duration {
        let Some(point) = self.selected(point) else {
            return Duration::ZERO;
        };
        let limit = |raw: &Raw| {
            let cells = raw
                .addresses()
                .filter_map(|address| self.snapshot.cell(raw.table, address));
            let limits = cells.filter_map(|(class, cell)| self.limit_of(class, cell));
            limits.min().unwrap_or(Duration::MAX)
        };
        match &point.source {
            Source::Raw(raw) => limit(raw),
            Source::Derived(derived) => {
                let sources = derived.sources().map(|source| self.good_for(source));
                sources.min().unwrap_or(Duration::ZERO)
            }
        }
    }

    /// Age from which a cell is stale; `None`: never while the drive answers.
    fn limit_of(&self, class: PollClass, cell: &Cell) -> Option<Duration> {
        match self.snapshot.heard {
            Some(_) => Some(self.stale_after.max(cell.cadence.good_for())),
            None => self.age_limit(class),
        }
    }

    /// Whether a cell of that time is stale; asked some twenty times an exchange.
    fn is_old(&self, class: PollClass, cell: &Cell, at: Instant) -> bool {
        if self.snapshot.heard.is_some() {
            let age = self.now.saturating_duration_since(at);
            return self.limit_of(class, cell).is_some_and(|limit| age > limit);
        }
        let [fast, slow] = self.fresh_from;
        let fresh_from = match class {
            PollClass::Fast => fast,
            PollClass::Slow | PollClass::Monitor => slow,
            PollClass::Once | PollClass::Fault | PollClass::Never => None,
        };
        fresh_from.is_some_and(|from| at < from)
    }

    fn quality(&self, class: PollClass, cell: &Cell) -> Quality {
        match (cell.refused, cell.at) {
            (Some(_), _) | (None, None) => Quality::Bad,
            _ if !self.snapshot.link.is_online() || cell.outlived => Quality::Stale,
            (None, Some(at)) if self.is_old(class, cell, at) => Quality::Stale,
            (None, Some(_)) => Quality::Good,
        }
    }

    /// The words of an address span, if every one of them is good.
    ///
    /// # Errors
    /// Why not: an address that is not polled first, then one refused, then one stale.
    pub fn words(&self, table: Table, start: u16, count: u16) -> Result<Vec<u16>, Unavailable> {
        let table = self.spec.profile.canonical(table);
        let mut words = Vec::with_capacity(usize::from(count));
        let mut worst = None;
        // Cells of one poll are of one quality, which is worked out once.
        let mut last: Option<(PollClass, &Cell, Quality)> = None;
        for offset in 0..count {
            let address = start.checked_add(offset).ok_or(Unavailable::NotPolled)?;
            let (class, cell) = self.snapshot.cell(table, address).ok_or(Unavailable::NotPolled)?;
            if class == PollClass::Monitor {
                // Read now and then: what it is now only the drive knows.
                return Err(Unavailable::NotPolled);
            }
            let quality = match last {
                Some((of, alike, quality)) if of == class && alike.is_like(cell) => quality,
                _ => self.quality(class, cell),
            };
            last = Some((class, cell, quality));
            match quality {
                Quality::Good => {}
                _ if cell.refused.is_some() && self.snapshot.link.is_online() => {
                    worst = cell.refused.map(Unavailable::Refused);
                }
                _ => worst = worst.or(Some(Unavailable::Stale)),
            }
            words.push(cell.word);
        }
        worst.map_or(Ok(words), Err)
    }

    /// The point that a value is taken from: the point itself, or its monitoring register.
    fn selected(&self, point: PointIndex) -> Option<&Point> {
        let points = &self.spec.profile.points;
        match self.snapshot.monitored.contains(&point) {
            true => points.get(points.get(point)?.monitor?),
            false => points.get(point),
        }
    }

    pub fn sample(&self, point: PointIndex) -> Sample {
        self.selected(point).map_or(Sample::NONE, |point| self.sample_of(point))
    }

    /// The sample of a point's own register, whatever a selector of the drive puts there.
    pub fn own_sample(&self, point: PointIndex) -> Sample {
        let point = self.spec.profile.points.get(point);
        point.map_or(Sample::NONE, |point| self.sample_of(point))
    }

    fn sample_of(&self, point: &Point) -> Sample {
        match &point.source {
            Source::Raw(raw) => self.raw_sample(raw, point.kind()),
            Source::Derived(derived) => {
                let sources = || derived.sources().map(|source| self.sample(source));
                let Some((_, low, high)) = derived.band() else {
                    return derived.sample(sources(), None);
                };
                if let Some(band) = self.band(low, high) {
                    return derived.sample(sources(), Some(band));
                }
                // What the ends were last makes a value of what the source was last, which is as good as they are.
                let Some((band, quality)) = self.last_band(low, high) else {
                    return Sample::NONE;
                };
                let sample = derived.sample(sources(), Some(band));
                Sample {
                    quality: sample.quality.worse(quality),
                    ..sample
                }
            }
        }
    }

    /// A value of the drive's own registers: as good as the worst of them, as old as the oldest. What is no value
    /// (a float that is no number) is bad.
    fn raw_sample(&self, raw: &Raw, kind: Kind) -> Sample {
        let (mut words, mut quality) = ([0; MOST_REGISTERS], Quality::Good);
        let items = usize::from(raw.form.items());
        // One that was never read comes before all times.
        let mut at = Some(self.now);
        for (offset, word) in (0..).zip(words.iter_mut().take(items)) {
            let address = raw.address.checked_add(offset);
            let Some((class, cell)) = address.and_then(|address| self.snapshot.cell(raw.table, address)) else {
                return Sample::NONE;
            };
            *word = cell.word;
            at = if offset == 0 { cell.at } else { at.min(cell.at) };
            quality = quality.worse(self.quality(class, cell));
        }
        let words = words.get(..items).unwrap_or_default();
        let value = match raw.scale_from.map(|scale| self.sample(scale)) {
            _ if at.is_none() => None,
            None => raw.decode(words, kind),
            Some(scale) => {
                quality = quality.worse(scale.quality);
                let power = scale.value.and_then(Value::exact_f64);
                power.and_then(|power| raw.decode_scaled(words, kind, power as i64))
            }
        };
        Sample {
            value,
            quality: if value.is_some() { quality } else { Quality::Bad },
            at,
        }
    }

    /// The ends of a band: the drive's own, else the configured frequencies. A maximum that is a figure of the
    /// profile gives way to the configured one.
    pub fn band(&self, minimum: Bound, maximum: Bound) -> Option<(f64, f64)> {
        self.band_of(minimum, maximum, |sample| sample.good())
    }

    /// As [`Reading::band`], for limits and conversions of commands: what the drive said longer than
    /// [`Reading::parameter_age`] ago is not known.
    pub(crate) fn band_for_commands(&self, minimum: Bound, maximum: Bound) -> Option<(f64, f64)> {
        self.band_of(minimum, maximum, |sample| {
            let age = self.now.saturating_duration_since(sample.at?);
            sample.good().filter(|_| age <= self.parameter_age())
        })
    }

    /// Oldest age of a parameter of the drive on which a limit or a conversion of a command may rest: 5 s or, where the
    /// line is slower, one slow cycle of it, with an eighth for what comes between.
    pub fn parameter_age(&self) -> Duration {
        PARAMETER_AGE.max(self.slow_cycle + self.slow_cycle / 8)
    }

    fn band_of(&self, minimum: Bound, maximum: Bound, known: impl Fn(&Sample) -> Option<Value>) -> Option<(f64, f64)> {
        let own = |bound: Bound| match bound {
            Bound::Point(point) => known(&self.sample(point)).map(Value::as_f64),
            Bound::Fixed(figure) => Some(figure),
        };
        let configured = self.spec.frequency_range.as_ref();
        if let (Bound::Fixed(_), Some(configured)) = (maximum, configured) {
            let low = own(minimum).unwrap_or(*configured.start());
            return Some((low, *configured.end())).filter(|(low, high)| high > low);
        }
        match (own(minimum), own(maximum)) {
            (Some(low), Some(high)) if high > low => Some((low, high)),
            _ => {
                let configured = configured?;
                match (minimum, maximum) {
                    (Bound::Fixed(low), _) => Some((low, *configured.end())),
                    _ => Some((*configured.start(), *configured.end())),
                }
            }
        }
    }

    /// The ends of a band as the drive reported them last, and the worse quality of the two. No command is made of them.
    fn last_band(&self, minimum: Bound, maximum: Bound) -> Option<((f64, f64), Quality)> {
        let end = |bound: Bound| match bound {
            Bound::Point(point) => {
                let sample = self.sample(point);
                let value = sample.value.filter(|_| sample.quality != Quality::Bad)?;
                Some((value.as_f64(), sample.quality))
            }
            Bound::Fixed(figure) => Some((figure, Quality::Good)),
        };
        let ((low, of_low), (high, of_high)) = (end(minimum)?, end(maximum)?);
        (high > low).then_some(((low, high), of_low.worse(of_high)))
    }

    /// The sample of a model point; a point that the family lacks is bad.
    pub fn model(&self, point: ModelPoint) -> Sample {
        self.spec
            .profile
            .model_index(point)
            .map_or(Sample::NONE, |i| self.sample(i))
    }

    /// Whether a bit of the model is good and set.
    pub fn is_set(&self, point: ModelPoint) -> bool {
        self.model(point).good().is_some_and(Value::as_bool)
    }

    /// A bit of the model; `None` where the family has it and it is not good. What the family lacks is not set.
    pub fn bit(&self, point: ModelPoint) -> Option<bool> {
        match self.spec.profile.model_index(point) {
            Some(index) => self.sample(index).good().map(Value::as_bool),
            None => Some(false),
        }
    }

    /// Age of the process data; `None` if it was never read.
    pub fn age(&self) -> Option<Duration> {
        self.snapshot.fast_at.map(|at| self.now.saturating_duration_since(at))
    }

    /// Whether the process data is too old or the drive is offline.
    pub fn is_stale(&self) -> bool {
        let cadence = self.snapshot.heard.unwrap_or_default();
        let limit = self.stale_after.max(cadence.good_for());
        !self.snapshot.link.is_online() || self.age().is_none_or(|age| age > limit)
    }

    /// The drive in one word; `None` while it answers and a point that decides is not good.
    pub fn state(&self) -> Option<State> {
        if self.is_stale() {
            return Some(State::Offline);
        }
        self.decided().ok()
    }

    /// The state by the deciding points, in their order; else the quality of the first that is not good. A point that
    /// the family lacks decides nothing.
    fn decided(&self) -> Result<State, Quality> {
        const DECIDING: [(ModelPoint, State); 3] = [
            (ModelPoint::Fault, State::Fault),
            (ModelPoint::Running, State::Running),
            (ModelPoint::Ready, State::Ready),
        ];
        for (point, state) in DECIDING {
            match self.bit(point) {
                Some(true) => return Ok(state),
                Some(false) => {}
                None => return Err(self.model(point).quality),
            }
        }
        Ok(State::NotReady)
    }

    /// Text of the active fault; empty without a fault.
    pub fn fault_text(&self) -> String {
        match self.model(ModelPoint::FaultCode).good() {
            Some(Value::Integer(code)) => self.spec.profile.fault_text(code),
            _ => String::new(),
        }
    }

    /// Quality of the drive as a whole: that of its process data or, while its state is unknown, that of the deciding
    /// point.
    pub fn overall(&self) -> Quality {
        if self.snapshot.fast_at.is_none() {
            Quality::Bad
        } else if self.is_stale() {
            Quality::Stale
        } else {
            self.decided().err().unwrap_or(Quality::Good)
        }
    }
}

#[cfg(test)]
mod tests;
