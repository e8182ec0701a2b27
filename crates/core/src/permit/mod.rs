//! When an order may move a motor: one gate, used at every moment that counts, with the state of that moment.
//!
//! An order is judged at three stages ([`Stage`]): it is accepted into the queue of its bus, its turn comes on the
//! line, and each of its frames is about to be sent. In between the state may change: by another client, a stop, a
//! reload, a pause of the process, a drive that restarts, an operator at the panel. So there is one list of rules
//! (`judge`), each in a separate file below `rules`, and one state for all of them ([`Gate`]). The callers do not
//! know the rules, and a rule does not know its caller. An answer may be to look first ([`Verdict::LookFirst`]): the bus then
//! reads the motor within the same command and asks again. Before an order is judged it is checked and converted by
//! profile and limits ([`admit`]).
//!
//! - `admit`: what the profile, the configuration and the limits let through. `reference_limits`: the present reference
//!   under a changed frequency range.
//! - `holder`: principals and who holds a drive. `priorities`: the slots of BACnet. The starts of motors are counted in
//!   [`crate::start_guard`].
//! - `awaited_files`: what the disk has not returned yet after a start.
//! - `gate`: what is known of the drives of a bus that decides about orders.
//! - `judge`: the list. `rules`: the rules.

mod admit;
mod awaited_files;
mod gate;
mod holder;
mod judge;
mod priorities;
mod reference_limits;
mod rules;

pub use admit::{admit, authority, broken_limit, converted, may_restore, sets_twice};
pub use awaited_files::{AwaitedFile, AwaitedFiles};
pub use gate::{DrillLock, Gate, Unheld};
pub use holder::{
    Claim, Denial, HoldChange, HoldState, HoldView, Holding, KeptReservation, KeptReservations, Mode, Principal, Rules,
    Verb, What,
};
pub use judge::{Ask, DriveFacts, Facts, Stage, Verdict};
pub use priorities::{Follows, PRIORITIES, PROTECTING, Priorities, Protects, Settled, VoidSlot};
pub use reference_limits::{LastWritten, is_reference, limits_passed};
pub use rules::access::{access, client_access, right_lost};
pub use rules::machine::{out_of_reach, refusal as meant_another};
pub use rules::standing::{
    AT_NEXT_START, Form, KnownRun, Motor, OnRunning, Repeats, Wants, not_seen, parameter, running_unknown,
};
