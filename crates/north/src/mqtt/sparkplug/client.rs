//! The task that owns session, orders and connection. It never waits for the broker: what finds no room is kept, and
//! the session is not asked for more until there is room.

mod answers;

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant, SystemTime};

use rustls::ClientConfig;
use tokio::sync::Notify;
use tokio_util::sync::CancellationToken;

use super::super::back_off::BackOff;
use super::super::broker_limits::{BrokerLimits, WillForm};
use super::super::connection::{self, CLOSED, Connection, ConnectionEvent, SUBSCRIBE_TIMEOUT};
use super::super::outage_log::OutageLog;
use super::super::outbox::Message;
use super::super::request::Incoming;
use super::super::takeover::Takeovers;
use super::super::{Options as BrokerOptions, tls};
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
use crate::{MqttLoss, NorthStats};

/// Maximum time between two checks of the connection and the plant.
const CHECK: Duration = Duration::from_millis(25);
/// Maximum time between two looks at a drive that was not updated, and at the buses.
const LOOK: Duration = Duration::from_millis(250);
/// Drives looked at, and messages published, before other events have their turn.
const DRIVES: usize = 32;
const MESSAGES: usize = 64;
/// Time for the orderly end of a connection.
const END: Duration = Duration::from_millis(500);
/// Time for the orders that are under way when a reload ends the node. When the gateway stops they have ended before.
const LAST_ORDERS: Duration = Duration::from_secs(3);
/// Longest wait for the file with the number of the session.
const FILE: Duration = Duration::from_secs(1);
/// Least time between two log lines of one kind.
const LOGGED: Duration = Duration::from_secs(60);

/// Runs the edge node until `cancel`.
pub(in crate::mqtt) async fn run(
    options: Options,
    broker: BrokerOptions,
    plant: SharedPlant,
    stats: Arc<NorthStats>,
    cancel: CancellationToken,
) {
    let mut client = Client::new(options, broker, plant, stats);
    loop {
        let look_at = tokio::time::Instant::from_std(client.look_at);
        tokio::select! {
            () = cancel.cancelled() => break,
            event = next(&mut client.link) => client.on_event(event).await,
            finished = client.orders.finished() => client.on_finished(finished),
            () = client.fresh.notified() => client.look(),
            () = tokio::time::sleep_until(look_at) => client.on_time().await,
        }
        client.publish();
    }
    client.shut_down().await;
}

/// The next event of the connection; pending while there is none. Cancel safe.
async fn next(link: &mut Link) -> ConnectionEvent {
    match link {
        Link::Down { .. } => std::future::pending().await,
        Link::Up(up) => up.connection.next().await,
    }
}

#[derive(Debug)]
enum Link {
    /// No connection; the next attempt follows then.
    Down { retry_at: Instant },
    /// A connection that the broker may not have accepted yet.
    Up(Up),
}

#[derive(Debug)]
struct Up {
    connection: Connection,
    bd_seq: u8,
    opened: Instant,
    /// Once the broker has accepted it.
    limits: Option<BrokerLimits>,
    subscribed: bool,
    /// Acknowledgements that are awaited: of the death of the node.
    unacknowledged: bool,
}

struct Drive {
    metrics: DriveMetrics,
    seen: Option<Arc<Snapshot>>,
    look_at: Instant,
}

