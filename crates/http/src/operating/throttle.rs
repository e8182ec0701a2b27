//! How often passwords may be tried. Pure: time is an argument.
//!
//! Limits login attempts. An attacker must not be able to lock an operator out, so attempts of one client never
//! count against another: each address has a separate count, and a browser that has logged in as a user before has
//! a separate one for that user. Failures counted for a user over all addresses delay only addresses that failed
//! before themselves.

use std::collections::HashMap;
use std::hash::Hash;
use std::net::{IpAddr, Ipv6Addr};
use std::time::{Duration, Instant};

/// Failures after which an address, or a known browser, has to wait between two attempts.
const FREE: u32 = 5;
/// Failures for one user after which addresses that failed before have to wait.
const FREE_OF_USER: u32 = 20;
/// First and longest pause after a failed login; each failure doubles the pause.
const PAUSE: (Duration, Duration) = (Duration::from_secs(2), Duration::from_secs(60));
/// Time without a failed login after which earlier failures are forgotten.
const FORGOTTEN: Duration = Duration::from_secs(15 * 60);
/// Maximum number of addresses and browsers, and of users, that are counted separately; beyond it the oldest is forgotten.
const MOST_SOURCES: usize = 4096;

/// The source of a login attempt.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Source {
    /// An address; for IPv6 its network of 64 bits, in which a client may use any address.
    Address(IpAddr),
    /// A browser that has logged in as this user before.
    Known(u64),
}

impl Source {
    pub(super) fn of(address: IpAddr) -> Source {
        Source::Address(match address {
            IpAddr::V4(_) => address,
            IpAddr::V6(address) => Ipv6Addr::from_bits(address.to_bits() & !u128::from(u64::MAX)).into(),
        })
    }
}

#[derive(Debug, Clone, Copy)]
struct Failures {
    count: u32,
    last: Instant,
}

/// Recent attempts to log in.
#[derive(Debug, Default)]
pub(super) struct Throttle {
    sources: HashMap<Source, Failures>,
    /// Failures by a hash of the user name, for existing users and others alike.
    users: HashMap<u64, Failures>,
}

impl Throttle {
    /// Starts an attempt to log in as `user`. The attempt counts as failed until [`Throttle::succeeded`], so that
    /// simultaneous attempts are limited too. Returns the number of failures of its source: sources with fewer are
    /// served first.
    ///
    /// # Errors
    /// If the client must wait first: contains the time to wait. Such an attempt is not counted.
    pub(super) fn begin(&mut self, source: Source, user: u64, now: Instant) -> Result<u32, Duration> {
        let failures = current(&self.sources, &source, now);
        let of_user = current(&self.users, &user, now);
        let wait = wait(failures, FREE, now).max(match (source, failures) {
            (Source::Address(_), Some(_)) => wait(of_user, FREE_OF_USER, now),
            _ => Duration::ZERO,
        });
        if !wait.is_zero() {
            return Err(wait);
        }
        count(&mut self.sources, source, now);
        if matches!(source, Source::Address(_)) {
            count(&mut self.users, user, now);
        }
        Ok(failures.map_or(0, |failures| failures.count))
    }

    /// Notes that the attempt was not a guess: the password was right, or there was no time to verify it.
    pub(super) fn withdraw(&mut self, source: Source, user: u64) {
        uncount(&mut self.sources, source);
        if matches!(source, Source::Address(_)) {
            uncount(&mut self.users, user);
        }
    }

    /// Forgets the failures of this source, because the password was right.
    pub(super) fn succeeded(&mut self, source: Source, user: u64) {
        self.withdraw(source, user);
        self.sources.remove(&source);
    }
}

fn current<K: Eq + Hash>(all: &HashMap<K, Failures>, key: &K, now: Instant) -> Option<Failures> {
    let failures = all.get(key).copied();
    failures.filter(|failures| now.saturating_duration_since(failures.last) < FORGOTTEN)
}

/// Time until the next attempt, when `free` failures cost nothing.
fn wait(failures: Option<Failures>, free: u32, now: Instant) -> Duration {
    let Some(Failures { count, last }) = failures.filter(|failures| failures.count >= free) else {
        return Duration::ZERO;
    };
    let (first, longest) = PAUSE;
    let pause = first.saturating_mul(2_u32.saturating_pow(count - free)).min(longest);
    (last + pause).saturating_duration_since(now)
}

