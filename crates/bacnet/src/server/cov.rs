//! Subscriptions to changes of value (clauses 13.1, 13.14, 13.15): which client is notified of which object, and
//! when it is notified again. The server supplies the values. This module only records the subscriptions; their
//! number is bounded.

use std::collections::{BTreeMap, HashMap};
use std::net::Ipv4Addr;
use std::time::{Duration, Instant};

use crate::services::PropertyRef;
use crate::types::{Address, ObjectId};

/// Subscriptions in all, of one host, and of one host to one device.
const MOST_SUBSCRIPTIONS: usize = 4096;
const MOST_OF_HOST: usize = 2048;
const MOST_OF_DEVICE: usize = 128;
/// Time for which an acknowledgement is awaited, and the number of tries.
const WAIT: Duration = Duration::from_secs(3);
const TRIES: u8 = 3;
/// Undelivered notifications in a row that end a subscription without a lifetime.
const LOST: u8 = 3;

/// The key of a subscription: subscriber and object.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Key {
    pub(super) subscriber: Address,
    pub(super) process: u32,
    pub(super) object: ObjectId,
    /// The single subscribed property; `None`: value and status flags of the object.
    pub(super) property: Option<PropertyRef>,
}

/// The values that were last reported to a subscriber.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct Reported {
    /// The number, where the value is one.
    pub(super) number: Option<f64>,
    /// All parts of the notification except the value, as encoded on the wire.
    pub(super) rest: Vec<u8>,
}

impl Reported {
    /// Whether the values differ enough from those last sent to a client to send a notification.
    fn differs(&self, now: &Reported, increment: f64) -> bool {
        let moved = match (self.number, now.number) {
            (Some(before), Some(now)) => {
                let change = (now - before).abs();
                change > 0.0 && change >= increment
            }
            (before, now) => before.is_some() != now.is_some(),
        };
        moved || self.rest != now.rest
    }
}

/// A subscription to changes of an object.
#[derive(Debug)]
pub(super) struct Subscription {
    pub(super) key: Key,
    pub(super) confirmed: bool,
    /// The increment that the client set for itself.
    pub(super) increment: Option<f32>,
    until: Option<Instant>,
    told: Option<Reported>,
    /// Sequence number since which the subscription has been waiting to notify.
    due: Option<u64>,
    lost: u8,
}

impl Subscription {
    /// Time until the subscription ends, s; 0 for a subscription without end.
    pub(super) fn left(&self, now: Instant) -> u64 {
        self.until
            .map_or(0, |until| until.saturating_duration_since(now).as_secs().max(1))
    }
}

/// A confirmed notification without an answer.
#[derive(Debug)]
struct Outstanding {
    device: u32,
    key: Key,
    invoke: u8,
    message: Vec<u8>,
    tries: u8,
    until: Instant,
}

/// All subscriptions to changes of value.
#[derive(Debug, Default)]
pub(super) struct Cov {
    one_device: bool,
    of: BTreeMap<u32, Vec<Subscription>>,
    hosts: HashMap<Ipv4Addr, usize>,
    outstanding: HashMap<Address, Outstanding>,
    numbered: u64,
    invoke: u8,
}

/// Reads the present values of a subscription, and the COV increment of its object.
pub(super) type PresentValue<'a> = &'a mut dyn FnMut(u32, &Subscription) -> Option<(Reported, f64)>;

impl Cov {
    /// The subscriptions with their limits: if all objects belong to one device, a host may have as many there as
    /// otherwise on all devices.
    pub(super) fn limited(one_device: bool) -> Cov {
        Cov {
            one_device,
            ..Cov::default()
        }
    }

    fn most_of_device(&self) -> usize {
        if self.one_device { MOST_OF_HOST } else { MOST_OF_DEVICE }
    }

