//! A connection to the broker: a rumqttc client, polled by a separate task.
//!
//! Client and event loop are discarded after any error: the outbox is better at keeping what rumqttc would keep
//! (messages in flight). The polling task never publishes, and publishing never waits: what finds no room stays in the
//! outbox until [`Step::Room`].

use std::collections::{HashMap, HashSet};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use futures_util::FutureExt;
use rumqttc::mqttbytes::QoS;
use rumqttc::mqttbytes::v5::Filter;
use rumqttc::{
    AsyncClient, ConnectProperties, ConnectReturnCode, ConnectionError, DisconnectProperties, DisconnectReasonCode,
    Event, EventLoop, LastWill, MqttOptions, NetworkOptions, Outgoing, Packet, Proxy, ProxyAuth, ProxyType,
    PubAckReason, PublishProperties, RetainForwardRule, SubscribeReasonCode, TlsConfiguration, Transport,
};
use rustls::ClientConfig;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;

use super::broker_limits::{BrokerLimits, Lack};
use super::dial::{ACCEPT_TIMEOUT, Dial};
use super::keep_alive::{KEEP_ALIVE_S, Silence, Verdict};
use super::outbox::Message;
use super::password::Secret;
use super::rate::Rate;
use super::reasons::{CLOSED, is_closed, reason, reference, refusal};
use super::request::Incoming;
use super::trail::Trail;
use super::{Broker, Options};
use drivegate_core::order::Arrival;
use drivegate_north::reading::{Dated, Reader};

/// The broker's reason for refusing filters with wildcards.
pub(super) const NO_WILDCARDS: &str = "WildcardSubscriptionsNotSupported";
/// Time limit for the broker to answer the subscription.
pub(super) const SUBSCRIBE_TIMEOUT: Duration = Duration::from_secs(5);
/// Maximum number of unacknowledged messages; the broker may allow fewer.
pub(super) const INFLIGHT: u16 = 1000;
/// Number of messages handed to rumqttc and not written to the socket yet.
const REQUESTS: usize = 128;
/// Messages that are written to the socket, or read from it, at once.
const BATCH: usize = 16;
/// Number of events that the client has not processed; beyond it, polling pauses.
const EVENTS: usize = 64;
/// Maximum size of a packet from the broker: much larger than any valid command, so that a command that is too long
/// still gets an answer. Brokers drop larger packets silently.
const MAX_PACKET: u32 = 2 << 20;
/// Number of unacknowledged commands that the broker may send.
const RECEIVE_MAXIMUM: u16 = 64;
/// Size of a packet with subscriptions, bytes, at most.
const SUBSCRIBE_BYTES: usize = 8 << 10;
/// Filters of a packet with subscriptions, at most: AWS IoT Core closes the connection at the ninth, without a reason.
const MOST_FILTERS: usize = 8;
/// Maximum number of packets with subscriptions: the client accepts [`REQUESTS`] at a time. Beyond this number,
/// each packet contains more filters.
const MOST_PACKETS: usize = REQUESTS / 2;
/// Size of the system's buffer for sent messages: a result never waits for more than this.
const SEND_BUFFER: u32 = 256 << 10;
/// Time for the DISCONNECT of a connection that the gateway gives up.
const LAST_PACKET: Duration = Duration::from_millis(500);

