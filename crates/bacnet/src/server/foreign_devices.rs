//! The foreign devices that this host serves as a BBMD (annex J.5.2). Pure: time is an argument.

use std::net::SocketAddrV4;
use std::time::{Duration, Instant};

/// Time after its registered time for which an entry remains.
const GRACE: Duration = Duration::from_secs(30);

/// An entry for a registered foreign device.
#[derive(Debug, Clone, Copy)]
struct Entry {
    host: SocketAddrV4,
    /// Time for which the device registered, s.
    time: u16,
    ends: Instant,
}

/// The table of foreign devices.
#[derive(Debug, Default)]
pub(super) struct ForeignDevices {
    /// Maximum number of entries; with 0, no device can register.
    most: usize,
    entries: Vec<Entry>,
}

impl ForeignDevices {
    pub(super) fn new(most: usize) -> ForeignDevices {
        ForeignDevices {
            most,
            entries: Vec::new(),
        }
    }

    /// Registers or renews a device; returns false if no room is left.
    pub(super) fn register(&mut self, host: SocketAddrV4, time: u16, now: Instant) -> bool {
        self.forget(now);
        let ends = now + Duration::from_secs(time.into()) + GRACE;
        let entry = Entry { host, time, ends };
        if let Some(known) = self.entries.iter_mut().find(|known| known.host == host) {
            *known = entry;
            return true;
        }
        let has_room = self.entries.len() < self.most;
        if has_room {
            self.entries.push(entry);
        }
        has_room
    }

    /// Removes a device; returns whether it was registered.
    pub(super) fn delete(&mut self, host: SocketAddrV4, now: Instant) -> bool {
        self.forget(now);
        let before = self.entries.len();
        self.entries.retain(|entry| entry.host != host);
        self.entries.len() < before
    }

    /// Whether a foreign device is registered.
    pub(super) fn has(&mut self, host: SocketAddrV4, now: Instant) -> bool {
        self.hosts(now).any(|known| known == host)
    }

    pub(super) fn hosts(&mut self, now: Instant) -> impl Iterator<Item = SocketAddrV4> {
        self.forget(now);
        self.entries.iter().map(|entry| entry.host)
    }

    /// Each foreign device with its registered time and the remaining time, in seconds.
    pub(super) fn all(&mut self, now: Instant) -> impl Iterator<Item = (SocketAddrV4, u16, u16)> {
        self.forget(now);
        self.entries.iter().map(move |entry| {
            let left = entry.ends.saturating_duration_since(now).as_secs();
            (entry.host, entry.time, u16::try_from(left).unwrap_or(u16::MAX))
        })
    }

    fn forget(&mut self, now: Instant) {
        self.entries.retain(|entry| entry.ends > now);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn entries_end_half_a_minute_after_their_time_and_are_bounded() {
        let start = Instant::now();
        let at = |s| start + Duration::from_secs(s);
        let host = |last: u16| SocketAddrV4::new([10, 0, 0, 1].into(), last);
        let mut table = ForeignDevices::new(2);
        assert!(table.register(host(1), 60, start) && table.register(host(2), 10, start));
        assert!(!table.register(host(3), 60, start), "no room");
        assert!(table.register(host(1), 60, at(30)), "renewed");
        assert_eq!(
            table.all(at(39)).collect::<Vec<_>>(),
            [(host(1), 60, 81), (host(2), 10, 1)]
        );
        assert!(!table.has(host(2), at(40)) && table.has(host(1), at(119)));
        assert!(table.register(host(3), 60, at(40)));
        assert!(table.delete(host(3), at(41)) && !table.delete(host(3), at(41)));
        assert!(!ForeignDevices::new(0).register(host(1), 60, start));
    }
}
