//! Whether the primary host is online, by its STATE messages.

use serde::Deserialize;

use super::topics::StateForm;

/// A STATE message: `{"online": true, "timestamp": 1700000000000}`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
struct State {
    online: bool,
    /// Time of the state, ms since 1970.
    timestamp: u64,
}

/// The primary host, according to its messages on this connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Host {
    state: Option<State>,
    /// Whether the host uses Sparkplug 3.0: a STATE message that an older version left at the broker is then ignored.
    has_objects: bool,
}

impl Host {
    /// Forgets the state of the host, which will be reported again.
    pub(super) fn forget(&mut self) {
        self.state = None;
    }

    /// Processes a STATE message; a message older than the last one is ignored.
    ///
    /// # Errors
    /// If the payload is not a valid state; contains the reason.
    pub(super) fn take(&mut self, form: StateForm, payload: &[u8]) -> Result<(), String> {
        let state: State = match form {
            StateForm::Object => serde_json::from_slice(payload).map_err(|error| error.to_string())?,
            StateForm::Word if self.has_objects => return Ok(()),
            StateForm::Word => State {
                online: match payload {
                    b"ONLINE" => true,
                    b"OFFLINE" => false,
                    _ => return Err("it is neither ONLINE nor OFFLINE".to_string()),
                },
                timestamp: 0,
            },
        };
        self.has_objects |= form == StateForm::Object;
        if self.state.is_none_or(|last| state.timestamp >= last.timestamp) {
            self.state = Some(state);
        }
        Ok(())
    }

    pub(super) fn is_online(self) -> bool {
        self.state.is_some_and(|state| state.online)
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
            host.take(StateForm::Object, message.as_bytes()).unwrap();
            assert_eq!(host.is_online(), online, "{message}");
        }
        for bad in [
            "ONLINE",
            "",
            "{}",
            r#"{"online": 1, "timestamp": 5}"#,
            r#"{"online": true}"#,
        ] {
            assert!(host.take(StateForm::Object, bad.as_bytes()).is_err(), "{bad}");
        }
        assert!(host.is_online());
    }

    #[test]
    fn the_words_of_sparkplug_2_count_until_there_is_an_object() {
        let mut host = Host::default();
        for (word, online) in [("ONLINE", true), ("OFFLINE", false), ("ONLINE", true)] {
            host.take(StateForm::Word, word.as_bytes()).unwrap();
            assert_eq!(host.is_online(), online, "{word}");
        }
        assert!(host.take(StateForm::Word, b"online?").is_err());
        let object = br#"{"online": false, "timestamp": 5}"#;
        host.take(StateForm::Object, object).unwrap();
        assert!(!host.is_online());
        host.take(StateForm::Word, b"ONLINE").unwrap();
        assert!(!host.is_online(), "left by an older version");
        host.forget();
        host.take(StateForm::Word, b"ONLINE").unwrap();
        assert!(!host.is_online(), "on the next connection too");
    }
}