/// Events of a connection to the broker.
#[derive(Debug)]
pub(super) enum Step {
    /// The broker accepted the connection: the client subscribes.
    Accepted(BrokerLimits),
    /// The broker takes no wildcards: the client subscribes again.
    Subscribe(BrokerLimits),
    /// The broker answered the subscriptions: for each, in order, the reason if it was refused.
    Subscribed(Vec<Option<String>>),
    /// The oldest published message with an acknowledgement was sent with this packet id.
    Sent(u16),
    /// The broker acknowledged the message.
    Acked(u16),
    /// The broker refused the message; the connection stays open.
    Refused(u16, PubAckReason),
    /// A message on a topic that was subscribed to.
    Message(Box<Incoming>),
    /// The connection has room for further messages.
    Room,
    /// A ping was sent to the broker.
    Pinged,
    /// An event that does not concern the client, such as any other packet from the broker.
    Nothing,
    /// The connection is open but cannot be used any more, for this reason, and must be closed.
    Stuck(&'static str),
    /// The broker refused the connection because of the last will. The last event.
    Refuses(Lack),
    /// The connection is lost, with the reason. The last event.
    Lost(String),
}

/// A connection, from the connection attempt to its end.
#[derive(Debug)]
pub(super) struct Connection {
    client: AsyncClient,
    event: mpsc::Receiver<Step>,
    backlog: Arc<Backlog>,
    aliases: Box<Aliases>,
    silence: Silence,
    /// Time before which no message may be published.
    held_until: Option<Instant>,
    /// The subscription that is repeated to test a silent broker.
    question: Option<Filter>,
    /// Number of subscriptions whose answers are awaited, and the answers so far.
    wanted: usize,
    answers: Vec<Option<String>>,
    /// The task of the connection; `None` when the task ends by itself.
    task: Option<JoinHandle<()>>,
}

/// Topic aliases for telemetry that is published repeatedly: a topic gets one when it is published for the second
/// time, as long as the broker has any left.
#[derive(Debug, Default)]
struct Aliases {
    /// Aliases by topic, and whether the broker knows each.
    named: HashMap<Arc<str>, (u16, bool)>,
    once: HashSet<Arc<str>>,
}

impl Aliases {
    fn of(&mut self, topic: &Arc<str>, granted: u16) -> Option<(u16, bool)> {
        if let Some(alias) = self.named.get(topic) {
            return Some(*alias);
        }
        let next = u16::try_from(self.named.len() + 1).ok().filter(|next| *next <= granted);
        let Some(next) = next else {
            self.once = HashSet::new();
            return None;
        };
        if self.once.insert(topic.clone()) {
            return None;
        }
        self.named.insert(topic.clone(), (next, false));
        Some((next, false))
    }

    fn announced(&mut self, topic: &str) {
        if let Some((_, known)) = self.named.get_mut(topic) {
            *known = true;
        }
    }
}

/// Messages that rumqttc has not written yet.
#[derive(Debug)]
struct Backlog {
    messages: AtomicUsize,
    /// Times at which rumqttc wrote its latest messages.
    rate: Mutex<Rate>,
    /// The packets that the library wrote last.
    trail: Mutex<Trail>,
    /// Whether the client waits for [`Step::Room`].
    room_wanted: AtomicBool,
}

impl Backlog {
    fn new(publish_limit: usize) -> Backlog {
        Backlog {
            messages: AtomicUsize::new(0),
            rate: Mutex::new(Rate::new(publish_limit)),
            trail: Mutex::default(),
            room_wanted: AtomicBool::new(false),
        }
    }

