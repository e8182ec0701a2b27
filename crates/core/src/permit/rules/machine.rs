//! Whether an order still means the machine that it named when its first byte arrived.
//!
//! This rule is checked before an order enters the queue ([`crate::plant::DriveHandle::place`]), since all other
//! rules judge the machine that the order reaches. It is not checked again: a bus serves the same machines as long
//! as it runs, and a reload ends the waiting orders of a bus that it replaces, or hands them over by machine.

use crate::order::Refusal;

/// The refusal of all orders except stops.
pub fn refusal() -> Refusal {
    Refusal::UnknownDrive(
        "the name meant another machine when this request began; nothing was written; send it again".to_string(),
    )
}
