//! Predicts the cadence and load of a bus from its configuration alone. Pure.
//!
//! A round of the fast class consists of all fast requests of the bus; it starts every `cycle`, or without idle
//! time if the line cannot carry that. Slow requests fill the idle time of a round as far as they fit completely,
//! and get at least [`SLOW_SHARE`] of the line. Requests of the class `once` cost nothing in the long run.

mod cadence;
mod faster;
mod refreshes;

pub use cadence::carried;
pub use faster::faster_points;
pub use refreshes::LateRefreshes;

use std::fmt;
use std::time::Duration;

use super::schedule::{SLOW_SHARE, slow_share};
use drivegate_core::process_image::{BusSpec, DriveSpec};
use drivegate_model::document::{Finding, format_duration};
use drivegate_model::drive::plan::WireTime;
use drivegate_model::drive::{DriveIndex, PerDrive, Plan, PlannedRead, PollClass};
use drivegate_proto::LineFormat;
use drivegate_proto::wire::Silence;

/// Baud rates that are proposed when no profile of the bus lists any.
const USUAL_BAUDS: [u32; 9] = [1200, 2400, 4800, 9600, 19_200, 38_400, 57_600, 115_200, 230_400];

/// Maximum planned load of the line if there is a choice: the rest is for commands, retries and drives slower than
/// their profile.
const MOST_LOAD: f64 = 0.8;

/// Minimum share of the line that polls have while refreshes run.
const LEAST_LEFT: f64 = 0.5;

/// Relative deviation from a cadence that is not reported as missed.
const TOLERANCE: f64 = 0.001;

/// A request of the plan of a bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PredictedRequest {
    /// Index of the drive on the bus.
    pub drive: DriveIndex,
    /// The planned read.
    pub read: PlannedRead,
    /// Duration of the whole transaction: request, its recognition by the drive, turnaround, reply, silence.
    pub wire: Duration,
}

/// The predicted cadence and load of a bus.
#[derive(Debug, Clone, PartialEq)]
pub struct Prediction {
    /// All requests, drive by drive, fast ones first.
    pub requests: Vec<PredictedRequest>,
    /// Time from round to round of the fast class; absent without fast requests.
    pub fast_cycle: Option<Duration>,
    /// Time from round to round of the slow class; absent without slow requests.
    pub slow_cycle: Option<Duration>,
    /// Share of the line that the configured cycles would need; above 1 no schedule can carry them.
    pub demand: f64,
    /// Share of the line that will be in use, 0..=1.
    pub load: f64,
    /// Share of the line that the refreshes of all drives take while all are active.
    pub refreshes: f64,
    /// Refreshes that come less often than configured while all are active.
    pub late_refreshes: Option<LateRefreshes>,
    /// Cadences that the line cannot carry.
    pub shortage: Option<Shortage>,
}

/// The cycles that the line cannot carry, at least one, and the remedies.
#[derive(Debug, Clone, PartialEq)]
pub struct Shortage {
    /// The fast class, if its cycle is missed.
    pub fast: Option<Missed>,
    /// The slow class, if its cycle is missed.
    pub slow: Option<Missed>,
    /// Changes that would each carry all cadences, best first.
    pub remedies: Vec<Remedy>,
}

/// A configured cadence that the line misses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Missed {
    /// Cadence that was configured.
    pub configured: Duration,
    /// Cadence that the line can carry.
    pub achieved: Duration,
    /// Number of requests in one round.
    pub requests: usize,
    /// Wire time of one round.
    pub round: Duration,
}

/// A change with which the line can carry its cycles; a baud rate only if it differs from the present one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Remedy {
    /// The least higher baud rate of all profiles that does.
    Baud(u32),
    /// Minimum number of buses among which the drives must be divided.
    Split {
        /// Number of buses to split the drives over.
        buses: usize,
        /// Baud rate of each bus; `None` keeps the present one.
        baud: Option<u32>,
    },
    /// The shortest cadence of the fast class, whole milliseconds.
    Cycle {
        /// The longer cadence to configure.
        cycle: Duration,
        /// The higher baud rate to configure.
        baud: Option<u32>,
    },
    /// The shortest cadence of the slow class, whole milliseconds.
    SlowCycle(Duration),
}

/// Predicts the bus `spec` with its drives.
pub fn predict(spec: &BusSpec, silence: Silence, drives: &[DriveSpec]) -> Prediction {
    let line = Line::new(spec, silence, drives);
    let total = line.total(spec.format.baud);
    let (fast, slow) = line.cycles(&total);
    let (fast_share, slow_share) = line.shares(&total);
    let present = |round: f64, cycle: f64| (round > 0.0).then(|| seconds(cycle));
    let mut prediction = Prediction {
        refreshes: total.refreshes,
        requests: line.requests(),
        fast_cycle: present(total.fast, fast),
        slow_cycle: present(total.slow, slow),
        demand: fast_share + slow_share + total.refreshes,
        load: (total.fast / fast + total.slow / slow + total.refreshes).min(1.0),
        late_refreshes: line.late_refreshes(),
        shortage: None,
    };
    prediction.shortage = line.shortage(&prediction, &total);
    prediction
}

