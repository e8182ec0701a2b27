//! Decides what is sent next, and tracks what waits for its acknowledgement.
//!
//! Telemetry: only the latest value of a topic waits, and one message per topic is in flight. Events and results:
//! bounded queues in order. An entry leaves only when it is acknowledged (PUBACK). At most `limit` messages are in
//! flight: half the inflight window of the connection, so that no packet id is used twice at a time.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::sync::Arc;

use super::journal::RecordId;

/// Maximum number of waiting results, the same as that of commands, and their size in bytes; the oldest is dropped.
const RESULTS: usize = 4096;
const RESULT_BYTES: usize = 32 << 20;
/// Maximum number of events waiting in memory; with a buffer, the others wait on disk.
const EVENTS: usize = crate::event::BURST;
/// Maximum number of events loaded from disk at a time.
const LOADED: usize = 64;
/// Number of lost connections after which a result is dropped: its response topic may be the cause.
const RESULT_ATTEMPTS: u8 = 2;

/// A message for the broker, QoS 1.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Message {
    pub(super) topic: Arc<str>,
    pub(super) payload: Vec<u8>,
    pub(super) retain: bool,
    /// Correlation data of the request that this answers.
    pub(super) correlation: Option<Vec<u8>>,
}

impl Message {
    /// A message that is not retained.
    pub(super) fn not_retained(topic: impl Into<Arc<str>>, payload: Vec<u8>) -> Message {
        Message {
            topic: topic.into(),
            payload,
            retain: false,
            correlation: None,
        }
    }

    fn bytes(&self) -> usize {
        self.topic.len() + self.payload.len() + self.correlation.as_ref().map_or(0, Vec::len)
    }
}

/// Identifies an entry while its message is in flight.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Key {
    /// Telemetry of this topic.
    Latest(Arc<str>),
    /// Result with this serial number.
    Result(u64),
    /// Event with this serial number.
    Event(u64),
}

/// An entry whose message was acknowledged.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Acknowledged {
    /// Topic of the message.
    pub(super) topic: Arc<str>,
    /// Its record on disk.
    pub(super) record: Option<RecordId>,
}

#[derive(Debug, Default)]
struct Slot {
    /// The latest payload that is not published yet.
    waiting: Option<Vec<u8>>,
    in_flight: bool,
}

#[derive(Debug)]
struct Entry {
    serial: u64,
    message: Message,
    record: Option<RecordId>,
    in_flight: bool,
    attempts: u8,
}

/// All messages that wait or are in flight.
#[derive(Debug, Default)]
pub(super) struct Outbox {
    latest: BTreeMap<Arc<str>, Slot>,
    /// Topics with a waiting payload, oldest change first.
    order: VecDeque<Arc<str>>,
    results: VecDeque<Entry>,
    events: VecDeque<Entry>,
    serial: u64,
    /// Published, packet id not known yet.
    published: VecDeque<Key>,
    /// Published, by packet id.
    unacknowledged: HashMap<u16, Key>,
    /// The first topic of `order` is published before everything else.
    has_leader: bool,
    /// Whether events come before telemetry next time.
    events_turn: bool,
    dropped: u64,
}

impl Outbox {
    /// Adds telemetry; replaces the waiting payload of the topic.
    pub(super) fn put(&mut self, topic: Arc<str>, payload: Vec<u8>) {
        let slot = self.latest.entry(topic.clone()).or_default();
        if slot.waiting.replace(payload).is_none() {
            self.order.push_back(topic);
        }
    }

    /// Adds telemetry that is published before everything else.
    pub(super) fn put_first(&mut self, topic: Arc<str>, payload: Vec<u8>) {
        self.latest.entry(topic.clone()).or_default().waiting = Some(payload);
        self.order.retain(|t| *t != topic);
        self.order.push_front(topic);
        self.has_leader = true;
    }

    /// Adds a result; if too many wait, the oldest is dropped.
    pub(super) fn push_result(&mut self, message: Message) {
        self.serial += 1;
        let full = |results: &VecDeque<Entry>| {
            let bytes = results.iter().map(|entry| entry.message.bytes());
            results.len() >= RESULTS || bytes.sum::<usize>() >= RESULT_BYTES
        };
        self.dropped += push(&mut self.results, self.serial, message, None, full);
    }

