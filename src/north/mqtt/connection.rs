//! One connection to the broker: a rumqttc client, polled by its own task.
//!
//! Client and event loop are discarded after any error: the outbox is better at keeping what rumqttc would keep
//! (messages in flight, a packet id collision). The polling task never publishes, and publishing never waits: it uses
//! `try_publish` on a channel that always has room.

use std::sync::Arc;
use std::time::Duration;

use rumqttc::Outgoing;
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{
    ConnAck, ConnectProperties, ConnectReturnCode, Filter, LastWill, Packet, PubAckReason, Publish, PublishProperties,
    SubscribeReasonCode,
};
use rumqttc::v5::{AsyncClient, ConnectionError, Event, EventLoop, MqttOptions, StateError};
use rumqttc::{NetworkOptions, TlsConfiguration, Transport};
use rustls::ClientConfig;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;

use super::Options;
use super::outbox::Message;

/// Keep-alive interval.
pub(super) const KEEP_ALIVE: Duration = Duration::from_secs(10);
/// Maximum number of unacknowledged messages; the broker may allow fewer.
const INFLIGHT: u16 = 100;
/// Room for half of them, the subscription and the disconnect.
const REQUESTS: usize = INFLIGHT as usize;
/// Number of events that the client has not processed; beyond it, polling pauses.
const EVENTS: usize = 64;
/// Maximum size of a packet from the broker; larger than any valid command, so that one that is too long gets an
/// answer.
const MAX_PACKET: u32 = 256 * 1024;
/// Number of unacknowledged commands that the broker may send.
const RECEIVE_MAXIMUM: u16 = 64;
/// Time limit for TCP, TLS and CONNACK, s.
const CONNECT_TIMEOUT: u64 = 5;

/// An event of the connection.
#[derive(Debug)]
pub(super) enum ConnectionEvent {
    /// The broker accepted the connection.
    Connected(BrokerLimits),
    /// The broker answered the subscription; with the reason if it refused part of it.
    Subscribed(Option<String>),
    /// The oldest published message was sent with this packet id.
    Sent(u16),
    /// The broker acknowledged the message.
    Acked(u16),
    /// The broker refused the message.
    Refused(u16, String),
    /// A message on a set topic.
    SetMessage(Box<Publish>),
    /// Any other packet from the broker.
    Alive,
    /// The connection is lost, with the reason. The last event.
    Lost(String),
}

/// Limits that the broker sets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct BrokerLimits {
    /// Number of unacknowledged messages: half the inflight window.
    pub(super) limit: usize,
    /// Maximum packet size, bytes.
    pub(super) max_packet: usize,
}

impl BrokerLimits {
    fn of(ack: &ConnAck) -> BrokerLimits {
        let properties = ack.properties.as_ref();
        let window = properties.and_then(|p| p.receive_max).unwrap_or(u16::MAX).min(INFLIGHT);
        let max_packet = properties.and_then(|p| p.max_packet_size).unwrap_or(u32::MAX);
        BrokerLimits {
            limit: usize::from(window / 2).max(1),
            max_packet: usize::try_from(max_packet).unwrap_or(usize::MAX),
        }
    }
}

/// One connection, from the connection attempt to its end.
#[derive(Debug)]
pub(super) struct Connection {
    client: AsyncClient,
    event: mpsc::Receiver<ConnectionEvent>,
    task: JoinHandle<()>,
}

impl Drop for Connection {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl Connection {
    /// Starts to connect; `will` is the topic of the last will `offline`.
    pub(super) fn open(options: &Options, will: String, tls: Option<Arc<ClientConfig>>) -> Connection {
        let (client, eventloop) = AsyncClient::new(mqtt_options(options, will, tls), REQUESTS);
        let (sender, event) = mpsc::channel(EVENTS);
        let task = tokio::spawn(poll(eventloop, sender));
        Connection { client, event, task }
    }

    /// The next event. Cancel safe.
    pub(super) async fn next(&mut self) -> ConnectionEvent {
        // The sender is dropped without a last event only if the task panicked.
        let silent = || ConnectionEvent::Lost("the MQTT client failed".to_string());
        self.event.recv().await.unwrap_or_else(silent)
    }

    /// Subscribes to all set topics. Retained messages are requested too, and stay marked even if they arrive during
    /// the subscription, so that they can be refused.
    pub(super) fn subscribe(&self, filters: [String; 2]) -> bool {
        let filters = filters.map(|path| Filter {
            path,
            qos: QoS::AtLeastOnce,
            preserve_retain: true,
            ..Filter::default()
        });
        self.client.try_subscribe_many(filters).is_ok()
    }

    /// Publishes a message; false if there is no room at the moment.
    pub(super) fn publish(&self, message: Message) -> bool {
        let properties = PublishProperties {
            correlation_data: message.correlation.map(Into::into),
            ..PublishProperties::default()
        };
        let (topic, payload) = (message.topic.as_ref(), message.payload);
        self.client
            .try_publish_with_properties(topic, QoS::AtLeastOnce, message.retain, payload, properties)
            .is_ok()
    }

