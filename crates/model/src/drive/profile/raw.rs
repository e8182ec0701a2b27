//! Raw values: address, format and conversion to engineering units.

mod contents;
mod form;

use super::super::model::{Kind, Text, Value, tidy, tidy_product};
use crate::drive::PointIndex;
use drivegate_proto::Table;

pub use contents::Part;
pub use form::{Form, Order};

/// Whole numbers up to here are exact as a number with a fraction.
const EXACT: u64 = 1 << 53;
/// Maximum number of registers of one value.
pub const MOST_REGISTERS: usize = 32;
/// Powers of ten by which another register may scale a value; no unit of measure needs more.
const LEAST_POWER: i32 = -20;
const MOST_POWER: i32 = 20;

/// Address and format of a raw value.
#[derive(Debug, Clone, PartialEq)]
pub struct Raw {
    /// Modbus table of the value.
    pub table: Table,
    /// First PDU address.
    pub address: u16,
    /// Form in which the value is encoded.
    pub form: Form,
    /// Order of the bytes over all registers of the value.
    pub order: Order,
    /// Selected bits, shifted down to bit 0.
    pub mask: Option<u64>,
    /// The count that means true, for a point with the values true and false.
    pub equals: Option<Equals>,
    /// Register contents, before `mask`, that mean "no value".
    pub invalid: Vec<u64>,
    /// Engineering value of one count.
    pub scale: f64,
    /// Engineering value of raw 0.
    pub offset: f64,
    /// Index of the point whose value is the power of ten by which a count is multiplied.
    pub scale_from: Option<PointIndex>,
    /// Indices of the points whose values multiply this one, such as the ratio of a transformer.
    pub factor_from: Vec<PointIndex>,
}

/// The number for which a point is true, or false.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Equals {
    /// The count that means true.
    pub count: i64,
    /// Whether this number means false and any other number means true.
    pub invert: bool,
}

/// Why a value cannot be written to a point.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Unwritable {
    /// The value does not fit the type of the register.
    #[error("{value} does not fit the register, which holds {least} to {most}")]
    Type {
        /// The requested value.
        value: f64,
        /// Minimum value of the register in engineering units.
        least: f64,
        /// Greatest value of the register in engineering units.
        most: f64,
    },
    /// A whole number that a command does not carry to the last digit.
    #[error("{value} is beyond 2^53, where a number of a command is no longer exact")]
    Rounded {
        /// The requested value.
        value: f64,
    },
    /// The drive would take the value for "no value".
    #[error("{value} is a raw value that means \"not available\"")]
    Invalid {
        /// The requested value.
        value: f64,
    },
    /// The value cannot be converted back to its registers.
    #[error("the point is read-only")]
    ReadOnly,
}

/// The value of registers before scaling.
enum Count {
    Whole(i128),
    Real(f64),
}

impl Raw {
    /// A value in the most common form: a register, or one bit of a bit table.
    pub fn plain(table: Table, address: u16, form: Form) -> Raw {
        Raw {
            table,
            address,
            form,
            order: Order::Abcd,
            mask: None,
            equals: None,
            invalid: Vec::new(),
            scale: 1.0,
            offset: 0.0,
            scale_from: None,
            factor_from: Vec::new(),
        }
    }

    /// Whether the values are true and false.
    pub fn is_bool(&self) -> bool {
        self.equals.is_some() || matches!(self.form, Form::Bit { .. })
    }

    /// Type, order and mask of the value, as in profiles and output.
    pub fn type_text(&self) -> String {
        let mut text = match self.form {
            Form::Text { registers } => format!("string:{registers}"),
            Form::I8 { high: true } => "i8 high byte".to_string(),
            Form::I8 { high: false } => "i8 low byte".to_string(),
            form => form.name().to_string(),
        };
        match (self.form.items(), self.order) {
            (2, Order::Abcd) if !matches!(self.form, Form::Text { .. }) => text += " high-first",
            (2, Order::Cdab) => text += " low-first",
            (_, Order::Abcd) => {}
            (_, order) => text = format!("{text} {}", order.name()),
        }
        if let Some(mask) = self.mask {
            text += &format!(" mask {mask:#06x}");
        }
        if let Some(Equals { count, invert }) = self.equals {
            text += &format!(" {} {count}", if invert { "not" } else { "=" });
        }
        text
    }

    /// Smallest and greatest whole number, after `mask`.
    pub(in crate::drive) fn counts(&self) -> (i128, i128) {
        let most = |mask: u64| (0, i128::from(mask.checked_shr(mask.trailing_zeros()).unwrap_or(0)));
        match (self.mask, self.form) {
            (Some(mask), _) => most(mask),
            (None, Form::Bits { count, .. }) => (0, i128::from(low_mask(count))),
            (None, Form::I8 { .. }) => (i128::from(i8::MIN), i128::from(i8::MAX)),
            (None, Form::Bcd16) => (0, 9999),
            (None, Form::Bcd32) => (0, 99_999_999),
            (None, form) if form.is_signed() => (-(1 << (form.width() - 1)), (1 << (form.width() - 1)) - 1),
            (None, form) => most(u64::MAX.checked_shr(64u32.saturating_sub(form.width())).unwrap_or(0)),
        }
    }

