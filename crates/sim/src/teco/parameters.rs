//! Parameters of the simulated TECO 7300PA by register (reference/drives.md 5.8): which exist, and their images in RAM and EEPROM.
//!
//! Ranges are those of the N2 map (reference/drives.md 6.7), where it has them. Defaults that the manual does not
//! state are plausible values for a small 440 V drive.

use super::super::motor::Ratings;
use super::super::parameter_set::{Parameter, ParameterSet};
use super::super::random::Random;
use super::options::Digits;

/// A group of parameters.
struct Group {
    first: u16,
    last: u16,
    /// Written in PRGM mode only.
    program_only: bool,
    /// Registers of the group without a parameter.
    reserved: &'static [u16],
}

/// The groups Sn, Cn, On, An and Bn. Sn begins at xx01H, the others at xx00H.
const GROUPS: [Group; 5] = [
    Group {
        first: 0x0101,
        last: 0x0126,
        program_only: true,
        reserved: &[0x011C, 0x011D],
    },
    Group {
        first: 0x0200,
        last: 0x023E,
        program_only: true,
        reserved: &[0x021C, 0x0221, 0x0222, 0x0234, 0x0235, 0x0236, 0x0237, 0x0238, 0x023C],
    },
    Group {
        first: 0x0300,
        last: 0x0317,
        program_only: true,
        reserved: &[0x0303, 0x0304, 0x0305, 0x0309, 0x030C, 0x030D],
    },
    Group {
        first: 0x0400,
        last: 0x0408,
        program_only: false,
        reserved: &[],
    },
    Group {
        first: 0x0500,
        last: 0x0519,
        program_only: false,
        reserved: &[],
    },
];

/// Registers of On-20 to On-24, which are not saved.
const NOT_SAVED: std::ops::RangeInclusive<u16> = 0x0313..=0x0317;

pub(super) const SN_08: u16 = 0x0108;
/// Function of the multifunction reference 1; the functions of 2 to 4 follow.
pub(super) const SN_15: u16 = 0x010F;
/// Functions of the outputs R2A-R2C, DO1 and R1A-R1C.
pub(super) const SN_20: u16 = 0x0114;
const SN_24: u16 = 0x0118;
const CN_02: u16 = 0x0201;
const CN_03: u16 = 0x0202;
const CN_04: u16 = 0x0203;
const CN_09: u16 = 0x0208;
/// Upper bound of the frequency, % of Cn-02; the lower one follows.
pub(super) const CN_14: u16 = 0x020D;
pub(super) const CN_21: u16 = 0x0214;
pub(super) const CN_22: u16 = 0x0215;
pub(super) const CN_26: u16 = 0x0219;
pub(super) const CN_27: u16 = 0x021A;
pub(super) const CN_32: u16 = 0x021F;
pub(super) const CN_33: u16 = 0x0220;
/// Frequency command 1; the commands 2 to 8 follow.
pub(super) const AN_01: u16 = 0x0400;
/// Register of the jog frequency.
pub(super) const AN_09: u16 = 0x0408;
const BN_01: u16 = 0x0500;
const BN_02: u16 = 0x0501;

/// Functions of Sn-15 to Sn-18. The manual states the default functions but not their numbers.
pub(super) mod function {
    pub(in super::super) const STEP_1: u16 = 2;
    pub(in super::super) const STEP_2: u16 = 3;
    pub(in super::super) const JOG: u16 = 5;
    pub(in super::super) const BASEBLOCK: u16 = 7;
}

/// Parameters whose range or default is known or matters here: (register, minimum, maximum, default). All others
/// accept any value and start at 0.
const KNOWN: [(u16, u16, u16, u16); 44] = [
    (SN_15, 0, 15, function::STEP_1),
    (0x0110, 0, 15, function::STEP_2),
    (0x0111, 0, 15, function::JOG),
    (0x0112, 0, 15, function::BASEBLOCK),
    (0x0113, 0, 12, 0),
    (SN_20, 0, 15, 0),
    (0x0115, 0, 15, 1),
    (0x0116, 0, 15, 2),
    (0x0117, 1, 31, 1),
    (0x011A, 0, 10, 0),
    (0x011B, 0, 10, 1),
    (0x0200, 0, 7650, 4400),
    (CN_02, 10, 1800, 600),
    (CN_03, 1, 7650, 4400),
    (CN_04, 10, 1800, 600),
    (0x0204, 0, 1800, 30),
    (0x0205, 0, 7650, 300),
    (0x0206, 0, 1800, 15),
    (0x0207, 0, 7650, 200),
    (CN_09, 1, 30_000, 22),
    (CN_14, 0, 109, 100),
    (0x020E, 0, 109, 0),
    (0x020F, 0, 1800, 0),
    (0x0210, 0, 1800, 0),
    (0x0211, 0, 1800, 0),
    (0x0212, 0, 255, 10),
    (CN_21, 0, 1800, 0),
    (CN_22, 0, 255, 20),
    (CN_26, 30, 200, 160),
    (CN_27, 0, 255, 1),
    (0x021B, 30, 170, 170),
    (0x021D, 30, 170, 160),
    (0x021E, 0, 255, 10),
    (CN_32, 0, 1800, 0),
    (CN_33, 0, 1800, 0),
    (0x0223, 0, 10, 0),
    (AN_09, 0, 18_000, 600),
    (BN_01, 0, 60_000, 30),
    (BN_02, 0, 60_000, 30),
    (0x0502, 0, 60_000, 100),
    (0x0503, 0, 60_000, 100),
    (0x050C, 1, 1000, 100),
    (0x050D, 1, 1000, 100),
    (0x050E, 0, 1000, 100),
];

