//! The effect of every word, worked out by hand from the figures of the manuals, compared with the profiles.

use drivegate_model::drive::control::ControlItem;
use drivegate_model::drive::profile::Profiles;
use drivegate_proto::Table;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Does {
    Runs,
    Stops,
    /// The word does nothing, does something else, or its effect is unknown.
    Other,
}

use Does::{Other, Runs, Stops};

fn is(word: u16, mask: u16) -> bool {
    word & mask == mask
}

fn any(word: u16, mask: u16) -> bool {
    word & mask != 0
}

/// Off without bit 0, 1 or 2 (OFF1 to OFF3), inhibited without bit 3; bits 8 and 9 jog while bit 0 is off.
fn off_words(word: u16) -> Does {
    match word {
        _ if !is(word, 0x0006) => Stops,
        _ if !is(word, 0x0001) && any(word, 0x0300) => Other,
        _ if !is(word, 0x000F) => Stops,
        _ if is(word, 0x047F) && !any(word, 0x0300) => Runs,
        _ => Other,
    }
}

/// ABB: without bit 10 only OFF1, OFF2 and OFF3 have an effect.
fn abb(word: u16) -> Does {
    match off_words(word) {
        Stops if !is(word, 0x0400) && is(word, 0x0007) => Other,
        does => does,
    }
}

/// Whether OFF counts without bit 10 is not known.
fn profidrive(word: u16) -> Does {
    if is(word, 0x0400) { off_words(word) } else { Other }
}

fn danfoss(word: u16) -> Does {
    match word {
        // Either the data is not valid, or the word is a jog.
        _ if !is(word, 0x0400) || any(word, 0x0100) => Other,
        // The word means DC brake, coast or quick stop.
        _ if !is(word, 0x001C) => Stops,
        // The word freezes the output.
        _ if !is(word, 0x0020) => Other,
        _ if is(word, 0x0040) => Runs,
        _ => Stops,
    }
}

fn cia402(word: u16) -> Does {
    match word & 0xF7FF {
        0x000F => Runs,
        _ if !is(word, 0x000F) => Stops,
        _ => Other,
    }
}

/// Exactly one of the two bits runs the motor; the reset bit is ignored, and any other bit belongs to another function.
fn pair(word: u16, forward: u16, reverse: u16, reset: u16) -> Does {
    match word & !reset {
        word if word == forward || word == reverse => Runs,
        0 => Stops,
        _ => Other,
    }
}

fn yaskawa(word: u16) -> Does {
    pair(word, 1, 2, 0x0008)
}

fn mitsubishi(word: u16) -> Does {
    pair(word, 2, 4, 0)
}

fn fuji(word: u16) -> Does {
    pair(word, 1, 2, 0x8000)
}

fn delta(word: u16) -> Does {
    match (word & 3, word) {
        (1, _) => Stops,
        (_, 0x12 | 0x22) => Runs,
        _ => Other,
    }
}

fn invt(word: u16) -> Does {
    match word {
        1 | 2 => Runs,
        5 | 6 => Stops,
        _ => Other,
    }
}

/// Bit 3 coasts, bit 1 is the fast stop; bit 0 counts last.
fn invertek(word: u16) -> Does {
    match word {
        _ if any(word, 0x000A) || !is(word, 0x0001) => Stops,
        _ if any(word, 0xFFF0) => Other,
        _ => Runs,
    }
}

fn weg(word: u16) -> Does {
    match word {
        // Either the panel commands, or the word is a jog.
        _ if !is(word, 0x0010) || any(word, 0x0008) => Other,
        _ if !is(word, 0x0003) || any(word, 0x0040) => Stops,
        _ => Runs,
    }
}

fn toshiba(word: u16) -> Does {
    match word {
        // Command from elsewhere; a jog and preset speeds.
        _ if !is(word, 0x8000) || any(word, 0x01FF) => Other,
        _ if any(word, 0x1800) || !is(word, 0x0400) => Stops,
        _ => Runs,
    }
}

fn ls(word: u16) -> Does {
    match word & 7 {
        _ if any(word, 0x0010) => Stops,
        1 => Stops,
        2 | 4 if !any(word, 0xFFF8) => Runs,
        _ => Other,
    }
}

fn teco(word: u16) -> Does {
    match word & !0x0008 {
        1 | 3 => Runs,
        0 | 2 => Stops,
        _ => Other,
    }
}

fn vacon(word: u16) -> Does {
    if is(word, 1) { Runs } else { Stops }
}

/// A word that a profile treats as a stop stops the motor, whatever else it contains; a word that it passes as a
/// run command runs the motor. The gateway itself sends a word of each kind.
#[test]
fn every_word_is_taken_for_what_it_does() {
    type Word = fn(u16) -> Does;
    let families: [(&str, Word); 17] = [
        ("abb-acs550", abb),
        ("abb-acs580", abb),
        ("danfoss-fc", danfoss),
        ("siemens-v20", profidrive),
        ("siemens-g120", profidrive),
        ("schneider-altivar", cia402),
        ("yaskawa-v1000", yaskawa),
        ("delta-ms300", delta),
        ("invt-goodrive", invt),
        ("mitsubishi-d700", mitsubishi),
        ("invertek-optidrive", invertek),
        ("weg-cfw", weg),
        ("fuji-frenic", fuji),
        ("toshiba-vf-s15", toshiba),
        ("ls-g100", ls),
        ("teco-f510", teco),
        ("vacon-10", vacon),
    ];
    let profiles = Profiles::built_in();
    for (name, does) in families {
        let profile = profiles.get(name).unwrap();
        let control = profile.control.as_ref().unwrap();
        let at = control.at;
        let (mut stops, mut runs) = (0, 0);
        for word in 0..=u16::MAX {
            let (is_stop, passes) = (control.is_stop(at, word), control.admits(at, word));
            assert_eq!(profile.is_stop(at.table, at.address, word), is_stop);
            assert!(!is_stop || does(word) == Stops, "{name}: {word:#06x} is said to stop");
            assert!(
                !passes || is_stop || does(word) == Runs,
                "{name}: {word:#06x} is said to run"
            );
            assert!(
                !(passes && is_stop && control.is_run(at, word)),
                "{name}: {word:#06x} is both"
            );
            stops += u32::from(is_stop);
            runs += u32::from(passes && !is_stop);
            let stop = control.stop_word(word);
            assert!(
                control.is_stop(at, stop) && does(stop) == Stops,
                "{name}: {stop:#06x} after {word:#06x}"
            );
            assert!(control.always.holds(stop), "{name}: {stop:#06x}");
        }
        assert!(stops > 0 && runs > 0, "{name}: {stops} stops, {runs} run commands");
    }
    // Hitachi is commanded by coils.
    let hitachi = profiles.get("hitachi-wj200").unwrap();
    let coil = |address| ControlItem {
        table: Table::Coil,
        address,
    };
    let control = hitachi.control.as_ref().unwrap();
    assert!(control.is_stop(coil(0), 0) && !control.is_stop(coil(0), 1) && control.is_run(coil(0), 1));
    for (address, word) in [(1, 0), (1, 1), (3, 0), (3, 1)] {
        assert!(!control.is_stop(coil(address), word) && !control.is_run(coil(address), word));
        assert!(control.admits(coil(address), word));
    }
}
