//! Encodes packets to clients.

use std::time::Instant;

use super::super::MAX_PACKET_BYTES;
use super::{Message, Qos, Version, property, reason};

/// A CONNACK with this reason code. If the connection is accepted, the CONNACK lists the features that the broker
/// does not support (section 3.2.2.3).
pub(in super::super) fn connack(version: Version, reason: u8, assigned: Option<&str>) -> Vec<u8> {
    if version == Version::V311 {
        // Return codes of table 3.1 in MQTT 3.1.1; a reason without a code there becomes "server unavailable".
        let code = match reason {
            reason::SUCCESS => 0,
            reason::CLIENT_ID_NOT_VALID => 2,
            _ => 3,
        };
        return packet(0x20, &[&[0, code]]);
    }
    let mut properties = Vec::new();
    if reason == reason::SUCCESS {
        properties.extend([property::MAXIMUM_PACKET]);
        properties.extend((MAX_PACKET_BYTES as u32).to_be_bytes());
        properties.extend([property::SESSION_EXPIRY, 0, 0, 0, 0, property::MAXIMUM_QOS, 1]);
        properties.extend([property::SUBSCRIPTION_IDS_AVAILABLE, 0]);
        properties.extend([property::SHARED_SUBSCRIPTIONS_AVAILABLE, 0]);
    }
    if let Some(id) = assigned {
        properties.push(property::ASSIGNED_CLIENT_ID);
        properties.extend(prefixed(id));
    }
    packet(0x20, &[&[0, reason], &variable(properties.len()), &properties])
}

/// CONNACK to a client of a version that is not served, in the form that older clients know (3.1.1 section 3.1.2.2).
pub(in super::super) const UNSUPPORTED_CONNACK: [u8; 4] = [0x20, 2, 0, 1];

/// A message to a client, sent at `now`. `pkid` is 0 at QoS 0.
pub(in super::super) fn publish(version: Version, message: &Message, retain: bool, pkid: u16, now: Instant) -> Vec<u8> {
    let qos = if pkid == 0 { Qos::AtMostOnce } else { Qos::AtLeastOnce };
    let first = 0x30 | ((qos as u8) << 1) | u8::from(retain);
    let id = pkid.to_be_bytes();
    let id = if pkid == 0 { &[][..] } else { &id[..] };
    let mut properties = Vec::new();
    if version == Version::V5 {
        let mut section = Vec::new();
        if let Some(left) = message.left(now) {
            // The time is rounded up, so that no message is delivered with expiry 0 before it expires.
            let seconds = left.as_secs() + u64::from(left.subsec_nanos() > 0);
            section.push(property::MESSAGE_EXPIRY);
            section.extend(u32::try_from(seconds).unwrap_or(u32::MAX).to_be_bytes());
        }
        section.extend_from_slice(&message.properties);
        properties = variable(section.len());
        properties.append(&mut section);
    }
    packet(first, &[&prefixed(&message.topic), id, &properties, &message.payload])
}

/// First byte of each kind of acknowledgement.
pub(in super::super) const PUBACK: u8 = 0x40;
pub(in super::super) const SUBACK: u8 = 0x90;
pub(in super::super) const UNSUBACK: u8 = 0xB0;

/// An acknowledgement with a reason code for each item; 3.1.1 has them for subscriptions only.
pub(in super::super) fn acknowledge(version: Version, first: u8, pkid: u16, codes: &[u8]) -> Vec<u8> {
    let id = pkid.to_be_bytes();
    match (version, first) {
        (Version::V5, PUBACK) => packet(first, &[&id, codes]),
        (Version::V5, _) => packet(first, &[&id, &[0], codes]),
        (Version::V311, SUBACK) => {
            let codes: Vec<u8> = codes.iter().map(|code| (*code).min(0x80)).collect();
            packet(first, &[&id, &codes])
        }
        (Version::V311, _) => packet(first, &[&id]),
    }
}

pub(in super::super) const PINGRESP: [u8; 2] = [0xD0, 0];

/// A DISCONNECT; in 3.1.1 the broker sends none. The gateway's MQTT library cannot read one without a property section.
pub(in super::super) fn disconnect(version: Version, reason: u8) -> Vec<u8> {
    match version {
        Version::V311 => Vec::new(),
        Version::V5 => packet(0xE0, &[&[reason, 0]]),
    }
}

pub(super) fn packet(first: u8, parts: &[&[u8]]) -> Vec<u8> {
    let length: usize = parts.iter().map(|part| part.len()).sum();
    let mut packet = vec![first];
    packet.extend(variable(length));
    parts.iter().for_each(|part| packet.extend_from_slice(part));
    packet
}

pub(super) fn variable(mut value: usize) -> Vec<u8> {
    let mut bytes = Vec::new();
    loop {
        let low = (value & 0x7F) as u8;
        value >>= 7;
        if value == 0 {
            bytes.push(low);
            return bytes;
        }
        bytes.push(low | 0x80);
    }
}

/// Text preceded by its length; the broker writes no text longer than those received from clients.
fn prefixed(text: &str) -> Vec<u8> {
    let mut bytes = (text.len() as u16).to_be_bytes().to_vec();
    bytes.extend_from_slice(text.as_bytes());
    bytes
}
