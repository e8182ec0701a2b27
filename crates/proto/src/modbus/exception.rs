//! Exception codes: those of Modbus, those of one family, and those that represent N2 errors.

use std::fmt;

/// The code with which a device refuses a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Exception {
    /// An exception code of Modbus; makers use codes of their own up to 0xFF.
    Modbus(u8),
    /// An error code of N2, two printed digits that are read as hexadecimal.
    N2(u8),
}

impl Exception {
    /// 01: the function is not known or not allowed.
    pub const FUNCTION: Exception = Exception::Modbus(0x01);
    /// 02: the address is not known or not allowed.
    pub const ADDRESS: Exception = Exception::Modbus(0x02);
    /// 03: the value or the count is not allowed.
    pub const VALUE: Exception = Exception::Modbus(0x03);
    /// 04: the device failed.
    pub const DEVICE_FAILURE: Exception = Exception::Modbus(0x04);
    /// 05: the device has accepted the request and is still processing it.
    pub const ACKNOWLEDGE: Exception = Exception::Modbus(0x05);
    /// 06: the device is busy.
    pub const BUSY: Exception = Exception::Modbus(0x06);
    /// 0x0A: the gateway has no path to this unit.
    pub const GATEWAY_PATH: Exception = Exception::Modbus(0x0A);
    /// 0x0B: the device behind the gateway does not reply.
    pub const GATEWAY_TARGET: Exception = Exception::Modbus(0x0B);

    /// N2 error 00: the drive has restarted and waits for Identify.
    pub const N2_RESTARTED: Exception = Exception::N2(0x00);

    /// The code in one byte, for Modbus clients and metrics: an error of N2 has bit 7 set.
    pub fn code(self) -> u8 {
        match self {
            Exception::Modbus(code) => code,
            Exception::N2(code) => 0x80 | code,
        }
    }

    /// The N2 error code; `None` for a code of Modbus.
    pub fn n2_code(self) -> Option<u8> {
        match self {
            Exception::Modbus(_) => None,
            Exception::N2(code) => Some(code),
        }
    }

    /// Whether the repeated request would be refused again, because function, address or value are the reason and
    /// not the state of the drive.
    pub fn is_about_request(self) -> bool {
        match self {
            Exception::Modbus(code) => matches!(code, 0x01..=0x03 | 0x21),
            Exception::N2(code) => matches!(code, 0x01 | 0x05 | 0x10..=0x12),
        }
    }

    /// Whether the drive cannot process the request now but may do so later.
    pub fn is_busy(self) -> bool {
        self == Exception::BUSY
    }

    /// Whether a gateway sends the exception because it cannot reach the drive: the drive itself sent no answer.
    pub fn is_no_answer(self) -> bool {
        matches!(self, Exception::GATEWAY_PATH | Exception::GATEWAY_TARGET)
    }

    /// Whether the exception leaves the result of a write unknown: the drive is still processing it, or did not answer.
    pub fn leaves_open(self) -> bool {
        self == Exception::ACKNOWLEDGE || self.is_no_answer()
    }

    /// Meaning of the code according to the Modbus specification and the TECO list (reference/drives.md 5.6).
    pub fn meaning(self) -> &'static str {
        match self {
            Exception::Modbus(0x01) => "illegal function",
            Exception::Modbus(0x02) => "illegal data address",
            Exception::Modbus(0x03) => "illegal data value",
            Exception::Modbus(0x04) => "device failure",
            Exception::Modbus(0x05) => "acknowledge, still working",
            Exception::Modbus(0x06) => "device busy",
            Exception::Modbus(0x08) => "memory parity error",
            Exception::Modbus(0x0A) => "gateway path unavailable",
            Exception::Modbus(0x0B) => "device behind the gateway does not reply",
            Exception::Modbus(0x21) => "data value error (TECO)",
            Exception::Modbus(0x22) => "register write error: only in PRGM mode (TECO, assumed)",
            Exception::N2(0x00) => "the drive has restarted and waits for Identify",
            Exception::N2(0x01) => "command not understood",
            Exception::N2(0x02) => "checksum error",
            Exception::N2(0x03) => "message too long",
            Exception::N2(0x05) => "field size wrong for the command",
            Exception::N2(0x10) => "invalid data, out of the expected range",
            Exception::N2(0x11) => "invalid command for the data type, or only in PRGM mode (TECO, assumed)",
            Exception::N2(0x12) => "the value is read-only",
            Exception::Modbus(_) | Exception::N2(_) => "unknown exception",
        }
    }
}

impl fmt::Display for Exception {
    /// The code as the manuals print it: Modbus codes with two digits, those of a family in hexadecimal with H
    /// (TECO: 22H), N2 errors with their own two digits.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let meaning = self.meaning();
        match self {
            Exception::N2(code) => write!(f, "N2 error {code:02X} ({meaning})"),
            Exception::Modbus(code @ 0x10..) => write!(f, "exception {code:02X}H ({meaning})"),
            Exception::Modbus(code) => write!(f, "exception {code:02X} ({meaning})"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_are_printed_as_in_the_manuals() {
        for (code, wanted) in [
            (Exception::ADDRESS, "exception 02 (illegal data address)"),
            (
                Exception::GATEWAY_TARGET,
                "exception 0B (device behind the gateway does not reply)",
            ),
            (
                Exception::Modbus(0x22),
                "exception 22H (register write error: only in PRGM mode (TECO, assumed))",
            ),
            (Exception::Modbus(0x33), "exception 33H (unknown exception)"),
            (Exception::Modbus(0x80), "exception 80H (unknown exception)"),
            (Exception::N2(0x05), "N2 error 05 (field size wrong for the command)"),
            (
                Exception::N2(0x11),
                "N2 error 11 (invalid command for the data type, or only in PRGM mode (TECO, assumed))",
            ),
            (
                Exception::N2_RESTARTED,
                "N2 error 00 (the drive has restarted and waits for Identify)",
            ),
        ] {
            assert_eq!(code.to_string(), wanted);
        }
    }
}
