//! Time on the wire: how long characters take at a baud rate and a character format.

use std::fmt;
use std::str::FromStr;
use std::time::Duration;

/// Standard baud rates in rising order: all that drives and meters can be set to, and 230400 of faster device servers. A
/// reply that is too early for all of them did not come over a serial wire.
pub const BAUDS: [u32; 11] = [
    300, 600, 1200, 2400, 4800, 9600, 19_200, 38_400, 57_600, 115_200, 230_400,
];

/// Rates at which nearly all drives are delivered or set, in rising order.
pub fn usual_bauds() -> impl Iterator<Item = u32> {
    BAUDS.into_iter().filter(|baud| (9600..=115_200).contains(baud))
}

/// The order in which an unknown line is searched: the usual rates, then the slower ones, the next slower first.
pub fn searched_bauds() -> impl Iterator<Item = u32> {
    usual_bauds().chain(BAUDS.into_iter().rev().filter(|baud| *baud < 9600))
}

/// Parity bit of a character.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Parity {
    /// The characters have no parity bit.
    None,
    /// The characters have even parity.
    Even,
    /// The characters have odd parity.
    Odd,
}

/// Baud rate and character format of a line; `8N1` is such a format.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct LineFormat {
    /// Bits a second, 300 and more.
    pub baud: u32,
    /// Number of data bits: 7 or 8.
    pub data_bits: u8,
    /// Parity of the characters.
    pub parity: Parity,
    /// Number of stop bits: 1 or 2.
    pub stop_bits: u8,
}

/// The text that could not be read as a character format.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{0}` is not a character format; write data bits 7 or 8, parity N, E or O, stop bits 1 or 2, such as 8N1")]
pub struct BadFormat(pub String);

impl LineFormat {
    /// Represents a network without a serial line: the time of a character is negligible.
    pub const NETWORK: LineFormat = LineFormat {
        baud: 100_000_000,
        data_bits: 8,
        parity: Parity::None,
        stop_bits: 1,
    };

    /// The format `text` (such as `8N1`) at `baud`.
    ///
    /// # Errors
    /// When the text is not data bits (7, 8), parity (N, E, O) and stop bits (1, 2).
    pub fn new(baud: u32, text: &str) -> Result<LineFormat, BadFormat> {
        let bad = || BadFormat(text.to_string());
        let mut chars = text.chars();
        let (Some(data), Some(parity), Some(stop), None) = (chars.next(), chars.next(), chars.next(), chars.next())
        else {
            return Err(bad());
        };
        let data_bits = match data {
            '7' => 7,
            '8' => 8,
            _ => return Err(bad()),
        };
        let parity = match parity.to_ascii_uppercase() {
            'N' => Parity::None,
            'E' => Parity::Even,
            'O' => Parity::Odd,
            _ => return Err(bad()),
        };
        let stop_bits = match stop {
            '1' => 1,
            '2' => 2,
            _ => return Err(bad()),
        };
        Ok(LineFormat {
            baud: baud.max(1),
            data_bits,
            parity,
            stop_bits,
        })
    }

    /// The character format as text: `8N1`.
    pub fn characters(&self) -> String {
        let parity = match self.parity {
            Parity::None => 'N',
            Parity::Even => 'E',
            Parity::Odd => 'O',
        };
        format!("{}{parity}{}", self.data_bits, self.stop_bits)
    }

    /// Bits of one character on the wire: start, data, parity, stop.
    pub fn bits_per_char(&self) -> u32 {
        1 + u32::from(self.data_bits) + u32::from(self.parity != Parity::None) + u32::from(self.stop_bits)
    }

    /// Wire time of `chars` characters.
    pub fn chars(&self, chars: usize) -> Duration {
        let bits = u64::from(self.bits_per_char()) * chars as u64;
        Duration::from_nanos(bits * 1_000_000_000 / u64::from(self.baud.max(1)))
    }

    /// Wire time of 3.5 characters at any baud rate.
    pub fn silence_chars(&self) -> Duration {
        self.chars(7) / 2
    }

    /// 3.5 characters, fixed at 1.75 ms above 19200 baud (Modbus over serial line, 2.5.1.1).
    pub fn silence_spec(&self) -> Duration {
        if self.baud > 19_200 {
            Duration::from_micros(1750)
        } else {
            self.silence_chars()
        }
    }
}

impl fmt::Display for LineFormat {
    /// `38400 8N1`; `Ethernet` for a network without a serial line.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if *self == LineFormat::NETWORK {
            return f.write_str("Ethernet");
        }
        write!(f, "{} {}", self.baud, self.characters())
    }
}

/// Silence that the master keeps before each request.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Silence {
    /// 3.5 characters, 1.75 ms above 19200 baud.
    #[default]
    Spec,
    /// Silence of 3.5 characters at any baud rate.
    Chars,
    /// Silence of a fixed time, for slow drives.
    Fixed(Duration),
}

impl Silence {
    /// The silence in time on a line of that format.
    pub fn on(self, format: &LineFormat) -> Duration {
        match self {
            Silence::Spec => format.silence_spec(),
            Silence::Chars => format.silence_chars(),
            Silence::Fixed(time) => time,
        }
    }
}

impl FromStr for Silence {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text {
            "spec" => Ok(Silence::Spec),
            "chars" => Ok(Silence::Chars),
            other => crate::duration::parse(other)
                .map(Silence::Fixed)
                .ok_or_else(|| format!("`{other}` is neither \"spec\" nor \"chars\" nor a duration such as \"2ms\"")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bits_and_times() {
        let f = LineFormat::new(38_400, "8N1").unwrap();
        assert_eq!(f.bits_per_char(), 10);
        assert_eq!(f.chars(8).as_nanos(), 2_083_333);
        assert_eq!(f.silence_chars().as_nanos(), 911_458);
        assert_eq!(f.silence_spec(), Duration::from_micros(1750));
        assert_eq!(LineFormat::new(9600, "8E1").unwrap().bits_per_char(), 11);
        assert_eq!(LineFormat::new(9600, "7N2").unwrap().bits_per_char(), 10);
        assert_eq!(LineFormat::new(19_200, "8N2").unwrap().silence_spec().as_micros(), 2005);
        assert_eq!(f.to_string(), "38400 8N1");
    }

    #[test]
    fn silences_of_the_reference() {
        // reference/drives.md, section 2, RTU timing, 11-bit characters.
        for (baud, tenths) in [
            (300, 1283),
            (600, 642),
            (1200, 321),
            (2400, 160),
            (4800, 80),
            (9600, 40),
            (19_200, 20),
        ] {
            let f = LineFormat::new(baud, "8E1").unwrap();
            let ms10 = (f.silence_chars().as_secs_f64() * 10_000.0).round() as i64;
            assert_eq!(ms10, tenths, "{baud}");
        }
    }

    #[test]
    fn bad_formats() {
        for bad in ["", "8", "8N", "8N3", "9N1", "8X1", "8N1 ", "N81"] {
            assert!(LineFormat::new(9600, bad).is_err(), "{bad}");
        }
    }
}
