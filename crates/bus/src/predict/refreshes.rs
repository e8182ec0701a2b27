//! The refreshes of a bus: their share of the line, and how often they come where the line cannot carry them. Pure.

use std::time::Duration;

use super::super::refresh;
use super::{LEAST_LEFT, Line, TOLERANCE, late, seconds};
use drivegate_core::process_image::DriveSpec;
use drivegate_model::document::{Finding, format_duration};
use drivegate_model::drive::plan::WireTime;
use drivegate_proto::LineFormat;

/// Halvings of the range in which the interval lies: to a millionth of it.
const HALVINGS: u32 = 20;

/// Refreshes that come less often than configured.
#[derive(Debug, Clone, PartialEq)]
pub struct LateRefreshes {
    /// Places of their drives on the bus.
    pub drives: Vec<usize>,
    /// The shortest configured interval.
    pub configured: Duration,
    /// The interval that the line can carry.
    pub achieved: Duration,
    /// Share of the line that all refreshes of the bus would need, and the share that they get.
    pub share: (f64, f64),
    /// The least higher baud rate of all profiles that carries them.
    pub baud: Option<u32>,
}

/// Refreshes of one drive, s.
#[derive(Debug, Clone, Copy)]
struct Repeated {
    round: f64,
    every: f64,
}

impl Line<'_> {
    /// Share of the line that the refresh of a drive takes.
    pub(super) fn refresh_share(&self, format: &LineFormat, drive: &DriveSpec) -> f64 {
        self.repeated(format, drive).map_or(0.0, |one| one.round / one.every)
    }

    fn repeated(&self, format: &LineFormat, drive: &DriveSpec) -> Option<Repeated> {
        let every = drive.refresh?;
        let silence = self.silence_around(format, drive);
        let wire = |pdu| WireTime::of(self.spec.protocol, format, &pdu).total(drive.turnaround, silence);
        let round: Duration = refresh::requests(&drive.profile).into_iter().map(wire).sum();
        Some(Repeated {
            round: round.as_secs_f64(),
            every: every.as_secs_f64().max(1e-3),
        })
    }

    /// The share of the line that refreshes get: what polls leave, half in any case.
    fn room_for_refreshes(&self, baud: u32) -> f64 {
        let (fast, slow) = self.shares(&self.total(baud));
        (1.0 - fast - slow).max(1.0 - LEAST_LEFT)
    }

    /// The refreshes that do not come as often as configured.
    pub(super) fn late_refreshes(&self) -> Option<LateRefreshes> {
        let here = self.spec.format.baud;
        let achieved = self.refresh_interval(here)?;
        let is_late = |drive: &DriveSpec| drive.refresh.is_some_and(|every| late(achieved.as_secs_f64(), every));
        let drives: Vec<&DriveSpec> = self.drives.iter().map(|(drive, _)| *drive).collect();
        let places = drives.iter().enumerate().filter(|(_, drive)| is_late(drive));
        let carries = |baud: &u32| self.refresh_interval(*baud).is_none();
        Some(LateRefreshes {
            drives: places.map(|(place, _)| place).collect(),
            configured: drives.iter().filter_map(|drive| drive.refresh).min()?,
            achieved,
            share: (self.total(here).refreshes, self.room_for_refreshes(here)),
            baud: self.higher_bauds().into_iter().find(carries),
        })
    }

    /// The interval at which refreshes come that are due too often for the line: the longest wait has the next turn, so
    /// it is the same for all of them. `None` if the line carries all.
    fn refresh_interval(&self, baud: u32) -> Option<Duration> {
        let format = LineFormat {
            baud,
            ..self.spec.format
        };
        let drives = self.drives.iter();
        let all: Vec<Repeated> = drives.filter_map(|(drive, _)| self.repeated(&format, drive)).collect();
        let share = |interval: f64| all.iter().map(|one| one.round / one.every.max(interval)).sum::<f64>();
        let room = self.room_for_refreshes(baud);
        if share(0.0) <= room * (1.0 + TOLERANCE) {
            return None;
        }
        let (mut short, mut long) = (0.0, all.iter().map(|one| one.round).sum::<f64>() / room);
        for _ in 0..HALVINGS {
            let middle = (short + long) / 2.0;
            if share(middle) > room {
                short = middle;
            } else {
                long = middle;
            }
        }
        Some(seconds(long))
    }
}

