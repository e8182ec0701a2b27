//! The common drive model: the same points, units and meanings for every family.

use std::fmt;
use std::time::Instant;

use serde::Serialize;

use super::profile::Order;

/// A value in engineering units.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(untagged)]
pub enum Value {
    /// A state, true or false.
    Bool(bool),
    /// A code or a bit mask, as an integer.
    Integer(i64),
    /// A number in the point's unit; always finite.
    Number(f64),
    /// A whole number that is too large for `Integer`.
    Unsigned(u64),
    /// A text value.
    Text(Text),
}

/// A text of a drive, of limited length and stored without allocation.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Text {
    bytes: [u8; Text::MOST_BYTES],
    length: u8,
}

impl Text {
    const MOST_BYTES: usize = 2 * super::profile::MOST_REGISTERS;

    /// The text in these registers up to its first NUL; `None` if there are too many registers.
    pub(crate) fn of_registers(words: &[u16], order: Order) -> Option<Text> {
        let mut text = Text {
            bytes: [0; Text::MOST_BYTES],
            length: 0,
        };
        if words.len() > super::profile::MOST_REGISTERS {
            return None;
        }
        let all = order.bytes(words).take_while(|byte| *byte != 0);
        for (place, byte) in text.bytes.iter_mut().zip(all) {
            *place = byte;
            text.length += 1;
        }
        Some(text)
    }

    /// The text; a control character, or a byte that is not a character, is shown as U+FFFD, so that no bytes of a
    /// device control a terminal or a log.
    pub fn shown(&self) -> String {
        let bytes = self.bytes.get(..usize::from(self.length)).unwrap_or_default();
        let shown = |c: char| if c.is_control() { char::REPLACEMENT_CHARACTER } else { c };
        String::from_utf8_lossy(bytes).chars().map(shown).collect()
    }
}

impl fmt::Debug for Text {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?}", self.shown())
    }
}

impl Serialize for Text {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(&self.shown())
    }
}

impl Value {
    /// The value as a number; true is 1, a text is NaN.
    pub fn as_f64(self) -> f64 {
        match self {
            Value::Bool(b) => f64::from(u8::from(b)),
            Value::Integer(i) => i as f64,
            Value::Unsigned(u) => u as f64,
            Value::Number(n) => n,
            Value::Text(_) => f64::NAN,
        }
    }

    /// The value as an exact number; `None` for a text and for a whole number that would be rounded.
    pub fn exact_f64(self) -> Option<f64> {
        let number = self.as_f64();
        let exact = match self {
            Value::Integer(i) => number as i128 == i128::from(i),
            Value::Unsigned(u) => number as i128 == i128::from(u),
            Value::Bool(_) | Value::Number(_) => true,
            Value::Text(_) => false,
        };
        exact.then_some(number)
    }

    /// Whether the value is not zero; `None` for a text.
    pub fn as_bool(self) -> bool {
        let number = self.as_f64();
        number != 0.0 && !number.is_nan()
    }
}

impl fmt::Display for Value {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Value::Bool(b) => write!(f, "{b}"),
            Value::Integer(i) => write!(f, "{i}"),
            Value::Unsigned(u) => write!(f, "{u}"),
            Value::Number(n) => write!(f, "{n}"),
            Value::Text(text) => f.write_str(&text.shown()),
        }
    }
}

/// Whether a value can be relied on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Quality {
    /// The value was read from the drive recently enough.
    Good,
    /// Older than allowed, or the drive is offline.
    Stale,
    /// The drive refused the point, or the point was never read.
    Bad,
}

impl Quality {
    /// The worse of two qualities.
    pub fn worse(self, other: Quality) -> Quality {
        let rank = |quality| match quality {
            Quality::Good => 0,
            Quality::Stale => 1,
            Quality::Bad => 2,
        };
        if rank(other) > rank(self) { other } else { self }
    }

    /// The name in payloads.
    pub fn name(self) -> &'static str {
        match self {
            Quality::Good => "good",
            Quality::Stale => "stale",
            Quality::Bad => "bad",
        }
    }
}

/// A value with its quality and the time of reading.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sample {
    /// The last value; absent if no value was ever read.
    pub value: Option<Value>,
    /// Quality of the sample.
    pub quality: Quality,
    /// Time of the end of the reply that contained the value.
    pub at: Option<Instant>,
}

impl Sample {
    /// A sample without a value.
    pub const NONE: Sample = Sample {
        value: None,
        quality: Quality::Bad,
        at: None,
    };

    /// The value; `None` if it is not good.
    pub fn good(&self) -> Option<Value> {
        if self.quality == Quality::Good {
            self.value
        } else {
            None
        }
    }
}

/// The state of a drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// The drive does not answer, has never answered, or its values are too old.
    Offline,
    /// The drive answers but is not ready to run.
    NotReady,
    /// The drive is ready to run.
    Ready,
    /// The drive runs its motor.
    Running,
    /// The drive has a fault.
    Fault,
}

impl State {
    /// All states, in the order of their codes at 0x8001.
    pub const ALL: [State; 5] = [
        State::Offline,
        State::NotReady,
        State::Ready,
        State::Running,
        State::Fault,
    ];

