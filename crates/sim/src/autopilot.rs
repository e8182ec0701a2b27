//! Operates a drive of the demo: starts, ramps, reverses, stops, and now and then trips it.
//!
//! The autopilot of a simulated drive, pure and reproducible: the seed determines what happens when. Like another
//! master on the fieldbus it acts through control word and reference, until the drive is commanded over the bus;
//! then it stops for good.

use super::SimTime;
use super::model::{Command, Model};
use super::random::Random;
use std::time::Duration;

/// The next action of the autopilot.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Next {
    Start,
    Change,
    Trip,
    ResetOn,
    ResetOff,
}

/// Operates one drive at random.
#[derive(Debug, Clone)]
pub(crate) struct Autopilot {
    random: Random,
    next: Next,
    at: SimTime,
    command: Command,
    /// Changes of the reference until the run ends.
    changes: u64,
}

impl Autopilot {
    /// An autopilot that begins within a few seconds after `now`.
    pub(crate) fn new(seed: u64, now: SimTime) -> Autopilot {
        let mut random = Random::new(seed);
        let at = now + Duration::from_millis(random.within(500..=4000));
        Autopilot {
            random,
            next: Next::Start,
            at,
            command: Command::default(),
            changes: 0,
        }
    }

    /// When the autopilot acts next.
    pub(crate) fn next_at(&self) -> SimTime {
        self.at
    }

    /// Does what the autopilot has due at `now`.
    pub(crate) fn act(&mut self, drive: &mut dyn Model, now: SimTime) {
        match self.next {
            Next::Start => {
                self.changes = self.random.within(2..=5);
                self.command = Command {
                    run: true,
                    reverse: self.random.chance(0.2),
                    reference: self.reference(),
                };
                drive.command(self.command);
                self.then(now, Next::Change, 5_000..=12_000);
            }
            Next::Change if self.changes > 0 => {
                self.changes -= 1;
                self.command.reference = self.reference();
                drive.command(self.command);
                let next = if self.random.chance(0.08) {
                    Next::Trip
                } else {
                    Next::Change
                };
                self.then(now, next, 5_000..=12_000);
            }
            Next::Change => {
                self.command = Command {
                    run: false,
                    ..self.command
                };
                drive.command(self.command);
                self.then(now, Next::Start, 5_000..=10_000);
            }
            Next::Trip => {
                let faults = drive.usual_faults();
                let pick = self.random.within(0..=(faults.len() as u64).saturating_sub(1)) as usize;
                drive.trip(faults.get(pick).copied().unwrap_or(1));
                self.then(now, Next::ResetOn, 8_000..=15_000);
            }
            Next::ResetOn => {
                self.command = Command {
                    run: false,
                    ..self.command
                };
                drive.command(self.command);
                drive.set_reset(true);
                self.then(now, Next::ResetOff, 100..=100);
            }
            Next::ResetOff => {
                drive.set_reset(false);
                self.then(now, Next::Start, 3_000..=8_000);
            }
        }
    }

    /// 20 to 100 %, in steps of a half percent.
    fn reference(&mut self) -> i16 {
        self.random.within(40..=200) as i16 * 50
    }

    fn then(&mut self, now: SimTime, next: Next, milliseconds: std::ops::RangeInclusive<u64>) {
        self.next = next;
        self.at = now + Duration::from_millis(self.random.within(milliseconds));
    }
}

#[cfg(test)]
mod tests {
    use super::super::nx::{NxDrive, NxOptions, status_word};
    use super::*;

    /// Ten minutes of one drive: (status, reference) each second.
    fn ten_minutes(seed: u64) -> Vec<(u16, i16)> {
        let mut drive = NxDrive::new(NxOptions::default(), SimTime::ZERO);
        let mut autopilot = Autopilot::new(seed, SimTime::ZERO);
        (1..600)
            .map(|second| {
                let now = Duration::from_secs(second);
                while autopilot.next_at() <= now {
                    let at = autopilot.next_at();
                    drive.advance(at);
                    autopilot.act(&mut drive, at);
                }
                drive.advance(now);
                (drive.state().status, drive.state().reference)
            })
            .collect()
    }

    #[test]
    fn a_lively_and_reproducible_demo() {
        assert_eq!(ten_minutes(3), ten_minutes(3));
        for seed in 1..=10 {
            let seen = ten_minutes(seed);
            let count = |mask: u16| seen.iter().filter(|(status, _)| status & mask != 0).count();
            assert!(count(status_word::RUN) > 200, "seed {seed} runs most of the time");
            assert!(count(status_word::ZERO_SPEED) > 20, "seed {seed} stands at times");
            assert!(count(status_word::FAULT) < 200, "seed {seed} recovers from faults");
            assert!(
                seen.iter()
                    .map(|s| s.1)
                    .collect::<std::collections::BTreeSet<_>>()
                    .len()
                    > 10
            );
        }
        let faults = (1..=10)
            .filter(|&seed| ten_minutes(seed).iter().any(|s| s.0 & status_word::FAULT != 0))
            .count();
        assert!(faults >= 5, "most drives fault within ten minutes: {faults} of 10");
    }
}
