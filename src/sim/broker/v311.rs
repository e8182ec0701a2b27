//! MQTT 3.1.1 (level 4) through the library's packet types.

use std::time::Duration;

use bytes::BytesMut;
use rumqttc::mqttbytes::v4::{self, Packet};
use rumqttc::mqttbytes::{self, QoS as OldQoS};
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{ConnectReturnCode, DisconnectReasonCode, Filter, LastWill, SubscribeReasonCode};

use super::MAX_PACKET_BYTES;
use super::packet::{Connect, Expiry, Fault, Incoming, Outbound, Outgoing, Publish, Version, Will};

/// Reads a checked CONNECT of level 4.
pub(super) fn read_connect(mut packet: BytesMut) -> Result<Connect, Fault> {
    let Packet::Connect(connect) = read_packet(&mut packet)? else {
        return Err(Fault::protocol("first packet is no CONNECT"));
    };
    let will = match connect.last_will {
        None => None,
        Some(will) => {
            let will = LastWill::new(will.topic, will.message, new_qos(will.qos), will.retain, None);
            Some(Will::new(will).ok_or_else(|| Fault::protocol("the will has no topic name"))?)
        }
    };
    Ok(Connect {
        version: Version::V311,
        client_id: connect.client_id,
        clean_start: connect.clean_session,
        expiry: if connect.clean_session {
            Expiry::AtOnce
        } else {
            Expiry::Never
        },
        keep_alive: Duration::from_secs(u64::from(connect.keep_alive)),
        receive_maximum: u16::MAX,
        max_packet: u32::MAX,
        will,
        authentication: false,
    })
}

/// Reads a checked packet.
pub(super) fn read(mut packet: BytesMut) -> Result<Incoming, Fault> {
    Ok(match read_packet(&mut packet)? {
        Packet::Publish(publish) => Incoming::Publish(Publish {
            topic: publish.topic,
            payload: publish.payload,
            qos: new_qos(publish.qos),
            retain: publish.retain,
            pkid: publish.pkid,
            alias: None,
            properties: None,
        }),
        Packet::PubAck(ack) => Incoming::PubAck(ack.pkid),
        Packet::PubRel(release) => Incoming::PubRel(release.pkid),
        Packet::Subscribe(subscribe) => Incoming::Subscribe {
            pkid: subscribe.pkid,
            filters: subscribe
                .filters
                .into_iter()
                .map(|f| Filter::new(f.path, new_qos(f.qos)))
                .collect(),
            id: None,
        },
        Packet::Unsubscribe(unsubscribe) => Incoming::Unsubscribe {
            pkid: unsubscribe.pkid,
            filters: unsubscribe.topics,
        },
        Packet::PingReq => Incoming::PingReq,
        Packet::Disconnect => Incoming::Disconnect {
            reason: DisconnectReasonCode::NormalDisconnection,
            session_expiry: None,
        },
        _ => return Err(Fault::protocol("packet is not for a broker")),
    })
}

/// Appends `outgoing`; false when it does not go out.
pub(super) fn write(outgoing: &Outgoing, max_packet: u32, output: &mut BytesMut) -> bool {
    let packet = match outgoing {
        Outgoing::ConnAck(ack) => Packet::ConnAck(v4::ConnAck::new(connect_code(ack.code), ack.session_present)),
        Outgoing::Publish(outbound) => Packet::Publish(publish(outbound)),
        // 3.1.1 cannot refuse a message: an acknowledgement is all there is.
        Outgoing::PubAck(pkid, _) => Packet::PubAck(v4::PubAck::new(*pkid)),
        Outgoing::PubRec(pkid, _) => Packet::PubRec(v4::PubRec::new(*pkid)),
        Outgoing::PubComp(pkid, _) => Packet::PubComp(v4::PubComp::new(*pkid)),
        Outgoing::SubAck(pkid, codes) => {
            Packet::SubAck(v4::SubAck::new(*pkid, codes.iter().map(subscribe_code).collect()))
        }
        Outgoing::UnsubAck(pkid, _) => Packet::UnsubAck(v4::UnsubAck::new(*pkid)),
        Outgoing::PingResp => Packet::PingResp,
        Outgoing::Disconnect(_) => return true,
    };
    packet
        .write(output, usize::try_from(max_packet).unwrap_or(usize::MAX))
        .is_ok()
}

fn read_packet(packet: &mut BytesMut) -> Result<Packet, Fault> {
    Packet::read(packet, MAX_PACKET_BYTES).map_err(|error: mqttbytes::Error| Fault::malformed(error.to_string()))
}

fn publish(outbound: &Outbound) -> v4::Publish {
    let message = &outbound.message;
    let mut publish = v4::Publish::from_bytes(message.topic.as_str(), old_qos(outbound.qos), message.payload.clone());
    publish.pkid = outbound.pkid;
    publish.dup = outbound.dup;
    publish.retain = outbound.retain;
    publish
}

/// The return codes of 3.1.1 table 3.1; what it has no word for is "server unavailable".
fn connect_code(code: ConnectReturnCode) -> v4::ConnectReturnCode {
    match code {
        ConnectReturnCode::Success => v4::ConnectReturnCode::Success,
        ConnectReturnCode::UnsupportedProtocolVersion => v4::ConnectReturnCode::RefusedProtocolVersion,
        ConnectReturnCode::ClientIdentifierNotValid => v4::ConnectReturnCode::BadClientId,
        _ => v4::ConnectReturnCode::ServiceUnavailable,
    }
}

fn subscribe_code(code: &SubscribeReasonCode) -> v4::SubscribeReasonCode {
    match code {
        SubscribeReasonCode::Success(qos) => v4::SubscribeReasonCode::Success(old_qos(*qos)),
        _ => v4::SubscribeReasonCode::Failure,
    }
}

fn new_qos(qos: OldQoS) -> QoS {
    match qos {
        OldQoS::AtMostOnce => QoS::AtMostOnce,
        OldQoS::AtLeastOnce => QoS::AtLeastOnce,
        OldQoS::ExactlyOnce => QoS::ExactlyOnce,
    }
}

fn old_qos(qos: QoS) -> OldQoS {
    match qos {
        QoS::AtMostOnce => OldQoS::AtMostOnce,
        QoS::AtLeastOnce => OldQoS::AtLeastOnce,
        QoS::ExactlyOnce => OldQoS::ExactlyOnce,
    }
}