    /// Code in the common block of Modbus TCP.
    pub fn code(self) -> u16 {
        match self {
            State::Offline => 0,
            State::NotReady => 1,
            State::Ready => 2,
            State::Running => 3,
            State::Fault => 4,
        }
    }

    /// The name in payloads and labels.
    pub fn name(self) -> &'static str {
        match self {
            State::Offline => "offline",
            State::NotReady => "not_ready",
            State::Ready => "ready",
            State::Running => "running",
            State::Fault => "fault",
        }
    }
}

/// Kind of a point's values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// True or false, as a kind of value.
    Bool,
    /// A number with a unit.
    Number,
    /// A code, or a whole number of 64 bits.
    Integer,
    /// The values are texts.
    Text,
}

/// Rounds away the error of binary fractions in a scaled count: 2500 * 0.01 is 25, not 25.000000000000004.
pub fn tidy(value: f64) -> f64 {
    let rounded = (value * 1e6).round() / 1e6;
    if rounded.is_finite() { rounded } else { value }
}

/// Rounds a count that was only multiplied, so that a small product keeps nine digits.
pub(crate) fn tidy_product(value: f64) -> f64 {
    if value == 0.0 || value.abs() >= 1.0 {
        return tidy(value);
    }
    let places = 8.0 - value.abs().log10().floor();
    // Powers of ten beyond are not exact.
    if places > 22.0 {
        return value;
    }
    let power = 10f64.powi(places as i32);
    (value * power).round() / power
}

macro_rules! model_points {
    ($($variant:ident $name:literal $unit:literal $kind:ident $doc:literal,)*) => {
        /// A point of the common drive model.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
        pub enum ModelPoint {
            $(#[doc = $doc] $variant,)*
        }

        impl ModelPoint {
            /// All points of the model in their public order.
            pub const ALL: &'static [ModelPoint] = &[$(ModelPoint::$variant,)*];

            /// The public name of the point.
            pub fn name(self) -> &'static str {
                match self { $(ModelPoint::$variant => $name,)* }
            }

            /// The unit, empty for states and codes.
            pub fn unit(self) -> &'static str {
                match self { $(ModelPoint::$variant => $unit,)* }
            }

            /// The kind of the point's values.
            pub fn kind(self) -> Kind {
                match self { $(ModelPoint::$variant => Kind::$kind,)* }
            }
        }
    };
}

model_points! {
    Ready "ready" "" Bool "Ready to run.",
    Running "running" "" Bool "Runs.",
    Reversed "reversed" "" Bool "Runs in reverse.",
    Fault "fault" "" Bool "Has a fault.",
    Warning "warning" "" Bool "Has a warning.",
    AtReference "at_reference" "" Bool "Output has reached the reference.",
    ZeroSpeed "zero_speed" "" Bool "Motor at standstill.",
    Remote "remote" "" Bool "The fieldbus is the control place.",
    ActualSpeed "actual_speed" "%" Number "Speed in percent of the speed range.",
    OutputFrequency "output_frequency" "Hz" Number "Output frequency.",
    MotorSpeed "motor_speed" "rpm" Number "Motor speed.",
    MotorCurrent "motor_current" "A" Number "Motor current.",
    MotorTorque "motor_torque" "%" Number "Torque in percent of nominal.",
    MotorPower "motor_power" "%" Number "Power in percent of nominal.",
    MotorVoltage "motor_voltage" "V" Number "Motor voltage.",
    DcLinkVoltage "dc_link_voltage" "V" Number "DC link voltage.",
    HeatsinkTemperature "heatsink_temperature" "°C" Number "Heatsink temperature.",
    Energy "energy" "kWh" Number "Energy counter.",
    OperatingHours "operating_hours" "h" Number "Operating hours.",
    FaultCode "fault_code" "" Integer "Active fault code, 0 without a fault.",
    Run "run" "" Bool "Command: run; read: the state in the drive.",
    Reverse "reverse" "" Bool "Command: reverse; read: the state in the drive.",
    FaultReset "fault_reset" "" Bool "Command: true resets a fault with one pulse.",
    SpeedReference "speed_reference" "%" Number "Speed reference, command and value in the drive.",
    FrequencyReference "frequency_reference" "Hz" Number "Frequency reference, command and value in the drive.",
}

impl ModelPoint {
    /// The bits of the common status word (register 0x8000), bit 0 first.
    pub const STATUS_WORD: [ModelPoint; 8] = [
        ModelPoint::Ready,
        ModelPoint::Running,
        ModelPoint::Reversed,
        ModelPoint::Fault,
        ModelPoint::Warning,
        ModelPoint::AtReference,
        ModelPoint::ZeroSpeed,
        ModelPoint::Remote,
    ];

    /// The point of that name.
    pub(crate) fn from_name(name: &str) -> Option<ModelPoint> {
        ModelPoint::ALL.iter().copied().find(|p| p.name() == name)
    }

    /// Place in [`ModelPoint::ALL`].
    pub(crate) fn index(self) -> usize {
        self as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_unique_and_found() {
        for (i, &point) in ModelPoint::ALL.iter().enumerate() {
            assert_eq!(point.index(), i);
            assert_eq!(ModelPoint::from_name(point.name()), Some(point));
        }
    }
}
