//! Handles messages that the broker refuses.

use rumqttc::PubAckReason;

use super::*;

impl PlainClient {
    /// Handles a message that the broker refused. A message that must arrive, or that the broker refuses only for now,
    /// is published again.
    pub(super) fn refused(&mut self, packet: u16, why: PubAckReason) {
        let for_now = matches!(why, PubAckReason::QuotaExceeded | PubAckReason::PacketIdentifierInUse);
        let (now, root) = (Instant::now(), self.topics.root());
        let remedy = if for_now {
            "raise its limits if this persists".to_string()
        } else {
            let discovery = self
                .announcer
                .as_ref()
                .map(|announcer| format!(", {}", announcer.own_topics()));
            format!(
                "it must let client {} publish to {root}/#{} and to the response topics in use",
                self.options.client_id,
                discovery.unwrap_or_default()
            )
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
        if let Some(kind) = kind {
            self.common.stats.mqtt.lost(*kind, 1);
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
