//! Limits what refusals cost: a client without a right can cause them at any rate.
//!
//! Limits refusals: the first refusal of a kind passes at once; after that one a second passes for each client and
//! stands for all that were refused meanwhile. A limited number of clients is distinguished; all further client
//! names share one place.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Number of clients that are counted separately.
const CLIENTS: usize = 64;
/// Number of kinds of each client whose first refusal is published at once.
const KINDS: usize = 16;
/// Shortest time between two reported refusals of one client, except the first of a kind.
const INTERVAL: Duration = Duration::from_secs(1);
/// Time without a refusal after which a client is forgotten.
const FORGOTTEN: Duration = Duration::from_secs(60);

/// Limits the refusals per client.
#[derive(Debug)]
pub struct RefusalLimit<T> {
    clients: BTreeMap<Arc<str>, Client<T>>,
}

#[derive(Debug)]
struct Client<T> {
    kinds: BTreeSet<(&'static str, String)>,
    passed: Instant,
    refused: Instant,
    /// The last refusal that was delayed, and the number of refusals that it represents.
    waiting: Option<(T, u64)>,
}

impl<T> Default for RefusalLimit<T> {
    fn default() -> RefusalLimit<T> {
        RefusalLimit {
            clients: BTreeMap::new(),
        }
    }
}

impl<T> RefusalLimit<T> {
    /// Notes that `client` was refused something for `reason`, by `drive` if a drive of that name exists. Returns
    /// the refusal to report now, with the number of refusals that it stands for; the rest is returned by a later
    /// call, or by [`RefusalLimit::due`].
    pub fn admit(
        &mut self,
        client: &Arc<str>,
        reason: &'static str,
        drive: Option<&str>,
        item: T,
        now: Instant,
    ) -> Option<(T, u64)> {
        let client = self.client(client, now);
        client.refused = now;
        let is_new = client.kinds.len() < KINDS && client.kinds.insert((reason, drive.unwrap_or_default().to_string()));
        if is_new {
            return Some((item, 1));
        }
        let before = client.waiting.take().map_or(0, |(_, refused)| refused);
        client.waiting = Some((item, before + 1));
        client.due(now)
    }

    fn client(&mut self, name: &Arc<str>, now: Instant) -> &mut Client<T> {
        if !self.clients.contains_key(name) && self.clients.len() >= CLIENTS {
            let idle = |client: &Client<T>| now.saturating_duration_since(client.refused) >= FORGOTTEN;
            self.clients
                .retain(|_, client| client.waiting.is_some() || !idle(client));
        }
        let known = self.clients.contains_key(name) || self.clients.len() < CLIENTS;
        let name = if known { name.clone() } else { Arc::from("") };
        self.clients.entry(name).or_insert_with(|| Client {
            kinds: BTreeSet::new(),
            passed: now,
            refused: now,
            waiting: None,
        })
    }

    /// Refusals that have waited long enough: at most one per client.
    pub fn due(&mut self, now: Instant) -> Vec<(T, u64)> {
        self.clients.values_mut().filter_map(|client| client.due(now)).collect()
    }
}

impl<T> Client<T> {
    fn due(&mut self, now: Instant) -> Option<(T, u64)> {
        if now.saturating_duration_since(self.passed) < INTERVAL {
            return None;
        }
        let due = self.waiting.take()?;
        self.passed = now;
        Some(due)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    fn admit(
        limit: &mut RefusalLimit<u64>,
        client: &str,
        reason: &'static str,
        item: u64,
        now: Instant,
    ) -> Option<(u64, u64)> {
        limit.admit(&client.into(), reason, Some("pump-1"), item, now)
    }

    #[test]
    fn the_first_of_a_kind_at_once_then_one_a_second_with_the_count() {
        let (mut limit, start) = (RefusalLimit::default(), Instant::now());
        assert_eq!(admit(&mut limit, "a", "not_allowed", 0, start), Some((0, 1)));
        let mut passed = Vec::new();
        for n in 1..=10_000 {
            let now = start + SECOND * n / 2500;
            passed.extend(admit(&mut limit, "a", "not_allowed", n.into(), now));
        }
        assert_eq!(passed, [(2500, 2500), (5000, 2500), (7500, 2500), (10_000, 2500)]);
        assert_eq!(
            admit(&mut limit, "a", "bad_value", 1, start + 4 * SECOND),
            Some((1, 1)),
            "another reason"
        );
        let drive = limit.admit(&"a".into(), "bad_value", Some("pump-2"), 2, start + 4 * SECOND);
        assert_eq!(drive, Some((2, 1)), "another drive");
        assert_eq!(
            admit(&mut limit, "b", "bad_value", 3, start + 4 * SECOND),
            Some((3, 1)),
            "another client"
        );
        assert_eq!(admit(&mut limit, "a", "bad_value", 4, start + 4 * SECOND), None);
        assert_eq!(limit.due(start + 4 * SECOND), []);
        assert_eq!(
            limit.due(start + 5 * SECOND),
            [(4, 1)],
            "it is not lost when nothing follows"
        );
        assert_eq!(limit.due(start + 6 * SECOND), []);
    }

    #[test]
    fn names_that_are_invented_share_a_place() {
        let (mut limit, start) = (RefusalLimit::default(), Instant::now());
        let mut counted = 0;
        let mut lines = 0;
        for n in 0..100_000u64 {
            let passed = admit(
                &mut limit,
                &format!("10.0.{}.{}", n / 256, n % 256),
                "not_allowed",
                n,
                start,
            );
            lines += passed.iter().count();
            counted += passed.map_or(0, |(_, count)| count);
        }
        assert!(
            lines <= CLIENTS + 1 && limit.clients.len() <= CLIENTS + 1,
            "{lines} lines"
        );
        let rest = limit.due(start + SECOND);
        assert_eq!(counted + rest.iter().map(|(_, count)| count).sum::<u64>(), 100_000);
        for n in 0..1000u64 {
            limit.admit(&"a".into(), "not_allowed", Some(&n.to_string()), n, start);
        }
        let kinds = limit.clients.values().map(|client| client.kinds.len());
        assert_eq!(kinds.max(), Some(KINDS));
        let later = start + FORGOTTEN;
        limit.due(later);
        assert_eq!(
            admit(&mut limit, "new", "not_allowed", 1, later),
            Some((1, 1)),
            "the others are forgotten"
        );
        assert!(limit.clients.contains_key("new"));
    }
}
