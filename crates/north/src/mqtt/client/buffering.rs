//! Events and history on their way to the broker: kept in memory or on disk, in order; what is lost is counted.

use super::*;

/// What an event takes on disk, bytes, at most for all but the longest texts.
const EVENT_BYTES: u64 = 512;
/// Minimum time between two log lines about lost messages.
const LOST_LOGGED: Duration = Duration::from_secs(60);

impl Client {
    pub(super) fn on_event(&mut self, event: Result<Arc<Event>, RecvError>) {
        match event {
            Ok(event) => self.store_event(&event),
            Err(RecvError::Lagged(lost)) => self.missed(lost),
            // The plant was replaced.
            Err(RecvError::Closed) => self.events = self.plant.load().events.subscribe(),
        }
        self.take_pending_events();
    }

    /// Stores all pending events at once, before newer ones displace them.
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
        self.stats.mqtt.lost(MqttLoss::Event, lost);
        tracing::error!(
            target: "drivegate::north::mqtt", "{lost} events arrived too fast and were not published, {} since the start; they are in the log",
            self.missed
        );
    }

    pub(super) fn store_event(&mut self, event: &Event) {
        // Refusals have a part of the room only, so that they push out no other event.
        if event.kind == EventKind::RefusedCommand && self.waiting_events() >= refusal_limit(&self.options) {
            self.stats.mqtt.lost(MqttLoss::Event, 1);
            return;
        }
        let (topics, payload) = payload::event(&self.topics, event, &self.plant_of(event));
        for topic in topics {
            self.keep(Kind::Event, Message::not_retained(topic, payload.clone()));
        }
        if let Some((topic, payload)) = payload::recording(&self.topics, event) {
            self.keep(Kind::Event, Message::not_retained(topic, payload));
        }
    }

    /// The plant that has the drives of an event: the newest, or the one before if a reload removed the bus.
    fn plant_of(&self, event: &Event) -> Arc<Plant> {
        let newest = self.plant.load_full();
        let has_bus = |plant: &Plant| plant.buses.iter().any(|bus| bus.image.spec.name == event.bus);
        match event.bus.is_empty() || has_bus(&newest) {
            true => newest,
            false => self.observed.clone(),
        }
    }

    /// Gives a message to the store, and to the outbox if its turn has come.
    pub(super) fn keep(&mut self, kind: Kind, message: Message) {
        let room = self.outbox.room(kind) > 0;
        let store = if kind == Kind::Event {
            &mut self.store
        } else {
            &mut self.history
        };
        if let Some((number, message)) = store.push(message, room) {
            self.outbox.push(kind, message, number);
        }
    }

    /// Keeps what was recorded and not kept yet.
    pub(super) fn keep_recorded(&mut self) {
        for Update { topic, payload } in self.publisher.recorded() {
            self.keep(Kind::History, Message::not_retained(topic, payload));
        }
    }

    pub(super) fn on_loaded(&mut self, kind: Kind, loaded: Loaded) {
        let opened = matches!(loaded, Loaded::Opened { .. });
        let store = if kind == Kind::Event {
            &mut self.store
        } else {
            &mut self.history
        };
        let (messages, topics) = store.take(loaded);
        for (number, message) in messages {
            self.outbox.push(kind, message, Some(number));
        }
        if kind == Kind::Event && opened {
            self.clear_old(topics);
            self.remember_topics();
        }
    }

    /// Clears the topics of earlier runs that are no longer published: drives that were removed, another base.
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
        self.stats.mqtt.keep_retained(topics.clone());
        self.store.remember(topics);
    }

    /// Counts what ends with this client, because there is no buffer.
    pub(super) fn count_unkept(&mut self) {
        let (events, history) = (self.outbox.unkept(Kind::Event), self.outbox.unkept(Kind::History));
        self.stats.mqtt.lost(MqttLoss::Event, events);
        self.stats.mqtt.lost(MqttLoss::History, history);
        if events + history > 0 {
            tracing::warn!(
                target: "drivegate::north::mqtt", "{} events or arrays of history that the broker did not accept are \
                    lost when the MQTT client ends; set \
                 mqtt.buffer to keep them",
                events + history
            );
        }
    }

    /// Counts what the outbox lost, and logs it once a minute.
    pub(super) fn count_lost(&mut self, now: Instant) {
        let lost = self.outbox.take_lost();
        let counts = [
            (MqttLoss::Event, lost.events),
            (MqttLoss::Result, lost.results),
            (MqttLoss::History, lost.history),
        ];
        for (kind, count) in counts {
            self.stats.mqtt.lost(kind, count);
        }
        let total: u64 = self.stats.mqtt.losses().map(|(_, count)| count).sum();
        let (logged, at) = self.lost_logged;
        if total > logged && at.is_none_or(|at| now.saturating_duration_since(at) >= LOST_LOGGED) {
            tracing::warn!(
                target: "drivegate::north::mqtt", "{} events, results or arrays of history were lost since the last such line: the buffer is full or \
                 damaged, or the broker refuses them",
                total - logged
            );
            self.lost_logged = (total, Some(now));
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

/// Refused commands are dropped while so many events wait: half of the room in memory, about half of that on disk.
pub(super) fn refusal_limit(options: &Options) -> u64 {
    let on_disk = options.buffer.as_ref().map(|buffer| buffer.max_bytes / EVENT_BYTES / 4);
    on_disk.unwrap_or(u64::MAX).min(BURST as u64 / 2)
}
