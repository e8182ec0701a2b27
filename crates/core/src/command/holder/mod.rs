//! Who holds a drive: principals and their ranks, the hold of one drive, and what a command asks of it. Pure: time is
//! an argument.
//!
//! Who a client is, is found by what its connection proves ([`Proof`], made by the north sides); [`Rules`] turn that
//! into a [`Claim`]. A [`Holding`] judges the commands of clients to one drive. The holdings are part of the queue of
//! the bus, as the priority arrays are, so that they and the commands have one order of acceptance.

mod asks;
mod denial;
mod holding;
mod kept;
mod principal;

pub use asks::Asks;
pub use denial::Denial;
pub use holding::{HoldState, HoldView, Holding, Told, Verb, What};
pub use kept::KeptReservation;
pub use principal::{Claim, Mode, Principal, Proof, Rules};

#[cfg(test)]
mod tests;
