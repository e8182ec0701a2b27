//! The task that owns outbox, journal and publisher, and puts them to a connection while there is one.

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

/// First and longest wait between two attempts to connect.
const BACK_OFF: (Duration, Duration) = (Duration::from_millis(100), Duration::from_secs(5));
/// A connection that held this long was a good one: the next attempt comes soon.
const STEADY: Duration = Duration::from_secs(5);
/// No sign of life for this long: the connection is dead, whatever the socket says.
const SILENCE: Duration = KEEP_ALIVE.saturating_mul(3);
/// Time for the broker to answer a subscription.
const SUBSCRIBE_TIMEOUT: Duration = Duration::from_secs(5);
/// Topics that are logged when the broker takes no messages on them.
const REFUSED_TOLD: usize = 100;
/// Time for the good-bye.
const FAREWELL: Duration = Duration::from_millis(500);
/// Time within it for results of commands that are under way.
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
        client.pump();
    }
    client.farewell().await;
}

/// What the connection tells next; waits for ever while there is none. May be cancelled without loss.
async fn next(link: &mut BrokerLink) -> ConnectionEvent {
    match link {
        BrokerLink::Away { .. } => std::future::pending().await,
        BrokerLink::Open(session) => session.connection.next().await,
    }
}

#[derive(Debug)]
enum BrokerLink {
    /// No connection; the next attempt comes then.
    Away { until: Instant },
    /// A connection, not necessarily taken by the broker yet.
    Open(BrokerSession),
}

#[derive(Debug)]
struct BrokerSession {
    connection: Connection,
    phase: Phase,
    /// When the broker was last heard of.
    heard: Instant,
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
    /// The plant that the publisher watches.
    watched: Arc<Plant>,
    stats: Arc<NorthStats>,
    events: Receiver<Arc<Event>>,
    topics: Topics,
    publisher: Publisher,
    outbox: Outbox,
    store: EventStore,
    commands: Commands,
    link: BrokerLink,
    /// Wait before the next attempt.
    back_off: Duration,
    /// Why there is no connection, as it was last logged.
    trouble: Option<String>,
    /// Events that came too fast.
    missed: u64,
    dropped_told: u64,
    /// Topics on which the broker took no messages, as far as they were logged.
    refused_told: BTreeSet<Arc<str>>,
}

impl Client {
    async fn new(options: Options, plant: SharedPlant, stats: Arc<NorthStats>, events: Receiver<Arc<Event>>) -> Client {
        let watched = plant.load_full();
        let topics = Topics::new(&options.base, &watched.gateway);
        let mut publisher = Publisher::new(topics.clone(), options.min_interval, options.max_interval);
        publisher.adopt(&watched);
        let now = Instant::now();
        Client {
            store: EventStore::open(options.buffer.clone()).await,
            commands: Commands::new(topics.clone()),
            outbox: Outbox::default(),
            link: BrokerLink::Away { until: now },
            back_off: BACK_OFF.0,
            trouble: None,
            missed: 0,
            dropped_told: 0,
            refused_told: BTreeSet::new(),
            options,
            plant,
            watched,
            stats,
            events,
            topics,
            publisher,
        }
    }

    /// Fine enough that `min_interval` is met closely.
    fn tick_interval(&self) -> Duration {
        (self.options.min_interval / 4).clamp(Duration::from_millis(10), Duration::from_millis(25))
    }

    fn on_event(&mut self, event: Result<Arc<Event>, RecvError>) {
        match event {
            Ok(event) => self.take_event(&event),
            Err(RecvError::Lagged(lost)) => self.missed(lost),
            // The plant that told them is gone; there is a new one.
            Err(RecvError::Closed) => self.events = self.plant.load().events.subscribe(),
        }
        self.take_told();
    }

