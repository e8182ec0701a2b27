//! MQTT packets as bytes, for 3.1.1 and 5.0: both versions are read into common types. Pure; for any input a reader
//! returns a [`Fault`] instead of panicking.
//!
//! Section numbers are those of the MQTT 5.0 specification.

mod reader;
#[cfg(test)]
mod tests;
mod writer;

use std::time::{Duration, Instant};

use self::reader::{Properties, Reader};
pub(super) use self::writer::{
    PINGRESP, PUBACK, SUBACK, UNSUBACK, UNSUPPORTED_CONNACK, acknowledge, connack, disconnect, publish,
};
use super::{MAX_CLIENT_ID_BYTES, MAX_PACKET_BYTES, topic};

/// Reason codes (section 2.4); version 3.1.1 has only some of them, with other numbers.
pub(super) mod reason {
    pub(crate) const SUCCESS: u8 = 0x00;
    pub(crate) const NO_SUBSCRIPTION_EXISTED: u8 = 0x11;
    pub(crate) const MALFORMED_PACKET: u8 = 0x81;
    pub(crate) const PROTOCOL_ERROR: u8 = 0x82;
    pub(crate) const UNSUPPORTED_VERSION: u8 = 0x84;
    pub(crate) const CLIENT_ID_NOT_VALID: u8 = 0x85;
    pub(crate) const SERVER_SHUTTING_DOWN: u8 = 0x8B;
    pub(crate) const BAD_AUTHENTICATION_METHOD: u8 = 0x8C;
    pub(crate) const KEEP_ALIVE_TIMEOUT: u8 = 0x8D;
    pub(crate) const SESSION_TAKEN_OVER: u8 = 0x8E;
    pub(crate) const TOPIC_FILTER_INVALID: u8 = 0x8F;
    pub(crate) const TOPIC_NAME_INVALID: u8 = 0x90;
    pub(crate) const TOPIC_ALIAS_INVALID: u8 = 0x94;
    pub(crate) const PACKET_TOO_LARGE: u8 = 0x95;
    pub(crate) const QUOTA_EXCEEDED: u8 = 0x97;
    pub(crate) const QOS_NOT_SUPPORTED: u8 = 0x9B;
    pub(crate) const SHARED_SUBSCRIPTIONS_NOT_SUPPORTED: u8 = 0x9E;
    pub(crate) const SUBSCRIPTION_IDS_NOT_SUPPORTED: u8 = 0xA1;
}

/// Identifiers of properties (section 2.2.2.2) that the code uses by name; all others are in the lists below.
mod property {
    pub(crate) const MESSAGE_EXPIRY: u8 = 2;
    pub(crate) const RESPONSE_TOPIC: u8 = 8;
    pub(crate) const SUBSCRIPTION_ID: u8 = 11;
    pub(crate) const SESSION_EXPIRY: u8 = 17;
    pub(crate) const ASSIGNED_CLIENT_ID: u8 = 18;
    pub(crate) const AUTHENTICATION_METHOD: u8 = 21;
    pub(crate) const RECEIVE_MAXIMUM: u8 = 33;
    pub(crate) const TOPIC_ALIAS: u8 = 35;
    pub(crate) const MAXIMUM_QOS: u8 = 36;
    pub(crate) const USER: u8 = 38;
    pub(crate) const MAXIMUM_PACKET: u8 = 39;
    pub(crate) const SUBSCRIPTION_IDS_AVAILABLE: u8 = 41;
    pub(crate) const SHARED_SUBSCRIPTIONS_AVAILABLE: u8 = 42;