    /// Adds an event, with its record if it is on disk; if too many wait, the oldest is dropped.
    pub(super) fn push_event(&mut self, message: Message, record: Option<RecordId>) {
        self.serial += 1;
        let full = |events: &VecDeque<Entry>| events.len() >= EVENTS;
        self.dropped += push(&mut self.events, self.serial, message, record, full);
    }

    /// Whether half of the room for events is taken.
    pub(super) fn is_busy(&self) -> bool {
        self.events.len() >= EVENTS / 2
    }

    /// Number of events that may be loaded from disk now.
    pub(super) fn room(&self) -> usize {
        LOADED.saturating_sub(self.events.len())
    }

    /// Number of events and results that wait or are in flight.
    pub(super) fn waiting(&self) -> usize {
        self.results.len() + self.events.len()
    }

    /// Whether telemetry of that topic waits or is in flight.
    pub(super) fn has_telemetry(&self, topic: &str) -> bool {
        self.latest.contains_key(topic)
    }

    /// Number of events and results dropped because too many waited.
    pub(super) fn dropped(&self) -> u64 {
        self.dropped
    }

    /// Number of messages in flight.
    pub(super) fn in_flight(&self) -> usize {
        self.published.len() + self.unacknowledged.len()
    }

    /// The message to publish next: the leading one, then results, then events and telemetry alternately. It stays in
    /// the outbox; confirm with [`Outbox::mark_published`] that it was published.
    pub(super) fn next(&self, limit: usize) -> Option<(Key, Message)> {
        if self.in_flight() >= limit {
            return None;
        }
        if self.has_leader
            && let Some(leader) = self.next_latest()
        {
            return Some(leader);
        }
        next_entry(&self.results, Key::Result).or_else(|| {
            let events = || next_entry(&self.events, Key::Event);
            let latest = || self.next_latest();
            if self.events_turn {
                events().or_else(latest)
            } else {
                latest().or_else(events)
            }
        })
    }

    fn next_latest(&self) -> Option<(Key, Message)> {
        self.order.iter().find_map(|topic| {
            let slot = self.latest.get(topic).filter(|slot| !slot.in_flight)?;
            let message = Message {
                topic: topic.clone(),
                payload: slot.waiting.clone()?,
                retain: true,
                correlation: None,
            };
            Some((Key::Latest(topic.clone()), message))
        })
    }

    /// The message of `key` was published on the connection.
    pub(super) fn mark_published(&mut self, key: Key) {
        match &key {
            Key::Latest(topic) => {
                if let Some(slot) = self.latest.get_mut(topic) {
                    slot.waiting = None;
                    slot.in_flight = true;
                }
                // At or near the front: only topics in flight come before it.
                if let Some(place) = self.order.iter().position(|t| t == topic) {
                    self.order.remove(place);
                }
                self.has_leader = false;
                self.events_turn = true;
            }
            Key::Result(serial) => mark(&mut self.results, *serial),
            Key::Event(serial) => {
                mark(&mut self.events, *serial);
                self.events_turn = false;
            }
        }
        self.published.push_back(key);
    }

