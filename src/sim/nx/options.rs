//! How a simulated NX is made.

use super::motor::Load;
use super::{Hole, Limits, ReadOnly};
use std::time::Duration;

/// Which status bits the drive shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StatusBits {
    /// All bits of the Vacon NX: 0x0541 when idle and healthy.
    Full,
    /// Only those all drives of the family share, as the worked frames of drives.md print them.
    Common,
}

/// What the read-only registers hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Values {
    /// What the simulated motor does.
    Physical,
    /// `tag` in the high byte, the low byte of the register's PDU address in the low byte: proves in a test that a
    /// value came from that register of that drive.
    Tagged(u8),
}

/// How a simulated NX is made.
#[derive(Debug, Clone)]
pub struct NxOptions {
    /// Load and mains.
    pub load: Load,
    /// Registers per message and what happens beyond.
    pub limits: Limits,
    /// Registers without a meaning inside the process data ranges.
    pub hole: Hole,
    /// Writes to read-only registers.
    pub read_only: ReadOnly,
    /// Silence on the bus that counts as a lost master; zero switches the supervision off. The board's parameter 5.
    pub timeout: Duration,
    /// Which status bits the drive shows.
    pub status: StatusBits,
    /// What the read-only registers hold.
    pub values: Values,
    /// Parameters to start with: ID and value; those that a drive does not have or not allow are passed over.
    pub parameters: Vec<(u16, u16)>,
    /// Makes ID 1999 (PDU 1998) a register of the simulator: writing a number trips that fault. No real drive has it.
    pub trip_register: bool,
}

impl Default for NxOptions {
    fn default() -> Self {
        NxOptions {
            load: Load::default(),
            limits: Limits::default(),
            hole: Hole::Exception,
            read_only: ReadOnly::Exception,
            timeout: Duration::from_secs(20),
            status: StatusBits::Full,
            values: Values::Physical,
            parameters: Vec::new(),
            trip_register: false,
        }
    }
}
