//! Vectors for what the checks are there for, and noise and damaged packets for the readers.

use bytes::Bytes;
use proptest::prelude::*;
use rumqttc::mqttbytes::v4;
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5 as five;

use super::super::packet::{ConnAck, Expiry, Message, Outbound};
use super::*;

/// A packet with the right remaining length around `body`.
fn packet(first: u8, body: &[u8]) -> Vec<u8> {
    let mut bytes = vec![first];
    let mut length = body.len();
    loop {
        let low = u8::try_from(length % 128).unwrap();
        length /= 128;
        bytes.push(if length > 0 { low | 0x80 } else { low });
        if length == 0 {
            break;
        }
    }
    bytes.extend_from_slice(body);
    bytes
}

fn read_v5(first: u8, body: &[u8]) -> Result<Incoming, Fault> {
    read(Version::V5, &packet(first, body))
}

fn read_v311(first: u8, body: &[u8]) -> Result<Incoming, Fault> {
    read(Version::V311, &packet(first, body))
}

#[test]
fn a_packet_is_cut_out_when_it_is_whole() {
    assert_eq!(packet_length(&[]), Ok(None));
    assert_eq!(packet_length(&[0x30]), Ok(None));
    assert_eq!(packet_length(&[0x30, 0x80]), Ok(None));
    assert_eq!(packet_length(&[0x30, 0x02, 0]), Ok(None));
    assert_eq!(packet_length(&[0x30, 0x02, 0, 0]), Ok(Some(4)));
    assert_eq!(packet_length(&[0xC0, 0x00, 0xC0]), Ok(Some(2)));
    let long = packet(0x30, &[0; 20_000]);
    assert_eq!(packet_length(&long), Ok(Some(20_004)));
    assert_eq!(packet_length(long.get(..20_003).unwrap()), Ok(None));
}

#[test]
fn a_bad_first_byte_or_length_is_seen_before_the_rest() {
    for first in [0x00, 0x20, 0x90, 0xB0, 0xD0, 0xF0] {
        assert_eq!(
            packet_length(&[first]).unwrap_err().reason,
            DisconnectReasonCode::ProtocolError,
            "{first:#x}"
        );
    }
    // CONNECT, PUBACK, PUBREL, SUBSCRIBE, UNSUBSCRIBE, PINGREQ, DISCONNECT with wrong flags.
    for first in [0x11, 0x42, 0x60, 0x80, 0xA0, 0xC8, 0xE1] {
        assert_eq!(
            packet_length(&[first]).unwrap_err().reason,
            DisconnectReasonCode::MalformedPacket,
            "{first:#x}"
        );
    }
    let endless = [0x30, 0x80, 0x80, 0x80, 0x80];
    assert_eq!(
        packet_length(&endless).unwrap_err().reason,
        DisconnectReasonCode::MalformedPacket
    );
    // 0x10 0x80 0x10 = 262160 bytes.
    assert_eq!(
        packet_length(&[0x30, 0x90, 0x80, 0x10]).unwrap_err().reason,
        DisconnectReasonCode::PacketTooLarge
    );
}

#[test]
fn the_level_byte_chooses_the_version() {
    let body = |name: &[u8], level: u8, rest: &[u8]| {
        let mut body = vec![0, u8::try_from(name.len()).unwrap()];
        body.extend_from_slice(name);
        body.push(level);
        body.extend_from_slice(rest);
        packet(0x10, &body)
    };
    // Flags: clean; keep alive 10 s; client id "ab".
    let old = read_connect(&body(b"MQTT", 4, &[0x02, 0, 10, 0, 2, b'a', b'b'])).unwrap();
    assert_eq!(
        (old.version, old.client_id.as_str(), old.expiry),
        (Version::V311, "ab", Expiry::AtOnce)
    );
    assert_eq!(old.keep_alive.as_secs(), 10);
    // The same with no properties.
    let new = read_connect(&body(b"MQTT", 5, &[0x02, 0, 10, 0, 0, 2, b'a', b'b'])).unwrap();
    assert_eq!(
        (new.version, new.client_id.as_str(), new.clean_start),
        (Version::V5, "ab", true)
    );

    for refused in [
        body(b"MQIsdp", 3, &[0x02, 0, 10, 0, 1, b'a']),
        body(b"MQTT", 6, &[0x02, 0, 10]),
    ] {
        assert_eq!(
            read_connect(&refused).unwrap_err().answer,
            [0x20, 2, 0, 1],
            "level not served"
        );
    }
    for refused in [
        body(b"HTTP", 4, &[0x02, 0, 10, 0, 1, b'a']),
        body(b"MQTT", 4, &[0x03, 0, 10, 0, 1, b'a']),
        body(b"MQTT", 4, &[0x22, 0, 10, 0, 1, b'a']),
        body(b"MQTT", 5, &[0x02, 0, 10, 0, 0, 9, b'a']),
        packet(0xC0, &[]),
    ] {
        assert!(read_connect(&refused).unwrap_err().answer.is_empty(), "{refused:?}");
    }
}

