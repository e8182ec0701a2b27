//! The right of a client to write, granted by the interface through which its commands arrive.

use std::fmt::Debug;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// The permissions of a client by the present configuration: a change by a reload takes effect at once.
pub trait Grants: Debug + Send + Sync {
    /// Whether the client may write to drives of this bus.
    fn may_write(&self, bus: &str) -> bool;
}

/// Grants for an interface whose client may write to every bus, switched by one flag.
impl Grants for AtomicBool {
    fn may_write(&self, _: &str) -> bool {
        self.load(Ordering::Acquire)
    }
}

/// The right of a client to write. Waiting commands, sequences in progress and slots of priority arrays carry the
/// right of their client, so that a reload that revokes it ends them.
#[derive(Debug, Clone, Default)]
pub struct Right(Option<Arc<dyn Grants>>);

impl Right {
    /// A right that a reload can take away.
    pub fn of(grants: Arc<dyn Grants>) -> Right {
        Right(Some(grants))
    }

    /// A right that no reload removes: for the gateway itself, and for an action that has started and must be completed.
    pub const fn lasting() -> Right {
        Right(None)
    }

    /// Whether the client may write to drives of this bus now.
    pub fn allows(&self, bus: &str) -> bool {
        self.0.as_ref().is_none_or(|grants| grants.may_write(bus))
    }
}

/// Clients are equal even if their rights differ.
impl PartialEq for Right {
    fn eq(&self, _: &Right) -> bool {
        true
    }
}

impl Eq for Right {}
