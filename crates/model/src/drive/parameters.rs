//! Parameters of a family as data: their addresses and names.

mod rules;

use crate::drive::PointIndex;
use std::ops::RangeInclusive;

use super::profile::Profile;
use drivegate_proto::{Protocol, Table};

pub use rules::{Addresses, Limit, Lock, WriteRules, has};

/// All parameters of a family.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ParameterList {
    /// Parameters that are known by name, by ascending address.
    pub named: Vec<Parameter>,
    /// Address ranges that may contain further parameters; reading shows which of them the drive has.
    pub spans: Vec<Span>,
    /// Points that identify the drive in a file: indices in the profile.
    pub identification: Vec<PointIndex>,
    /// The rules for writing the parameters back.
    pub rules: WriteRules,
}

/// Addresses at which a drive may have parameters.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Span {
    /// First PDU address of a holding register.
    pub first: u16,
    /// Last PDU address of the span.
    pub last: u16,
    /// How the parameters of the span are numbered.
    pub numbering: Numbering,
}

/// How a family numbers its parameters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Numbering {
    /// ID = PDU address + 1.
    Id,
    /// `group.number` = 100 group + number - 1, numbers 1 to 99; group 0 at 9900.
    Group,
}

impl Numbering {
    /// The name of the parameter at an address; `None` if no parameter can be there.
    pub fn id(self, address: u16) -> Option<String> {
        match self {
            Numbering::Id => Some((u32::from(address) + 1).to_string()),
            Numbering::Group => {
                let (block, number) = (address / 100, address % 100 + 1);
                let group = if block == 99 { 0 } else { block };
                (number <= 99).then(|| format!("{group}.{number}"))
            }
        }
    }

    /// The address of the parameter with this name.
    pub fn address(self, id: &str) -> Option<u16> {
        match self {
            Numbering::Id => id.parse::<u16>().ok()?.checked_sub(1),
            Numbering::Group => {
                let (group, number) = id.split_once('.')?;
                let (group, number): (u16, u16) = (group.parse().ok()?, number.parse().ok()?);
                let block = match group {
                    0 => 99,
                    1..=98 => group,
                    _ => return None,
                };
                (1..=99).contains(&number).then(|| 100 * block + number - 1)
            }
        }
    }
}

/// A parameter that is known by name.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameter {
    /// The family's own name of the parameter: `Cn-02`, `102`, `1.2`, `AO 3`.
    pub id: String,
    /// PDU address of the parameter's (first) holding register.
    pub address: u16,
    /// Name and unit of the parameter.
    pub label: Label,
    /// The accepted range, in the unit of the parameter; in counts if the scale is unknown. `None` if no manual states it.
    pub range: Option<RangeInclusive<f64>>,
}

/// A difference to the end of a range that floating point explains.
const TOLERANCE: f64 = 1e-6;

impl Parameter {
    /// Whether the drive accepts the value, as far as its family is known.
    pub fn accepts(&self, raw: RawValue) -> bool {
        let scale = match raw {
            RawValue::Word(_) if self.label.scale > 0.0 => self.label.scale,
            RawValue::Word(_) | RawValue::Float(_) => 1.0,
        };
        let value = raw.number() * scale;
        self.range.as_ref().is_none_or(|range| {
            let slack = TOLERANCE * value.abs().max(1.0);
            (range.start() - slack..=range.end() + slack).contains(&value)
        })
    }
}

/// Name, unit and scale of a parameter.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Label {
    /// Name of the parameter; empty if unknown.
    pub name: String,
    /// Unit of the value; empty for codes.
    pub unit: String,
    /// Value of one count; 0 if unknown.
    pub scale: f64,
}

impl Label {
    /// The value in the parameter's unit; empty if the value of a count is unknown.
    pub fn value(&self, raw: RawValue) -> String {
        let number = match raw {
            RawValue::Float(bits) => return with_unit(&f32::from_bits(bits).to_string(), &self.unit),
            RawValue::Word(word) => f64::from(word),
        };
        if self.scale <= 0.0 {
            return String::new();
        }
        let decimals = (0..6).find(|n| {
            let scaled = self.scale * 10f64.powi(*n);
            (scaled - scaled.round()).abs() < 1e-6
        });
        let decimals = usize::try_from(decimals.unwrap_or(6)).unwrap_or_default();
        with_unit(&format!("{:.decimals$}", number * self.scale), &self.unit)
    }
}

fn with_unit(number: &str, unit: &str) -> String {
    match unit {
        "" => number.to_string(),
        unit => format!("{number} {unit}"),
    }
}

/// The value of a parameter in the form that the drive gives.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum RawValue {
    /// The value of one register.
    Word(u16),
    /// The bits of an analog output of N2.
    Float(u32),
}

impl RawValue {
    /// The value in the words of a read.
    pub fn of_words(words: &[u16]) -> Option<RawValue> {
        match words {
            [word] => Some(RawValue::Word(*word)),
            [high, low] => Some(RawValue::Float(u32::from(*high) << 16 | u32::from(*low))),
            _ => None,
        }
    }

    /// The words to write for this value.
    pub fn words(self) -> Vec<u16> {
        match self {
            RawValue::Word(word) => vec![word],
            RawValue::Float(bits) => vec![(bits >> 16) as u16, bits as u16],
        }
    }

