//! Register or bit of the simulated drive for each object of its N2 board: reference/drives.md 6.6 and 6.7.

use crate::simulated_drive::ModelOptions;
use drivegate_proto::Table;
use drivegate_proto::n2::Region;

/// Source of an object's value, and destination of an override.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Backing {
    /// A signed register; the value of one count.
    Signed(Table, u16, f64),
    /// An unsigned register; the value of one count.
    Unsigned(Table, u16, f64),
    /// A single bit of a register.
    Bit(Table, u16, u8),
    /// A constant, because the model has no such value.
    Fixed(f32),
}

/// One object of an N2 board.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Entry {
    /// Region of the object.
    pub region: Region,
    pub number: u8,
    /// The register or bit of the drive that the object represents.
    pub place: Backing,
    /// Limits of the drive's parameter; if absent, the limits of the register hold.
    pub limits: Option<(f64, f64)>,
}

/// Reaction of a board to an override beyond the limits of the parameter.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Beyond {
    /// Acknowledges the value and uses the limit instead, if the value fits the variable (Vacon, Eaton).
    Clamp,
    Refuse,
}

/// The objects of a family's N2 board, and how the board behaves.
#[derive(Debug, Clone, Copy)]
pub struct Map {
    /// All objects of the N2 board.
    pub entries: &'static [Entry],
    /// Whether an override of AI, BI or ADI changes what the bus reads until a release; otherwise override and
    /// release do nothing.
    pub overrides_inputs: bool,
    /// Whether AI objects have alarm and warning limits.
    pub has_limits: bool,
    /// Whether the board knows the warm reset.
    pub warm_reset: bool,
    /// The reaction to overrides beyond a parameter's limits.
    pub beyond: Beyond,
    /// Overrides are released after about 10 minutes without a poll.
    pub stands_alone: bool,
}

/// The map of a model's family.
pub(crate) fn of(model: &ModelOptions) -> &'static Map {
    match model {
        ModelOptions::Nx(nx) if nx.hvac_control => &HVX,
        ModelOptions::Nx(_) => &NX,
        ModelOptions::Teco(_) => &TECO,
        ModelOptions::Cx(_) | ModelOptions::Profile(_) => &NONE,
    }
}

use Backing::{Bit, Fixed, Signed, Unsigned};
use Region::{Adi, Ai, Ao, Bi, Bo};

const HOLDING: Table = Table::Holding;

const fn entry(region: Region, number: u8, place: Backing) -> Entry {
    Entry {
        region,
        number,
        place,
        limits: None,
    }
}

const fn limited(number: u8, place: Backing, low: f64, high: f64) -> Entry {
    Entry {
        region: Ao,
        number,
        place,
        limits: Some((low, high)),
    }
}

/// Bits of a status word as BI `first`, `first` + 1, …, and of a control word as BO.
macro_rules! nx_entries {
    ($($more:expr,)*) => {
        &[
            entry(Ai, 1, Signed(HOLDING, 24, 0.01)),
            entry(Ai, 2, Signed(HOLDING, 0, 0.01)),
            entry(Ai, 3, Signed(HOLDING, 1, 1.0)),
            entry(Ai, 4, Signed(HOLDING, 4, 0.1)),
            entry(Ai, 5, Fixed(1.5)),
            entry(Ai, 6, Unsigned(HOLDING, 2, 0.1)),
            entry(Ai, 7, Unsigned(HOLDING, 6, 1.0)),
            entry(Ai, 8, Unsigned(HOLDING, 5, 0.1)),
            entry(Ai, 9, Signed(HOLDING, 7, 1.0)),
            entry(Ai, 10, Signed(HOLDING, 3, 0.1)),
            entry(Ai, 11, Fixed(12.0)),
            entry(Ai, 12, Fixed(288.0)),
            entry(Ai, 13, Fixed(250.0)),
            entry(Ai, 14, Fixed(0.0)),
            entry(Ai, 15, Signed(HOLDING, 8, 1.0)),
            entry(Ai, 16, Signed(HOLDING, 2103, 1.0)),
            entry(Ai, 17, Signed(HOLDING, 2104, 1.0)),
            entry(Ai, 18, Signed(HOLDING, 2105, 1.0)),
            entry(Ai, 19, Signed(HOLDING, 2106, 1.0)),
            entry(Ai, 20, Signed(HOLDING, 2107, 1.0)),
            entry(Ai, 21, Signed(HOLDING, 2108, 1.0)),
            entry(Ai, 22, Signed(HOLDING, 2109, 1.0)),
            entry(Ai, 23, Signed(HOLDING, 2110, 1.0)),
            entry(Bi, 1, Bit(HOLDING, 2100, 0)),
            entry(Bi, 2, Bit(HOLDING, 2100, 1)),
            entry(Bi, 3, Bit(HOLDING, 2100, 2)),
            entry(Bi, 4, Bit(HOLDING, 2100, 3)),
            entry(Bi, 5, Bit(HOLDING, 2100, 4)),
            entry(Bi, 6, Bit(HOLDING, 2100, 5)),
            entry(Bi, 8, Bit(HOLDING, 2101, 0)),
            entry(Bi, 9, Bit(HOLDING, 2101, 1)),
            entry(Bi, 10, Bit(HOLDING, 2101, 2)),
            entry(Bi, 11, Bit(HOLDING, 2101, 3)),
            entry(Bi, 12, Bit(HOLDING, 2101, 4)),
            limited(1, Signed(HOLDING, 2002, 0.01), -100.0, 100.0),
            limited(2, Unsigned(HOLDING, 106, 0.1), 0.1, 400.0),
            limited(3, Unsigned(HOLDING, 100, 0.01), 0.0, 320.0),
            limited(4, Unsigned(HOLDING, 101, 0.01), 1.0, 320.0),
            limited(5, Unsigned(HOLDING, 102, 0.1), 0.1, 3000.0),
            limited(6, Unsigned(HOLDING, 103, 0.1), 0.1, 3000.0),
            entry(Bo, 1, Bit(HOLDING, 2000, 0)),
            entry(Bo, 2, Bit(HOLDING, 2000, 1)),
            entry(Bo, 3, Bit(HOLDING, 2000, 2)),
            entry(Bo, 4, Bit(HOLDING, 2000, 3)),
            entry(Bo, 5, Bit(HOLDING, 2000, 4)),
            entry(Bo, 6, Bit(HOLDING, 2000, 5)),
            entry(Bo, 7, Bit(HOLDING, 2000, 6)),
            entry(Bo, 8, Bit(HOLDING, 2000, 7)),
            entry(Bo, 11, Bit(HOLDING, 2000, 10)),
            entry(Bo, 12, Bit(HOLDING, 2000, 11)),
            entry(Bo, 13, Bit(HOLDING, 2000, 12)),
            entry(Bo, 14, Bit(HOLDING, 2000, 13)),
            entry(Bo, 15, Bit(HOLDING, 2000, 14)),
            entry(Adi, 1, Unsigned(HOLDING, 98, 1.0)),
            $($more,)*
        ]
    };
}

