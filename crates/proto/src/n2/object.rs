//! The N2 objects of a drive, and their places in the tables of Modbus.

use std::fmt;

use crate::modbus::Table;

/// First input register of the internal integers.
pub const ADI_BASE: u16 = 0x4000;

/// A type of N2 object; the number is its region on the wire (reference/drives.md 6.2).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Region {
    /// Analog input, a float.
    Ai = 1,
    /// Binary input.
    Bi = 2,
    /// Analog output, a float.
    Ao = 3,
    /// Binary output.
    Bo = 4,
    /// Internal objects that are floats.
    Adf = 5,
    /// Internal objects that are integers of 16 bits.
    Adi = 6,
    /// Internal objects that are bytes.
    Bd = 7,
}

impl Region {
    /// All regions in the order of their numbers.
    pub const ALL: [Region; 7] = [
        Region::Ai,
        Region::Bi,
        Region::Ao,
        Region::Bo,
        Region::Adf,
        Region::Adi,
        Region::Bd,
    ];

    /// The region with this number.
    pub fn from_number(number: u8) -> Option<Region> {
        Region::ALL.into_iter().find(|region| *region as u8 == number)
    }

    /// The abbreviation used in the manuals.
    pub fn name(self) -> &'static str {
        match self {
            Region::Ai => "AI",
            Region::Bi => "BI",
            Region::Ao => "AO",
            Region::Bo => "BO",
            Region::Adf => "ADF",
            Region::Adi => "ADI",
            Region::Bd => "BD",
        }
    }

    /// The attribute that carries the value; the state of BI and BO is in their status.
    pub fn value_attribute(self) -> u8 {
        match self {
            Region::Ai | Region::Ao => 3,
            Region::Bi | Region::Bo | Region::Adf | Region::Adi | Region::Bd => 2,
        }
    }

    /// Internal objects are written without an attribute number (reference/n2.md 2).
    pub fn is_internal(self) -> bool {
        matches!(self, Region::Adf | Region::Adi | Region::Bd)
    }

    /// Number of bytes of an override's value.
    pub fn override_bytes(self) -> usize {
        match self {
            Region::Ai | Region::Ao | Region::Adf => 4,
            Region::Adi => 2,
            Region::Bi | Region::Bo | Region::Bd => 1,
        }
    }
}

/// An N2 object of a drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Object {
    /// Region of the object.
    pub region: Region,
    /// Network point address of the object, as the manuals print it: their maps begin with 1.
    pub number: u8,
}

impl Object {
    /// The object whose first item is at that address; 255 of a kind at most.
    pub fn containing(table: Table, address: u16) -> Option<Object> {
        let (region, index) = match table {
            Table::DiscreteInput => (Region::Bi, address),
            Table::Coil => (Region::Bo, address),
            Table::Input if address >= ADI_BASE => (Region::Adi, address - ADI_BASE),
            Table::Input if address.is_multiple_of(2) => (Region::Ai, address / 2),
            Table::Holding if address.is_multiple_of(2) => (Region::Ao, address / 2),
            Table::Input | Table::Holding => return None,
        };
        let number = u8::try_from(index.checked_add(1)?).ok()?;
        Some(Object { region, number })
    }

    /// Place of the object: table and first address; `None` for objects in no table.
    pub fn place(self) -> Option<(Table, u16)> {
        let index = u16::from(self.number.checked_sub(1)?);
        match self.region {
            Region::Bi => Some((Table::DiscreteInput, index)),
            Region::Bo => Some((Table::Coil, index)),
            Region::Ai => Some((Table::Input, 2 * index)),
            Region::Ao => Some((Table::Holding, 2 * index)),
            Region::Adi => Some((Table::Input, ADI_BASE + index)),
            Region::Adf | Region::Bd => None,
        }
    }

    /// Number of registers or bits that the object takes.
    pub fn items(self) -> u16 {
        match self.region {
            Region::Ai | Region::Ao | Region::Adf => 2,
            Region::Bi | Region::Bo | Region::Adi | Region::Bd => 1,
        }
    }
}

impl fmt::Display for Object {
    /// Formats an object like `AI 2`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}", self.region.name(), self.number)
    }
}
