//! The task that owns session, commands and connection. It never waits for the broker: what finds no room is kept, and
//! no more messages are taken from the session until there is room.

mod answers;

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant, SystemTime};

use tokio::sync::Notify;
use tokio_util::sync::CancellationToken;

use super::super::Options as BrokerOptions;
use super::super::back_off::chance;
use super::super::broker_limits::BrokerLimits;
use super::super::connection::{self, ConnectionEvent};
use super::super::link::{BrokerLink, Due, Step};
use super::super::outbox::Message;
use super::super::request::Incoming;
use super::bd_seq::BdSeq;
use super::model::{self, DriveMetrics, Moment, millis};
use super::orders::{Finished, Orders};
use super::session::{Packet, REBIRTH_METRIC, Rules, Session, Tick};
use super::topics::{Received, Topics};
use super::wire::{MetricValue, Payload};
use super::{Options, model::COMMAND_ERROR, model::COMMAND_RESULT};
use crate::log_throttle::LogThrottle;
use crate::plant::{Plant, SharedPlant};
use crate::process_image::Snapshot;
use crate::stats::LinkOf;
use crate::{MqttLoss, NorthState};

/// Maximum time between two checks of the connection and the plant.
const CHECK: Duration = Duration::from_millis(25);
/// Maximum time between two looks at a drive that was not updated, and at the buses.
const LOOK: Duration = Duration::from_millis(250);
/// Drives looked at, and messages published, before other events have their turn.
const DRIVES: usize = 32;
const MESSAGES: usize = 64;
/// Time for the orderly end of a connection.
const END: Duration = Duration::from_millis(500);
/// Time for the commands that are in progress when a reload ends the node. When the gateway stops they have ended
/// before.
const LAST_ORDERS: Duration = Duration::from_secs(3);
/// Longest wait for the file with the number of the session.
const FILE: Duration = Duration::from_secs(1);
/// Least time between two log lines of one kind.
const LOGGED: Duration = Duration::from_secs(60);

/// Time that a broker has to say that the primary host is online, before another one is tried.
const HOST: Duration = Duration::from_secs(5);
/// Longest wait for the births when the host comes online, and for the next connection when it went offline: nodes follow one
/// another.
const SPREAD: Duration = Duration::from_secs(2);

/// When the births follow if the host is online now.
fn births_at() -> Instant {
    Instant::now() + SPREAD.mul_f64(chance())
}

/// Runs the edge node until `cancel`.
pub(in crate::mqtt) async fn run(
    options: Options,
    broker: BrokerOptions,
    plant: SharedPlant,
    stats: Arc<NorthState>,
    cancel: CancellationToken,
) {
    let mut client = Client::new(options, broker, plant, stats);
    loop {
        let look_at = tokio::time::Instant::from_std(client.look_at);
        tokio::select! {
            () = cancel.cancelled() => break,
            event = client.link.next() => client.on_event(event).await,
            finished = client.orders.finished() => client.on_finished(finished),
            () = client.fresh.notified() => client.look(),
            () = tokio::time::sleep_until(look_at) => client.on_time().await,
        }
        client.publish();
    }
    client.shut_down().await;
}

struct Drive {
    metrics: DriveMetrics,
    seen: Option<Arc<Snapshot>>,
    look_at: Instant,
}

struct Client {
    topics: Topics,
    broker: BrokerOptions,
    plant: SharedPlant,
    observed: Arc<Plant>,
    stats: Arc<NorthState>,
    session: Session,
    drives: Vec<Drive>,
    /// The drive that is looked at next, of those that are due.
    cursor: usize,
    orders: Orders,
    bd_seq: BdSeq,
    bd_seq_fails: bool,
    /// A message that found no room.
    held: Option<Message>,
    fresh: Arc<Notify>,
    look_at: Instant,
    check_at: Instant,
    buses_at: Instant,
    link: BrokerLink,
    /// Number of the connection.
    number: u8,
    /// Whether the acknowledgement of the death of the node is awaited.
    unacknowledged: bool,
    /// When another broker is tried, because the primary host is not online at this one.
    host_until: Option<Instant>,
    waits_logged: bool,
    not_understood: LogThrottle,
}

