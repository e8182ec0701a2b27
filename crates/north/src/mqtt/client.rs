//! The task that owns outbox, journal and publisher, and publishes while there is a connection.

mod answers;
mod buffering;
mod discovery;
mod repair;

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant, SystemTime};

use tokio::sync::Notify;
use tokio::sync::broadcast::Receiver;
use tokio::sync::broadcast::error::{RecvError, TryRecvError};
use tokio_util::sync::CancellationToken;

use self::buffering::buffers;
use self::discovery::{announcer, discovery_topics, report_refused};
use self::repair::Repair;
use super::broker_limits::BrokerLimits;
use super::commands::{Commands, Finished, Rules};
use super::connection::{self, ConnectionEvent, Subscription};
use super::home_assistant::{Announcer, Sources};
use super::link::{BrokerLink, Due, Step};
use super::outbox::{Delivery, Key, Kind, Message, Outbox, Settled};
use super::payload;
use super::publisher::{Publisher, Update};
use super::reply::ResponseTopics;
use super::request::Incoming;
use super::retry::Retry;
use super::store::{Loaded, LostCount, Store};
use super::topics::Topics;
use super::{Buffer, History, Options};
use crate::event::{BURST, Event, EventKind};
use crate::files::names::{MQTT_EVENTS, MQTT_HISTORY};
use crate::log_throttle::LogThrottle;
use crate::plant::{Plant, SharedPlant};
use crate::stats::LinkOf;
use crate::{MqttLoss, NorthState};

/// Maximum time between two checks of the connection, the plant and the buffer.
const CHECK: Duration = Duration::from_millis(25);
/// Time for the orderly disconnect.
const DISCONNECT_TIMEOUT: Duration = Duration::from_millis(500);
/// Part of it for the results of pending commands.
const LAST_RESULTS: Duration = Duration::from_millis(250);
/// Time for the commands that are in progress when a reload ends the client. When the gateway stops they have ended
/// before.
const LAST_COMMANDS: Duration = Duration::from_secs(3);
/// Time for the disk to take the last messages.
const LAST_WRITE: Duration = Duration::from_secs(1);
/// Minimum time between two messages of the history, so that live values have the connection.
const HISTORY_PACE: Duration = Duration::from_millis(50);
/// Minimum time between two log lines about messages that the broker refused.
const REFUSED_LOGGED: Duration = Duration::from_secs(60);

/// Expiring messages are renewed after this fraction of their time.
const RENEWED: u32 = 2;

/// An expiry in whole seconds: 0 would mean at once.
fn seconds(expiry: Duration) -> u32 {
    u32::try_from(expiry.as_secs()).unwrap_or(u32::MAX).max(1)
}

/// Runs the MQTT client until `cancel`.
pub(super) async fn run(
    options: Options,
    plant: SharedPlant,
    stats: Arc<NorthState>,
    events: Receiver<Arc<Event>>,
    cancel: CancellationToken,
) {
    stats.mqtt.configured.store(true, Ordering::Relaxed);
    let mut client = Client::new(options, plant, stats, events);
    loop {
        let look_at = tokio::time::Instant::from_std(client.look_at);
        tokio::select! {
            () = cancel.cancelled() => break,
            event = client.events.recv() => client.on_event(event),
            event = client.link.next(), if client.receives() => client.on_connection_event(event),
            ended = client.commands.finished() => client.on_ended(ended),
            loaded = client.store.next() => client.on_loaded(Kind::Event, loaded),
            loaded = client.history.next() => client.on_loaded(Kind::History, loaded),
            () = client.fresh.notified() => client.look(),
            () = tokio::time::sleep_until(look_at) => client.on_time().await,
        }
        client.publish_waiting();
    }
    client.shut_down().await;
}

struct Client {
    options: Options,
    plant: SharedPlant,
    /// The plant that the publisher observes.
    observed: Arc<Plant>,
    stats: Arc<NorthState>,
    events: Receiver<Arc<Event>>,
    topics: Topics,
    publisher: Publisher,
    /// The announcer for Home Assistant, if on.
    announcer: Option<Announcer>,
    /// Whether discovery messages of an earlier run were requested, or are not needed.
    leftovers_known: bool,
    /// The subscriptions of the present connection.
    subscriptions: Vec<Subscription>,
    /// Woken when a drive was updated.
    fresh: Arc<Notify>,
    /// When the publisher, and when everything else is looked at again at the latest.
    look_at: Instant,
    check_at: Instant,
    outbox: Outbox,
    store: Store,
    history: Store,
    history_at: Instant,
    commands: Commands,
    link: BrokerLink,
    /// When `online` is published again, before it expires.
    renew_at: Option<Instant>,
    /// When messages that the broker refused are published again, and log lines about them.
    retry: Retry,
    refused: LogThrottle,
    /// Number of events lost because they arrived too fast.
    missed: u64,
    /// How many lost messages were logged, and when.
    lost_logged: (u64, Option<Instant>),
    repair: Repair,
}

