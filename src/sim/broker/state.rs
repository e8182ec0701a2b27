//! The broker without its sockets: sessions, retained messages, wills. No clock and no I/O.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use rumqttc::v5::mqttbytes::v5::{
    ConnectReturnCode, DisconnectReasonCode, Filter, PubAckReason, SubscribeReasonCode, UnsubAckReason,
};
use tokio::sync::{Notify, oneshot};

use super::packet::{Connect, Expiry, Fault, Message, Outbound, Version, Will};
use super::session::{Link, Session};
use super::{MAX_CLIENT_ID_BYTES, MAX_RETAINED_BYTES, MAX_RETAINED_MESSAGES, MAX_SESSIONS};

/// All the broker knows.
#[derive(Debug, Default)]
pub(super) struct State {
    sessions: BTreeMap<String, Session>,
    retained: BTreeMap<String, Arc<Message>>,
    retained_bytes: usize,
    connections: u64,
    assigned: u64,
}

/// A client that was let in.
#[derive(Debug)]
pub(super) struct Attached {
    pub(super) client_id: String,
    /// Number of the connection.
    pub(super) link: u64,
    pub(super) session_present: bool,
    /// The broker chose the client id.
    pub(super) assigned: bool,
}

/// How a connection ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Leave {
    /// The client said good-bye: no will.
    Clean,
    /// Anything else: the will is due.
    Lost,
}

impl State {
    /// Gives a client its session. An earlier connection of the same client is ended, and its will
    /// is published before the new one goes on.
    ///
    /// # Errors
    /// The code for the CONNACK that refuses.
    pub(super) fn attach(
        &mut self,
        now: Instant,
        connect: &Connect,
        wake: Arc<Notify>,
        end: oneshot::Sender<Fault>,
    ) -> Result<Attached, ConnectReturnCode> {
        if connect.authentication {
            return Err(ConnectReturnCode::BadAuthenticationMethod);
        }
        // 3.1.1 section 3.1.3.1: a client without an id cannot have a session to come back to.
        let nameless_session = connect.client_id.is_empty() && !connect.clean_start;
        if (nameless_session && connect.version == Version::V311) || connect.client_id.len() > MAX_CLIENT_ID_BYTES {
            return Err(ConnectReturnCode::ClientIdentifierNotValid);
        }
        let assigned = connect.client_id.is_empty();
        let client_id = if assigned {
            self.assign_client_id()
        } else {
            connect.client_id.clone()
        };

        self.take_over(now, &client_id, connect.clean_start);
        let session_present = self.sessions.contains_key(&client_id);
        if !session_present {
            self.make_room(now);
        }
        self.connections += 1;
        let link = self.connections;
        let session = self
            .sessions
            .entry(client_id.clone())
            .or_insert_with(|| Session::new(connect.expiry));
        session.expiry = connect.expiry;
        session.ends = None;
        session.left = None;
        session.will = connect.will.clone();
        session.will_due = None;
        let receive_maximum = usize::from(connect.receive_maximum);
        session.link = Some(Link {
            number: link,
            wake,
            end: Some(end),
            receive_maximum,
        });
        Ok(Attached {
            client_id,
            link,
            session_present,
            assigned,
        })
    }

    /// Ends an earlier connection of the client, and its session if it asks for a new one. The will
    /// is published unless it has a delay and the session goes on (MQTT 5.0 section 3.1.3.2.2).
    fn take_over(&mut self, now: Instant, client_id: &str, clean_start: bool) {
        if let Some(session) = self.sessions.get_mut(client_id)
            && let Some(mut link) = session.link.take()
        {
            let what = String::from("the client connected again");
            link.end(Fault {
                reason: DisconnectReasonCode::SessionTakenOver,
                what,
            });
            self.suspend(now, client_id, Leave::Lost);
        }
        if clean_start {
            self.end_session(now, client_id);
        }
    }

    /// The connection `link` of a client is gone. `expiry` replaces that of its CONNECT.
    pub(super) fn detach(&mut self, now: Instant, client_id: &str, link: u64, leave: Leave, expiry: Option<Expiry>) {
        let Some(session) = self.linked(client_id, link) else {
            return;
        };
        session.expiry = expiry.unwrap_or(session.expiry);
        self.suspend(now, client_id, leave);
    }

    fn suspend(&mut self, now: Instant, client_id: &str, leave: Leave) {
        let Some(session) = self.sessions.get_mut(client_id) else {
            return;
        };
        session.suspend(now);
        match leave {
            Leave::Clean => session.will = None,
            Leave::Lost => session.will_due = session.will.as_ref().and_then(|will| now.checked_add(will.delay)),
        }
        self.settle(now, client_id);
    }

    /// Does what is due for a client without connection: publishes its will, ends its session.
    fn settle(&mut self, now: Instant, client_id: &str) {
        let Some(session) = self.sessions.get_mut(client_id) else {
            return;
        };
        if session.link.is_some() {
            return;
        }
        if session.ends.is_some_and(|ends| ends <= now) {
            self.end_session(now, client_id);
        } else if session.will_due.is_some_and(|due| due <= now) {
            session.will_due = None;
            let will = session.will.take();
            self.publish_will(now, client_id, will);
        }
    }

    /// A will is published at the latest when the session ends.
    fn end_session(&mut self, now: Instant, client_id: &str) {
        if let Some(session) = self.sessions.remove(client_id) {
            self.publish_will(now, client_id, session.will);
        }
    }

