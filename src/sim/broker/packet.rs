//! What clients and broker say to each other, whichever version of MQTT they speak.
//!
//! Both versions are brought to these types at the wire; the reason codes are those of v5, which
//! has all that 3.1.1 has.

use std::time::{Duration, Instant};

use bytes::Bytes;
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{
    ConnectReturnCode, DisconnectReasonCode, Filter, LastWill, LastWillProperties, PubAckReason, PublishProperties,
    SubscribeReasonCode, UnsubAckReason,
};

/// Version a client chose with the level byte of its CONNECT.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Version {
    /// Level 4.
    V311,
    /// Level 5.
    V5,
}

/// Why a connection is closed by the broker.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Fault {
    /// Told to v5 clients in a DISCONNECT.
    pub(super) reason: DisconnectReasonCode,
    /// For the log.
    pub(super) what: String,
}

impl Fault {
    pub(super) fn malformed(what: impl Into<String>) -> Fault {
        Fault {
            reason: DisconnectReasonCode::MalformedPacket,
            what: what.into(),
        }
    }

    pub(super) fn protocol(what: impl Into<String>) -> Fault {
        Fault {
            reason: DisconnectReasonCode::ProtocolError,
            what: what.into(),
        }
    }
}

/// How long a session outlives its connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Expiry {
    /// It ends with the connection.
    AtOnce,
    /// It ends this long after the connection.
    After(Duration),
    /// It ends with the broker, or when the broker needs its place.
    Never,
}

impl Expiry {
    /// The v5 property in seconds; absent is 0, all ones is never (MQTT 5.0 section 3.1.2.11.2).
    pub(super) fn from_seconds(seconds: Option<u32>) -> Expiry {
        match seconds {
            None | Some(0) => Expiry::AtOnce,
            Some(u32::MAX) => Expiry::Never,
            Some(seconds) => Expiry::After(Duration::from_secs(u64::from(seconds))),
        }
    }
}

/// A client's CONNECT.
#[derive(Debug, Clone)]
pub(super) struct Connect {
    pub(super) version: Version,
    pub(super) client_id: String,
    pub(super) clean_start: bool,
    pub(super) expiry: Expiry,
    /// Zero: no supervision.
    pub(super) keep_alive: Duration,
    /// QoS 1 messages the client takes without having acknowledged them.
    pub(super) receive_maximum: u16,
    /// Largest packet the client takes, bytes.
    pub(super) max_packet: u32,
    pub(super) will: Option<Will>,
    /// The client asked for an extended authentication method.
    pub(super) authentication: bool,
}

/// Message published for a client that goes away without saying so.
#[derive(Debug, Clone)]
pub(super) struct Will {
    pub(super) publish: Publish,
    pub(super) delay: Duration,
}

impl Will {
    /// From the v5 packet. `None` when the topic is no topic name.
    pub(super) fn new(will: LastWill) -> Option<Will> {
        let LastWill {
            topic,
            message,
            qos,
            retain,
            properties,
        } = will;
        let topic = String::from_utf8(topic.to_vec())
            .ok()
            .filter(|topic| super::topic::is_name(topic))?;
        let delay = properties
            .as_ref()
            .and_then(|properties| properties.delay_interval)
            .unwrap_or(0);
        let properties = properties.map(|properties| {
            let LastWillProperties {
                delay_interval: _,
                payload_format_indicator,
                message_expiry_interval,
                content_type,
                response_topic,
                correlation_data,
                user_properties,
            } = properties;
            PublishProperties {
                payload_format_indicator,
                message_expiry_interval,
                content_type,
                response_topic,
                correlation_data,
                user_properties,
                ..PublishProperties::default()
            }
        });
        let publish = Publish {
            topic,
            payload: message,
            qos,
            retain,
            pkid: 0,
            alias: None,
            properties,
        };
        Some(Will {
            publish,
            delay: Duration::from_secs(u64::from(delay)),
        })
    }
}

/// A client's PUBLISH.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Publish {
    /// Empty when only the alias is given.
    pub(super) topic: String,
    pub(super) payload: Bytes,
    pub(super) qos: QoS,
    pub(super) retain: bool,
    /// 0 at QoS 0.
    pub(super) pkid: u16,
    pub(super) alias: Option<u16>,
    /// Without topic alias and subscription identifiers: those belong to one connection.
    pub(super) properties: Option<PublishProperties>,
}