    fn rate(&self) -> MutexGuard<'_, Rate> {
        self.rate.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn trail(&self) -> MutexGuard<'_, Trail> {
        self.trail.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Why the broker closed a connection, if it gave no reason.
    fn closed(&self) -> String {
        match self.trail().last() {
            Some(packet) => format!("{CLOSED}; the last packet sent before was {packet}"),
            None => CLOSED.to_string(),
        }
    }
}

impl Drop for Connection {
    fn drop(&mut self) {
        if let Some(task) = &self.task {
            task.abort();
        }
    }
}

impl Connection {
    /// Starts to connect to `broker` as this client, with this last will; `dial` opens the TCP connection,
    /// beginning with the address of index `first`.
    pub(super) fn open(
        options: &Options,
        (broker, client_id): (&Broker, &str),
        (will, password): (LastWill, Option<Secret>),
        tls: Option<Arc<ClientConfig>>,
        (dial, first): (Dial, usize),
    ) -> Connection {
        let mut mqtt = mqtt_options(options, broker, client_id, will, tls);
        if let Some(user) = &options.username {
            let password = password.map(|password| password.0).unwrap_or_default();
            mqtt.set_credentials(user, password);
        }
        // With a proxy, only the name of the proxy is looked up.
        let dialled = match &options.proxy {
            None => broker.clone(),
            Some((host, port)) => Broker {
                host: host.clone(),
                port: *port,
                path: None,
            },
        };
        let reader = Arc::new(Reader::here());
        let of_stream = reader.clone();
        mqtt.set_socket_connector(move |_, network| {
            let (connecting, reader) = (dial.clone().connect(dialled.clone(), first, network), of_stream.clone());
            async move { Ok(Dated::new(connecting.await?, reader)) }
        });
        let (client, eventloop) = AsyncClient::builder(mqtt).capacity(REQUESTS).build();
        let (sender, event) = mpsc::channel(EVENTS);
        let backlog = Arc::new(Backlog::new(options.publish_limit));
        let task = tokio::spawn(poll(eventloop, reader, sender, backlog.clone()));
        Connection {
            client,
            event,
            backlog,
            aliases: Box::default(),
            silence: Silence::new(Instant::now()),
            held_until: None,
            question: None,
            wanted: 0,
            answers: Vec::new(),
            task: Some(task),
        }
    }

    /// The next event of the connection. Cancel safe.
    pub(super) async fn next(&mut self) -> Step {
        // The sender is dropped without a last event only if the task panicked.
        let silent = || Step::Lost("the MQTT client failed".to_string());
        let event = match self.held_until {
            None => self.event.recv().await.unwrap_or_else(silent),
            Some(until) => tokio::select! {
                event = self.event.recv() => event.unwrap_or_else(silent),
                () = tokio::time::sleep_until(until.into()) => {
                    self.held_until = None;
                    Step::Room
                }
            },
        };
        match event {
            Step::Sent(_) | Step::Room => return event,
            Step::Pinged => {
                self.silence.pinged(Instant::now());
                return Step::Nothing;
            }
            _ => {}
        }
        self.silence.packet_received(Instant::now());
        match event {
            Step::Subscribed(_) if self.silence.answered() => Step::Nothing,
            Step::Subscribed(answers) => {
                self.answers.extend(answers);
                match self.answers.len() < self.wanted {
                    true => Step::Nothing,
                    false => Step::Subscribed(std::mem::take(&mut self.answers)),
                }
            }
            event => event,
        }
    }

    /// Subscribes, with as many packets as the broker requires. Returns false if the connection does not accept a packet.
    pub(super) fn subscribe(&mut self, filters: Vec<Filter>, limits: BrokerLimits) -> bool {
        (self.wanted, self.answers) = (filters.len(), Vec::new());
        self.question = filters.first().map(|first| Filter {
            retain_forward_rule: RetainForwardRule::Never,
            ..first.clone()
        });
        packets(filters, limits.max_packet.min(SUBSCRIBE_BYTES))
            .into_iter()
            .all(|packet| {
                self.backlog.trail().subscribes(packet.len());
                self.client.try_subscribe_many(packet).is_ok()
            })
    }

    /// Whether the broker was silent for so long that the connection is lost. A silent broker gets a repeated
    /// subscription, which it must answer and which changes nothing.
    pub(super) fn is_silent(&mut self, limits: Option<BrokerLimits>, now: Instant) -> bool {
        let verdict = self.silence.judge(limits.and_then(|limits| limits.keep_alive), now);
        if verdict == Verdict::Ask
            && let Some(question) = &self.question
            && self.client.try_subscribe_many([question.clone()]).is_ok()
        {
            self.backlog.trail().subscribes(1);
            self.silence.test_sent();
        }
        verdict == Verdict::Lost
    }

