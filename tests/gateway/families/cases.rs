//! What each family is told, by hand from the figures of its manual.

/// A write to the unit of the drive.
#[derive(Debug)]
pub(super) enum Order {
    /// One register, by function 06.
    Word(u16, u16),
    /// Two registers, by function 16.
    Pair(u16, u16, u16),
    /// One coil, by function 05.
    Coil(u16, bool),
    /// The common model's command word, and the register and word that the drive gets for it.
    Model(u16, u16, u16),
}

impl Order {
    pub(super) fn pdu(&self) -> Vec<u8> {
        let words = |words: &[u16]| words.iter().flat_map(|word| word.to_be_bytes()).collect::<Vec<u8>>();
        match *self {
            Order::Word(address, word) => [vec![6], words(&[address, word])].concat(),
            Order::Pair(address, high, low) => [vec![16], words(&[address, 2]), vec![4], words(&[high, low])].concat(),
            Order::Coil(address, on) => [vec![5], words(&[address, if on { 0xFF00 } else { 0 }])].concat(),
            Order::Model(word, ..) => [vec![6], words(&[0x8100, word])].concat(),
        }
    }

    /// As the drive prints it.
    pub(super) fn as_seen(&self) -> String {
        match *self {
            Order::Word(address, word) | Order::Model(_, address, word) => {
                format!("wrote holding {address:04X} {word:04X}\n")
            }
            Order::Pair(address, high, low) => {
                let (next, high) = (address + 1, format!("wrote holding {address:04X} {high:04X}\n"));
                format!("{high}wrote holding {next:04X} {low:04X}\n")
            }
            Order::Coil(address, on) => format!("wrote coil {address:04X} {:04X}\n", u16::from(on)),
        }
    }
}

pub(super) struct Case {
    pub(super) profile: &'static str,
    /// The module of the drive in `tests/peers/families`.
    pub(super) peer: &'static str,
    pub(super) reference: &'static [Order],
    pub(super) start: &'static [Order],
    pub(super) stop: &'static [Order],
    pub(super) reverse: &'static [Order],
    /// Empty where the family's reset is not known.
    pub(super) reset: &'static [Order],
    /// Not passed on: neither a stop nor clearly a run command.
    pub(super) refused: &'static [Order],
    pub(super) shows_frequency: bool,
    pub(super) shows_reversed: bool,
}

impl Case {
    /// Whether the family is started by a sequence of words that the drive confirms.
    pub(super) fn has_sequence(&self) -> bool {
        ["abb", "cia402", "siemens"].contains(&self.peer)
    }
}

use Order::{Coil, Model, Pair, Word};