fn tick() -> Tick {
    Tick {
        now: Instant::now(),
        millis: millis(SystemTime::now()),
    }
}

impl Client {
    fn new(options: Options, broker: BrokerOptions, plant: SharedPlant, stats: Arc<NorthState>) -> Client {
        let observed = plant.load_full();
        let topics = Topics::new(&options.group, &options.node, &options.primary_host);
        let now = Instant::now();
        let rules = Rules {
            topics: topics.clone(),
            alias: options.alias,
            history: options.history,
            min_interval: broker.min_interval,
        };
        let client_id = format!("{}-sparkplug", broker.client_id);
        let kept = stats.mqtt.keep_broker(LinkOf::Node, None);
        let mut client = Client {
            link: BrokerLink::new(broker.clone(), client_id, "Sparkplug: ", kept.as_ref()),
            topics,
            broker,
            plant,
            observed,
            orders: Orders::new(stats.taken.clone(), stats.mqtt.keep_node_orders(None)),
            stats,
            session: Session::new(rules),
            drives: Vec::new(),
            cursor: 0,
            bd_seq: BdSeq::open(&options.state_dir),
            bd_seq_fails: false,
            held: None,
            fresh: Arc::new(Notify::new()),
            look_at: now,
            check_at: now,
            buses_at: now,
            number: 0,
            unacknowledged: false,
            host_until: None,
            waits_logged: false,
            not_understood: LogThrottle::every(LOGGED),
        };
        client.adopt();
        client
    }

    /// Observes the plant that `observed` is now.
    fn adopt(&mut self) {
        let before = std::mem::take(&mut self.drives);
        let (now, mut definitions) = (Instant::now(), Vec::new());
        for handle in self.observed.drives() {
            handle.image.notify(&self.fresh);
            let name = handle.image.spec.name.clone();
            let (mut metrics, of_drive) = DriveMetrics::new(handle, self.broker.commands);
            let same = |drive: &&Drive| drive.metrics.drive.image.spec.name == name;
            if let Some(before) = before.iter().find(same) {
                metrics.keep_result_of(&before.metrics);
            }
            self.drives.push(Drive {
                metrics,
                seen: None,
                look_at: now,
            });
            definitions.push((name, of_drive));
        }
        self.cursor = 0;
        self.session.adopt(model::node_definitions(&self.observed), definitions);
        // All at once: a birth tells what is, and a drive that was there has not gone.
        for place in 0..self.drives.len() {
            self.tell(place, now, SystemTime::now());
        }
        self.tell_node(now, SystemTime::now());
        if let Some(limits) = self.link.limits().filter(|limits| !limits.wildcards) {
            self.subscribe(limits);
        }
    }

    fn tell(&mut self, place: usize, now: Instant, wall: SystemTime) {
        let Some(drive) = self.drives.get_mut(place) else {
            return;
        };
        let reading = drive.metrics.drive.reading(now);
        let samples = drive.metrics.samples(&reading, wall);
        let present = reading.snapshot.link.is_online() && drive.metrics.drive.bus_up();
        self.session.tell(place, present, samples, now);
        drive.seen = Some(reading.snapshot);
        drive.look_at = now + LOOK;
    }

    fn tell_node(&mut self, now: Instant, wall: SystemTime) {
        self.session
            .tell_node(model::node_samples(&self.observed, Moment { now, wall }));
        self.buses_at = now + LOOK;
    }

