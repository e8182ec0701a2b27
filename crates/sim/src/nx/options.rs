//! Options of a simulated NX, SVX or HVX. The drives of the family differ in this data only.

use super::super::motor::Load;
use super::{Beyond, Hole, Limits, ReadOnly, StatusBits};
use std::time::Duration;

/// Content of the read-only registers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Values {
    /// Registers have values of the simulated motor.
    Physical,
    /// `tag` in the high byte, the low byte of the register's PDU address in the low byte: proves in a test that a
    /// value came from this register of this drive.
    Tagged(u8),
}

/// The range that 100 % of the speed reference represents (reference/drives.md 9.2).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Base {
    /// The band from the minimum frequency (0 %) to the maximum frequency (100 %).
    Band,
    /// The maximum frequency; a running drive does not go below the minimum frequency.
    Maximum,
}

/// Unit of one count of the speed reference (reference/drives.md 9.3).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unit {
    /// 0.01 %.
    Percent,
    /// Unit 0.01 Hz, as in Eaton's tables of the Multipurpose and PID applications.
    Hertz,
}

/// How the speed reference, ID 2003, and the actual speed, ID 2103, are to be read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SpeedReference {
    /// Whether a negative reference is allowed, which reverses the direction.
    pub signed: bool,
    /// The range that 100 % represents.
    pub base: Base,
    /// Unit of one count of ID 2003; ID 2103 is always 0.01 %.
    pub unit: Unit,
}

/// Options of a simulated drive of the family.
#[derive(Debug, Clone)]
pub struct NxOptions {
    /// Load of the motor and mains.
    pub load: Load,
    /// Registers per message and what happens beyond.
    pub limits: Limits,
    /// Registers without a meaning inside the process data ranges.
    pub hole: Hole,
    /// Reaction to writes to read-only registers.
    pub read_only: ReadOnly,
    /// Silence on the bus that counts as loss of the master; zero switches the supervision off. Parameter 5 of the board.
    pub timeout: Duration,
    /// Which status bits the drive has.
    pub status: StatusBits,
    /// How the speed reference is to be read.
    pub reference: SpeedReference,
    /// Hz that one count of the output frequency is, 0.01 or 0.1 (reference/drives.md 9.1).
    pub frequency_step: f64,
    /// Whether the control word has the bits of the HVX: bypass (3), pass-through to RO1, RO2 and DO1 (10 to 12)
    /// and fire mode (13). Other drives only pass these bits on to the application.
    pub hvac_control: bool,
    /// Content of the read-only registers.
    pub values: Values,
    /// Initial parameters: ID and value; those that a drive does not have or does not allow are skipped.
    pub parameters: Vec<(u16, u16)>,
    /// Whether ID 1999 (PDU 1998) is a register of the simulator: writing a number trips the drive with that fault. No
    /// real drive has this register.
    pub trip_register: bool,
}

impl NxOptions {
    /// PDU address of the simulator's own trip register.
    pub const TRIP_ADDRESS: u16 = 1998;

    pub fn vacon() -> NxOptions {
        NxOptions {
            load: Load::default(),
            limits: Limits::VACON,
            hole: Hole::Exception,
            read_only: ReadOnly::Exception,
            timeout: Duration::from_secs(20),
            status: StatusBits::Full,
            reference: SpeedReference {
                signed: true,
                base: Base::Band,
                unit: Unit::Percent,
            },
            frequency_step: 0.01,
            hvac_control: false,
            values: Values::Physical,
            parameters: Vec::new(),
            trip_register: false,
        }
    }

    /// Eaton SVX9000.
    pub fn svx() -> NxOptions {
        NxOptions {
            limits: Limits::EATON,
            timeout: Duration::from_secs(10),
            status: StatusBits::Svx,
            reference: SpeedReference {
                signed: false,
                base: Base::Maximum,
                unit: Unit::Percent,
            },
            ..NxOptions::vacon()
        }
    }

    /// Eaton HVX9000.
    pub fn hvx() -> NxOptions {
        NxOptions {
            status: StatusBits::Hvx,
            hvac_control: true,
            ..NxOptions::svx()
        }
    }
}

impl Default for NxOptions {
    fn default() -> Self {
        NxOptions::vacon()
    }
}

impl Limits {
    /// Vacon NX: 30 and 1, process data 20 and 20.
    pub const VACON: Limits = Limits {
        read: 30,
        write: 1,
        process: 20,
        beyond: Beyond::Value,
    };
    /// Eaton SVX and HVX: 1 and 1, process data 20 and 20.
    pub const EATON: Limits = Limits {
        read: 1,
        ..Limits::VACON
    };
}

impl Default for Limits {
    fn default() -> Self {
        Limits::VACON
    }
}
