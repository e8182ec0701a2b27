//! Words that the gateway passes on and refuses for each family, taken by hand from the figures of its manual.

use drivegate_testkit::{families, orders, rows};

/// A write to the unit of the drive.
#[derive(Debug)]
pub(super) enum Order {
    /// The order writes registers and coils of the drive directly.
    Raw(drivegate_testkit::Order),
    /// The common model's command word, and the register and word that the drive receives for it.
    Model(u16, u16, u16),
}

use Order::{Model, Raw};
use drivegate_testkit::Order::{Coil, Pair, Single, Word};

impl Order {
    pub(super) fn pdu(&self) -> Vec<u8> {
        let words = |words: &[u16]| words.iter().flat_map(|word| word.to_be_bytes()).collect::<Vec<u8>>();
        match *self {
            Raw(Word(address, word) | Single(address, word)) => [vec![6], words(&[address, word])].concat(),
            Raw(Pair(address, high, low)) => [vec![16], words(&[address, 2]), vec![4], words(&[high, low])].concat(),
            Raw(Coil(address, on)) => [vec![5], words(&[address, if on { 0xFF00 } else { 0 }])].concat(),
            Model(word, ..) => [vec![6], words(&[0x8100, word])].concat(),
        }
    }

    /// The order as the drive prints it.
    pub(super) fn as_seen(&self) -> String {
        match *self {
            Raw(Word(address, word) | Single(address, word)) | Model(_, address, word) => {
                format!("wrote holding {address:04X} {word:04X}\n")
            }
            Raw(Pair(address, high, low)) => {
                let (next, high) = (address + 1, format!("wrote holding {address:04X} {high:04X}\n"));
                format!("{high}wrote holding {next:04X} {low:04X}\n")
            }
            Raw(Coil(address, on)) => format!("wrote coil {address:04X} {:04X}\n", u16::from(on)),
        }
    }
}

pub(super) struct Case {
    pub(super) profile: &'static str,
    /// The module of the drive in `tests/peers/families`.
    pub(super) peer: &'static str,
    pub(super) reference: Vec<Order>,
    pub(super) start: Vec<Order>,
    pub(super) stop: Vec<Order>,
    pub(super) reverse: Vec<Order>,
    /// The reset as a client may write it raw; empty if only the reset of the common model is passed on.
    pub(super) reset: Vec<Order>,
    /// Orders that are refused: neither a stop nor clearly a run command.
    pub(super) refused: Vec<Order>,
    pub(super) shows_frequency: bool,
    pub(super) shows_reversed: bool,
}

impl Case {
    /// The register of the reference, if the reference is a register.
    pub(super) fn reference_register(&self) -> Option<u16> {
        match self.reference.as_slice() {
            [Raw(Word(address, _) | Single(address, _))] => Some(*address),
            _ => None,
        }
    }

    /// Whether the family is started by a sequence of words that the drive confirms.
    pub(super) fn has_sequence(&self) -> bool {
        ["abb", "cia402", "siemens"].contains(&self.peer)
    }
}

/// Columns: profile, peer, displayed states, reset, refused words. A raw 7 of INVT and a raw 8 of LS are neither a
/// stop nor a run command.
const CASES: &str = "\
abb-acs550         | abb        | frequency reversed | 0=0x47E,0x4FE,0x47E         | 0=0x7F,0x57E,0x67F
abb-acs580         | abb        | reversed           | 0=0x47E,0x4FE,0x47E         | 0=0x7,0x77
danfoss-fc         | danfoss    | frequency reversed | 49999=0x43C,0x4BC,0x43C     | 49999=0x7C,0x3C,0x41C,0x53C,0x74
siemens-v20        | siemens    | frequency reversed | 99=0x47E,0x4FE,0x47E        | 99=0x7F,0x7E,0x57E,0x7D
siemens-g120       | siemens    | reversed           | 99=0x47E,0x4FE,0x47E        | 99=0x77,0x67E
schneider-altivar  | cia402     | frequency reversed | 8501=0,0x80,0               | 8501=0x1F,0x8F,0xE
yaskawa-v1000      | yaskawa    | frequency reversed | 1=0,8,0                     | 1=3,4,5,0x10
delta-ms300        | delta      | frequency reversed | 0x2002=2                    | 0x2000=0,2,3 0x2002=1,4
invt-goodrive      | invt       | frequency reversed |                             | 0x2000=0,3,4,7,8,14
mitsubishi-d700    | mitsubishi | frequency reversed | 1=0x9696                    | 8=6,1,8
invertek-optidrive | invertek   | frequency reversed | 0=0,4,0                     | 0=0x11,0x21
weg-cfw            | weg        | frequency reversed | 682=0x16,0x96,0x16          | 682=0x7,0x1E,0x5,0x6
fuji-frenic        | fuji       | frequency reversed | 0x0706=0,0x8000,0           | 0x0706=3,4,0x2000
hitachi-wj200      | hitachi    | frequency reversed | 0=off 3=on 3=off            |
toshiba-vf-s15     | toshiba    | frequency reversed | 0xFA00=0xC000,0xE000,0xC000 | 0xFA00=0,0x4400,0x5400,0x4C00
ls-g100            | ls         | frequency reversed |                             | 5=0,6,8,32
teco-f510          | teco       | frequency reversed | 0x2501=0,8,0                | 0x2501=5,4,0x11
vacon-10           | vacon10    | frequency reversed | 2000=4                      |";

/// All cases in the order of [`families`].
pub(super) fn cases() -> Vec<Case> {
    let rows = rows::<5>(CASES).into_iter();
    let case = |(family, [profile, peer, shows, reset, refused]): (drivegate_testkit::Family, [&'static str; 5])| {
        assert_eq!(family.profile, profile);
        // The control word of this family can only be written through the common model.
        let client = |order| match order {
            Word(2000, word) if peer == "vacon10" => Model(word, 2000, word),
            order => Raw(order),
        };
        let all = |orders: Vec<drivegate_testkit::Order>| orders.into_iter().map(client).collect();
        Case {
            profile,
            peer,
            reference: all(family.reference),
            start: all(family.start),
            stop: all(family.stop),
            reverse: all(family.reverse),
            reset: all(orders(reset)),
            refused: all(orders(refused)),
            shows_frequency: shows.contains("frequency"),
            shows_reversed: shows.contains("reversed"),
        }
    };
    let families = families();
    assert_eq!(families.len(), rows.len());
    families.into_iter().zip(rows).map(case).collect()
}