impl Prediction {
    /// Whether the line keeps all cadences with a fifth of its time to spare.
    fn is_comfortable(&self) -> bool {
        self.shortage.is_none() && self.demand <= MOST_LOAD
    }
}

/// Wire time of one round of each class, s.
#[derive(Debug, Clone, Copy, Default)]
struct Rounds {
    fast: f64,
    slow: f64,
    /// Number of requests in a slow round, and the duration of the longest.
    slow_requests: f64,
    longest_slow: f64,
    /// Share of the line that refreshes take.
    refreshes: f64,
}

impl Rounds {
    fn and(self, other: &Rounds) -> Rounds {
        Rounds {
            fast: self.fast + other.fast,
            slow: self.slow + other.slow,
            slow_requests: self.slow_requests + other.slow_requests,
            longest_slow: self.longest_slow.max(other.longest_slow),
            refreshes: self.refreshes + other.refreshes,
        }
    }

    /// Mean duration of a slow request.
    fn mean_slow(&self) -> f64 {
        self.slow / self.slow_requests.max(1.0)
    }
}

/// The line with its drives and the requested cycles.
struct Line<'a> {
    spec: &'a BusSpec,
    silence: Silence,
    drives: PerDrive<(&'a DriveSpec, Plan)>,
}

impl<'a> Line<'a> {
    fn new(spec: &'a BusSpec, silence: Silence, drives: &'a [DriveSpec]) -> Line<'a> {
        Line {
            spec,
            silence,
            drives: drives.iter().map(|d| (d, Plan::of(&d.profile))).collect(),
        }
    }

    fn wire(&self, format: &LineFormat, drive: &DriveSpec, read: &PlannedRead) -> Duration {
        let silence = self.silence_around(format, drive);
        WireTime::of(self.spec.protocol, format, &read.pdu()).total(drive.turnaround, silence)
    }

    /// Silence that an exchange with the drive takes.
    fn silence_around(&self, format: &LineFormat, drive: &DriveSpec) -> Duration {
        let of_bus = self.spec.protocol.silence(self.silence, format);
        drive.timing.silence_around(of_bus)
    }

    fn requests(&self) -> Vec<PredictedRequest> {
        let mut requests = Vec::new();
        for (index, (drive, plan)) in self.drives.enumerate() {
            requests.extend(plan.reads.iter().map(|read| PredictedRequest {
                drive: index,
                read: *read,
                wire: self.wire(&self.spec.format, drive, read),
            }));
        }
        requests
    }

    /// Rounds of each drive alone at that baud.
    fn rounds(&self, baud: u32) -> Vec<Rounds> {
        let format = LineFormat {
            baud,
            ..self.spec.format
        };
        let of = |(drive, plan): &(&DriveSpec, Plan)| {
            let mut rounds = Rounds {
                refreshes: self.refresh_share(&format, drive),
                ..Rounds::default()
            };
            for read in &plan.reads {
                let wire = self.wire(&format, drive, read).as_secs_f64();
                match read.class {
                    PollClass::Fast => rounds.fast += wire,
                    PollClass::Slow => {
                        rounds.slow += wire;
                        rounds.slow_requests += 1.0;
                        rounds.longest_slow = rounds.longest_slow.max(wire);
                    }
                    PollClass::Once | PollClass::Fault | PollClass::Monitor | PollClass::Never => {}
                }
            }
            rounds
        };
        self.drives.iter().map(of).collect()
    }

    /// Rounds of all drives at that baud.
    fn total(&self, baud: u32) -> Rounds {
        self.rounds(baud).iter().fold(Rounds::default(), Rounds::and)
    }

    /// Shares of the line that the classes ask for.
    fn shares(&self, rounds: &Rounds) -> (f64, f64) {
        let share = |round: f64, cycle: Duration| round / cycle.as_secs_f64().max(1e-6);
        (
            share(rounds.fast, self.spec.cycle),
            share(rounds.slow, self.spec.slow_cycle),
        )
    }

    /// Share of the line that slow requests can have: the idle time of a round as far as whole requests fit, or
    /// the share that they get in any case.
    fn room(&self, rounds: &Rounds) -> f64 {
        self.room_beside(rounds, slow_share(self.shares(rounds).1))
    }

    /// The share of slow polls where they get `least` in any case.
    fn room_beside(&self, rounds: &Rounds, least: f64) -> f64 {
        if rounds.fast == 0.0 {
            return 1.0;
        }
        let cycle = self.spec.cycle.as_secs_f64().max(1e-6);
        let fitting =
            ((cycle * (1.0 - rounds.refreshes) - rounds.fast).max(0.0) / rounds.longest_slow.max(1e-6)).floor();
        (fitting * rounds.mean_slow() / cycle).max(least)
    }

    /// Seconds from round to round, fast and slow.
    fn cycles(&self, rounds: &Rounds) -> (f64, f64) {
        let (fast, slow) = self.shares(rounds);
        let granted = slow.min(self.room(rounds));
        let left = (1.0 - granted - rounds.refreshes).max(LEAST_LEFT);
        let fast_cycle = if fast > 0.0 { rounds.fast / left } else { 0.0 };
        let slow_cycle = if slow > 0.0 { rounds.slow / granted } else { 0.0 };
        (
            fast_cycle.max(self.spec.cycle.as_secs_f64()),
            slow_cycle.max(self.spec.slow_cycle.as_secs_f64()),
        )
    }

    /// Whether both cadences are kept.
    fn carries(&self, rounds: &Rounds) -> bool {
        let (fast, slow) = self.cycles(rounds);
        !late(fast, self.spec.cycle) && !late(slow, self.spec.slow_cycle)
    }

    fn shortage(&self, prediction: &Prediction, total: &Rounds) -> Option<Shortage> {
        let missed = |class, wanted: Duration, achieved: Option<Duration>, round| {
            let missed = achieved.filter(|achieved| late(achieved.as_secs_f64(), wanted));
            missed.map(|achieved| Missed {
                configured: wanted,
                achieved,
                requests: prediction.requests.iter().filter(|r| r.read.class == class).count(),
                round: seconds(round),
            })
        };
        let fast = missed(PollClass::Fast, self.spec.cycle, prediction.fast_cycle, total.fast);
        let slow = missed(PollClass::Slow, self.spec.slow_cycle, prediction.slow_cycle, total.slow);
        if fast.is_none() && slow.is_none() {
            return None;
        }
        let mut remedies = self.other_lines();
        remedies.extend(self.longer(fast.is_some(), total));
        Some(Shortage { fast, slow, remedies })
    }

    /// A higher baud rate that carries everything; otherwise the smallest number of buses, and the cycle at the highest
    /// baud rate.
    fn other_lines(&self) -> Vec<Remedy> {
        let bauds = self.higher_bauds();
        if let Some(baud) = bauds.iter().find(|baud| self.carries(&self.total(**baud))) {
            return vec![Remedy::Baud(*baud)];
        }
        let here = self.split(self.spec.format.baud).map(|buses| (buses, None));
        let best = bauds.last().copied();
        let there = best.and_then(|baud| Some((self.split(baud)?, Some(baud))));
        let split = match (here, there) {
            (Some(here), Some(there)) if there.0 < here.0 => Some(there),
            (here, there) => here.or(there),
        };
        let cycle = best.and_then(|baud| Some((self.shortest_cycle(&self.total(baud))?, baud)));
        let split = split.map(|(buses, baud)| Remedy::Split { buses, baud });
        let cycle = cycle.map(|(cycle, baud)| Remedy::Cycle {
            cycle,
            baud: Some(baud),
        });
        split.into_iter().chain(cycle).collect()
    }

    /// Higher baud rates that all drives of the bus know, ascending.
    fn higher_bauds(&self) -> Vec<u32> {
        let mut lists = self
            .drives
            .iter()
            .map(|(d, _)| &d.profile.bauds)
            .filter(|l| !l.is_empty());
        let mut bauds = match lists.next() {
            None => USUAL_BAUDS.to_vec(),
            Some(first) => first.clone(),
        };
        let allowed = |baud: u32| {
            let format = self.spec.format;
            self.spec.protocol.allows(&LineFormat { baud, ..format })
        };
        bauds.retain(|baud| {
            *baud > self.spec.format.baud && allowed(*baud) && lists.clone().all(|list| list.contains(baud))
        });
        bauds.sort_unstable();
        bauds
    }

    /// Number of buses needed for the drives, first fit by decreasing time; `None` if a single drive needs too much.
    fn split(&self, baud: u32) -> Option<usize> {
        let mut drives = self.rounds(baud);
        let time = |one: &Rounds| one.fast + one.slow;
        drives.sort_by(|a, b| time(b).total_cmp(&time(a)));
        let mut buses: Vec<Rounds> = Vec::new();
        for drive in drives {
            if !self.carries(&drive) {
                return None;
            }
            match buses.iter_mut().find(|bus| self.carries(&bus.and(&drive))) {
                Some(bus) => *bus = bus.and(&drive),
                None => buses.push(drive),
            }
        }
        Some(buses.len())
    }

    /// The longer cadences with which the line carries both classes at its present settings.
    fn longer(&self, fast_missed: bool, rounds: &Rounds) -> Vec<Remedy> {
        let cycle = |cycle| Remedy::Cycle { cycle, baud: None };
        if fast_missed {
            return self.shortest_cycle(rounds).map(cycle).into_iter().collect();
        }
        let slow_cycle = Remedy::SlowCycle(whole_milliseconds(rounds.slow / self.room_beside(rounds, SLOW_SHARE)));
        let roomy = self.roomy_cycle(rounds).map(cycle);
        [slow_cycle].into_iter().chain(roomy).collect()
    }

    /// The shortest cadence of the fast class at which the slow one is kept.
    fn shortest_cycle(&self, rounds: &Rounds) -> Option<Duration> {
        let (_, slow) = self.shares(rounds);
        match slow {
            _ if rounds.fast == 0.0 => None,
            slow if slow <= SLOW_SHARE => {
                let left = (1.0 - slow - rounds.refreshes).max(LEAST_LEFT);
                Some(whole_milliseconds(rounds.fast / left))
            }
            _ => self.roomy_cycle(rounds),
        }
    }

    /// The shortest cadence whose idle time has room for the slow class: for as many of its longest requests as make
    /// `fitting * mean / cycle` its share.
    fn roomy_cycle(&self, rounds: &Rounds) -> Option<Duration> {
        let (_, slow) = self.shares(rounds);
        let spare = rounds.mean_slow() - slow * rounds.longest_slow;
        let fitting = (slow * rounds.fast / spare).ceil();
        (spare > 0.0 && rounds.fast > 0.0)
            .then(|| whole_milliseconds(rounds.fast + fitting * rounds.longest_slow))
            .filter(|cycle| late(cycle.as_secs_f64(), self.spec.cycle))
    }
}

