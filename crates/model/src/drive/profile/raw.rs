//! Raw values: address, format and conversion to engineering units.

use super::super::model::{Kind, Value, tidy, tidy_product};
use crate::codec::Table;

/// Address and format of a raw value.
#[derive(Debug, Clone, PartialEq)]
pub struct Raw {
    /// Table.
    pub table: Table,
    /// First PDU address.
    pub address: u16,
    /// Form.
    pub form: Form,
    /// Engineering value of one count.
    pub scale: f64,
    /// Engineering value of raw 0.
    pub offset: f64,
}

/// Form of a raw value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// One bit of a register (0 = least significant), or the bit itself in a bit table.
    Bit {
        /// Number of the bit.
        bit: u8,
        /// 0 means true.
        invert: bool,
    },
    /// Neighbouring bits of a register as a number.
    Bits {
        /// Number of the least significant one.
        first: u8,
        /// How many, 2..=16.
        count: u8,
    },
    /// Unsigned 16 bit.
    U16,
    /// Signed 16 bit, two's complement.
    I16,
    /// Unsigned 32 bit in two registers.
    U32(WordOrder),
    /// Signed 32 bit, two's complement, in two registers.
    I32(WordOrder),
    /// IEEE 754 single in two registers; NaN and infinities are not values.
    F32(WordOrder),
}

/// Which register of two comes first.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WordOrder {
    /// The more significant one, as Modbus devices mostly do.
    HighFirst,
    /// The less significant one.
    LowFirst,
}

impl WordOrder {
    /// The name in profiles and output.
    pub fn name(self) -> &'static str {
        match self {
            WordOrder::HighFirst => "high-first",
            WordOrder::LowFirst => "low-first",
        }
    }

    fn join(self, words: &[u16]) -> Option<u32> {
        let (&first, &second) = (words.first()?, words.get(1)?);
        let (high, low) = match self {
            WordOrder::HighFirst => (first, second),
            WordOrder::LowFirst => (second, first),
        };
        Some(u32::from(high) << 16 | u32::from(low))
    }

    fn split(self, both: u32) -> Vec<u16> {
        let (high, low) = ((both >> 16) as u16, both as u16);
        match self {
            WordOrder::HighFirst => vec![high, low],
            WordOrder::LowFirst => vec![low, high],
        }
    }
}

impl Form {
    /// Number of registers or bits of the value.
    pub fn items(self) -> u16 {
        match self {
            Form::U32(_) | Form::I32(_) | Form::F32(_) => 2,
            Form::Bit { .. } | Form::Bits { .. } | Form::U16 | Form::I16 => 1,
        }
    }

    /// The name of the type in profiles and output.
    pub fn name(self) -> &'static str {
        match self {
            Form::Bit { .. } => "bit",
            Form::Bits { .. } => "bits",
            Form::U16 => "u16",
            Form::I16 => "i16",
            Form::U32(_) => "u32",
            Form::I32(_) => "i32",
            Form::F32(_) => "f32",
        }
    }

    /// Which register of two comes first, if there are two.
    pub fn word_order(self) -> Option<WordOrder> {
        match self {
            Form::U32(order) | Form::I32(order) | Form::F32(order) => Some(order),
            _ => None,
        }
    }

    /// Least and greatest count.
    fn span(self) -> (f64, f64) {
        match self {
            Form::Bit { .. } => (0.0, 1.0),
            Form::Bits { count, .. } => (0.0, f64::from((1u32 << count.min(16)) - 1)),
            Form::U16 => (0.0, f64::from(u16::MAX)),
            Form::I16 => (f64::from(i16::MIN), f64::from(i16::MAX)),
            Form::U32(_) => (0.0, f64::from(u32::MAX)),
            Form::I32(_) => (f64::from(i32::MIN), f64::from(i32::MAX)),
            Form::F32(_) => (f64::from(f32::MIN), f64::from(f32::MAX)),
        }
    }
}

