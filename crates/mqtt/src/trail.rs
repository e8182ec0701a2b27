//! Remembers the last packet that the gateway sent: some brokers close a connection because of it without a reason.

use std::collections::VecDeque;
use std::fmt;
use std::sync::Arc;

/// Messages that may wait between the client and the socket, at most.
const MOST_WAITING: usize = 2048;

/// The kind of a packet that was written.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Packet {
    /// A message: topic, bytes of the payload, whether it is retained.
    Publish(Arc<str>, usize, bool),
    /// A packet with this number of filters.
    Subscribe(usize),
    /// A PINGREQ, which the broker must answer.
    Ping,
}

impl fmt::Display for Packet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Packet::Publish(topic, bytes, retained) => {
                let retained = if *retained { ", retained" } else { "" };
                write!(f, "PUBLISH to {topic} ({bytes} bytes{retained})")
            }
            Packet::Subscribe(1) => f.write_str("SUBSCRIBE with 1 filter"),
            Packet::Subscribe(filters) => write!(f, "SUBSCRIBE with {filters} filters"),
            Packet::Ping => f.write_str("PINGREQ"),
        }
    }
}

/// The packets given to the library, in order, and the last one that it wrote. Messages and subscriptions are each
/// written in the order in which they were given.
#[derive(Debug, Default)]
pub(super) struct Trail {
    messages: VecDeque<Packet>,
    subscriptions: VecDeque<Packet>,
    last: Option<Packet>,
}

impl Trail {
    /// A message is handed to the library.
    pub(super) fn publishes(&mut self, topic: Arc<str>, bytes: usize, retained: bool) {
        if self.messages.len() < MOST_WAITING {
            self.messages.push_back(Packet::Publish(topic, bytes, retained));
        }
    }

    /// The library had no room for the last message.
    pub(super) fn kept_back(&mut self) {
        self.messages.pop_back();
    }

    /// A packet with so many filters was handed to the library.
    pub(super) fn subscribes(&mut self, filters: usize) {
        if self.subscriptions.len() < MOST_WAITING {
            self.subscriptions.push_back(Packet::Subscribe(filters));
        }
    }

    /// Notes that the library wrote its next message.
    pub(super) fn published(&mut self) {
        self.last = self.messages.pop_front().or(self.last.take());
    }

    /// Notes that the library wrote its next packet with subscriptions.
    pub(super) fn subscribed(&mut self) {
        self.last = self.subscriptions.pop_front().or(self.last.take());
    }

    /// Notes that the library sent a ping.
    pub(super) fn pinged(&mut self) {
        self.last = Some(Packet::Ping);
    }

    /// The last packet that the library wrote.
    pub(super) fn last(&self) -> Option<&Packet> {
        self.last.as_ref()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_packet_is_the_one_that_was_written_last() {
        let mut trail = Trail::default();
        assert_eq!(trail.last(), None);
        trail.subscribes(8);
        trail.publishes("a/state".into(), 12, true);
        trail.publishes("a/b".into(), 3, false);
        let mut said = |wrote: fn(&mut Trail)| {
            wrote(&mut trail);
            trail.last().map(Packet::to_string)
        };
        assert_eq!(said(Trail::subscribed).as_deref(), Some("SUBSCRIBE with 8 filters"));
        assert_eq!(
            said(Trail::published).as_deref(),
            Some("PUBLISH to a/state (12 bytes, retained)")
        );
        assert_eq!(said(Trail::published).as_deref(), Some("PUBLISH to a/b (3 bytes)"));
        assert_eq!(said(Trail::pinged).as_deref(), Some("PINGREQ"));
    }
}