/// Vacon NX (tables 19 to 23). The model has no counters: AI 5 and AI 11 to 14 do not change.
pub(crate) const NX: Map = Map {
    entries: nx_entries![
        entry(Bi, 7, Bit(HOLDING, 2100, 6)),
        entry(Bi, 13, Bit(HOLDING, 2101, 5)),
        entry(Bi, 14, Bit(HOLDING, 2101, 6)),
        entry(Bi, 15, Bit(HOLDING, 2101, 7)),
        entry(Ao, 7, Signed(HOLDING, 2003, 1.0)),
        entry(Ao, 8, Signed(HOLDING, 2004, 1.0)),
        entry(Ao, 9, Signed(HOLDING, 2005, 1.0)),
        entry(Ao, 10, Signed(HOLDING, 2006, 1.0)),
        entry(Bo, 9, Bit(HOLDING, 2000, 8)),
        entry(Bo, 10, Bit(HOLDING, 2000, 9)),
        entry(Bo, 16, Bit(HOLDING, 2000, 15)),
    ],
    overrides_inputs: true,
    has_limits: true,
    warm_reset: false,
    beyond: Beyond::Clamp,
    stands_alone: true,
};

/// Eaton HVX (tables 6-1 to 6-5): BI 7, AO 9 and 10, BO 9, 10 and 16 do not exist.
pub(crate) const HVX: Map = Map {
    entries: nx_entries![
        entry(Ao, 7, Signed(HOLDING, 2003, 0.01)),
        entry(Ao, 8, Signed(HOLDING, 2004, 0.01)),
    ],
    ..NX
};

/// The empty map of a family without N2.
pub(crate) const NONE: Map = Map { entries: &[], ..NX };

