//! The broker without its sockets: clients, subscriptions, retained messages, wills. No clock and no I/O.
//!
//! A client is known only while it is connected: no session outlives its connection.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Instant;

use tokio::sync::{Notify, oneshot};

use super::packet::{Fault, Message, Qos, Subscription, reason};
use super::{MAX_QUEUE_BYTES, MAX_QUEUE_MESSAGES, MAX_RETAINED_BYTES, MAX_RETAINED_MESSAGES, MAX_SUBSCRIPTIONS, topic};

/// All state of the broker, without its sockets.
#[derive(Debug, Default)]
pub(super) struct State {
    /// The clients by the number of their connection.
    clients: BTreeMap<u64, Client>,
    retained: BTreeMap<String, Arc<Message>>,
    retained_bytes: usize,
}

/// A connected client.
#[derive(Debug)]
struct Client {
    id: String,
    will: Option<Message>,
    subscriptions: Vec<Subscription>,
    queue: VecDeque<Delivery>,
    queue_bytes: usize,
    /// Notified when the client has something to send.
    wake: Arc<Notify>,
    /// Channel that ends the connection; usable once.
    end: Option<oneshot::Sender<Fault>>,
}

/// A message for one client.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Delivery {
    pub(super) message: Arc<Message>,
    pub(super) qos: Qos,
    pub(super) retain: bool,
}

/// How a connection ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Leave {
    /// The client sent a DISCONNECT, so no will is published.
    Clean,
    /// The connection ended without a DISCONNECT, so the will is published.
    Lost,
}

impl State {
    /// Adds the client `id` on the connection with this number; an earlier connection of the same client ends, and
    /// its will is published.
    pub(super) fn attach(
        &mut self,
        number: u64,
        id: &str,
        will: Option<Message>,
        wake: Arc<Notify>,
        end: oneshot::Sender<Fault>,
        now: Instant,
    ) {
        let earlier = self
            .clients
            .iter()
            .find(|(_, client)| client.id == id)
            .map(|(number, _)| *number);
        if let Some(earlier) = earlier {
            let reason = reason::SESSION_TAKEN_OVER;
            if let Some(client) = self.clients.get_mut(&earlier) {
                client.end(reason, "the client connected again");
            }
            self.detach(earlier, Leave::Lost, now);
        }
        let client = Client {
            id: id.to_string(),
            will,
            subscriptions: Vec::new(),
            queue: VecDeque::new(),
            queue_bytes: 0,
            wake,
            end: Some(end),
        };
        self.clients.insert(number, client);
    }

    /// Removes the connection with this number, which has ended.
    pub(super) fn detach(&mut self, number: u64, leave: Leave, now: Instant) {
        let will = self.clients.remove(&number).and_then(|client| client.will);
        if let (Leave::Lost, Some(will)) = (leave, will) {
            self.publish(number, Message { published: now, ..will }, now);
        }
    }

    /// Retains and passes on a message; returns false if there was no room to retain it.
    pub(super) fn publish(&mut self, publisher: u64, message: Message, now: Instant) -> bool {
        let message = Arc::new(message);
        let kept = !message.retain || self.retain(&message, now);
        for (number, client) in &mut self.clients {
            client.offer(&message, *number == publisher);
        }
        kept
    }

    /// Sets, replaces or, without payload, deletes the retained message of a topic; returns false if there is no
    /// room for it.
    fn retain(&mut self, message: &Arc<Message>, now: Instant) -> bool {
        if let Some(old) = self.retained.remove(&message.topic) {
            self.retained_bytes -= old.weight();
        }
        if message.payload.is_empty() {
            return true;
        }
        if !self.has_room(message) {
            self.retained.retain(|_, message| message.is_current(now));
            self.retained_bytes = self.retained.values().map(|message| message.weight()).sum();
        }
        let room = self.has_room(message);
        if room {
            self.retained_bytes += message.weight();
            self.retained.insert(message.topic.clone(), Arc::clone(message));
        }
        room
    }

    fn has_room(&self, message: &Message) -> bool {
        self.retained.len() < MAX_RETAINED_MESSAGES && self.retained_bytes + message.weight() <= MAX_RETAINED_BYTES
    }