    /// Whether a drive that shows `other` has this value: an N2 object is stored in counts internally.
    pub fn is_shown_by(self, other: RawValue) -> bool {
        match (self, other) {
            (RawValue::Word(one), RawValue::Word(other)) => one == other,
            (RawValue::Float(one), RawValue::Float(other)) => {
                let (one, other) = (f32::from_bits(one), f32::from_bits(other));
                (one - other).abs() <= 1e-5 * one.abs().max(other.abs())
            }
            (RawValue::Word(_), RawValue::Float(_)) | (RawValue::Float(_), RawValue::Word(_)) => false,
        }
    }

    /// The value as a number: counts of a register, or the value of an object.
    pub fn number(self) -> f64 {
        match self {
            RawValue::Word(word) => f64::from(word),
            RawValue::Float(bits) => f64::from(f32::from_bits(bits)),
        }
    }
}

impl Profile {
    /// Whether the parameter at this address can be written; a parameter where the drive is commanded cannot.
    pub fn parameter_is_writable(&self, address: u16) -> bool {
        let (range, words) = (self.range(Table::Holding, address), self.parameter_words());
        range.is_some_and(|range| range.write >= words) && !self.commands_in(address, words)
    }

    /// Number of registers of a parameter; an N2 object has two.
    pub fn parameter_words(&self) -> u16 {
        if self.protocols.contains(&Protocol::N2) { 2 } else { 1 }
    }

    /// Maximum number of parameters in one read at `address`, and whether the read may include addresses without a
    /// parameter.
    pub fn parameter_read(&self, address: u16) -> (u16, bool) {
        let range = self.range(Table::Holding, address);
        range.map_or((1, false), |range| {
            ((range.read / self.parameter_words()).max(1), range.holes)
        })
    }

    /// The last address that may be read together with `address`.
    pub fn parameter_range_end(&self, address: u16) -> u16 {
        self.range(Table::Holding, address)
            .map_or(address, |range| *range.addresses.end())
    }
}

impl ParameterList {
    /// Whether the family has parameters that can be read.
    pub fn is_empty(&self) -> bool {
        self.named.is_empty() && self.spans.is_empty()
    }

    /// The parameter at an address; `None` if its name is unknown.
    pub fn by_address(&self, address: u16) -> Option<&Parameter> {
        let index = self.named.binary_search_by_key(&address, |parameter| parameter.address);
        index.ok().and_then(|index| self.named.get(index))
    }

    /// The id in files of the parameter at an address.
    pub fn id(&self, address: u16) -> Option<String> {
        if let Some(parameter) = self.by_address(address) {
            return Some(parameter.id.clone());
        }
        let span = self
            .spans
            .iter()
            .find(|span| (span.first..=span.last).contains(&address));
        span.and_then(|span| span.numbering.id(address))
    }

    /// The address of the parameter with this name.
    pub fn address(&self, id: &str) -> Option<u16> {
        if let Some(parameter) = self.named.iter().find(|parameter| parameter.id == id) {
            return Some(parameter.address);
        }
        self.spans.iter().find_map(|span| {
            let address = span.numbering.address(id)?;
            (span.first..=span.last).contains(&address).then_some(address)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_and_addresses_of_the_manuals() {
        assert_eq!(
            (Numbering::Id.id(101), Numbering::Id.address("102")),
            (Some("102".to_string()), Some(101))
        );
        let group = Numbering::Group;
        for (id, address) in [
            ("1.2", 101),
            ("3.2", 301),
            ("0.1", 9900),
            ("98.99", 9898),
            ("0.99", 9998),
        ] {
            assert_eq!(
                (group.address(id), group.id(address).as_deref()),
                (Some(address), Some(id))
            );
        }
        assert_eq!(
            (group.id(199), group.address("1.100"), group.address("99.1")),
            (None, None, None)
        );
    }

    #[test]
    fn ranges_are_in_the_unit() {
        let mut parameter = Parameter {
            id: "Bn-13".to_string(),
            address: 0x050C,
            label: Label {
                scale: 0.01,
                ..Label::default()
            },
            range: Some(0.01..=10.0),
        };
        let takes = |parameter: &Parameter, words: [u16; 4]| words.map(|word| parameter.accepts(RawValue::Word(word)));
        assert_eq!(takes(&parameter, [0, 1, 1000, 1001]), [false, true, true, false]);
        let floats = [0.009f32, 0.01, 10.0, 10.01];
        let taken = floats.map(|value| parameter.accepts(RawValue::Float(value.to_bits())));
        assert_eq!(taken, [false, true, true, false]);
        parameter.label.scale = 0.0;
        assert_eq!(
            takes(&parameter, [0, 1, 10, 11]),
            [false, true, true, false],
            "in counts"
        );
        parameter.range = None;
        assert_eq!(takes(&parameter, [0, 1, 1000, 65_535]), [true; 4]);
    }

    #[test]
    fn values_have_the_decimals_of_their_scale() {
        let label = |scale| Label {
            unit: "Hz".to_string(),
            scale,
            ..Label::default()
        };
        assert_eq!(label(0.01).value(RawValue::Word(5000)), "50.00 Hz");
        assert_eq!(label(1.0).value(RawValue::Word(7)), "7 Hz");
        assert_eq!(label(0.25).value(RawValue::Word(3)), "0.75 Hz");
        assert_eq!(label(0.0).value(RawValue::Word(3)), "");
        assert_eq!(label(1.0).value(RawValue::Float(12.5f32.to_bits())), "12.5 Hz");
    }
}