    /// The connection assigned this packet id to the oldest published message.
    ///
    /// # Errors
    /// The state is inconsistent; the connection must be closed.
    pub(super) fn numbered(&mut self, packet: u16) -> Result<(), &'static str> {
        let key = self
            .published
            .pop_front()
            .ok_or("a message was sent that was not published by the outbox")?;
        match self.unacknowledged.insert(packet, key) {
            None => Ok(()),
            Some(_) => Err("a packet id was used twice"),
        }
    }

    /// The broker acknowledged a message; its entry is removed.
    pub(super) fn acked(&mut self, packet: u16) -> Option<Acknowledged> {
        self.settle(self.unacknowledged.get(&packet).cloned()?, Some(packet))
    }

    /// Drops the message of `key`, which cannot be sent.
    pub(super) fn give_up(&mut self, key: Key) -> Option<Acknowledged> {
        if let Key::Latest(topic) = &key {
            self.latest.get_mut(topic)?.waiting = None;
            self.order.retain(|t| t != topic);
        }
        self.settle(key, None)
    }

    fn settle(&mut self, key: Key, packet: Option<u16>) -> Option<Acknowledged> {
        if let Some(packet) = packet {
            self.unacknowledged.remove(&packet);
        }
        match key {
            Key::Latest(topic) => {
                let slot = self.latest.get_mut(&topic)?;
                slot.in_flight = false;
                if slot.waiting.is_none() {
                    self.latest.remove(&topic);
                }
                Some(Acknowledged { topic, record: None })
            }
            Key::Result(serial) => take(&mut self.results, serial),
            Key::Event(serial) => take(&mut self.events, serial),
        }
    }

    /// The connection is lost. Events and results in flight wait again, in their order; telemetry is dropped, since the
    /// process image has newer values.
    pub(super) fn lost(&mut self) {
        self.latest.clear();
        self.order.clear();
        self.published.clear();
        self.unacknowledged.clear();
        self.has_leader = false;
        for entry in self.results.iter_mut().chain(&mut self.events) {
            entry.attempts = entry.attempts.saturating_add(u8::from(entry.in_flight));
            entry.in_flight = false;
        }
        let before = self.results.len();
        self.results.retain(|entry| entry.attempts < RESULT_ATTEMPTS);
        self.dropped += (before - self.results.len()) as u64;
    }

    /// Stops sending telemetry.
    pub(super) fn drop_telemetry(&mut self) {
        self.order.clear();
        self.latest.retain(|_, slot| {
            slot.waiting = None;
            slot.in_flight
        });
    }
}

/// Appends an entry and returns the number of entries dropped to make room. Entries in flight are dropped last: they
/// have probably been delivered.
fn push(
    queue: &mut VecDeque<Entry>,
    serial: u64,
    message: Message,
    record: Option<RecordId>,
    is_full: impl Fn(&VecDeque<Entry>) -> bool,
) -> u64 {
    let mut dropped = 0;
    while is_full(queue) {
        let victim = queue.iter().position(|e| !e.in_flight).unwrap_or(0);
        queue.remove(victim);
        dropped += 1;
    }
    queue.push_back(Entry {
        serial,
        message,
        record,
        in_flight: false,
        attempts: 0,
    });
    dropped
}

fn next_entry(queue: &VecDeque<Entry>, key: fn(u64) -> Key) -> Option<(Key, Message)> {
    let entry = queue.iter().find(|e| !e.in_flight)?;
    Some((key(entry.serial), entry.message.clone()))
}

fn mark(queue: &mut VecDeque<Entry>, serial: u64) {
    if let Some(entry) = queue.iter_mut().find(|e| e.serial == serial) {
        entry.in_flight = true;
    }
}