    /// Adds or renews a subscription; returns false if no room is left.
    pub(super) fn subscribe(
        &mut self,
        device: u32,
        key: Key,
        (confirmed, lifetime): (bool, u32),
        increment: Option<f32>,
        now: Instant,
    ) -> bool {
        let until = (lifetime > 0).then(|| now + Duration::from_secs(lifetime.into()));
        let renewed = Subscription {
            key,
            confirmed,
            increment,
            until,
            told: None,
            due: None,
            lost: 0,
        };
        let (all, most_of_device) = (self.len(), self.most_of_device());
        let of_device = self.of.entry(device).or_default();
        if let Some(known) = of_device.iter_mut().find(|s| s.key == key) {
            *known = renewed;
            return true;
        }
        let own = of_device
            .iter()
            .filter(|s| s.key.subscriber.ip() == key.subscriber.ip())
            .count();
        let of_host = self.hosts.entry(key.subscriber.ip()).or_default();
        if all >= MOST_SUBSCRIPTIONS || *of_host >= MOST_OF_HOST || own >= most_of_device {
            self.tidy();
            return false;
        }
        *of_host += 1;
        of_device.push(renewed);
        true
    }

    /// Ends a subscription, if it exists.
    pub(super) fn cancel(&mut self, device: u32, key: &Key) {
        self.retain(|of, subscription| of != device || subscription.key != *key);
    }

    /// Keeps the subscriptions for which `keep` returns true.
    pub(super) fn retain(&mut self, mut keep: impl FnMut(u32, &Subscription) -> bool) {
        for (device, all) in &mut self.of {
            all.retain(|subscription| {
                let keeps = keep(*device, subscription);
                let subscriber = subscription.key.subscriber;
                if !keeps && let Some(count) = self.hosts.get_mut(&subscriber.ip()) {
                    *count = count.saturating_sub(1);
                }
                let of_it = |o: &Outstanding| (o.device, o.key) == (*device, subscription.key);
                if !keeps && self.outstanding.get(&subscriber).is_some_and(of_it) {
                    self.outstanding.remove(&subscriber);
                }
                keeps
            });
        }
        self.tidy();
    }

    fn tidy(&mut self) {
        self.of.retain(|_, all| !all.is_empty());
        self.hosts.retain(|_, count| *count > 0);
    }

    /// Number of subscriptions.
    pub(super) fn len(&self) -> usize {
        self.hosts.values().sum()
    }

    /// Devices with a subscription.
    pub(super) fn devices(&self) -> Vec<u32> {
        self.of.keys().copied().collect()
    }

    /// The subscriptions to a device.
    pub(super) fn of(&self, device: u32) -> &[Subscription] {
        self.of.get(&device).map_or(&[], Vec::as_slice)
    }

    /// Compares the subscriptions of a device with its values: those whose clients need a notification become due.
    pub(super) fn compare(&mut self, device: u32, look: PresentValue<'_>) {
        let Some(all) = self.of.get_mut(&device) else { return };
        for subscription in all.iter_mut().filter(|subscription| subscription.due.is_none()) {
            let Some((now, increment)) = look(device, subscription) else {
                continue;
            };
            let increment = subscription.increment.map_or(increment, f64::from);
            if subscription
                .told
                .as_ref()
                .is_none_or(|told| told.differs(&now, increment))
            {
                self.numbered += 1;
                subscription.due = Some(self.numbered);
            }
        }
    }

    /// The subscription to notify next: the longest waiting first, and one at a time for a client that acknowledges. None of
    /// a device that is quiet.
    pub(super) fn next(&self, is_quiet: impl Fn(u32) -> bool) -> Option<(u32, Key, bool)> {
        let free = |s: &&Subscription| !s.confirmed || !self.outstanding.contains_key(&s.key.subscriber);
        let talking = self.of.iter().filter(|(device, _)| !is_quiet(**device));
        let all = talking.flat_map(|(device, all)| all.iter().map(move |s| (*device, s)));
        let due = all.filter(|(_, s)| s.due.is_some() && free(s));
        let first = due.min_by_key(|(_, s)| s.due);
        first.map(|(device, s)| (device, s.key, s.confirmed))
    }

    /// Notes that a notification was sent: the subscription is no longer due, and later values are compared with `told`.
    pub(super) fn notified(&mut self, device: u32, key: &Key, told: Option<Reported>) {
        let all = self.of.get_mut(&device);
        if let Some(subscription) = all.and_then(|all| all.iter_mut().find(|s| s.key == *key)) {
            subscription.due = None;
            if told.is_some() {
                subscription.told = told;
            }
        }
    }

