//! Checks whether process data still has the values that the profile assumes. On several families a selector
//! parameter decides the content of a process data register; the profile names the register that always has the
//! value ([`Point::monitor`]), and the two are compared when the drive comes online, until a comparison proves
//! something. Pure.
//!
//! After the first comparison that differs, the value comes from the monitoring register, which is slower and
//! always right. Two comparisons that agree switch back to the process data; three that differ show that the
//! selection was changed.

use std::time::{Duration, Instant};

use drivegate_core::process_image::Reading;
use drivegate_model::drive::profile::MOST_REGISTERS;
use drivegate_model::drive::{DriveIndex, ModelPoint, PerDrive, PerPoint, PlannedRead, Point, PointIndex, Value};
use drivegate_proto::Table;

/// Number of consecutive comparisons that differ, all with the same selection, after which the selection counts as changed.
const DIFFERING: u8 = 3;
/// Matching comparisons in a row after which process data is trusted again.
const AGREEING: u8 = 2;
/// First and longest pause before a value is compared again after a comparison that proved nothing, such as 0 of a
/// motor at standstill.
const PAUSE: (Duration, Duration) = (Duration::from_secs(10), Duration::from_secs(600));
/// Pause between two looks at process data that is 0 in a motor that does not run.
const LOOK: Duration = Duration::from_millis(500);
/// Relative difference, or difference in counts, that changing values may have although the selection is right.
const TOLERANCE: f64 = 0.1;
const COUNTS: f64 = 50.0;

/// The comparisons of all drives of a bus.
#[derive(Debug, Default)]
pub(super) struct Selections {
    drives: PerDrive<DriveSelections>,
}

#[derive(Debug)]
struct DriveSelections {
    points: Vec<Compared>,
    /// Whether an event has reported that the selection differs.
    reported: bool,
}

/// A point of process data and the state of its comparisons.
#[derive(Debug)]
struct Compared {
    point: PointIndex,
    monitor: PointIndex,
    /// Registers of the process data, and of its monitoring register.
    registers: Option<(Registers, Registers)>,
    is_code: bool,
    /// Whether the value is 0 if all its registers are.
    is_0_by_registers: bool,
    trust: Trust,
    /// Process data before the monitoring register was read, and that register: to be compared with the next process data.
    open: Option<(f64, f64)>,
    last: f64,
}

/// The registers of a value.
#[derive(Debug, Clone, Copy)]
struct Registers {
    table: Table,
    first: u16,
    last: u16,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Trust {
    /// No comparison has proved anything yet; when to compare next, if there is something to compare, and the pause
    /// after that.
    Unproven(Instant, Duration),
    Proven,
    /// Number of comparisons that differed, and of those that agreed since.
    Doubted(u8, u8),
    /// The selection was changed; comparisons that agree since.
    Differs(u8),
}

/// The result of comparing two values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Verdict {
    Agrees,
    Differs,
    /// The comparison proves nothing: both values are about 0, or the register may not exist.
    Nothing,
}

/// What follows from a read of process data.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Findings {
    /// Monitoring points to be read, and when.
    pub(super) reads: Vec<(PointIndex, Instant)>,
    /// The points whose value comes from their monitoring register from now on, if that has changed.
    pub(super) monitored: Option<Vec<PointIndex>>,
    /// Points now known to differ, with both values: the first ones of the drive.
    pub(super) differ: Vec<(PointIndex, f64, f64)>,
    /// Points whose process data matches the profile again.
    pub(super) restored: Vec<PointIndex>,
}

