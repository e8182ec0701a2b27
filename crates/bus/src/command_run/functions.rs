//! Function codes that a drive accepts for a write of one item: those of its profile, until the drive itself shows
//! otherwise. Pure.

use drivegate_model::drive::Profile;
use drivegate_proto::{Protocol, RequestPdu};

/// The functions that a drive has shown to accept, if any.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct TakenFunctions {
    /// Whether a register is written by function 16, not 06.
    registers_by_16: Option<bool>,
    /// Whether a coil is written by function 15, not 05.
    coils_by_15: Option<bool>,
    /// Whether the drive refused function 22.
    refuses_22: bool,
}

impl TakenFunctions {
    /// The request in the form that the drive takes.
    pub(super) fn form(self, pdu: RequestPdu, profile: &Profile) -> RequestPdu {
        let several = match &pdu {
            RequestPdu::WriteRegister { .. } => self.registers_by_16.unwrap_or(profile.functions.registers_by_16),
            RequestPdu::WriteCoil { .. } => self.coils_by_15.unwrap_or(profile.functions.coils_by_15),
            _ => false,
        };
        match other_function(&pdu) {
            Some(other) if several && !profile.protocols.contains(&Protocol::N2) => other,
            _ => pdu,
        }
    }

    /// Whether bits of a register are written by function 22.
    pub(super) fn masks(self, profile: &Profile) -> bool {
        profile.functions.mask_write && !self.refuses_22
    }

    /// The drive does not know that function.
    pub(super) fn refused(&mut self, pdu: &RequestPdu) {
        self.refuses_22 |= matches!(pdu, RequestPdu::MaskWrite { .. });
    }

    /// Notes that the drive accepted this write of one item after it had refused it with the other function.
    pub(super) fn took(&mut self, pdu: &RequestPdu) {
        match pdu {
            RequestPdu::WriteRegister { .. } => self.registers_by_16 = Some(false),
            RequestPdu::WriteRegisters { .. } => self.registers_by_16 = Some(true),
            RequestPdu::WriteCoil { .. } => self.coils_by_15 = Some(false),
            RequestPdu::WriteCoils { .. } => self.coils_by_15 = Some(true),
            _ => {}
        }
    }
}

/// A write of the same item by the other function; `None` for any other request.
pub(super) fn other_function(pdu: &RequestPdu) -> Option<RequestPdu> {
    match pdu {
        RequestPdu::WriteRegister { address, value } => Some(RequestPdu::WriteRegisters {
            start: *address,
            values: vec![*value],
        }),
        RequestPdu::WriteCoil { address, on } => Some(RequestPdu::WriteCoils {
            start: *address,
            bits: vec![*on],
        }),
        RequestPdu::WriteRegisters { start, values } => match values.as_slice() {
            [value] => Some(RequestPdu::WriteRegister {
                address: *start,
                value: *value,
            }),
            _ => None,
        },
        RequestPdu::WriteCoils { start, bits } => match bits.as_slice() {
            [on] => Some(RequestPdu::WriteCoil {
                address: *start,
                on: *on,
            }),
            _ => None,
        },
        _ => None,
    }
}