    /// Session expiry, authentication, problem and response information, receive maximum, alias maximum, packet size.
    pub(crate) const OF_CONNECT: &[u8] = &[17, 21, 22, 23, 25, 33, 34, USER, 39];
    /// Properties of a message: payload format, expiry, content type, response topic, correlation data, topic alias.
    pub(crate) const OF_PUBLISH: &[u8] = &[1, 2, 3, 8, 9, 35, USER];
    /// Properties of a will: those of a message, with the will delay instead of the topic alias.
    pub(crate) const OF_WILL: &[u8] = &[1, 2, 3, 8, 9, 24, USER];
    /// Properties that subscribers get as the publisher sent them.
    pub(crate) const FORWARDED: &[u8] = &[1, 3, 8, 9, USER];
    /// Properties of acknowledgements: reason string.
    pub(crate) const OF_ACK: &[u8] = &[31, USER];
    pub(crate) const OF_DISCONNECT: &[u8] = &[17, 31, USER];
}

/// Version of MQTT, which a client chooses by the level byte of its CONNECT.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Version {
    /// MQTT 3.1.1, protocol level 4.
    V311,
    /// MQTT 5.0, protocol level 5.
    V5,
}

/// Quality of service; QoS 2 is not served.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Qos {
    AtMostOnce,
    AtLeastOnce,
}

/// Why the broker ends a connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Fault {
    /// Reason code sent to v5 clients, see [`reason`].
    pub(super) reason: u8,
    /// Description of the fault for the log.
    pub(super) what: &'static str,
}

pub(super) const fn fault(reason: u8, what: &'static str) -> Fault {
    Fault { reason, what }
}

const fn malformed(what: &'static str) -> Fault {
    fault(reason::MALFORMED_PACKET, what)
}

const fn protocol(what: &'static str) -> Fault {
    fault(reason::PROTOCOL_ERROR, what)
}

/// A message that the broker passes on.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Message {
    pub(super) topic: String,
    pub(super) payload: Vec<u8>,
    pub(super) qos: Qos,
    pub(super) retain: bool,
    /// Encoded properties, which subscribers receive unchanged.
    pub(super) properties: Vec<u8>,
    /// Time after `published` within which the message may be delivered.
    pub(super) lifetime: Option<Duration>,
    pub(super) published: Instant,
}

impl Message {
    /// Bytes that the message counts for in a limit; the constant covers the type itself and an entry in a queue.
    pub(super) fn weight(&self) -> usize {
        192 + self.topic.len() + self.payload.len() + self.properties.len()
    }

    /// Remaining time in which the message may be delivered; `None` without a limit, zero when it has expired.
    fn left(&self, now: Instant) -> Option<Duration> {
        let age = now.saturating_duration_since(self.published);
        self.lifetime.map(|lifetime| lifetime.saturating_sub(age))
    }

    /// Whether the message has not expired and may still be delivered.
    pub(super) fn is_current(&self, now: Instant) -> bool {
        self.left(now) != Some(Duration::ZERO)
    }
}

/// A client's CONNECT.
#[derive(Debug)]
pub(super) struct Connect {
    pub(super) version: Version,
    /// Client id; empty if the broker must assign one.
    pub(super) client_id: String,
    /// Keep-alive time; zero means no supervision.
    pub(super) keep_alive: Duration,
    /// Maximum number of unacknowledged QoS 1 messages that the client accepts.
    pub(super) receive_maximum: usize,
    /// Largest packet that the client takes, bytes.
    pub(super) max_packet: usize,
    /// Published when the connection ends without a good-bye.
    pub(super) will: Option<Message>,
    /// Reason code of the CONNACK for a valid CONNECT that requests an unsupported feature.
    pub(super) refused: Option<u8>,
}

/// A filter of a SUBSCRIBE with its options.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Subscription {
    pub(super) filter: String,
    pub(super) qos: Qos,
    /// Whether the client's own messages are left out.
    pub(super) no_local: bool,
    /// Whether messages keep the retain flag that they were published with.
    pub(super) retain_as_published: bool,
    /// When retained messages are sent: 0 at each subscription, 1 if the subscription is new, 2 never.
    pub(super) retain_handling: u8,
}

/// A packet that a client sends after its CONNECT.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Incoming {
    /// A message; the packet identifier is 0 at QoS 0.
    Publish(Message, u16),
    PubAck(u16),
    Subscribe(u16, Vec<Subscription>),
    Unsubscribe(u16, Vec<String>),
    PingReq,
    /// The end, with or without the will.
    Disconnect {
        with_will: bool,
    },
}