    /// Subscribes a client and queues the retained messages; a reason code for each filter.
    pub(super) fn subscribe(&mut self, number: u64, wanted: Vec<Subscription>, now: Instant) -> Vec<u8> {
        let Some(client) = self.clients.get_mut(&number) else {
            return vec![reason::PROTOCOL_ERROR; wanted.len()];
        };
        let mut codes = Vec::with_capacity(wanted.len());
        for subscription in wanted {
            let new = client.unsubscribe(&subscription.filter) != reason::SUCCESS;
            let code = client.check(&subscription.filter);
            codes.push(code.err().unwrap_or(subscription.qos as u8));
            if code.is_err() {
                continue;
            }
            if subscription.retain_handling == 0 || (subscription.retain_handling == 1 && new) {
                let matching = |message: &&Arc<Message>| {
                    message.is_current(now) && topic::matches(&message.topic, &subscription.filter)
                };
                for message in self.retained.values().filter(matching) {
                    client.push(Delivery {
                        message: Arc::clone(message),
                        qos: subscription.qos.min(message.qos),
                        retain: true,
                    });
                }
            }
            client.subscriptions.push(subscription);
        }
        codes
    }

    /// Ends subscriptions; returns a reason code for each filter.
    pub(super) fn unsubscribe(&mut self, number: u64, filters: &[String]) -> Vec<u8> {
        let Some(client) = self.clients.get_mut(&number) else {
            return vec![reason::PROTOCOL_ERROR; filters.len()];
        };
        filters.iter().map(|filter| client.unsubscribe(filter)).collect()
    }

    /// The next message for a client; a QoS 1 message only if `acknowledged` ones may be sent, otherwise it waits
    /// with those behind it.
    pub(super) fn take(&mut self, number: u64, acknowledged: bool, now: Instant) -> Option<Delivery> {
        let client = self.clients.get_mut(&number)?;
        loop {
            let next = client.queue.front()?;
            let current = next.message.is_current(now);
            if current && next.qos == Qos::AtLeastOnce && !acknowledged {
                return None;
            }
            let next = client.queue.pop_front()?;
            client.queue_bytes -= next.message.weight();
            if current {
                return Some(next);
            }
        }
    }
}

impl Client {
    fn end(&mut self, reason: u8, what: &'static str) {
        if let Some(end) = self.end.take() {
            // A connection that has already ended need not be ended.
            let _ = end.send(Fault { reason, what });
        }
    }

    /// Whether one more subscription to `filter` is allowed.
    fn check(&self, filter: &str) -> Result<(), u8> {
        if !topic::is_filter(filter) {
            Err(reason::TOPIC_FILTER_INVALID)
        } else if filter.starts_with("$share/") {
            Err(reason::SHARED_SUBSCRIPTIONS_NOT_SUPPORTED)
        } else if self.subscriptions.len() >= MAX_SUBSCRIPTIONS {
            Err(reason::QUOTA_EXCEEDED)
        } else {
            Ok(())
        }
    }

    fn unsubscribe(&mut self, filter: &str) -> u8 {
        let before = self.subscriptions.len();
        self.subscriptions.retain(|known| known.filter != filter);
        if self.subscriptions.len() < before {
            reason::SUCCESS
        } else {
            reason::NO_SUBSCRIPTION_EXISTED
        }
    }

    /// Queues `message` if the client has subscribed to it: once, at the highest QoS of all matching subscriptions.
    /// `own` means that the client published it.
    fn offer(&mut self, message: &Arc<Message>, own: bool) {
        let matches = |subscription: &&Subscription| {
            !(own && subscription.no_local) && topic::matches(&message.topic, &subscription.filter)
        };
        let matching = || self.subscriptions.iter().filter(matches);
        let Some(qos) = matching().map(|subscription| subscription.qos).max() else {
            return;
        };
        let retain = message.retain && matching().any(|subscription| subscription.retain_as_published);
        self.push(Delivery {
            message: Arc::clone(message),
            qos: qos.min(message.qos),
            retain,
        });
    }

