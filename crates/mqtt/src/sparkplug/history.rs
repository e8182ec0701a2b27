//! Values of one device while there is no receiver: keeps the newest, in memory. Time is an argument.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use super::metric::Sample;

/// Collects changes while the host is away.
#[derive(Debug, Default)]
pub(super) struct Recorder {
    /// Index and value of each metric, the oldest first.
    entries: VecDeque<(usize, Sample)>,
    at: Option<Instant>,
}

impl Recorder {
    /// Records the values that differ from `before`, at most once in `least`; keeps `most` values. Returns whether
    /// anything was recorded, and how many older values were dropped for it.
    pub(super) fn record(
        &mut self,
        before: &[Option<Sample>],
        now_is: &[Sample],
        least: Duration,
        most: usize,
        now: Instant,
    ) -> Option<u64> {
        let early = |at: Instant| now.saturating_duration_since(at) < least;
        if self.at.is_some_and(early) {
            return None;
        }
        let changed = |(place, sample): (usize, &Sample)| {
            let same = before
                .get(place)
                .and_then(Option::as_ref)
                .is_some_and(|b| b.is_same(sample));
            (!same).then(|| (place, sample.clone()))
        };
        let held = self.entries.len();
        self.entries.extend(now_is.iter().enumerate().filter_map(changed));
        if self.entries.len() == held {
            return None;
        }
        self.at = Some(now);
        let surplus = self.entries.len().saturating_sub(most);
        self.entries.drain(..surplus);
        Some(surplus as u64)
    }

    /// Removes and returns the oldest entries, at most `most`.
    pub(super) fn take(&mut self, most: usize) -> Vec<(usize, Sample)> {
        let count = self.entries.len().min(most);
        self.entries.drain(..count).collect()
    }

    pub(super) fn len(&self) -> usize {
        self.entries.len()
    }

    pub(super) fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::super::metric::Datum;
    use super::*;
    use drivegate_model::drive::Quality;

    #[test]
    fn the_newest_changes_are_kept() {
        let start = Instant::now();
        let mut recorder = Recorder::default();
        let sample = |number| Sample {
            value: Some(Datum::Number(number)),
            quality: Quality::Good,
            time: number as u64,
        };
        let least = Duration::from_millis(50);
        let mut before = vec![None];
        let mut outcomes = Vec::new();
        for (ms, number) in [(0, 1.0), (10, 2.0), (50, 2.0), (100, 2.0), (150, 3.0), (200, 4.0)] {
            let now = [sample(number)];
            let recorded = recorder.record(&before, &now, least, 3, start + Duration::from_millis(ms));
            if recorded.is_some() {
                before = vec![Some(now[0].clone())];
            }
            outcomes.push(recorded);
        }
        assert_eq!(outcomes, [Some(0), None, Some(0), None, Some(0), Some(1)]);
        assert_eq!(recorder.take(2), [(0, sample(2.0)), (0, sample(3.0))]);
        assert_eq!((recorder.len(), recorder.take(9)), (1, vec![(0, sample(4.0))]));
        assert!(recorder.is_empty());
    }
}
