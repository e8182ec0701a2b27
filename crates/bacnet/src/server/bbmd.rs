//! Registration as a foreign device (annex J.5).

use std::net::SocketAddrV4;
use std::time::{Duration, Instant};

use crate::bvlc;

/// Time for which the server registers, s.
pub(crate) const LIFETIME: u16 = 60;
const RENEWED: Duration = Duration::from_secs(30);
/// Pause before a registration without an answer is tried again.
const AGAIN: Duration = Duration::from_secs(5);

/// Whether a BBMD passes broadcasts on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Registration {
    /// No BBMD is configured.
    #[default]
    None,
    /// The BBMD has not answered yet.
    Unanswered,
    /// The BBMD accepted the registration.
    Registered,
    /// The BBMD refused the registration, with this result code.
    Refused(u16),
}

/// The registration of the server as a foreign device.
#[derive(Debug)]
pub(super) struct Foreign {
    bbmd: Option<SocketAddrV4>,
    next: Instant,
    pub(super) state: Registration,
    /// Time since which a request has had no answer.
    asked: Option<Instant>,
}

impl Foreign {
    pub(super) fn new(bbmd: Option<SocketAddrV4>, now: Instant) -> Foreign {
        let state = match bbmd {
            Some(_) => Registration::Unanswered,
            None => Registration::None,
        };
        Foreign {
            bbmd,
            next: now,
            state,
            asked: None,
        }
    }

    pub(super) fn is_bbmd(&self, host: SocketAddrV4) -> bool {
        self.bbmd == Some(host)
    }

    /// The address of the BBMD, if it accepted the registration for broadcasts.
    pub(super) fn passes_on(&self) -> Option<SocketAddrV4> {
        self.bbmd.filter(|_| self.state == Registration::Registered)
    }

    /// The BBMD answered.
    pub(super) fn answered(&mut self, code: u16, now: Instant) {
        self.asked = None;
        self.state = match code {
            0 => Registration::Registered,
            code => Registration::Refused(code),
        };
        self.next = now + RENEWED;
    }

    /// The registration request, if one is due.
    pub(super) fn poll(&mut self, now: Instant) -> Option<(SocketAddrV4, Vec<u8>)> {
        let bbmd = self.bbmd?;
        if now < self.next {
            return None;
        }
        let since = *self.asked.get_or_insert(now);
        if now.saturating_duration_since(since) >= RENEWED {
            self.state = Registration::Unanswered;
        }
        self.next = now + AGAIN;
        Some((bbmd, bvlc::register(LIFETIME)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_renews_and_notices_that_nobody_answers() {
        let start = Instant::now();
        let at = |s: u64| start + Duration::from_secs(s);
        let bbmd = "10.0.0.1:47808".parse().unwrap();
        let mut foreign = Foreign::new(Some(bbmd), start);
        assert_eq!(foreign.poll(start), Some((bbmd, bvlc::register(60))));
        assert_eq!(foreign.poll(at(1)), None);
        foreign.answered(0, at(1));
        assert_eq!(foreign.passes_on(), Some(bbmd));
        assert_eq!(foreign.poll(at(30)), None);
        assert!(foreign.poll(at(31)).is_some());
        assert!(foreign.poll(at(36)).is_some());
        assert_eq!(foreign.state, Registration::Registered);
        assert!(foreign.poll(at(61)).is_some());
        assert_eq!(foreign.state, Registration::Unanswered);
        foreign.answered(0x30, at(62));
        assert_eq!(
            (foreign.state, foreign.passes_on()),
            (Registration::Refused(0x30), None)
        );
        assert_eq!(Foreign::new(None, start).poll(at(99)), None);
    }
}