fn count<K: Eq + Hash + Copy>(all: &mut HashMap<K, Failures>, key: K, now: Instant) {
    let count = current(all, &key, now).map_or(0, |failures| failures.count);
    if all.len() >= MOST_SOURCES && !all.contains_key(&key) {
        let oldest = all
            .iter()
            .min_by_key(|(_, failures)| failures.last)
            .map(|(key, _)| *key);
        oldest.map(|oldest| all.remove(&oldest));
    }
    all.insert(
        key,
        Failures {
            count: count.saturating_add(1),
            last: now,
        },
    );
}

fn uncount<K: Eq + Hash>(all: &mut HashMap<K, Failures>, key: K) {
    if let Some(failures) = all.get_mut(&key) {
        failures.count = failures.count.saturating_sub(1);
        if failures.count == 0 {
            all.remove(&key);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALICE: u64 = 1;

    fn address(last: u8) -> Source {
        Source::of([192, 0, 2, last].into())
    }

    #[test]
    fn an_address_that_fails_waits_longer_and_longer() {
        let (mut throttle, mut now) = (Throttle::default(), Instant::now());
        for failures in 0..FREE {
            assert_eq!(throttle.begin(address(1), ALICE, now), Ok(failures));
        }
        for seconds in [2, 4, 8, 16, 32, 60, 60] {
            let pause = Duration::from_secs(seconds);
            assert_eq!(throttle.begin(address(1), ALICE, now), Err(pause));
            now += pause - Duration::from_millis(1);
            assert_eq!(
                throttle.begin(address(1), 2, now),
                Err(Duration::from_millis(1)),
                "whoever the user"
            );
            now += Duration::from_millis(1);
            assert!(throttle.begin(address(1), ALICE, now).is_ok());
        }
        assert_eq!(throttle.begin(address(1), ALICE, now + FORGOTTEN), Ok(0));
    }

    #[test]
    fn an_attacker_does_not_lock_the_operator_out() {
        let (mut throttle, mut now) = (Throttle::default(), Instant::now());
        let mut tried = 0;
        for attempt in 0..100_000_u32 {
            now += Duration::from_millis(1);
            tried += u32::from(throttle.begin(address((attempt % 10) as u8), ALICE, now).is_ok());
        }
        assert!(tried < 40, "{tried} guesses in 100 s from ten addresses");
        assert_eq!(throttle.begin(address(200), ALICE, now), Ok(0), "another address");
        assert_eq!(throttle.begin(Source::Known(7), ALICE, now), Ok(0), "a known browser");
        // The attacker has the same address, because both use one proxy: the known browser is admitted.
        assert!(throttle.begin(address(3), ALICE, now).is_err());
        throttle.succeeded(Source::Known(7), ALICE);
        assert_eq!(throttle.begin(Source::Known(7), ALICE, now), Ok(0));
    }

    #[test]
    fn a_success_clears_the_record() {
        let (mut throttle, now) = (Throttle::default(), Instant::now());
        for _ in 0..3 {
            assert!(throttle.begin(address(1), ALICE, now).is_ok());
        }
        throttle.succeeded(address(1), ALICE);
        assert_eq!(throttle.begin(address(1), ALICE, now), Ok(0));
        throttle.withdraw(address(1), ALICE);
        assert_eq!(
            throttle.begin(address(1), ALICE, now),
            Ok(0),
            "there was no time to look at it"
        );
    }

    #[test]
    fn an_ipv6_client_is_its_network_and_the_table_is_bounded() {
        let source = |text: &str| Source::of(text.parse().unwrap());
        assert_eq!(source("2001:db8::1"), source("2001:db8::ffff:1"));
        assert_ne!(source("2001:db8::1"), source("2001:db8:0:1::1"));
        let (mut throttle, now) = (Throttle::default(), Instant::now());
        for number in 0..2 * MOST_SOURCES as u32 {
            let address = Source::Address(IpAddr::V4(number.into()));
            let begun = throttle.begin(address, number.into(), now + Duration::from_millis(number.into()));
            assert_eq!(begun, Ok(0));
        }
        assert_eq!(
            (throttle.sources.len(), throttle.users.len()),
            (MOST_SOURCES, MOST_SOURCES)
        );
    }
}
