//! The meaning of a tool's frame: a read, a write, or a request that may write. Pure.

use drivegate_proto::n2::{self, Command};
use drivegate_proto::{Exception, Protocol, RequestPdu, ascii, rtu};

/// Diagnostics (function 8) that only read: the echo, the diagnostic register and the counters. The other
/// subfunctions restart or silence the drive, or clear its counters.
const READING_DIAGNOSTICS: [u16; 10] = [0, 2, 11, 12, 13, 14, 15, 16, 17, 18];

/// A valid frame of a tool.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct ToolRequest {
    /// Address of the receiver; 0 is the broadcast, except on N2.
    pub(super) address: u8,
    /// The function code; 0 on N2.
    pub(super) function: u8,
    pub(super) meaning: Meaning,
}

/// The meaning of a request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Meaning {
    /// A read and nothing else.
    Read(RequestPdu),
    /// Writes registers, coils or an object.
    Write(RequestPdu),
    /// May write, and cannot be checked.
    Unchecked(RequestPdu),
    /// A request that no drive could carry out, with the refusal for it.
    Faulty(Refused),
}

/// Why a request of a tool is refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Refused {
    /// The request is answered with a Modbus exception.
    Exception(Exception),
    /// The request is answered with an N2 error code.
    Nak(u8),
}

impl ToolRequest {
    /// The request in a complete frame on a Modbus line whose addresses end at `highest`, or on an N2 line; `None` if the
    /// frame is invalid. An invalid frame is not answered.
    pub(super) fn of(protocol: Protocol, frame: &[u8], highest: u8) -> Option<ToolRequest> {
        let (address, pdu) = match protocol {
            Protocol::ModbusRtu => rtu::open_frame(frame).map(|(address, pdu)| (address, pdu.to_vec()))?,
            Protocol::ModbusAscii => ascii::open_frame(frame)?,
            Protocol::N2 => return of_n2(frame),
        };
        let function = *pdu.first()?;
        let sound = address <= highest && (1..0x80).contains(&function);
        sound.then(|| ToolRequest {
            address,
            function,
            meaning: meaning(pdu),
        })
    }

    /// Whether the request is a broadcast, which is not answered.
    pub(super) fn is_broadcast(&self, protocol: Protocol) -> bool {
        self.address == 0 && protocol != Protocol::N2
    }

    /// The frame that refuses the request.
    pub(super) fn refusal(&self, protocol: Protocol, why: Refused) -> Vec<u8> {
        let mut frame = Vec::with_capacity(12);
        match why {
            Refused::Nak(code) => n2::Answer::Nak(code).encode(&mut frame),
            Refused::Exception(code) if protocol == Protocol::N2 => nak(code).encode(&mut frame),
            Refused::Exception(code) => {
                let pdu = [self.function | 0x80, code.code()];
                protocol.encode_frame(self.address, &pdu, &mut frame);
            }
        }
        frame
    }
}

/// The N2 error code that corresponds to the exception for a Modbus client.
fn nak(code: Exception) -> n2::Answer {
    n2::Answer::Nak(match code {
        Exception::VALUE => n2::command::DATA,
        _ => n2::command::TYPE,
    })
}

fn meaning(pdu: Vec<u8>) -> Meaning {
    use RequestPdu::{
        DeviceIdentification, Diagnostics, MaskWrite, Read, ReadWrite, WriteCoil, WriteCoils, WriteRegister,
        WriteRegisters,
    };
    let known = pdu.first().is_some_and(|function| rtu::is_known(*function));
    match RequestPdu::decode(&pdu) {
        Ok(pdu @ (Read { .. } | DeviceIdentification { .. })) => Meaning::Read(pdu),
        Ok(pdu @ Diagnostics { subfunction, .. }) if READING_DIAGNOSTICS.contains(&subfunction) => Meaning::Read(pdu),
        Ok(pdu @ (WriteCoil { .. } | WriteRegister { .. } | WriteCoils { .. } | WriteRegisters { .. })) => {
            Meaning::Write(pdu)
        }
        // The values that these functions write depend on the drive, or go with a read, so no limit could be
        // checked. No supported family has these functions.
        Ok(MaskWrite { .. } | ReadWrite { .. }) => Meaning::Faulty(Refused::Exception(Exception::FUNCTION)),
        Ok(pdu) => Meaning::Unchecked(pdu),
        // The only known part of function 43 is the device identification.
        Err(code) if known && !matches!(pdu.as_slice(), [43, mei, ..] if *mei != 14) => {
            Meaning::Faulty(Refused::Exception(code))
        }
        Err(_) => Meaning::Unchecked(RequestPdu::Other(pdu)),
    }
}

fn of_n2(frame: &[u8]) -> Option<ToolRequest> {
    let (address, heard) = Command::decode(frame)?;
    let command = match heard {
        Ok(command) => command,
        // A drive does not answer a damaged request, and the tool repeats it.
        Err(n2::command::CHECKSUM) => return None,
        Err(code) => return Some(n2_request(address, Meaning::Faulty(Refused::Nak(code)))),
    };
    // The digits between the address and the checksum.
    let lead = frame.iter().rposition(|byte| *byte == b'>')?;
    let digits = frame.get(lead + 3..frame.len().checked_sub(3)?)?.to_vec();
    let pdu = n2::pdu_of(&command);
    let meaning = match (&command, pdu) {
        (Command::Identify | Command::Poll { .. } | Command::Read { .. }, Some(pdu)) => Meaning::Read(pdu),
        (Command::Read { .. } | Command::Status | Command::ReadMemory, None) => {
            Meaning::Read(RequestPdu::Other(digits))
        }
        (Command::Override { .. }, Some(pdu)) => Meaning::Write(pdu),
        _ => Meaning::Unchecked(RequestPdu::Other(digits)),
    };
    Some(n2_request(address, meaning))
}

fn n2_request(address: u8, meaning: Meaning) -> ToolRequest {
    ToolRequest {
        address,
        function: 0,
        meaning,
    }
}
