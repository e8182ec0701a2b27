//! Options of a simulated Vacon CX.

use super::super::model::Beyond;
use super::super::motor::Load;
use drivegate_proto::Table;
use std::str::FromStr;

/// Items per message; the manual states no limits and shows one item everywhere (reference/drives.md 9.7).
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    /// Maximum number of coils or discrete inputs per message.
    pub bits: u16,
    pub registers: u16,
    /// The reaction to more items.
    pub beyond: Beyond,
}

impl Default for Limits {
    fn default() -> Self {
        Limits {
            bits: 8,
            registers: 20,
            beyond: Beyond::Value,
        }
    }
}

/// Offsets added to the addresses of the manual's tables. The start-up test of the manual uses some that are one
/// higher, so some boards may have an offset of 1 (reference/drives.md 9.6).
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct AddressOffset {
    pub coil: u16,
    pub discrete_input: u16,
    /// Offset of the input registers.
    pub input: u16,
    /// Offset of the holding registers.
    pub holding: u16,
}

impl AddressOffset {
    /// The address offset of this table.
    pub fn of(&self, table: Table) -> u16 {
        match table {
            Table::Coil => self.coil,
            Table::DiscreteInput => self.discrete_input,
            Table::Input => self.input,
            Table::Holding => self.holding,
        }
    }
}

/// Text such as `holding=1,discrete-input=1`; a table that is not named has no offset.
impl FromStr for AddressOffset {
    type Err = String;

    fn from_str(text: &str) -> Result<AddressOffset, String> {
        let mut offset = AddressOffset::default();
        for part in text.split(',') {
            let (table, value) = part.split_once('=').unwrap_or((part, ""));
            let table = Table::from_name(table.trim()).ok_or_else(|| {
                format!("`{part}` does not name a table; write coil, discrete-input, input or holding")
            })?;
            let value = match value.trim() {
                "0" => 0,
                "1" => 1,
                _ => return Err(format!("`{part}` is not an offset; write 0 or 1, such as {table}=1")),
            };
            match table {
                Table::Coil => offset.coil = value,
                Table::DiscreteInput => offset.discrete_input = value,
                Table::Input => offset.input = value,
                Table::Holding => offset.holding = value,
            }
        }
        Ok(offset)
    }
}

/// Reaction to a frequency reference outside Par 1.1 to Par 1.2.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OutOfRange {
    /// Exception 03.
    Exception,
    /// The nearest allowed number is used.
    Clamp,
}

/// Options of a simulated CX.
#[derive(Debug, Clone)]
pub struct CxOptions {
    /// Load of the motor and mains.
    pub load: Load,
    /// Maximum items per message.
    pub limits: Limits,
    /// Offsets added to the addresses.
    pub offset: AddressOffset,
    /// Reaction to a frequency reference outside Par 1.1 to Par 1.2.
    pub reference_out_of_range: OutOfRange,
    /// Hz that one count of Par 1.1, 1.2 and 1.9 is. The manual's example reads 50 for Par 1.2.
    pub frequency_step: f64,
    /// Days or hours that one count of the operating times n9 and n10 is.
    pub time_step: f64,
    /// Whether the fieldbus is the active control source at first.
    pub fieldbus: bool,
    /// Initial parameters: (group, number) and value; those that a drive does not have or does not allow are skipped.
    pub parameters: Vec<((u16, u16), u16)>,
    /// Whether PDU 9999 is a holding register of the simulator: writing a number trips the drive with that fault. No
    /// real drive has this register.
    pub trip_register: bool,
}

impl CxOptions {
    /// PDU address of the simulator's own trip register: the last address of group 0, at which there is no parameter.
    pub const TRIP_ADDRESS: u16 = 9999;
}

impl Default for CxOptions {
    fn default() -> Self {
        CxOptions {
            load: Load::default(),
            limits: Limits::default(),
            offset: AddressOffset::default(),
            reference_out_of_range: OutOfRange::Exception,
            frequency_step: 1.0,
            time_step: 0.01,
            fieldbus: true,
            parameters: Vec::new(),
            trip_register: false,
        }
    }
}
