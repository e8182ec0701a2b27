//! What a tool may send, as its slot is configured now: a reload counts also for a request that waits for its share of the
//! line, or of which half has come.

use std::net::IpAddr;
use std::path::PathBuf;
use std::sync::Arc;

use arc_swap::ArcSwap;

use super::{Options, Slot, SlotAccess};
use crate::command::{Grants, Proof, Right};

/// By which way a tool came.
#[derive(Debug, Clone)]
enum Way {
    Address(IpAddr),
    Pty(PathBuf),
    /// None: a test without sockets.
    Within,
}

/// The rights of one tool.
#[derive(Debug, Clone)]
pub(super) struct ToolRights {
    current: Arc<ArcSwap<Options>>,
    bus: Arc<str>,
    way: Way,
}

impl ToolRights {
    pub(super) fn new(current: &Arc<ArcSwap<Options>>, bus: &str, proof: &Proof) -> ToolRights {
        ToolRights {
            current: current.clone(),
            bus: bus.into(),
            way: match proof {
                Proof::Address(address) => Way::Address(*address),
                Proof::Pty(path) => Way::Pty(PathBuf::from(&**path)),
                _ => Way::Within,
            },
        }
    }

    /// The right to send what needs that access.
    pub(super) fn of(&self, needs: SlotAccess) -> Right {
        Right::of(Arc::new(ToolRight {
            rights: self.clone(),
            needs,
        }))
    }
}

#[derive(Debug)]
struct ToolRight {
    rights: ToolRights,
    needs: SlotAccess,
}

impl Grants for ToolRight {
    fn may_write(&self, bus: &str) -> bool {
        let ToolRights { current, bus: own, way } = &self.rights;
        let serves = |slot: &Slot| match way {
            Way::Address(address) => {
                slot.addresses().next().is_some() && slot.allow.iter().any(|network| network.contains(address))
            }
            Way::Pty(path) => slot.pty.as_ref() == Some(path),
            Way::Within => true,
        };
        let current = current.load();
        let mut slots = current.slots.iter();
        bus == &**own && slots.any(|slot| slot.bus == bus && slot.access >= self.needs && serves(slot))
    }
}
