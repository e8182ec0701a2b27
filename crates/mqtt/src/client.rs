//! The client of the plain topics: owns outbox, journal and publisher, and publishes while it is connected.

mod answers;
mod buffering;
mod discovery;
mod repair;

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant, SystemTime};

use rumqttc::mqttbytes::v5::Filter;
use tokio::sync::broadcast::Receiver;
use tokio::sync::broadcast::error::{RecvError, TryRecvError};
use tokio_util::sync::CancellationToken;

use self::buffering::buffers;
use self::discovery::{Subscribed, announcer, discovery_topics, report_refused, subscriptions};
use self::repair::Repair;
use super::broker_limits::BrokerLimits;
use super::commands::{Commands, Finished, OrdersLeft, Rules};
use super::connection::{self, Step};
use super::handover::{ClientLeft, Handover};
use super::home_assistant::{Announcer, Sources};
use super::link::BrokerLink;
use super::outbox::{Delivery, Key, Message, Outbox, Settled};
use super::payload;
use super::publisher::{PublishInterval, Publisher, Update};
use super::reply::ResponseTopics;
use super::request::Incoming;
use super::retry::Retry;
use super::session::{self, Client as _, Common, Will};
use super::store::{Loaded, Store};
use super::topics::Topics;
use super::{Buffer, History, Options};
use drivegate_core::event::{BURST, Event, EventKind};
use drivegate_core::files::names::{MQTT_EVENTS, MQTT_HISTORY};
use drivegate_core::order::Right;
use drivegate_core::plant::{Plant, SharedPlant};
use drivegate_north::log_throttle::LogThrottle;
use drivegate_north::{MqttKind, NorthState};

/// Part of the time for the orderly disconnect, for the results of pending commands.
const LAST_RESULTS: Duration = Duration::from_millis(250);
/// Time for the disk to take the last messages.
const LAST_WRITE: Duration = Duration::from_secs(1);
/// Minimum time between two messages of the history, so that live values have the connection.
const HISTORY_PACE: Duration = Duration::from_millis(50);
/// Minimum time between two log lines about messages that the broker refused.
const REFUSED_LOGGED: Duration = Duration::from_secs(60);
/// Minimum time between two log lines about lost messages.
const LOST_LOGGED: Duration = Duration::from_secs(60);

/// Messages with an expiry are renewed after their expiry time divided by this number.
const RENEWED: u32 = 2;

/// An expiry in whole seconds; an expiry of 0 would end the message at once.
fn seconds(expiry: Duration) -> u32 {
    u32::try_from(expiry.as_secs()).unwrap_or(u32::MAX).max(1)
}

/// Runs the MQTT client until `cancel`.
pub(super) async fn run(
    options: Options,
    right: Right,
    left: ClientLeft<OrdersLeft>,
    plant: SharedPlant,
    stats: Arc<NorthState>,
    events: Receiver<Arc<Event>>,
    cancel: CancellationToken,
) {
    stats.mqtt.configured.store(true, Ordering::Relaxed);
    let mut client = PlainClient::new(options, right, left, plant, stats, events);
    session::run(&mut client, cancel).await;
    client.shut_down().await;
}

struct PlainClient {
    options: Options,
    common: Common,
    events: Receiver<Arc<Event>>,
    topics: Topics,
    publisher: Publisher,
    /// The announcer for Home Assistant, if on.
    announcer: Option<Announcer>,
    /// Whether discovery messages of an earlier run were requested, or are not needed.
    leftovers_known: bool,
    /// The subscriptions of the present connection.
    subscriptions: Vec<(Subscribed, Filter)>,
    outbox: Outbox,
    store: Store,
    history: Store,
    history_at: Instant,
    commands: Commands,
    /// When `online` is published again, shortly before it expires.
    renew_at: Option<Instant>,
    /// When messages that the broker refused are published again, and log lines about them.
    retry: Retry,
    refused: LogThrottle,
    /// Number of events lost because they arrived too fast.
    missed: u64,
    /// Number of lost messages already logged, and the throttle for log lines about them.
    lost_logged: u64,
    lost: LogThrottle,
    repair: Repair,
}

