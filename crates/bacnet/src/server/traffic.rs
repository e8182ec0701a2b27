//! Limits of sending: at most eight times the octets received from an address may be sent to it, and a number of
//! broadcasts per second.

use std::collections::{HashMap, HashSet, VecDeque};
use std::net::{Ipv4Addr, SocketAddrV4};
use std::time::{Duration, Instant};

/// Octets that may be sent to an address within a second for each octet received from it.
const FACTOR: u64 = 8;
/// Octets that may be sent to an address within a second in addition to the factor.
const GRANT: u64 = 16 * 1024;
/// Octets that may wait for an address, or for a broadcast.
const WAITING: usize = 64 * 1024;
/// Octets that may wait for all addresses together.
const WAITING_IN_ALL: usize = 1024 * 1024;
/// Maximum number of broadcasts sent within a second.
const BROADCASTS: u64 = 100;
/// Maximum number of addresses that are tracked at a time.
const ADDRESSES: usize = 1024;
/// Datagrams that may wait for the system: more than a notification of every subscription.
const READY: usize = 8192;
/// Step in which a second of traffic is counted.
const STEP: Duration = Duration::from_millis(100);
const STEPS: usize = 11;

/// Destination of a datagram.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum To {
    /// Destination: this host.
    Host(SocketAddrV4),
    /// Destination: all hosts of the network.
    Broadcast,
}

/// Sums of traffic over the last second.
#[derive(Debug, Clone, Default)]
struct Window {
    steps: [u32; STEPS],
    /// The step of the second that was last counted.
    last: u64,
}

impl Window {
    fn turn(&mut self, step: u64) {
        let passed = step.saturating_sub(self.last).min(STEPS as u64);
        for ahead in 1..=passed {
            if let Some(count) = self.steps.get_mut(((self.last + ahead) % STEPS as u64) as usize) {
                *count = 0;
            }
        }
        if passed == STEPS as u64 {
            self.steps = [0; STEPS];
        }
        self.last = self.last.max(step);
    }

    fn add(&mut self, step: u64, count: u32) {
        self.turn(step);
        let place = (self.last % STEPS as u64) as usize;
        if let Some(sum) = self.steps.get_mut(place) {
            *sum = sum.saturating_add(count);
        }
    }

    fn sum(&mut self, step: u64) -> u64 {
        self.turn(step);
        self.steps.iter().map(|count| u64::from(*count)).sum()
    }
}

#[derive(Debug, Default)]
struct AddressRecord {
    came: Window,
    left: Window,
    waiting: VecDeque<(SocketAddrV4, Vec<u8>)>,
    octets: usize,
}

impl AddressRecord {
    fn may(&mut self, len: usize, step: u64) -> bool {
        let budget = self.came.sum(step) * FACTOR + GRANT;
        self.left.sum(step) + len as u64 <= budget
    }
}

/// Datagrams that may be sent.
#[derive(Debug, Default)]
struct Ready(VecDeque<(To, Vec<u8>)>);

impl Ready {
    /// Adds a datagram; returns how many were dropped for it, if the system accepts none any more.
    fn put(&mut self, datagram: (To, Vec<u8>)) -> u64 {
        if self.0.len() >= READY {
            return 1;
        }
        self.0.push_back(datagram);
        0
    }
}

/// Octets that wait until they may be sent.
#[derive(Debug)]
pub(super) struct Traffic {
    begun: Instant,
    known: HashMap<Ipv4Addr, AddressRecord>,
    /// Octets that wait for addresses.
    held: usize,
    broadcasts: VecDeque<Vec<u8>>,
    waiting: HashSet<Vec<u8>>,
    octets: usize,
    sent: Window,
    ready: Ready,
    /// Datagrams dropped for lack of room.
    pub(super) dropped: u64,
}

impl Traffic {
    pub(super) fn new(now: Instant) -> Traffic {
        Traffic {
            begun: now,
            known: HashMap::new(),
            held: 0,
            broadcasts: VecDeque::new(),
            waiting: HashSet::new(),
            octets: 0,
            sent: Window::default(),
            ready: Ready::default(),
            dropped: 0,
        }
    }

