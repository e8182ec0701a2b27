//! A BACnet/IP server without sockets, threads or a clock: datagrams and the time are arguments, datagrams are results.
//!
//! [`Server`] represents a device of its own and, behind a virtual network for which it is the router, any number
//! of further ones. Their values come from an [`Application`]; writes of clients are given to it as [`Job`]s and
//! answered only when the application reports their result, so that an acknowledgement means that the write took
//! effect.
//!
//! | module | what it is |
//! |---|---|
//! | `types`, `encoding` | identifiers, errors, tags and primitive values |
//! | `bvlc`, `npdu`, `apdu` | the three headers of a datagram |
//! | `services` | what requests say |
//! | `object` | what a device is made of, and its properties |
//! | `server` | network, transactions, subscriptions, limits |
//!
//! Every table is bounded, in total and for each client; no input causes a panic.

#![warn(missing_docs)]
#![forbid(unsafe_code)]
#![cfg_attr(
    test,
    allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::indexing_slicing)
)]

pub mod apdu;
pub mod bvlc;
pub mod encoding;
pub mod npdu;
pub mod object;
pub mod server;

pub mod services;
pub mod types;

pub use object::{Access, Commands, Datum, Device, Kind, Object, Reliability, Sample, Slot, ValueSource};
pub use server::{Application, Counters, Job, Options, Registration, Server, To};
pub use types::{Address, Data, DateTime, Error, ErrorClass, Mac, ObjectId, ObjectType, PropertyId};