    /// Takes in at once what was told: who falls behind loses events.
    fn take_told(&mut self) {
        loop {
            match self.events.try_recv() {
                Ok(event) => self.take_event(&event),
                Err(TryRecvError::Lagged(lost)) => self.missed(lost),
                Err(TryRecvError::Empty | TryRecvError::Closed) => return,
            }
        }
    }

    fn missed(&mut self, lost: u64) {
        self.missed += lost;
        tracing::error!(
            "{lost} events came faster than they could be taken and are lost, {} since the start; the log has them",
            self.missed
        );
    }

    fn take_event(&mut self, event: &Event) {
        let Some((topic, payload)) = payload::event(&self.topics, event) else {
            return;
        };
        self.store.push(Message::not_retained(topic, payload), &mut self.outbox);
    }

    fn on_connection_event(&mut self, event: ConnectionEvent) {
        let BrokerLink::Open(session) = &mut self.link else {
            return;
        };
        if !matches!(event, ConnectionEvent::Sent(_)) {
            session.heard = Instant::now();
        }
        match event {
            ConnectionEvent::Connected(limits) => self.connected(limits),
            ConnectionEvent::Subscribed(refused) => {
                if let Some(why) = refused {
                    tracing::error!(
                        "the broker refuses the set topics ({why}): no commands by MQTT; allow the client to subscribe to {}",
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
                    self.tell_refused(topic, &format!("the broker refuses it: {why}"));
                }
                self.done(acked);
            }
            ConnectionEvent::SetMessage(publish) => self.on_command(*publish),
            ConnectionEvent::Alive => {}
            ConnectionEvent::Lost(why) => self.lost(&why),
        }
    }

    /// Once for each topic and connection.
    fn tell_refused(&mut self, topic: &Arc<str>, why: &str) {
        if self.refused_told.len() < REFUSED_TOLD && self.refused_told.insert(topic.clone()) {
            tracing::warn!("a message on {topic} is dropped: {why}");
        }
    }

    /// An entry left the outbox: the disk need not keep it.
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
            // Who reads `online` may command: first the subscription, then the birth.
            session.phase = Phase::Subscribing { limits, since };
        } else {
            self.lost("the subscription could not be sent");
        }
    }

    /// Birth: status first, then everything there is.
    fn ready(&mut self, limits: BrokerLimits, since: Instant) {
        let BrokerLink::Open(session) = &mut self.link else {
            return;
        };
        session.phase = Phase::Ready { limits, since };
        self.stats.mqtt.connected.store(true, Ordering::Relaxed);
        tracing::info!("connected to the broker at {}:{}", self.options.host, self.options.port);
        self.trouble = None;
        self.dropped_told = self.dropped();
        self.refused_told.clear();
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
        if held >= STEADY {
            self.back_off = BACK_OFF.0;
        }
        let wait = jittered(self.back_off, RandomState::new().hash_one(0));
        self.back_off = (self.back_off * 2).min(BACK_OFF.1);
        // Dropping the session ends its task and closes the socket.
        self.link = BrokerLink::Away { until: now + wait };
        self.outbox.lost();
        self.stats.mqtt.connected.store(false, Ordering::Relaxed);
        if self.trouble.as_deref() == Some(why) {
            tracing::debug!("no connection to the broker: {why}");
        } else {
            let (host, port) = (&self.options.host, self.options.port);
            let hint = if why.contains("SessionTakenOver") {
                "; another client has the same `client_id`: give each gateway a name or a `client_id` of its own"
            } else {
                ""
            };
            tracing::warn!(
                "no connection to the broker at {host}:{port}: {why}{hint}; trying again until there is one"
            );
            self.trouble = Some(why.to_string());
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
        self.follow_plant();
        match &self.link {
            BrokerLink::Away { until } if now >= *until => self.connect().await,
            BrokerLink::Away { .. } => {}
            BrokerLink::Open(session) => match session.phase {
                Phase::Subscribing { since, .. } if now.saturating_duration_since(since) > SUBSCRIBE_TIMEOUT => {
                    self.lost("the broker does not answer the subscription");
                }
                _ if now.saturating_duration_since(session.heard) > SILENCE => {
                    self.lost("the broker gives no sign of life");
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
        self.tell_dropped();
    }

    /// After a reload there is another plant.
    fn follow_plant(&mut self) {
        let plant = self.plant.load_full();
        if Arc::ptr_eq(&plant, &self.watched) {
            return;
        }
        let events = plant.events.subscribe();
        if !events.same_channel(&self.events) {
            self.take_told();
            self.events = events;
        }
        self.publisher.adopt(&plant);
        self.watched = plant;
    }

    async fn connect(&mut self) {
        let now = Instant::now();
        let options = self.options.clone();
        // Read anew for each attempt: a renewed certificate is taken without a restart.
        let config = tokio::task::spawn_blocking(move || tls::client_config(&options)).await;
        let config = config.map_err(|error| error.to_string());
        match config.and_then(|config| config.map_err(|error| error.to_string())) {
            Ok(config) => {
                let connection = Connection::open(&self.options, self.topics.status(), config);
                self.link = BrokerLink::Open(BrokerSession {
                    connection,
                    phase: Phase::Connecting,
                    heard: now,
                });
            }
            Err(why) => self.lost(&why),
        }
    }

    /// Hands over to the connection what may go.
    fn pump(&mut self) {
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
                    self.outbox.handed_over(key);
                } else {
                    break;
                }
            }
            for acked in oversized {
                if let Some(Acknowledged { topic, .. }) = &acked {
                    self.tell_refused(topic, &format!("the broker takes packets of {most} bytes at most"));
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

    /// Once for each time that the broker is away.
    fn tell_dropped(&mut self) {
        let dropped = self.dropped();
        if dropped > self.dropped_told && self.dropped_told != u64::MAX {
            tracing::warn!("the buffer is full or damaged: the oldest events or results are dropped");
            self.dropped_told = u64::MAX;
        }
    }

    /// Sends what waits, then `offline`, then says good-bye; all within half a second.
    async fn farewell(mut self) {
        self.take_told();
        let begun = tokio::time::Instant::now();
        // When the time is over the connection is cut, and the broker publishes the last will.
        let in_time = tokio::time::timeout_at(begun + FAREWELL, self.say_goodbye(begun + LAST_RESULTS)).await;
        if in_time.is_err() {
            tracing::warn!("the broker did not take the good-bye in time; it publishes the last will");
        }
        self.stats.mqtt.connected.store(false, Ordering::Relaxed);
    }

    async fn say_goodbye(&mut self, last_results: tokio::time::Instant) {
        let status = self.topics.status();
        self.options.commands = false;
        self.outbox.drop_telemetry();
        let mut offline_put = false;
        while matches!(&self.link, BrokerLink::Open(s) if matches!(s.phase, Phase::Ready { .. })) {
            self.pump();
            let quiet = self.commands.is_idle() && self.outbox.waiting() == 0;
            if !offline_put && (quiet || tokio::time::Instant::now() >= last_results) {
                self.outbox.put_first(status.as_str().into(), b"offline".to_vec());
                offline_put = true;
                continue;
            }
            if offline_put && !self.outbox.has_telemetry(&status) {
                break;
            }
            tokio::select! {
                event = next(&mut self.link), if self.commands.has_room() => self.on_connection_event(event),
                event = self.events.recv() => self.on_event(event),
                ended = self.commands.finished() => self.on_ended(ended),
                () = tokio::time::sleep_until(last_results), if !offline_put => {}
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

/// Three quarters to all of `wait`, by a random number: gateways that lost one broker do not come back in step.
fn jittered(wait: Duration, random: u64) -> Duration {
    wait.mul_f64(0.75 + 0.25 * (random as f64 / u64::MAX as f64))
}

#[cfg(test)]
mod tests;
