//! The links to the brokers as the status page shows them. Pure: time is an argument.

use std::sync::{Mutex, PoisonError};
use std::time::SystemTime;

/// The link of a client to its broker; empty while no client runs.
#[derive(Debug, Default)]
pub struct LinkStatus(Mutex<Option<LinkState>>);

/// What is known of a link.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LinkState {
    /// Host and port of the broker that is connected or tried.
    pub broker: String,
    pub connected: bool,
    /// Time from which on it is connected, or is not.
    pub since: SystemTime,
    /// Why the last connection ended or did not come about, and when; also while another one is open.
    pub error: Option<(SystemTime, String)>,
}

impl LinkStatus {
    /// The present state; `None` while no client runs.
    pub fn get(&self) -> Option<LinkState> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// A client begins with this broker.
    pub fn begin(&self, broker: String, at: SystemTime) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = Some(LinkState {
            broker,
            connected: false,
            since: at,
            error: None,
        });
    }

    /// The client may publish to this broker.
    pub fn connected(&self, broker: String, at: SystemTime) {
        self.change(broker, true, at);
    }

    /// There is no connection to this broker, for this reason.
    pub fn lost(&self, broker: String, why: &str, at: SystemTime) {
        self.change(broker, false, at);
        if let Some(state) = &mut *self.0.lock().unwrap_or_else(PoisonError::into_inner) {
            state.error = Some((at, why.to_string()));
        }
    }

    /// The client left its broker; this one is next.
    pub fn left(&self, broker: String, at: SystemTime) {
        self.change(broker, false, at);
    }

    /// The client ended.
    pub fn end(&self) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = None;
    }

    fn change(&self, broker: String, connected: bool, at: SystemTime) {
        if let Some(state) = &mut *self.0.lock().unwrap_or_else(PoisonError::into_inner) {
            state.broker = broker;
            if state.connected != connected {
                (state.connected, state.since) = (connected, at);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn attempts_that_fail_do_not_renew_the_time_without_a_connection() {
        let at = |seconds| SystemTime::UNIX_EPOCH + Duration::from_secs(seconds);
        let status = LinkStatus::default();
        status.connected("a:1".to_string(), at(1));
        assert_eq!(status.get(), None, "no client runs");
        status.begin("a:1".to_string(), at(2));
        status.lost("a:1".to_string(), "refused", at(3));
        status.lost("b:1".to_string(), "timed out", at(4));
        let seen = |connected, since| {
            let expected = LinkState {
                broker: "b:1".to_string(),
                connected,
                since: at(since),
                error: Some((at(4), "timed out".to_string())),
            };
            assert_eq!(status.get(), Some(expected));
        };
        seen(false, 2);
        status.connected("b:1".to_string(), at(5));
        seen(true, 5);
        status.left("b:1".to_string(), at(6));
        seen(false, 6);
        status.end();
        assert_eq!(status.get(), None);
    }
}
