//! The broker's capabilities, learned from its CONNACK and its refusals. No I/O.

use rumqttc::mqttbytes::QoS;
use rumqttc::{ConnAck, LastWill};

use super::connection::INFLIGHT;
use super::session::Will;

/// The broker's capabilities.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct BrokerLimits {
    /// Maximum number of unacknowledged messages.
    pub(super) window: usize,
    /// Maximum packet size, bytes.
    pub(super) max_packet: usize,
    /// Whether the broker acknowledges messages (QoS 1).
    pub(super) acknowledges: bool,
    /// Whether the broker keeps retained messages.
    pub(super) retains: bool,
    /// Whether the broker takes filters with `+` and `#`.
    pub(super) wildcards: bool,
    /// Maximum number of topic aliases.
    pub(super) aliases: u16,
    /// Keep-alive interval, in s, that the broker set instead of the gateway's.
    pub(super) keep_alive: Option<u16>,
}

impl BrokerLimits {
    pub(super) fn of(ack: &ConnAck) -> BrokerLimits {
        let properties = ack.properties.as_ref();
        let window = properties.and_then(|p| p.receive_max).unwrap_or(u16::MAX).min(INFLIGHT);
        let max_packet = properties.and_then(|p| p.max_packet_size).unwrap_or(u32::MAX);
        let wildcards = properties.and_then(|p| p.wildcard_subscription_available);
        BrokerLimits {
            window: usize::from(window).max(1),
            max_packet: usize::try_from(max_packet).unwrap_or(usize::MAX),
            acknowledges: properties.and_then(|p| p.max_qos) != Some(0),
            retains: properties.and_then(|p| p.retain_available) != Some(0),
            wildcards: wildcards != Some(0),
            aliases: properties.and_then(|p| p.topic_alias_max).unwrap_or_default(),
            keep_alive: properties.and_then(|p| p.server_keep_alive),
        }
    }

    /// Functions that are lost with a broker without some feature; each text completes a sentence about the broker.
    pub(super) fn losses(&self) -> Vec<&'static str> {
        let all = [
            (
                self.acknowledges,
                "has no QoS 1: events and results in flight when a connection breaks are lost",
            ),
            (
                self.retains,
                "keeps no retained messages: later subscribers get no status, and each value only when it is next \
                 published",
            ),
            (
                self.wildcards,
                "accepts no filters with wildcards: the gateway subscribes drive by drive, and commands for unknown \
                 drives or points get no result",
            ),
        ];
        all.into_iter().filter(|(has, _)| !has).map(|(_, lost)| lost).collect()
    }
}

/// Why a broker refuses a last will.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Lack {
    /// The broker has no QoS 1.
    Acknowledgements,
    /// The broker keeps no retained messages.
    Retained,
}

/// The form of the last will that the broker is known to accept. The will is part of the CONNECT, before the broker
/// reports its capabilities.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct WillForm {
    unacknowledged: bool,
    not_retained: bool,
}

impl WillForm {
    /// The form of the will that is tried first.
    pub(super) fn first(retain: bool) -> WillForm {
        WillForm {
            not_retained: !retain,
            ..WillForm::default()
        }
    }

    /// The broker refused the connection for that; whether there is a lesser form to try.
    pub(super) fn lessen(&mut self, lack: Lack) -> bool {
        let given_up = match lack {
            Lack::Acknowledgements => &mut self.unacknowledged,
            Lack::Retained => &mut self.not_retained,
        };
        !std::mem::replace(given_up, true)
    }

    /// The last will in this form.
    pub(super) fn will(self, will: Will) -> LastWill {
        let qos = if self.unacknowledged {
            QoS::AtMostOnce
        } else {
            QoS::AtLeastOnce
        };
        LastWill::new(will.topic, will.payload, qos, will.retain && !self.not_retained, None)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_will_is_lessened_step_by_step_and_only_once_each() {
        let mut form = WillForm::default();
        let shape = |form: WillForm| {
            let will = form.will(Will {
                topic: "t".to_string(),
                payload: Vec::new(),
                retain: true,
            });
            (will.qos, will.retain)
        };
        assert_eq!(shape(form), (QoS::AtLeastOnce, true));
        assert!(form.lessen(Lack::Acknowledgements));
        assert_eq!(shape(form), (QoS::AtMostOnce, true));
        assert!(form.lessen(Lack::Retained));
        assert_eq!(shape(form), (QoS::AtMostOnce, false));
        assert!(!form.lessen(Lack::Retained) && !form.lessen(Lack::Acknowledgements));
    }
}
