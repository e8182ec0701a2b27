//! A connection to the broker: a rumqttc client, polled by a separate task.
//!
//! Client and event loop are discarded after any error: the outbox is better at keeping what rumqttc would keep
//! (messages in flight). The polling task never publishes, and publishing never waits: what finds no room stays in the
//! outbox until [`Step::Room`].

mod aliases;
mod backlog;
mod filters;
mod frames;
mod options;
mod polling;

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use rumqttc::mqttbytes::QoS;
use rumqttc::mqttbytes::v5::Filter;
use rumqttc::{
    AsyncClient, DisconnectProperties, DisconnectReasonCode, LastWill, PubAckReason, PublishProperties,
    RetainForwardRule,
};
use rustls::ClientConfig;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;

use self::aliases::Aliases;
use self::backlog::Backlog;
use self::filters::{SUBSCRIBE_BYTES, packets};
pub(super) use self::filters::{commanding, of_others};
use self::frames::{Carrier, PacketFrames};
use self::options::mqtt_options;
use self::polling::poll;
use super::broker_limits::{BrokerLimits, Lack};
use super::dial::Dial;
use super::keep_alive::{Silence, Verdict};
use super::outbox::Message;
use super::password::Secret;
use super::request::Incoming;
use super::{Broker, Options};
use drivegate_north::reading::{Dated, Reader};

/// The broker's reason for refusing filters with wildcards.
pub(super) const NO_WILDCARDS: &str = "WildcardSubscriptionsNotSupported";
/// Time limit for the broker to answer the subscription.
pub(super) const SUBSCRIBE_TIMEOUT: Duration = Duration::from_secs(5);
/// Maximum number of unacknowledged messages; the broker may allow fewer.
pub(super) const INFLIGHT: u16 = 1000;
/// Number of messages handed to rumqttc and not written to the socket yet.
const REQUESTS: usize = 128;
/// Number of events that the client has not processed; beyond it, polling pauses.
const EVENTS: usize = 64;
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
        let carrier = Carrier {
            proxy: options.proxy.is_some(),
            tls: options.tls,
            web_socket: broker.path.is_some(),
        };
        mqtt.set_socket_connector(move |_, network| {
            let (connecting, reader) = (dial.clone().connect(dialled.clone(), first, network), of_stream.clone());
            let frames = Box::new(PacketFrames::new(carrier));
            async move { Ok(Dated::in_frames(connecting.await?, reader, frames)) }
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
                if self.answers.len() < self.wanted {
                    Step::Nothing
                } else {
                    Step::Subscribed(std::mem::take(&mut self.answers))
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
        let qos = if message.acknowledged && limits.acknowledges {
            QoS::AtLeastOnce
        } else {
            QoS::AtMostOnce
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
        if limits.acknowledges {
            self.client.try_disconnect_now().is_ok()
        } else {
            self.client.try_disconnect().is_ok()
        }
    }

    /// Ends the connection without waiting, and sends the broker the reason if it still reads. The last will is
    /// published if it is `true_now`, that is, if other clients still assume that the gateway is online.
    pub(super) fn give_up(mut self, why: &str, true_now: bool) {
        let reason = if true_now {
            DisconnectReasonCode::DisconnectWithWillMessage
        } else {
            DisconnectReasonCode::NormalDisconnection
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

/// Maximum bytes of a packet in addition to topic, payload and correlation data.
pub(super) const PACKET_OVERHEAD: usize = 24;

/// Maximum size of the packet with `message`, bytes.
pub(super) fn packet_size(message: &Message) -> usize {
    let correlation = message.correlation.as_ref().map_or(0, |c| c.len() + 3);
    message.topic.len() + message.payload.len() + correlation + PACKET_OVERHEAD
}