impl Selections {
    /// The comparisons of drives with these points.
    pub(super) fn new<'p>(drives: impl Iterator<Item = &'p PerPoint<Point>>, now: Instant) -> Selections {
        let of = |points: &PerPoint<Point>| {
            let compared = |(index, point): (PointIndex, &Point)| {
                let monitor = point.monitor?;
                Some(Compared {
                    point: index,
                    monitor,
                    registers: Registers::of(point).zip(points.get(monitor).and_then(Registers::of)),
                    is_code: is_code(point),
                    is_0_by_registers: point.raw().is_some_and(|raw| {
                        let zeros = [0; MOST_REGISTERS];
                        raw.decode(&zeros, point.kind()).map(Value::as_f64) == Some(0.0)
                    }),
                    trust: Trust::Unproven(now, PAUSE.0),
                    open: None,
                    last: 0.0,
                })
            };
            DriveSelections {
                points: points.enumerate().filter_map(compared).collect(),
                reported: false,
            }
        };
        Selections {
            drives: drives.map(of).collect(),
        }
    }

    /// The drive was offline: earlier readings are not compared with new ones.
    pub(super) fn interrupted(&mut self, drive: DriveIndex) {
        for compared in self.points(drive) {
            compared.open = None;
        }
    }

    /// Notes that the drive refuses this read: a missing monitoring register proves nothing.
    pub(super) fn refused(
        &mut self,
        drive: DriveIndex,
        read: &PlannedRead,
        reading: &Reading<'_>,
        now: Instant,
    ) -> Findings {
        for compared in self.points(drive) {
            if compared.is_monitor_in(read) {
                compared.open = None;
                if matches!(compared.trust, Trust::Doubted(..)) {
                    compared.trust = Trust::Unproven(now + PAUSE.1, PAUSE.1);
                }
            }
        }
        self.findings(drive, reading, Vec::new(), Vec::new(), Vec::new())
    }

    /// Whether a read that was answered with `words` at `now` concerns a comparison. Most reads concern none: once the
    /// process data has proved right, only its monitoring registers do.
    pub(super) fn are_concerned_by(&self, drive: DriveIndex, read: &PlannedRead, words: &[u16], now: Instant) -> bool {
        let points = &self.drives.of(drive).points;
        points
            .iter()
            .any(|compared| compared.is_monitor_in(read) || compared.looks_at(read, words, now))
    }

    /// Notes that the drive answered this read with `words` and has the values of `reading` after it.
    pub(super) fn read(
        &mut self,
        drive: DriveIndex,
        read: &PlannedRead,
        words: &[u16],
        reading: &Reading<'_>,
    ) -> Findings {
        let now = reading.now;
        let profile = &reading.spec.profile;
        let runs = || {
            let running = profile.model_index(ModelPoint::Running);
            running.is_some_and(|running| reading.sample(running).good().is_some_and(|value| value.as_bool()))
        };
        let value = |point: PointIndex| reading.own_sample(point).good().map(|value| value.as_f64());
        let (mut wanted, mut differ, mut restored) = (Vec::new(), Vec::new(), Vec::new());
        for compared in self.points(drive) {
            let Some((point, monitor)) = profile
                .points
                .get(compared.point)
                .zip(profile.points.get(compared.monitor))
            else {
                continue;
            };
            if compared.is_monitor_in(read) {
                compared.open = value(compared.point).zip(value(compared.monitor));
                continue;
            }
            if !compared.looks_at(read, words, now) {
                continue;
            }
            let Some(own) = value(compared.point) else { continue };
            let Some((before, monitored)) = compared.open.take() else {
                wanted.extend(
                    compared
                        .comparison_due(own, &runs, now)
                        .map(|at| (compared.monitor, at)),
                );
                compared.last = own;
                continue;
            };
            compared.last = own;
            let before_it = compared.trust;
            compared.judge(compare((point, monitor), (before, own), monitored), now);
            match (before_it, compared.trust) {
                (Trust::Doubted(..), Trust::Differs(_)) => differ.push((compared.point, own, monitored)),
                (Trust::Differs(_), Trust::Proven) => restored.push(compared.point),
                _ => {}
            }
            if compared.is_monitored() {
                wanted.push((compared.monitor, now + reading.slow_cycle));
            }
        }
        self.findings(drive, reading, wanted, differ, restored)
    }

    fn findings(
        &mut self,
        drive: DriveIndex,
        reading: &Reading<'_>,
        reads: Vec<(PointIndex, Instant)>,
        differ: Vec<(PointIndex, f64, f64)>,
        restored: Vec<PointIndex>,
    ) -> Findings {
        let points = &self.drives.of(drive).points;
        let monitored = points
            .iter()
            .filter(|compared| compared.is_monitored())
            .map(|compared| compared.point);
        let is_new = !monitored.clone().eq(reading.snapshot.monitored.iter().copied());
        Findings {
            monitored: is_new.then(|| monitored.collect()),
            reads,
            differ,
            restored,
        }
    }

    /// Whether this is the first report of a drive since the gateway started.
    pub(super) fn report_first(&mut self, drive: DriveIndex) -> bool {
        !std::mem::replace(&mut self.drives.of_mut(drive).reported, true)
    }

    fn points(&mut self, drive: DriveIndex) -> impl Iterator<Item = &mut Compared> {
        self.drives.of_mut(drive).points.iter_mut()
    }
}

impl Compared {
    fn is_monitored(&self) -> bool {
        matches!(self.trust, Trust::Doubted(..) | Trust::Differs(_))
    }

    /// Whether the process data is to be compared and is in this read: evaluated after each read.
    fn looks_at(&self, read: &PlannedRead, words: &[u16], now: Instant) -> bool {
        let Some((own, _)) = self.registers.filter(|(own, _)| own.are_in(read)) else {
            return false;
        };
        self.open.is_some()
            || match self.trust {
                Trust::Unproven(next, _) => {
                    // A code that stays 0 gives no reason.
                    let stays_0 = || self.is_0_by_registers && self.last == 0.0 && own.are_0_in(read, words);
                    now >= next || self.is_code && !stays_0()
                }
                Trust::Proven | Trust::Doubted(..) | Trust::Differs(_) => false,
            }
    }