/// TECO 7300PA with its PA-C card, from the column "Modbus" of the tables.
pub(crate) const TECO: Map = Map {
    entries: &[
        entry(Ai, 1, Unsigned(HOLDING, 0x0023, 0.01)),
        entry(Ai, 2, Unsigned(HOLDING, 0x0024, 0.01)),
        entry(Ai, 3, Unsigned(HOLDING, 0x0027, 0.1)),
        entry(Ai, 4, Unsigned(HOLDING, 0x0028, 1.0)),
        entry(Ai, 5, Unsigned(HOLDING, 0x0029, 100.0 / 1023.0)),
        entry(Ai, 6, Unsigned(HOLDING, 0x002A, 100.0 / 1023.0)),
        entry(Ai, 7, Unsigned(HOLDING, 0x0031, 1.0)),
        entry(Ai, 8, Unsigned(HOLDING, 0x0021, 1.0)),
        entry(Ai, 9, Fixed(0.0)),
        entry(Ai, 10, Unsigned(HOLDING, 0x0040, 0.1)),
        entry(Bi, 1, Bit(HOLDING, 0x0020, 0)),
        entry(Bi, 2, Bit(HOLDING, 0x0020, 1)),
        entry(Bi, 3, Bit(HOLDING, 0x0020, 2)),
        entry(Bi, 4, Bit(HOLDING, 0x0020, 3)),
        entry(Bi, 5, Bit(HOLDING, 0x002C, 1)),
        entry(Bi, 6, Bit(HOLDING, 0x002C, 2)),
        entry(Bi, 7, Bit(HOLDING, 0x002C, 3)),
        entry(Bi, 8, Bit(HOLDING, 0x002C, 4)),
        entry(Bi, 9, Bit(HOLDING, 0x002C, 5)),
        entry(Bi, 10, Bit(HOLDING, 0x002C, 7)),
        entry(Bi, 11, Bit(HOLDING, 0x002C, 8)),
        entry(Bi, 12, Bit(HOLDING, 0x002C, 11)),
        entry(Bi, 13, Bit(HOLDING, 0x002C, 12)),
        entry(Bi, 14, Bit(HOLDING, 0x002B, 0)),
        entry(Bi, 15, Bit(HOLDING, 0x002B, 1)),
        entry(Bi, 16, Bit(HOLDING, 0x002B, 2)),
        entry(Bi, 17, Bit(HOLDING, 0x002B, 3)),
        entry(Bi, 18, Bit(HOLDING, 0x002B, 4)),
        entry(Bi, 19, Bit(HOLDING, 0x002B, 5)),
        entry(Bi, 20, Bit(HOLDING, 0x002B, 6)),
        entry(Bi, 21, Bit(HOLDING, 0x002B, 7)),
        entry(Bi, 22, Bit(HOLDING, 0x002D, 1)),
        entry(Bi, 23, Bit(HOLDING, 0x002D, 2)),
        entry(Bi, 24, Bit(HOLDING, 0x002D, 0)),
        limited(1, Unsigned(HOLDING, 0x0002, 0.01), 0.0, 180.0),
        limited(2, Unsigned(HOLDING, 0x000A, 100.0 / 255.0), 0.0, 100.0),
        limited(3, Unsigned(HOLDING, 0x000B, 100.0 / 255.0), 0.0, 100.0),
        limited(4, Unsigned(HOLDING, 0x0408, 0.01), 0.0, 180.0),
        limited(5, Unsigned(HOLDING, 0x0500, 0.1), 0.0, 6000.0),
        limited(6, Unsigned(HOLDING, 0x0501, 0.1), 0.0, 6000.0),
        limited(7, Unsigned(HOLDING, 0x0502, 0.1), 0.0, 6000.0),
        limited(8, Unsigned(HOLDING, 0x0503, 0.1), 0.0, 6000.0),
        limited(9, Unsigned(HOLDING, 0x050C, 0.01), 0.01, 10.0),
        limited(10, Unsigned(HOLDING, 0x050D, 0.01), 0.01, 10.0),
        limited(11, Unsigned(HOLDING, 0x050E, 0.1), 0.0, 100.0),
        limited(12, Unsigned(HOLDING, 0x050F, 0.01), 0.0, 1.0),
        limited(13, Unsigned(HOLDING, 0x020D, 1.0), 0.0, 109.0),
        limited(14, Unsigned(HOLDING, 0x020E, 1.0), 0.0, 109.0),
        limited(15, Unsigned(HOLDING, 0x020F, 0.1), 0.0, 180.0),
        limited(16, Unsigned(HOLDING, 0x0210, 0.1), 0.0, 180.0),
        limited(17, Unsigned(HOLDING, 0x0211, 0.1), 0.0, 180.0),
        limited(18, Unsigned(HOLDING, 0x0212, 0.1), 0.0, 25.5),
        limited(19, Unsigned(HOLDING, 0x021B, 1.0), 30.0, 170.0),
        limited(20, Unsigned(HOLDING, 0x021D, 1.0), 30.0, 170.0),
        limited(21, Unsigned(HOLDING, 0x0223, 1.0), 0.0, 10.0),
        limited(22, Unsigned(HOLDING, 0x0113, 1.0), 0.0, 12.0),
        entry(Bo, 1, Bit(HOLDING, 0x0001, 0)),
        entry(Bo, 2, Bit(HOLDING, 0x0001, 1)),
        entry(Bo, 3, Bit(HOLDING, 0x0001, 2)),
        entry(Bo, 4, Bit(HOLDING, 0x0001, 3)),
        entry(Bo, 5, Bit(HOLDING, 0x0001, 4)),
        entry(Bo, 6, Bit(HOLDING, 0x0001, 5)),
        entry(Bo, 7, Bit(HOLDING, 0x0001, 6)),
        entry(Bo, 8, Bit(HOLDING, 0x0001, 7)),
        entry(Bo, 9, Bit(HOLDING, 0x0009, 1)),
        entry(Bo, 10, Bit(HOLDING, 0x0009, 2)),
        entry(Bo, 11, Bit(HOLDING, 0x0009, 0)),
        entry(Bo, 12, Bit(HOLDING, 0x0109, 0)),
    ],
    overrides_inputs: false,
    has_limits: false,
    warm_reset: true,
    beyond: Beyond::Refuse,
    stands_alone: false,
};