    fn step(&self, now: Instant) -> u64 {
        let steps = now.saturating_duration_since(self.begun).as_millis() / STEP.as_millis();
        u64::try_from(steps).unwrap_or(u64::MAX)
    }

    /// Counts octets received from an address, which raise the limit for sending to it.
    pub(super) fn received(&mut self, from: Ipv4Addr, octets: usize, now: Instant) {
        let step = self.step(now);
        if let Some(known) = self.known(from, step) {
            known.came.add(step, u32::try_from(octets).unwrap_or(u32::MAX));
        }
    }

    /// The state of this address. If the table is full, the address that was idle for longest is dropped.
    fn known(&mut self, address: Ipv4Addr, step: u64) -> Option<&mut AddressRecord> {
        if !self.known.contains_key(&address) {
            if self.known.len() >= ADDRESSES {
                let quiet = |known: &AddressRecord| known.came.last.max(known.left.last);
                let idle = self
                    .known
                    .iter()
                    .filter(|(_, known)| known.waiting.is_empty() && quiet(known) + (STEPS as u64) < step);
                let oldest = idle
                    .min_by_key(|(_, known)| quiet(known))
                    .map(|(address, _)| *address)?;
                self.known.remove(&oldest);
            }
            self.known.insert(address, AddressRecord::default());
        }
        self.known.get_mut(&address)
    }

    /// Whether anything more to that address finds room.
    pub(super) fn has_room(&self, to: To) -> bool {
        match to {
            To::Broadcast => self.octets < WAITING,
            To::Host(host) => self.known.get(host.ip()).is_none_or(|known| known.octets < WAITING),
        }
    }

    /// Sends an answer at once or later, or drops it.
    pub(super) fn answer(&mut self, to: SocketAddrV4, bytes: Vec<u8>, now: Instant) {
        let (step, held) = (self.step(now), self.held);
        let len = bytes.len();
        let Some(known) = self.known(*to.ip(), step) else {
            self.dropped += 1;
            return;
        };
        if known.waiting.is_empty() && known.may(len, step) {
            known.left.add(step, u32::try_from(len).unwrap_or(u32::MAX));
            self.dropped += self.ready.put((To::Host(to), bytes));
        } else if known.octets + len <= WAITING && held + len <= WAITING_IN_ALL {
            known.octets += len;
            known.waiting.push_back((to, bytes));
            self.held += len;
        } else {
            self.dropped += 1;
        }
    }

    /// Sends data that the limits do not count: a notification, or a request of our own.
    pub(super) fn exempt(&mut self, to: SocketAddrV4, bytes: Vec<u8>) {
        self.dropped += self.ready.put((To::Host(to), bytes));
    }

    /// Sends a broadcast, at once or later. A broadcast that already waits is not added a second time.
    pub(super) fn broadcast(&mut self, bytes: Vec<u8>, now: Instant) {
        let step = self.step(now);
        if self.broadcasts.is_empty() && self.sent.sum(step) < BROADCASTS {
            self.sent.add(step, 1);
            self.dropped += self.ready.put((To::Broadcast, bytes));
        } else if self.waiting.contains(&bytes) {
        } else if self.octets + bytes.len() <= WAITING {
            self.octets += bytes.len();
            self.waiting.insert(bytes.clone());
            self.broadcasts.push_back(bytes);
        } else {
            self.dropped += 1;
        }
    }

    /// Sends the held answers that may be sent now.
    pub(super) fn poll(&mut self, now: Instant) {
        let step = self.step(now);
        while self.sent.sum(step) < BROADCASTS
            && let Some(bytes) = self.broadcasts.pop_front()
        {
            self.sent.add(step, 1);
            self.octets -= bytes.len();
            self.waiting.remove(&bytes);
            self.dropped += self.ready.put((To::Broadcast, bytes));
        }
        for known in self.known.values_mut() {
            while let Some((_, bytes)) = known.waiting.front()
                && let len = bytes.len()
                && known.may(len, step)
                && let Some((to, bytes)) = known.waiting.pop_front()
            {
                known.left.add(step, u32::try_from(len).unwrap_or(u32::MAX));
                known.octets -= len;
                self.held -= len;
                self.dropped += self.ready.put((To::Host(to), bytes));
            }
        }
    }