/// A message on its way through the broker.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Message {
    pub(super) topic: String,
    pub(super) payload: Bytes,
    pub(super) qos: QoS,
    pub(super) retain: bool,
    /// Without topic alias, subscription identifiers and message expiry.
    pub(super) properties: Option<PublishProperties>,
    /// Not delivered from this time on.
    pub(super) expires: Option<Instant>,
}

impl Message {
    /// The message of `publish`, received at `now`, its topic alias resolved.
    pub(super) fn new(publish: Publish, now: Instant) -> Message {
        let Publish {
            topic,
            payload,
            qos,
            retain,
            pkid: _,
            alias: _,
            mut properties,
        } = publish;
        let expires = properties
            .as_mut()
            .and_then(|properties| properties.message_expiry_interval.take())
            .and_then(|seconds| now.checked_add(Duration::from_secs(u64::from(seconds))));
        let properties = properties.filter(|properties| *properties != PublishProperties::default());
        Message {
            topic,
            payload,
            qos,
            retain,
            properties,
            expires,
        }
    }

    /// Bytes it counts for in a bound.
    pub(super) fn weight(&self) -> usize {
        // The constant is what the type and an entry in a queue take.
        256 + self.topic.len() + self.payload.len() + self.properties.as_ref().map_or(0, properties_weight)
    }

    /// Whether it may still be delivered.
    pub(super) fn is_current(&self, now: Instant) -> bool {
        self.expires.is_none_or(|expires| now < expires)
    }
}

fn properties_weight(properties: &PublishProperties) -> usize {
    let user: usize = properties
        .user_properties
        .iter()
        .map(|(key, value)| 48 + key.len() + value.len())
        .sum();
    user + properties.response_topic.as_ref().map_or(0, String::len)
        + properties.content_type.as_ref().map_or(0, String::len)
        + properties.correlation_data.as_ref().map_or(0, Bytes::len)
}

/// What a client sends after its CONNECT.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Incoming {
    Publish(Publish),
    /// Acknowledges a QoS 1 message.
    PubAck(u16),
    /// Releases the identifier of a QoS 2 message.
    PubRel(u16),
    Subscribe {
        pkid: u16,
        filters: Vec<Filter>,
        /// Subscription identifier.
        id: Option<usize>,
    },
    Unsubscribe {
        pkid: u16,
        filters: Vec<String>,
    },
    PingReq,
    Disconnect {
        reason: DisconnectReasonCode,
        /// New session expiry, seconds.
        session_expiry: Option<u32>,
    },
}

/// What the broker sends.
#[derive(Debug)]
pub(super) enum Outgoing {
    ConnAck(ConnAck),
    Publish(Outbound),
    PubAck(u16, PubAckReason),
    /// Takes over a QoS 2 message, or refuses it.
    PubRec(u16, PubAckReason),
    /// Whether the identifier was known.
    PubComp(u16, bool),
    SubAck(u16, Vec<SubscribeReasonCode>),
    UnsubAck(u16, Vec<UnsubAckReason>),
    PingResp,
    /// 3.1.1 has no such packet from the broker.
    Disconnect(DisconnectReasonCode),
}

/// The answer to a CONNECT.
#[derive(Debug)]
pub(super) struct ConnAck {
    pub(super) code: ConnectReturnCode,
    pub(super) session_present: bool,
    /// Client id the broker gave to a client without one.
    pub(super) assigned: Option<String>,
}

/// One message for one client.
#[derive(Debug, Clone)]
pub(super) struct Outbound {
    pub(super) message: std::sync::Arc<Message>,
    pub(super) qos: QoS,
    pub(super) retain: bool,
    /// 0 at QoS 0.
    pub(super) pkid: u16,
    /// Sent on an earlier connection of this session already.
    pub(super) dup: bool,
    /// Identifiers of the subscriptions that matched.
    pub(super) subscription_ids: Vec<usize>,
    /// Seconds left until the message expires.
    pub(super) expires_in: Option<u32>,
}