/// Half the maximum forward: 10000 of 20000, 0x2000 of 0x4000, 25 Hz of 50 Hz.
pub(super) const CASES: &[Case] = &[
    Case {
        profile: "abb-acs550",
        peer: "abb",
        reference: &[Word(1, 10_000)],
        start: &[Word(0, 0x047E), Word(0, 0x047F)],
        stop: &[Word(0, 0x047E)],
        reverse: &[Word(1, 0xD8F0), Word(0, 0x047F)],
        reset: &[Word(0, 0x047E), Word(0, 0x04FE), Word(0, 0x047E)],
        refused: &[Word(0, 0x007F), Word(0, 0x0477), Word(0, 0x047D), Word(0, 0x057E)],
        shows_frequency: true,
        shows_reversed: false,
    },
    Case {
        profile: "abb-acs580",
        peer: "abb",
        reference: &[Word(1, 10_000)],
        start: &[Word(0, 0x047E), Word(0, 0x047F)],
        stop: &[Word(0, 0x047E)],
        reverse: &[Word(1, 0xD8F0), Word(0, 0x047F)],
        reset: &[Word(0, 0x047E), Word(0, 0x04FE), Word(0, 0x047E)],
        refused: &[Word(0, 0x0001), Word(0, 0x0477)],
        shows_frequency: false,
        shows_reversed: false,
    },
    Case {
        profile: "danfoss-fc",
        peer: "danfoss",
        reference: &[Word(50_009, 0x2000)],
        start: &[Word(49_999, 0x047C)],
        stop: &[Word(49_999, 0x043C)],
        reverse: &[Word(49_999, 0x847C)],
        reset: &[Word(49_999, 0x043C), Word(49_999, 0x04BC), Word(49_999, 0x043C)],
        refused: &[
            Word(49_999, 0x007C),
            Word(49_999, 0x003C),
            Word(49_999, 0x041C),
            Word(49_999, 0x053C),
        ],
        shows_frequency: true,
        shows_reversed: false,
    },
    Case {
        profile: "siemens-v20",
        peer: "siemens",
        reference: &[Word(100, 0x2000)],
        start: &[Word(99, 0x047E), Word(99, 0x047F)],
        stop: &[Word(99, 0x047E)],
        reverse: &[Word(99, 0x0C7F)],
        reset: &[Word(99, 0x047E), Word(99, 0x04FE), Word(99, 0x047E)],
        refused: &[Word(99, 0x007F), Word(99, 0x007E), Word(99, 0x057E), Word(99, 0x047D)],
        shows_frequency: true,
        shows_reversed: false,
    },
    Case {
        profile: "siemens-g120",
        peer: "siemens",
        reference: &[Word(100, 0x2000)],
        start: &[Word(99, 0x047E), Word(99, 0x047F)],
        stop: &[Word(99, 0x047E)],
        reverse: &[Word(100, 0xE000), Word(99, 0x047F)],
        reset: &[Word(99, 0x047E), Word(99, 0x04FE), Word(99, 0x047E)],
        refused: &[Word(99, 0x0077), Word(99, 0x067E)],
        shows_frequency: false,
        shows_reversed: false,
    },
    Case {
        profile: "schneider-altivar",
        peer: "cia402",
        reference: &[Word(8502, 250)],
        start: &[Word(8501, 6), Word(8501, 7), Word(8501, 15)],
        stop: &[Word(8501, 7)],
        reverse: &[Word(8501, 0x080F)],
        reset: &[Word(8501, 0), Word(8501, 0x80), Word(8501, 0)],
        refused: &[Word(8501, 0x001F), Word(8501, 0x008F), Word(8501, 0x000A)],
        shows_frequency: true,
        shows_reversed: false,
    },
    Case {
        profile: "yaskawa-v1000",
        peer: "yaskawa",
        reference: &[Word(2, 2500)],
        start: &[Word(1, 1)],
        stop: &[Word(1, 0)],
        reverse: &[Word(1, 2)],
        reset: &[Word(1, 0), Word(1, 8), Word(1, 0)],
        refused: &[Word(1, 3), Word(1, 4), Word(1, 5), Word(1, 0x10)],
        shows_frequency: true,
        shows_reversed: true,
    },
    Case {
        profile: "delta-ms300",
        peer: "delta",
        reference: &[Word(0x2001, 2500)],
        start: &[Word(0x2000, 0x12)],
        stop: &[Word(0x2000, 1)],
        reverse: &[Word(0x2000, 0x22)],
        reset: &[Word(0x2002, 2)],
        refused: &[
            Word(0x2000, 0),
            Word(0x2000, 2),
            Word(0x2000, 3),
            Word(0x2002, 1),
            Word(0x2002, 4),
        ],
        shows_frequency: true,
        shows_reversed: true,
    },
    Case {
        profile: "invt-goodrive",
        peer: "invt",
        reference: &[Word(0x2001, 2500)],
        start: &[Word(0x2000, 1)],
        stop: &[Word(0x2000, 5)],
        reverse: &[Word(0x2000, 2)],
        // A raw 7 is neither a stop nor a run command.
        reset: &[],
        refused: &[
            Word(0x2000, 0),
            Word(0x2000, 3),
            Word(0x2000, 4),
            Word(0x2000, 7),
            Word(0x2000, 8),
        ],
        shows_frequency: true,
        shows_reversed: true,
    },
    Case {
        profile: "mitsubishi-d700",
        peer: "mitsubishi",
        reference: &[Word(13, 2500)],
        start: &[Word(8, 2)],
        stop: &[Word(8, 0)],
        reverse: &[Word(8, 4)],
        reset: &[],
        refused: &[Word(8, 6), Word(8, 1), Word(8, 8)],
        shows_frequency: true,
        shows_reversed: true,
    },
    Case {
        profile: "invertek-optidrive",
        peer: "invertek",
        reference: &[Word(1, 250)],
        start: &[Word(0, 1)],
        stop: &[Word(0, 0)],
        // A negative reference is outside what the profile commands: forward again.
        reverse: &[],
        reset: &[Word(0, 0), Word(0, 4), Word(0, 0)],
        refused: &[Word(0, 9), Word(0, 3), Word(1, 0xFF06)],
        shows_frequency: true,
        shows_reversed: false,
    },
    Case {
        profile: "weg-cfw",
        peer: "weg",
        reference: &[Word(683, 4096)],
        start: &[Word(682, 0x17)],
        stop: &[Word(682, 0x16)],
        reverse: &[Word(682, 0x13)],
        reset: &[Word(682, 0x16), Word(682, 0x96), Word(682, 0x16)],
        refused: &[Word(682, 0x07), Word(682, 0x1E), Word(682, 0x15), Word(682, 0x06)],
        shows_frequency: true,
        shows_reversed: false,
    },
    Case {
        profile: "fuji-frenic",
        peer: "fuji",
        reference: &[Word(0x0705, 2500)],
        start: &[Word(0x0706, 1)],
        stop: &[Word(0x0706, 0)],
        reverse: &[Word(0x0706, 2)],
        reset: &[Word(0x0706, 0), Word(0x0706, 0x8000), Word(0x0706, 0)],
        refused: &[Word(0x0706, 3), Word(0x0706, 4), Word(0x0706, 0x2000)],
        shows_frequency: true,
        shows_reversed: true,
    },
    Case {
        profile: "hitachi-wj200",
        peer: "hitachi",
        reference: &[Pair(0, 0, 2500)],
        start: &[Coil(1, false), Coil(0, true)],
        stop: &[Coil(0, false)],
        reverse: &[Coil(1, true), Coil(0, true)],
        reset: &[Coil(0, false), Coil(3, true), Coil(3, false)],
        refused: &[],
        shows_frequency: true,
        shows_reversed: true,
    },
    Case {
        profile: "toshiba-vf-s15",
        peer: "toshiba",
        reference: &[Word(0xFA01, 2500)],
        start: &[Word(0xFA00, 0xC400)],
        stop: &[Word(0xFA00, 0xC000)],
        reverse: &[Word(0xFA00, 0xC600)],
        reset: &[Word(0xFA00, 0xC000), Word(0xFA00, 0xE000), Word(0xFA00, 0xC000)],
        refused: &[
            Word(0xFA00, 0),
            Word(0xFA00, 0x4400),
            Word(0xFA00, 0xD400),
            Word(0xFA00, 0xCC00),
        ],
        shows_frequency: true,
        shows_reversed: true,
    },
    Case {
        profile: "ls-g100",
        peer: "ls",
        reference: &[Word(4, 2500)],
        start: &[Word(5, 2)],
        stop: &[Word(5, 1)],
        reverse: &[Word(5, 4)],
        reset: &[],
        refused: &[Word(5, 0), Word(5, 6), Word(5, 8), Word(5, 16)],
        shows_frequency: true,
        shows_reversed: true,
    },
    Case {
        profile: "teco-f510",
        peer: "teco",
        reference: &[Word(0x2502, 2500)],
        start: &[Word(0x2501, 1)],
        stop: &[Word(0x2501, 0)],
        reverse: &[Word(0x2501, 3)],
        reset: &[Word(0x2501, 0), Word(0x2501, 8), Word(0x2501, 0)],
        refused: &[Word(0x2501, 5), Word(0x2501, 4), Word(0x2501, 0x11)],
        shows_frequency: true,
        shows_reversed: true,
    },
    Case {
        profile: "vacon-10",
        peer: "vacon10",
        reference: &[Word(2002, 5000)],
        start: &[Model(1, 2000, 1)],
        stop: &[Model(0, 2000, 0)],
        reverse: &[Model(3, 2000, 3)],
        reset: &[Model(4, 2000, 4)],
        refused: &[],
        shows_frequency: true,
        shows_reversed: true,
    },
];
