//! The rights of those who publish to the broker. They belong to the configuration and not to the client, which a reload
//! replaces: commands that wait, and messages that a client still receives while it ends, are judged by what comes next.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use super::Options;
use crate::command::Right;

/// Who may command: by the set topics, and as a Sparkplug host.
#[derive(Debug, Default)]
pub struct BrokerRights {
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

    /// What comes later is another right: none of what this one has placed comes back with it.
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

    /// A reload puts a client with the options `next` in the place of the one before, or none.
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
