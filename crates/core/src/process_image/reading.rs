//! The state of a drive for a reader at one time: its points in units, with their age and quality. Pure: time is an
//! argument.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::snapshot::{Cell, Snapshot, Unavailable};
use super::{DriveSpec, RestoreLock};
use drivegate_model::drive::control::ControlItem;
use drivegate_model::drive::model::Kind;
use drivegate_model::drive::profile::MOST_REGISTERS;
use drivegate_model::drive::{
    Bound, ModelPoint, Point, PointIndex, PollClass, Quality, Raw, Sample, Source, State, Value,
};
use drivegate_proto::Table;

/// Maximum age of a drive parameter on which a command may depend, if the line can read the parameter faster.
const PARAMETER_AGE: Duration = Duration::from_secs(5);

/// The state of a drive for a reader at one time.
#[derive(Debug, Clone)]
pub struct Reading<'d> {
    /// Configuration of the drive.
    pub spec: &'d DriveSpec,
    /// Why the drive accepts only stops; `None` if it accepts all commands, and for past states.
    pub restore_lock: Option<&'d RestoreLock>,
    /// The snapshot of the drive's registers.
    pub snapshot: Arc<Snapshot>,
    /// Time of the reading.
    pub now: Instant,
    /// Age from which a sample of the fast class is stale.
    pub stale_after: Duration,
    /// Cadence of the slow class.
    pub slow_cycle: Duration,
    /// Times from which on samples are not stale yet, for the fast and for the slow class.
    fresh_from: [Fresh; 2],
}

/// The earliest time of a sample that is not stale yet. With `None` no sample is stale, because the clock has not
/// run long enough.
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
            restore_lock: None,
            snapshot,
            now,
            stale_after,
            slow_cycle,
            fresh_from: limits.map(|limit| now.checked_sub(limit)),
        }
    }

    /// The reading of a drive that accepts only stops while `hold` is set.
    pub fn with_restore_lock(self, hold: &'d RestoreLock) -> Reading<'d> {
        Reading {
            restore_lock: Some(hold),
            ..self
        }
    }
}

