//! One connection to the broker: a rumqttc client of its own, polled by a task of its own.
//!
//! rumqttc is used for one connection only. After any error client and event loop are thrown away: what it
//! would keep (messages in flight, a packet id that collided) is kept better by the outbox. The polling task
//! never publishes, and publishing never waits: `try_publish` into a channel that always has room.

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

/// Time between two signs of life to the broker.
pub(super) const KEEP_ALIVE: Duration = Duration::from_secs(10);
/// Most messages that are sent and not acknowledged; the broker may want fewer.
const INFLIGHT: u16 = 100;
/// Room for half of them, the subscription and the disconnect.
const REQUESTS: usize = INFLIGHT as usize;
/// What happened that the client has not looked at; when full, polling pauses.
const EVENTS: usize = 64;
/// Largest packet taken from the broker. Larger than any command, so that one that is too long is answered.
const MAX_PACKET: u32 = 256 * 1024;
/// Commands that the broker may send before the first is acknowledged.
const RECEIVE_MAXIMUM: u16 = 64;
/// TCP, TLS and CONNACK within this time, s.
const CONNECT_TIMEOUT: u64 = 5;

/// What happened on the connection.
#[derive(Debug)]
pub(super) enum ConnectionEvent {
    /// The broker took the connection.
    Connected(BrokerLimits),
    /// The broker answered the subscription; with what it refused.
    Subscribed(Option<String>),
    /// The oldest message handed over was sent under this packet id.
    Sent(u16),
    /// The broker has the message.
    Acked(u16),
    /// The broker refuses the message for good.
    Refused(u16, String),
    /// A message on a set topic.
    SetMessage(Box<Publish>),
    /// The broker is alive.
    Alive,
    /// The connection is gone, and why. Nothing comes after this.
    Lost(String),
}

/// What the broker allows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct BrokerLimits {
    /// Messages under way at one time: half the inflight window.
    pub(super) limit: usize,
    /// Largest packet.
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

/// One connection, from the first attempt to its end.
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
    /// Begins to connect; `will` is the topic of the last will `offline`.
    pub(super) fn open(options: &Options, will: String, tls: Option<Arc<ClientConfig>>) -> Connection {
        let (client, eventloop) = AsyncClient::new(mqtt_options(options, will, tls), REQUESTS);
        let (sender, event) = mpsc::channel(EVENTS);
        let task = tokio::spawn(poll(eventloop, sender));
        Connection { client, event, task }
    }

    /// What happens next; may be cancelled without loss.
    pub(super) async fn next(&mut self) -> ConnectionEvent {
        // The sender only goes without a word when the task panicked.
        let silent = || ConnectionEvent::Lost("the MQTT client failed".to_string());
        self.event.recv().await.unwrap_or_else(silent)
    }

    /// Asks for all set topics. Retained messages are sent too, marked as such even when they arrive while
    /// the subscription stands: they must be seen to be refused.
    pub(super) fn subscribe(&self, filters: [String; 2]) -> bool {
        let filters = filters.map(|path| Filter {
            path,
            qos: QoS::AtLeastOnce,
            preserve_retain: true,
            ..Filter::default()
        });
        self.client.try_subscribe_many(filters).is_ok()
    }

    /// Hands a message over; false when there is no room now.
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

    /// Says good-bye, so that the broker does not publish the last will.
    pub(super) fn disconnect(&self) -> bool {
        self.client.try_disconnect().is_ok()
    }
}

/// Bytes of the packet that carries `message`, at most.
pub(super) fn packet_size(message: &Message) -> usize {
    let correlation = message.correlation.as_ref().map_or(0, |c| c.len() + 3);
    message.topic.len() + message.payload.len() + correlation + 16
}

/// Whether something can be published on that topic.
pub(super) fn is_topic(topic: &str) -> bool {
    let long = u16::try_from(topic.len()).is_err();
    !topic.is_empty() && !long && !topic.contains(['+', '#', '\0'])
}

fn mqtt_options(options: &Options, will: String, tls: Option<Arc<ClientConfig>>) -> MqttOptions {
    // rumqttc wants an IPv6 address without brackets, or TLS takes it for a name.
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

/// Polls until the first error, and tells what happens.
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
            // The broker cannot take it now: try again on a new connection, a little later.
            other => ConnectionEvent::Lost(format!("the broker cannot take messages now: {other:?}")),
        }),
        Event::Incoming(Packet::Publish(publish)) => Some(ConnectionEvent::SetMessage(Box::new(publish))),
        Event::Incoming(_) => Some(ConnectionEvent::Alive),
        Event::Outgoing(Outgoing::Publish(packet)) => Some(ConnectionEvent::Sent(packet)),
        // A packet id was to be used again before it was free. rumqttc could wait for ever.
        Event::Outgoing(Outgoing::AwaitAck(_)) => {
            Some(ConnectionEvent::Lost("the broker left a message unacknowledged".into()))
        }
        Event::Outgoing(_) => None,
    }
}

fn reason(error: &ConnectionError) -> String {
    use ConnectReturnCode::{BadUserNamePassword, Banned, ClientIdentifierNotValid, NotAuthorized, RetainNotSupported};
    let ConnectionError::ConnectionRefused(code) = error else {
        return match error {
            ConnectionError::Timeout(_) => "no answer in time".to_string(),
            ConnectionError::MqttState(StateError::AwaitPingResp) => "the broker does not answer any more".to_string(),
            ConnectionError::MqttState(StateError::ConnectionAborted) => "the broker closed the connection".to_string(),
            _ => error.to_string(),
        };
    };
    let advice = match code {
        BadUserNamePassword | NotAuthorized | Banned => {
            "; check mqtt.username, mqtt.password_file and what the broker allows"
        }
        ClientIdentifierNotValid => "; change mqtt.client_id",
        RetainNotSupported => "; the gateway needs a broker with retained messages",
        _ => "",
    };
    format!("the broker refuses the connection ({code:?}){advice}")
}
