//! How the families react to the words written to them, written by hand from their manuals without using the profiles.

use super::status::{self, Shows, Words};
use drivegate_proto::Table;

/// Effect of a word on the motor and the start sequence.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum MotorEffect {
    /// The word changes nothing.
    Nothing,
    /// The drive has reached this position in its start sequence; the motor is not powered.
    Prepares(usize),
    Runs {
        /// Whether the motor runs in reverse, without regard to the sign of the reference.
        reverse: bool,
    },
    /// The drive ramps the motor down; its start sequence starts again.
    Stops,
    /// The drive lets the motor coast; its start sequence starts again.
    Coasts,
    /// The word causes an external fault.
    Trips,
}

/// All effects of a control word.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct WordEffect {
    pub(super) does: MotorEffect,
    /// Whether the word resets a fault, before anything else.
    pub(super) resets: bool,
    /// The word that is in force from now on.
    pub(super) word: u16,
}

/// State of the drive that determines the effect of a word.
#[derive(Clone, Copy)]
pub(super) struct KnownState<'d> {
    /// The word that was in force before.
    pub(super) before: u16,
    /// How many words of the start sequence the drive has received.
    pub(super) position: usize,
    pub(super) faulted: bool,
    /// Whether reverse was last commanded.
    pub(super) reverse: bool,
    /// Function that reads registers at other addresses.
    pub(super) at: &'d dyn Fn(Table, u16) -> u16,
}