    /// The next datagram to send.
    pub(super) fn next(&mut self) -> Option<(To, Vec<u8>)> {
        self.ready.0.pop_front()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn host(last: u8) -> SocketAddrV4 {
        SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, last), 47808)
    }

    fn octets(traffic: &mut Traffic) -> usize {
        std::iter::from_fn(|| traffic.next())
            .map(|(_, bytes)| bytes.len())
            .sum()
    }

    #[test]
    fn an_address_gets_eight_times_what_it_sent_and_16_kb() {
        let start = Instant::now();
        let mut traffic = Traffic::new(start);
        traffic.received(*host(1).ip(), 1000, start);
        (0..1000).for_each(|_| traffic.answer(host(1), vec![0; 100], start));
        let first = octets(&mut traffic);
        assert_eq!(first, (16 * 1024 + 8000) / 100 * 100);
        assert!(!traffic.has_room(To::Host(host(1))) || traffic.dropped > 0);
        let mut left = vec![(0, first)];
        for ms in (50..10_000).step_by(50) {
            traffic.poll(start + Duration::from_millis(ms));
            left.push((ms, octets(&mut traffic)));
        }
        for (ms, _) in &left {
            let second = left
                .iter()
                .filter(|(at, _)| (*ms..ms + 1000).contains(at))
                .map(|(_, n)| n)
                .sum::<usize>();
            assert!(second <= 16 * 1024 + 8000, "{second} from {ms} ms on");
        }
        let all: usize = left.iter().map(|(_, n)| n).sum();
        assert_eq!(all + traffic.dropped as usize * 100, 100_000);
        assert!(all > first + 60_000);
    }

    #[test]
    fn broadcasts_are_a_hundred_a_second_and_each_waits_once() {
        let start = Instant::now();
        let mut traffic = Traffic::new(start);
        for n in 0..150_u32 {
            traffic.broadcast(n.to_be_bytes().to_vec(), start);
        }
        (100..150_u32).for_each(|n| traffic.broadcast(n.to_be_bytes().to_vec(), start));
        assert_eq!(octets(&mut traffic), 400);
        traffic.poll(start + Duration::from_millis(900));
        assert_eq!(octets(&mut traffic), 0);
        traffic.poll(start + Duration::from_millis(1200));
        assert_eq!(octets(&mut traffic), 200, "those that waited, once");
        assert_eq!(traffic.dropped, 0);
    }

    #[test]
    fn what_waits_is_bounded_in_all() {
        let start = Instant::now();
        let mut traffic = Traffic::new(start);
        for n in 0..100_u8 {
            (0..100).for_each(|_| traffic.answer(host(n), vec![0; 1000], start));
        }
        assert!(
            traffic.held <= WAITING_IN_ALL && traffic.held > WAITING_IN_ALL - 1000,
            "{}",
            traffic.held
        );
        for second in 1..200 {
            traffic.poll(start + Duration::from_millis(1200 * second));
        }
        assert_eq!(traffic.held, 0);
    }

    #[test]
    fn what_the_system_does_not_take_is_bounded() {
        let mut traffic = Traffic::new(Instant::now());
        for n in 0..10_000_u16 {
            traffic.exempt(host(1), n.to_be_bytes().to_vec());
        }
        assert_eq!(
            (octets(&mut traffic), traffic.dropped),
            (2 * READY, 10_000 - READY as u64)
        );
    }

    #[test]
    fn addresses_are_bounded() {
        let start = Instant::now();
        let mut traffic = Traffic::new(start);
        for n in 0..5000_u32 {
            let address = SocketAddrV4::new(Ipv4Addr::from(n), 1);
            traffic.received(*address.ip(), 10, start);
            traffic.answer(address, vec![0; 10], start);
        }
        assert_eq!(traffic.known.len(), ADDRESSES);
        assert_eq!(traffic.dropped, 5000 - ADDRESSES as u64);
        let later = start + Duration::from_secs(3);
        traffic.received(*host(9).ip(), 10, later);
        assert!(traffic.known.contains_key(host(9).ip()));
        assert_eq!(traffic.known.len(), ADDRESSES);
    }
}
