//! Discovery for Home Assistant, and the subscriptions of the client.

use rumqttc::RetainForwardRule;

use super::*;
use crate::connection::{commanding, of_others};

/// Purpose of a subscription.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Subscribed {
    /// The status that others publish in the gateway's name.
    Status,
    /// Subscription to the set topics.
    Commands,
    /// Subscription to the start message of Home Assistant.
    Birth,
    /// Retained discovery messages of an earlier run.
    Leftovers,
}

/// The publisher of discovery messages, if they are configured.
pub(super) fn announcer(options: &Options, topics: &Topics) -> Option<Announcer> {
    let prefix = options.home_assistant.as_deref()?;
    let sources = Sources {
        topics: topics.clone(),
        telemetry: options.telemetry,
        commands: options.commands,
    };
    Some(Announcer::new(prefix, sources))
}

/// The retained topics of discovery for this plant, which is announced from now on.
pub(super) fn discovery_topics(announcer: Option<&mut Announcer>, plant: &Plant) -> Vec<Arc<str>> {
    announcer.map_or_else(Vec::new, |announcer| {
        announcer.adopt(plant);
        announcer.topics().cloned().collect()
    })
}

/// Subscriptions of a connection; `plant` if the broker takes no wildcards.
pub(super) fn subscriptions(
    topics: &Topics,
    commands: bool,
    principals: Option<&[String]>,
    announcer: Option<&Announcer>,
    leftovers_known: bool,
    plant: Option<&Plant>,
) -> Vec<(Subscribed, Filter)> {
    let news = |path| Filter {
        retain_forward_rule: RetainForwardRule::Never,
        ..of_others(path)
    };
    let birth = announcer.map(|announcer| (Subscribed::Birth, news(announcer.birth_topic())));
    let leftovers = announcer.filter(|_| !leftovers_known && plant.is_none());
    let leftovers = leftovers.map(|announcer| (Subscribed::Leftovers, of_others(announcer.own_filter())));
    let sets = commands.then(|| topics.set_filters(plant, principals));
    let sets = sets
        .into_iter()
        .flatten()
        .map(|path| (Subscribed::Commands, commanding(path)));
    let status = (Subscribed::Status, news(topics.status()));
    std::iter::once(status)
        .chain(sets)
        .chain(birth)
        .chain(leftovers)
        .collect()
}

/// Logs which subscriptions the broker refuses, with the reasons. The gateway works without the status messages of others.
pub(super) fn report_refused(subscriptions: &[(Subscribed, Filter)], refused: &[Option<String>]) {
    let of = |wanted: Subscribed| {
        let pairs = subscriptions
            .iter()
            .zip(refused)
            .filter(move |((of, _), _)| *of == wanted);
        pairs.filter_map(|((_, filter), why)| Some((filter.path.as_str(), why.as_ref()?)))
    };
    if let Some((_, why)) = of(Subscribed::Commands).next() {
        let filters: Vec<&str> = of(Subscribed::Commands).map(|(filter, _)| filter).collect();
        let more = match filters.len() {
            0..=2 => String::new(),
            all => format!(" and {} more", all - 2),
        };
        tracing::error!(
            target: "drivegate::north::mqtt", "the broker refuses set topics ({why}): no commands over MQTT there; allow the client to subscribe to {}{more}",
            filters.get(..filters.len().min(2)).unwrap_or_default().join(" and ")
        );
    }
    if let Some((filter, why)) = of(Subscribed::Birth).next() {
        tracing::warn!(
            target: "drivegate::north::mqtt", "the broker refuses {filter} ({why}): the drives are not announced again when Home Assistant starts; allow \
             the client to subscribe to it"
        );
    }
    if let Some((filter, why)) = of(Subscribed::Leftovers).next() {
        tracing::warn!(
            target: "drivegate::north::mqtt", "the broker refuses {filter} ({why}): drives removed before this start stay in Home Assistant; allow the \
             client to subscribe to it, or set mqtt.buffer"
        );
    }
}

impl PlainClient {
    /// Clears retained topics that the client before a reload published and this one does not.
    pub(super) fn take_over(&mut self) {
        let before = std::mem::take(&mut Handover::of(&self.common.stats).lock().retained);
        self.clear_old(before);
        Handover::of(&self.common.stats).lock().retained = self.retained_topics();
    }

    /// Whether a message is about discovery: a message of Home Assistant, or one of an earlier run.
    pub(super) fn on_discovery(&mut self, message: &Incoming) -> bool {
        let Some(announcer) = &mut self.announcer else {
            return false;
        };
        if message.topic == announcer.birth_topic() {
            if message.payload == b"online" {
                announcer.born(Instant::now());
            }
            return true;
        }
        let own = announcer.is_own(&message.topic);
        if own && (!message.payload.is_empty() || message.oversized.is_some()) {
            self.clear_old(vec![message.topic.clone()]);
        }
        own
    }

    /// Gives the next discovery message to the outbox, if the broker has received the previous ones.
    pub(super) fn announce(&mut self) {
        let Some(announcer) = &mut self.announcer else { return };
        let outbox = &self.outbox;
        let updates = announcer.next(Instant::now(), |topic| outbox.is_under_way(topic));
        for Update { topic, payload } in updates {
            self.outbox.put_lasting(topic, payload);
        }
        if announcer.take_changed() {
            self.publisher.publish_besides(announcer.topics().cloned().collect());
            self.remember_topics();
        }
    }
}