/// Whether the achieved cadence misses the requested one.
fn late(achieved: f64, wanted: Duration) -> bool {
    achieved > wanted.as_secs_f64() * (1.0 + TOLERANCE)
}

fn seconds(time: f64) -> Duration {
    Duration::try_from_secs_f64(time).unwrap_or(Duration::MAX)
}

/// Rounded up, a nanosecond of dust aside.
fn whole_milliseconds(seconds: f64) -> Duration {
    Duration::from_millis((seconds * 1e3 - 1e-6).ceil() as u64)
}

impl Shortage {
    /// The shortage and its remedies as a finding of `check`.
    pub fn finding(&self) -> Finding {
        let milliseconds = |time: Duration| time.as_secs_f64() * 1e3;
        let mut cadences = Vec::new();
        let mut rounds = Vec::new();
        for (key, class, missed) in [("cycle", "fast", &self.fast), ("slow_cycle", "slow", &self.slow)] {
            let Some(missed) = missed else { continue };
            let requests = if missed.requests == 1 { "request" } else { "requests" };
            cadences.push(format!("{key} = \"{}\"", format_duration(missed.configured)));
            rounds.push(format!(
                "{class} polling of {} {requests} takes {:.1} ms, every {:.1} ms",
                missed.requests,
                milliseconds(missed.round),
                milliseconds(missed.achieved)
            ));
        }
        let remedies: Vec<String> = self.remedies.iter().map(Remedy::to_string).collect();
        let remedy = if remedies.is_empty() {
            "use fewer drives or longer cycles".to_string()
        } else {
            remedies.join(", or ")
        };
        let (cadences, rounds) = (cadences.join(" and "), rounds.join(", "));
        Finding::new(format!("the line cannot carry {cadences}: {rounds}"), remedy)
    }
}

impl fmt::Display for Remedy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Remedy::Baud(baud) => write!(f, "set baud = {baud}"),
            Remedy::Split { buses, baud: None } => write!(f, "split the bus into {buses} buses"),
            Remedy::Split {
                buses,
                baud: Some(baud),
            } => write!(f, "split the bus into {buses} buses with baud = {baud}"),
            Remedy::Cycle { cycle, baud: None } => write!(f, "set cycle = \"{}\"", format_duration(*cycle)),
            Remedy::Cycle {
                cycle,
                baud: Some(baud),
            } => write!(f, "set baud = {baud} and cycle = \"{}\"", format_duration(*cycle)),
            Remedy::SlowCycle(cycle) => write!(f, "set slow_cycle = \"{}\"", format_duration(*cycle)),
        }
    }
}

#[cfg(test)]
mod tests;
