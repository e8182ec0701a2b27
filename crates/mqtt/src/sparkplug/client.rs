//! The edge node as a client of its broker: owns the session and the commands. It never waits for the broker:
//! messages without room are kept, and no more are taken from the session until there is room.

mod answers;

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant, SystemTime};

use rumqttc::mqttbytes::v5::Filter;
use tokio::time::{self, sleep_until};
use tokio_util::sync::CancellationToken;

use super::super::Options as BrokerOptions;
use super::super::back_off::chance;
use super::super::broker_limits::BrokerLimits;
use super::super::connection::{self, Step};
use super::super::handover::{ClientLeft, Handover};
use super::super::link::BrokerLink;
use super::super::outbox::Message;
use super::super::request::Incoming;
use super::super::rounds::{self, LOOK};
use super::super::session::{self, Common, Will};
use super::bd_seq::BdSeq;
use super::metric::Moment;
use super::model::{self, DriveMetrics};
use super::orders::{Finished, NodeOrdersLeft, Orders};
use super::session::{Packet, REBIRTH_METRIC, Rules, Session};
use super::topics::{Received, StateForm, Topics};
use super::wire::{MetricValue, Payload};
use super::{Options, model::COMMAND_ERROR, model::COMMAND_RESULT};
use drivegate_core::order::Right;
use drivegate_core::plant::{Plant, SharedPlant};
use drivegate_core::process_image::Snapshot;
use drivegate_north::log_throttle::LogThrottle;
use drivegate_north::{MqttKind, NorthState};

/// Maximum number of messages published before other events are handled.
const MESSAGES: usize = 64;
/// Minimum time between two log lines of one kind.
const LOGGED: Duration = Duration::from_secs(60);

/// Time for a broker to report that the primary host is online, before another broker is tried.
const HOST: Duration = Duration::from_secs(5);
/// Longest random wait for the births when the host comes online, and for the next connection when it went offline,
/// so that the nodes do not all act at once.
const SPREAD: Duration = Duration::from_secs(2);

/// Pause before the number of the session is written again.
const WRITE_AGAIN: Duration = Duration::from_secs(1);

/// When the births follow if the host is online now.
fn births_at() -> Instant {
    Instant::now() + SPREAD.mul_f64(chance())
}

/// Runs the edge node until `cancel`.
pub(crate) async fn run(
    options: Options,
    broker: (BrokerOptions, Right, ClientLeft<NodeOrdersLeft>),
    plant: SharedPlant,
    stats: Arc<NorthState>,
    cancel: CancellationToken,
) {
    let bd_seq = BdSeq::open(&options.state_dir, &stats.patience).await;
    let mut client = NodeClient::new(options, broker, bd_seq, plant, stats);
    session::run(&mut client, cancel).await;
    // Outstanding results are published by the next node.
    session::end(&mut client).await;
    let Common { link, stats, .. } = client.common;
    let handover = Handover::of(&stats);
    let mut left = handover.lock();
    left.node = ClientLeft {
        orders: Some(client.orders.leave()),
        broker: Some(link.broker()),
    };
}

struct Drive {
    metrics: DriveMetrics,
    seen: Option<Arc<Snapshot>>,
    look_at: Instant,
}

impl Drive {
    /// Whether the drive was updated, or was not evaluated for long.
    fn is_due(&self, now: Instant) -> bool {
        let image = &self.metrics.drive.image;
        self.look_at <= now || self.seen.as_ref().is_none_or(|seen| image.is_newer_than(seen))
    }
}

