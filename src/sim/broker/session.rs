//! What the broker keeps for one client: subscriptions, messages that wait, messages under way.

use std::collections::{BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::Instant;

use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{
    DisconnectReasonCode, Filter, RetainForwardRule, SubscribeReasonCode, UnsubAckReason,
};
use tokio::sync::{Notify, oneshot};

use super::packet::{Expiry, Fault, Message, Outbound, Will};
use super::{MAX_INFLIGHT, MAX_QUEUE_BYTES, MAX_QUEUE_MESSAGES, MAX_SUBSCRIPTIONS, RECEIVE_MAXIMUM, topic};

/// The way from a session to the task of its connection.
#[derive(Debug)]
pub(super) struct Link {
    /// Tells this connection from earlier ones of the same client.
    pub(super) number: u64,
    /// Notified when there is something to send.
    pub(super) wake: Arc<Notify>,
    /// Ends the connection, once.
    pub(super) end: Option<oneshot::Sender<Fault>>,
    /// QoS 1 messages the client takes unacknowledged.
    pub(super) receive_maximum: usize,
}

impl Link {
    /// Has the connection closed for `fault`.
    pub(super) fn end(&mut self, fault: Fault) {
        if let Some(end) = self.end.take() {
            // A connection that is gone already has nobody to tell.
            let _ = end.send(fault);
        }
    }
}

/// State of one client, with or without a connection.
#[derive(Debug)]
pub(super) struct Session {
    pub(super) link: Option<Link>,
    pub(super) expiry: Expiry,
    /// Time without connection at which the session ends. `None`: connected, or no end.
    pub(super) ends: Option<Instant>,
    /// When the connection was lost, to choose the oldest when a place is needed.
    pub(super) left: Option<Instant>,
    pub(super) will: Option<Will>,
    /// Time at which the will of a lost connection is due.
    pub(super) will_due: Option<Instant>,
    subscriptions: Vec<Subscription>,
    queue: VecDeque<Outbound>,
    queue_bytes: usize,
    inflight: VecDeque<Outbound>,
    last_pkid: u16,
    /// Identifiers of QoS 2 messages that were taken over and not yet released.
    received: BTreeSet<u16>,
}

#[derive(Debug)]
struct Subscription {
    filter: Filter,
    id: Option<usize>,
}

/// What became of a subscription.
pub(super) struct Subscribed {
    pub(super) code: SubscribeReasonCode,
    /// Whether retained messages are due to it.
    pub(super) wants_retained: bool,
}

impl Session {
    pub(super) fn new(expiry: Expiry) -> Session {
        Session {
            link: None,
            expiry,
            ends: None,
            left: None,
            will: None,
            will_due: None,
            subscriptions: Vec::new(),
            queue: VecDeque::new(),
            queue_bytes: 0,
            inflight: VecDeque::new(),
            last_pkid: 0,
            received: BTreeSet::new(),
        }
    }

    /// Adds or replaces a subscription.
    pub(super) fn subscribe(&mut self, filter: &Filter, id: Option<usize>) -> Subscribed {
        let refused = |code| Subscribed {
            code,
            wants_retained: false,
        };
        if !topic::is_filter(&filter.path) {
            return refused(SubscribeReasonCode::TopicFilterInvalid);
        }
        if filter.path.starts_with("$share/") {
            return refused(SubscribeReasonCode::SharedSubscriptionsNotSupported);
        }
        let mut filter = filter.clone();
        filter.qos = at_most_once_or_at_least_once(filter.qos);
        let code = SubscribeReasonCode::Success(filter.qos);
        let rule = filter.retain_forward_rule.clone();
        let subscription = Subscription { filter, id };
        let before = self.subscriptions.len();
        self.subscriptions
            .retain(|known| known.filter.path != subscription.filter.path);
        let new = self.subscriptions.len() == before;
        if self.subscriptions.len() >= MAX_SUBSCRIPTIONS {
            return refused(SubscribeReasonCode::QuotaExceeded);
        }
        self.subscriptions.push(subscription);
        let wants_retained = match rule {
            RetainForwardRule::OnEverySubscribe => true,
            RetainForwardRule::OnNewSubscribe => new,
            RetainForwardRule::Never => false,
        };
        Subscribed { code, wants_retained }
    }

    pub(super) fn unsubscribe(&mut self, path: &str) -> UnsubAckReason {
        let before = self.subscriptions.len();
        self.subscriptions
            .retain(|subscription| subscription.filter.path != path);
        if self.subscriptions.len() < before {
            UnsubAckReason::Success
        } else {
            UnsubAckReason::NoSubscriptionExisted
        }
    }

    /// Whether a subscription has the topic.
    pub(super) fn is_subscribed(&self, name: &str) -> bool {
        self.subscriptions
            .iter()
            .any(|subscription| topic::matches(name, &subscription.filter.path))
    }

    /// Queues `message` if it is subscribed to: once, at the highest granted QoS and with the
    /// identifiers of all subscriptions that match (MQTT 5.0 section 3.3.4). `own`: this client published it.
    pub(super) fn offer(&mut self, message: &Arc<Message>, own: bool) -> bool {
        let mut granted: Option<QoS> = None;
        let mut retain = false;
        let mut subscription_ids = Vec::new();
        for Subscription { filter, id } in &self.subscriptions {
            if (own && filter.nolocal) || !topic::matches(&message.topic, &filter.path) {
                continue;
            }
            granted = Some(granted.map_or(filter.qos, |qos| highest(qos, filter.qos)));
            retain |= message.retain && filter.preserve_retain;
            subscription_ids.extend(*id);
        }
        let Some(granted) = granted else { return false };
        let qos = lowest(granted, message.qos);
        self.push(outbound(message, qos, retain, subscription_ids));
        true
    }

    /// Queues a retained message for the subscription `path`.
    pub(super) fn offer_retained(&mut self, message: &Arc<Message>, path: &str) {
        let Some(subscription) = self.subscriptions.iter().find(|known| known.filter.path == path) else {
            return;
        };
        let qos = lowest(subscription.filter.qos, message.qos);
        let ids = subscription.id.into_iter().collect();
        self.push(outbound(message, qos, true, ids));
    }

    /// Queues within the bounds. A full queue gives up its oldest QoS 0 message. If it has none, a
    /// QoS 0 message is dropped, a client that does not keep up loses its connection, and a client
    /// that is away loses the new message.
    fn push(&mut self, outbound: Outbound) {
        let kept = outbound.qos != QoS::AtMostOnce;
        if self.link.is_none() && !kept {
            return;
        }
        let weight = outbound.message.weight();
        while self.queue.len() >= MAX_QUEUE_MESSAGES || self.queue_bytes.saturating_add(weight) > MAX_QUEUE_BYTES {
            if let Some(oldest) = self.queue.iter().position(|waiting| waiting.qos == QoS::AtMostOnce) {
                self.remove(oldest);
                continue;
            }
            if let Some(link) = &mut self.link
                && kept
            {
                let what = String::from("client does not take its messages, its queue is full");
                link.end(Fault {
                    reason: DisconnectReasonCode::QuotaExceeded,
                    what,
                });
            }
            return;
        }
        self.queue_bytes += weight;
        self.queue.push_back(outbound);
        if let Some(link) = &self.link {
            link.wake.notify_one();
        }
    }

    fn remove(&mut self, index: usize) -> Option<Outbound> {
        let outbound = self.queue.remove(index)?;
        self.queue_bytes = self.queue_bytes.saturating_sub(outbound.message.weight());
        Some(outbound)
    }

    /// Takes up to `budget` bytes of messages to send, in order; at least one if one may go. A QoS 1
    /// message waits until the client has room for it, and so do those behind it.
    pub(super) fn take(&mut self, now: Instant, budget: usize) -> Vec<Outbound> {
        let window = self
            .link
            .as_ref()
            .map_or(0, |link| link.receive_maximum.min(MAX_INFLIGHT));
        let mut taken = Vec::new();
        let mut bytes = 0;
        while bytes < budget {
            let Some(next) = self.queue.front() else { break };
            let kept = next.qos != QoS::AtMostOnce;
            // A message once sent is sent again even if it has expired: the client may wait for it.
            let expired = !next.dup && !next.message.is_current(now);
            if !expired && kept && self.inflight.len() >= window {
                break;
            }
            let Some(mut outbound) = self.remove(0) else { break };
            if expired {
                continue;
            }
            outbound.expires_in = outbound.message.expires.map(|expires| seconds_until(expires, now));
            if kept {
                if outbound.pkid == 0 {
                    outbound.pkid = self.free_pkid();
                }
                self.inflight.push_back(outbound.clone());
            }
            bytes += outbound.message.weight();
            taken.push(outbound);
        }
        taken
    }

    /// Ends the way of a QoS 1 message: the client has it, or cannot take it. Unknown identifiers
    /// are passed over, they may belong to an earlier session.
    pub(super) fn acknowledge(&mut self, pkid: u16) {
        self.inflight.retain(|outbound| outbound.pkid != pkid);
    }

    /// Notes the identifier of a received QoS 2 message: true when the message is new, false when
    /// the client sends it again.
    ///
    /// # Errors
    /// More are open than the broker has allowed.
    pub(super) fn receive(&mut self, pkid: u16) -> Result<bool, Fault> {
        if !self.received.contains(&pkid) && self.received.len() >= usize::from(RECEIVE_MAXIMUM) {
            let what = format!("more than {RECEIVE_MAXIMUM} QoS 2 messages without PUBREL");
            return Err(Fault {
                reason: DisconnectReasonCode::ReceiveMaximumExceeded,
                what,
            });
        }
        Ok(self.received.insert(pkid))
    }

    /// Forgets the identifier of a QoS 2 message; false when it was not known.
    pub(super) fn release(&mut self, pkid: u16) -> bool {
        self.received.remove(&pkid)
    }

    /// The connection is gone: QoS 0 is forgotten, what was under way goes back to the front and
    /// will be marked as sent before.
    pub(super) fn suspend(&mut self, now: Instant) {
        self.link = None;
        self.left = Some(now);
        self.ends = match self.expiry {
            Expiry::AtOnce => Some(now),
            Expiry::After(time) => now.checked_add(time),
            Expiry::Never => None,
        };
        self.queue.retain(|outbound| outbound.qos != QoS::AtMostOnce);
        while let Some(mut outbound) = self.inflight.pop_back() {
            outbound.dup = true;
            self.queue.push_front(outbound);
        }
        self.queue_bytes = self.queue.iter().map(|outbound| outbound.message.weight()).sum();
    }

    /// A packet identifier that is in no use. The search ends because far fewer than 65535 can be
    /// under way; identifiers of an earlier connection stand first in the queue and are under way
    /// again before a new one is needed.
    fn free_pkid(&mut self) -> u16 {
        loop {
            self.last_pkid = self.last_pkid.checked_add(1).unwrap_or(1);
            if self.inflight.iter().all(|outbound| outbound.pkid != self.last_pkid) {
                return self.last_pkid;
            }
        }
    }
}

fn outbound(message: &Arc<Message>, qos: QoS, retain: bool, subscription_ids: Vec<usize>) -> Outbound {
    Outbound {
        message: Arc::clone(message),
        qos,
        retain,
        pkid: 0,
        dup: false,
        subscription_ids,
        expires_in: None,
    }
}

/// Seconds left, rounded up so that a message is not delivered with 0 before its time.
fn seconds_until(expires: Instant, now: Instant) -> u32 {
    let left = expires.saturating_duration_since(now);
    let seconds = left.as_secs() + u64::from(left.subsec_nanos() > 0);
    u32::try_from(seconds).unwrap_or(u32::MAX)
}

/// Nothing is sent at QoS 2.
fn at_most_once_or_at_least_once(qos: QoS) -> QoS {
    lowest(qos, QoS::AtLeastOnce)
}

fn lowest(a: QoS, b: QoS) -> QoS {
    if a < b { a } else { b }
}

fn highest(a: QoS, b: QoS) -> QoS {
    if a < b { b } else { a }
}
