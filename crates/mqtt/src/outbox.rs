//! Decides what is sent next, and tracks pending acknowledgements.
//!
//! Messages for the broker. Telemetry: only the latest value of a topic waits. Results, events and history: bounded
//! queues in order, whose entries are removed when they are acknowledged (PUBACK). Results, events and telemetry
//! take turns, so that none starves another; history is sent when nothing else waits. Only messages with an
//! acknowledgement count towards the broker's window; telemetry has none by default and is sent even when the
//! window is full.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::sync::Arc;

use super::Qos;
use super::number::{MessageNumber, Place};
use drivegate_north::MqttKind;

/// Maximum number of waiting results, and their size in bytes.
const RESULTS: usize = 16_384;
const RESULT_BYTES: usize = 32 << 20;
/// Maximum number of results that wait on one topic; beyond it, commands that would be answered there are refused.
const RESULTS_OF_TOPIC: usize = 2048;
/// Maximum number of messages of a queue in memory, and their size in bytes; with a buffer, further messages wait
/// on disk. An array of the history has up to 32 KiB.
const KEPT: usize = drivegate_core::event::BURST;
pub(super) const KEPT_BYTES: usize = 16 << 20;
/// Maximum number of messages loaded from disk at once, more than any window, and the size at which loading stops.
const LOADED: usize = 1024;
pub(super) const LOADED_BYTES: usize = 1 << 20;
/// Number of lost connections after which a result is dropped: its response topic may cause them.
const RESULT_ATTEMPTS: u8 = 2;

/// A message for the broker.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Message {
    pub(super) topic: Arc<str>,
    pub(super) payload: Vec<u8>,
    pub(super) retain: bool,
    /// Whether the broker acknowledges the message (QoS 1).
    pub(super) acknowledged: bool,
    /// Time after which the broker drops the message, s.
    pub(super) expiry: Option<u32>,
    /// Correlation data of the request that this answers.
    pub(super) correlation: Option<Vec<u8>>,
}

impl Message {
    /// A message with QoS 1 that is not retained.
    pub(super) fn not_retained(topic: impl Into<Arc<str>>, payload: Vec<u8>) -> Message {
        Message {
            topic: topic.into(),
            payload,
            retain: false,
            acknowledged: true,
            expiry: None,
            correlation: None,
        }
    }

    pub(super) fn bytes(&self) -> usize {
        self.topic.len() + self.payload.len() + self.correlation.as_ref().map_or(0, Vec::len)
    }
}

/// Identifies an entry while its message is in flight.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Key {
    /// The latest value of this telemetry topic.
    Latest(Arc<str>),
    /// Entry of a queue, at this place.
    Queued(MqttKind, Place),
}

/// A message that has left the outbox.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Settled {
    /// Topic of the message.
    pub(super) topic: Arc<str>,
    /// Queue of the message; `None` for telemetry.
    pub(super) kind: Option<MqttKind>,
}

/// How messages are published.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Delivery {
    pub(super) telemetry: Qos,
    /// QoS of events and history.
    pub(super) events: Qos,
    /// Expiry of telemetry, s.
    pub(super) expiry: Option<u32>,
}

#[derive(Debug, Default)]
struct Slot {
    /// The latest payload that is not published yet.
    waiting: Option<Vec<u8>>,
    /// The payload of a message in flight that will be acknowledged, kept in case the broker refuses it.
    sent: Option<Vec<u8>>,
    /// Whether the message must arrive and lasts: the status, discovery, and the end of a topic.
    lasting: bool,
    /// Time after which a lasting message expires as well, s.
    expiry: Option<u32>,
    in_flight: bool,
    /// Whether the broker refused the message, which then waits for [`Outbox::retry`].
    put_back: bool,
}

#[derive(Debug)]
struct Entry {
    place: Place,
    message: Message,
    in_flight: bool,
    attempts: u8,
}