struct NodeClient {
    topics: Topics,
    broker: BrokerOptions,
    common: Common,
    session: Session,
    drives: Vec<Drive>,
    /// Index of the drive that is looked at next among the drives that are due.
    cursor: usize,
    orders: Orders,
    bd_seq: BdSeq,
    /// When the number of the session, which the disk did not take, is written again.
    write_again: Option<time::Instant>,
    /// A message for which there was no room yet.
    held: Option<Message>,
    buses_at: Instant,
    /// Whether the death of the node is to be declared at this broker, and how long to wait before the next one.
    leaving: Option<Duration>,
    /// When another broker is tried, because the primary host is not online at this one.
    host_until: Option<Instant>,
    waits_logged: bool,
    not_understood: LogThrottle,
}

impl NodeClient {
    fn new(
        options: Options,
        (broker, right, left): (BrokerOptions, Right, ClientLeft<NodeOrdersLeft>),
        bd_seq: BdSeq,
        plant: SharedPlant,
        stats: Arc<NorthState>,
    ) -> NodeClient {
        let topics = Topics::new(&options.group, &options.node, &options.primary_host);
        let now = Instant::now();
        let rules = Rules {
            topics: topics.clone(),
            alias: options.alias,
            history: options.history,
            min_interval: broker.min_interval,
        };
        let client_id = format!("{}-sparkplug", broker.client_id);
        let link = BrokerLink::new(
            broker.clone(),
            client_id,
            "Sparkplug: ",
            stats.mqtt.sparkplug.clone(),
            left.broker.as_ref(),
        );
        let mut client = NodeClient {
            topics,
            broker,
            orders: Orders::new(Handover::of(&stats).commands.clone(), right, left.orders),
            common: Common::new(link, plant, stats),
            session: Session::new(rules),
            drives: Vec::new(),
            cursor: 0,
            bd_seq,
            write_again: None,
            held: None,
            buses_at: now,
            leaving: None,
            host_until: None,
            waits_logged: false,
            not_understood: LogThrottle::every(LOGGED),
        };
        client.observe();
        client
    }