    /// Looks at the drives that were updated or are due, a few in one call.
    fn look(&mut self) {
        let (now, wall) = (Instant::now(), SystemTime::now());
        let (count, mut looked) = (self.drives.len(), 0);
        let mut next = self.check_at;
        for step in 0..count {
            let place = (self.cursor + step) % count;
            let Some(drive) = self.drives.get(place) else { break };
            let image = &drive.metrics.drive.image;
            let fresh = drive.seen.as_ref().is_none_or(|seen| image.is_newer_than(seen));
            if !fresh && drive.look_at > now {
                next = next.min(drive.look_at);
                continue;
            }
            if looked == DRIVES {
                self.cursor = place;
                next = now;
                break;
            }
            looked += 1;
            self.tell(place, now, wall);
        }
        if self.buses_at <= now {
            self.tell_node(now, wall);
        }
        self.look_at = next;
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
        let plant = self.plant.load_full();
        if !Arc::ptr_eq(&plant, &self.observed) {
            self.observed = plant;
            self.adopt();
        }
        self.stats.mqtt.lost(MqttLoss::History, self.session.take_lost());
        match self.link.due(now) {
            Due::Connect => self.connect().await,
            Due::GiveUp(why) => self.give_up(why),
            Due::Nothing if self.host_until.is_some_and(|until| now >= until) => self.look_elsewhere().await,
            Due::Nothing => {}
        }
    }

    /// The primary host is not online at this broker: it may be at another one.
    async fn look_elsewhere(&mut self) {
        self.host_until = None;
        if self.session.is_waiting() {
            tracing::debug!(target: "drivegate::north::mqtt", "Sparkplug: the primary host is not online at the broker at {}", self.link.broker());
            self.end_connection(SPREAD.mul_f64(chance())).await;
        }
    }

    async fn connect(&mut self) {
        self.number = self.next_number().await;
        let death = self.session.will(self.number, tick().millis);
        let topic = self.topics.of(death.kind, None);
        if let Err(why) = self.link.connect(topic, death.payload.encoded(), false).await {
            self.lost(&why);
        }
    }

    /// The number of the next connection, kept on disk; a disk that is too slow is not waited for.
    async fn next_number(&mut self) -> u8 {
        let mut bd_seq = self.bd_seq.clone();
        let work = tokio::task::spawn_blocking(move || {
            let (number, written) = bd_seq.next();
            (bd_seq, number, written.map_err(|error| error.to_string()))
        });
        let (number, written) = match tokio::time::timeout(FILE, work).await {
            Ok(Ok((after, number, written))) => {
                self.bd_seq = after;
                (number, written)
            }
            _ => (self.bd_seq.unkept(), Err("the disk does not respond".to_string())),
        };
        match written {
            Ok(()) => self.bd_seq_fails = false,
            Err(why) if !std::mem::replace(&mut self.bd_seq_fails, true) => {
                tracing::warn!(
                    target: "drivegate::north::mqtt", "{}: {why}; the session number of Sparkplug (bdSeq) starts at 0 \
                                                       after a restart; make the directory writable, or set \
                                                       gateway.state_dir",
                    self.bd_seq.path().display()
                );
            }
            Err(_) => {}
        }
        number
    }

    async fn on_event(&mut self, event: ConnectionEvent) {
        match self.link.take(event) {
            Step::Accepted(limits) => {
                self.bd_seq.accepted();
                self.session.opened(self.number, limits.max_packet);
                self.subscribe(limits);
            }
            Step::Subscribe(limits) => self.subscribe(limits),
            Step::Subscribed(refused, ready) => self.subscribed(&refused, ready),
            Step::Acked(_) | Step::Refused(..) => self.unacknowledged = false,
            Step::Message(message) => self.on_message(&message).await,
            Step::GiveUp(why) => self.give_up(why),
            Step::Lost(why) => self.lost(&why),
            Step::Sent(_) | Step::Nothing => {}
        }
    }

    fn ready(&mut self, limits: BrokerLimits) {
        self.link.log_ready(limits, &format!(" as {}", self.topics.node()));
        self.session.subscribed();
        let alone = self.broker.brokers.len() < 2;
        self.host_until = (!alone && self.session.is_waiting()).then(|| Instant::now() + HOST);
        if self.session.is_waiting() && !std::mem::replace(&mut self.waits_logged, true) {
            let state = self.topics.state().unwrap_or_default();
            let old = self.topics.old_state().unwrap_or_default();
            tracing::info!(
                target: "drivegate::north::mqtt", "Sparkplug: waiting for the primary host to be online, on {state}, or {old} as in version 2.2"
            );
        }
    }