/// Messages of a kind in order.
#[derive(Debug, Default)]
struct Queue {
    entries: VecDeque<Entry>,
    /// Place of the last message that was added.
    last: Place,
    bytes: usize,
    /// Whether the broker refused one of the messages for now; all then wait for [`Outbox::retry`], so that the
    /// order is kept.
    put_back: bool,
    /// Messages dropped since the last [`Outbox::take_lost`], because too many waited or because they broke connections.
    lost: u64,
}

/// All messages that wait or are in flight.
#[derive(Debug)]
pub(super) struct Outbox {
    delivery: Delivery,
    latest: BTreeMap<Arc<str>, Slot>,
    /// Topics with a waiting payload, oldest change first.
    order: VecDeque<Arc<str>>,
    results: Queue,
    /// Number of waiting results by topic.
    results_of: HashMap<Arc<str>, usize>,
    events: Queue,
    history: Queue,
    /// Published messages whose packet id is not known yet.
    published: VecDeque<Key>,
    /// Published messages by packet id.
    unacknowledged: HashMap<u16, Key>,
    /// Whether the first topic of `order` is published before everything else.
    has_leader: bool,
    /// The kind that is sent next: results, events or telemetry.
    turn: usize,
}

impl Outbox {
    pub(super) fn new(delivery: Delivery) -> Outbox {
        Outbox {
            delivery,
            latest: BTreeMap::new(),
            order: VecDeque::new(),
            results: Queue::default(),
            results_of: HashMap::new(),
            events: Queue::default(),
            history: Queue::default(),
            published: VecDeque::new(),
            unacknowledged: HashMap::new(),
            has_leader: false,
            turn: 0,
        }
    }

    /// Adds telemetry; replaces the waiting payload of the topic.
    pub(super) fn put(&mut self, topic: Arc<str>, payload: Vec<u8>) {
        self.put_slot(topic, payload, false);
    }

    /// Adds a message like [`Outbox::put`], for messages that must arrive and do not expire.
    pub(super) fn put_lasting(&mut self, topic: Arc<str>, payload: Vec<u8>) {
        self.put_slot(topic, payload, true);
    }

    fn put_slot(&mut self, topic: Arc<str>, payload: Vec<u8>, lasting: bool) {
        let slot = self.latest.entry(topic.clone()).or_default();
        (slot.lasting, slot.expiry) = (lasting, None);
        if slot.waiting.replace(payload).is_none() {
            self.order.push_back(topic);
        }
    }

    /// Adds a message like [`Outbox::put_lasting`], but ahead of all others; the broker drops it after `expiry`, s,
    /// if given.
    pub(super) fn put_first(&mut self, topic: Arc<str>, payload: Vec<u8>, expiry: Option<u32>) {
        let slot = self.latest.entry(topic.clone()).or_default();
        slot.expiry = expiry;
        (slot.waiting, slot.lasting, slot.put_back) = (Some(payload), true, false);
        self.order.retain(|t| *t != topic);
        self.order.push_front(topic);
        self.has_leader = true;
    }

    /// Adds a result of a command; if too many wait, the oldest is dropped. Receiving continues, because the
    /// acknowledgements that make room arrive over the same connection, and so do stops.
    pub(super) fn push_result(&mut self, message: Message) {
        *self.results_of.entry(message.topic.clone()).or_default() += 1;
        self.push(MqttKind::Result, message, None);
    }

    /// The results that the broker has not acknowledged, in order.
    pub(super) fn into_results(self) -> Vec<Message> {
        self.results.entries.into_iter().map(|entry| entry.message).collect()
    }

    /// Adds an event or history, with its number if it is on disk; if too many wait, the oldest is dropped.
    pub(super) fn push(&mut self, kind: MqttKind, message: Message, number: Option<MessageNumber>) {
        let message = match (kind, self.delivery.events) {
            (MqttKind::Event | MqttKind::History, Qos::AtMostOnce) => Message {
                acknowledged: false,
                ..message
            },
            _ => message,
        };
        let most = match kind {
            MqttKind::Result => (RESULTS, RESULT_BYTES),
            MqttKind::Event | MqttKind::History => (KEPT, KEPT_BYTES),
        };
        while self.queue(kind).is_full_for(&message, most) {
            self.drop_oldest(kind);
        }
        let queue = self.queue_mut(kind);
        queue.bytes += message.bytes();
        queue.last = queue.last.next(number);
        queue.entries.push_back(Entry {
            place: queue.last,
            message,
            in_flight: false,
            attempts: 0,
        });
    }