fn take(queue: &mut VecDeque<Entry>, serial: u64) -> Option<Acknowledged> {
    let index = queue.iter().position(|e| e.serial == serial)?;
    queue.remove(index).map(|entry| Acknowledged {
        topic: entry.message.topic,
        record: entry.record,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn topic(name: &str) -> Arc<str> {
        Arc::from(name)
    }

    fn event(name: &str) -> Message {
        Message::not_retained(name, Vec::new())
    }

    /// Publishes everything allowed; returns topics and payloads.
    fn drain(outbox: &mut Outbox, limit: usize) -> Vec<(String, Vec<u8>)> {
        let mut sent = Vec::new();
        while let Some((key, message)) = outbox.next(limit) {
            outbox.mark_published(key);
            sent.push((message.topic.to_string(), message.payload));
        }
        sent
    }

    fn names(sent: &[(String, Vec<u8>)]) -> Vec<&str> {
        sent.iter().map(|(t, _)| t.as_str()).collect()
    }

    #[test]
    fn newest_telemetry_wins_and_one_message_per_topic_is_in_flight() {
        let mut outbox = Outbox::default();
        outbox.put(topic("a"), vec![1]);
        outbox.put(topic("b"), vec![1]);
        outbox.put(topic("a"), vec![2]);
        assert_eq!(drain(&mut outbox, 10), [("a".into(), vec![2]), ("b".into(), vec![1])]);
        outbox.put(topic("a"), vec![3]);
        outbox.put(topic("a"), vec![4]);
        assert!(outbox.next(10).is_none(), "a is in flight");
        outbox.numbered(1).unwrap();
        outbox.numbered(2).unwrap();
        assert!(outbox.acked(2).is_some(), "acknowledgements come in any order");
        assert_eq!(outbox.acked(1).unwrap().topic.as_ref(), "a");
        assert_eq!(drain(&mut outbox, 10), [("a".into(), vec![4])]);
        assert!(outbox.acked(77).is_none());
    }

    #[test]
    fn the_limit_bounds_what_is_in_flight() {
        let mut outbox = Outbox::default();
        for i in 0..10 {
            outbox.put(topic(&format!("t{i}")), Vec::new());
            outbox.push_event(event("e"), None);
        }
        assert_eq!(drain(&mut outbox, 3).len(), 3);
        assert_eq!(outbox.in_flight(), 3);
        outbox.numbered(1).unwrap();
        outbox.acked(1);
        assert_eq!(drain(&mut outbox, 3).len(), 1);
    }

    #[test]
    fn leader_then_results_then_events_and_telemetry_alternately() {
        let mut outbox = Outbox::default();
        for i in 1..=3 {
            outbox.put(topic(&format!("t{i}")), Vec::new());
            outbox.push_event(event(&format!("e{i}")), None);
        }
        outbox.push_result(event("r"));
        outbox.put_first(topic("status"), Vec::new());
        let sent = drain(&mut outbox, 100);
        assert_eq!(names(&sent), ["status", "r", "e1", "t1", "e2", "t2", "e3", "t3"]);
    }

    #[test]
    fn after_a_lost_connection_events_are_sent_again_in_order() {
        let mut outbox = Outbox::default();
        outbox.put(topic("t"), Vec::new());
        for name in ["e1", "e2", "e3"] {
            outbox.push_event(event(name), None);
        }
        assert_eq!(drain(&mut outbox, 3).len(), 3);
        outbox.numbered(1).unwrap();
        outbox.numbered(2).unwrap();
        outbox.numbered(3).unwrap();
        assert_eq!(outbox.acked(2).unwrap().topic.as_ref(), "e1");
        outbox.lost();
        assert_eq!(outbox.waiting(), 2);
        assert_eq!(outbox.in_flight(), 0);
        assert!(
            outbox.acked(3).is_none(),
            "an acknowledgement of the lost connection means nothing"
        );
        assert_eq!(names(&drain(&mut outbox, 10)), ["e2", "e3"]);
    }

    #[test]
    fn a_result_that_breaks_connections_is_dropped() {
        let mut outbox = Outbox::default();
        outbox.push_result(event("bad"));
        for _ in 0..2 {
            assert_eq!(drain(&mut outbox, 10).len(), 1);
            outbox.lost();
        }
        assert_eq!((outbox.waiting(), outbox.dropped()), (0, 1));
    }

    #[test]
    fn queues_are_bounded_and_drop_the_oldest() {
        let mut outbox = Outbox::default();
        for i in 0..EVENTS + 2 {
            outbox.push_event(event(&format!("e{i}")), None);
            outbox.push_result(event("r"));
        }
        assert_eq!(outbox.waiting(), EVENTS + RESULTS);
        assert_eq!(outbox.dropped(), 2 + (EVENTS + 2 - RESULTS) as u64);
        for _ in 0..RESULTS {
            let (key, _) = outbox.next(usize::MAX).unwrap();
            outbox.give_up(key);
        }
        assert_eq!(outbox.next(1).unwrap().1.topic.as_ref(), "e2");
    }

    #[test]
    fn results_are_bounded_by_size() {
        let mut outbox = Outbox::default();
        let long = Message {
            correlation: Some(vec![0; 60_000]),
            ..event("r")
        };
        for _ in 0..1000 {
            outbox.push_result(long.clone());
        }
        assert_eq!(outbox.waiting(), RESULT_BYTES / 60_001 + 1);
    }

    #[test]
    fn inconsistent_packet_ids_are_detected() {
        let mut outbox = Outbox::default();
        assert!(outbox.numbered(1).is_err());
        for name in ["a", "b"] {
            outbox.push_event(event(name), None);
        }
        drain(&mut outbox, 10);
        assert!(outbox.numbered(1).is_ok());
        assert!(outbox.numbered(1).is_err());
    }

    #[test]
    fn messages_that_cannot_be_sent_are_dropped() {
        let mut outbox = Outbox::default();
        outbox.put(topic("big"), vec![0; 10]);
        let (key, _) = outbox.next(1).unwrap();
        outbox.give_up(key);
        assert!(outbox.next(1).is_none());
        assert!(!outbox.has_telemetry("big"));
    }
}
