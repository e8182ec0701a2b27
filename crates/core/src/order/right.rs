//! The right of a client to write, as the way by which its commands came gives it.

use std::fmt::Debug;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// The permissions of a client, as the gateway is configured now: what a reload changes is seen at once.
pub trait Grants: Debug + Send + Sync {
    /// Whether the client may write to drives of that bus.
    fn may_write(&self, bus: &str) -> bool;
}

/// For a way in whose client may write to every bus, until that is set otherwise.
impl Grants for AtomicBool {
    fn may_write(&self, _: &str) -> bool {
        self.load(Ordering::Acquire)
    }
}

/// The right of a client to write. Commands that wait, sequences that have started and slots of priority arrays carry
/// the right of their client, so that a reload which takes it away ends them.
#[derive(Debug, Clone, Default)]
pub struct Right(Option<Arc<dyn Grants>>);

impl Right {
    /// A right that a reload can take away.
    pub fn of(grants: Arc<dyn Grants>) -> Right {
        Right(Some(grants))
    }

    /// A right that no reload takes away: for the gateway itself, and for an action that has started and must be
    /// completed.
    pub const fn lasting() -> Right {
        Right(None)
    }

    /// Whether the client may write to drives of this bus now.
    pub fn allows(&self, bus: &str) -> bool {
        self.0.as_ref().is_none_or(|grants| grants.may_write(bus))
    }
}

/// A client is the same with any right.
impl PartialEq for Right {
    fn eq(&self, _: &Right) -> bool {
        true
    }
}

impl Eq for Right {}