/// Length of the packet at the start of `bytes`, once all of it has arrived.
///
/// # Errors
/// If the length is malformed, or exceeds [`MAX_PACKET_BYTES`].
pub(super) fn packet_length(bytes: &[u8]) -> Result<Option<usize>, Fault> {
    let mut rest = Reader(bytes.get(1..).unwrap_or_default());
    let available = rest.0.len();
    let Ok(body) = rest.variable() else {
        return match available {
            0..4 => Ok(None),
            _ => Err(malformed("remaining length of more than four bytes")),
        };
    };
    let length = 1 + (available - rest.0.len()) + body as usize;
    if length > MAX_PACKET_BYTES {
        return Err(fault(reason::PACKET_TOO_LARGE, "packet too large"));
    }
    Ok((bytes.len() >= length).then_some(length))
}

/// Reads the first packet of a connection.
///
/// # Errors
/// [`reason::UNSUPPORTED_VERSION`] for an unsupported protocol level; other codes for an invalid CONNECT.
pub(super) fn read_connect(packet: &[u8], now: Instant) -> Result<Connect, Fault> {
    let (first, mut body) = open(packet)?;
    if first != 0x10 {
        return Err(protocol("the first packet is not a CONNECT"));
    }
    let name = body.binary()?;
    let version = match (name, body.u8()?) {
        (b"MQTT", 4) => Version::V311,
        (b"MQTT", 5) => Version::V5,
        (b"MQTT" | b"MQIsdp", _) => {
            return Err(fault(reason::UNSUPPORTED_VERSION, "protocol level is not 4 or 5"));
        }
        _ => return Err(protocol("CONNECT without the name of the protocol")),
    };
    let flags = body.u8()?;
    let has = |bit: u8| flags & (1 << bit) != 0;
    let will_qos = (flags >> 3) & 3;
    if has(0) || will_qos == 3 || (!has(2) && (flags & 0x38) != 0) {
        return Err(malformed("flags of CONNECT"));
    }
    let keep_alive = Duration::from_secs(body.u16()?.into());
    let properties = body.properties(version, property::OF_CONNECT)?;
    let limit = |id, otherwise: u32| properties.number(id).unwrap_or(otherwise) as usize;
    let receive_maximum = limit(property::RECEIVE_MAXIMUM, u16::MAX.into());
    let max_packet = limit(property::MAXIMUM_PACKET, u32::MAX);
    if receive_maximum == 0 || max_packet == 0 {
        return Err(protocol("receive maximum or maximum packet size 0"));
    }
    let client_id = body.text()?;
    let will = if has(2) {
        let properties = body.properties(version, property::OF_WILL)?;
        let topic = body.text()?;
        let payload = body.binary()?.to_vec();
        Some(message(topic, payload, Qos::of(will_qos), has(5), properties, now)?)
    } else {
        None
    };
    // The demo has no accounts: name and password are skipped.
    if has(7) {
        body.text()?;
    }
    if has(6) {
        body.binary()?;
    }
    body.end()?;
    // A client without an id cannot request a lasting session (3.1.1 section 3.1.3.1).
    let nameless = client_id.is_empty() && version == Version::V311 && !has(1);
    let refused = if properties.has(property::AUTHENTICATION_METHOD) {
        Some(reason::BAD_AUTHENTICATION_METHOD)
    } else if nameless || client_id.len() > MAX_CLIENT_ID_BYTES {
        Some(reason::CLIENT_ID_NOT_VALID)
    } else if will_qos == 2 && version == Version::V5 {
        Some(reason::QOS_NOT_SUPPORTED)
    } else {
        None
    };
    Ok(Connect {
        version,
        client_id,
        keep_alive,
        receive_maximum,
        max_packet,
        will,
        refused,
    })
}

