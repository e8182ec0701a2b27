//! Events and history on their way to the broker: kept in memory or on disk, in order; losses are counted.

use super::*;

/// Size of an event on disk, bytes, at most for all but the longest texts.
const EVENT_BYTES: u64 = 512;

impl PlainClient {
    pub(super) fn on_event(&mut self, event: Result<Arc<Event>, RecvError>) {
        match event {
            Ok(event) => self.store_event(&event),
            Err(RecvError::Lagged(lost)) => self.missed(lost),
            // The plant was replaced, with its events.
            Err(RecvError::Closed) => self.events = self.common.plant.load().events.subscribe(),
        }
        self.take_pending_events();
    }

    /// Stores all pending events at once, before newer ones can displace them.
    pub(super) fn take_pending_events(&mut self) {
        loop {
            match self.events.try_recv() {
                Ok(event) => self.store_event(&event),
                Err(TryRecvError::Lagged(lost)) => self.missed(lost),
                Err(TryRecvError::Empty | TryRecvError::Closed) => return,
            }
        }
    }

    /// Events in memory and on disk.
    pub(super) fn waiting_events(&self) -> u64 {
        self.outbox.events() as u64 + self.store.waiting()
    }

    pub(super) fn missed(&mut self, lost: u64) {
        self.missed += lost;
        self.common.stats.mqtt.lost(MqttKind::Event, lost);
        tracing::error!(
            target: "drivegate::north::mqtt", "{lost} events arrived too fast and were not published, {} since the start; they are in the log",
            self.missed
        );
    }

    pub(super) fn store_event(&mut self, event: &Event) {
        // Refusals may use only a part of the room, so that they displace no other event.
        if event.kind == EventKind::RefusedCommand && self.waiting_events() >= refusal_limit(&self.options) {
            self.common.stats.mqtt.lost(MqttKind::Event, 1);
            return;
        }
        let (topics, payload) = payload::event(&self.topics, event, &self.plant_of(event));
        for topic in topics {
            self.keep(MqttKind::Event, Message::not_retained(topic, payload.clone()));
        }
        if let Some((topic, payload)) = payload::recording(&self.topics, event) {
            self.keep(MqttKind::Event, Message::not_retained(topic, payload));
        }
    }

    /// The plant that has the drives of an event: the newest one, or the previous one if a reload removed the bus.
    fn plant_of(&self, event: &Event) -> Arc<Plant> {
        let newest = self.common.plant.load_full();
        let has_bus = |plant: &Plant| plant.buses.iter().any(|bus| bus.image.spec.name == event.bus);
        if event.bus.is_empty() || has_bus(&newest) {
            newest
        } else {
            self.common.observed.clone()
        }
    }

    fn store_of(&mut self, kind: MqttKind) -> &mut Store {
        match kind {
            MqttKind::History => &mut self.history,
            MqttKind::Event | MqttKind::Result => &mut self.store,
        }
    }

    /// Gives a message to the store, and to the outbox if it is next in order.
    pub(super) fn keep(&mut self, kind: MqttKind, message: Message) {
        let room = self.outbox.room(kind) > 0;
        let store = self.store_of(kind);
        if let Some((number, message)) = store.push(message, room) {
            self.outbox.push(kind, message, number);
        }
    }

    /// Stores recorded values that were not stored yet.
    pub(super) fn keep_recorded(&mut self) {
        for Update { topic, payload } in self.publisher.recorded() {
            self.keep(MqttKind::History, Message::not_retained(topic, payload));
        }
    }

    pub(super) fn on_loaded(&mut self, kind: MqttKind, loaded: Loaded) {
        let opened = matches!(loaded, Loaded::Opened { .. });
        let (messages, topics) = self.store_of(kind).take(loaded);
        for (number, message) in messages {
            self.outbox.push(kind, message, Some(number));
        }
        if kind == MqttKind::Event && opened {
            self.clear_old(topics);
            self.remember_topics();
        }
    }

    /// Clears the topics of earlier runs that are no longer published, because a drive was removed or the base
    /// topic changed.
    pub(super) fn clear_old(&mut self, topics: Vec<String>) {
        let status = self.topics.status();
        let sound = |topic: &String| !topic.is_empty() && !topic.contains(['+', '#', '\0']) && *topic != status;
        self.publisher.clear(topics.into_iter().filter(sound).map(Arc::from));
    }

    /// All topics that have a retained message, or may have one.
    pub(super) fn retained_topics(&self) -> Vec<String> {
        let topics = self.publisher.all_topics().chain(self.publisher.vanished());
        topics
            .map(|topic| topic.to_string())
            .chain([self.topics.status()])
            .collect()
    }

    /// Keeps the retained topics for the next run, with those that are still to be cleared.
    pub(super) fn remember_topics(&self) {
        let topics = self.retained_topics();
        Handover::of(&self.common.stats).lock().retained = topics.clone();
        self.store.remember(topics);
    }

    /// Counts as lost, and logs, the messages that end with the client because they are only in memory.
    pub(super) fn count_unkept(&mut self) {
        let (events, history) = (
            self.outbox.unkept(MqttKind::Event),
            self.outbox.unkept(MqttKind::History),
        );
        self.common.stats.mqtt.lost(MqttKind::Event, events);
        self.common.stats.mqtt.lost(MqttKind::History, history);
        if events + history > 0 {
            tracing::warn!(
                target: "drivegate::north::mqtt", "{} events or arrays of history that the broker did not accept are \
                    lost when the MQTT client ends; set \
                 mqtt.buffer to keep them",
                events + history
            );
        }
    }

    /// Counts the messages that the outbox lost, and logs their number once a minute.
    pub(super) fn count_lost(&mut self, now: Instant) {
        let unfollowed = (MqttKind::Result, self.commands.take_unfollowed());
        for (kind, count) in self.outbox.take_lost().into_iter().chain([unfollowed]) {
            self.common.stats.mqtt.lost(kind, count);
        }
        let total: u64 = self.common.stats.mqtt.losses().map(|(_, count)| count).sum();
        if total > self.lost_logged && self.lost.permit(now).is_some() {
            tracing::warn!(
                target: "drivegate::north::mqtt", "{} events, results or arrays of history were lost since the last such line: the buffer is full or \
                 damaged, or the broker refuses them",
                total - self.lost_logged
            );
            self.lost_logged = total;
        }
    }
}

/// The buffers of events and of history; with both, each has half.
pub(super) fn buffers(options: &Options) -> (Option<Buffer>, Option<Buffer>) {
    match (options.buffer.clone(), options.telemetry.history) {
        (None, _) => (None, None),
        (buffer, History::Off) => (buffer, None),
        (Some(Buffer { dir, max_bytes }), _) => {
            let half = Buffer {
                dir,
                max_bytes: max_bytes / 2,
            };
            (Some(half.clone()), Some(half))
        }
    }
}

/// Number of waiting events at which refused commands are dropped: half of the room in memory, or about half of that on
/// disk.
pub(super) fn refusal_limit(options: &Options) -> u64 {
    let on_disk = options.buffer.as_ref().map(|buffer| buffer.max_bytes / EVENT_BYTES / 4);
    on_disk.unwrap_or(u64::MAX).min(BURST as u64 / 2)
}