    fn publish_will(&mut self, now: Instant, client_id: &str, will: Option<Will>) {
        if let Some(will) = will {
            self.publish(now, client_id, Message::new(will.publish, now));
        }
    }

    /// Does what time brings: delayed wills, ends of sessions, expiry of retained messages.
    pub(super) fn tick(&mut self, now: Instant) {
        let due = |at: Option<Instant>| at.is_some_and(|at| at <= now);
        let clients: Vec<String> = self
            .sessions
            .iter()
            .filter(|(_, session)| session.link.is_none() && (due(session.ends) || due(session.will_due)))
            .map(|(client_id, _)| client_id.clone())
            .collect();
        for client_id in clients {
            self.settle(now, &client_id);
        }
        self.retained.retain(|_, message| message.is_current(now));
        self.retained_bytes = self.retained.values().map(|message| message.weight()).sum();
    }

    /// Retains and passes on a message of `client_id`.
    pub(super) fn publish(&mut self, now: Instant, client_id: &str, message: Message) -> PubAckReason {
        let message = Arc::new(message);
        let retained = !message.retain || self.retain(now, &message);
        let mut subscribers = 0_usize;
        for (subscriber, session) in &mut self.sessions {
            subscribers += usize::from(session.offer(&message, subscriber == client_id));
        }
        match (retained, subscribers) {
            (false, _) => PubAckReason::QuotaExceeded,
            (true, 0) => PubAckReason::NoMatchingSubscribers,
            (true, _) => PubAckReason::Success,
        }
    }

    /// Sets, replaces or (without payload) deletes the retained message of a topic; false when the
    /// bounds leave no place for it.
    fn retain(&mut self, now: Instant, message: &Arc<Message>) -> bool {
        if let Some(old) = self.retained.remove(&message.topic) {
            self.retained_bytes = self.retained_bytes.saturating_sub(old.weight());
        }
        if message.payload.is_empty() || !message.is_current(now) {
            return true;
        }
        let bytes = self.retained_bytes.saturating_add(message.weight());
        if self.retained.len() >= MAX_RETAINED_MESSAGES || bytes > MAX_RETAINED_BYTES {
            return false;
        }
        self.retained_bytes = bytes;
        self.retained.insert(message.topic.clone(), Arc::clone(message));
        true
    }

    /// Subscribes a client; retained messages go into its queue.
    pub(super) fn subscribe(
        &mut self,
        now: Instant,
        client_id: &str,
        link: u64,
        filters: &[Filter],
        id: Option<usize>,
    ) -> Vec<SubscribeReasonCode> {
        let Some(session) = self
            .sessions
            .get_mut(client_id)
            .filter(|session| is_linked(session, link))
        else {
            return vec![SubscribeReasonCode::Unspecified; filters.len()];
        };
        let mut codes = Vec::with_capacity(filters.len());
        for filter in filters {
            let subscribed = session.subscribe(filter, id);
            codes.push(subscribed.code);
            if !subscribed.wants_retained {
                continue;
            }
            for message in self.retained.values() {
                if message.is_current(now) && super::topic::matches(&message.topic, &filter.path) {
                    session.offer_retained(message, &filter.path);
                }
            }
        }
        codes
    }

    /// Takes subscriptions back.
    pub(super) fn unsubscribe(&mut self, client_id: &str, link: u64, filters: &[String]) -> Vec<UnsubAckReason> {
        match self.linked(client_id, link) {
            Some(session) => filters.iter().map(|filter| session.unsubscribe(filter)).collect(),
            None => vec![UnsubAckReason::UnspecifiedError; filters.len()],
        }
    }

    /// Messages to send on the connection `link`, see [`Session::take`].
    pub(super) fn take(&mut self, now: Instant, client_id: &str, link: u64, budget: usize) -> Vec<Outbound> {
        self.linked(client_id, link)
            .map(|session| session.take(now, budget))
            .unwrap_or_default()
    }

    /// The session of a client as long as `link` is its connection.
    pub(super) fn linked(&mut self, client_id: &str, link: u64) -> Option<&mut Session> {
        self.sessions
            .get_mut(client_id)
            .filter(|session| is_linked(session, link))
    }

    /// Number of clients that are connected and subscribed to the topic `name`.
    pub(super) fn subscribers(&self, name: &str) -> usize {
        self.sessions
            .values()
            .filter(|session| session.link.is_some() && session.is_subscribed(name))
            .count()
    }

    /// Number of clients that are connected.
    pub(super) fn clients(&self) -> usize {
        self.sessions.values().filter(|session| session.link.is_some()).count()
    }

    fn assign_client_id(&mut self) -> String {
        loop {
            self.assigned += 1;
            let client_id = format!("assigned-{}", self.assigned);
            if !self.sessions.contains_key(&client_id) {
                return client_id;
            }
        }
    }

    /// Ends the session that has been left longest when there is no place for another one.
    fn make_room(&mut self, now: Instant) {
        if self.sessions.len() < MAX_SESSIONS {
            return;
        }
        let oldest = self
            .sessions
            .iter()
            .filter_map(|(client_id, session)| session.left.map(|left| (left, client_id.clone())))
            .min();
        if let Some((_, client_id)) = oldest {
            self.end_session(now, &client_id);
        }
    }
}

fn is_linked(session: &Session, link: u64) -> bool {
    session.link.as_ref().is_some_and(|known| known.number == link)
}

#[cfg(test)]
mod tests;
