//! Topic aliases of a connection.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;

/// Topic aliases for telemetry that is published repeatedly: a topic gets one when it is published for the second
/// time, as long as the broker has any left.
#[derive(Debug, Default)]
pub(super) struct Aliases {
    /// Aliases by topic, and whether the broker knows each.
    named: HashMap<Arc<str>, (u16, bool)>,
    once: HashSet<Arc<str>>,
}

impl Aliases {
    /// The alias of a topic, if it gets one of those that the broker granted, and whether the broker knows it already.
    pub(super) fn of(&mut self, topic: &Arc<str>, granted: u16) -> Option<(u16, bool)> {
        if let Some(alias) = self.named.get(topic) {
            return Some(*alias);
        }
        let next = u16::try_from(self.named.len() + 1).ok().filter(|next| *next <= granted);
        let Some(next) = next else {
            self.once = HashSet::new();
            return None;
        };
        if self.once.insert(topic.clone()) {
            return None;
        }
        self.named.insert(topic.clone(), (next, false));
        Some((next, false))
    }

    /// Notes that the broker knows the alias of this topic.
    pub(super) fn announced(&mut self, topic: &str) {
        if let Some((_, known)) = self.named.get_mut(topic) {
            *known = true;
        }
    }
}
