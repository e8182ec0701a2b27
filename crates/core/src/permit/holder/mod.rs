//! Who holds a drive: principals and their ranks, the hold of one drive, and what a command asks of it. Pure: time is
//! an argument.
//!
//! What a connection proves ([`crate::order::Proof`], made by the servers) tells who a client is; [`Rules`] turn that
//! into a [`Claim`]. A [`Holding`] judges the commands of clients to one drive. The holdings are part of the gate of
//! the bus, as the priority arrays are, so that they and the commands have one order of acceptance.

mod denial;
mod holding;
mod kept;
mod principal;

pub use denial::Denial;
pub use holding::{HoldState, HoldView, Holding, Told, Verb, What};
pub use kept::KeptReservation;
pub use principal::{Claim, Mode, Principal, Rules};

#[cfg(test)]
mod tests;