    /// Disconnects in order, so that the broker does not publish the last will.
    pub(super) fn disconnect(&self) -> bool {
        self.client.try_disconnect().is_ok()
    }
}

/// Maximum size of the packet with `message`, bytes.
pub(super) fn packet_size(message: &Message) -> usize {
    let correlation = message.correlation.as_ref().map_or(0, |c| c.len() + 3);
    message.topic.len() + message.payload.len() + correlation + 16
}

/// Whether messages can be published on that topic.
pub(super) fn is_topic(topic: &str) -> bool {
    let long = u16::try_from(topic.len()).is_err();
    !topic.is_empty() && !long && !topic.contains(['+', '#', '\0'])
}

fn mqtt_options(options: &Options, will: String, tls: Option<Arc<ClientConfig>>) -> MqttOptions {
    // rumqttc requires IPv6 addresses without brackets; TLS would take one with brackets for a name.
    let host = options.host.trim_start_matches('[').trim_end_matches(']');
    let mut mqtt = MqttOptions::new(&options.client_id, host, options.port);
    mqtt.set_keep_alive(KEEP_ALIVE)
        .set_clean_start(true)
        .set_connection_timeout(CONNECT_TIMEOUT)
        .set_outgoing_inflight_upper_limit(INFLIGHT)
        .set_last_will(LastWill::new(will, "offline", QoS::AtLeastOnce, true, None));
    let mut properties = ConnectProperties::new();
    properties.max_packet_size = Some(MAX_PACKET);
    properties.receive_maximum = Some(RECEIVE_MAXIMUM);
    mqtt.set_connect_properties(properties);
    if let Some(user) = &options.username {
        let password = options.password.as_ref().map_or("", |p| p.0.as_str());
        mqtt.set_credentials(user, password);
    }
    let mut network = NetworkOptions::new();
    network.set_tcp_nodelay(true);
    mqtt.set_network_options(network);
    if let Some(config) = tls {
        mqtt.set_transport(Transport::tls_with_config(TlsConfiguration::Rustls(config)));
    }
    mqtt
}

/// Polls until the first error and reports the events.
async fn poll(mut eventloop: EventLoop, event: mpsc::Sender<ConnectionEvent>) {
    loop {
        let item = match eventloop.poll().await {
            Ok(event) => interpret(event),
            Err(error) => Some(ConnectionEvent::Lost(reason(&error))),
        };
        let Some(item) = item else { continue };
        let end = matches!(item, ConnectionEvent::Lost(_));
        if event.send(item).await.is_err() || end {
            return;
        }
    }
}

fn interpret(event: Event) -> Option<ConnectionEvent> {
    match event {
        Event::Incoming(Packet::ConnAck(ack)) => Some(ConnectionEvent::Connected(BrokerLimits::of(&ack))),
        Event::Incoming(Packet::SubAck(ack)) => {
            let granted = |code: &SubscribeReasonCode| matches!(code, SubscribeReasonCode::Success(_));
            let refused = ack.return_codes.iter().find(|code| !granted(code));
            Some(ConnectionEvent::Subscribed(refused.map(|code| format!("{code:?}"))))
        }
        Event::Incoming(Packet::PubAck(ack)) => Some(match ack.reason {
            PubAckReason::Success | PubAckReason::NoMatchingSubscribers => ConnectionEvent::Acked(ack.pkid),
            PubAckReason::NotAuthorized | PubAckReason::TopicNameInvalid | PubAckReason::PayloadFormatInvalid => {
                ConnectionEvent::Refused(ack.pkid, format!("{:?}", ack.reason))
            }
            // The broker cannot accept it now: retry on a new connection.
            other => ConnectionEvent::Lost(format!("the broker does not accept messages at the moment: {other:?}")),
        }),
        Event::Incoming(Packet::Publish(publish)) => Some(ConnectionEvent::SetMessage(Box::new(publish))),
        Event::Incoming(_) => Some(ConnectionEvent::Alive),
        Event::Outgoing(Outgoing::Publish(packet)) => Some(ConnectionEvent::Sent(packet)),
        // A packet id was about to be used again before its acknowledgement, for which rumqttc could wait forever.
        Event::Outgoing(Outgoing::AwaitAck(_)) => {
            Some(ConnectionEvent::Lost("the broker did not acknowledge a message".into()))
        }
        Event::Outgoing(_) => None,
    }
}

fn reason(error: &ConnectionError) -> String {
    use ConnectReturnCode::{BadUserNamePassword, Banned, ClientIdentifierNotValid, NotAuthorized, RetainNotSupported};
    let ConnectionError::ConnectionRefused(code) = error else {
        return match error {
            ConnectionError::Timeout(_) => "timed out".to_string(),
            ConnectionError::MqttState(StateError::AwaitPingResp) => "the broker no longer responds".to_string(),
            ConnectionError::MqttState(StateError::ConnectionAborted) => "the broker closed the connection".to_string(),
            _ => error.to_string(),
        };
    };
    let advice = match code {
        BadUserNamePassword | NotAuthorized | Banned => {
            "; check mqtt.username, mqtt.password_file and the permissions at the broker"
        }
        ClientIdentifierNotValid => "; change mqtt.client_id",
        RetainNotSupported => "; the gateway requires a broker that supports retained messages",
        _ => "",
    };
    format!("the broker refuses the connection ({code:?}){advice}")
}
