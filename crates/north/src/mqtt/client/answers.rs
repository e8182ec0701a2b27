//! What the broker answers: to the last will, to the subscriptions, and to messages that it refuses.

use rumqttc::PubAckReason;

use super::discovery::{report_refused, subscriptions};
use super::*;
use crate::mqtt::broker_limits::Lack;
use crate::mqtt::connection::NO_WILDCARDS;

impl Client {
    pub(super) fn connected(&mut self, limits: BrokerLimits) {
        let since = Instant::now();
        if let BrokerLink::Open(session) = &mut self.link {
            // A client that reads `online` may send commands, so the subscription comes first.
            session.phase = Phase::Subscribing { limits, since };
        }
        self.subscribe(limits);
    }

    pub(super) fn subscribe(&mut self, limits: BrokerLimits) {
        let plant = (!limits.wildcards).then_some(self.observed.as_ref());
        self.subscriptions = subscriptions(
            &self.topics,
            self.options.commands,
            self.announcer.as_ref(),
            self.leftovers_known,
            plant,
        );
        let filters = self.subscriptions.iter().map(Subscription::filter).collect();
        if let BrokerLink::Open(session) = &mut self.link
            && !session.connection.subscribe(filters, limits)
        {
            self.give_up("the subscription could not be sent");
        }
    }

    /// The broker answered the subscriptions.
    pub(super) fn subscribed(&mut self, phase: Phase, refused: &[Option<String>]) {
        if let Phase::Subscribing { limits, since } = phase
            && limits.wildcards
            && refused.iter().flatten().any(|why| why == NO_WILDCARDS)
            && let BrokerLink::Open(session) = &mut self.link
        {
            let limits = BrokerLimits {
                wildcards: false,
                ..limits
            };
            session.phase = Phase::Subscribing { limits, since };
            return self.subscribe(limits);
        }
        report_refused(&self.subscriptions, refused);
        if let Phase::Subscribing { limits, since } = phase {
            self.ready(limits, since);
        }
    }

    /// The broker refused the connection because of the last will: another one follows with less, at once, if there is less.
    pub(super) fn lessen_will(&mut self, lack: Lack) {
        if self.will.lessen(lack) {
            tracing::debug!(target: "drivegate::north::mqtt", "the broker refuses the last will ({lack:?}); trying a lesser one");
            self.link = BrokerLink::Disconnected {
                retry_at: Instant::now(),
            };
        } else {
            drop(self.lost("the broker refuses the last will in every form"));
        }
    }

    /// The broker refused a message. What must arrive, and what it refuses for now only, is published again.
    pub(super) fn refused(&mut self, packet: u16, why: PubAckReason) {
        let for_now = matches!(why, PubAckReason::QuotaExceeded | PubAckReason::PacketIdentifierInUse);
        let (now, root) = (Instant::now(), self.topics.root());
        let remedy = match for_now {
            true => "raise its limits if that lasts".to_string(),
            false => {
                let discovery = self
                    .announcer
                    .as_ref()
                    .map(|announcer| format!(", {}", announcer.own_topics()));
                format!(
                    "it must let client {} publish to {root}/#{} and to the response topics in use",
                    self.options.client_id,
                    discovery.unwrap_or_default()
                )
            }
        };
        let why = format!("{}; {remedy}", refusal(why));
        if let Some(topic) = self.outbox.put_back(packet, for_now) {
            let wait = self.retry.refused(now).saturating_duration_since(now);
            let what = format!("a message on {topic} is published again in {} s", wait.as_secs().max(1));
            return self.log_refused(&what, &why, now);
        }
        let settled = self.outbox.acked(packet);
        self.drop_refused(settled.as_ref(), &why);
        self.settled(settled);
    }

    /// A message cannot be delivered: counted, and logged once a minute.
    pub(super) fn drop_refused(&mut self, settled: Option<&Settled>, why: &str) {
        let Some(Settled { topic, kind }) = settled else { return };
        match kind {
            Some(Kind::Event) => self.stats.mqtt.lost(MqttLoss::Event, 1),
            Some(Kind::Result) => self.stats.mqtt.lost(MqttLoss::Result, 1),
            Some(Kind::History) => self.stats.mqtt.lost(MqttLoss::History, 1),
            None => {}
        }
        self.log_refused(&format!("dropped a message on {topic}"), why, Instant::now());
    }

    pub(super) fn log_refused(&mut self, what: &str, why: &str, now: Instant) {
        let Some(omitted) = self.refused.permit(now) else {
            return;
        };
        let more = match omitted {
            0 => String::new(),
            omitted => format!(" ({omitted} more messages, on this or other topics, since the last such line)"),
        };
        tracing::warn!(target: "drivegate::north::mqtt", "{what}: {why}{more}");
    }
}

fn refusal(why: PubAckReason) -> String {
    match why {
        PubAckReason::NotAuthorized => "the broker does not allow it (ACL)".to_string(),
        PubAckReason::QuotaExceeded => "the broker accepts no more for now (quota exceeded)".to_string(),
        why => format!("the broker refuses it ({why:?})"),
    }
}