impl Client {
    fn new(options: Options, plant: SharedPlant, stats: Arc<NorthState>, events: Receiver<Arc<Event>>) -> Client {
        let observed = plant.load_full();
        let topics = Topics::new(&options.base, &observed.gateway);
        let fresh = Arc::new(Notify::new());
        // What expires is renewed before.
        let most = options.message_expiry.map_or(options.max_interval, |expiry| {
            options.max_interval.min(expiry / RENEWED)
        });
        let intervals = (options.min_interval, most);
        let mut publisher = Publisher::new(topics.clone(), intervals, options.telemetry, fresh.clone());
        let mut announcer = announcer(&options, &topics);
        publisher.adopt(&observed, discovery_topics(announcer.as_mut(), &observed));
        let rules = Rules {
            responses: ResponseTopics::new(&options.base, &observed.gateway, options.response_topics.clone()),
            require_id: options.require_id,
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
        let count = |kind| LostCount(stats.clone(), kind);
        let now = Instant::now();
        let kept = stats.mqtt.keep_broker(LinkOf::Topics, None);
        let (topics_of_commands, memory) = (topics.clone(), stats.taken.clone());
        let (commands, results) = match stats.mqtt.keep_orders(None) {
            Some(mut left) => {
                let results = std::mem::take(&mut left.results);
                (Commands::after(topics_of_commands, rules, memory, left), results)
            }
            None => (Commands::new(topics_of_commands, rules, memory), Vec::new()),
        };
        let mut client = Client {
            store: Store::open(events_buffer, MQTT_EVENTS, count(MqttLoss::Event)),
            history: Store::open(history_buffer, MQTT_HISTORY, count(MqttLoss::History)),
            history_at: now,
            commands,
            outbox: Outbox::new(delivery),
            link: BrokerLink::new(options.clone(), options.client_id.clone(), "", kept.as_ref()),
            renew_at: None,
            retry: Retry::default(),
            refused: LogThrottle::every(REFUSED_LOGGED),
            missed: 0,
            lost_logged: (0, None),
            repair: Repair::default(),
            options,
            plant,
            observed,
            stats,
            events,
            topics,
            publisher,
            announcer,
            leftovers_known: has_buffer,
            subscriptions: Vec::new(),
            fresh,
            look_at: now,
            check_at: now,
        };
        client.take_over();
        results.into_iter().for_each(|result| client.outbox.push_result(result));
        client
    }

    /// Whether another message from the broker may be taken: a result of it finds room.
    fn receives(&self) -> bool {
        self.commands.has_room() && self.outbox.has_room_for_results()
    }

    fn on_connection_event(&mut self, event: ConnectionEvent) {
        match self.link.take(event) {
            // A client that reads `online` may send commands, so the subscription comes first.
            Step::Accepted(limits) | Step::Subscribe(limits) => self.subscribe(limits),
            Step::Subscribed(refused, ready) => {
                report_refused(&self.subscriptions, &refused);
                if let Some(limits) = ready {
                    self.ready(limits);
                }
            }
            Step::Sent(packet) => {
                if let Err(why) = self.outbox.numbered(packet) {
                    self.give_up(why);
                }
            }
            Step::Acked(packet) => {
                self.stats.mqtt.published.fetch_add(1, Ordering::Relaxed);
                let settled = self.outbox.acked(packet);
                self.settled(settled);
            }
            Step::Refused(packet, why) => self.refused(packet, why),
            Step::Message(message) => self.on_message(*message),
            Step::GiveUp(why) => self.give_up(why),
            Step::Lost(why) => self.lost(&why),
            Step::Nothing => {}
        }
    }

    /// A message left the outbox.
    fn settled(&mut self, settled: Option<Settled>) {
        let Some(Settled { topic, kind }) = settled else { return };
        match kind {
            Some(Kind::Event) => self.store.acknowledge(self.outbox.oldest(Kind::Event)),
            Some(Kind::History) => self.history.acknowledge(self.outbox.oldest(Kind::History)),
            Some(Kind::Result) => {}
            None if self.publisher.was_cleared(&topic) => self.remember_topics(),
            None => {}
        }
    }

    /// Publishes the status, then everything else.
    fn ready(&mut self, limits: BrokerLimits) {
        self.stats.mqtt.connected.store(true, Ordering::Relaxed);
        self.link.log_ready(limits, "");
        self.repair.forget();
        self.publish_online();
        self.keep_recorded();
        self.publisher.restart(limits.max_packet);
        if let Some(announcer) = &mut self.announcer {
            announcer.restart(limits.max_packet);
        }
        self.leftovers_known = true;
        self.look_at = Instant::now();
    }

    fn publish_online(&mut self) {
        let expiry = self.options.message_expiry;
        self.renew_at = expiry.map(|expiry| Instant::now() + expiry / RENEWED);
        self.outbox
            .put_first(self.topics.status().into(), b"online".to_vec(), expiry.map(seconds));
    }

    /// Ends the connection for this reason, with notice to the broker. Once the status was `online`, the last will is
    /// true: subscribers learn that the gateway is offline.
    fn give_up(&mut self, why: &str) {
        let true_now = self.is_ready();
        self.link.give_up(why, true_now);
        self.down();
    }

    /// There is no connection any more.
    fn lost(&mut self, why: &str) {
        drop(self.link.lost(why));
        self.down();
    }

    fn down(&mut self) {
        self.outbox.lost();
        self.look_at = Instant::now();
        self.stats.mqtt.connected.store(false, Ordering::Relaxed);
    }

    fn on_message(&mut self, message: Incoming) {
        if message.topic == self.topics.status() {
            return self.on_status(&message.payload);
        }
        if self.on_discovery(&message) {
            return;
        }
        let plant = self.plant.load();
        let crowded = |topic: &str| self.outbox.is_crowded(topic);
        if self.options.commands
            && let Some(result) = self
                .commands
                .take(message, &plant, crowded, Instant::now(), SystemTime::now())
        {
            self.outbox.push_result(result);
        }
    }

    /// Someone else published a status in the gateway's name, such as the will of its last connection.
    fn on_status(&mut self, payload: &[u8]) {
        if payload != b"online" {
            self.repair.ask();
            self.repair_status(Instant::now());
        }
    }

    /// Publishes `online` again: someone published another status, or it would expire.
    fn repair_status(&mut self, now: Instant) {
        let renews = self.renew_at.is_some_and(|at| now >= at);
        if self.is_ready() && (self.repair.take(now) || renews) {
            self.publish_online();
        }
    }

    fn is_ready(&self) -> bool {
        self.link.ready().is_some()
    }

    fn on_ended(&mut self, ended: Finished) {
        let result = self.commands.answer(ended, SystemTime::now());
        self.outbox.push_result(result);
    }

    /// Looks at the drives that were updated.
    fn look(&mut self) {
        let (now, wall) = (Instant::now(), SystemTime::now());
        let next = match (self.is_ready(), self.options.telemetry.history) {
            (true, _) => {
                for topic in self.publisher.cleared() {
                    self.outbox.put_lasting(topic, Vec::new());
                }
                let (updates, next) = self.publisher.tick(now, wall);
                for Update { topic, payload } in updates {
                    self.outbox.put(topic, payload);
                }
                for line in self.publisher.take_reduced() {
                    tracing::warn!(target: "drivegate::north::mqtt", "broker {}: {line}", self.link.broker());
                }
                next
            }
            (false, History::Off) => now + CHECK,
            (false, _) => {
                let (updates, next) = self.publisher.record(now, wall);
                for Update { topic, payload } in updates {
                    self.keep(Kind::History, Message::not_retained(topic, payload));
                }
                next
            }
        };
        self.look_at = next.min(self.check_at.max(now));
    }

    async fn on_time(&mut self) {
        let now = Instant::now();
        if now >= self.check_at {
            self.check_at = now + CHECK;
            self.check(now).await;
        }
        self.look();
    }

    async fn check(&mut self, now: Instant) {
        self.update_plant();
        match self.link.due(now) {
            Due::Connect => self.connect().await,
            Due::GiveUp(why) => self.give_up(why),
            Due::Nothing => {}
        }
        self.repair_status(now);
        if self.retry.is_due(now) {
            self.outbox.retry();
        }
        // What the disk had no room for the last time.
        self.store.acknowledge(self.outbox.oldest(Kind::Event));
        self.history.acknowledge(self.outbox.oldest(Kind::History));
        self.count_lost(now);
    }

    /// Observes the current plant, which a reload may have replaced.
    fn update_plant(&mut self) {
        let plant = self.plant.load_full();
        if Arc::ptr_eq(&plant, &self.observed) {
            return;
        }
        // The last events of a removed bus find its drives in the plant before.
        self.take_pending_events();
        let events = plant.events.subscribe();
        if !events.same_channel(&self.events) {
            self.events = events;
        }
        // The publisher starts again.
        self.keep_recorded();
        let discovery = discovery_topics(self.announcer.as_mut(), &plant);
        self.publisher.adopt(&plant, discovery);
        self.observed = plant;
        self.remember_topics();
        if let Some(limits) = self.link.limits().filter(|limits| !limits.wildcards) {
            self.subscribe(limits);
        }
    }

    async fn connect(&mut self) {
        if let Err(why) = self.link.connect(self.topics.status(), b"offline".to_vec(), true).await {
            self.lost(&why);
        }
    }

    /// Publishes from the outbox as far as the connection allows.
    fn publish_waiting(&mut self) {
        self.outbox.drop_gone(Kind::Event, self.store.gone());
        self.outbox.drop_gone(Kind::History, self.history.gone());
        self.store.load(self.outbox.room(Kind::Event));
        if let Some(limits) = self.link.ready() {
            self.history.load(self.outbox.room(Kind::History));
            self.announce();
            self.publish(limits);
        }
        let waiting = self.outbox.waiting() as u64 + self.store.waiting() + self.history.waiting();
        self.stats.mqtt.buffered.store(waiting, Ordering::Relaxed);
    }

    fn publish(&mut self, limits: BrokerLimits) {
        let now = Instant::now();
        while self.link.is_up()
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
            if !self.link.publish(message) {
                break;
            }
            if matches!(key, Key::Queued(Kind::History, _)) {
                self.history_at = now + HISTORY_PACE;
            }
            let settled = self.outbox.mark_published(key, acknowledged);
            if settled.is_some() {
                self.stats.mqtt.published.fetch_add(1, Ordering::Relaxed);
            }
            self.settled(settled);
        }
    }