    /// Drops the oldest message of a queue.
    fn drop_oldest(&mut self, kind: MqttKind) {
        let queue = self.queue_mut(kind);
        // Entries in flight are dropped last, because the broker has probably received them.
        let victim = queue.entries.iter().position(|e| !e.in_flight).unwrap_or(0);
        let dropped = queue.remove(victim);
        queue.lost += 1;
        if let Some(result) = dropped.filter(|_| kind == MqttKind::Result) {
            self.forget_result(&result.message.topic);
        }
    }

    /// Drops the waiting messages up to this one: they are no longer on disk because the buffer was full, and count
    /// as lost, as after a restart. Messages in flight have probably been delivered.
    pub(super) fn drop_gone(&mut self, kind: MqttKind, through: MessageNumber) {
        let queue = self.queue_mut(kind);
        let is_older = |entry: &&Entry| entry.place.is_within(through);
        let is_gone = |entry: &Entry| !entry.in_flight && entry.place.number().is_some();
        // The places are ascending, so the loop ends at the first message that is kept.
        while let Some(index) = queue.entries.iter().take_while(is_older).position(is_gone) {
            queue.remove(index);
            queue.lost += 1;
        }
    }

    fn queue(&self, kind: MqttKind) -> &Queue {
        match kind {
            MqttKind::Result => &self.results,
            MqttKind::Event => &self.events,
            MqttKind::History => &self.history,
        }
    }

    fn queue_mut(&mut self, kind: MqttKind) -> &mut Queue {
        match kind {
            MqttKind::Result => &mut self.results,
            MqttKind::Event => &mut self.events,
            MqttKind::History => &mut self.history,
        }
    }

    /// Whether so many results wait on a topic that further commands answered there are refused.
    pub(super) fn is_crowded(&self, topic: &str) -> bool {
        self.results_of
            .get(topic)
            .is_some_and(|count| *count >= RESULTS_OF_TOPIC)
    }

    /// Number of messages of this kind that may be loaded from disk now.
    pub(super) fn room(&self, kind: MqttKind) -> usize {
        let queue = self.queue(kind);
        if queue.bytes < LOADED_BYTES {
            LOADED.saturating_sub(queue.entries.len())
        } else {
            0
        }
    }

    /// Number of the first message of this kind that is on disk and not acknowledged.
    pub(super) fn oldest(&self, kind: MqttKind) -> Option<MessageNumber> {
        self.queue(kind).entries.iter().find_map(|entry| entry.place.number())
    }

    /// Number of events, results and history that wait or are in flight.
    pub(super) fn waiting(&self) -> usize {
        self.urgent() + self.history.entries.len()
    }

    /// Number of events that wait or are in flight.
    pub(super) fn events(&self) -> usize {
        self.events.entries.len()
    }

    /// Number of results and events that wait or are in flight.
    pub(super) fn urgent(&self) -> usize {
        self.results.entries.len() + self.events.entries.len()
    }

    /// Number of messages of that kind that are nowhere else.
    pub(super) fn unkept(&self, kind: MqttKind) -> u64 {
        self.queue(kind)
            .entries
            .iter()
            .filter(|entry| entry.place.number().is_none())
            .count() as u64
    }

    /// Whether telemetry of that topic waits for its first attempt, or is in flight.
    pub(super) fn is_under_way(&self, topic: &str) -> bool {
        self.latest.get(topic).is_some_and(|slot| !slot.put_back)
    }

    /// Whether telemetry of that topic waits or is in flight.
    pub(super) fn has_telemetry(&self, topic: &str) -> bool {
        self.latest.contains_key(topic)
    }