struct Client {
    client_id: String,
    topics: Topics,
    broker: BrokerOptions,
    plant: SharedPlant,
    observed: Arc<Plant>,
    stats: Arc<NorthStats>,
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
    link: Link,
    will: WillForm,
    back_off: BackOff,
    outages: OutageLog,
    takeovers: Takeovers,
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
    fn new(options: Options, broker: BrokerOptions, plant: SharedPlant, stats: Arc<NorthStats>) -> Client {
        let observed = plant.load_full();
        let topics = Topics::new(&options.group, &options.node, &options.primary_host);
        let now = Instant::now();
        let rules = Rules {
            topics: topics.clone(),
            alias: options.alias,
            history: options.history,
            min_interval: broker.min_interval,
        };
        let mut client = Client {
            client_id: format!("{}-sparkplug", broker.client_id),
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
            link: Link::Down { retry_at: now },
            will: WillForm::default(),
            back_off: BackOff::default(),
            outages: OutageLog::default(),
            takeovers: Takeovers::default(),
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
        if matches!(&self.link, Link::Up(Up { limits: Some(limits), .. }) if !limits.wildcards) {
            self.subscribe();
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
        match &mut self.link {
            Link::Down { retry_at } if now >= *retry_at => self.connect().await,
            Link::Down { .. } => {}
            Link::Up(up) => {
                let late = now.saturating_duration_since(up.opened) > SUBSCRIBE_TIMEOUT;
                if up.limits.is_some() && !up.subscribed && late {
                    self.give_up("the broker does not answer the subscription");
                } else if up.connection.is_silent(up.limits, now) {
                    self.give_up("the broker is silent");
                }
            }
        }
    }

    async fn connect(&mut self) {
        let bd_seq = self.next_number().await;
        let options = self.broker.clone();
        // Read for each attempt, so that renewed certificates are used without a restart.
        let config = tokio::task::spawn_blocking(move || tls::client_config(&options)).await;
        let config = config.map_err(|error| error.to_string());
        match config.and_then(|config| config.map_err(|error| error.to_string())) {
            Ok(config) => self.open(bd_seq, config),
            Err(why) => drop(self.lost(&why)),
        }
    }

    fn open(&mut self, bd_seq: u8, config: Option<Arc<ClientConfig>>) {
        let death = self.session.will(bd_seq, tick().millis);
        let topic = self.topics.of(death.kind, None);
        let will = self.will.will(topic, death.payload.encoded(), false);
        let now = Instant::now();
        self.link = Link::Up(Up {
            connection: Connection::open(&self.broker, &self.client_id, will, config),
            bd_seq,
            opened: now,
            limits: None,
            subscribed: false,
            unacknowledged: false,
        });
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
            _ => (self.bd_seq.unkept(), Err("the disk does not answer".to_string())),
        };
        match written {
            Ok(()) => self.bd_seq_fails = false,
            Err(why) if !std::mem::replace(&mut self.bd_seq_fails, true) => {
                tracing::warn!(
                    target: "drivegate::north::mqtt", "{}: {why}; the session number of Sparkplug (bdSeq) begins with 0 after a restart; make the \
                     directory writable, or set gateway.state_dir",
                    self.bd_seq.path().display()
                );
            }
            Err(_) => {}
        }
        number
    }

    async fn on_event(&mut self, event: ConnectionEvent) {
        let Link::Up(up) = &mut self.link else { return };
        let now = Instant::now();
        match event {
            ConnectionEvent::Connected(limits) => {
                (up.limits, up.opened) = (Some(limits), now);
                self.bd_seq.accepted();
                self.session.opened(up.bd_seq, limits.max_packet);
                self.subscribe();
            }
            ConnectionEvent::Subscribed(refused) => self.subscribed(&refused),
            ConnectionEvent::Refuses(lack) => self.lessen_will(lack, now),
            ConnectionEvent::Acked(_) | ConnectionEvent::Refused(..) => up.unacknowledged = false,
            ConnectionEvent::Message(message) => self.on_message(&message).await,
            ConnectionEvent::Sent(_) | ConnectionEvent::Room | ConnectionEvent::Alive => {}
            ConnectionEvent::Stuck(why) => self.give_up(why),
            ConnectionEvent::Lost(why) => drop(self.lost(&why)),
        }
    }

    fn ready(&mut self, limits: BrokerLimits) {
        for lost in limits.losses() {
            tracing::warn!(target: "drivegate::north::mqtt", "Sparkplug: the broker {lost}");
        }
        tracing::info!(
            target: "drivegate::north::mqtt", "Sparkplug: connected to the broker at {}:{} as {}",
            self.broker.host,
            self.broker.port,
            self.topics.node()
        );
        self.outages.end();
        self.session.subscribed();
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
            Some(Received::State(form)) => match self.session.host_state(form, &message.payload) {
                Ok(false) => {}
                Ok(true) => {
                    tracing::info!(target: "drivegate::north::mqtt", "Sparkplug: the primary host is offline; values are kept until it is back");
                    self.end_connection().await;
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

    /// The result of an order becomes metrics of the drive; what it was to change is published as it is.
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
        let Link::Up(Up {
            connection,
            limits: Some(limits),
            ..
        }) = &mut self.link
        else {
            return false;
        };
        if connection::packet_size(&message) > limits.max_packet {
            // Without it the sequence has a gap, and a birth lacks its metrics.
            let (topic, most) = (&message.topic, limits.max_packet);
            let why =
                format!("the broker accepts at most {most} bytes per packet, {topic} needs more; raise its limit");
            self.give_up(&why);
            return false;
        }
        if !connection.publish(message.clone(), *limits) {
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
        if let Link::Up(up) = self.lost(why) {
            up.connection.give_up(true_now);
        }
    }

    /// There is no connection any more; returns what was there.
    fn lost(&mut self, why: &str) -> Link {
        let now = Instant::now();
        if self.outages.permit(why, now) {
            let (host, port) = (&self.broker.host, self.broker.port);
            let hint = match why.contains("SessionTakenOver") {
                true => "; another client has the same client id: give each gateway a name or a `client_id` of its own",
                false => "",
            };
            tracing::warn!(target: "drivegate::north::mqtt", "Sparkplug: no connection to the broker at {host}:{port}: {why}{hint}; reconnecting");
        } else {
            tracing::debug!(target: "drivegate::north::mqtt", "Sparkplug: no connection to the broker: {why}");
        }
        if why == CLOSED && self.takeovers.closed(now) {
            let words = Takeovers::words(&self.client_id);
            tracing::warn!(target: "drivegate::north::mqtt", "Sparkplug: {}:{}: {words}", self.broker.host, self.broker.port);
        }
        self.down(now)
    }

    /// Without a connection; the next attempt follows after a while. Dropping what is returned aborts its task and closes the
    /// socket.
    fn down(&mut self, now: Instant) -> Link {
        let held = match &self.link {
            Link::Up(up) if up.subscribed => now.saturating_duration_since(up.opened),
            _ => Duration::ZERO,
        };
        if !held.is_zero() {
            // The next broker, or this one with another configuration, may take more.
            self.will = WillForm::default();
        }
        let retry_at = now + self.back_off.after(held);
        self.held = None;
        self.session.closed();
        self.look_at = now;
        std::mem::replace(&mut self.link, Link::Down { retry_at })
    }

    /// Declares the node dead and disconnects, within half a second; after that time the broker publishes the last will.
    async fn end_connection(&mut self) {
        if tokio::time::timeout(END, self.disconnect()).await.is_err() {
            tracing::warn!(target: "drivegate::north::mqtt", "Sparkplug: the orderly disconnect timed out; the broker publishes the last will");
        }
        drop(self.down(Instant::now()));
    }

    async fn disconnect(&mut self) {
        self.held = None;
        let accepted = matches!(&self.link, Link::Up(up) if up.subscribed);
        if !accepted {
            return;
        }
        let death = self.session.end(tick().millis);
        let death = self.message(death, true);
        while let Link::Up(up) = &mut self.link {
            let Some(limits) = up.limits else { return };
            if up.connection.publish(death.clone(), limits) {
                up.unacknowledged = limits.acknowledges;
                break;
            }
            if self.is_lost_next().await {
                return;
            }
        }
        while matches!(&self.link, Link::Up(up) if up.unacknowledged) {
            if self.is_lost_next().await {
                return;
            }
        }
        if matches!(&self.link, Link::Up(Up { connection, limits: Some(limits), .. }) if connection.disconnect(*limits))
        {
            while !self.is_lost_next().await {}
        }
    }

    /// Waits for the next event of a connection that ends: whether it is lost, or is to be closed without DISCONNECT. The broker counts a command that comes meanwhile as
    /// delivered, so it is carried out.
    async fn is_lost_next(&mut self) -> bool {
        match next(&mut self.link).await {
            ConnectionEvent::Lost(_) => return true,
            ConnectionEvent::Message(message) => self.on_device_command(&message),
            // The broker did not take the death of the node: it publishes the last will instead.
            ConnectionEvent::Refused(..) => return true,
            ConnectionEvent::Acked(_) => {
                if let Link::Up(up) = &mut self.link {
                    up.unacknowledged = false;
                }
            }
            _ => {}
        }
        false
    }

    /// Publishes the results of pending orders and the death of the node. What is still to come is published by the node that comes
    /// after.
    async fn shut_down(mut self) {
        let until = tokio::time::Instant::now() + LAST_ORDERS;
        while !self.orders.is_idle() && self.session.is_alive() && tokio::time::Instant::now() < until {
            tokio::select! {
                event = next(&mut self.link) => self.on_event(event).await,
                finished = self.orders.finished() => self.on_finished(finished),
                () = tokio::time::sleep_until(until) => {}
            }
            self.publish();
        }
        self.publish();
        self.end_connection().await;
        self.stats.mqtt.keep_node_orders(Some(self.orders.leave()));
    }
}