    /// The number of the next confirmed notification.
    pub(super) fn number(&mut self) -> u8 {
        self.invoke = self.invoke.wrapping_add(1);
        self.invoke
    }

    /// Notes that a confirmed notification was sent.
    pub(super) fn sent(&mut self, device: u32, key: Key, invoke: u8, message: Vec<u8>, now: Instant) {
        let outstanding = Outstanding {
            device,
            key,
            invoke,
            message,
            tries: 1,
            until: now + WAIT,
        };
        self.outstanding.insert(key.subscriber, outstanding);
    }

    /// Notes that a client answered a notification, in any form.
    pub(super) fn answered(&mut self, from: Address, device: u32, invoke: u8) {
        let is = |o: &Outstanding| (o.device, o.invoke) == (device, invoke);
        if self.outstanding.get(&from).is_some_and(is)
            && let Some(done) = self.outstanding.remove(&from)
        {
            self.note(done.device, done.key, false);
        }
    }

    fn note(&mut self, device: u32, key: Key, lost: bool) {
        let all = self.of.get_mut(&device);
        let Some(subscription) = all.and_then(|all| all.iter_mut().find(|s| s.key == key)) else {
            return;
        };
        subscription.lost = if lost { subscription.lost.saturating_add(1) } else { 0 };
        if lost {
            // The client has not received the notification.
            subscription.told = None;
        }
        if subscription.lost >= LOST && subscription.until.is_none() {
            self.cancel(device, &key);
        }
    }