    /// The number of messages of each kind lost since the last call.
    pub(super) fn take_lost(&mut self) -> [(MqttKind, u64); MqttKind::ALL.len()] {
        MqttKind::ALL.map(|kind| (kind, std::mem::take(&mut self.queue_mut(kind).lost)))
    }

    /// Number of messages whose acknowledgement is awaited.
    fn in_flight(&self) -> usize {
        self.published.len() + self.unacknowledged.len()
    }

    /// The message to publish next; history only if `may_history`. The message stays in the outbox until
    /// [`Outbox::mark_published`] confirms that it was published.
    pub(super) fn next(&self, window: usize, may_history: bool) -> Option<(Key, Message)> {
        let free = self.in_flight() < window;
        if self.has_leader {
            return self.next_latest(free);
        }
        let of = |kind| self.queue(kind).next(kind, free);
        let turns = (0..3).map(|step| (self.turn + step) % 3);
        let next = turns.into_iter().find_map(|turn| match turn {
            0 => of(MqttKind::Result),
            1 => of(MqttKind::Event),
            _ => self.next_latest(free),
        });
        next.or_else(|| may_history.then(|| of(MqttKind::History)).flatten())
    }

    fn next_latest(&self, free: bool) -> Option<(Key, Message)> {
        self.order.iter().find_map(|topic| {
            let slot = self.latest.get(topic).filter(|s| !s.in_flight && !s.put_back)?;
            let acknowledged = slot.lasting || self.delivery.telemetry == Qos::AtLeastOnce;
            let payload = slot.waiting.as_ref().filter(|_| free || !acknowledged)?.clone();
            let lasting = slot.lasting || payload.is_empty();
            let message = Message {
                topic: topic.clone(),
                payload,
                retain: true,
                acknowledged,
                expiry: if lasting { slot.expiry } else { self.delivery.expiry },
                correlation: None,
            };
            Some((Key::Latest(topic.clone()), message))
        })
    }

    /// Notes that the message of `key` was published on the connection; if it will not be acknowledged, its entry
    /// is removed.
    pub(super) fn mark_published(&mut self, key: Key, acknowledged: bool) -> Option<Settled> {
        match &key {
            Key::Latest(topic) => {
                if let Some(slot) = self.latest.get_mut(topic) {
                    (slot.sent, slot.in_flight) = (slot.waiting.take().filter(|_| acknowledged), true);
                }
                // The topic is at or near the front: only topics in flight precede it.
                if let Some(index) = self.order.iter().position(|t| t == topic) {
                    self.order.remove(index);
                }
                self.has_leader = false;
                self.turn = 0;
            }
            Key::Queued(kind, place) => {
                if let Some(entry) = self.queue_mut(*kind).get_mut(*place) {
                    entry.in_flight = true;
                }
                match kind {
                    MqttKind::Result => self.turn = 1,
                    MqttKind::Event => self.turn = 2,
                    MqttKind::History => {}
                }
            }
        }
        if !acknowledged {
            return self.settle(key, None);
        }
        self.published.push_back(key);
        None
    }

    /// The connection assigned this packet id to the oldest published message.
    ///
    /// # Errors
    /// If the state is inconsistent; the connection must be closed.
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

    /// Removes the entry whose message the broker acknowledged.
    pub(super) fn acked(&mut self, packet: u16) -> Option<Settled> {
        self.settle(self.unacknowledged.get(&packet).cloned()?, Some(packet))
    }

    /// The broker refused a message. If it did so only `for_now`, or the message must arrive, the message stays, to
    /// be published again after [`Outbox::retry`], and its topic is returned; otherwise [`Outbox::acked`] removes
    /// it.
    pub(super) fn put_back(&mut self, packet: u16, for_now: bool) -> Option<Arc<str>> {
        let key = self.unacknowledged.get(&packet)?.clone();
        let topic = match &key {
            Key::Latest(topic) => {
                let slot = self.latest.get_mut(topic).filter(|slot| for_now || slot.lasting)?;
                (slot.in_flight, slot.put_back) = (false, true);
                let sent = slot.sent.take();
                if slot.waiting.is_none() {
                    slot.waiting = sent;
                    self.order.push_back(topic.clone());
                }
                topic.clone()
            }
            Key::Queued(kind, place) if for_now => {
                let queue = self.queue_mut(*kind);
                let entry = queue.get_mut(*place)?;
                entry.in_flight = false;
                let topic = entry.message.topic.clone();
                queue.put_back = true;
                topic
            }
            Key::Queued(..) => return None,
        };
        self.unacknowledged.remove(&packet);
        Some(topic)
    }