    /// Whether a value cannot be converted back to its registers.
    pub(in crate::drive) fn is_only_read(&self) -> bool {
        let derived = self.equals.is_some() || self.mask.is_some() || self.scaled_by().next().is_some();
        // A single byte could only be written together with the other byte of its register.
        derived || matches!(self.form, Form::Text { .. } | Form::I8 { .. })
    }

    /// The points by which the value of this one is scaled.
    pub fn scaled_by(&self) -> impl Iterator<Item = PointIndex> {
        self.scale_from.into_iter().chain(self.factor_from.iter().copied())
    }

    /// Whether the values are codes or 64-bit whole numbers, which are shown unchanged.
    pub(in crate::drive) fn is_code(&self) -> bool {
        let long = matches!(self.form, Form::U64 | Form::I64);
        matches!(self.form, Form::Bits { .. }) || self.is_unscaled() && (long || self.mask.is_some())
    }

    /// Whether a count is the value: nothing is multiplied or added.
    pub fn is_unscaled(&self) -> bool {
        self.scale == 1.0 && self.offset == 0.0 && self.scaled_by().next().is_none()
    }

    /// Whether the value is in a single register, and no other point scales it.
    pub fn is_one_word(&self) -> bool {
        self.form.items() == 1 && self.scale_from.is_none() && self.factor_from.is_empty()
    }

    /// The value in `words`, the registers (or bits as 0 and 1) from `address` on; `None` if there are too few or
    /// they contain no value. A value with `scale_from` or `factor_from` is decoded by [`Raw::decode_scaled`].
    pub fn decode(&self, words: &[u16], kind: Kind) -> Option<Value> {
        match self.scaled_by().next() {
            Some(_) => None,
            None => self.decode_scaled(words, kind, 0),
        }
    }

    /// Decodes a value whose count is multiplied by a power of ten.
    pub fn decode_scaled(&self, words: &[u16], kind: Kind, power: i64) -> Option<Value> {
        let words = words.get(..usize::from(self.form.items()))?;
        if let Form::Text { .. } = self.form {
            return Text::of_registers(words, self.order).map(Value::Text);
        }
        let bits = self.order.join(words)?;
        if self.invalid.contains(&bits) {
            return None;
        }
        let count = self.count(bits)?;
        match (count, self.equals) {
            (Count::Whole(whole), Some(Equals { count, invert })) => {
                Some(Value::Bool((whole == i128::from(count)) != invert))
            }
            (Count::Whole(whole), None) if matches!(self.form, Form::Bit { .. }) => Some(Value::Bool(whole == 1)),
            (Count::Whole(whole), None) if kind == Kind::Integer => whole_value(whole),
            (Count::Whole(whole), None) => {
                let whole = i64::try_from(whole)
                    .ok()
                    .filter(|whole| whole.unsigned_abs() <= EXACT)?;
                self.scaled(whole as f64, power)
            }
            (Count::Real(real), _) if kind == Kind::Integer => Some(Value::Integer(real as i64)),
            (Count::Real(real), _) => self.scaled(real, power),
        }
    }

    /// The count in the bits of the registers.
    fn count(&self, bits: u64) -> Option<Count> {
        let bits = match self.mask {
            Some(0) => 0,
            Some(mask) => (bits & mask) >> mask.trailing_zeros(),
            None => bits,
        };
        let whole = |value: i128| Some(Count::Whole(value));
        match self.form {
            Form::Bit { bit, invert } => whole(i128::from(((bits >> bit) & 1 == 1) != invert)),
            Form::Bits { first, count } => whole(i128::from((bits >> first) & u64::from(low_mask(count)))),
            Form::U16 | Form::U32 | Form::U64 => whole(i128::from(bits)),
            Form::I8 { high } => whole(i128::from((bits >> if high { 8 } else { 0 }) as u8 as i8)),
            Form::I16 => whole(i128::from(bits as u16 as i16)),
            Form::I32 => whole(i128::from(bits as u32 as i32)),
            Form::I64 => whole(i128::from(bits as i64)),
            Form::Bcd16 | Form::Bcd32 => whole(i128::from(of_digits(bits)?)),
            Form::F32 => short(f32::from_bits(bits as u32)).map(Count::Real),
            Form::F64 => Some(f64::from_bits(bits))
                .filter(|real| real.is_finite())
                .map(Count::Real),
            Form::Text { .. } => None,
        }
    }

