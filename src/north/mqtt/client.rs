//! The task that owns outbox, journal and publisher, and publishes while there is a connection.

use std::collections::BTreeSet;
use std::hash::{BuildHasher, RandomState};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant, SystemTime};

use rumqttc::v5::mqttbytes::v5::Publish;
use tokio::sync::broadcast::Receiver;
use tokio::sync::broadcast::error::{RecvError, TryRecvError};
use tokio::time::MissedTickBehavior;
use tokio_util::sync::CancellationToken;

use super::commands::{Commands, FinishedCommand};
use super::connection::{self, BrokerLimits, Connection, ConnectionEvent, KEEP_ALIVE};
use super::outbox::{Acknowledged, Message, Outbox};
use super::payload::{self, Topics};
use super::publisher::Publisher;
use super::request::Incoming;
use super::store::EventStore;
use super::{Options, tls};
use crate::event::Event;
use crate::north::NorthStats;
use crate::plant::{Plant, SharedPlant};

/// First and longest wait between two connection attempts.
const BACK_OFF: (Duration, Duration) = (Duration::from_millis(100), Duration::from_secs(5));
/// After a connection that lasted this long, the next attempt follows after the shortest wait.
const STABLE: Duration = Duration::from_secs(5);
/// Without a packet from the broker for this long, the connection is considered lost.
const SILENCE: Duration = KEEP_ALIVE.saturating_mul(3);
/// Time limit for the broker to answer the subscription.
const SUBSCRIBE_TIMEOUT: Duration = Duration::from_secs(5);
/// Maximum number of topics that are logged because the broker refuses messages on them.
const REFUSED_LOGGED: usize = 100;
/// Time for the orderly disconnect.
const DISCONNECT_TIMEOUT: Duration = Duration::from_millis(500);
/// Part of it for the results of pending commands.
const LAST_RESULTS: Duration = Duration::from_millis(250);

/// Runs the MQTT client until `cancel`.
pub(super) async fn run(
    options: Options,
    plant: SharedPlant,
    stats: Arc<NorthStats>,
    events: Receiver<Arc<Event>>,
    cancel: CancellationToken,
) {
    let mut client = Client::new(options, plant, stats, events).await;
    let mut ticks = tokio::time::interval(client.tick_interval());
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        tokio::select! {
            () = cancel.cancelled() => break,
            event = client.events.recv() => client.on_event(event),
            event = next(&mut client.link), if client.commands.has_room() => client.on_connection_event(event),
            ended = client.commands.finished() => client.on_ended(ended),
            _ = ticks.tick() => client.on_tick().await,
        }
        client.publish_waiting();
    }
    client.shut_down().await;
}

/// The next event of the connection; pending while there is none. Cancel safe.
async fn next(link: &mut BrokerLink) -> ConnectionEvent {
    match link {
        BrokerLink::Disconnected { .. } => std::future::pending().await,
        BrokerLink::Open(session) => session.connection.next().await,
    }
}

#[derive(Debug)]
enum BrokerLink {
    /// No connection; the next attempt follows then.
    Disconnected { retry_at: Instant },
    /// A connection that the broker may not have accepted yet.
    Open(BrokerSession),
}

#[derive(Debug)]
struct BrokerSession {
    connection: Connection,
    phase: Phase,
    /// Time of the last packet from the broker.
    last_packet: Instant,
}

#[derive(Debug, Clone, Copy)]
enum Phase {
    Connecting,
    Subscribing { limits: BrokerLimits, since: Instant },
    Ready { limits: BrokerLimits, since: Instant },
}

struct Client {
    options: Options,
    plant: SharedPlant,
    /// The plant that the publisher observes.
    observed: Arc<Plant>,
    stats: Arc<NorthStats>,
    events: Receiver<Arc<Event>>,
    topics: Topics,
    publisher: Publisher,
    outbox: Outbox,
    store: EventStore,
    commands: Commands,
    link: BrokerLink,
    /// Wait before the next connection attempt.
    back_off: Duration,
    /// Why there is no connection, as last logged.
    last_error: Option<String>,
    /// Number of events lost because they arrived too fast.
    missed: u64,
    dropped_logged: u64,
    /// Topics that were logged because the broker refuses messages on them.
    refused_logged: BTreeSet<Arc<str>>,
}

