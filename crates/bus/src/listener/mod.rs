//! A line that another master owns: the gateway only listens.
//!
//! - [`decoder`]: bytes and their times in, transactions of the other master out; `codec::frames` cuts the bytes. Pure.
//! - [`core`](self::core): the bus without its thread: what was received goes into the process image, events and the audit. Pure.
//! - [`commands`]: what the other master commands, reported when it changes. Pure.
//! - [`survey`]: which addresses are polled and how often, for `drivegate listen`. Pure.
//! - [`n2_survey`]: what confirms or contradicts the assumptions about N2. Pure.
//! - [`guess`]: protocol and format of a line from what is received with a setting. Pure.
//!
//! No code here can send: the thread ([`crate::BusTask`]) has a [`drivegate_line::Receiver`], which offers no way to send.

pub mod commands;
pub mod core;
pub mod decoder;
pub mod guess;
pub mod n2_survey;
pub mod survey;

pub use self::core::ListenCore;
pub use decoder::{Decoder, Exchange, Traffic};
