//! Register contents of a simulated drive for a value.

use super::{EXACT, Equals, Form, Raw, low_mask, to_digits};

/// Bits of a register or of an item of a bit table, with their values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Part {
    /// The bits that are meant.
    pub mask: u16,
    /// Values of the bits.
    pub value: u16,
}

impl Raw {
    /// The bits that make a point with states true, item by item, and whether they make it false instead; `None`
    /// for other points.
    pub fn state_parts(&self) -> Option<(Vec<Part>, bool)> {
        match (self.equals, self.form) {
            (Some(Equals { count, invert }), form) => {
                let mask = match (self.mask, form) {
                    (Some(mask), _) => mask,
                    (None, Form::Bits { first, count }) => u64::from(low_mask(count)) << first,
                    (None, form) => form.bits_of(-1),
                };
                let is = (form.bits_of(i128::from(count)) << mask.trailing_zeros().min(63)) & mask;
                Some((self.masked(mask, is), invert))
            }
            (None, Form::Bit { bit, invert }) => {
                let mask = 1u16 << bit.min(15);
                let value = if invert { 0 } else { mask };
                Some((vec![Part { mask, value }], false))
            }
            _ => None,
        }
    }

    /// Register contents for some bits of the whole value.
    pub fn masked(&self, mask: u64, is: u64) -> Vec<Part> {
        let items = self.form.items();
        let words = self
            .order
            .split(mask, items)
            .into_iter()
            .zip(self.order.split(is, items));
        words.map(|(mask, value)| Part { mask, value }).collect()
    }

    /// Register contents for a number, as close as the type allows, with the count divided by this power of ten.
    pub fn number_parts(&self, value: f64, power: i64) -> Vec<Part> {
        let power = i32::try_from(power)
            .unwrap_or(0)
            .clamp(super::LEAST_POWER, super::MOST_POWER);
        let exact = (value - self.offset) / self.scale / 10f64.powi(power);
        let exact = if exact.is_finite() { exact } else { 0.0 };
        let all = self.form.bits_of(-1);
        let whole = |count: i128| match (self.mask, self.form) {
            (Some(mask), _) => (mask, (count as u64) << mask.trailing_zeros().min(63) & mask),
            (None, Form::Bits { first, count: bits }) => {
                let mask = u64::from(low_mask(bits)) << first;
                (mask, (count as u64) << first & mask)
            }
            (None, Form::I8 { high }) => {
                let shift = if high { 8 } else { 0 };
                (0xFF << shift, u64::from(count as u8) << shift)
            }
            (None, Form::Bcd16 | Form::Bcd32) => (all, to_digits(count as u64)),
            (None, form) => (all, form.bits_of(count)),
        };
        let (mask, bits) = match self.form {
            Form::F32 => (all, u64::from((exact as f32).to_bits())),
            Form::F64 => (all, exact.to_bits()),
            Form::Text { .. } => return Vec::new(),
            _ => {
                let (least, most) = self.counts();
                let count = (exact.round().clamp(-(EXACT as f64), EXACT as f64) as i128).clamp(least, most);
                let near = [count, count - 1, count + 1].map(|count| whole(count.clamp(least, most)));
                let valid = near.into_iter().find(|(_, bits)| !self.invalid.contains(bits));
                valid.unwrap_or_else(|| whole(count))
            }
        };
        self.masked(mask, bits)
    }

    /// Register contents for a text.
    pub fn text_parts(&self, text: &str) -> Vec<Part> {
        let bytes = |register: u16| {
            let place = 2 * usize::from(register);
            let byte = |place: usize| text.as_bytes().get(place).copied().unwrap_or_default();
            u16::from_be_bytes([byte(place), byte(place + 1)])
        };
        let items = self.form.items();
        let mut words: Vec<u16> = (0..items).map(|register| self.order.word(bytes(register))).collect();
        if self.order.low_word_first() {
            words.reverse();
        }
        let part = |value| Part { mask: u16::MAX, value };
        words.into_iter().map(part).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::super::super::super::model::{Kind, Value};
    use super::super::Order;
    use super::*;
    use drivegate_proto::Table;

    fn words(parts: &[Part]) -> Vec<u16> {
        parts.iter().map(|part| part.value).collect()
    }

    /// A placed value reads back as placed, with any type and order.
    #[test]
    fn a_placed_number_is_read_as_it() {
        for form in Form::NAMED {
            for order in Order::ALL {
                let raw = Raw {
                    order,
                    scale: 0.1,
                    ..Raw::plain(Table::Holding, 7, form)
                };
                let value = match form {
                    Form::I8 { .. } => 12.3,
                    _ => 123.4,
                };
                let number = words(&raw.number_parts(value, 0));
                assert_eq!(
                    raw.decode(&number, Kind::Number),
                    Some(Value::Number(value)),
                    "{form:?} {order:?}"
                );
                let far = words(&raw.number_parts(-1e12, 0));
                assert!(raw.decode(&far, Kind::Number).is_some(), "{form:?} {order:?}");
            }
        }
        let scaled = Raw::plain(Table::Holding, 0, Form::I16);
        assert_eq!(words(&scaled.number_parts(23.4, -1)), [234]);
        let invalid = Raw {
            invalid: vec![0x7FFF],
            ..Raw::plain(Table::Holding, 0, Form::U16)
        };
        assert_eq!(words(&invalid.number_parts(32_767.0, 0)), [0x7FFE], "not \"no value\"");
    }

    #[test]
    fn parts_of_registers() {
        let masked = Raw {
            mask: Some(0x0FF0),
            ..Raw::plain(Table::Holding, 0, Form::U16)
        };
        let wanted = Part {
            mask: 0x0FF0,
            value: 0x0120,
        };
        assert_eq!(masked.number_parts(18.0, 0), [wanted]);
        let equals = Raw {
            equals: Some(Equals { count: 3, invert: true }),
            ..masked
        };
        let wanted = Part {
            mask: 0x0FF0,
            value: 0x0030,
        };
        assert_eq!(equals.state_parts(), Some((vec![wanted], true)));
        // A mask of neighbouring bits of one register is read as these bits.
        let neighbours = Raw {
            equals: Some(Equals {
                count: 3,
                invert: false,
            }),
            ..Raw::plain(Table::Holding, 0, Form::Bits { first: 3, count: 2 })
        };
        let wanted = Part {
            mask: 0x0018,
            value: 0x0018,
        };
        assert_eq!(neighbours.state_parts(), Some((vec![wanted], false)));
        let bits = Raw::plain(Table::Input, 0, Form::Bits { first: 4, count: 3 });
        let wanted = Part {
            mask: 0x0070,
            value: 0x0050,
        };
        assert_eq!(bits.number_parts(5.0, 0), [wanted]);
        for order in Order::ALL {
            let raw = Raw {
                order,
                ..Raw::plain(Table::Input, 0, Form::Text { registers: 3 })
            };
            let text = raw.decode(&words(&raw.text_parts("SIM-1")), Kind::Text);
            assert_eq!(
                text.map(|text| text.to_string()),
                Some("SIM-1".to_string()),
                "{order:?}"
            );
        }
    }
}