    /// Sends what is waiting, publishes `offline` and disconnects, all within half a second once the commands that are
    /// in progress have ended. The next client then sends the results that are still due.
    async fn shut_down(mut self) {
        self.take_pending_events();
        self.announcer = None;
        self.outbox.drop_telemetry();
        self.end_commands(tokio::time::Instant::now() + LAST_COMMANDS).await;
        let begun = tokio::time::Instant::now();
        // After that time the connection is closed, and the broker publishes the last will.
        let in_time = tokio::time::timeout_at(begun + DISCONNECT_TIMEOUT, self.disconnect(begun + LAST_RESULTS)).await;
        if in_time.is_err() {
            tracing::warn!(target: "drivegate::north::mqtt", "the orderly disconnect from the broker timed out; the broker publishes the last will");
        }
        self.stats.mqtt.connected.store(false, Ordering::Relaxed);
        self.stats.mqtt.configured.store(false, Ordering::Relaxed);
        self.keep_recorded();
        self.count_unkept();
        let close = async { tokio::join!(self.store.close(), self.history.close()) };
        if tokio::time::timeout(LAST_WRITE, close).await.is_err() {
            tracing::warn!(target: "drivegate::north::mqtt", "the MQTT buffer is too slow: the last messages may be missing after a restart");
        }
        // The client that replaces it after a reload continues with them.
        self.stats.mqtt.keep_unread(Some(self.events));
        self.stats.mqtt.keep_broker(LinkOf::Topics, Some(self.link.broker()));
        let orders = self.commands.leave(self.outbox.into_results());
        self.stats.mqtt.keep_orders(Some(orders));
    }