    /// Publishes a message; returns false if no room is left until [`Step::Room`].
    pub(super) fn publish(&mut self, message: Message, limits: BrokerLimits) -> bool {
        let waiting = self.backlog.messages.load(Ordering::SeqCst);
        if let Err(until) = self.backlog.rate().take(waiting, Instant::now()) {
            self.held_until = Some(until);
            return false;
        }
        let telemetry = message.retain && !message.payload.is_empty();
        let alias = telemetry
            .then(|| self.aliases.of(&message.topic, limits.aliases))
            .flatten();
        let properties = PublishProperties {
            topic_alias: alias.map(|(alias, _)| alias),
            correlation_data: message.correlation.map(Into::into),
            message_expiry_interval: message.expiry,
            ..PublishProperties::default()
        };
        let qos = match message.acknowledged && limits.acknowledges {
            true => QoS::AtLeastOnce,
            false => QoS::AtMostOnce,
        };
        let retain = message.retain && limits.retains;
        let known = alias.is_some_and(|(_, known)| known);
        let topic = if known { "" } else { message.topic.as_ref() };
        self.backlog
            .trail()
            .publishes(message.topic.clone(), message.payload.len(), retain);
        // The flag is set before the attempt, because the event for the last message may follow immediately.
        self.backlog.room_wanted.store(true, Ordering::SeqCst);
        let attempt = self
            .client
            .try_publish_with_properties(topic, qos, retain, message.payload, properties);
        if attempt.is_ok() {
            self.aliases.announced(&message.topic);
            self.backlog.room_wanted.store(false, Ordering::SeqCst);
            self.backlog.messages.fetch_add(1, Ordering::SeqCst);
        } else {
            self.backlog.trail().kept_back();
        }
        attempt.is_ok()
    }

    /// Disconnects in order, so that the broker does not publish the last will. Messages that the broker does not
    /// acknowledge are sent before.
    pub(super) fn disconnect(&self, limits: BrokerLimits) -> bool {
        match limits.acknowledges {
            true => self.client.try_disconnect_now().is_ok(),
            false => self.client.try_disconnect().is_ok(),
        }
    }

