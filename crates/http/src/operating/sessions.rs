//! The sessions of logged-in users. Pure: time and random numbers are arguments.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::super::tokens::hash;
use drivegate_core::hex;

/// Time without activity of the user after which a session ends. Reading values does not count as activity, so the
/// session of an unattended page ends.
pub(super) const IDLE: Duration = Duration::from_secs(30 * 60);
/// Longest time from login to the end of a session, however active its user is.
const LONGEST: Duration = Duration::from_secs(12 * 3600);
/// Maximum number of sessions of one user; a further login ends the one that was unused longest.
const MOST_OF_USER: usize = 8;
/// Maximum number of sessions of all users; a further login ends the one that was unused longest.
const MOST_SESSIONS: usize = 128;

/// Random numbers for one session.
#[derive(Debug, Clone, Copy)]
pub(super) struct Secrets {
    pub(super) cookie: [u8; 32],
    pub(super) csrf: [u8; 32],
}

/// A session that was started by a login.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Session {
    pub(super) user: Arc<str>,
    /// The user and a number that no other login has.
    pub(super) login: Arc<str>,
    /// The token that every POST request must repeat.
    pub(super) csrf: String,
    begun: Instant,
    used: Instant,
}

impl Session {
    fn ends(&self) -> Instant {
        (self.used + IDLE).min(self.begun + LONGEST)
    }

    /// Time until the session ends if its user does nothing.
    pub(super) fn expires_in(&self, now: Instant) -> Duration {
        self.ends().saturating_duration_since(now)
    }
}

/// All sessions. Of a cookie only the SHA-256 is kept, so the duration of a lookup reveals nothing.
#[derive(Debug, Default)]
pub(super) struct Sessions {
    open: HashMap<[u8; 32], Session>,
    /// Number of sessions started so far.
    logins: u64,
}

impl Sessions {
    /// Starts a session; returns it and the value of its cookie.
    pub(super) fn begin(&mut self, user: &Arc<str>, secrets: Secrets, now: Instant) -> (Session, String) {
        self.open.retain(|_, session| now < session.ends());
        self.make_room(MOST_OF_USER, |session| session.user == *user);
        self.make_room(MOST_SESSIONS, |_| true);
        self.logins += 1;
        let session = Session {
            user: user.clone(),
            login: format!("{user}#{}", self.logins).into(),
            csrf: hex::encode(&secrets.csrf),
            begun: now,
            used: now,
        };
        let cookie = hex::encode(&secrets.cookie);
        self.open.insert(hash(&cookie), session.clone());
        (session, cookie)
    }

    /// Ends the session that was unused longest, if there are `most` sessions of this kind.
    fn make_room(&mut self, most: usize, kind: impl Fn(&Session) -> bool) {
        let of_kind = || self.open.iter().filter(|(_, session)| kind(session));
        if of_kind().count() < most {
            return;
        }
        if let Some(oldest) = of_kind().min_by_key(|(_, session)| session.used).map(|(key, _)| *key) {
            self.open.remove(&oldest);
        }
    }

    pub(super) fn find(&self, cookie: &str, now: Instant) -> Option<&Session> {
        self.open.get(&hash(cookie)).filter(|session| now < session.ends())
    }

    /// Notes that the user of the session was active.
    pub(super) fn used(&mut self, cookie: &str, now: Instant) {
        if let Some(session) = self.open.get_mut(&hash(cookie)).filter(|session| now < session.ends()) {
            session.used = now;
        }
    }

    /// Ends the session with this cookie.
    pub(super) fn end(&mut self, cookie: &str) {
        self.open.remove(&hash(cookie));
    }

    /// Ends the sessions of all users for whom `stays` does not hold.
    pub(super) fn keep(&mut self, stays: impl Fn(&str) -> bool) {
        self.open.retain(|_, session| stays(&session.user));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn secrets(number: u8) -> Secrets {
        Secrets {
            cookie: [number; 32],
            csrf: [number.wrapping_add(100); 32],
        }
    }

    #[test]
    fn a_session_ends_by_itself() {
        let (mut sessions, start) = (Sessions::default(), Instant::now());
        let (session, cookie) = sessions.begin(&"alice".into(), secrets(1), start);
        assert_eq!((&*session.user, &*session.login), ("alice", "alice#1"));
        assert_eq!(session.csrf, "65".repeat(32));
        assert_eq!(session.expires_in(start), IDLE);
        let nearly = IDLE - Duration::from_secs(1);
        assert!(sessions.find(&cookie, start + nearly).is_some());
        assert!(sessions.find(&cookie, start + IDLE).is_none());
        sessions.used(&cookie, start + IDLE);
        assert!(sessions.find(&cookie, start + IDLE).is_none(), "it does not come back");
        assert!(sessions.find(&hex::encode(&[2; 32]), start).is_none() && sessions.find("", start).is_none());

        let (_, cookie) = sessions.begin(&"alice".into(), secrets(2), start);
        let mut now = start;
        while now + nearly < start + LONGEST {
            now += nearly;
            assert!(sessions.find(&cookie, now).is_some());
            sessions.used(&cookie, now);
        }
        assert!(
            sessions.find(&cookie, start + LONGEST).is_none(),
            "whatever its user does"
        );
    }

    #[test]
    fn sessions_are_ended_and_bounded() {
        let (mut sessions, start) = (Sessions::default(), Instant::now());
        let second = Duration::from_secs(1);
        let cookies: Vec<String> = (0..MOST_OF_USER as u8)
            .map(|i| sessions.begin(&"alice".into(), secrets(i), start + second * i.into()).1)
            .collect();
        let now = start + second * 20;
        sessions.used(&cookies[0], now);
        let (_, bob) = sessions.begin(&"bob".into(), secrets(90), now);
        let (_, ninth) = sessions.begin(&"alice".into(), secrets(91), now);
        let open = |sessions: &Sessions, cookie: &str| sessions.find(cookie, now).is_some();
        assert!(
            !open(&sessions, &cookies[1]),
            "the one that was used the longest time ago"
        );
        assert!(
            [&cookies[0], &cookies[2], &ninth, &bob]
                .iter()
                .all(|cookie| open(&sessions, cookie))
        );
        sessions.end(&ninth);
        sessions.keep(|user| user == "bob");
        assert!(open(&sessions, &bob) && !open(&sessions, &cookies[0]) && !open(&sessions, &ninth));
        for number in 0..=u8::MAX {
            sessions.begin(&format!("u{number}").into(), secrets(number), now);
        }
        assert_eq!(sessions.open.len(), MOST_SESSIONS);
    }
}