/// Why a value cannot be written to a point.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Unwritable {
    /// The value does not fit the type of the register.
    #[error("{value} does not fit the register, which holds {least} to {most}")]
    Type {
        /// Value asked for.
        value: f64,
        /// Least value of the register in engineering units.
        least: f64,
        /// Greatest value of the register in engineering units.
        most: f64,
    },
}

impl Raw {
    /// The value in `words`, the registers (or bits as 0 and 1) from `address` on; `None` if there are too few of them,
    /// or a float is not a finite number.
    pub fn decode(&self, words: &[u16], kind: Kind) -> Option<Value> {
        let &word = words.first()?;
        let count = match self.form {
            Form::Bit { bit, invert } => return Some(Value::Bool(((word >> bit) & 1 == 1) != invert)),
            Form::Bits { first, count } => f64::from((word >> first) & mask(count)),
            Form::U16 => f64::from(word),
            Form::I16 => f64::from(word as i16),
            Form::U32(order) => f64::from(order.join(words)?),
            Form::I32(order) => f64::from(order.join(words)? as i32),
            Form::F32(order) => short(f32::from_bits(order.join(words)?))?,
        };
        if kind == Kind::Integer {
            return Some(Value::Integer(count as i64));
        }
        let scaled = count * self.scale;
        Some(Value::Number(match self.offset == 0.0 {
            true => tidy_product(scaled),
            false => tidy(scaled + self.offset),
        }))
    }

    /// The registers for `value`; bits are merged into `old`.
    ///
    /// # Errors
    /// The value does not fit the register's type. Nothing is clamped.
    pub fn encode(&self, value: Value, old: u16) -> Result<Vec<u16>, Unwritable> {
        if let Form::Bit { bit, invert } = self.form {
            let set = value.as_bool() != invert;
            return Ok(vec![if set { old | (1 << bit) } else { old & !(1 << bit) }]);
        }
        let (least, most) = self.form.span();
        let exact = (value.as_f64() - self.offset) / self.scale;
        let count = if matches!(self.form, Form::F32(_)) {
            exact
        } else {
            exact.round()
        };
        if !(least..=most).contains(&count) {
            let unit = |c: f64| tidy(c * self.scale + self.offset);
            return Err(Unwritable::Type {
                value: value.as_f64(),
                least: unit(least),
                most: unit(most),
            });
        }
        Ok(match self.form {
            Form::Bits { first, count: bits } => {
                vec![(old & !(mask(bits) << first)) | ((count as u16 & mask(bits)) << first)]
            }
            Form::U32(order) => order.split(count as u32),
            Form::I32(order) => order.split(count as i32 as u32),
            Form::F32(order) => order.split((count as f32).to_bits()),
            Form::Bit { .. } | Form::U16 | Form::I16 => vec![count as i32 as u16],
        })
    }

    /// The addresses of its registers or bits.
    pub fn addresses(&self) -> impl Iterator<Item = u16> + Clone + use<> {
        let start = self.address;
        (0..self.form.items()).filter_map(move |item| start.checked_add(item))
    }

    /// Whether it includes that register or bit.
    pub fn covers(&self, table: Table, address: u16) -> bool {
        self.table == table
            && address
                .checked_sub(self.address)
                .is_some_and(|item| item < self.form.items())
    }
}

fn mask(bits: u8) -> u16 {
    ((1u32 << bits.min(16)) - 1) as u16
}

