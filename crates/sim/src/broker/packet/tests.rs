//! Packets are read as they were written, and no input makes a reader panic.

use super::writer::{packet, variable};
use super::*;
use proptest::prelude::*;
use rumqttc::{Packet, PubAck};

const VERSIONS: [Version; 2] = [Version::V311, Version::V5];

fn connect(version: Version) -> Vec<u8> {
    match version {
        Version::V311 => packet(0x10, &[b"\0\x04MQTT\x04\x26\0\x0A", b"\0\x01c\0\x01w\0\x02by"]),
        Version::V5 => packet(
            0x10,
            &[
                b"\0\x04MQTT\x05\x2E\0\x0A\x03\x21\0\x05\0\x01c",
                b"\x05\x18\0\0\0\x09\0\x01w\0\x02by",
            ],
        ),
    }
}

#[test]
fn a_connect_is_read_with_its_will() {
    for version in VERSIONS {
        let now = Instant::now();
        let read = read_connect(&connect(version), now).unwrap();
        assert_eq!(
            (read.version, read.client_id.as_str(), read.refused),
            (version, "c", None)
        );
        assert_eq!(read.keep_alive, Duration::from_secs(10));
        assert_eq!(read.receive_maximum, if version == Version::V5 { 5 } else { 0xFFFF });
        let will = read.will.unwrap();
        assert_eq!(
            (will.topic.as_str(), &will.payload[..], will.retain),
            ("w", &b"by"[..], true)
        );
        assert_eq!(
            will.qos,
            if version == Version::V5 {
                Qos::AtLeastOnce
            } else {
                Qos::AtMostOnce
            }
        );
    }
}

/// Subscribers receive the message as it was published; the test reads it with the MQTT library of the gateway.
#[test]
fn a_message_keeps_its_properties_and_its_life_counts_down() {
    let now = Instant::now();
    let properties = b"\x02\0\0\0\x0A\x08\0\x01r\x09\0\x02\0\xFF\x26\0\x01k\0\x01v";
    let sent = packet(
        0x33,
        &[b"\0\x01t\0\x07", &variable(properties.len()), properties, b"50"],
    );
    let Ok(Incoming::Publish(message, 7)) = read(Version::V5, &sent, now) else {
        panic!()
    };
    assert_eq!((message.qos, message.retain), (Qos::AtLeastOnce, true));
    let late = now + Duration::from_millis(2500);
    assert!(message.is_current(late) && !message.is_current(now + Duration::from_secs(10)));
    let out = publish(Version::V5, &message, false, 9, late);
    let Ok(Packet::Publish(got)) = Packet::read(&mut out[..].into(), None) else {
        panic!("{out:?}")
    };
    let properties = got.properties.unwrap();
    assert_eq!(properties.message_expiry_interval, Some(8));
    assert_eq!(properties.response_topic.as_deref(), Some("r"));
    assert_eq!(properties.correlation_data.as_deref(), Some(&[0, 0xFF][..]));
    assert_eq!(properties.user_properties, [("k".to_string(), "v".to_string())]);
    assert_eq!((got.pkid, &got.payload[..], got.retain), (9, &b"50"[..], false));
    assert_eq!(publish(Version::V311, &message, true, 0, late), b"\x31\x05\0\x01t50");
}

#[test]
fn the_library_of_the_gateway_reads_acknowledgements() {
    let ack = acknowledge(Version::V5, PUBACK, 3, &[reason::QUOTA_EXCEEDED]);
    let read = Packet::read(&mut ack[..].into(), None).unwrap();
    assert!(matches!(read, Packet::PubAck(PubAck { pkid: 3, .. })));
    let accepted = connack(Version::V5, reason::SUCCESS, Some("a-1"));
    let Ok(Packet::ConnAck(ack)) = Packet::read(&mut accepted[..].into(), None) else {
        panic!()
    };
    let properties = ack.properties.unwrap();
    assert_eq!(properties.assigned_client_identifier.as_deref(), Some("a-1"));
    assert_eq!((properties.max_qos, properties.receive_max), (Some(1), None));
    assert_eq!(
        acknowledge(Version::V311, SUBACK, 1, &[1, reason::TOPIC_FILTER_INVALID]),
        [0x90, 4, 0, 1, 1, 0x80]
    );
}

