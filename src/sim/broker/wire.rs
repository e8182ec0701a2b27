//! Packets on the wire: framing, the checks the library leaves out, and the way to each version.
//!
//! The library's readers are only given whole packets that passed these checks, because on their own
//! they
//! - take a packet whose inner lengths end early for one that has not arrived completely, and
//!   swallow it;
//! - let a property run over the end of its section into what follows;
//! - refuse a v5 DISCONNECT without a reason code or without properties, the two usual forms;
//! - do not look at the reserved flags of the first byte, at repeated properties, or whether a
//!   v5 topic is text.
//!
//! With them, no input makes a reader panic: the property tests below feed it noise and damaged
//! packets. Should one do so all the same, it ends the task of its own connection only.

use bytes::BytesMut;

use super::packet::{Connect, Fault, Incoming, Outgoing, Version};
use super::{MAX_PACKET_BYTES, v5, v311};
use rumqttc::v5::mqttbytes::v5::DisconnectReasonCode;

/// Packet types a client may send (MQTT 5.0 section 2.1.2).
mod kind {
    pub(super) const CONNECT: u8 = 1;
    pub(super) const PUBLISH: u8 = 3;
    pub(super) const PUBACK: u8 = 4;
    pub(super) const PUBREC: u8 = 5;
    pub(super) const PUBREL: u8 = 6;
    pub(super) const PUBCOMP: u8 = 7;
    pub(super) const SUBSCRIBE: u8 = 8;
    pub(super) const UNSUBSCRIBE: u8 = 10;
    pub(super) const PINGREQ: u8 = 12;
    pub(super) const DISCONNECT: u8 = 14;
}

/// One whole packet: its first byte and what follows the remaining length.
struct Frame<'a> {
    first: u8,
    body: &'a [u8],
}

impl Frame<'_> {
    fn kind(&self) -> u8 {
        self.first >> 4
    }
}

/// A CONNECT that is not served.
#[derive(Debug)]
pub(super) struct Refusal {
    /// Packet to send before closing, in the client's own form.
    pub(super) answer: &'static [u8],
    pub(super) what: String,
}

impl From<Fault> for Refusal {
    /// Whoever does not speak MQTT well gets no answer (MQTT 5.0 section 3.1.4).
    fn from(fault: Fault) -> Refusal {
        Refusal {
            answer: &[],
            what: fault.what,
        }
    }
}

/// Length of the packet at the start of `bytes`, as soon as the whole of it is there.
///
/// # Errors
/// A first byte no client may send, a malformed length, more than [`MAX_PACKET_BYTES`]. Close the
/// connection: the start of the next packet is not known.
pub(super) fn packet_length(bytes: &[u8]) -> Result<Option<usize>, Fault> {
    let Some((&first, rest)) = bytes.split_first() else {
        return Ok(None);
    };
    let flags_valid = match first >> 4 {
        kind::PUBLISH => true,
        kind::PUBREL | kind::SUBSCRIBE | kind::UNSUBSCRIBE => first & 0x0F == 0x02,
        kind::CONNECT | kind::PUBACK | kind::PUBREC | kind::PUBCOMP | kind::PINGREQ | kind::DISCONNECT => {
            first & 0x0F == 0
        }
        _ => {
            return Err(Fault::protocol(format!(
                "packet with first byte {first:#04x} is not for a broker"
            )));
        }
    };
    if !flags_valid {
        return Err(Fault::malformed(format!("first byte {first:#04x} has wrong flags")));
    }
    let Some((field, body)) = variable_integer(rest) else {
        return match rest.len() {
            0..4 => Ok(None),
            _ => Err(Fault::malformed("remaining length has more than four bytes")),
        };
    };
    let length = 1 + field + body;
    if length > MAX_PACKET_BYTES {
        let what = format!("packet of {length} bytes, at most {MAX_PACKET_BYTES} are taken");
        return Err(Fault {
            reason: DisconnectReasonCode::PacketTooLarge,
            what,
        });
    }
    Ok((bytes.len() >= length).then_some(length))
}

