//! Messages between the client and the socket.

use std::sync::atomic::{AtomicBool, AtomicUsize};
use std::sync::{Mutex, MutexGuard, PoisonError};

use super::super::rate::Rate;
use super::super::reasons::CLOSED;
use super::super::trail::Trail;

/// Messages that rumqttc has not written yet.
#[derive(Debug)]
pub(super) struct Backlog {
    pub(super) messages: AtomicUsize,
    /// Times at which rumqttc wrote its latest messages.
    rate: Mutex<Rate>,
    /// The packets that the library wrote last.
    trail: Mutex<Trail>,
    /// Whether the client waits for [`Step::Room`].
    pub(super) room_wanted: AtomicBool,
}

impl Backlog {
    pub(super) fn new(publish_limit: usize) -> Backlog {
        Backlog {
            messages: AtomicUsize::new(0),
            rate: Mutex::new(Rate::new(publish_limit)),
            trail: Mutex::default(),
            room_wanted: AtomicBool::new(false),
        }
    }

    pub(super) fn rate(&self) -> MutexGuard<'_, Rate> {
        self.rate.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn trail(&self) -> MutexGuard<'_, Trail> {
        self.trail.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Why the broker closed a connection, if it gave no reason.
    pub(super) fn closed(&self) -> String {
        match self.trail().last() {
            Some(packet) => format!("{CLOSED}; the last packet sent before was {packet}"),
            None => CLOSED.to_string(),
        }
    }
}