#[test]
fn what_is_not_served_has_its_reason() {
    let reasons = [
        (&b"\x34\x06\0\x01t\0\x01\0"[..], reason::QOS_NOT_SUPPORTED),
        (b"\x30\x07\0\x01t\x03\x23\0\x01", reason::TOPIC_ALIAS_INVALID),
        (b"\x30\x04\0\x01+\0", reason::TOPIC_NAME_INVALID),
        (b"\x30\x08\0\x01t\x04\x08\0\x01#", reason::PROTOCOL_ERROR),
        (b"\x30\x08\0\x01t\x04\x01\0\x01\0", reason::PROTOCOL_ERROR),
        (
            b"\x82\x09\0\x01\x02\x0B\x01\0\x01t\0",
            reason::SUBSCRIPTION_IDS_NOT_SUPPORTED,
        ),
        (b"\x82\x03\0\x01\0", reason::MALFORMED_PACKET),
        (b"\x82\x07\0\x01\0\0\x01t\x03", reason::MALFORMED_PACKET),
        (b"\x40\x02\0\0", reason::MALFORMED_PACKET),
        (b"\xC0\x01\0", reason::MALFORMED_PACKET),
        (b"\x62\x02\0\x01", reason::PROTOCOL_ERROR),
        (b"\x30\x04\0\x01\xFF\0", reason::MALFORMED_PACKET),
    ];
    for (bytes, reason) in reasons {
        let fault = read(Version::V5, bytes, Instant::now()).unwrap_err();
        assert_eq!(fault.reason, reason, "{bytes:02X?}: {}", fault.what);
    }
    assert_eq!(
        packet_length(&[0x30, 0xFF, 0xFF, 0xFF, 0xFF]).unwrap_err().reason,
        reason::MALFORMED_PACKET
    );
    assert_eq!(
        packet_length(&[0x30, 0xFF, 0xFF, 0xFF, 0x7F]).unwrap_err().reason,
        reason::PACKET_TOO_LARGE
    );
    assert_eq!((packet_length(&[]), packet_length(&[0x30, 0x80])), (Ok(None), Ok(None)));
    let level_6 = packet(0x10, &[b"\0\x04MQTT\x06\x02\0\0\0\0\x01x"]);
    let fault = read_connect(&level_6, Instant::now()).unwrap_err();
    assert_eq!(fault.reason, reason::UNSUPPORTED_VERSION);
}

fn packets() -> impl Strategy<Value = Vec<u8>> {
    let body = |first: u8| {
        prop_oneof![
            Just(b"\0\x01t\0\x07\x0A\x02\0\0\0\x0A\x08\0\x01r\x0150".to_vec()),
            Just(b"\0\x01\0\0\x01t\x01".to_vec()),
            Just(b"\0\x01\x10\x02\x1F\0\0".to_vec()),
            prop::collection::vec(any::<u8>(), 0..40),
        ]
        .prop_map(move |body| packet(first, &[&body]))
    };
    prop_oneof![
        any::<u8>().prop_flat_map(body),
        prop::sample::select(VERSIONS.to_vec()).prop_map(connect),
        prop::collection::vec(any::<u8>(), 0..60),
    ]
}

proptest! {
    #[test]
    fn no_input_makes_a_reader_panic(mut bytes in packets(), damage in prop::collection::vec((0..60usize, any::<u8>()), 0..4)) {
        for (at, value) in damage {
            if let Some(byte) = bytes.get_mut(at) {
                *byte = value;
            }
        }
        let now = Instant::now();
        let whole = packet_length(&bytes);
        let _ = read_connect(&bytes, now);
        for version in VERSIONS {
            let _ = read(version, &bytes, now);
            if let Ok(Some(length)) = whole
                && let Ok(Incoming::Publish(message, pkid)) = read(version, &bytes[..length], now)
            {
                // A message that was read and written again is read back equal.
                let out = publish(version, &message, message.retain, pkid, now);
                prop_assert_eq!(read(version, &out, now), Ok(Incoming::Publish(message, pkid)));
            }
        }
    }
}
