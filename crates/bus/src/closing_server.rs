//! Handles a device server that closes its connection soon after a reply. A request sent before the close is
//! noticed is lost in a connection that the server no longer reads, and blocks the line until its time limit. So
//! the bus learns after how many replies, and how soon, the server closes, and sends nothing during that time.
//! Pure: time is an argument.

use std::time::{Duration, Instant};

/// A connection that ends later than that after a reply is not closed because of the reply.
const SOON: Duration = Duration::from_millis(60);
/// Time to wait for the server to close, in addition to twice the time that it took before.
const MARGIN: Duration = Duration::from_millis(10);
/// Number of further replies over one connection after which the server counts as one that stays connected.
const STAYED: u32 = 3;

/// Knowledge of a device server and of its present connection.
#[derive(Debug, Default)]
pub(super) struct ClosingServer {
    /// Number of replies over this connection, and when the last one arrived.
    replies: u32,
    last: Option<Instant>,
    habit: Option<ClosePattern>,
}

/// The learned behaviour of a server: it closes a connection after this number of replies and within this time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct ClosePattern {
    replies: u32,
    within: Duration,
}

impl ClosingServer {
    /// The bus has connected to the server again.
    pub(super) fn connected(&mut self) {
        (self.replies, self.last) = (0, None);
    }

    /// Notes that the port was lost: the next connection may lead to another server.
    pub(super) fn lost(&mut self) {
        *self = ClosingServer::default();
    }

    /// Notes that a reply arrived over the connection.
    pub(super) fn replied(&mut self, now: Instant) {
        self.replies = self.replies.saturating_add(1);
        self.last = Some(now);
        let stays = |habit: &mut ClosePattern| self.replies > habit.replies.saturating_add(STAYED);
        self.habit.take_if(stays);
    }

    /// Notes that the server closed the connection; `asked` means that a request had been sent over it since the
    /// last reply.
    pub(super) fn closed(&mut self, asked: bool, now: Instant) {
        let within = self.last.map(|last| now.saturating_duration_since(last));
        let Some(within) = within.filter(|within| *within <= SOON) else {
            return;
        };
        let replies = self.replies;
        match &mut self.habit {
            Some(habit) if habit.replies == replies => habit.within = habit.within.max(within),
            _ if asked => self.habit = Some(ClosePattern { replies, within }),
            _ => {}
        }
    }

    /// Until when nothing is sent over the connection, because the server is about to close it.
    pub(super) fn closes_until(&self) -> Option<Instant> {
        let habit = self.habit.filter(|habit| self.replies >= habit.replies)?;
        Some(self.last? + habit.within * 2 + MARGIN)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Duration = Duration::from_millis(1);

    #[test]
    fn a_server_that_closes_after_a_reply_is_waited_for_from_the_second_connection_on() {
        for replies in [1, 2, 7] {
            let (mut server, mut now) = (ClosingServer::default(), Instant::now());
            let reply = |server: &mut ClosingServer, now: &mut Instant| {
                for _ in 0..replies {
                    assert_eq!(server.closes_until(), None);
                    *now += 20 * MS;
                    server.replied(*now);
                }
            };
            reply(&mut server, &mut now);
            server.closed(true, now + 5 * MS);
            for _ in 0..3 {
                server.connected();
                reply(&mut server, &mut now);
                assert_eq!(server.closes_until(), Some(now + 20 * MS));
                server.closed(false, now + 5 * MS);
            }
            // The server keeps its connections from now on, which is learned after a few more replies.
            server.connected();
            (0..replies + STAYED).for_each(|_| server.replied(now));
            assert!(server.closes_until().is_some());
            server.replied(now);
            assert_eq!(server.closes_until(), None);
        }
    }

    #[test]
    fn a_connection_that_ends_in_a_pause_or_before_a_reply_shows_nothing() {
        let (mut server, now) = (ClosingServer::default(), Instant::now());
        server.closed(true, now);
        server.replied(now);
        server.closed(true, now + SOON + MS);
        server.connected();
        server.replied(now);
        server.closed(false, now + MS);
        server.connected();
        server.replied(now);
        assert_eq!(server.closes_until(), None);
        server.closed(true, now + MS);
        server.connected();
        server.replied(now);
        assert!(server.closes_until().is_some());
        server.lost();
        assert_eq!(server.closes_until(), None);
    }
}