#[test]
fn the_usual_short_forms_of_disconnect_are_read() {
    for (body, reason) in [
        (&[][..], DisconnectReasonCode::NormalDisconnection),
        (&[0x04], DisconnectReasonCode::DisconnectWithWillMessage),
        (&[0x04, 0], DisconnectReasonCode::DisconnectWithWillMessage),
    ] {
        assert_eq!(
            read_v5(0xE0, body),
            Ok(Incoming::Disconnect {
                reason,
                session_expiry: None
            }),
            "{body:?}"
        );
    }
    // Session expiry interval 60 s.
    let expiry = read_v5(0xE0, &[0x00, 5, 17, 0, 0, 0, 60]).unwrap();
    let reason = DisconnectReasonCode::NormalDisconnection;
    assert_eq!(
        expiry,
        Incoming::Disconnect {
            reason,
            session_expiry: Some(60)
        }
    );
    assert_eq!(
        read_v311(0xE0, &[]).unwrap(),
        Incoming::Disconnect {
            reason,
            session_expiry: None
        }
    );
}

#[test]
fn a_property_does_not_run_into_the_payload() {
    // Topic "t"; one byte of properties; a content type that would take the payload with it.
    let overrun = [0, 1, b't', 1, 3, 0, 2, b'h', b'i'];
    assert_eq!(
        read_v5(0x30, &overrun).unwrap_err().reason,
        DisconnectReasonCode::MalformedPacket
    );
    // The same, long enough.
    let good = [0, 1, b't', 5, 3, 0, 2, b'h', b'i', b'x'];
    let Incoming::Publish(publish) = read_v5(0x30, &good).unwrap() else {
        panic!("no PUBLISH")
    };
    assert_eq!(publish.payload, Bytes::from_static(b"x"));
    assert_eq!(publish.properties.unwrap().content_type.as_deref(), Some("hi"));
    // Payload format indicator twice.
    let twice = [0, 1, b't', 4, 1, 0, 1, 0];
    assert_eq!(
        read_v5(0x30, &twice).unwrap_err().reason,
        DisconnectReasonCode::MalformedPacket
    );
}

#[test]
fn the_properties_of_connect_and_will_end_where_they_say() {
    // Level 5; clean start; keep alive 0.
    let head = |flags: u8| vec![0, 4, b'M', b'Q', b'T', b'T', 5, flags, 0, 0];
    let read = |flags: u8, rest: &[u8]| read_connect(&packet(0x10, &[&head(flags)[..], rest].concat())).is_ok();
    // Receive maximum 5; client id "a".
    assert!(read(0x02, &[3, 33, 0, 5, 0, 1, b'a']));
    // One byte too few: the identifier would be taken for the rest of the property.
    assert!(!read(0x02, &[2, 33, 0, 5, 0, 1, b'a']));
    // The same twice.
    assert!(!read(0x02, &[6, 33, 0, 5, 33, 0, 5, 0, 1, b'a']));
    // Will delay 1 s; topic "w"; message "x".
    assert!(read(0x06, &[0, 0, 1, b'a', 5, 24, 0, 0, 0, 1, 0, 1, b'w', 0, 1, b'x']));
    assert!(!read(0x06, &[0, 0, 1, b'a', 4, 24, 0, 0, 0, 1, 0, 1, b'w', 0, 1, b'x']));
}