/// Reads a packet that follows the CONNECT and came at `now`.
///
/// # Errors
/// If the packet is malformed or not supported: the broker then closes the connection.
pub(super) fn read(version: Version, packet: &[u8], now: Instant) -> Result<Incoming, Fault> {
    let (first, mut body) = open(packet)?;
    let incoming = match first {
        0x30..=0x3F => read_publish(version, first, &mut body, now)?,
        0x40 => {
            let pkid = body.packet_id()?;
            body.reason(version, property::OF_ACK)?;
            Incoming::PubAck(pkid)
        }
        0x82 => {
            let pkid = body.packet_id()?;
            let properties = body.properties(version, &[property::SUBSCRIPTION_ID, property::USER])?;
            if properties.has(property::SUBSCRIPTION_ID) {
                return Err(fault(reason::SUBSCRIPTION_IDS_NOT_SUPPORTED, "subscription identifier"));
            }
            Incoming::Subscribe(pkid, body.list(|body| body.subscription(version))?)
        }
        0xA2 => {
            let pkid = body.packet_id()?;
            body.properties(version, &[property::USER])?;
            Incoming::Unsubscribe(pkid, body.list(Reader::text)?)
        }
        0xC0 => Incoming::PingReq,
        0xE0 => {
            let reason = body.reason(version, property::OF_DISCONNECT)?;
            let with_will = reason != reason::SUCCESS;
            Incoming::Disconnect { with_will }
        }
        0x10 => return Err(protocol("second CONNECT")),
        0x20 | 0x50 | 0x62 | 0x70 | 0x90 | 0xB0 | 0xD0 | 0xF0 => return Err(protocol("packet type not served")),
        _ => return Err(malformed("packet type or its flags")),
    };
    body.end()?;
    Ok(incoming)
}

fn read_publish(version: Version, first: u8, body: &mut Reader<'_>, now: Instant) -> Result<Incoming, Fault> {
    let qos = match (first >> 1) & 3 {
        qos @ (0 | 1) => Qos::of(qos),
        2 => return Err(fault(reason::QOS_NOT_SUPPORTED, "PUBLISH at QoS 2")),
        _ => return Err(malformed("QoS 3")),
    };
    let topic = body.text()?;
    let pkid = match qos {
        Qos::AtMostOnce => 0,
        Qos::AtLeastOnce => body.packet_id()?,
    };
    let properties = body.properties(version, property::OF_PUBLISH)?;
    if properties.has(property::TOPIC_ALIAS) {
        return Err(fault(reason::TOPIC_ALIAS_INVALID, "topic alias"));
    }
    let payload = std::mem::take(&mut body.0).to_vec();
    let message = message(topic, payload, qos, first & 1 != 0, properties, now)?;
    Ok(Incoming::Publish(message, pkid))
}

fn message(
    topic: String,
    payload: Vec<u8>,
    qos: Qos,
    retain: bool,
    properties: Properties,
    published: Instant,
) -> Result<Message, Fault> {
    if !topic::is_name(&topic) {
        return Err(fault(reason::TOPIC_NAME_INVALID, "not a topic to publish to"));
    }
    let lifetime = properties.number(property::MESSAGE_EXPIRY);
    Ok(Message {
        topic,
        payload,
        qos,
        retain,
        properties: properties.forwarded,
        lifetime: lifetime.map(|seconds| Duration::from_secs(seconds.into())),
        published,
    })
}

/// First byte and body of a complete packet.
fn open(packet: &[u8]) -> Result<(u8, Reader<'_>), Fault> {
    let mut reader = Reader(packet);
    let first = reader.u8()?;
    let length = reader.variable()? as usize;
    if length != reader.0.len() {
        return Err(malformed("length of the packet"));
    }
    Ok((first, reader))
}

impl Qos {
    /// Reads the two QoS bits; QoS 2 is served as QoS 1.
    fn of(bits: u8) -> Qos {
        if bits == 0 { Qos::AtMostOnce } else { Qos::AtLeastOnce }
    }
}