    async fn on_message(&mut self, message: &Incoming) {
        match self.topics.parse(&message.topic) {
            Some(Received::State(form)) => match self.session.host_state(form, &message.payload, births_at()) {
                Ok(false) => {}
                Ok(true) => {
                    tracing::info!(target: "drivegate::north::mqtt", "Sparkplug: the primary host is offline; values are kept until it is back");
                    self.end_connection(SPREAD.mul_f64(chance())).await;
                }
                Err(why) => self.not_understood(&message.topic, &why),
            },
            Some(Received::NodeCommand) if !message.retain => self.on_node_command(message),
            Some(Received::DeviceCommand(_)) => self.on_device_command(message),
            _ => {}
        }
    }

    fn on_device_command(&mut self, message: &Incoming) {
        match self.topics.parse(&message.topic) {
            // A retained command was cleared.
            Some(Received::DeviceCommand(_)) if message.retain && message.payload.is_empty() => {}
            Some(Received::DeviceCommand(device)) if self.broker.commands => {
                let drives = self.drives.iter().map(|drive| &drive.metrics);
                let place = drives
                    .into_iter()
                    .position(|metrics| metrics.drive.image.spec.name == device);
                let target = place.and_then(|place| Some((place, &self.drives.get(place)?.metrics)));
                let now = Instant::now();
                let finished = self
                    .orders
                    .take(message, device, target, &self.session, &self.observed, now);
                if let Some(finished) = finished {
                    self.on_finished(finished);
                }
            }
            _ => {}
        }
    }

    fn on_node_command(&mut self, message: &Incoming) {
        let payload = match Payload::decoded(&message.payload) {
            Ok(payload) => payload,
            Err(why) => return self.not_understood(&message.topic, &why),
        };
        for metric in &payload.metrics {
            let asks = metric.name.as_deref() == Some(REBIRTH_METRIC);
            match (asks, &metric.value) {
                (true, Some(MetricValue::Boolean(true))) => self.session.request_birth(),
                (true, _) => {}
                (false, _) => {
                    let name = metric.name.as_deref().unwrap_or("a metric without a name");
                    let why = format!("{name:?} is not a command of the node");
                    self.not_understood(&message.topic, &why);
                }
            }
        }
    }

    fn not_understood(&mut self, topic: &str, why: &str) {
        if let Some(omitted) = self.not_understood.permit(Instant::now()) {
            tracing::warn!(
                target: "drivegate::north::mqtt", "Sparkplug: a message on {topic} is ignored: {why} ({omitted} more since the last such line)"
            );
        }
    }

    /// The result of a command becomes metrics of the drive; what it was to change is published as it is.
    fn on_finished(&mut self, finished: Finished) {
        let drive_of = |drive: &Drive| drive.metrics.drive.image.spec.name == finished.drive;
        let Some(place) = self.drives.iter().position(drive_of) else {
            return;
        };
        if let Some(drive) = self.drives.get_mut(place) {
            drive.metrics.set_result(finished.code, finished.error);
        }
        self.tell(place, Instant::now(), SystemTime::now());
        let result = [COMMAND_RESULT, COMMAND_ERROR].map(|name| self.session.metric(place, Some(name), None));
        let metrics = finished.metrics.into_iter().chain(result.into_iter().flatten());
        self.session.repeat(place, metrics);
    }

    /// Publishes what is due, as far as there is room.
    fn publish(&mut self) {
        for _ in 0..MESSAGES {
            let message = match self.held.take() {
                Some(message) => message,
                None => match self.session.next(tick()) {
                    Ok(packet) => {
                        let packet = self.fitted(packet);
                        self.message(packet, false)
                    }
                    Err(due) => {
                        self.look_at = self.look_at.min(due.unwrap_or(self.look_at));
                        return;
                    }
                },
            };
            if !self.send(message) {
                return;
            }
        }
        self.look_at = Instant::now();
    }

