//! A family's rules for writing parameters back: exceptions, order, saving.

use crate::drive::PointIndex;
use std::ops::RangeInclusive;

/// PDU addresses of parameters.
pub type Addresses = Vec<RangeInclusive<u16>>;

/// Rules for writing parameters back; by default there are no rules and nothing is left out.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct WriteRules {
    /// Written only if the user names the parameter; and why.
    pub only_by_name: Vec<(RangeInclusive<u16>, String)>,
    /// Parameters with the ratings of the drive itself, equal in all drives of one kind. Such a parameter is
    /// written only if the user names it.
    pub nameplate: Addresses,
    /// Parameters with the ratings of the supply and the motor, which are connected to the drive.
    pub ratings: Addresses,
    /// Parameters that are not kept without power, even if saved.
    pub volatile: Addresses,
    /// Parameters that bound one another.
    pub limits: Vec<Limit>,
    /// The write after which the drive stores the parameters permanently: PDU address and value. Without it every
    /// write is stored at once, as far as the family is known.
    pub save: Option<(u16, u16)>,
    /// Parameters that the drive takes in one mode only.
    pub lock: Option<Lock>,
    /// A note that the user should read before writing the parameter; empty if there is none.
    pub note: String,
}

/// Two parameters of one scale, of which one must never be above the other.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limit {
    /// PDU address of the parameter that must not be below the other.
    pub upper: u16,
    /// PDU address of the parameter that may not be greater.
    pub lower: u16,
}

/// Parameters that the drive takes in one mode only.
#[derive(Debug, Clone, PartialEq)]
pub struct Lock {
    /// The addresses that the lock protects.
    pub of: Addresses,
    /// Point (index in the profile) that is true only while the drive refuses parameters. While it is false, the
    /// drive may still refuse them.
    pub point: PointIndex,
    /// Exception code of the refusal; N2 codes with 0x80 added. `None` if no manual states it.
    pub exception: Option<u8>,
    /// The remedy for the lock.
    pub remedy: String,
}

/// Whether one of the ranges has that address.
pub fn has(addresses: &[RangeInclusive<u16>], address: u16) -> bool {
    addresses.iter().any(|range| range.contains(&address))
}

impl WriteRules {
    /// Why the parameter is written only if the user names it; `None` if it is written like all others.
    pub fn held_back(&self, address: u16) -> Option<&str> {
        if has(&self.nameplate, address) {
            return Some("it describes the drive itself");
        }
        let row = self.only_by_name.iter().find(|(range, _)| range.contains(&address));
        row.map(|(_, why)| why.as_str())
    }
}