    /// Lets postponed messages be published again.
    pub(super) fn retry(&mut self) {
        self.latest.values_mut().for_each(|slot| slot.put_back = false);
        for queue in [&mut self.results, &mut self.events, &mut self.history] {
            queue.put_back = false;
        }
    }

    /// Drops the message of `key`, which cannot be sent.
    pub(super) fn give_up(&mut self, key: Key) -> Option<Settled> {
        if let Key::Latest(topic) = &key {
            self.latest.get_mut(topic)?.waiting = None;
            self.order.retain(|t| t != topic);
        }
        self.settle(key, None)
    }

    fn settle(&mut self, key: Key, packet: Option<u16>) -> Option<Settled> {
        if let Some(packet) = packet {
            self.unacknowledged.remove(&packet);
        }
        match key {
            Key::Latest(topic) => {
                let slot = self.latest.get_mut(&topic)?;
                (slot.in_flight, slot.sent) = (false, None);
                if slot.waiting.is_none() {
                    self.latest.remove(&topic);
                }
                Some(Settled { topic, kind: None })
            }
            Key::Queued(kind, place) => {
                let queue = self.queue_mut(kind);
                let index = queue.index(place)?;
                let topic = queue.remove(index)?.message.topic;
                if kind == MqttKind::Result {
                    self.forget_result(&topic);
                }
                Some(Settled {
                    topic,
                    kind: Some(kind),
                })
            }
        }
    }

    fn forget_result(&mut self, topic: &Arc<str>) {
        if let Some(count) = self.results_of.get_mut(topic) {
            *count -= 1;
            if *count == 0 {
                self.results_of.remove(topic);
            }
        }
    }

    /// Handles the loss of the connection. Messages in flight wait again, in their order; telemetry is dropped, since
    /// the process image has newer values.
    pub(super) fn lost(&mut self) {
        self.latest.clear();
        self.order.clear();
        self.published.clear();
        self.unacknowledged.clear();
        self.has_leader = false;
        self.retry();
        for queue in [&mut self.results, &mut self.events, &mut self.history] {
            for entry in &mut queue.entries {
                entry.attempts = entry.attempts.saturating_add(u8::from(entry.in_flight));
                entry.in_flight = false;
            }
        }
        while let Some(index) = self.results.entries.iter().position(|e| e.attempts >= RESULT_ATTEMPTS) {
            if let Some(entry) = self.results.remove(index) {
                self.forget_result(&entry.message.topic);
                self.results.lost += 1;
            }
        }
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

impl Queue {
    fn is_full_for(&self, message: &Message, (most, bytes): (usize, usize)) -> bool {
        self.entries.len() >= most || !self.entries.is_empty() && self.bytes + message.bytes() > bytes
    }

    fn next(&self, kind: MqttKind, free: bool) -> Option<(Key, Message)> {
        let entry = self.entries.iter().find(|e| !e.in_flight).filter(|_| !self.put_back)?;
        let may = free || !entry.message.acknowledged;
        may.then(|| (Key::Queued(kind, entry.place), entry.message.clone()))
    }

    fn index(&self, place: Place) -> Option<usize> {
        self.entries.binary_search_by_key(&place, |entry| entry.place).ok()
    }

    fn get_mut(&mut self, place: Place) -> Option<&mut Entry> {
        self.entries.get_mut(self.index(place)?)
    }

    fn remove(&mut self, index: usize) -> Option<Entry> {
        let entry = self.entries.remove(index)?;
        self.bytes -= entry.message.bytes();
        Some(entry)
    }
}

#[cfg(test)]
mod tests;