/// PID differential time, 0.01 s.
const BN_16: (u16, u16, u16, u16) = (0x050F, 0, 100, 0);

/// Pairs of upper and lower bounds according to their names: Cn-14 and Cn-15, Cn-23 and Cn-24, Cn-45 and Cn-47,
/// Cn-46 and Cn-48. No manual says that the drive refuses values that cross; this is assumed.
const LIMITS: [(u16, u16); 4] = [(CN_14, CN_14 + 1), (0x0216, 0x0217), (0x022C, 0x022E), (0x022D, 0x022F)];

/// cos phi of the motor, which no parameter holds.
const COS_PHI: f64 = 0.85;

/// Properties of a register of the parameters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct RegisterKind {
    /// Written in PRGM mode only.
    pub(super) program_only: bool,
    /// No parameter: reads as 0, a write is acknowledged and forgotten.
    pub(super) reserved: bool,
}

/// Properties of the register, if it belongs to a parameter.
pub(super) fn place(register: u16) -> Option<RegisterKind> {
    GROUPS
        .iter()
        .find(|group| (group.first..=group.last).contains(&register))
        .map(|group| RegisterKind {
            program_only: group.program_only,
            reserved: group.reserved.contains(&register),
        })
}

/// The parameters in RAM and EEPROM.
#[derive(Debug, Clone)]
pub(super) struct Parameters {
    pub(super) ram: ParameterSet,
    eeprom: ParameterSet,
}

impl Parameters {
    /// Creates RAM and EEPROM with equal values.
    pub(super) fn new(digits: Digits, set: &[(u16, u16)]) -> Parameters {
        let serial = digits.register([true, true, false, false]);
        let four = digits.register([true; 4]);
        // Sn-08 = 1100: run and reference from the serial link. Sn-24 = 1100: 19200 baud, no parity.
        let coded = [(SN_08, 0, four, serial), (SN_24, 0, four, serial)];
        let others = GROUPS
            .iter()
            .flat_map(|group| group.first..=group.last)
            .filter(|register| place(*register).is_some_and(|place| !place.reserved))
            .map(|register| (register, 0, u16::MAX, 0));
        let frequencies = (AN_01..AN_09).map(|register| (register, 0, 18_000, 0));
        // If several registers are equal, the first one is used.
        let all = coded
            .into_iter()
            .chain(KNOWN)
            .chain(frequencies)
            .chain([BN_16])
            .chain(others);
        let mut ram = ParameterSet::new(all).limited(LIMITS);
        for &(register, value) in set {
            let _ = ram.set(register, value);
        }
        Parameters {
            eeprom: ram.clone(),
            ram,
        }
    }

    /// The value in RAM; 0 for a reserved register.
    pub(super) fn number(&self, register: u16) -> u16 {
        self.ram.number(register)
    }

    /// A parameter stored in tenths, as a number.
    pub(super) fn tenths(&self, register: u16) -> f64 {
        f64::from(self.number(register)) / 10.0
    }

    /// Copies RAM to EEPROM, except On-20 to On-24.
    pub(super) fn save(&mut self) {
        self.copy();
        let keys: Vec<u16> = self.ram.iter().map(|parameter| parameter.key).collect();
        for key in keys.into_iter().filter(|key| !NOT_SAVED.contains(key)) {
            self.ram.record_kept(key);
        }
    }

    fn copy(&mut self) {
        let not_saved: Vec<Parameter> = self
            .eeprom
            .iter()
            .filter(|p| NOT_SAVED.contains(&p.key))
            .copied()
            .collect();
        self.eeprom.take_values(&self.ram);
        for Parameter { key, value, .. } in not_saved {
            let _ = self.eeprom.set(key, value);
        }
    }

    /// Simulates a power cycle: RAM takes the values of the EEPROM.
    pub(super) fn reload(&mut self) {
        self.ram.take_values(&self.eeprom);
    }

    /// Random values for all, but that the source of commands stays; in EEPROM, too.
    pub(super) fn fill(&mut self, random: &mut Random) {
        self.ram.fill(random, &[SN_08]);
        self.copy();
    }

    /// Ratings of the motor and its ramps, from the parameters.
    pub(super) fn ratings(&self) -> Ratings {
        let frequency = self.tenths(CN_04);
        Ratings {
            maximum: self.tenths(CN_02),
            acceleration: self.tenths(BN_01),
            deceleration: self.tenths(BN_02),
            voltage: self.tenths(CN_03),
            frequency,
            // A motor with four poles and no slip is assumed, because no parameter contains a speed.
            speed: 30.0 * frequency,
            current: self.tenths(CN_09),
            cos_phi: COS_PHI,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_rows_of_the_manual_and_no_other() {
        let rows: usize = GROUPS
            .iter()
            .map(|group| usize::from(group.last - group.first) + 1)
            .sum();
        assert_eq!(rows, 160, "as reference/drives.md 5.8 lists them");
        assert!(
            KNOWN
                .iter()
                .all(|known| place(known.0).is_some_and(|place| !place.reserved))
        );
        for register in [0x0100, 0x0127, 0x023F, 0x02FF, 0x0318, 0x0409, 0x051A, 0x0000, 0x0900] {
            assert_eq!(place(register), None, "{register:04X}");
        }
        let parameters = Parameters::new(Digits::Bits, &[]);
        assert_eq!(parameters.ram.iter().count(), 160 - 17, "17 are reserved");
        assert!(parameters.ram.iter().all(|p| p.min <= p.value && p.value <= p.max));
        assert_eq!(parameters.number(SN_08), 0x000C);
    }
}
