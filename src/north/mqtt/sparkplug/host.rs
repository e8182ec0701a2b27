//! Whether the primary host is online, by its STATE messages.

use serde::Deserialize;

/// A STATE message: `{"online": true, "timestamp": 1700000000000}`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
struct State {
    online: bool,
    /// ms since 1970.
    timestamp: u64,
}

/// The primary host as its messages on this connection tell.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Host(Option<State>);

impl Host {
    /// Takes a STATE message; older ones than the last count for nothing.
    ///
    /// # Errors
    /// Why it is none.
    pub(super) fn take(&mut self, payload: &[u8]) -> Result<(), String> {
        let state: State = serde_json::from_slice(payload).map_err(|error| error.to_string())?;
        if self.0.is_none_or(|last| state.timestamp >= last.timestamp) {
            self.0 = Some(state);
        }
        Ok(())
    }

    pub(super) fn is_online(self) -> bool {
        self.0.is_some_and(|state| state.online)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_latest_message_counts() {
        let mut host = Host::default();
        assert!(!host.is_online());
        for (message, online) in [
            (r#"{"online": true, "timestamp": 100}"#, true),
            (r#"{"online": false, "timestamp": 99}"#, true),
            (r#"{"online": false, "timestamp": 100, "more": 1}"#, false),
            (r#"{"online": true, "timestamp": 99}"#, false),
            (r#"{"online": true, "timestamp": 101}"#, true),
        ] {
            host.take(message.as_bytes()).unwrap();
            assert_eq!(host.is_online(), online, "{message}");
        }
        for bad in [
            "ONLINE",
            "",
            "{}",
            r#"{"online": 1, "timestamp": 5}"#,
            r#"{"online": true}"#,
        ] {
            assert!(host.take(bad.as_bytes()).is_err(), "{bad}");
        }
        assert!(host.is_online());
    }
}