impl Client {
    async fn new(options: Options, plant: SharedPlant, stats: Arc<NorthStats>, events: Receiver<Arc<Event>>) -> Client {
        let observed = plant.load_full();
        let topics = Topics::new(&options.base, &observed.gateway);
        let mut publisher = Publisher::new(topics.clone(), options.min_interval, options.max_interval);
        publisher.adopt(&observed);
        let now = Instant::now();
        Client {
            store: EventStore::open(options.buffer.clone()).await,
            commands: Commands::new(topics.clone()),
            outbox: Outbox::default(),
            link: BrokerLink::Disconnected { retry_at: now },
            back_off: BACK_OFF.0,
            last_error: None,
            missed: 0,
            dropped_logged: 0,
            refused_logged: BTreeSet::new(),
            options,
            plant,
            observed,
            stats,
            events,
            topics,
            publisher,
        }
    }

    /// Short enough to keep `min_interval` accurately.
    fn tick_interval(&self) -> Duration {
        (self.options.min_interval / 4).clamp(Duration::from_millis(10), Duration::from_millis(25))
    }

    fn on_event(&mut self, event: Result<Arc<Event>, RecvError>) {
        match event {
            Ok(event) => self.store_event(&event),
            Err(RecvError::Lagged(lost)) => self.missed(lost),
            // The plant was replaced.
            Err(RecvError::Closed) => self.events = self.plant.load().events.subscribe(),
        }
        self.take_pending_events();
    }

    /// Stores all pending events at once, before newer ones displace them.
    fn take_pending_events(&mut self) {
        loop {
            match self.events.try_recv() {
                Ok(event) => self.store_event(&event),
                Err(TryRecvError::Lagged(lost)) => self.missed(lost),
                Err(TryRecvError::Empty | TryRecvError::Closed) => return,
            }
        }
    }

    fn missed(&mut self, lost: u64) {
        self.missed += lost;
        tracing::error!(
            "{lost} events arrived too fast and were not published, {} since the start; they are in the log",
            self.missed
        );
    }

    fn store_event(&mut self, event: &Event) {
        let Some((topic, payload)) = payload::event(&self.topics, event) else {
            return;
        };
        self.store.push(Message::not_retained(topic, payload), &mut self.outbox);
        if let Some((topic, payload)) = payload::recording(&self.topics, event) {
            self.store.push(Message::not_retained(topic, payload), &mut self.outbox);
        }
    }

    fn on_connection_event(&mut self, event: ConnectionEvent) {
        let BrokerLink::Open(session) = &mut self.link else {
            return;
        };
        if !matches!(event, ConnectionEvent::Sent(_)) {
            session.last_packet = Instant::now();
        }
        match event {
            ConnectionEvent::Connected(limits) => self.connected(limits),
            ConnectionEvent::Subscribed(refused) => {
                if let Some(why) = refused {
                    tracing::error!(
                        "the broker refuses the set topics ({why}): no commands over MQTT; allow the client to subscribe to {}",
                        self.topics.set_filters().join(" and ")
                    );
                }
                if let Phase::Subscribing { limits, since } = session.phase {
                    self.ready(limits, since);
                }
            }
            ConnectionEvent::Sent(packet) => {
                if let Err(why) = self.outbox.numbered(packet) {
                    self.lost(why);
                }
            }
            ConnectionEvent::Acked(packet) => {
                self.stats.mqtt.published.fetch_add(1, Ordering::Relaxed);
                let acked = self.outbox.acked(packet);
                self.done(acked);
            }
            ConnectionEvent::Refused(packet, why) => {
                let acked = self.outbox.acked(packet);
                if let Some(Acknowledged { topic, .. }) = &acked {
                    self.log_refused(topic, &format!("the broker refuses it: {why}"));
                }
                self.done(acked);
            }
            ConnectionEvent::SetMessage(publish) => self.on_command(*publish),
            ConnectionEvent::Alive => {}
            ConnectionEvent::Lost(why) => self.lost(&why),
        }
    }

    /// Logs once per topic and connection.
    fn log_refused(&mut self, topic: &Arc<str>, why: &str) {
        if self.refused_logged.len() < REFUSED_LOGGED && self.refused_logged.insert(topic.clone()) {
            tracing::warn!("dropped a message on {topic}: {why}");
        }
    }

    /// Removes the record of a message that left the outbox.
    fn done(&mut self, acked: Option<Acknowledged>) {
        if let Some(record) = acked.and_then(|a| a.record) {
            self.store.acknowledge(record);
        }
    }