#[test]
fn malformed_packets_are_refused_not_swallowed() {
    for (first, body) in [
        (0x30, &[0, 5, b't'][..]),                // topic longer than the packet
        (0x30, &[0, 1, b't']),                    // no properties
        (0x30, &[0, 1, b't', 0x80]),              // property length without end
        (0x32, &[0, 1, b't', 0, 0, 0]),           // packet identifier 0
        (0x36, &[0, 1, b't', 0, 1, 0]),           // QoS 3
        (0x30, &[0, 1, 0xFF, 0]),                 // topic is not UTF-8
        (0x30, &[0, 1, b'+', 0]),                 // wildcard in a topic
        (0x30, &[0, 0, 0]),                       // neither topic nor alias
        (0x30, &[0, 0, 3, 35, 0, 0]),             // alias 0
        (0x30, &[0, 0, 3, 35, 0, 33]),            // alias above the maximum
        (0x30, &[0, 1, b't', 2, 11, 1]),          // subscription identifier of a client
        (0x30, &[0, 1, b't', 4, 8, 0, 1, b'#']),  // response topic with wildcard
        (0x82, &[0, 1, 0]),                       // no filter
        (0x82, &[0, 1, 0, 0, 1, b't']),           // filter without options
        (0x82, &[0, 1, 0, 0, 1, b't', 0x30]),     // retain handling 3
        (0x82, &[0, 0, 0, 0, 1, b't', 0]),        // packet identifier 0
        (0x82, &[0, 1, 2, 11, 0, 0, 1, b't', 0]), // subscription identifier 0
        (0xA2, &[0, 1, 0]),                       // nothing to unsubscribe from
        (0x40, &[0]),                             // half an identifier
        (0x40, &[0, 0]),                          // packet identifier 0
        (0x40, &[0, 1, 0x55]),                    // unknown reason
        (0x50, &[0, 1]),                          // PUBREC: nothing was sent at QoS 2
        (0xE0, &[0x55]),                          // unknown reason
        (0xC0, &[0]),                             // PINGREQ with content
    ] {
        assert!(read_v5(first, body).is_err(), "{first:#x} {body:?}");
    }
    for (first, body) in [
        (0x30, &[0, 5, b't'][..]),
        (0x32, &[0, 1, b't', 0, 0]),
        (0x36, &[0, 1, b't', 0, 1]),
        (0x30, &[0, 0]),
        (0x82, &[0, 1]),
        (0x82, &[0, 1, 0, 1, b't', 3]),
        (0xA2, &[0, 1]),
        (0xA2, &[0]),
        (0xA2, &[0, 1, 0]),
        (0x40, &[]),
        (0xE0, &[0]),
    ] {
        assert!(read_v311(first, body).is_err(), "{first:#x} {body:?}");
    }
}

#[test]
fn what_is_too_large_for_the_client_leaves_no_trace() {
    let message = Message {
        topic: String::from("topic"),
        payload: Bytes::from_static(&[7; 100]),
        qos: QoS::AtMostOnce,
        retain: false,
        properties: None,
        expires: None,
    };
    let outbound = Outbound {
        message: std::sync::Arc::new(message),
        qos: QoS::AtMostOnce,
        retain: false,
        pkid: 0,
        dup: false,
        subscription_ids: vec![],
        expires_in: None,
    };
    for version in [Version::V311, Version::V5] {
        let mut output = BytesMut::from(&b"before"[..]);
        assert!(!write(version, &Outgoing::Publish(outbound.clone()), 100, &mut output));
        assert_eq!(&output[..], b"before");
        assert!(write(version, &Outgoing::Publish(outbound.clone()), 200, &mut output));
    }
}

#[test]
fn a_v5_disconnect_says_its_length() {
    let mut output = BytesMut::new();
    assert!(write(
        Version::V5,
        &Outgoing::Disconnect(DisconnectReasonCode::SessionTakenOver),
        100,
        &mut output
    ));
    assert_eq!(&output[..], [0xE0, 2, 0x8E, 0]);
    output.clear();
    assert!(write(
        Version::V311,
        &Outgoing::Disconnect(DisconnectReasonCode::SessionTakenOver),
        100,
        &mut output
    ));
    assert!(output.is_empty());
}