    fn is_monitor_in(&self, read: &PlannedRead) -> bool {
        self.registers.is_some_and(|(_, monitor)| monitor.are_in(read))
    }

    /// When to compare the point, if the process data just read gives a reason for it.
    fn comparison_due(&mut self, own: f64, runs: &dyn Fn() -> bool, now: Instant) -> Option<Instant> {
        let Trust::Unproven(next, pause) = self.trust else {
            return None;
        };
        let came = self.is_code && self.last == 0.0 && own != 0.0;
        if !came && now < next {
            return None;
        }
        if !came && own == 0.0 && !runs() {
            self.trust = Trust::Unproven(now + LOOK, pause);
            return None;
        }
        self.trust = Trust::Unproven(now + pause, (pause * 2).min(PAUSE.1));
        Some(now)
    }

    fn judge(&mut self, verdict: Verdict, now: Instant) {
        self.trust = match (self.trust, verdict) {
            (Trust::Unproven(next, pause), Verdict::Nothing) => Trust::Unproven(next.max(now + PAUSE.0), pause),
            (Trust::Unproven(..) | Trust::Proven, Verdict::Agrees) => Trust::Proven,
            (Trust::Proven, Verdict::Nothing) => Trust::Proven,
            (Trust::Unproven(..) | Trust::Proven, Verdict::Differs) => Trust::Doubted(1, 0),
            (Trust::Doubted(differing, _), Verdict::Differs) if differing + 1 >= DIFFERING => Trust::Differs(0),
            (Trust::Doubted(differing, _), Verdict::Differs) => Trust::Doubted(differing + 1, 0),
            (Trust::Doubted(_, agreeing), Verdict::Agrees) if agreeing + 1 >= AGREEING => Trust::Proven,
            (Trust::Doubted(_, agreeing), Verdict::Nothing) if agreeing + 1 >= AGREEING => {
                Trust::Unproven(now + PAUSE.0, PAUSE.0)
            }
            (Trust::Doubted(differing, agreeing), _) => Trust::Doubted(differing, agreeing + 1),
            (Trust::Differs(agreeing), Verdict::Agrees) if agreeing + 1 >= AGREEING => Trust::Proven,
            (Trust::Differs(agreeing), Verdict::Agrees) => Trust::Differs(agreeing + 1),
            (Trust::Differs(_), Verdict::Differs) => Trust::Differs(0),
            (Trust::Differs(agreeing), Verdict::Nothing) => Trust::Differs(agreeing),
        };
    }
}

/// Whether the point is a number such as a fault code, whose values are either equal or different, never close.
fn is_code(point: &Point) -> bool {
    point.unit.is_empty()
}

/// Compares process data from right before and right after the read of its monitoring register.
fn compare(of: (&Point, &Point), around: (f64, f64), monitored: f64) -> Verdict {
    let (point, monitor) = of;
    let (low, high) = (around.0.min(around.1), around.0.max(around.1));
    let count = |point: &Point| point.raw().map_or(0.0, |raw| raw.scale.abs());
    let most = low.abs().max(high.abs()).max(monitored.abs());
    let slack = if is_code(point) {
        0.0
    } else {
        (most * TOLERANCE).max(COUNTS * count(point).max(count(monitor)))
    };
    if (low - slack..=high + slack).contains(&monitored) {
        let least = low.abs().min(high.abs()).min(monitored.abs());
        return if least > slack {
            Verdict::Agrees
        } else {
            Verdict::Nothing
        };
    }
    // A register that only other documents name, and that reads 0, is perhaps not there.
    if monitored == 0.0 && !monitor.verified {
        Verdict::Nothing
    } else {
        Verdict::Differs
    }
}

impl Registers {
    /// The registers of a point; `None` if it is derived.
    fn of(point: &Point) -> Option<Registers> {
        let raw = point.raw()?;
        Some(Registers {
            table: raw.table,
            first: raw.address,
            last: raw.address.checked_add(raw.form.items().checked_sub(1)?)?,
        })
    }

    fn are_in(&self, read: &PlannedRead) -> bool {
        self.table == read.table && self.first >= read.start && self.last - read.start < read.count
    }

    /// Whether all of them are 0 in the reply to a read that has them.
    fn are_0_in(&self, read: &PlannedRead, words: &[u16]) -> bool {
        let place = |address: u16| usize::from(address.saturating_sub(read.start));
        let own = words.get(place(self.first)..=place(self.last));
        own.is_some_and(|own| own.iter().all(|word| *word == 0))
    }
}

#[cfg(test)]
mod tests;