impl PlainClient {
    fn new(
        options: Options,
        right: Right,
        left: ClientLeft<OrdersLeft>,
        plant: SharedPlant,
        stats: Arc<NorthState>,
        events: Receiver<Arc<Event>>,
    ) -> PlainClient {
        let ClientLeft { mut orders, broker } = left;
        let link = BrokerLink::new(
            options.clone(),
            options.client_id.clone(),
            "",
            stats.mqtt.plain.clone(),
            broker.as_ref(),
        );
        let common = Common::new(link, plant, stats);
        let (observed, stats) = (&common.observed, &common.stats);
        let topics = Topics::new(&options.base, &observed.gateway);
        // Messages are renewed before they expire.
        let most = options.message_expiry.map_or(options.max_interval, |expiry| {
            options.max_interval.min(expiry / RENEWED)
        });
        let pace = PublishInterval {
            min: options.min_interval,
            max: most,
        };
        let mut publisher = Publisher::new(topics.clone(), pace, options.telemetry, common.fresh.clone());
        let mut announcer = announcer(&options, &topics);
        publisher.adopt(observed, discovery_topics(announcer.as_mut(), observed));
        let rules = Rules {
            responses: ResponseTopics::new(&options.base, &observed.gateway, options.response_topics.clone()),
            require_id: options.require_id,
            right,
        };
        let delivery = Delivery {
            telemetry: options.telemetry_qos,
            events: options.event_qos,
            expiry: options
                .expiry
                .into_iter()
                .chain(options.message_expiry)
                .min()
                .map(seconds),
        };
        let (events_buffer, history_buffer) = buffers(&options);
        let has_buffer = events_buffer.is_some();
        let now = Instant::now();
        let results = orders.as_mut().map(|left| std::mem::take(&mut left.results));
        let commands = Commands::new(
            topics.clone(),
            rules,
            Handover::of(stats).commands.clone(),
            (stats.stop_all.clone(), Handover::of(stats).earlier_names.clone()),
            orders,
        );
        let mut client = PlainClient {
            store: Store::open(events_buffer, MQTT_EVENTS, stats, MqttKind::Event),
            history: Store::open(history_buffer, MQTT_HISTORY, stats, MqttKind::History),
            history_at: now,
            commands,
            outbox: Outbox::new(delivery),
            renew_at: None,
            retry: Retry::default(),
            refused: LogThrottle::every(REFUSED_LOGGED),
            missed: 0,
            lost_logged: 0,
            lost: LogThrottle::every(LOST_LOGGED),
            repair: Repair::default(),
            options,
            common,
            events,
            topics,
            publisher,
            announcer,
            leftovers_known: has_buffer,
            subscriptions: Vec::new(),
        };
        client.take_over();
        for result in results.into_iter().flatten() {
            client.outbox.push_result(result);
        }
        client
    }

    /// Notes that a message left the outbox.
    fn settled(&mut self, settled: Option<Settled>) {
        let Some(Settled { topic, kind }) = settled else { return };
        match kind {
            Some(MqttKind::Event) => self.store.acknowledge(self.outbox.oldest(MqttKind::Event)),
            Some(MqttKind::History) => self.history.acknowledge(self.outbox.oldest(MqttKind::History)),
            None if self.publisher.was_cleared(&topic) => self.remember_topics(),
            Some(MqttKind::Result) | None => {}
        }
    }

    fn publish_online(&mut self) {
        let expiry = self.options.message_expiry;
        self.renew_at = expiry.map(|expiry| Instant::now() + expiry / RENEWED);
        self.outbox
            .put_first(self.topics.status().into(), b"online".to_vec(), expiry.map(seconds));
    }

    fn on_set_topic(&mut self, message: Incoming) {
        let plant = self.common.plant.load();
        let crowded = |topic: &str| self.outbox.is_crowded(topic);
        if self.options.commands
            && let Some(result) = self
                .commands
                .take(message, &plant, crowded, Instant::now(), SystemTime::now())
        {
            self.outbox.push_result(result);
        }
    }

    /// Notes a status that another client published in the gateway's name, such as the last will of an earlier connection.
    fn on_status(&mut self, payload: &[u8]) {
        if payload != b"online" {
            self.repair.ask();
            self.repair_status(Instant::now());
        }
    }

    /// Publishes `online` again if another status was published, or if it would expire.
    fn repair_status(&mut self, now: Instant) {
        let renews = self.renew_at.is_some_and(|at| now >= at);
        if self.is_alive() && (self.repair.take(now) || renews) {
            self.publish_online();
        }
    }

