//! Decides which recordings are removed when there are too many. Pure.
//!
//! Recordings that follow one another closely are a storm. The first ones of a storm show its cause and are kept;
//! each later one replaces earlier later ones. Storms get half of the room, so that the next recording always fits.

use std::time::{Duration, SystemTime};

/// Recordings closer than this to the previous one belong to the same storm.
pub const STORM: Duration = Duration::from_secs(60);
/// Recordings of a storm that are kept first.
pub const FIRST_OF_STORM: usize = 8;

/// Counts recordings that follow closely.
#[derive(Debug, Clone, Copy, Default)]
pub struct Storm {
    last: Option<SystemTime>,
    place: usize,
}

impl Storm {
    /// Whether a recording of this time, newer than all before, is among the first of its storm. A single recording
    /// counts as the first of a storm.
    pub fn is_first(&mut self, time: SystemTime) -> bool {
        let close = self
            .last
            .is_some_and(|last| time.duration_since(last).is_ok_and(|gap| gap <= STORM));
        self.place = if close { self.place + 1 } else { 0 };
        self.last = Some(time);
        self.place < FIRST_OF_STORM
    }
}

/// The properties of a recording that decide whether it is kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Kept {
    /// Size of the file.
    pub bytes: u64,
    /// Whether the recording is among the first of its storm.
    pub first: bool,
}

/// Indices of the recordings to remove, given from the oldest to the newest, so that at most `max_bytes` and
/// `max_count` remain. The last one, which was just made, always stays.
pub fn surplus(all: &[Kept], max_bytes: u64, max_count: usize) -> Vec<usize> {
    let mut left: Vec<(usize, Kept)> = all.iter().copied().enumerate().collect();
    let mut gone = Vec::new();
    loop {
        let bytes: u64 = left.iter().map(|(_, kept)| kept.bytes).sum();
        if left.len() <= 1 || bytes <= max_bytes && left.len() <= max_count.max(1) {
            return gone;
        }
        let firsts = || left.iter().filter(|(_, kept)| kept.first);
        let their_bytes: u64 = firsts().map(|(_, kept)| kept.bytes).sum();
        let too_many = firsts().count() > max_count / 2 || their_bytes > max_bytes / 2;
        let older = left.len() - 1;
        let oldest = |wanted: bool| left.iter().take(older).position(|(_, kept)| kept.first == wanted);
        let victim = if too_many {
            oldest(true).or_else(|| oldest(false))
        } else {
            oldest(false).or_else(|| oldest(true))
        };
        let (place, ..) = left.remove(victim.unwrap_or(0));
        gone.push(place);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(second: u64) -> SystemTime {
        SystemTime::UNIX_EPOCH + Duration::from_secs(second)
    }

    /// Times, s, of the recordings that remain after these were made one after the other with 10 bytes each.
    fn left(seconds: impl Iterator<Item = u64>, max_bytes: u64, max_count: usize) -> Vec<u64> {
        let mut storm = Storm::default();
        let mut all: Vec<(u64, Kept)> = Vec::new();
        for second in seconds {
            let first = storm.is_first(at(second));
            all.push((second, Kept { bytes: 10, first }));
            let kept: Vec<Kept> = all.iter().map(|(_, kept)| *kept).collect();
            let mut gone = surplus(&kept, max_bytes, max_count);
            gone.sort_unstable();
            for place in gone.into_iter().rev() {
                all.remove(place);
            }
        }
        all.into_iter().map(|(second, _)| second).collect()
    }

    #[test]
    fn the_first_of_a_storm_stay_and_the_last_rotate() {
        let storm = || (0..1000).map(|n| n * 2);
        let expected: Vec<u64> = (0..8).chain(988..1000).map(|n| n * 2).collect();
        assert_eq!(left(storm(), u64::MAX, 20), expected);
        assert_eq!(left(storm(), 200, usize::MAX), expected);
    }

    #[test]
    fn old_storms_make_room_for_new_ones() {
        // Five storms of 50, a day apart.
        let storms = (0..5).flat_map(|day| (0..50).map(move |n| day * 86_400 + n));
        let all = left(storms, u64::MAX, 40);
        let last: Vec<u64> = all
            .iter()
            .filter(|s| **s >= 4 * 86_400)
            .map(|s| s - 4 * 86_400)
            .collect();
        assert_eq!((all.len(), last.len()), (40, 28));
        assert!(
            last.starts_with(&[0, 1, 2, 3, 4, 5, 6, 7]) && last.ends_with(&[48, 49]),
            "{last:?}"
        );
    }

    #[test]
    fn single_recordings_rotate() {
        let all = left((0..100).map(|n| n * 3600), u64::MAX, 10);
        assert_eq!(all, (90..100).map(|n| n * 3600).collect::<Vec<_>>());
        assert_eq!(left([1].into_iter(), 5, 10), [1], "the newest stays");
    }
}