#[test]
fn every_refusal_can_be_written_in_both_versions() {
    use five::ConnectReturnCode as Code;
    for code in [
        Code::Success,
        Code::ClientIdentifierNotValid,
        Code::BadAuthenticationMethod,
    ] {
        for version in [Version::V311, Version::V5] {
            let ack = ConnAck {
                code,
                session_present: false,
                assigned: Some(String::from("x")),
            };
            assert!(write(version, &Outgoing::ConnAck(ack), u32::MAX, &mut BytesMut::new()));
        }
    }
}

/// Reads whatever can be read, as a connection does; the end is a fault or the lack of bytes.
fn read_stream(version: Version, mut bytes: &[u8]) {
    while let Ok(Some(length)) = packet_length(bytes) {
        let (packet, rest) = bytes.split_at(length);
        let _ = read_connect(packet);
        let _ = read(version, packet);
        bytes = rest;
    }
}

/// Good packets of both versions, written by the library.
fn samples() -> Vec<Vec<u8>> {
    let user = vec![(String::from("key"), String::from("value"))];
    let properties = five::PublishProperties {
        payload_format_indicator: Some(1),
        message_expiry_interval: Some(30),
        topic_alias: Some(3),
        response_topic: Some(String::from("answer/here")),
        correlation_data: Some(Bytes::from_static(b"\x00\x01")),
        user_properties: user.clone(),
        subscription_identifiers: vec![],
        content_type: Some(String::from("text/plain")),
    };
    let mut publish = five::Publish::new("a/b", QoS::AtLeastOnce, "payload", Some(properties));
    publish.pkid = 7;
    let will_properties = five::LastWillProperties {
        delay_interval: Some(5),
        payload_format_indicator: Some(1),
        message_expiry_interval: Some(9),
        content_type: Some(String::from("c")),
        response_topic: Some(String::from("r")),
        correlation_data: Some(Bytes::from_static(b"d")),
        user_properties: user.clone(),
    };
    let connect = five::Connect {
        keep_alive: 10,
        client_id: String::from("client"),
        clean_start: true,
        properties: Some(five::ConnectProperties {
            session_expiry_interval: Some(60),
            receive_maximum: Some(5),
            max_packet_size: Some(1000),
            user_properties: user.clone(),
            ..five::ConnectProperties::default()
        }),
    };
    let will = five::LastWill::new("will", "gone", QoS::AtLeastOnce, true, Some(will_properties));
    let subscribe = five::Subscribe {
        pkid: 2,
        filters: vec![
            five::Filter::new("a/+/#", QoS::ExactlyOnce),
            five::Filter::new("b", QoS::AtMostOnce),
        ],
        properties: Some(five::SubscribeProperties {
            id: Some(300),
            user_properties: user,
        }),
    };
    let five = [
        five::Packet::Connect(connect, Some(will), Some(five::Login::new("user", "word"))),
        five::Packet::Publish(publish),
        five::Packet::Subscribe(subscribe),
        five::Packet::Unsubscribe(five::Unsubscribe {
            pkid: 3,
            ..five::Unsubscribe::new("a/+/#", None)
        }),
        five::Packet::PubAck(five::PubAck::new(7, None)),
        five::Packet::PubRel(five::PubRel::new(7, None)),
        five::Packet::Disconnect(five::Disconnect::new(DisconnectReasonCode::NormalDisconnection)),
    ];
    let mut old_connect = v4::Connect::new("client");
    old_connect.last_will = Some(v4::LastWill::new(
        "will",
        "gone",
        rumqttc::mqttbytes::QoS::AtLeastOnce,
        true,
    ));
    old_connect.set_login("user", "word");
    let mut old_publish = v4::Publish::new("a/b", rumqttc::mqttbytes::QoS::AtLeastOnce, "payload");
    old_publish.pkid = 7;
    let mut old_subscribe = v4::Subscribe::new("a/+/#", rumqttc::mqttbytes::QoS::ExactlyOnce);
    old_subscribe.pkid = 2;
    let mut old_unsubscribe = v4::Unsubscribe::new("a/+/#");
    old_unsubscribe.pkid = 3;
    let four = [
        v4::Packet::Connect(old_connect),
        v4::Packet::Publish(old_publish),
        v4::Packet::Subscribe(old_subscribe),
        v4::Packet::Unsubscribe(old_unsubscribe),
        v4::Packet::PubRel(v4::PubRel::new(7)),
        v4::Packet::PingReq,
    ];
    let written = |write: &dyn Fn(&mut BytesMut)| {
        let mut bytes = BytesMut::new();
        write(&mut bytes);
        bytes.to_vec()
    };
    let five = five
        .iter()
        .map(|packet| written(&|bytes| assert!(packet.write(bytes, None).is_ok())));
    let four = four
        .iter()
        .map(|packet| written(&|bytes| assert!(packet.write(bytes, 10_000).is_ok())));
    five.chain(four).collect()
}

