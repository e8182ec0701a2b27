//! Options of a simulated TECO 7300PA.

use super::super::model::ReadOnly;
use super::super::motor::Load;
use std::time::Duration;

/// The mode of the drive's operator.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mode {
    /// PRGM: parameters may be written, the drive does not run.
    Program,
    /// DRIVE: the drive is ready; Sn, Cn and On are not written.
    Drive,
}

/// How a register stores the four digits of an Sn value such as 1100, which the manual does not state
/// (reference/drives.md 5.8).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Digits {
    /// The digits are bits of a number, the first digit the most significant: 1100 is 0x000C.
    Bits,
    /// The digits are a decimal number: 1100 is 1100.
    Decimal,
    /// The digits are hexadecimal: 1100 is 0x1100.
    Hexadecimal,
}

impl Digits {
    /// Value that a 1 in each digit adds to the register, from the last digit to the first.
    fn weights(self) -> [u16; 4] {
        match self {
            Digits::Bits => [1, 2, 4, 8],
            Digits::Decimal => [1, 10, 100, 1000],
            Digits::Hexadecimal => [1, 0x10, 0x100, 0x1000],
        }
    }

    /// The register for four digits, the first first.
    pub fn register(self, digits: [bool; 4]) -> u16 {
        let weights = self.weights().into_iter().rev();
        weights
            .zip(digits)
            .filter(|(_, on)| *on)
            .map(|(weight, _)| weight)
            .sum()
    }

    /// Whether a digit of a register is other than 0; 0 is the last one.
    pub fn is_set(self, register: u16, from_last: usize) -> bool {
        let radix = match self {
            Digits::Bits => 2,
            Digits::Decimal => 10,
            Digits::Hexadecimal => 16,
        };
        let weight = self.weights().get(from_last).copied().unwrap_or(u16::MAX);
        !(register / weight).is_multiple_of(radix)
    }
}

/// The levels of frequency detection 1 and 2, bits 4 and 5 of 002CH (reference/drives.md 9.10).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DetectionLevels {
    /// Cn-21 for both, as the bits are explained.
    Cn21,
    /// Cn-32 and Cn-33, as the parameters are named.
    Cn32AndCn33,
}

/// Options of a simulated TECO 7300PA.
#[derive(Debug, Clone)]
pub struct TecoOptions {
    /// Load of the motor and mains.
    pub load: Load,
    /// Mode of the operator panel after power-on.
    pub mode: Mode,
    /// How Sn-08 and Sn-24 store their digits.
    pub digits: Digits,
    /// The levels of frequency detection.
    pub detection_levels: DetectionLevels,
    /// Reaction to writes to monitor registers.
    pub read_only: ReadOnly,
    /// Registers of parameters that cannot be written over the bus (error 21H). The manual mentions them without a list.
    pub locked: Vec<u16>,
    /// Initial parameters in the EEPROM: register and value; those that a drive does not have or does not allow are
    /// skipped.
    pub parameters: Vec<(u16, u16)>,
    /// Time between a message and its answer; `None` uses the turnaround of the line.
    pub turnaround: Option<Duration>,
    /// Whether a request with a wrong check code is answered by error 00H. The manual's error table has that code; the
    /// text next to it, and everything else about messages, describes no answer (reference/drives.md 9.8).
    pub answer_check_error: bool,
    /// Makes 09FFH a register of the simulator: writing a fault mask as in 0021H trips the drive. No real drive has
    /// this register.
    pub trip_register: bool,
}

impl TecoOptions {
    /// Address of the simulator's own trip register.
    pub const TRIP_ADDRESS: u16 = 0x09FF;
    /// Time between a message and its answer (reference/drives.md 5.1).
    pub const TURNAROUND: Duration = Duration::from_millis(15);
}

impl Default for TecoOptions {
    fn default() -> Self {
        TecoOptions {
            load: Load {
                mains: 440.0,
                ..Load::default()
            },
            mode: Mode::Drive,
            digits: Digits::Bits,
            detection_levels: DetectionLevels::Cn21,
            read_only: ReadOnly::Exception,
            locked: Vec::new(),
            parameters: Vec::new(),
            turnaround: Some(TecoOptions::TURNAROUND),
            answer_check_error: false,
            trip_register: false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codings_of_1100() {
        let digits = [true, true, false, false];
        for (coding, register) in [
            (Digits::Bits, 0x000C),
            (Digits::Decimal, 1100),
            (Digits::Hexadecimal, 0x1100),
        ] {
            assert_eq!(coding.register(digits), register);
            let set: Vec<bool> = (0..4).map(|digit| coding.is_set(register, digit)).collect();
            assert_eq!(set, [false, false, true, true]);
        }
        assert!(!Digits::Bits.is_set(u16::MAX, 9) || Digits::Bits.is_set(u16::MAX, 0));
    }
}
