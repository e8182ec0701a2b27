//! The state of a drive at one time: raw words with their times, and how they become points.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use drivegate_model::drive::{Plan, PointIndex, PollClass};
use drivegate_proto::{Exception, Table};

/// Whether a drive answers, and since when.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Link {
    /// No request was sent yet.
    Untried,
    /// The drive answers since this time.
    Online(SystemTime),
    /// The drive does not answer since this time.
    Offline(SystemTime),
}

impl Link {
    /// Whether the drive answers.
    pub fn is_online(self) -> bool {
        matches!(self, Link::Online(_))
    }

    /// Whether at least one request to the drive has ended.
    pub fn is_tried(self) -> bool {
        self != Link::Untried
    }
}

/// How often a register is received on a line that another master owns, learned from the intervals, in tenths of a
/// second; 0 is unknown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Cadence(u16);

impl Cadence {
    /// Longest interval between two reads that counts as a cadence.
    pub const LONGEST: Duration = Duration::from_secs(600);

    /// Learns from a value that was received again after `interval`. A longer interval counts as at most four times
    /// the present one, so that a pause of the other master does not appear as a slow cadence; a shorter one
    /// reduces the cadence by a quarter at most.
    #[must_use]
    pub fn after(self, interval: Duration) -> Cadence {
        let tenths = |time: Duration| u16::try_from(time.as_millis().div_ceil(100)).unwrap_or(u16::MAX);
        let interval = tenths(interval.min(Cadence::LONGEST));
        let most = self.0.max(10).saturating_mul(4);
        Cadence(interval.max(self.0 - self.0.div_ceil(4)).min(most))
    }

    /// Three intervals: a value not received again within this time is no longer good.
    pub fn good_for(self) -> Duration {
        Duration::from_millis(300) * u32::from(self.0)
    }
}

/// A register (or bit as 0 and 1) of the drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Cell {
    pub(super) word: u16,
    pub(super) at: Option<Instant>,
    pub(super) refused: Option<Exception>,
    /// The value was read before the drive went offline, and not again since.
    pub(super) outlived: bool,
    /// Cadence at which another master reads the register, where one does.
    pub(super) cadence: Cadence,
}

impl Cell {
    /// Whether everything except the word is the same.
    pub(super) fn is_like(&self, other: &Cell) -> bool {
        let alike = |cell: &Cell| (cell.at, cell.refused, cell.outlived, cell.cadence);
        alike(self) == alike(other)
    }
}

/// Cells at adjacent addresses that are polled in the same class.
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

/// The state of a drive at one time.
#[derive(Debug, Clone)]
pub struct Snapshot {
    /// Whether the drive answers.
    pub link: Link,
    /// When the process data (fast class) was last read.
    pub fast_at: Option<Instant>,
    /// How often another master reads process data, where its traffic fills the snapshot.
    pub heard: Option<Cadence>,
    /// Points that take their value from their monitoring register because a selector of the drive has assigned
    /// other content than the profile states; see [`drivegate_model::drive::Point::monitor`].
    pub monitored: Vec<PointIndex>,
    /// Spans of registers, shared with earlier snapshots if nothing in them changed.
    spans: Vec<Arc<Span>>,
}

/// Why words of a drive cannot be served from the image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unavailable {
    /// The register is not polled, so its value must be read from the drive.
    NotPolled,
    /// The value is too old or was never read, or the drive is offline.
    Stale,
    /// The drive refuses the address with this exception.
    Refused(Exception),
}

impl Snapshot {
    /// A snapshot in which no polled address has a value yet.
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

    /// Stores words from a reply of the drive.
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

    /// Stores words from the drive's reply to another master. Returns whether process data was among them.
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
            // Measures the time between two reads of the same registers. Reads of one round may follow each other
            // closely, so the pause until the next round is what counts.
            let interval = before.map(|before| now.saturating_duration_since(before));
            let cadence = self.heard.unwrap_or_default();
            self.heard = Some(interval.map_or(cadence, |interval| cadence.after(interval)));
            self.fast_at = Some(now);
        }
        fast
    }

    /// Corrects all times after the machine was suspended for this time, during which its clock did not advance.
    pub fn slept(&mut self, time: Duration) {
        let earlier = |at: &mut Option<Instant>| *at = at.map(|at| at.checked_sub(time).unwrap_or(at));
        earlier(&mut self.fast_at);
        for cell in self.spans.iter_mut().flat_map(|span| &mut Arc::make_mut(span).cells) {
            earlier(&mut cell.at);
        }
    }

    /// Notes that the drive refused these addresses.
    pub fn refuse(&mut self, table: Table, start: u16, count: u16, exception: Exception) {
        self.each(table, start, usize::from(count), |cell, _| {
            cell.refused = Some(exception)
        });
    }

    /// Slow values may have changed while the drive was offline: they are stale until they are read again.
    pub fn expire_slow_values(&mut self) {
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

    pub(super) fn cell(&self, table: Table, address: u16) -> Option<(PollClass, &Cell)> {
        self.spans
            .iter()
            .find_map(|s| Some((s.class, s.cells.get(s.offset(table, address)?)?)))
    }
}