    fn connected(&mut self, limits: BrokerLimits) {
        let since = Instant::now();
        let BrokerLink::Open(session) = &mut self.link else {
            return;
        };
        if !self.options.commands {
            self.ready(limits, since);
        } else if session.connection.subscribe(self.topics.set_filters()) {
            // A client that reads `online` may send commands, so the subscription comes first.
            session.phase = Phase::Subscribing { limits, since };
        } else {
            self.lost("the subscription could not be sent");
        }
    }

    /// Publishes the status, then everything else.
    fn ready(&mut self, limits: BrokerLimits, since: Instant) {
        let BrokerLink::Open(session) = &mut self.link else {
            return;
        };
        session.phase = Phase::Ready { limits, since };
        self.stats.mqtt.connected.store(true, Ordering::Relaxed);
        tracing::info!("connected to the broker at {}:{}", self.options.host, self.options.port);
        self.last_error = None;
        self.dropped_logged = self.dropped();
        self.refused_logged.clear();
        self.outbox.put_first(self.topics.status().into(), b"online".to_vec());
        self.publisher.restart();
    }

    fn lost(&mut self, why: &str) {
        let now = Instant::now();
        let held = match &self.link {
            BrokerLink::Open(BrokerSession {
                phase: Phase::Ready { since, .. },
                ..
            }) => now.saturating_duration_since(*since),
            _ => Duration::ZERO,
        };
        if held >= STABLE {
            self.back_off = BACK_OFF.0;
        }
        let wait = jittered(self.back_off, RandomState::new().hash_one(0));
        self.back_off = (self.back_off * 2).min(BACK_OFF.1);
        // Dropping the session aborts its task and closes the socket.
        self.link = BrokerLink::Disconnected { retry_at: now + wait };
        self.outbox.lost();
        self.stats.mqtt.connected.store(false, Ordering::Relaxed);
        if self.last_error.as_deref() == Some(why) {
            tracing::debug!("no connection to the broker: {why}");
        } else {
            let (host, port) = (&self.options.host, self.options.port);
            let hint = if why.contains("SessionTakenOver") {
                "; another client has the same `client_id`: give each gateway a name or a `client_id` of its own"
            } else {
                ""
            };
            tracing::warn!("no connection to the broker at {host}:{port}: {why}{hint}; reconnecting");
            self.last_error = Some(why.to_string());
        }
    }

    fn on_command(&mut self, publish: Publish) {
        let properties = publish.properties.unwrap_or_default();
        let Ok(topic) = String::from_utf8(publish.topic.to_vec()) else {
            return;
        };
        let incoming = Incoming {
            topic,
            payload: publish.payload.to_vec(),
            retain: publish.retain,
            dup: publish.dup,
            packet: publish.pkid,
            response_topic: properties.response_topic,
            correlation: properties.correlation_data.map(|data| data.to_vec()),
            expiry: properties.message_expiry_interval,
        };
        let plant = self.plant.load();
        if self.options.commands
            && let Some(result) = self.commands.take(incoming, &plant, Instant::now(), SystemTime::now())
        {
            self.outbox.push_result(result);
        }
    }

    fn on_ended(&mut self, ended: FinishedCommand) {
        let result = self.commands.result(ended, SystemTime::now());
        self.outbox.push_result(result);
    }

    async fn on_tick(&mut self) {
        let now = Instant::now();
        self.update_plant();
        match &self.link {
            BrokerLink::Disconnected { retry_at } if now >= *retry_at => self.connect().await,
            BrokerLink::Disconnected { .. } => {}
            BrokerLink::Open(session) => match session.phase {
                Phase::Subscribing { since, .. } if now.saturating_duration_since(since) > SUBSCRIBE_TIMEOUT => {
                    self.lost("the broker does not answer the subscription");
                }
                _ if now.saturating_duration_since(session.last_packet) > SILENCE => {
                    self.lost("the broker is silent");
                }
                Phase::Ready { .. } => {
                    for update in self.publisher.tick(now, SystemTime::now()) {
                        self.outbox.put(update.topic, update.payload);
                    }
                }
                _ => {}
            },
        }
        self.store.sync(now);
        self.log_dropped();
    }

    /// Observes the current plant, which a reload may have replaced.
    fn update_plant(&mut self) {
        let plant = self.plant.load_full();
        if Arc::ptr_eq(&plant, &self.observed) {
            return;
        }
        let events = plant.events.subscribe();
        if !events.same_channel(&self.events) {
            self.take_pending_events();
            self.events = events;
        }
        self.publisher.adopt(&plant);
        self.observed = plant;
    }