    /// The value multiplied by the values of the points of `factor_from`.
    pub fn multiplied(value: Value, factors: impl Iterator<Item = f64>) -> Option<Value> {
        let product = tidy_product(factors.fold(value.as_f64(), |product, factor| product * factor));
        product.is_finite().then_some(Value::Number(product))
    }

    fn scaled(&self, count: f64, power: i64) -> Option<Value> {
        // A division by a power of ten is rounded once, a multiplication by a fraction of it twice.
        let count = match i32::try_from(power) {
            Ok(0) => count,
            Ok(power @ 1..=MOST_POWER) => count * 10f64.powi(power),
            Ok(power @ LEAST_POWER..0) => count / 10f64.powi(-power),
            _ => return None,
        };
        let scaled = count * self.scale;
        let value = match (self.offset == 0.0, self.form) {
            (true, Form::F64) if self.scale == 1.0 && power == 0 => scaled,
            (true, _) => tidy_product(scaled),
            (false, _) => tidy(scaled + self.offset),
        };
        value.is_finite().then_some(Value::Number(value))
    }

    /// The registers for `value`; bits are merged into `old`.
    ///
    /// # Errors
    /// If the value does not fit the register's type. Nothing is clamped.
    pub fn encode(&self, value: Value, old: u16) -> Result<Vec<u16>, Unwritable> {
        if self.is_only_read() {
            return Err(Unwritable::ReadOnly);
        }
        if let Form::Bit { bit, invert } = self.form {
            let set = value.as_bool() != invert;
            return Ok(vec![if set { old | (1 << bit) } else { old & !(1 << bit) }]);
        }
        let (least, most) = self.form.span();
        let exact = (value.as_f64() - self.offset) / self.scale;
        let real = matches!(self.form, Form::F32 | Form::F64);
        let count = if real { exact } else { exact.round() };
        if !(least..=most).contains(&count) {
            let unit = |c: f64| tidy(c * self.scale + self.offset);
            return Err(Unwritable::Type {
                value: value.as_f64(),
                least: unit(least),
                most: unit(most),
            });
        }
        let bits = match (self.form, value) {
            (Form::Bits { first, count: bits }, _) => {
                let (mask, count) = (low_mask(bits), count as u16);
                return Ok(vec![(old & !(mask << first)) | ((count & mask) << first)]);
            }
            (Form::F32, _) => u64::from((count as f32).to_bits()),
            (Form::F64, _) => count.to_bits(),
            (Form::Bcd16 | Form::Bcd32, _) => to_digits(count as u64),
            (_, Value::Integer(whole)) if self.is_unscaled() => self.form.bits_of(i128::from(whole)),
            (_, Value::Unsigned(whole)) if self.is_unscaled() => self.form.bits_of(i128::from(whole)),
            _ if count.abs() > EXACT as f64 => return Err(Unwritable::Rounded { value: value.as_f64() }),
            _ => self.form.bits_of(count as i128),
        };
        if self.invalid.contains(&bits) {
            return Err(Unwritable::Invalid { value: value.as_f64() });
        }
        Ok(self.order.split(bits, self.form.items()))
    }

    /// The addresses of the value's registers or bits.
    pub fn addresses(&self) -> impl Iterator<Item = u16> + Clone + use<> {
        let start = self.address;
        (0..self.form.items()).filter_map(move |item| start.checked_add(item))
    }

    /// Whether the value includes this register or bit.
    pub fn covers(&self, table: Table, address: u16) -> bool {
        self.table == table
            && address
                .checked_sub(self.address)
                .is_some_and(|item| item < self.form.items())
    }
}

fn low_mask(bits: u8) -> u16 {
    ((1u32 << bits.min(16)) - 1) as u16
}

/// The number in its most compact type.
fn whole_value(whole: i128) -> Option<Value> {
    let signed = i64::try_from(whole).map(Value::Integer);
    signed.or_else(|_| u64::try_from(whole).map(Value::Unsigned)).ok()
}

/// Decodes binary-coded decimals, four bits for each digit; `None` if a digit is above 9.
fn of_digits(bits: u64) -> Option<u64> {
    (0..8).rev().try_fold(0, |number, place| {
        let digit = (bits >> (4 * place)) & 0xF;
        (digit <= 9).then_some(number * 10 + digit)
    })
}

fn to_digits(number: u64) -> u64 {
    let digit = |place: u32| (number / 10u64.pow(place) % 10) << (4 * place);
    (0..8).map(digit).sum()
}

/// A single-precision float as its shortest decimal: 0.1 and not 0.10000000149; `None` for NaN and infinities.
fn short(single: f32) -> Option<f64> {
    single
        .is_finite()
        .then(|| single.to_string().parse().unwrap_or(f64::from(single)))
}

#[cfg(test)]
mod tests;
