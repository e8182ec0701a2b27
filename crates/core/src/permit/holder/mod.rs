//! The holder of a drive: principals and their ranks, the hold of one drive, and the rights that a command needs. Pure:
//! time is an argument.
//!
//! The proof of a connection ([`crate::order::Proof`], made by the servers) identifies a client; [`Rules`] turn it into
//! a [`Claim`]. A [`Holding`] judges the commands of clients to one drive. The holdings are part of the gate of the
//! bus, as the priority arrays are, so that they and the commands have one order of acceptance.

mod denial;
mod holding;
mod principal;
mod saved_reservation;

pub use denial::Denial;
pub use holding::{HoldChange, HoldState, HoldView, Holding, Verb, What};
pub use principal::{Claim, Mode, Principal, Rules};
pub use saved_reservation::{KeptReservation, KeptReservations};

#[cfg(test)]
mod tests;