/// Reads the first packet of a connection, which has to be a CONNECT.
///
/// # Errors
/// With an answer for a version that is not served, without for anything that is no good CONNECT.
pub(super) fn read_connect(packet: &[u8]) -> Result<Connect, Refusal> {
    let frame = split(packet)?;
    if frame.kind() != kind::CONNECT {
        return Err(Fault::protocol("first packet is no CONNECT").into());
    }
    // Length-prefixed protocol name, level, flags: sections 3.1.2.1 to 3.1.2.3.
    let (level, flags) = match frame.body {
        [0, 4, b'M', b'Q', b'T', b'T', level, flags, ..] => (*level, *flags),
        [0, 6, b'M', b'Q', b'I', b's', b'd', b'p', level, flags, ..] => (*level, *flags),
        _ => return Err(Fault::protocol("CONNECT without the name of the protocol").into()),
    };
    let version = match level {
        4 => Version::V311,
        5 => Version::V5,
        other => {
            // 3.1.1 section 3.1.2.2: CONNACK 0x01, and older clients understand it too.
            let what = format!("protocol level {other}; 4 (3.1.1) and 5 are served");
            return Err(Refusal {
                answer: &[0x20, 0x02, 0x00, 0x01],
                what,
            });
        }
    };
    if flags & 1 != 0 {
        return Err(Fault::malformed("reserved flag of CONNECT is set").into());
    }
    let connect = match version {
        Version::V311 => v311::read_connect(BytesMut::from(packet))?,
        Version::V5 => {
            check_connect_properties(&frame, flags)?;
            v5::read_connect(BytesMut::from(packet))?
        }
    };
    if connect.client_id.contains('\0') {
        return Err(Fault::malformed("null character in the client id").into());
    }
    Ok(connect)
}

/// Reads one whole packet that follows the CONNECT.
///
/// # Errors
/// Malformed, or not allowed to a client here: close the connection.
pub(super) fn read(version: Version, packet: &[u8]) -> Result<Incoming, Fault> {
    let frame = split(packet)?;
    match frame.kind() {
        kind::CONNECT => return Err(Fault::protocol("second CONNECT")),
        // Nothing is sent at QoS 2, so there is nothing to answer in this way.
        kind::PUBREC | kind::PUBCOMP => return Err(Fault::protocol("answer to a QoS 2 message that was not sent")),
        kind::PINGREQ | kind::DISCONNECT if frame.body.is_empty() => {}
        kind::PINGREQ => return Err(Fault::malformed("PINGREQ with content")),
        kind::DISCONNECT if version == Version::V311 => return Err(Fault::malformed("DISCONNECT with content")),
        _ => {}
    }
    let incoming = match version {
        Version::V311 => v311::read(BytesMut::from(packet))?,
        Version::V5 => {
            check_properties(&frame)?;
            v5::read(complete_disconnect(&frame, packet))?
        }
    };
    check_content(&incoming)?;
    Ok(incoming)
}

/// Appends `outgoing` to `output`, unless the packet is larger than `max_packet` bytes: the
/// return value tells whether it went in.
pub(super) fn write(version: Version, outgoing: &Outgoing, max_packet: u32, output: &mut BytesMut) -> bool {
    let before = output.len();
    let written = match version {
        Version::V311 => v311::write(outgoing, max_packet, output),
        Version::V5 => v5::write(outgoing, max_packet, output),
    };
    if !written {
        output.truncate(before);
    }
    written
}

fn split(packet: &[u8]) -> Result<Frame<'_>, Fault> {
    let (&first, rest) = packet.split_first().ok_or_else(|| Fault::malformed("empty packet"))?;
    let (field, length) = variable_integer(rest).ok_or_else(|| Fault::malformed("remaining length"))?;
    match rest.get(field..) {
        Some(body) if body.len() == length => Ok(Frame { first, body }),
        _ => Err(Fault::malformed("packet is not as long as it says")),
    }
}

/// What the library's types cannot express and its readers do not check.
fn check_content(incoming: &Incoming) -> Result<(), Fault> {
    match incoming {
        Incoming::Publish(publish) => {
            // A v5 topic may be left out for an alias; the connection knows the aliases.
            let named = super::topic::is_name(&publish.topic) || (publish.topic.is_empty() && publish.alias.is_some());
            if !named {
                let what = format!("{:?} is no topic to publish to", publish.topic);
                return Err(Fault {
                    reason: DisconnectReasonCode::TopicNameInvalid,
                    what,
                });
            }
            let response = publish
                .properties
                .as_ref()
                .and_then(|properties| properties.response_topic.as_deref());
            if response.is_some_and(|topic| !super::topic::is_name(topic)) {
                return Err(Fault::protocol("response topic is no topic name"));
            }
            Ok(())
        }
        Incoming::PubAck(pkid)
        | Incoming::PubRel(pkid)
        | Incoming::Subscribe { pkid, .. }
        | Incoming::Unsubscribe { pkid, .. }
            if *pkid == 0 =>
        {
            Err(Fault::malformed("packet identifier 0"))
        }
        Incoming::Unsubscribe { filters, .. } if filters.is_empty() => Err(Fault::protocol("UNSUBSCRIBE from nothing")),
        Incoming::Subscribe { id: Some(0), .. } => Err(Fault::protocol("subscription identifier 0")),
        _ => Ok(()),
    }
}

