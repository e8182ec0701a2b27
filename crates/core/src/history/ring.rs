//! A ring bounded by bytes and by age.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Something with a time that takes memory.
pub(super) trait Timed {
    /// Time of the entry.
    fn at(&self) -> Instant;
    /// Bytes of memory that the entry takes.
    fn size(&self) -> usize;
}

/// The newest entries, oldest first.
#[derive(Debug)]
pub(super) struct Ring<T> {
    entries: VecDeque<T>,
    bytes: usize,
    most_bytes: usize,
    window: Duration,
}

impl<T: Timed> Ring<T> {
    /// A ring of that many bytes, and of entries that are not older than `window`.
    pub(super) fn new(most_bytes: usize, window: Duration) -> Ring<T> {
        Ring {
            entries: VecDeque::new(),
            bytes: 0,
            most_bytes,
            window,
        }
    }

    /// Adds the newest entry; `gone` receives the entries that are removed for it.
    pub(super) fn push(&mut self, entry: T, mut gone: impl FnMut(T)) {
        let now = entry.at();
        self.bytes += entry.size();
        self.entries.push_back(entry);
        while let Some(oldest) = self.entries.front() {
            let old = now.saturating_duration_since(oldest.at()) > self.window;
            if !old && (self.bytes <= self.most_bytes || self.entries.len() == 1) {
                break;
            }
            let Some(oldest) = self.entries.pop_front() else { break };
            self.bytes -= oldest.size();
            gone(oldest);
        }
    }

    /// Limits the ring to this number of bytes from the next entry on.
    pub(super) fn limit(&mut self, most_bytes: usize) {
        self.most_bytes = most_bytes;
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = &T> {
        self.entries.iter()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Entry(Instant, usize);

    impl Timed for Entry {
        fn at(&self) -> Instant {
            self.0
        }
        fn size(&self) -> usize {
            self.1
        }
    }

    #[test]
    fn what_is_old_or_too_much_goes_oldest_first() {
        let start = Instant::now();
        let mut ring = Ring::new(100, Duration::from_secs(10));
        let mut gone = 0;
        for second in 0..20 {
            ring.push(Entry(start + Duration::from_secs(second), 5), |_| gone += 1);
        }
        assert_eq!((ring.iter().count(), gone), (11, 9), "by age");
        ring.push(Entry(start + Duration::from_secs(20), 95), |_| gone += 1);
        assert_eq!((ring.iter().count(), ring.bytes), (2, 100), "by bytes");
        ring.push(Entry(start + Duration::from_secs(20), 500), |_| gone += 1);
        assert_eq!((ring.iter().count(), ring.bytes), (1, 500), "the newest always stays");
    }
}
