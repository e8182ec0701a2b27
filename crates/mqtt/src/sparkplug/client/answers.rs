//! Answers of the broker to the subscriptions, and births that fit into its packets.

use super::*;
use crate::connection::{PACKET_OVERHEAD, commanding};
use crate::sparkplug::session::FIXED_METRICS;
use crate::sparkplug::topics::Kind;
use rumqttc::mqttbytes::QoS;

impl NodeClient {
    /// Subscriptions of the node: commands for the node, state of the primary host, commands for its devices.
    pub(super) fn subscriptions(&self, limits: BrokerLimits) -> Vec<Filter> {
        let topics = &self.topics;
        let plain = |path| Filter {
            path,
            qos: QoS::AtLeastOnce,
            ..Filter::default()
        };
        let mut filters = vec![commanding(topics.node_commands())];
        filters.extend(topics.state().into_iter().chain(topics.old_state()).map(plain));
        let name = |drive: &Drive| topics.commands_of(&drive.metrics.drive.image.spec.name);
        if self.broker.commands && limits.wildcards {
            filters.push(commanding(topics.device_commands()));
        } else if self.broker.commands {
            filters.extend(self.drives.iter().map(name).map(commanding));
        }
        filters
    }

    pub(super) fn report_refused(&self, filters: &[Filter], refused: &[Option<String>]) {
        for (filter, why) in filters.iter().zip(refused) {
            // Most hosts do not use the state topic of version 2.2.
            let spare = self.topics.old_state().is_some_and(|old| old == filter.path);
            if let Some(why) = why
                && !spare
            {
                tracing::error!(
                    target: "drivegate::north::mqtt", "the broker refuses a Sparkplug subscription ({why}); allow client {} to subscribe to {}",
                    self.common.link.client_id(),
                    filter.path
                );
            }
        }
    }

    /// A birth without the metrics for which the broker's packet limit is too small; the session leaves them out
    /// from now on.
    pub(super) fn fitted(&mut self, mut packet: Packet) -> Packet {
        let Some(limits) = self.common.link.limits() else {
            return packet;
        };
        let (most, all) = (limits.max_packet, packet.payload.metrics.len());
        let fixed = match packet.kind {
            Kind::NodeBirth => FIXED_METRICS,
            Kind::DeviceBirth => 0,
            _ => return packet,
        };
        let topic = self.topics.of(packet.kind, packet.device.as_deref());
        let room = most.saturating_sub(topic.len() + PACKET_OVERHEAD);
        let mut omitted = Vec::new();
        while packet.payload.encoded().len() > room && packet.payload.metrics.len() > fixed {
            omitted.extend(packet.payload.metrics.pop().and_then(|metric| metric.name));
        }
        if !omitted.is_empty() {
            self.session
                .keep(packet.device.as_deref(), packet.payload.metrics.len() - fixed);
            omitted.reverse();
            tracing::warn!(
                target: "drivegate::north::mqtt", "Sparkplug: {topic} is too large for the broker, which accepts \
                                                   {most} bytes per packet: {} of {all} metrics are omitted until the \
                                                   next connection ({}); raise the broker's limit",
                omitted.len(),
                omitted.join(", ")
            );
        }
        packet
    }
}