/// A v5 DISCONNECT in the one form the library reads: reason code and property length present.
fn complete_disconnect(frame: &Frame<'_>, packet: &[u8]) -> BytesMut {
    if frame.kind() != kind::DISCONNECT {
        return BytesMut::from(packet);
    }
    match frame.body {
        [] => BytesMut::from([frame.first, 2, 0, 0].as_slice()),
        [reason] => BytesMut::from([frame.first, 2, *reason, 0].as_slice()),
        _ => BytesMut::from(packet),
    }
}

/// Checks the property section of a v5 packet other than CONNECT.
fn check_properties(frame: &Frame<'_>) -> Result<(), Fault> {
    let body = frame.body;
    let start = match frame.kind() {
        kind::PUBLISH => {
            let pkid = if frame.first & 0b0110 == 0 { 0 } else { 2 };
            prefixed(body).map(|topic| topic + pkid)
        }
        kind::SUBSCRIBE | kind::UNSUBSCRIBE => Some(2),
        // Reason code and properties may be left out, from the end.
        kind::PUBACK | kind::PUBREL if body.len() <= 3 => return Ok(()),
        kind::PUBACK | kind::PUBREL => Some(3),
        kind::DISCONNECT if body.len() <= 1 => return Ok(()),
        kind::DISCONNECT => Some(1),
        _ => return Ok(()),
    };
    start
        .and_then(|start| body.get(start..))
        .and_then(properties_length)
        .map(|_| ())
        .ok_or_else(|| Fault::malformed("properties do not fit their length"))
}

/// Checks both property sections of a v5 CONNECT: its own, and that of the will.
fn check_connect_properties(frame: &Frame<'_>, flags: u8) -> Result<(), Fault> {
    let fault = || Fault::malformed("properties of CONNECT do not fit their length");
    // Name 6, level 1, flags 1, keep alive 2.
    let own = frame.body.get(10..).ok_or_else(fault)?;
    let payload = properties_length(own)
        .and_then(|length| own.get(length..))
        .ok_or_else(fault)?;
    if flags & 0b100 == 0 {
        return Ok(());
    }
    prefixed(payload)
        .and_then(|client_id| payload.get(client_id..))
        .and_then(properties_length)
        .map(|_| ())
        .ok_or_else(fault)
}

/// Length of the property section at the start of `bytes`, its own length field included, when
/// every property ends inside it and none but the repeatable ones occurs twice
/// (MQTT 5.0 section 2.2.2.2).
fn properties_length(bytes: &[u8]) -> Option<usize> {
    let (field, content) = variable_integer(bytes)?;
    let mut rest = bytes.get(field..field + content)?;
    let mut seen = 0_u64;
    while let Some((&id, value)) = rest.split_first() {
        let length = match id {
            1 | 23 | 25 | 36 | 37 | 40..=42 => 1,
            19 | 33..=35 => 2,
            2 | 17 | 24 | 39 => 4,
            3 | 8 | 9 | 18 | 21 | 22 | 26 | 28 | 31 => prefixed(value)?,
            11 => variable_integer(value)?.0,
            38 => {
                let key = prefixed(value)?;
                key + prefixed(value.get(key..)?)?
            }
            _ => return None,
        };
        let bit = 1_u64 << id;
        if seen & bit != 0 && !matches!(id, 11 | 38) {
            return None;
        }
        seen |= bit;
        rest = value.get(length..)?;
    }
    Some(field + content)
}

/// Length of a string or of binary data at the start of `bytes`, with its two bytes of length.
fn prefixed(bytes: &[u8]) -> Option<usize> {
    let [high, low, rest @ ..] = bytes else { return None };
    let length = usize::from(u16::from_be_bytes([*high, *low]));
    (rest.len() >= length).then_some(2 + length)
}

/// Variable byte integer at the start of `bytes`: its own length (1 to 4) and its value.
fn variable_integer(bytes: &[u8]) -> Option<(usize, usize)> {
    let mut value = 0;
    for (index, byte) in bytes.iter().take(4).enumerate() {
        value |= usize::from(byte & 0x7F) << (7 * index);
        if byte & 0x80 == 0 {
            return Some((index + 1, value));
        }
    }
    None
}

#[cfg(test)]
mod tests;