    fn on_ended(&mut self, ended: Finished) {
        let result = self.commands.answer(ended, SystemTime::now());
        self.outbox.push_result(result);
    }

    fn send(&mut self, limits: BrokerLimits) {
        let now = Instant::now();
        while self.common.link.is_up()
            && let Some((key, message)) = self.outbox.next(limits.window, now >= self.history_at)
        {
            if connection::packet_size(&message) > limits.max_packet {
                let settled = self.outbox.give_up(key);
                let why = format!(
                    "the broker accepts at most {} bytes per packet; raise its limit",
                    limits.max_packet
                );
                self.drop_refused(settled.as_ref(), &why);
                self.settled(settled);
                continue;
            }
            let acknowledged = message.acknowledged && limits.acknowledges;
            if !self.common.link.publish(message) {
                break;
            }
            if matches!(key, Key::Queued(MqttKind::History, _)) {
                self.history_at = now + HISTORY_PACE;
            }
            let settled = self.outbox.mark_published(key, acknowledged);
            if settled.is_some() {
                self.common.stats.mqtt.published.fetch_add(1, Ordering::Relaxed);
            }
            self.settled(settled);
        }
    }

    /// Ends the client: the commands that are in progress, then the connection. The next client then sends the results that
    /// are still due.
    async fn shut_down(mut self) {
        self.take_pending_events();
        self.announcer = None;
        self.outbox.drop_telemetry();
        session::end(&mut self).await;
        self.common.stats.mqtt.connected.store(false, Ordering::Relaxed);
        self.common.stats.mqtt.configured.store(false, Ordering::Relaxed);
        self.keep_recorded();
        self.count_unkept();
        let close = async { tokio::join!(self.store.close(), self.history.close()) };
        if tokio::time::timeout(LAST_WRITE, close).await.is_err() {
            tracing::warn!(target: "drivegate::north::mqtt", "the MQTT buffer is too slow: the last messages may be missing after a restart");
        }
        // The client that follows after a reload continues with these events.
        let handover = Handover::of(&self.common.stats);
        let mut left = handover.lock();
        left.unread = Some(self.events);
        left.client = ClientLeft {
            orders: Some(self.commands.leave(self.outbox.into_results())),
            broker: Some(self.common.link.broker()),
        };
    }
}

impl session::Client for PlainClient {
    fn common(&mut self) -> &mut Common {
        &mut self.common
    }

    async fn next(&mut self) -> Step {
        tokio::select! {
            step = self.common.link.next() => return step,
            event = self.events.recv() => self.on_event(event),
            ended = self.commands.finished() => self.on_ended(ended),
            loaded = self.store.next() => self.on_loaded(MqttKind::Event, loaded),
            loaded = self.history.next() => self.on_loaded(MqttKind::History, loaded),
        }
        Step::Nothing
    }

    async fn will(&mut self) -> Will {
        Will {
            topic: self.topics.status(),
            payload: b"offline".to_vec(),
            retain: true,
        }
    }

    fn filters(&mut self, limits: BrokerLimits) -> Vec<Filter> {
        let plant = (!limits.wildcards).then_some(self.common.observed.as_ref());
        self.subscriptions = subscriptions(
            &self.topics,
            self.options.commands,
            self.options.principals.as_deref(),
            self.announcer.as_ref(),
            self.leftovers_known,
            plant,
        );
        self.subscriptions.iter().map(|(_, filter)| filter.clone()).collect()
    }

    fn answered(&mut self, refused: &[Option<String>]) {
        report_refused(&self.subscriptions, refused);
    }

    /// Publishes the status, then everything else. A client that reads `online` may send commands, so the
    /// subscriptions were made before.
    fn ready(&mut self, limits: BrokerLimits) {
        self.common.stats.mqtt.connected.store(true, Ordering::Relaxed);
        self.common.link.log_ready(limits, "");
        self.repair.forget();
        self.publish_online();
        self.keep_recorded();
        self.publisher.restart(limits.max_packet);
        if let Some(announcer) = &mut self.announcer {
            announcer.restart(limits.max_packet);
        }
        self.leftovers_known = true;
        self.common.look_at = Instant::now();
    }

    fn on_message(&mut self, message: Incoming) {
        if message.topic == self.topics.status() {
            self.on_status(&message.payload);
        } else if !self.on_discovery(&message) {
            self.on_set_topic(message);
        }
    }