    /// Ends expired subscriptions, and returns the notifications that must be sent again.
    pub(super) fn poll(&mut self, now: Instant) -> Vec<(Address, u32, Vec<u8>)> {
        let over = |s: &Subscription| s.until.is_some_and(|until| until <= now);
        if self.of.values().flatten().any(over) {
            self.retain(|_, subscription| !over(subscription));
        }
        let mut again = Vec::new();
        let mut lost = Vec::new();
        for (subscriber, outstanding) in &mut self.outstanding {
            if now < outstanding.until {
                continue;
            }
            outstanding.tries += 1;
            outstanding.until = now + WAIT;
            if outstanding.tries <= TRIES {
                again.push((*subscriber, outstanding.device, outstanding.message.clone()));
            } else {
                lost.push((*subscriber, outstanding.device, outstanding.key));
            }
        }
        for (subscriber, device, key) in lost {
            self.outstanding.remove(&subscriber);
            self.note(device, key, true);
        }
        again
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::ObjectType;

    fn key(host: u8, process: u32) -> Key {
        Key {
            subscriber: Address::local(format!("10.0.0.{host}:47808").parse().unwrap()),
            process,
            object: ObjectId::new(ObjectType::ANALOG_INPUT, 1),
            property: None,
        }
    }

    fn shows(number: f64, rest: u8) -> Reported {
        Reported {
            number: Some(number),
            rest: vec![rest],
        }
    }

    #[test]
    fn what_is_not_acknowledged_ends_with_its_subscription() {
        let now = Instant::now();
        let mut cov = Cov::default();
        for n in 0..10_000_u32 {
            let key = Key {
                subscriber: Address::local(format!("10.0.0.1:{}", 1000 + n % 60_000).parse().unwrap()),
                ..key(1, n)
            };
            assert!(cov.subscribe(1, key, (true, 0), None, now));
            cov.sent(1, key, n as u8, vec![0; 50], now);
            cov.cancel(1, &key);
        }
        assert_eq!(cov.outstanding.len(), 0);
        assert!(cov.poll(now + WAIT).is_empty());
    }

    #[test]
    fn subscriptions_are_bounded_for_each_client_too() {
        let now = Instant::now();
        let mut cov = Cov::default();
        let taken = (0..200)
            .filter(|n| cov.subscribe(1, key(1, *n), (false, 0), None, now))
            .count();
        assert_eq!(taken, MOST_OF_DEVICE);
        assert!(cov.subscribe(1, key(1, 0), (true, 9), None, now), "renewed");
        let mut more = |host: u8| {
            let all = (0..5000).filter(|n| cov.subscribe(2 + n / 100, key(host, *n), (false, 0), None, now));
            all.count()
        };
        assert_eq!(more(1), MOST_OF_HOST - MOST_OF_DEVICE);
        assert_eq!((more(2), more(3)), (MOST_OF_HOST, 0));
        assert_eq!(cov.len(), MOST_SUBSCRIPTIONS);
        cov.cancel(1, &key(1, 0));
        assert_eq!(
            (cov.len(), cov.of(1).len()),
            (MOST_SUBSCRIPTIONS - 1, MOST_OF_DEVICE - 1)
        );
        cov.poll(now + Duration::from_secs(99));
        assert_eq!(cov.len(), MOST_SUBSCRIPTIONS - 1);
    }

    #[test]
    fn told_at_once_then_by_the_increment_or_the_flags() {
        let now = Instant::now();
        let mut cov = Cov::default();
        cov.subscribe(1, key(1, 7), (false, 10), None, now);
        let mut due = |number: f64, rest: u8| {
            cov.compare(1, &mut |_, _| Some((shows(number, rest), 1.0)));
            let due = cov.next(|_| false).is_some();
            if due {
                cov.notified(1, &key(1, 7), Some(shows(number, rest)));
            }
            due
        };
        let cases = [
            (5.0, 0, true),
            (5.0, 0, false),
            (5.9, 0, false),
            (6.0, 0, true),
            (5.5, 1, true),
            (5.5, 1, false),
        ];
        for (number, rest, is_due) in cases {
            assert_eq!(due(number, rest), is_due, "{number} {rest}");
        }
        assert_eq!(cov.of(1)[0].left(now), 10);
        cov.poll(now + Duration::from_secs(10));
        assert_eq!(cov.len(), 0);
    }

    #[test]
    fn any_number_in_vain_leaves_what_has_an_end() {
        let now = Instant::now();
        let mut cov = Cov::default();
        cov.subscribe(1, key(1, 1), (true, 1_000_000), None, now);
        for lost in 0..300 {
            cov.sent(1, key(1, 1), 9, vec![1], now);
            for tries in 1..=u64::from(TRIES) {
                cov.poll(now + Duration::from_secs((lost * u64::from(TRIES) + tries) * 3));
            }
            assert_eq!((cov.len(), cov.outstanding.len()), (1, 0));
        }
    }

    #[test]
    fn one_at_a_time_and_three_in_vain_end_what_has_no_end() {
        let now = Instant::now();
        let mut cov = Cov::default();
        cov.subscribe(1, key(1, 1), (true, 0), None, now);
        cov.subscribe(1, key(1, 2), (true, 0), None, now);
        cov.compare(1, &mut |_, _| Some((shows(0.0, 0), 1.0)));
        let (device, first, confirmed) = cov.next(|_| false).unwrap();
        assert!(confirmed);
        cov.notified(device, &first, Some(shows(0.0, 0)));
        cov.sent(device, first, 9, vec![1], now);
        assert!(cov.next(|_| false).is_none(), "one outstanding for each subscriber");
        cov.answered(first.subscriber, 1, 8);
        cov.answered(key(2, 1).subscriber, 1, 9);
        assert!(cov.next(|_| false).is_none());
        cov.answered(first.subscriber, 1, 9);
        let (_, second, _) = cov.next(|_| false).unwrap();
        assert_ne!(second, first);
        let mut at = now;
        for _ in 0..LOST {
            assert_eq!(cov.len(), 2);
            cov.notified(1, &second, Some(shows(0.0, 0)));
            cov.sent(1, second, 10, vec![2], at);
            for again in [1, 1, 0] {
                at += WAIT;
                assert_eq!(cov.poll(at).len(), again);
            }
            cov.compare(1, &mut |_, _| Some((shows(0.0, 0), 1.0)));
        }
        assert_eq!((cov.len(), cov.of(1)[0].key), (1, first));
    }
}