/// A single as its shortest decimal: 0.1 and not 0.10000000149; `None` for NaN and infinities.
fn short(single: f32) -> Option<f64> {
    single
        .is_finite()
        .then(|| single.to_string().parse().unwrap_or(f64::from(single)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn raw(form: Form, scale: f64) -> Raw {
        Raw {
            table: Table::Holding,
            address: 2002,
            form,
            scale,
            offset: 0.0,
        }
    }

    #[test]
    fn raw_to_engineering_and_back() {
        let reference = raw(Form::I16, 0.01);
        assert_eq!(reference.decode(&[5000], Kind::Number), Some(Value::Number(50.0)));
        assert_eq!(reference.decode(&[0xEC78], Kind::Number), Some(Value::Number(-50.0)));
        assert_eq!(reference.encode(Value::Number(-50.0), 0), Ok(vec![0xEC78]));
        assert_eq!(reference.encode(Value::Number(33.333), 0), Ok(vec![3333]));
        assert!(reference.encode(Value::Number(400.0), 0).is_err());
        assert!(reference.encode(Value::Number(f64::NAN), 0).is_err());
        assert_eq!(
            raw(Form::U16, 0.1).decode(&[12], Kind::Number),
            Some(Value::Number(1.2))
        );
        assert_eq!(raw(Form::U16, 1.0).decode(&[], Kind::Number), None);
    }

    #[test]
    fn bits_are_merged() {
        let run = raw(Form::Bit { bit: 0, invert: false }, 1.0);
        assert_eq!(run.encode(Value::Bool(true), 0x0102), Ok(vec![0x0103]));
        assert_eq!(run.encode(Value::Bool(false), 0x0103), Ok(vec![0x0102]));
        let inverted = raw(Form::Bit { bit: 8, invert: true }, 1.0);
        assert_eq!(inverted.decode(&[0x0100], Kind::Bool), Some(Value::Bool(false)));
        assert_eq!(inverted.encode(Value::Bool(true), 0xFFFF), Ok(vec![0xFEFF]));
    }

    #[test]
    fn wide_forms() {
        use WordOrder::{HighFirst, LowFirst};
        let float = raw(Form::F32(HighFirst), 1.0);
        assert_eq!(float.decode(&[0x4248, 0], Kind::Number), Some(Value::Number(50.0)));
        assert_eq!(float.decode(&[0x3DCC, 0xCCCD], Kind::Number), Some(Value::Number(0.1)));
        for small in [4.2e-7_f32, -1.5e-20, f32::MIN_POSITIVE, 16_777_215.0] {
            let bits = small.to_bits();
            let words = [(bits >> 16) as u16, bits as u16];
            let wanted = small.to_string().parse().map(Value::Number).ok();
            assert_eq!(float.decode(&words, Kind::Number), wanted, "{small}");
        }
        assert_eq!(
            raw(Form::F32(LowFirst), 1.0).decode(&[0, 0x4248], Kind::Number),
            Some(Value::Number(50.0))
        );
        for no_number in [0x7FC0, 0x7F80, 0xFF80] {
            assert_eq!(float.decode(&[no_number, 0], Kind::Number), None);
        }
        assert_eq!(float.decode(&[0x4248], Kind::Number), None, "half of it is nothing");
        assert_eq!(float.encode(Value::Number(50.0), 0), Ok(vec![0x4248, 0]));
        assert!(float.encode(Value::Number(1e39), 0).is_err());
        assert!(float.encode(Value::Number(f64::NAN), 0).is_err());
        let signed = raw(Form::I32(HighFirst), 0.1);
        assert_eq!(
            signed.decode(&[0xFFFF, 0xFFF6], Kind::Number),
            Some(Value::Number(-1.0))
        );
        assert_eq!(signed.encode(Value::Number(-1.0), 0), Ok(vec![0xFFFF, 0xFFF6]));
        let unsigned = raw(Form::U32(LowFirst), 1.0);
        assert_eq!(unsigned.decode(&[1, 2], Kind::Number), Some(Value::Number(131_073.0)));
        assert_eq!(unsigned.encode(Value::Number(131_073.0), 0), Ok(vec![1, 2]));
    }

    #[test]
    fn bit_fields() {
        let field = raw(Form::Bits { first: 4, count: 3 }, 1.0);
        assert_eq!(field.decode(&[0xFF5F], Kind::Integer), Some(Value::Integer(5)));
        assert_eq!(field.encode(Value::Integer(2), 0xFFFF), Ok(vec![0xFFAF]));
        assert!(field.encode(Value::Integer(8), 0).is_err());
    }
}
