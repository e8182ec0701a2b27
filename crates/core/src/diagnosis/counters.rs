//! The kinds of counters: in steps of the last minute, under two conditions, by the phase of the mains. All of a fixed size.

use std::f32::consts::TAU;
use std::time::{Duration, Instant};

/// Number of steps that are remembered: one minute.
pub const STEPS: usize = 12;
/// Part of the counters without steps that is left after each step: half in two minutes.
pub(super) const FADE: f32 = 0.97;
/// A state that is older than this says nothing about the present state of the drives.
pub(super) const LONGEST_AGE: Duration = Duration::from_secs(10);
/// The latency timer of usual USB adapters, ms.
pub const LATENCY: usize = 16;
/// Frequencies of the mains, Hz.
pub const MAINS: [f32; 2] = [50.0, 60.0];
/// Longest time for which the phase of the mains is kept; their frequency differs by some hundredths of a Hz.
const IN_PHASE: Duration = Duration::from_secs(3);

/// Counters for each step of the last minute.
#[derive(Debug, Clone)]
pub(super) struct Window<const N: usize> {
    pub(super) steps: [[u16; N]; STEPS],
    now: usize,
}

impl<const N: usize> Window<N> {
    pub(super) fn new() -> Window<N> {
        Window {
            steps: [[0; N]; STEPS],
            now: 0,
        }
    }

    pub(super) fn add(&mut self, place: usize, count: u16) {
        if let Some(counter) = self.steps.get_mut(self.now).and_then(|step| step.get_mut(place)) {
            *counter = counter.saturating_add(count);
        }
    }

    /// Keeps the greatest count of the step.
    pub(super) fn most(&mut self, place: usize, count: u16) {
        if let Some(counter) = self.steps.get_mut(self.now).and_then(|step| step.get_mut(place)) {
            *counter = count.max(*counter);
        }
    }

    pub(super) fn roll(&mut self) {
        self.now = (self.now + 1) % STEPS;
        if let Some(step) = self.steps.get_mut(self.now) {
            *step = [0; N];
        }
    }

    pub(super) fn each(&self, place: usize) -> impl Iterator<Item = u16> {
        self.steps
            .iter()
            .map(move |step| step.get(place).copied().unwrap_or_default())
    }

    pub(super) fn sum(&self, place: usize) -> u32 {
        self.each(place).map(u32::from).sum()
    }
}

/// Damaged and valid replies of a drive by their phase in the mains period, measured from the drive's last damaged reply.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct InPhase {
    last: Option<Instant>,
    /// For each mains frequency: number of damaged replies and sum of the cosines of their phases, then both for
    /// the valid replies.
    pub(super) sums: [[f32; 4]; MAINS.len()],
}

impl InPhase {
    pub(super) fn add(&mut self, at: Instant, length: Duration, damaged: bool) {
        if let Some(last) = self.last {
            let since = at.saturating_duration_since(last);
            if since > IN_PHASE {
                self.last = None;
            } else {
                for (sums, hertz) in self.sums.iter_mut().zip(MAINS) {
                    let [bad, bad_cosines, good, good_cosines] = sums;
                    // The mean of the cosine over the whole length.
                    let half = TAU / 2.0 * hertz * length.as_secs_f32();
                    let mean = if half > 0.0 { half.sin() / half } else { 1.0 };
                    let cosine = mean * (TAU * (hertz * since.as_secs_f32()).fract()).cos();
                    let (count, sum) = if damaged {
                        (bad, bad_cosines)
                    } else {
                        (good, good_cosines)
                    };
                    *count += 1.0;
                    *sum += cosine;
                }
            }
        }
        if damaged {
            self.last = Some(at);
        }
    }
}

/// Requests and failures under two conditions, for comparison.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Contrast {
    /// Transactions under each condition.
    pub transactions: [f32; 2],
    /// Transactions that failed under each condition.
    pub failed: [f32; 2],
}

impl Contrast {
    pub(super) fn add(&mut self, condition: usize, asked: f32, failed: f32) {
        if let (Some(a), Some(f)) = (self.transactions.get_mut(condition), self.failed.get_mut(condition)) {
            *a += asked;
            *f += failed;
        }
    }

    pub(super) fn fade(&mut self) {
        self.transactions
            .iter_mut()
            .chain(&mut self.failed)
            .for_each(|count| *count *= FADE);
    }
}

/// A contrast between the time when a drive runs and the time when it does not. Figures from shortly before a
/// change of the running state are left out: the state is read some time after it changes, and on a slow line some
/// seconds.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Running {
    pub(super) runs: bool,
    /// Number of transactions and failures in the present slot and in the previous one.
    slots: [(f32, f32); 2],
    slot_ends: Option<Instant>,
    /// Recent maximum of the age of the running state before it was read again.
    pub(super) age: Duration,
    pub(super) contrast: Contrast,
}

/// Minimum time for which a change of the running state may stay unknown.
const UNKNOWN: Duration = Duration::from_secs(1);

impl Running {
    pub(super) fn change(&mut self, runs: bool) {
        if runs != self.runs {
            (self.runs, self.slots, self.slot_ends) = (runs, Default::default(), None);
        }
    }

    pub(super) fn add(&mut self, asked: f32, failed: f32, at: Instant) {
        let unknown = self.age.max(UNKNOWN);
        let ends = *self.slot_ends.get_or_insert(at + unknown);
        let [now, before] = &mut self.slots;
        if at >= ends {
            self.contrast.add(usize::from(self.runs), before.0, before.1);
            (*before, *now) = (*now, (0.0, 0.0));
            self.slot_ends = Some(at + unknown);
        }
        now.0 += asked;
        now.1 += failed;
    }
}

/// Length of the mean vector of the milliseconds on a circle. Each step is evaluated separately because clocks drift apart.
pub(super) fn lock(window: &Window<LATENCY>) -> (f64, u32) {
    let (mut length, mut all) = (0.0, 0);
    for step in &window.steps {
        let (mut x, mut y, mut count) = (0.0, 0.0, 0);
        for (place, number) in step.iter().enumerate() {
            let angle = std::f64::consts::TAU * place as f64 / LATENCY as f64;
            x += f64::from(*number) * angle.cos();
            y += f64::from(*number) * angle.sin();
            count += u32::from(*number);
        }
        length += x.hypot(y);
        all += count;
    }
    (if all > 0 { length / f64::from(all) } else { 0.0 }, all)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_older_than_a_minute_is_forgotten() {
        let mut window = Window::<1>::new();
        window.add(0, u16::MAX);
        window.add(0, 1);
        for _ in 0..STEPS - 1 {
            window.roll();
            assert_eq!(window.sum(0), u32::from(u16::MAX));
        }
        window.roll();
        assert_eq!(window.sum(0), 0);
    }
}
