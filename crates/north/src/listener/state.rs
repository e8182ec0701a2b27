//! The configured listeners, and why some of them do not listen: for readiness and metrics.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::ServerKind;

/// The listeners of all servers.
#[derive(Debug, Default)]
pub struct ListenerStates(Mutex<All>);

#[derive(Debug, Default)]
struct All {
    added: u64,
    listeners: BTreeMap<u64, Entry>,
}

#[derive(Debug)]
struct Entry {
    server: ServerKind,
    pub address: SocketAddr,
    /// Why the listener does not listen.
    why: Option<String>,
}

/// The state of one listener; dropping it removes the listener from all states.
#[derive(Debug)]
pub(crate) struct ListenerState {
    all: Arc<ListenerStates>,
    number: u64,
}

impl ListenerStates {
    /// Adds a listener to the states.
    pub(crate) fn add(self: &Arc<Self>, server: ServerKind, address: SocketAddr) -> ListenerState {
        let mut all = self.lock();
        all.added += 1;
        let (number, why) = (all.added, None);
        all.listeners.insert(number, Entry { server, address, why });
        ListenerState {
            all: self.clone(),
            number,
        }
    }

    /// A line of text for each listener that does not listen.
    pub fn reasons(&self) -> Vec<String> {
        let line = |entry: &Entry| {
            let (server, address) = (entry.server.title(), entry.address);
            let why = entry.why.as_ref()?;
            Some(format!("{server} does not listen on {address}: {why}; retrying"))
        };
        self.lock().listeners.values().filter_map(line).collect()
    }

    /// The servers that have a listener, and whether all of theirs listen.
    pub fn up(&self) -> Vec<(ServerKind, bool)> {
        let all = self.lock();
        let of = |server: ServerKind| {
            let mut own = all.listeners.values().filter(|entry| entry.server == server).peekable();
            own.peek()?;
            Some((server, own.all(|entry| entry.why.is_none())))
        };
        ServerKind::ALL.into_iter().filter_map(of).collect()
    }

    fn lock(&self) -> MutexGuard<'_, All> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl ListenerState {
    /// Sets the state: listening, or not listening for this reason.
    pub(super) fn set(&self, why: Option<String>) {
        if let Some(entry) = self.all.lock().listeners.get_mut(&self.number) {
            entry.why = why;
        }
    }
}

impl Drop for ListenerState {
    fn drop(&mut self) {
        self.all.lock().listeners.remove(&self.number);
    }
}