    /// Observes the plant that `observed` is now.
    fn observe(&mut self) {
        let before = std::mem::take(&mut self.drives);
        let (now, mut definitions) = (Instant::now(), Vec::new());
        for handle in self.common.observed.drives() {
            handle.image.notify(&self.common.fresh);
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
        let (of_node, samples) = model::node_metrics(&self.common.observed, Moment::present());
        self.session.adopt(of_node, definitions);
        self.session.set_node(samples);
        // All samples are set at once: a birth has the present state, and drives that were online do not appear as lost.
        for place in 0..self.drives.len() {
            self.publish_device(place, now, SystemTime::now());
        }
    }

    fn publish_device(&mut self, place: usize, now: Instant, wall: SystemTime) {
        let Some(drive) = self.drives.get_mut(place) else {
            return;
        };
        let reading = drive.metrics.drive.reading(now);
        let samples = drive.metrics.samples(&reading, wall);
        let present = reading.snapshot.link.is_online() && drive.metrics.drive.bus_up();
        self.session.set_device(place, present, samples, now);
        drive.seen = Some(reading.snapshot);
        drive.look_at = now + LOOK;
    }

    fn publish_node(&mut self, now: Instant, wall: SystemTime) {
        let (_, samples) = model::node_metrics(&self.common.observed, Moment { now, wall });
        self.session.set_node(samples);
        self.buses_at = now + LOOK;
    }

    /// The number of the next connection, kept on disk.
    async fn next_number(&mut self) -> u8 {
        let (number, written) = self.bd_seq.next().await;
        match written {
            Ok(()) => self.write_again = None,
            Err(why) if self.write_again.replace(time::Instant::now() + WRITE_AGAIN).is_none() => {
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

    /// Writes the number of this connection again, which the disk did not take.
    async fn keep_number(&mut self) {
        self.write_again = Some(time::Instant::now() + WRITE_AGAIN);
        if self.bd_seq.keep().await {
            self.write_again = None;
            tracing::info!(target: "drivegate::north::mqtt", "{} is written", self.bd_seq.path().display());
        }
    }

    /// Ends this connection; the nodes of a group do so one after the other.
    fn leave(&mut self) {
        self.leaving = Some(SPREAD.mul_f64(chance()));
    }

    fn on_state(&mut self, topic: &str, form: StateForm, payload: &[u8]) {
        match self.session.host_state(form, payload, births_at()) {
            Ok(false) => {}
            Ok(true) => {
                tracing::info!(target: "drivegate::north::mqtt", "Sparkplug: the primary host is offline; values are kept until it is back");
                self.leave();
            }
            Err(why) => self.not_understood(topic, &why),
        }
    }

    fn on_device_command(&mut self, device: &str, message: &Incoming) {
        // Between two checks, and until a client that ends with a reload is gone, the plant may already be a newer one.
        session::follow_plant(self);
        let mut drives = self.drives.iter().map(|drive| &drive.metrics).enumerate();
        let target = drives.find(|(_, metrics)| metrics.drive.image.spec.name == device);
        let now = Instant::now();
        let finished = self
            .orders
            .take(message, device, target, &self.session, &self.common.observed, now);
        if let Some(finished) = finished {
            self.on_finished(finished);
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

    /// Publishes the result of a command as metrics of the drive, and the metric that the command should change with
    /// its present value.
    fn on_finished(&mut self, finished: Finished) {
        let drive_of = |drive: &Drive| drive.metrics.drive.image.spec.name == finished.drive;
        let Some(place) = self.drives.iter().position(drive_of) else {
            return;
        };
        if let Some(drive) = self.drives.get_mut(place) {
            drive.metrics.set_result(finished.code, finished.error);
        }
        self.publish_device(place, Instant::now(), SystemTime::now());
        let result = [COMMAND_RESULT, COMMAND_ERROR].map(|name| self.session.metric(place, Some(name), None));
        let metrics = finished.metrics.into_iter().chain(result.into_iter().flatten());
        self.session.repeat(place, metrics);
    }

    fn message(&self, packet: Packet, acknowledged: bool) -> Message {
        let topic = self.topics.of(packet.kind, packet.device.as_deref());
        Message {
            acknowledged,
            ..Message::not_retained(topic, packet.payload.encoded())
        }
    }

    /// Publishes a message; returns whether another may follow.
    fn send(&mut self, message: Message) -> bool {
        let Some(limits) = self.common.link.limits() else {
            return false;
        };
        if connection::packet_size(&message) > limits.max_packet {
            // If this message were not sent, the sequence would have a gap, or a birth would lack its metrics.
            let (topic, most) = (&message.topic, limits.max_packet);
            let why =
                format!("the broker accepts at most {most} bytes per packet, {topic} needs more; raise its limit");
            session::give_up(self, &why);
            return false;
        }
        if !self.common.link.publish(message.clone()) {
            self.held = Some(message);
            return false;
        }
        self.common.stats.mqtt.published.fetch_add(1, Ordering::Relaxed);
        true
    }
}

impl session::Client for NodeClient {
    fn common(&mut self) -> &mut Common {
        &mut self.common
    }

    async fn next(&mut self) -> Step {
        tokio::select! {
            step = self.common.link.next() => return step,
            finished = self.orders.finished() => self.on_finished(finished),
            () = sleep_until(self.write_again.unwrap_or_else(time::Instant::now)), if self.write_again.is_some() => {
                self.keep_number().await;
            }
        }
        Step::Nothing
    }

    async fn will(&mut self) -> Will {
        let number = self.next_number().await;
        let death = self.session.will(number, Moment::present());
        Will {
            topic: self.topics.of(death.kind, None),
            payload: death.payload.encoded(),
            retain: false,
        }
    }

    fn accepted(&mut self, limits: BrokerLimits) {
        let number = self.bd_seq.accepted();
        self.session.opened(number, limits.max_packet);
    }

    fn filters(&mut self, limits: BrokerLimits) -> Vec<Filter> {
        self.subscriptions(limits)
    }

    fn answered(&mut self, refused: &[Option<String>]) {
        if let Some(limits) = self.common.link.limits() {
            self.report_refused(&self.subscriptions(limits), refused);
        }
    }

    fn ready(&mut self, limits: BrokerLimits) {
        self.common
            .link
            .log_ready(limits, &format!(" as {}", self.topics.node()));
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

    fn on_message(&mut self, message: Incoming) {
        match self.topics.parse(&message.topic) {
            Some(Received::State(form)) => self.on_state(&message.topic, form, &message.payload),
            Some(Received::NodeCommand) if !message.retain => self.on_node_command(&message),
            // The message clears a retained command.
            Some(Received::DeviceCommand(_)) if message.retain && message.payload.is_empty() => {}
            Some(Received::DeviceCommand(device)) if self.broker.commands => self.on_device_command(device, &message),
            _ => {}
        }
    }

    fn is_alive(&self) -> bool {
        self.session.is_alive()
    }

    fn down(&mut self) {
        (self.held, self.host_until) = (None, None);
        self.session.closed();
        self.common.look_at = Instant::now();
    }

    fn adopt(&mut self, plant: Arc<Plant>) {
        self.common.observed = plant;
        self.observe();
    }

    fn check(&mut self, now: Instant) {
        self.common.stats.mqtt.lost(MqttKind::History, self.session.take_lost());
        // The primary host may be online at another broker.
        if self.host_until.take_if(|until| now >= *until).is_some() && self.session.is_waiting() {
            tracing::debug!(target: "drivegate::north::mqtt", "Sparkplug: the primary host is not online at the broker at {}", self.common.link.broker());
            self.leave();
        }
    }

    /// Checks a few drives in one call.
    fn publish_due(&mut self) {
        let (now, wall) = (Instant::now(), SystemTime::now());
        let drives = &self.drives;
        let is_due = |place| drives.get(place).is_some_and(|drive: &Drive| drive.is_due(now));
        let (due, all) = rounds::due(&mut self.cursor, drives.len(), is_due);
        for place in due {
            self.publish_device(place, now, wall);
        }
        if self.buses_at <= now {
            self.publish_node(now, wall);
        }
        let next = self
            .drives
            .iter()
            .map(|drive| drive.look_at)
            .chain([self.buses_at])
            .min();
        self.common.look_at = next.filter(|_| all).unwrap_or(now);
    }

    fn publish(&mut self) {
        for _ in 0..MESSAGES {
            let message = match self.held.take() {
                Some(message) => message,
                None => match self.session.next(Moment::present()) {
                    Ok(packet) => {
                        let packet = self.fitted(packet);
                        self.message(packet, false)
                    }
                    Err(due) => {
                        self.common.look_at = self.common.look_at.min(due.unwrap_or(self.common.look_at));
                        return;
                    }
                },
            };
            if !self.send(message) {
                return;
            }
        }
        self.common.look_at = Instant::now();
    }

    fn leaves(&mut self) -> Option<Duration> {
        self.leaving.take()
    }

    fn is_idle(&self) -> bool {
        self.orders.is_idle()
    }

    /// Publishes the death of the node.
    async fn say_goodbye(&mut self) -> bool {
        self.held = None;
        let Some(limits) = self.common.link.ready() else {
            return false;
        };
        let death = self.session.end(Moment::present());
        let death = self.message(death, true);
        let mut sent = false;
        loop {
            if !sent && self.common.link.publish(death.clone()) {
                if !limits.acknowledges {
                    return true;
                }
                sent = true;
            }
            match self.common.link.next().await {
                // The broker does not accept the death of the node, so it publishes the last will instead.
                Step::Lost(_) | Step::Refused(..) => return false,
                Step::Acked(_) => return true,
                Step::Message(message) => self.on_message(*message),
                _ => {}
            }
        }
    }
}

#[cfg(test)]
mod tests;
