//! MQTT 5.0 (level 5) through the library's packet types.

use std::time::Duration;

use bytes::BytesMut;
use rumqttc::v5::mqttbytes::v5::{
    self, ConnAckProperties, ConnectReturnCode, Packet, PubAckReason, PubCompReason, PubRecReason, PublishProperties,
};

use super::packet::{ConnAck, Connect, Expiry, Fault, Incoming, Outbound, Outgoing, Publish, Version, Will};
use super::{MAX_PACKET_BYTES, MAX_TOPIC_ALIAS, RECEIVE_MAXIMUM};
use rumqttc::v5::mqttbytes::v5::DisconnectReasonCode;

/// Reads a checked CONNECT of level 5.
pub(super) fn read_connect(mut packet: BytesMut) -> Result<Connect, Fault> {
    let Packet::Connect(connect, will, _) = read_packet(&mut packet)? else {
        return Err(Fault::protocol("first packet is no CONNECT"));
    };
    let will = match will {
        None => None,
        Some(will) => Some(Will::new(will).ok_or_else(|| Fault::protocol("the will has no topic name"))?),
    };
    let properties = connect.properties.as_ref();
    let receive_maximum = properties
        .and_then(|properties| properties.receive_maximum)
        .unwrap_or(u16::MAX);
    let max_packet = properties
        .and_then(|properties| properties.max_packet_size)
        .unwrap_or(u32::MAX);
    if receive_maximum == 0 || max_packet == 0 {
        return Err(Fault::protocol("receive maximum or maximum packet size 0"));
    }
    Ok(Connect {
        version: Version::V5,
        clean_start: connect.clean_start,
        expiry: Expiry::from_seconds(properties.and_then(|properties| properties.session_expiry_interval)),
        keep_alive: Duration::from_secs(u64::from(connect.keep_alive)),
        receive_maximum,
        max_packet,
        will,
        authentication: properties.is_some_and(|properties| properties.authentication_method.is_some()),
        client_id: connect.client_id,
    })
}

/// Reads a checked packet.
pub(super) fn read(mut packet: BytesMut) -> Result<Incoming, Fault> {
    Ok(match read_packet(&mut packet)? {
        Packet::Publish(publish) => Incoming::Publish(read_publish(publish)?),
        Packet::PubAck(ack) => Incoming::PubAck(ack.pkid),
        Packet::PubRel(release) => Incoming::PubRel(release.pkid),
        Packet::Subscribe(subscribe) => Incoming::Subscribe {
            pkid: subscribe.pkid,
            filters: subscribe.filters,
            id: subscribe.properties.and_then(|properties| properties.id),
        },
        Packet::Unsubscribe(unsubscribe) => Incoming::Unsubscribe {
            pkid: unsubscribe.pkid,
            filters: unsubscribe.filters,
        },
        Packet::PingReq(_) => Incoming::PingReq,
        Packet::Disconnect(disconnect) => Incoming::Disconnect {
            reason: disconnect.reason_code,
            session_expiry: disconnect
                .properties
                .and_then(|properties| properties.session_expiry_interval),
        },
        _ => return Err(Fault::protocol("packet is not for a broker")),
    })
}

/// Appends `outgoing`; false when it does not go out.
pub(super) fn write(outgoing: &Outgoing, max_packet: u32, output: &mut BytesMut) -> bool {
    let packet = match outgoing {
        Outgoing::ConnAck(ack) => Packet::ConnAck(connack(ack)),
        Outgoing::Publish(outbound) => Packet::Publish(publish(outbound)),
        Outgoing::PubAck(pkid, reason) => Packet::PubAck(v5::PubAck {
            pkid: *pkid,
            reason: *reason,
            properties: None,
        }),
        Outgoing::PubRec(pkid, reason) => Packet::PubRec(v5::PubRec {
            pkid: *pkid,
            reason: received(*reason),
            properties: None,
        }),
        Outgoing::PubComp(pkid, known) => {
            let reason = if *known {
                PubCompReason::Success
            } else {
                PubCompReason::PacketIdentifierNotFound
            };
            Packet::PubComp(v5::PubComp {
                pkid: *pkid,
                reason,
                properties: None,
            })
        }
        Outgoing::SubAck(pkid, codes) => Packet::SubAck(v5::SubAck {
            pkid: *pkid,
            return_codes: codes.clone(),
            properties: None,
        }),
        Outgoing::UnsubAck(pkid, reasons) => Packet::UnsubAck(v5::UnsubAck {
            pkid: *pkid,
            reasons: reasons.clone(),
            properties: None,
        }),
        Outgoing::PingResp => Packet::PingResp(v5::PingResp),
        // By hand: for a reason without properties the library writes a wrong length, and for one
        // with empty properties no reason.
        Outgoing::Disconnect(reason) => {
            output.extend_from_slice(&[0xE0, 2, *reason as u8, 0]);
            return true;
        }
    };
    packet.write(output, Some(max_packet)).is_ok()
}