    fn message(&self, packet: Packet, acknowledged: bool) -> Message {
        Message {
            retain: false,
            acknowledged,
            ..Message::not_retained(
                self.topics.of(packet.kind, packet.device.as_deref()),
                packet.payload.encoded(),
            )
        }
    }

    /// Whether another message may follow.
    fn send(&mut self, message: Message) -> bool {
        let Some(limits) = self.link.limits() else { return false };
        if connection::packet_size(&message) > limits.max_packet {
            // Without it the sequence has a gap, and a birth lacks its metrics.
            let (topic, most) = (&message.topic, limits.max_packet);
            let why =
                format!("the broker accepts at most {most} bytes per packet, {topic} needs more; raise its limit");
            self.give_up(&why);
            return false;
        }
        if !self.link.publish(message.clone()) {
            self.held = Some(message);
            return false;
        }
        self.stats.mqtt.published.fetch_add(1, Ordering::Relaxed);
        true
    }

    /// Ends the connection for this reason, and tells the broker. Its last will, the death of the node, is true once the node was
    /// born.
    fn give_up(&mut self, why: &str) {
        let true_now = self.session.is_alive();
        self.link.give_up(why, true_now);
        self.down();
    }

    /// There is no connection any more.
    fn lost(&mut self, why: &str) {
        drop(self.link.lost(why));
        self.down();
    }

    fn down(&mut self) {
        (self.held, self.host_until) = (None, None);
        self.session.closed();
        self.look_at = Instant::now();
    }

    /// Declares the node dead and disconnects, within half a second; after that time the broker publishes the last will. The next
    /// attempt follows after `wait`.
    async fn end_connection(&mut self, wait: Duration) {
        if tokio::time::timeout(END, self.disconnect()).await.is_err() {
            tracing::warn!(target: "drivegate::north::mqtt", "Sparkplug: the orderly disconnect timed out; the broker publishes the last will");
        }
        self.link.close(wait);
        self.down();
    }

    async fn disconnect(&mut self) {
        self.held = None;
        if self.link.ready().is_none() {
            return;
        }
        let death = self.session.end(tick().millis);
        let death = self.message(death, true);
        while let Some(limits) = self.link.limits() {
            if self.link.publish(death.clone()) {
                self.unacknowledged = limits.acknowledges;
                break;
            }
            if self.is_lost_next().await {
                return;
            }
        }
        while self.unacknowledged {
            if self.is_lost_next().await {
                return;
            }
        }
        if self.link.disconnect() {
            while !self.is_lost_next().await {}
        }
    }

    /// Waits for the next event of a connection that ends: whether it is lost, or is to be closed without DISCONNECT. The broker counts a command that comes meanwhile as
    /// delivered, so it is carried out.
    async fn is_lost_next(&mut self) -> bool {
        match self.link.next().await {
            ConnectionEvent::Lost(_) => return true,
            ConnectionEvent::Message(message) => self.on_device_command(&message),
            // The broker did not take the death of the node: it publishes the last will instead.
            ConnectionEvent::Refused(..) => return true,
            ConnectionEvent::Acked(_) => self.unacknowledged = false,
            _ => {}
        }
        false
    }

    /// Publishes the results of pending commands and the death of the node. What is still to come is published by the
    /// node that comes after.
    async fn shut_down(mut self) {
        let until = tokio::time::Instant::now() + LAST_ORDERS;
        while !self.orders.is_idle() && self.session.is_alive() && tokio::time::Instant::now() < until {
            tokio::select! {
                event = self.link.next() => self.on_event(event).await,
                finished = self.orders.finished() => self.on_finished(finished),
                () = tokio::time::sleep_until(until) => {}
            }
            self.publish();
        }
        self.publish();
        let broker = self.link.broker();
        self.end_connection(Duration::ZERO).await;
        self.stats.mqtt.keep_broker(LinkOf::Node, Some(broker));
        self.stats.mqtt.keep_node_orders(Some(self.orders.leave()));
    }
}