/// Tenths of a second, rounded up.
fn tenths(time: Duration) -> u64 {
    time.as_secs() * 10 + u64::from(time.subsec_nanos().div_ceil(100_000_000))
}

impl LateRefreshes {
    /// The late refreshes and the remedies as a finding of `check`.
    pub fn finding(&self) -> Finding {
        let (needed, gotten) = (self.share.0 * 100.0, self.share.1 * 100.0);
        let configured = format_duration(self.configured);
        let achieved = format_duration(Duration::from_millis(100 * tenths(self.achieved)));
        let drives = match self.drives.len() {
            1 => "1 drive is".to_string(),
            drives => format!("{drives} drives are each"),
        };
        let baud = self
            .baud
            .map_or("split the bus".to_string(), |baud| format!("set baud = {baud}"));
        Finding::new(
            format!(
                "refresh needs {needed:.1} % of the line and gets {gotten:.1} %: {drives} written every {achieved} instead \
                 of every {configured}, and an own timeout shorter than that trips a drive"
            ),
            format!("{baud}, or set refresh = \"{achieved}\", and the own timeouts to more than three times that"),
        )
    }
}

#[cfg(test)]
mod tests {
    use drivegate_testkit::{bus_spec, monitored, profile};

    use super::super::predict;
    use super::*;
    use drivegate_core::process_image::BusSpec;
    use drivegate_proto::wire::Silence;

    fn bus(baud: u32, cycle: u64) -> BusSpec {
        BusSpec {
            format: LineFormat::new(baud, "8N1").unwrap(),
            cycle: Duration::from_millis(cycle),
            slow_cycle: Duration::from_secs(60),
            ..bus_spec("b")
        }
    }

    /// Danfoss drives with these intervals, ms.
    fn drives(every: &[u64]) -> Vec<DriveSpec> {
        let danfoss = profile("danfoss-fc");
        let drive = |(address, every): (u8, &u64)| DriveSpec {
            refresh: Some(Duration::from_millis(*every)),
            ..monitored("d", "b", address, &danfoss)
        };
        (1..).zip(every).map(drive).collect()
    }

    fn late_on(bus: &BusSpec, every: &[u64]) -> Option<LateRefreshes> {
        predict(bus, Silence::Spec, &drives(every)).late_refreshes
    }

    #[test]
    fn refreshes_that_the_line_carries_are_not_late() {
        assert_eq!(late_on(&bus(9600, 10), &[8_000; 30]), None);
        assert_eq!(late_on(&bus(9600, 10), &[]), None);
        // Polls leave more than half of the line.
        assert_eq!(late_on(&bus(9600, 10_000), &[150]), None);
        assert!(late_on(&bus(9600, 10), &[150]).is_some());
    }

    #[test]
    fn late_refreshes_take_turns_in_half_of_the_line() {
        let found = late_on(&bus(9600, 10), &[1_000; 30]).unwrap();
        assert_eq!((found.drives.len(), found.configured), (30, Duration::from_secs(1)));
        assert_eq!(found.share.1, 0.5);
        let interval = found.share.0 / 0.5;
        assert!((found.achieved.as_secs_f64() - interval).abs() < 0.001, "{found:?}");
        // Drives that are due less often keep their interval, and the others share what these leave.
        let mixed: Vec<u64> = [[500; 10], [60_000; 10]].concat();
        let found = late_on(&bus(9600, 10), &mixed).unwrap();
        assert_eq!(found.drives, (0..10).collect::<Vec<usize>>());
        let alone = late_on(&bus(9600, 10), &[500; 10]).unwrap();
        let longer = found.achieved.as_secs_f64() / alone.achieved.as_secs_f64();
        assert!((1.01..1.2).contains(&longer), "{longer}");
    }

    #[test]
    fn each_remedy_is_one() {
        let asked = bus(9600, 10);
        for every in [vec![1_000; 10], vec![1_000; 30], [[500; 10], [60_000; 10]].concat()] {
            let found = late_on(&asked, &every).unwrap();
            let longer = found.achieved.as_millis() as u64 + 1;
            let longest: Vec<u64> = every.iter().map(|every| longer.max(*every)).collect();
            assert_eq!(late_on(&asked, &longest), None);
            if let Some(baud) = found.baud {
                let format = LineFormat { baud, ..asked.format };
                assert_eq!(
                    late_on(
                        &BusSpec {
                            format,
                            ..asked.clone()
                        },
                        &every
                    ),
                    None
                );
            }
        }
    }
}
