//! Units as BACnet numbers them (BACnetEngineeringUnits).

/// BACnet's number for "no unit".
pub(super) const NONE: u32 = 95;

const UNITS: [(&str, u32); 30] = [
    ("%", 98),
    ("Hz", 27),
    ("kHz", 129),
    ("rpm", 104),
    ("1/min", 104),
    ("A", 3),
    ("mA", 2),
    ("V", 5),
    ("mV", 124),
    ("kV", 6),
    ("°C", 62),
    ("°F", 64),
    ("K", 63),
    ("kWh", 19),
    ("Wh", 18),
    ("MWh", 146),
    ("W", 47),
    ("kW", 48),
    ("MW", 49),
    ("hp", 51),
    ("VA", 8),
    ("kVA", 9),
    ("h", 71),
    ("min", 72),
    ("s", 73),
    ("ms", 159),
    ("Nm", 160),
    ("Ω", 4),
    ("bar", 55),
    ("°", 90),
];

/// The number of a unit of a profile.
pub(super) fn number(unit: &str) -> u32 {
    let known = UNITS.iter().find(|(name, _)| *name == unit);
    known.map_or(NONE, |(_, number)| *number)
}

/// The unit of a number; the first of several.
pub(super) fn name(number: u32) -> &'static str {
    UNITS
        .iter()
        .find(|(_, own)| *own == number)
        .map_or("", |(name, _)| name)
}

/// The unit numbers in use, each with its unit.
pub(super) fn all() -> impl Iterator<Item = (u32, &'static str)> {
    UNITS.iter().map(|(name, number)| (*number, *name)).chain([(NONE, "")])
}