    fn on_delivery(&mut self, step: Step) {
        match step {
            Step::Sent(packet) => {
                if let Err(why) = self.outbox.numbered(packet) {
                    session::give_up(self, why);
                }
            }
            Step::Acked(packet) => {
                self.common.stats.mqtt.published.fetch_add(1, Ordering::Relaxed);
                let settled = self.outbox.acked(packet);
                self.settled(settled);
            }
            Step::Refused(packet, why) => self.refused(packet, why),
            _ => {}
        }
    }

    fn is_alive(&self) -> bool {
        self.common.link.ready().is_some()
    }

    fn down(&mut self) {
        self.outbox.lost();
        self.common.look_at = Instant::now();
        self.common.stats.mqtt.connected.store(false, Ordering::Relaxed);
    }

    fn adopt(&mut self, plant: Arc<Plant>) {
        // The last events of a removed bus find its drives in the plant before.
        self.take_pending_events();
        let events = plant.events.subscribe();
        if !events.same_channel(&self.events) {
            self.events = events;
        }
        // The publisher starts again with this plant.
        self.keep_recorded();
        let discovery = discovery_topics(self.announcer.as_mut(), &plant);
        self.publisher.adopt(&plant, discovery);
        self.common.observed = plant;
        self.remember_topics();
    }

    fn check(&mut self, now: Instant) {
        self.repair_status(now);
        if self.retry.is_due(now) {
            self.outbox.retry();
        }
        // Retries messages for which the disk had no room the last time.
        self.store.acknowledge(self.outbox.oldest(MqttKind::Event));
        self.history.acknowledge(self.outbox.oldest(MqttKind::History));
        self.count_lost(now);
    }

    fn publish_due(&mut self) {
        let (now, wall) = (Instant::now(), SystemTime::now());
        self.common.look_at = match (self.is_alive(), self.options.telemetry.history) {
            (true, _) => {
                // Without the retain flag nothing would be cleared; the topics wait for a connection with it.
                if self.common.link.ready().is_some_and(|limits| limits.retains) {
                    for topic in self.publisher.cleared() {
                        self.outbox.put_lasting(topic, Vec::new());
                    }
                }
                let (updates, next) = self.publisher.tick(now, wall);
                for Update { topic, payload } in updates {
                    self.outbox.put(topic, payload);
                }
                for line in self.publisher.take_reduced() {
                    tracing::warn!(target: "drivegate::north::mqtt", "broker {}: {line}", self.common.link.broker());
                }
                next
            }
            (false, History::Off) => now + session::CHECK,
            (false, _) => {
                let (updates, next) = self.publisher.record(now, wall);
                for Update { topic, payload } in updates {
                    self.keep(MqttKind::History, Message::not_retained(topic, payload));
                }
                next
            }
        };
    }

    fn publish(&mut self) {
        self.outbox.drop_gone(MqttKind::Event, self.store.gone());
        self.outbox.drop_gone(MqttKind::History, self.history.gone());
        self.store.load(self.outbox.room(MqttKind::Event));
        if let Some(limits) = self.common.link.ready() {
            self.history.load(self.outbox.room(MqttKind::History));
            self.announce();
            self.send(limits);
        }
        let waiting = self.outbox.waiting() as u64 + self.store.waiting() + self.history.waiting();
        self.common.stats.mqtt.buffered.store(waiting, Ordering::Relaxed);
    }

    fn is_idle(&self) -> bool {
        self.commands.is_idle()
    }

    /// Sends the waiting messages, then `offline`.
    async fn say_goodbye(&mut self) -> bool {
        let status: Arc<str> = self.topics.status().into();
        let last_results = tokio::time::Instant::now() + LAST_RESULTS;
        let mut queued = false;
        while self.is_alive() {
            self.publish();
            let quiet = self.commands.is_idle() && self.outbox.urgent() == 0;
            if !queued && (quiet || tokio::time::Instant::now() >= last_results) {
                self.outbox.put_first(status.clone(), b"offline".to_vec(), None);
                queued = true;
                continue;
            }
            if queued && !self.outbox.has_telemetry(&status) {
                break;
            }
            tokio::select! {
                step = self.next() => session::apply(self, step),
                () = tokio::time::sleep_until(last_results), if !queued => {}
            }
        }
        true
    }
}

#[cfg(test)]
pub(super) mod tests;