impl Reading<'_> {
    /// Age at which a sample of this class becomes stale: slow points get two of their cycles in addition, and
    /// points read once stay good while the drive is online.
    fn age_limit(&self, class: PollClass) -> Option<Duration> {
        match class {
            PollClass::Fast => Some(self.stale_after),
            PollClass::Slow | PollClass::Monitor => Some(self.stale_after + 2 * self.slow_cycle),
            PollClass::Once | PollClass::Fault | PollClass::Never => None,
        }
    }

    /// How long a value of this point is good after it was read, while the drive answers: as long as the value of
    /// its register that becomes stale first.
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

    /// Whether a cell of this age is stale; evaluated some twenty times in each transaction.
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

    /// The words of an address span, if all of them are good.
    ///
    /// # Errors
    /// If the words cannot be served: an address that is not polled counts first, then one refused, then one stale.
    pub fn words(&self, table: Table, start: u16, count: u16) -> Result<Vec<u16>, Unavailable> {
        let table = self.spec.profile.canonical(table);
        let mut words = Vec::with_capacity(usize::from(count));
        let mut worst = None;
        // Cells of one poll have one quality, which is calculated once.
        let mut last: Option<(PollClass, &Cell, Quality)> = None;
        for offset in 0..count {
            let address = start.checked_add(offset).ok_or(Unavailable::NotPolled)?;
            let (class, cell) = self.snapshot.cell(table, address).ok_or(Unavailable::NotPolled)?;
            if class == PollClass::Monitor {
                // A monitor value is read only occasionally, so its present value must be read from the drive.
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

    /// The point whose register gives the value: the point itself, or its monitoring register.
    fn selected(&self, point: PointIndex) -> Option<&Point> {
        let points = &self.spec.profile.points;
        if self.snapshot.monitored.contains(&point) {
            points.get(points.get(point)?.monitor?)
        } else {
            points.get(point)
        }
    }

    pub fn sample(&self, point: PointIndex) -> Sample {
        self.selected(point).map_or(Sample::NONE, |point| self.sample_of(point))
    }

    /// The sample of a point's own register, even if a selector of the drive assigns other content to it.
    pub fn own_sample(&self, point: PointIndex) -> Sample {
        let point = self.spec.profile.points.get(point);
        point.map_or(Sample::NONE, |point| self.sample_of(point))
    }

    fn sample_of(&self, point: &Point) -> Sample {
        match &point.source {
            // A control word that cannot be read has no value, whatever the drive shows in its register.
            Source::Raw(raw) if point.class == PollClass::Never && self.is_unreadable(raw) => Sample::NONE,
            Source::Raw(raw) => self.raw_sample(raw, point.kind()),
            Source::Derived(derived) => {
                let sources = || derived.sources().map(|source| self.sample(source));
                let Some((_, low, high)) = derived.band() else {
                    return derived.sample(sources(), None);
                };
                if let Some(band) = self.band(low, high) {
                    return derived.sample(sources(), Some(band));
                }
                // The last known ends of the band convert the last value of the source; the result has no better
                // quality than they have.
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

    fn is_unreadable(&self, raw: &Raw) -> bool {
        let (table, address) = (raw.table, raw.address);
        let control = self.spec.profile.control.as_ref();
        control.is_some_and(|control| control.is_unreadable(ControlItem { table, address }))
    }

    /// A value of the drive's own registers, with the worst quality and the oldest age among them. Register content
    /// that is not a value (a float that is NaN) is bad.
    fn raw_sample(&self, raw: &Raw, kind: Kind) -> Sample {
        if raw.is_one_word() {
            return self.word_sample(raw, kind);
        }
        let (mut words, mut quality) = ([0; MOST_REGISTERS], Quality::Good);
        let items = usize::from(raw.form.items());
        // A register that was never read makes the whole value count as never read.
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
            None => raw.decode_scaled(words, kind, 0),
            Some(scale) => {
                quality = quality.worse(scale.quality);
                let power = scale.value.and_then(Value::exact_f64);
                power.and_then(|power| raw.decode_scaled(words, kind, power as i64))
            }
        };
        let value = if raw.factor_from.is_empty() {
            value
        } else {
            value.and_then(|value| self.multiplied(value, raw, &mut quality))
        };
        Sample {
            value,
            quality: if value.is_some() { quality } else { Quality::Bad },
            at,
        }
    }

    /// The value of a single register that no other point scales: nearly all points are so, and some twenty of them are decoded in
    /// each transaction.
    fn word_sample(&self, raw: &Raw, kind: Kind) -> Sample {
        let Some((class, cell)) = self.snapshot.cell(raw.table, raw.address) else {
            return Sample::NONE;
        };
        let value = cell.at.and_then(|_| raw.decode_scaled(&[cell.word], kind, 0));
        Sample {
            quality: if value.is_some() {
                self.quality(class, cell)
            } else {
                Quality::Bad
            },
            value,
            at: cell.at,
        }
    }

    /// The value multiplied by those of other points; the quality becomes the worst of all.
    fn multiplied(&self, value: Value, raw: &Raw, quality: &mut Quality) -> Option<Value> {
        let factors = raw.factor_from.iter().map(|factor| {
            let factor = self.sample(*factor);
            *quality = quality.worse(factor.quality);
            factor.value.map(Value::as_f64)
        });
        let factors: Option<Vec<f64>> = factors.collect();
        Raw::multiplied(value, factors?.into_iter())
    }

    /// The ends of a band: those of the drive itself, or else the configured frequencies. The configured maximum
    /// replaces a maximum that the profile states as a fixed number.
    pub fn band(&self, minimum: Bound, maximum: Bound) -> Option<(f64, f64)> {
        self.band_of(minimum, maximum, |sample| sample.good())
    }

    /// Like [`Reading::band`], for limits and conversions of commands: a bound that was read longer than
    /// [`Reading::parameter_age`] ago counts as unknown.
    pub(crate) fn band_for_commands(&self, minimum: Bound, maximum: Bound) -> Option<(f64, f64)> {
        self.band_of(minimum, maximum, |sample| {
            let age = self.now.saturating_duration_since(sample.at?);
            sample.good().filter(|_| age <= self.parameter_age())
        })
    }

    /// Maximum age of a drive parameter on which a limit or a conversion of a command may depend: 5 s or, if the
    /// line is slower, one slow cycle and an eighth for traffic in between.
    pub fn parameter_age(&self) -> Duration {
        PARAMETER_AGE.max(self.slow_cycle + self.slow_cycle / 8)
    }

    fn band_of(&self, minimum: Bound, maximum: Bound, known: impl Fn(&Sample) -> Option<Value>) -> Option<(f64, f64)> {
        let own = |bound: Bound| match bound {
            Bound::Point(point) => known(&self.sample(point)).map(Value::as_f64),
            Bound::Fixed(figure) => Some(figure),
            Bound::Configured => None,
        };
        let configured = self.spec.frequency_range.as_ref();
        if let (Bound::Fixed(_) | Bound::Configured, Some(configured)) = (maximum, configured) {
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

    /// The ends of a band as the drive last reported them, and the worse quality of the two. Commands must not
    /// depend on this.
    fn last_band(&self, minimum: Bound, maximum: Bound) -> Option<((f64, f64), Quality)> {
        let end = |bound: Bound| match bound {
            Bound::Point(point) => {
                let sample = self.sample(point);
                let value = sample.value.filter(|_| sample.quality != Quality::Bad)?;
                Some((value.as_f64(), sample.quality))
            }
            Bound::Fixed(figure) => Some((figure, Quality::Good)),
            Bound::Configured => None,
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

    /// A bit of the model; `None` if the family has the bit but its value is not good. A bit that the family lacks is
    /// not set.
    pub fn bit(&self, point: ModelPoint) -> Option<bool> {
        match self.spec.profile.model_index(point) {
            Some(index) => self.sample(index).good().map(Value::as_bool),
            None => Some(false),
        }
    }

    /// Age of the process data; `None` if the data was never read.
    pub fn age(&self) -> Option<Duration> {
        self.snapshot.fast_at.map(|at| self.now.saturating_duration_since(at))
    }

    /// Whether the process data is too old or the drive is offline.
    pub fn is_stale(&self) -> bool {
        let cadence = self.snapshot.heard.unwrap_or_default();
        let limit = self.stale_after.max(cadence.good_for());
        !self.snapshot.link.is_online() || self.age().is_none_or(|age| age > limit)
    }

    /// The state of the drive in one word; `None` if the drive answers but a point that decides the state is not good.
    pub fn state(&self) -> Option<State> {
        if self.is_stale() {
            return Some(State::Offline);
        }
        self.decided().ok()
    }

    /// The state by the deciding points, in their order; otherwise the quality of the first one that is not good. A
    /// point that the family lacks decides nothing.
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

    /// Quality of the drive as a whole: that of its process data or, while its state is unknown, that of the point
    /// that decides the state.
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