    /// Queues a message for a client; a client that does not take its messages loses its connection, so that no
    /// message is dropped silently.
    fn push(&mut self, delivery: Delivery) {
        let bytes = self.queue_bytes + delivery.message.weight();
        if self.queue.len() >= MAX_QUEUE_MESSAGES || bytes > MAX_QUEUE_BYTES {
            self.end(reason::QUOTA_EXCEEDED, "the client does not take its messages");
            return;
        }
        self.queue_bytes = bytes;
        self.queue.push_back(delivery);
        self.wake.notify_one();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    fn message(topic: &str, payload: &[u8]) -> Message {
        Message {
            topic: topic.to_string(),
            payload: payload.to_vec(),
            qos: Qos::AtLeastOnce,
            retain: true,
            properties: Vec::new(),
            lifetime: None,
            published: Instant::now(),
        }
    }

    fn attach(state: &mut State, number: u64, id: &str, will: Option<Message>) -> oneshot::Receiver<Fault> {
        let (end, ended) = oneshot::channel();
        state.attach(number, id, will, Arc::default(), end, Instant::now());
        ended
    }

    fn subscription(filter: &str) -> Subscription {
        Subscription {
            filter: filter.to_string(),
            qos: Qos::AtLeastOnce,
            no_local: false,
            retain_as_published: false,
            retain_handling: 0,
        }
    }

    fn subscribe(state: &mut State, number: u64, subscription: Subscription) -> u8 {
        state.subscribe(number, vec![subscription], Instant::now())[0]
    }

    /// Topics, payloads and retain flags of all that waits.
    fn waiting(state: &mut State, number: u64) -> Vec<(String, Vec<u8>, bool)> {
        let now = Instant::now();
        let all = std::iter::from_fn(|| state.take(number, true, now));
        all.map(|d| (d.message.topic.clone(), d.message.payload.clone(), d.retain))
            .collect()
    }

    fn seen(topic: &str, payload: &[u8], retain: bool) -> (String, Vec<u8>, bool) {
        (topic.to_string(), payload.to_vec(), retain)
    }

    #[test]
    fn options_of_subscriptions() {
        let (mut state, now) = (State::default(), Instant::now());
        let _end = attach(&mut state, 1, "a", None);
        assert!(state.publish(9, message("t/1", b"old"), now));
        assert_eq!(subscribe(&mut state, 1, subscription("t/#")), 1);
        assert_eq!(waiting(&mut state, 1), [seen("t/1", b"old", true)]);
        for (handling, comes) in [(0, 1), (1, 0), (2, 0)] {
            subscribe(
                &mut state,
                1,
                Subscription {
                    retain_handling: handling,
                    ..subscription("t/#")
                },
            );
            assert_eq!(waiting(&mut state, 1).len(), comes, "retain handling {handling}");
        }
        state.publish(1, message("t/1", b"x"), now);
        assert_eq!(waiting(&mut state, 1), [seen("t/1", b"x", false)]);
        // A message that matches two filters arrives once, with the retain flag as published if one of the filters
        // requests that.
        let as_published = Subscription {
            retain_as_published: true,
            retain_handling: 2,
            ..subscription("+/1")
        };
        subscribe(&mut state, 1, as_published);
        state.publish(1, message("t/1", b"y"), now);
        assert_eq!(waiting(&mut state, 1), [seen("t/1", b"y", true)]);
        assert_eq!(state.unsubscribe(1, &["+/1".to_string(), "x".to_string()]), [0, 0x11]);
        let no_local = Subscription {
            no_local: true,
            retain_handling: 2,
            ..subscription("t/#")
        };
        subscribe(&mut state, 1, no_local);
        state.publish(1, message("t/1", b"own"), now);
        state.publish(2, message("t/1", b"other"), now);
        assert_eq!(waiting(&mut state, 1), [seen("t/1", b"other", false)]);
        assert_eq!(
            subscribe(&mut state, 1, subscription("a#")),
            reason::TOPIC_FILTER_INVALID
        );
        assert_eq!(
            subscribe(&mut state, 1, subscription("$share/g/t")),
            reason::SHARED_SUBSCRIPTIONS_NOT_SUPPORTED
        );
    }

    #[test]
    fn wills_and_take_over() {
        let (mut state, now) = (State::default(), Instant::now());
        let _watcher = attach(&mut state, 1, "watcher", None);
        subscribe(&mut state, 1, subscription("status/#"));
        let mut first = attach(&mut state, 2, "twin", Some(message("status/2", b"gone")));
        let _second = attach(&mut state, 3, "twin", Some(message("status/3", b"gone")));
        assert_eq!(first.try_recv().unwrap().reason, reason::SESSION_TAKEN_OVER);
        assert_eq!(waiting(&mut state, 1), [seen("status/2", b"gone", false)]);
        state.detach(2, Leave::Lost, now);
        assert!(waiting(&mut state, 1).is_empty(), "it was published already");
        state.detach(3, Leave::Clean, now);
        assert!(waiting(&mut state, 1).is_empty(), "a client that took its leave");
    }

    #[test]
    fn retained_messages_are_deleted_and_expire() {
        let (mut state, now) = (State::default(), Instant::now());
        let _end = attach(&mut state, 1, "a", None);
        let short = Message {
            lifetime: Some(Duration::from_secs(1)),
            ..message("short", b"x")
        };
        state.publish(
            9,
            Message {
                published: now,
                ..short
            },
            now,
        );
        state.publish(9, message("gone", b"x"), now);
        state.publish(9, message("gone", b""), now);
        state.subscribe(1, vec![subscription("#")], now + Duration::from_secs(1));
        assert!(waiting(&mut state, 1).is_empty());
        assert_eq!(
            (state.retained.len(), state.retained_bytes),
            (1, state.retained["short"].weight())
        );
    }

    #[test]
    fn everything_is_bounded() {
        let (mut state, now) = (State::default(), Instant::now());
        let short = Message {
            lifetime: Some(Duration::from_secs(1)),
            published: now,
            ..message("short", b"x")
        };
        state.publish(9, short, now);
        for number in 1..MAX_RETAINED_MESSAGES {
            assert!(state.publish(9, message(&number.to_string(), b"x"), now));
        }
        assert!(!state.publish(9, message("one more", b"x"), now), "not retained");
        let later = now + Duration::from_secs(2);
        assert!(
            state.publish(9, message("one more", b"x"), later),
            "in the place of one that has expired"
        );
        assert!(
            state.publish(9, message("7", b"new"), now),
            "one in the place of another"
        );
        let mut slow = attach(&mut state, 1, "slow", None);
        let mut quick = attach(&mut state, 2, "quick", None);
        subscribe(&mut state, 1, subscription("#"));
        subscribe(&mut state, 2, subscription("#"));
        assert_eq!(
            waiting(&mut state, 2).len(),
            MAX_RETAINED_MESSAGES,
            "all retained messages fit a queue"
        );
        let large = Message {
            retain: false,
            ..message("t", &vec![7; 200_000])
        };
        while slow.try_recv().is_err() {
            state.publish(9, large.clone(), now);
            assert_eq!(waiting(&mut state, 2).len(), 1);
            assert!(state.clients[&1].queue_bytes <= MAX_QUEUE_BYTES);
        }
        assert!(quick.try_recv().is_err(), "a slow client harms no other");
        let codes: Vec<u8> = (0..=MAX_SUBSCRIPTIONS)
            .map(|n| subscribe(&mut state, 2, subscription(&format!("x/{n}"))))
            .collect();
        assert_eq!(codes.last(), Some(&reason::QUOTA_EXCEEDED));
        assert_eq!(state.clients[&2].subscriptions.len(), MAX_SUBSCRIPTIONS);
    }

    #[test]
    fn a_message_waits_for_acknowledgements_and_not_beyond_its_life() {
        let (mut state, now) = (State::default(), Instant::now());
        let _end = attach(&mut state, 1, "a", None);
        subscribe(&mut state, 1, subscription("#"));
        let short = Message {
            lifetime: Some(Duration::from_secs(1)),
            published: now,
            ..message("t", b"short")
        };
        state.publish(9, short, now);
        state.publish(9, message("t", b"long"), now);
        assert_eq!(state.take(1, false, now), None);
        let next = state.take(1, true, now + Duration::from_secs(2)).unwrap();
        assert_eq!(next.message.payload, b"long");
        assert_eq!(state.clients[&1].queue_bytes, 0);
    }
}
