//! The types a value can be read as, and the notation of durations and sizes.

use std::path::PathBuf;
use std::time::Duration;

use drivegate_proto::duration;

use super::{Finding, Node, Raw};

/// Why a value is invalid: contains the value or its type, and the correction.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ValueError {
    /// A number or a truth value in quotes: the text, and the expected type.
    #[error("`\"{0}\"` is a string")]
    Quoted(String, &'static str),
    /// Another text: the text, and the expected type.
    #[error("`{0}` is not {1}")]
    Text(String, &'static str),
    /// One text instead of a list: the text, and the expected type.
    #[error("`{0}` is not a list")]
    NotAList(String, String),
    /// A number with a decimal point instead of a whole one: the number, and the expected type.
    #[error("`{0:?}` has a decimal point")]
    Fraction(f64, &'static str),
    /// A value of another type: that type, and the expected one.
    #[error("wrong type: {0}")]
    Type(&'static str, String),
    /// A whole number out of the range of its type: the number, and the expected type.
    #[error("{0} is out of range")]
    OutOfRange(i64, &'static str),
    /// Infinity or NaN: the number, and the expected type.
    #[error("{0} is not a finite number")]
    NotFinite(f64, &'static str),
    /// A text that is no duration with its unit, such as `10ms` or `2min`.
    #[error("`{0}` is not a duration")]
    Duration(String),
    /// A text that is no whole number of `B`, `KiB`, `MiB` or `GiB`.
    #[error("`{0}` is not a size")]
    Size(String),
}

impl From<ValueError> for Finding {
    fn from(error: ValueError) -> Finding {
        use ValueError::{Duration, Fraction, NotAList, NotFinite, OutOfRange, Quoted, Size, Text, Type};
        let remedy = match &error {
            Quoted(_, wanted) => format!("write {wanted}, without quotes"),
            Text(_, wanted) | OutOfRange(_, wanted) | NotFinite(_, wanted) => format!("write {wanted}"),
            Fraction(value, wanted) if value.fract() == 0.0 => format!("write {wanted}, such as {value:.0}"),
            Fraction(_, wanted) => format!("write {wanted}"),
            NotAList(_, wanted) | Type(_, wanted) => format!("write {wanted}"),
            Duration(_) => "write a number with its unit, such as 10ms, 1.5s or 2min".to_string(),
            Size(_) => "write a whole number with B, KiB, MiB or GiB, such as \"64MiB\"".to_string(),
        };
        Finding::new(error.to_string(), remedy)
    }
}

/// A type that a value can be read as.
pub trait FromNode: Sized {
    /// The expected type, for messages: `a string`.
    const WANTED: &'static str;

    /// Converts the node to a value.
    ///
    /// # Errors
    /// If the value has another type, another form, or is out of range.
    fn from_node(node: &Node) -> Result<Self, ValueError>;
}

fn wrong<T: FromNode>(node: &Node) -> ValueError {
    let is_quoted = |text: &str| text.parse::<f64>().is_ok() || text.parse::<bool>().is_ok();
    match &node.value {
        Raw::Text(text) if is_quoted(text) && !T::WANTED.contains("quotes") => {
            ValueError::Quoted(text.clone(), T::WANTED)
        }
        Raw::Float(value) if T::WANTED.contains("whole") => ValueError::Fraction(*value, T::WANTED),
        Raw::Env(text) | Raw::Text(text) => ValueError::Text(text.clone(), T::WANTED),
        other => ValueError::Type(other.kind(), T::WANTED.to_string()),
    }
}

impl FromNode for String {
    const WANTED: &'static str = "a string in quotes";

    fn from_node(node: &Node) -> Result<Self, ValueError> {
        match &node.value {
            Raw::Text(text) | Raw::Env(text) => Ok(text.clone()),
            _ => Err(wrong::<Self>(node)),
        }
    }
}

impl FromNode for PathBuf {
    const WANTED: &'static str = "a path in quotes";

    fn from_node(node: &Node) -> Result<Self, ValueError> {
        String::from_node(node)
            .map(PathBuf::from)
            .map_err(|_| wrong::<Self>(node))
    }
}

impl FromNode for bool {
    const WANTED: &'static str = "true or false";

    fn from_node(node: &Node) -> Result<Self, ValueError> {
        match &node.value {
            Raw::Bool(value) => Ok(*value),
            Raw::Env(text) => text.parse().map_err(|_| wrong::<Self>(node)),
            _ => Err(wrong::<Self>(node)),
        }
    }
}

impl FromNode for i64 {
    const WANTED: &'static str = "a whole number";

    fn from_node(node: &Node) -> Result<Self, ValueError> {
        match &node.value {
            Raw::Integer(value) => Ok(*value),
            Raw::Env(text) => text.parse().map_err(|_| wrong::<Self>(node)),
            _ => Err(wrong::<Self>(node)),
        }
    }
}

macro_rules! from_integer {
    ($($type:ty: $wanted:literal),*) => {$(
        impl FromNode for $type {
            const WANTED: &'static str = $wanted;

            fn from_node(node: &Node) -> Result<Self, ValueError> {
                let value = i64::from_node(node).map_err(|_| wrong::<Self>(node))?;
                <$type>::try_from(value)
                    .map_err(|_| ValueError::OutOfRange(value, Self::WANTED))
            }
        }
    )*};
}

from_integer!(u8: "a whole number from 0 to 255", u16: "a whole number from 0 to 65535",
    u32: "a whole number from 0 to 4294967295", usize: "a whole number, not negative");

impl FromNode for f64 {
    const WANTED: &'static str = "a number";

    fn from_node(node: &Node) -> Result<Self, ValueError> {
        let value = match &node.value {
            Raw::Float(value) => *value,
            Raw::Integer(value) => *value as f64,
            Raw::Env(text) => text.parse().map_err(|_| wrong::<Self>(node))?,
            _ => return Err(wrong::<Self>(node)),
        };
        if value.is_finite() {
            Ok(value)
        } else {
            Err(ValueError::NotFinite(value, Self::WANTED))
        }
    }
}

impl FromNode for Duration {
    const WANTED: &'static str = "a duration in quotes, such as \"10ms\", \"1.5s\" or \"2min\"";

    fn from_node(node: &Node) -> Result<Self, ValueError> {
        match &node.value {
            Raw::Text(text) | Raw::Env(text) => parse_duration(text),
            _ => Err(wrong::<Self>(node)),
        }
    }
}

impl<T: FromNode> FromNode for Vec<T> {
    const WANTED: &'static str = "a list in brackets";

    fn from_node(node: &Node) -> Result<Self, ValueError> {
        match &node.value {
            Raw::Array(items) => items.iter().map(T::from_node).collect(),
            Raw::Env(text) => text
                .split(',')
                .map(|item| {
                    let value = Raw::Env(item.trim().to_string());
                    T::from_node(&Node {
                        value,
                        line: node.line,
                        env: node.env.clone(),
                    })
                })
                .collect(),
            Raw::Text(text) => Err(ValueError::NotAList(text.clone(), each::<T>())),
            other => Err(ValueError::Type(other.kind(), each::<T>())),
        }
    }
}

/// The expected kind of list, for messages.
fn each<T: FromNode>() -> String {
    format!("{}, each {}", Vec::<T>::WANTED, T::WANTED)
}

/// Parses a value with [`duration::parse`].
///
/// # Errors
/// If the text is not a duration.
pub fn parse_duration(text: &str) -> Result<Duration, ValueError> {
    duration::parse(text).ok_or_else(|| ValueError::Duration(text.to_string()))
}

/// A size in bytes: a number and one of `B`, `KiB`, `MiB`, `GiB`.
///
/// # Errors
/// If the text is not a size.
pub fn parse_size(text: &str) -> Result<u64, ValueError> {
    let bad = || ValueError::Size(text.to_string());
    let trimmed = text.trim();
    let digits = trimmed.find(|c: char| !c.is_ascii_digit()).ok_or_else(bad)?;
    let (number, unit) = trimmed.split_at(digits);
    let number: u64 = number.parse().map_err(|_| bad())?;
    let shift = match unit.trim_start() {
        "B" => 0,
        "KiB" => 10,
        "MiB" => 20,
        "GiB" => 30,
        _ => return Err(bad()),
    };
    number
        .checked_shl(shift)
        .filter(|v| v >> shift == number)
        .ok_or_else(bad)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes() {
        assert_eq!(parse_size("64MiB"), Ok(64 << 20));
        for bad in ["", "64", "64MB", "-1B", "99999999999999999GiB"] {
            assert!(parse_size(bad).is_err(), "{bad}");
        }
    }
}
