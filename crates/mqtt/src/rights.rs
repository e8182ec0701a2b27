//! The rights of the clients that publish to the broker. They belong to the configuration and not to the gateway's
//! MQTT client, which a reload replaces: waiting commands, and messages that an ending client still receives, are
//! judged by the new configuration.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use super::Options;
use drivegate_core::order::Right;

/// Rights to command: over the set topics, and as a Sparkplug host.
#[derive(Debug, Default)]
pub(super) struct BrokerRights {
    topics: Revocable,
    node: Revocable,
}

#[derive(Debug, Default)]
struct Revocable(Mutex<Arc<AtomicBool>>);

impl Revocable {
    fn begin(&self, may_write: bool) -> Right {
        let right = self.0.lock().unwrap_or_else(PoisonError::into_inner).clone();
        right.store(may_write, Ordering::Release);
        Right::of(right)
    }

    /// Ends this right. A later right is separate: commands placed under the ended one do not regain it.
    fn end(&self) {
        let mut right = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        right.store(false, Ordering::Release);
        *right = Arc::default();
    }
}

impl BrokerRights {
    /// A client begins: the rights over the set topics, and of a Sparkplug host.
    pub(super) fn begin(&self, options: &Options) -> (Right, Right) {
        let node = options.commands && options.sparkplug.is_some();
        (self.topics.begin(options.commands), self.node.begin(node))
    }

    /// Notes that a reload replaces the client with the options `before` by one with the options `next`, or by none.
    pub(super) fn reload(&self, before: &Options, next: Option<&Options>) {
        let same_brokers = |next: &&Options| before.brokers.iter().any(|broker| next.brokers.contains(broker));
        let next = next.filter(|next| next.commands).filter(same_brokers);
        if next.is_none() {
            self.topics.end();
        }
        if next.is_none_or(|next| next.sparkplug.is_none()) {
            self.node.end();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::client::tests::options;
    use crate::{Broker, sparkplug};

    #[test]
    fn a_right_ends_with_what_gave_it_and_comes_back_as_another_one() {
        let broker = |port| Broker {
            host: "127.0.0.1".to_string(),
            port,
            path: None,
        };
        let before = Options {
            brokers: vec![broker(1), broker(2)],
            commands: true,
            sparkplug: Some(sparkplug::Options {
                group: "plant".to_string(),
                node: "hall".to_string(),
                primary_host: String::new(),
                alias: true,
                history: false,
                state_dir: "/nonexistent".into(),
            }),
            ..options(None)
        };
        let table = [
            ("nothing", Some(before.clone()), (true, true)),
            (
                "an interval",
                Some(Options {
                    min_interval: std::time::Duration::from_secs(9),
                    ..before.clone()
                }),
                (true, true),
            ),
            (
                "one broker less",
                Some(Options {
                    brokers: vec![broker(2)],
                    ..before.clone()
                }),
                (true, true),
            ),
            ("no [mqtt]", None, (false, false)),
            (
                "commands",
                Some(Options {
                    commands: false,
                    ..before.clone()
                }),
                (false, false),
            ),
            (
                "another broker",
                Some(Options {
                    brokers: vec![broker(3)],
                    ..before.clone()
                }),
                (false, false),
            ),
            (
                "Sparkplug",
                Some(Options {
                    sparkplug: None,
                    ..before.clone()
                }),
                (true, false),
            ),
        ];
        for (what, next, expected) in table {
            let rights = BrokerRights::default();
            let (topics, node) = rights.begin(&before);
            let allowed = || (topics.allows("line1"), node.allows("line1"));
            assert_eq!(allowed(), (true, true));
            rights.reload(&before, next.as_ref());
            assert_eq!(allowed(), expected, "{what}");
            // A later client gets a new right, because the previous one has ended.
            let (later, _) = rights.begin(&before);
            assert_eq!((allowed(), later.allows("line1")), (expected, true), "{what}");
        }
    }
}