#[test]
fn the_sample_packets_are_good() {
    let five = |packet: &[u8]| read(Version::V5, packet).is_ok();
    let four = |packet: &[u8]| read(Version::V311, packet).is_ok();
    for (index, packet) in samples().iter().enumerate() {
        assert_eq!(packet_length(packet), Ok(Some(packet.len())), "{index}");
        let good = match index {
            0 | 7 => read_connect(packet).is_ok(),
            1..7 => five(packet),
            _ => four(packet),
        };
        assert!(good, "sample {index}: {packet:?}");
    }
}

/// A good packet with some bytes changed and its end cut or prolonged, its length set right again in
/// half of the cases so that the damage reaches the readers.
fn damaged() -> impl Strategy<Value = Vec<u8>> {
    let changes = prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..4);
    let tail = prop::collection::vec(any::<u8>(), 0..5);
    (
        prop::sample::select(samples()),
        changes,
        any::<prop::sample::Index>(),
        tail,
        any::<bool>(),
        any::<bool>(),
    )
        .prop_map(|(mut bytes, changes, cut, tail, cutting, framing)| {
            for (index, value) in changes {
                let at = index.index(bytes.len());
                bytes[at] = value;
            }
            if cutting {
                bytes.truncate(cut.index(bytes.len()).max(2));
                bytes.extend_from_slice(&tail);
            }
            if framing { packet(bytes[0], &bytes[2..]) } else { bytes }
        })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    #[test]
    fn noise_does_no_harm(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        read_stream(Version::V311, &bytes);
        read_stream(Version::V5, &bytes);
    }

    #[test]
    fn framed_noise_does_no_harm(
        first in prop::sample::select(vec![0x10_u8, 0x30, 0x31, 0x32, 0x34, 0x36, 0x40, 0x62, 0x82, 0xA2, 0xC0, 0xE0]),
        body in prop::collection::vec(prop_oneof![0_u8..45, any::<u8>()], 0..60),
    ) {
        let bytes = packet(first, &body);
        read_stream(Version::V311, &bytes);
        read_stream(Version::V5, &bytes);
    }

    #[test]
    fn damaged_packets_do_no_harm(bytes in damaged()) {
        read_stream(Version::V311, &bytes);
        read_stream(Version::V5, &bytes);
    }

    #[test]
    fn what_was_read_can_be_passed_on(bytes in damaged()) {
        let now = std::time::Instant::now();
        for from in [Version::V311, Version::V5] {
            let Ok(Some(length)) = packet_length(&bytes) else { continue };
            let Ok(Incoming::Publish(publish)) = read(from, &bytes[..length]) else { continue };
            let message = std::sync::Arc::new(Message::new(publish, now));
            for to in [Version::V311, Version::V5] {
                let outbound = Outbound {
                    message: std::sync::Arc::clone(&message),
                    qos: QoS::AtLeastOnce,
                    retain: false,
                    pkid: 1,
                    dup: false,
                    subscription_ids: vec![1, 268_435_455],
                    expires_in: Some(1),
                };
                let mut output = BytesMut::new();
                prop_assert!(write(to, &Outgoing::Publish(outbound), u32::MAX, &mut output));
                prop_assert_eq!(split(&output).map(|frame| frame.first).ok(), Some(0x32));
            }
        }
    }
}
