//! Types of raw values and the order of their bytes.

/// How a value is encoded in registers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// A bit of a register (0 = least significant), or the bit itself if the table is one of bits.
    Bit {
        /// Number of the bit in its register.
        bit: u8,
        /// Whether the bit is inverted, so that 0 means true.
        invert: bool,
    },
    /// Neighbouring bits of a register as a number.
    Bits {
        /// Number of the least significant bit.
        first: u8,
        /// Number of bits, 1..=16.
        count: u8,
    },
    /// Signed 8 bit, two's complement: one byte of a register.
    I8 {
        /// Whether the value is in the high byte of the register; otherwise in the low one.
        high: bool,
    },
    /// Unsigned 16 bit.
    U16,
    /// Signed 16 bit, two's complement.
    I16,
    /// Unsigned 32 bit in two registers.
    U32,
    /// Signed 32 bit, two's complement, in two registers.
    I32,
    /// Unsigned 64 bit in four registers.
    U64,
    /// Signed 64 bit, two's complement, in four registers.
    I64,
    /// IEEE 754 single in two registers; NaN and infinities are not values.
    F32,
    /// IEEE 754 double in four registers; likewise.
    F64,
    /// Four binary-coded decimal digits in one register.
    Bcd16,
    /// Eight binary-coded decimals in two registers.
    Bcd32,
    /// Text, two characters a register, that ends at a NUL.
    Text {
        /// Number of registers of the text.
        registers: u8,
    },
}

/// Byte order of a 32-bit value on the wire; A is the most significant byte. With four registers, CDAB means the
/// least significant word first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Order {
    /// High byte and high word first, as in most Modbus devices.
    #[default]
    Abcd,
    /// The low word is first.
    Cdab,
    /// The low byte is first in each register.
    Badc,
    /// The low word and the low byte are first.
    Dcba,
}

impl Order {
    /// All byte orders.
    pub const ALL: [Order; 4] = [Order::Abcd, Order::Cdab, Order::Badc, Order::Dcba];

    /// The name of the order in profiles and output.
    pub fn name(self) -> &'static str {
        match self {
            Order::Abcd => "ABCD",
            Order::Cdab => "CDAB",
            Order::Badc => "BADC",
            Order::Dcba => "DCBA",
        }
    }

    pub(super) fn low_word_first(self) -> bool {
        matches!(self, Order::Cdab | Order::Dcba)
    }

    /// The word with its bytes in normal order, the high byte first.
    pub(super) fn word(self, word: u16) -> u16 {
        match self {
            Order::Abcd | Order::Cdab => word,
            Order::Badc | Order::Dcba => word.swap_bytes(),
        }
    }

    /// The bits of up to four registers.
    pub(super) fn join(self, words: &[u16]) -> Option<u64> {
        let join = |bits: u64, word: &u16| bits << 16 | u64::from(self.word(*word));
        match (words.len(), self.low_word_first()) {
            (1..=4, false) => Some(words.iter().fold(0, join)),
            (1..=4, true) => Some(words.iter().rev().fold(0, join)),
            _ => None,
        }
    }

    /// The registers of a value of that many.
    pub(super) fn split(self, bits: u64, registers: u16) -> Vec<u16> {
        let place = |register: u16| {
            if self.low_word_first() {
                register
            } else {
                registers - 1 - register
            }
        };
        let word = |register| self.word((bits >> (16 * u32::from(place(register)))) as u16);
        (0..registers.min(4)).map(word).collect()
    }

    /// The bytes of a text in their order.
    pub(in crate::drive) fn bytes(self, words: &[u16]) -> impl Iterator<Item = u8> {
        let last = words.len();
        let at = move |place: usize| if self.low_word_first() { last - 1 - place } else { place };
        let words = (0..last).filter_map(move |place| words.get(at(place)));
        words.flat_map(move |word| self.word(*word).to_be_bytes())
    }
}

impl Form {
    /// Types that a profile names, without the texts.
    pub const NAMED: [Form; 11] = [
        Form::I8 { high: false },
        Form::U16,
        Form::I16,
        Form::U32,
        Form::I32,
        Form::U64,
        Form::I64,
        Form::F32,
        Form::F64,
        Form::Bcd16,
        Form::Bcd32,
    ];

    /// Number of registers or bits of the value.
    pub fn items(self) -> u16 {
        match self {
            Form::U64 | Form::I64 | Form::F64 => 4,
            Form::U32 | Form::I32 | Form::F32 | Form::Bcd32 => 2,
            Form::Bit { .. } | Form::Bits { .. } | Form::I8 { .. } | Form::U16 | Form::I16 | Form::Bcd16 => 1,
            Form::Text { registers } => u16::from(registers),
        }
    }

    /// The name of the type in profiles and output.
    pub fn name(self) -> &'static str {
        match self {
            Form::Bit { .. } => "bit",
            Form::Bits { .. } => "bits",
            Form::I8 { .. } => "i8",
            Form::U16 => "u16",
            Form::I16 => "i16",
            Form::U32 => "u32",
            Form::I32 => "i32",
            Form::U64 => "u64",
            Form::I64 => "i64",
            Form::F32 => "f32",
            Form::F64 => "f64",
            Form::Bcd16 => "bcd16",
            Form::Bcd32 => "bcd32",
            Form::Text { .. } => "string",
        }
    }

    /// Whether the form's counts have a sign.
    pub fn is_signed(self) -> bool {
        matches!(self, Form::I8 { .. } | Form::I16 | Form::I32 | Form::I64)
    }

    /// Whether the form is a whole number of registers, so that `mask` can select bits of it.
    pub fn takes_mask(self) -> bool {
        matches!(self, Form::U16 | Form::U32 | Form::U64)
    }

    /// Number of bits in the form's registers.
    pub fn width(self) -> u32 {
        16 * u32::from(self.items())
    }

    /// The bits of a whole count that fits.
    pub(super) fn bits_of(self, count: i128) -> u64 {
        let all = u64::MAX
            .checked_shr(64u32.saturating_sub(self.width()))
            .unwrap_or(u64::MAX);
        count as u64 & all
    }

    /// Smallest and greatest number that the type can represent.
    pub(super) fn span(self) -> (f64, f64) {
        match self {
            Form::Bit { .. } => (0.0, 1.0),
            Form::Bits { count, .. } => (0.0, f64::from((1u32 << count.min(16)) - 1)),
            Form::I8 { .. } => (f64::from(i8::MIN), f64::from(i8::MAX)),
            Form::U16 => (0.0, f64::from(u16::MAX)),
            Form::I16 => (f64::from(i16::MIN), f64::from(i16::MAX)),
            Form::U32 => (0.0, f64::from(u32::MAX)),
            Form::I32 => (f64::from(i32::MIN), f64::from(i32::MAX)),
            Form::U64 => (0.0, u64::MAX as f64),
            Form::I64 => (i64::MIN as f64, i64::MAX as f64),
            Form::F32 => (f64::from(f32::MIN), f64::from(f32::MAX)),
            Form::F64 => (f64::MIN, f64::MAX),
            Form::Bcd16 => (0.0, 9999.0),
            Form::Bcd32 => (0.0, 99_999_999.0),
            Form::Text { .. } => (0.0, 0.0),
        }
    }
}