fn read_packet(packet: &mut BytesMut) -> Result<Packet, Fault> {
    Packet::read(packet, None).map_err(|error| Fault::malformed(error.to_string()))
}

fn read_publish(publish: v5::Publish) -> Result<Publish, Fault> {
    let topic =
        String::from_utf8(publish.topic.to_vec()).map_err(|_| Fault::malformed("topic of PUBLISH is not UTF-8"))?;
    let mut properties = publish.properties;
    let mut alias = None;
    if let Some(properties) = &mut properties {
        if !properties.subscription_identifiers.is_empty() {
            return Err(Fault::protocol("PUBLISH of a client with a subscription identifier"));
        }
        alias = properties.topic_alias.take();
    }
    if alias.is_some_and(|alias| alias == 0 || alias > MAX_TOPIC_ALIAS) {
        let what = format!("topic alias {alias:?} is not in 1 to {MAX_TOPIC_ALIAS}");
        return Err(Fault {
            reason: DisconnectReasonCode::TopicAliasInvalid,
            what,
        });
    }
    Ok(Publish {
        topic,
        payload: publish.payload,
        qos: publish.qos,
        retain: publish.retain,
        pkid: publish.pkid,
        alias,
        properties,
    })
}

/// What this broker can do goes with every acceptance (MQTT 5.0 section 3.2.2.3).
fn connack(ack: &ConnAck) -> v5::ConnAck {
    let accepted = ack.code == ConnectReturnCode::Success;
    let properties = accepted.then(|| ConnAckProperties {
        session_expiry_interval: None,
        receive_max: Some(RECEIVE_MAXIMUM),
        max_qos: None,
        retain_available: None,
        max_packet_size: u32::try_from(MAX_PACKET_BYTES).ok(),
        assigned_client_identifier: ack.assigned.clone(),
        topic_alias_max: Some(MAX_TOPIC_ALIAS),
        reason_string: None,
        user_properties: Vec::new(),
        wildcard_subscription_available: None,
        subscription_identifiers_available: None,
        shared_subscription_available: Some(0),
        server_keep_alive: None,
        response_information: None,
        server_reference: None,
        authentication_method: None,
        authentication_data: None,
    });
    v5::ConnAck {
        session_present: ack.session_present,
        code: ack.code,
        properties,
    }
}

fn publish(outbound: &Outbound) -> v5::Publish {
    let message = &outbound.message;
    let mut properties = message.properties.clone().unwrap_or_default();
    properties.message_expiry_interval = outbound.expires_in;
    properties
        .subscription_identifiers
        .clone_from(&outbound.subscription_ids);
    let properties = (properties != PublishProperties::default()).then_some(properties);
    let mut publish = v5::Publish::new(
        message.topic.as_str(),
        outbound.qos,
        message.payload.clone(),
        properties,
    );
    publish.pkid = outbound.pkid;
    publish.dup = outbound.dup;
    publish.retain = outbound.retain;
    publish
}

/// PUBREC has the reasons of PUBACK (MQTT 5.0 sections 3.4.2.1 and 3.5.2.1).
fn received(reason: PubAckReason) -> PubRecReason {
    match reason {
        PubAckReason::Success => PubRecReason::Success,
        PubAckReason::NoMatchingSubscribers => PubRecReason::NoMatchingSubscribers,
        PubAckReason::UnspecifiedError => PubRecReason::UnspecifiedError,
        PubAckReason::ImplementationSpecificError => PubRecReason::ImplementationSpecificError,
        PubAckReason::NotAuthorized => PubRecReason::NotAuthorized,
        PubAckReason::TopicNameInvalid => PubRecReason::TopicNameInvalid,
        PubAckReason::PacketIdentifierInUse => PubRecReason::PacketIdentifierInUse,
        PubAckReason::QuotaExceeded => PubRecReason::QuotaExceeded,
        PubAckReason::PayloadFormatInvalid => PubRecReason::PayloadFormatInvalid,
    }
}