/// A family with hand-written words.
#[derive(Debug, Clone, Copy)]
pub(super) struct Family {
    /// Name of the profile.
    pub(super) name: &'static str,
    /// Effect of the control word.
    pub(super) word: fn(&KnownState<'_>, u16) -> WordEffect,
    /// Effect of another register or coil.
    pub(super) other: fn(Table, u16, u16) -> Option<WordEffect>,
    /// Whether words act once, when they are written, and do not stay as a command.
    pub(super) acts_once: bool,
    /// A reset while a run command is in effect starts the motor.
    pub(super) restarts_on_reset: bool,
    /// The status words of the family with all their bits.
    pub(super) status: fn(&Shows) -> Words,
}

const fn family(
    name: &'static str,
    word: fn(&KnownState<'_>, u16) -> WordEffect,
    status: fn(&Shows) -> Words,
) -> Family {
    Family {
        name,
        word,
        other: |_, _, _| None,
        acts_once: false,
        restarts_on_reset: false,
        status,
    }
}

pub(super) const FAMILIES: [Family; 16] = [
    family("abb", abb, status::abb),
    family("profidrive", profidrive, status::profidrive),
    family("danfoss", danfoss, status::danfoss),
    family("cia402", cia402, status::cia402),
    family("yaskawa", yaskawa, status::yaskawa),
    Family {
        other: delta_reset,
        acts_once: true,
        ..family("delta", delta, status::delta)
    },
    Family {
        acts_once: true,
        ..family("invt", invt, status::invt)
    },
    Family {
        other: mitsubishi_restart,
        ..family("mitsubishi", mitsubishi, status::mitsubishi)
    },
    family("invertek", invertek, status::invertek),
    family("weg", weg, status::weg),
    Family {
        other: fuji_reset,
        restarts_on_reset: true,
        ..family("fuji", fuji, status::fuji)
    },
    family("toshiba", toshiba, status::toshiba),
    Family {
        acts_once: true,
        ..family("ls", ls, status::ls)
    },
    family("teco-f510", teco, status::teco),
    Family {
        restarts_on_reset: true,
        ..family("vacon-10", vacon, status::vacon)
    },
    // The states of a Hitachi are coils, each a separate point.
    Family {
        other: hitachi_coils,
        ..family("hitachi", hitachi, |_| Vec::new())
    },
];

pub(super) const fn is(word: u16, mask: u16) -> bool {
    word & mask == mask
}

const fn any(word: u16, mask: u16) -> bool {
    word & mask != 0
}

fn effect(does: MotorEffect, resets: bool, word: u16) -> WordEffect {
    WordEffect { does, resets, word }
}

fn rises(known: &KnownState<'_>, word: u16, bit: u16) -> bool {
    any(word & !known.before, bit)
}

fn runs(reverse: bool) -> MotorEffect {
    MotorEffect::Runs { reverse }
}

/// Two bits for two directions; both together are not a run command.
fn pair(bits: u16) -> MotorEffect {
    match bits {
        1 => runs(false),
        2 => runs(true),
        _ => MotorEffect::Stops,
    }
}

/// OFF1 to OFF3 are bits 0 to 2, also without bit 10, without which all else counts for nothing; a run command needs bits 0 to 6,
/// and bit 0 must have been off before.
fn off_words(known: &KnownState<'_>, word: u16, reverse: bool) -> WordEffect {
    let valid = is(word, 0x0400);
    let word = if valid { word } else { known.before & (word | !0x0007) };
    let does = match word {
        _ if !is(word, 0x0006) => MotorEffect::Coasts,
        _ if !is(word, 0x0001) => MotorEffect::Prepares(1),
        _ if !is(word, 0x0008) => MotorEffect::Coasts,
        _ if is(word, 0x007F) && known.position > 0 => runs(reverse),
        _ => MotorEffect::Nothing,
    };
    effect(does, rises(known, word, 0x0080), word)
}

fn abb(known: &KnownState<'_>, word: u16) -> WordEffect {
    off_words(known, word, false)
}

fn profidrive(known: &KnownState<'_>, word: u16) -> WordEffect {
    off_words(known, word, is(word, 0x0800))
}

/// Danfoss: without bit 10 a word is ignored; bits 2 to 5 at 0 brake, coast, stop quickly and freeze.
fn danfoss(known: &KnownState<'_>, word: u16) -> WordEffect {
    if !is(word, 0x0400) {
        return effect(MotorEffect::Nothing, false, known.before);
    }
    let does = match word {
        _ if !is(word, 0x0008) => MotorEffect::Coasts,
        _ if !is(word, 0x0054) => MotorEffect::Stops,
        // The word freezes the drive, or is a jog.
        _ if !is(word, 0x0020) || any(word, 0x0100) => MotorEffect::Nothing,
        _ => runs(is(word, 0x8000)),
    };
    effect(does, rises(known, word, 0x0080), word)
}

/// CiA 402: 6 is shutdown, 7 switch on, 15 enable operation, each accepted only from the previous state.
fn cia402(known: &KnownState<'_>, word: u16) -> WordEffect {
    let does = match word & 0x000F {
        _ if known.faulted => MotorEffect::Coasts,
        low if !is(low, 0x0002) => MotorEffect::Coasts,
        low if !is(low, 0x0004) => MotorEffect::Stops,
        0x06 | 0x0E => MotorEffect::Prepares(1),
        0x07 if known.position >= 1 => MotorEffect::Prepares(2),
        0x0F if known.position >= 2 => runs(is(word, 0x0800)),
        _ => MotorEffect::Nothing,
    };
    effect(does, rises(known, word, 0x0080), word)
}

/// Bit 2 is an external fault; a reset counts only without a run command.
fn yaskawa(known: &KnownState<'_>, word: u16) -> WordEffect {
    let does = if is(word, 0x0004) {
        MotorEffect::Trips
    } else {
        pair(word & 3)
    };
    effect(does, rises(known, word, 0x0008) && !any(word, 3), word)
}

/// Delta: bits 1 and 0 run (10) or stop (01), bits 5 and 4 set the direction; 0 does nothing.
fn delta(known: &KnownState<'_>, word: u16) -> WordEffect {
    let reverse = match word >> 4 & 3 {
        1 => false,
        2 => true,
        _ => known.reverse,
    };
    let does = match word & 3 {
        1 => MotorEffect::Stops,
        2 => runs(reverse),
        _ => MotorEffect::Nothing,
    };
    effect(does, false, word)
}

/// 0x2002: bit 0 external fault, bit 1 reset, bit 2 base block.
fn delta_reset(table: Table, address: u16, word: u16) -> Option<WordEffect> {
    let does = match word {
        _ if is(word, 1) => MotorEffect::Trips,
        _ if is(word, 4) => MotorEffect::Coasts,
        _ => MotorEffect::Nothing,
    };
    ((table, address) == (Table::Holding, 0x2002)).then(|| effect(does, is(word, 2), word))
}

/// The codes act when they are written; jogs are not simulated.
fn invt(_: &KnownState<'_>, word: u16) -> WordEffect {
    let does = match word {
        1 | 2 => pair(word),
        5 => MotorEffect::Stops,
        6 => MotorEffect::Coasts,
        _ => MotorEffect::Nothing,
    };
    effect(does, word == 7, word)
}

fn mitsubishi(_: &KnownState<'_>, word: u16) -> WordEffect {
    effect(pair(word >> 1 & 3), false, word)
}

/// A write to register 1 restarts the drive: the motor coasts, and the fault is cleared.
fn mitsubishi_restart(table: Table, address: u16, word: u16) -> Option<WordEffect> {
    ((table, address) == (Table::Holding, 1)).then(|| effect(MotorEffect::Coasts, true, word))
}

/// Bit 3 coasts, bit 1 stops by the second ramp; both go before bit 0.
fn invertek(known: &KnownState<'_>, word: u16) -> WordEffect {
    let does = match word {
        _ if is(word, 0x0008) => MotorEffect::Coasts,
        _ if is(word, 0x0002) => MotorEffect::Stops,
        _ if is(word, 0x0001) => runs(false),
        _ => MotorEffect::Stops,
    };
    effect(does, rises(known, word, 0x0004), word)
}

/// Bits 0 and 1 both, bit 2 forward; without bit 4 the panel commands.
fn weg(known: &KnownState<'_>, word: u16) -> WordEffect {
    let does = match word {
        _ if !is(word, 0x0010) => MotorEffect::Nothing,
        _ if !is(word, 0x0002) => MotorEffect::Coasts,
        _ if is(word, 0x0001) && !any(word, 0x0040) => runs(!is(word, 0x0004)),
        _ => MotorEffect::Stops,
    };
    effect(does, rises(known, word, 0x0080), word)
}

/// The rising edge of bit 15 resets the drive; a run command that is in effect then starts the motor.
fn fuji(known: &KnownState<'_>, word: u16) -> WordEffect {
    effect(pair(word & 3), rises(known, word, 0x8000), word)
}

/// S14: 1 resets.
fn fuji_reset(table: Table, address: u16, word: u16) -> Option<WordEffect> {
    ((table, address) == (Table::Holding, 0x070E)).then(|| effect(MotorEffect::Nothing, is(word, 1), word))
}

/// Bits 15 and 10 run; bit 9 reverse, bit 11 coasts, bit 12 emergency off, bit 13 resets.
fn toshiba(known: &KnownState<'_>, word: u16) -> WordEffect {
    let does = match word {
        _ if is(word, 0x1000) => MotorEffect::Trips,
        _ if !is(word, 0x8000) => MotorEffect::Nothing,
        _ if is(word, 0x0800) => MotorEffect::Coasts,
        _ if is(word, 0x0400) => runs(is(word, 0x0200)),
        _ => MotorEffect::Stops,
    };
    effect(does, rises(known, word, 0x2000), word)
}

/// Bit 0 stops, bits 1 and 2 run, bit 3 resets, bit 4 is the emergency stop; 0 does nothing.
fn ls(known: &KnownState<'_>, word: u16) -> WordEffect {
    let does = match word & 0x07 {
        _ if is(word, 0x0010) => MotorEffect::Coasts,
        1 => MotorEffect::Stops,
        2 => runs(false),
        4 => runs(true),
        _ => MotorEffect::Nothing,
    };
    effect(does, rises(known, word, 0x0008), word)
}

/// TECO: bit 2 of the word is an external fault.
fn teco(known: &KnownState<'_>, word: u16) -> WordEffect {
    let does = match word {
        _ if is(word, 0x0004) => MotorEffect::Trips,
        _ if is(word, 0x0001) => runs(is(word, 0x0002)),
        _ => MotorEffect::Stops,
    };
    effect(does, rises(known, word, 0x0008), word)
}

/// The run command that stands starts the motor after a reset.
fn vacon(known: &KnownState<'_>, word: u16) -> WordEffect {
    let does = if is(word, 1) {
        runs(is(word, 2))
    } else {
        MotorEffect::Stops
    };
    effect(does, rises(known, word, 0x0004), word)
}

/// Coil 0 runs, coil 1 = 1 is reverse.
fn hitachi(known: &KnownState<'_>, word: u16) -> WordEffect {
    let does = match word {
        0 => MotorEffect::Stops,
        _ => runs((known.at)(Table::Coil, 1) != 0),
    };
    effect(does, false, word)
}

/// Coil 2 is an external trip, coil 3 resets.
fn hitachi_coils(table: Table, address: u16, word: u16) -> Option<WordEffect> {
    match (table, address) {
        (Table::Coil, 2) if word != 0 => Some(effect(MotorEffect::Trips, false, word)),
        (Table::Coil, 3) => Some(effect(MotorEffect::Nothing, word != 0, word)),
        _ => None,
    }
}