    /// Ends the connection without waiting, and sends the broker the reason if it still reads. The last will is
    /// published if it is `true_now`, that is, if other clients still assume that the gateway is online.
    pub(super) fn give_up(mut self, why: &str, true_now: bool) {
        let reason = match true_now {
            true => DisconnectReasonCode::DisconnectWithWillMessage,
            false => DisconnectReasonCode::NormalDisconnection,
        };
        let properties = DisconnectProperties {
            session_expiry_interval: None,
            // Without any property the library sends the code of a normal end, whatever the reason is.
            reason_string: Some(why.to_string()),
            user_properties: Vec::new(),
            server_reference: None,
        };
        let told = self.client.try_disconnect_now_with_properties(reason, properties);
        let Some(task) = self.task.take().filter(|_| told.is_ok()) else {
            return;
        };
        let abort = task.abort_handle();
        tokio::spawn(async move {
            // The task ends when all its events are taken.
            let ended = async { while self.event.recv().await.is_some() {} };
            if tokio::time::timeout(LAST_PACKET, ended).await.is_err() {
                abort.abort();
            }
        });
    }
}

/// A subscription to commands. Retained messages are requested too and stay marked, even if they arrive during the
/// subscription, so that they can be refused.
pub(super) fn commanding(path: String) -> Filter {
    Filter {
        path,
        qos: QoS::AtLeastOnce,
        preserve_retain: true,
        ..Filter::default()
    }
}

/// A subscription without the gateway's own messages.
pub(super) fn of_others(path: String) -> Filter {
    Filter {
        path,
        qos: QoS::AtLeastOnce,
        nolocal: true,
        ..Filter::default()
    }
}

/// Maximum bytes of a packet in addition to topic, payload and correlation data.
pub(super) const PACKET_OVERHEAD: usize = 24;

/// Maximum size of the packet with `message`, bytes.
pub(super) fn packet_size(message: &Message) -> usize {
    let correlation = message.correlation.as_ref().map_or(0, |c| c.len() + 3);
    message.topic.len() + message.payload.len() + correlation + PACKET_OVERHEAD
}

fn mqtt_options(
    options: &Options,
    broker: &Broker,
    client_id: &str,
    will: LastWill,
    tls: Option<Arc<ClientConfig>>,
) -> MqttOptions {
    let mut mqtt = MqttOptions::new(client_id, target(broker));
    if let Some((host, port)) = &options.proxy {
        mqtt.set_proxy(Proxy {
            ty: ProxyType::Http,
            auth: ProxyAuth::None,
            addr: host.clone(),
            port: *port,
        });
    }
    let mut properties = ConnectProperties::new();
    properties.max_packet_size = Some(MAX_PACKET);
    properties.receive_maximum = Some(RECEIVE_MAXIMUM);
    mqtt.set_connect_properties(properties);
    mqtt.set_keep_alive(KEEP_ALIVE_S)
        .set_clean_start(true)
        .set_connect_timeout(ACCEPT_TIMEOUT)
        .set_max_request_batch(BATCH)
        .set_read_batch_size(BATCH)
        .set_outgoing_inflight_upper_limit(INFLIGHT)
        .set_last_will(will);
    let mut network = NetworkOptions::new();
    network.set_tcp_nodelay(true);
    network.set_tcp_send_buffer_size(SEND_BUFFER);
    mqtt.set_network_options(network);
    if let Some(config) = tls {
        let config = TlsConfiguration::Rustls(config);
        mqtt.set_transport(match broker.path {
            None => Transport::tls_with_config(config),
            Some(_) => Transport::Wss(config),
        });
    }
    mqtt
}

/// The broker's address in the form of the library.
fn target(broker: &Broker) -> rumqttc::Broker {
    // TLS would take an IPv6 address with brackets for a name.
    let plain = || rumqttc::Broker::tcp(broker.bare_host(), broker.port);
    let Some(path) = &broker.path else { return plain() };
    // An invalid URL was refused with the configuration.
    rumqttc::Broker::websocket(format!("ws://{broker}{path}")).unwrap_or_else(|_| plain())
}

/// Polls until the first error and reports the events.
async fn poll(mut eventloop: EventLoop, reader: Arc<Reader>, event: mpsc::Sender<Step>, backlog: Arc<Backlog>) {
    let mut accepted = false;
    let mut elsewhere = String::new();
    loop {
        let event_or_end = eventloop.poll().await;
        // Packets are read in batches: the earliest arrival of the batch counts.
        let arrival = reader.first();
        let item = match event_or_end {
            Ok(Event::Outgoing(Outgoing::Publish(packet))) => {
                backlog.rate().sent(Instant::now());
                backlog.trail().published();
                let left = backlog.messages.fetch_sub(1, Ordering::SeqCst).saturating_sub(1);
                if left <= REQUESTS / 2
                    && backlog.room_wanted.swap(false, Ordering::SeqCst)
                    && event.send(Step::Room).await.is_err()
                {
                    return;
                }
                (packet != 0).then_some(Step::Sent(packet))
            }
            Ok(event) => {
                match &event {
                    Event::Outgoing(Outgoing::Subscribe(_)) => backlog.trail().subscribed(),
                    Event::Outgoing(Outgoing::PingReq) => backlog.trail().pinged(),
                    Event::Incoming(Packet::Disconnect(told)) => elsewhere = reference(told),
                    _ => {}
                }
                interpret(event, arrival)
            }
            Err(ConnectionError::ConnectionRefused(ConnectReturnCode::QoSNotSupported)) => {
                Some(Step::Refuses(Lack::Acknowledgements))
            }
            Err(ConnectionError::ConnectionRefused(ConnectReturnCode::RetainNotSupported)) => {
                Some(Step::Refuses(Lack::Retained))
            }
            Err(error) if accepted && is_closed(&error) => Some(Step::Lost(backlog.closed())),
            Err(error) if accepted => Some(Step::Lost(format!("{}{elsewhere}", reason(&error)))),
            Err(error) => Some(Step::Lost(refusal(&error))),
        };
        let Some(item) = item else { continue };
        accepted |= matches!(item, Step::Accepted(_));
        let end = matches!(item, Step::Lost(_) | Step::Refuses(_));
        let sent = {
            let mut sending = std::pin::pin!(event.send(item));
            match (&mut sending).now_or_never() {
                Some(sent) => sent,
                None => {
                    // Reading pauses until the client has room.
                    reader.ceased();
                    sending.await
                }
            }
        };
        if sent.is_err() || end {
            return;
        }
    }
}

fn interpret(event: Event, arrival: Arrival) -> Option<Step> {
    match event {
        Event::Incoming(Packet::ConnAck(ack)) => Some(Step::Accepted(BrokerLimits::of(&ack))),
        Event::Incoming(Packet::SubAck(ack)) => {
            let refused = |code: &SubscribeReasonCode| match code {
                SubscribeReasonCode::Success(_) => None,
                why => Some(format!("{why:?}")),
            };
            Some(Step::Subscribed(ack.return_codes.iter().map(refused).collect()))
        }
        Event::Incoming(Packet::PubAck(ack)) => Some(match ack.reason {
            PubAckReason::Success | PubAckReason::NoMatchingSubscribers => Step::Acked(ack.pkid),
            why => Step::Refused(ack.pkid, why),
        }),
        Event::Incoming(Packet::Publish(publish)) => {
            Incoming::of(publish, arrival).map(|message| Step::Message(Box::new(message)))
        }
        Event::Incoming(_) => Some(Step::Nothing),
        // A packet id would have been used again before its acknowledgement.
        Event::Outgoing(Outgoing::AwaitAck(_)) => Some(Step::Stuck("the broker did not acknowledge a message")),
        Event::Outgoing(Outgoing::PingReq) => Some(Step::Pinged),
        Event::Outgoing(_) | Event::Auth(_) => None,
    }
}

/// Packets with these filters in their order, each of at most `most` bytes and [`MOST_FILTERS`] filters, unless there are
/// too many.
fn packets(filters: Vec<Filter>, most: usize) -> Vec<Vec<Filter>> {
    let most_filters = MOST_FILTERS.max(filters.len().div_ceil(MOST_PACKETS));
    let mut packets: Vec<(usize, Vec<Filter>)> = Vec::new();
    for filter in filters {
        // Each filter needs its path, the length of the path and the options; each packet has a header.
        let bytes = filter.path.len() + 3;
        let has_room = |(size, packet): &&mut (usize, Vec<Filter>)| size + bytes <= most && packet.len() < most_filters;
        match packets.last_mut().filter(has_room) {
            Some((size, packet)) => {
                *size += bytes;
                packet.push(filter);
            }
            None => packets.push((bytes + 8, vec![filter])),
        }
    }
    packets.into_iter().map(|(_, packet)| packet).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_packet_with_subscriptions_has_eight_filters_and_so_many_bytes_at_most() {
        let filters = |count: usize, length: usize| -> Vec<Filter> {
            let path = |number: usize| format!("{number:0length$}");
            (0..count)
                .map(|number| Filter::new(path(number), QoS::AtLeastOnce))
                .collect()
        };
        for (count, length, most, sizes) in [
            (0, 10, 8192, vec![]),
            (8, 10, 8192, vec![8]),
            (9, 10, 8192, vec![8, 1]),
            (20, 10, 8192, vec![8, 8, 4]),
            (640, 4, 8192, vec![10; 64]),
            // Three of 103 bytes and the head of 8 fit into 320.
            (7, 100, 320, vec![3, 3, 1]),
            (2, 400, 320, vec![1, 1]),
        ] {
            let wanted = filters(count, length);
            let packets = packets(wanted.clone(), most);
            assert_eq!(
                packets.iter().map(Vec::len).collect::<Vec<_>>(),
                sizes,
                "{count} {length}"
            );
            assert_eq!(packets.concat(), wanted, "in their order");
        }
    }
}