    /// Waits for the commands that are in progress; what comes in meanwhile is taken as usual.
    async fn end_commands(&mut self, until: tokio::time::Instant) {
        while self.is_ready() && !self.commands.is_idle() {
            self.publish_waiting();
            tokio::select! {
                event = self.link.next(), if self.receives() => self.on_connection_event(event),
                event = self.events.recv() => self.on_event(event),
                ended = self.commands.finished() => self.on_ended(ended),
                loaded = self.store.next() => self.on_loaded(Kind::Event, loaded),
                () = tokio::time::sleep_until(until) => return,
            }
        }
    }

    async fn disconnect(&mut self, last_results: tokio::time::Instant) {
        let status = self.topics.status();
        let mut offline_queued = false;
        while self.is_ready() {
            self.publish_waiting();
            let quiet = self.commands.is_idle() && self.outbox.urgent() == 0;
            if !offline_queued && (quiet || tokio::time::Instant::now() >= last_results) {
                self.outbox.put_first(status.as_str().into(), b"offline".to_vec(), None);
                offline_queued = true;
                continue;
            }
            if offline_queued && !self.outbox.has_telemetry(&status) {
                break;
            }
            tokio::select! {
                event = self.link.next(), if self.receives() => self.on_connection_event(event),
                event = self.events.recv() => self.on_event(event),
                ended = self.commands.finished() => self.on_ended(ended),
                loaded = self.store.next() => self.on_loaded(Kind::Event, loaded),
                () = tokio::time::sleep_until(last_results), if !offline_queued => {}
            }
        }
        if self.link.disconnect() {
            // The broker counts what is still in progress from it as delivered.
            loop {
                match self.link.next().await {
                    ConnectionEvent::Lost(_) => break,
                    ConnectionEvent::Message(message) => self.on_message(*message),
                    _ => {}
                }
            }
        }
    }
}

#[cfg(test)]
mod tests;