    async fn connect(&mut self) {
        let now = Instant::now();
        let options = self.options.clone();
        // Read for each attempt, so that renewed certificates are used without a restart.
        let config = tokio::task::spawn_blocking(move || tls::client_config(&options)).await;
        let config = config.map_err(|error| error.to_string());
        match config.and_then(|config| config.map_err(|error| error.to_string())) {
            Ok(config) => {
                let connection = Connection::open(&self.options, self.topics.status(), config);
                self.link = BrokerLink::Open(BrokerSession {
                    connection,
                    phase: Phase::Connecting,
                    last_packet: now,
                });
            }
            Err(why) => self.lost(&why),
        }
    }

    /// Publishes from the outbox as far as the connection allows.
    fn publish_waiting(&mut self) {
        self.store.refill(&mut self.outbox);
        if let BrokerLink::Open(BrokerSession {
            connection,
            phase: Phase::Ready { limits, .. },
            ..
        }) = &self.link
        {
            let most = limits.max_packet;
            let mut oversized = Vec::new();
            while let Some((key, message)) = self.outbox.next(limits.limit) {
                if connection::packet_size(&message) > most {
                    oversized.push(self.outbox.give_up(key));
                } else if connection.publish(message) {
                    self.outbox.mark_published(key);
                } else {
                    break;
                }
            }
            for acked in oversized {
                if let Some(Acknowledged { topic, .. }) = &acked {
                    self.log_refused(topic, &format!("the broker accepts at most {most} bytes per packet"));
                }
                self.done(acked);
            }
        }
        let waiting = self.outbox.waiting() as u64 + self.store.waiting();
        self.stats.mqtt.buffered.store(waiting, Ordering::Relaxed);
    }

    fn dropped(&self) -> u64 {
        self.outbox.dropped() + self.store.dropped()
    }

    /// Logs once per connection outage.
    fn log_dropped(&mut self) {
        let dropped = self.dropped();
        if dropped > self.dropped_logged && self.dropped_logged != u64::MAX {
            tracing::warn!("the buffer is full or damaged: dropping the oldest events or results");
            self.dropped_logged = u64::MAX;
        }
    }

    /// Sends what is waiting, publishes `offline` and disconnects, all within half a second.
    async fn shut_down(mut self) {
        self.take_pending_events();
        let begun = tokio::time::Instant::now();
        // After that time the connection is closed, and the broker publishes the last will.
        let in_time = tokio::time::timeout_at(begun + DISCONNECT_TIMEOUT, self.disconnect(begun + LAST_RESULTS)).await;
        if in_time.is_err() {
            tracing::warn!("the orderly disconnect from the broker timed out; the broker publishes the last will");
        }
        self.stats.mqtt.connected.store(false, Ordering::Relaxed);
    }

    async fn disconnect(&mut self, last_results: tokio::time::Instant) {
        let status = self.topics.status();
        self.options.commands = false;
        self.outbox.drop_telemetry();
        let mut offline_queued = false;
        while matches!(&self.link, BrokerLink::Open(s) if matches!(s.phase, Phase::Ready { .. })) {
            self.publish_waiting();
            let quiet = self.commands.is_idle() && self.outbox.waiting() == 0;
            if !offline_queued && (quiet || tokio::time::Instant::now() >= last_results) {
                self.outbox.put_first(status.as_str().into(), b"offline".to_vec());
                offline_queued = true;
                continue;
            }
            if offline_queued && !self.outbox.has_telemetry(&status) {
                break;
            }
            tokio::select! {
                event = next(&mut self.link), if self.commands.has_room() => self.on_connection_event(event),
                event = self.events.recv() => self.on_event(event),
                ended = self.commands.finished() => self.on_ended(ended),
                () = tokio::time::sleep_until(last_results), if !offline_queued => {}
            }
        }
        if let BrokerLink::Open(session) = &mut self.link
            && !matches!(session.phase, Phase::Connecting)
            && session.connection.disconnect()
        {
            while !matches!(session.connection.next().await, ConnectionEvent::Lost(_)) {}
        }
    }
}

/// 75 to 100 % of `wait`, by a random number, so that gateways do not reconnect to a broker at the same time.
fn jittered(wait: Duration, random: u64) -> Duration {
    wait.mul_f64(0.75 + 0.25 * (random as f64 / u64::MAX as f64))
}

#[cfg(test)]
mod tests;
