use super::*;
use crate::drive::PointIndex;

fn raw(form: Form, scale: f64) -> Raw {
    Raw {
        scale,
        ..Raw::plain(Table::Holding, 2002, form)
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
    let low_first = |form| Raw {
        order: Order::Cdab,
        ..raw(form, 1.0)
    };
    let float = raw(Form::F32, 1.0);
    assert_eq!(float.decode(&[0x4248, 0], Kind::Number), Some(Value::Number(50.0)));
    assert_eq!(float.decode(&[0x3DCC, 0xCCCD], Kind::Number), Some(Value::Number(0.1)));
    for small in [4.2e-7_f32, -1.5e-20, f32::MIN_POSITIVE, 16_777_215.0] {
        let bits = small.to_bits();
        let words = [(bits >> 16) as u16, bits as u16];
        let wanted = small.to_string().parse().map(Value::Number).ok();
        assert_eq!(float.decode(&words, Kind::Number), wanted, "{small}");
    }
    assert_eq!(
        low_first(Form::F32).decode(&[0, 0x4248], Kind::Number),
        Some(Value::Number(50.0))
    );
    for no_number in [0x7FC0, 0x7F80, 0xFF80] {
        assert_eq!(float.decode(&[no_number, 0], Kind::Number), None);
    }
    assert_eq!(float.decode(&[0x4248], Kind::Number), None, "half of it is nothing");
    assert_eq!(float.encode(Value::Number(50.0), 0), Ok(vec![0x4248, 0]));
    assert!(float.encode(Value::Number(1e39), 0).is_err());
    assert!(float.encode(Value::Number(f64::NAN), 0).is_err());
    let signed = raw(Form::I32, 0.1);
    assert_eq!(
        signed.decode(&[0xFFFF, 0xFFF6], Kind::Number),
        Some(Value::Number(-1.0))
    );
    assert_eq!(signed.encode(Value::Number(-1.0), 0), Ok(vec![0xFFFF, 0xFFF6]));
    let unsigned = low_first(Form::U32);
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

#[test]
fn orders_count_over_all_words() {
    let of = |order, form| Raw {
        order,
        ..raw(form, 1.0)
    };
    let wide = [0x1122, 0x3344];
    for (order, value) in [
        (Order::Abcd, 0x1122_3344u32),
        (Order::Cdab, 0x3344_1122),
        (Order::Badc, 0x2211_4433),
        (Order::Dcba, 0x4433_2211),
    ] {
        let raw = of(order, Form::U32);
        let value = Value::Number(f64::from(value));
        assert_eq!(raw.decode(&wide, Kind::Number), Some(value), "{}", order.name());
        assert_eq!(raw.encode(value, 0), Ok(wide.to_vec()), "{}", order.name());
    }
    let long = [0x0011, 0x2233, 0x4455, 0x6677];
    for (order, value) in [
        (Order::Abcd, 0x0011_2233_4455_6677),
        (Order::Cdab, 0x6677_4455_2233_0011),
        (Order::Badc, 0x1100_3322_5544_7766),
        (Order::Dcba, 0x7766_5544_3322_1100),
    ] {
        let raw = of(order, Form::I64);
        assert_eq!(raw.decode(&long, Kind::Integer), Some(Value::Integer(value)));
        assert_eq!(raw.encode(Value::Integer(value), 0), Ok(long.to_vec()));
    }
    assert_eq!(
        of(Order::Badc, Form::I16).decode(&[0xFEFF], Kind::Number),
        Some(Value::Number(-2.0))
    );
}

#[test]
fn sixty_four_bits_are_never_rounded() {
    let big = (1u64 << 53) + 1;
    let words = |bits: u64| Order::Abcd.split(bits, 4);
    let plain = raw(Form::U64, 1.0);
    assert_eq!(
        plain.decode(&words(big), Kind::Integer),
        Some(Value::Integer(big as i64))
    );
    assert_eq!(
        plain.decode(&words(u64::MAX), Kind::Integer),
        Some(Value::Unsigned(u64::MAX))
    );
    assert_eq!(
        raw(Form::I64, 1.0).decode(&words(u64::MAX), Kind::Integer),
        Some(Value::Integer(-1))
    );
    let scaled = raw(Form::U64, 0.001);
    assert_eq!(
        scaled.decode(&words(1_234_567), Kind::Number),
        Some(Value::Number(1234.567))
    );
    assert_eq!(
        scaled.decode(&words(big), Kind::Number),
        None,
        "no figure is better than a rounded one"
    );
    assert!(plain.encode(Value::Number(9_007_199_254_740_994.0), 0).is_err());
    assert_eq!(plain.encode(Value::Unsigned(u64::MAX), 0), Ok(words(u64::MAX)));
    let double = raw(Form::F64, 1.0);
    let bits = 0.1f64.to_bits();
    assert_eq!(double.decode(&words(bits), Kind::Number), Some(Value::Number(0.1)));
    assert_eq!(double.encode(Value::Number(0.1), 0), Ok(words(bits)));
    assert_eq!(double.decode(&words(f64::NAN.to_bits()), Kind::Number), None);
}

#[test]
fn decimals_texts_and_what_is_not_available() {
    let bcd = raw(Form::Bcd16, 0.1);
    assert_eq!(bcd.decode(&[0x1234], Kind::Number), Some(Value::Number(123.4)));
    assert_eq!(bcd.decode(&[0x12A4], Kind::Number), None);
    assert_eq!(bcd.encode(Value::Number(987.6), 0), Ok(vec![0x9876]));
    assert!(bcd.encode(Value::Number(1000.0), 0).is_err());
    let wide = raw(Form::Bcd32, 1.0);
    assert_eq!(
        wide.decode(&[0x1234, 0x5678], Kind::Number),
        Some(Value::Number(12_345_678.0))
    );
    assert_eq!(wide.encode(Value::Number(12_345_678.0), 0), Ok(vec![0x1234, 0x5678]));

    let text = |words: &[u16], order| {
        let raw = Raw {
            order,
            ..raw(Form::Text { registers: 3 }, 1.0)
        };
        raw.decode(words, Kind::Text).map(|value| value.to_string())
    };
    assert_eq!(text(&[0x4142, 0x4300, 0x5858], Order::Abcd).as_deref(), Some("ABC"));
    assert_eq!(text(&[0x4241, 0x4443, 0x4645], Order::Badc).as_deref(), Some("ABCDEF"));
    assert_eq!(text(&[0x4100, 0, 0], Order::Abcd).as_deref(), Some("A"));
    assert_eq!(text(&[0x4142, 0x43], Order::Abcd), None, "not whole");

    let hollow = Raw {
        invalid: vec![0x7FFF],
        ..raw(Form::I16, 0.1)
    };
    assert_eq!(hollow.decode(&[0x7FFF], Kind::Number), None);
    assert_eq!(hollow.decode(&[0x7FFE], Kind::Number), Some(Value::Number(3276.6)));
    assert!(hollow.encode(Value::Number(3276.7), 0).is_err());
}

#[test]
fn masks_states_and_powers_of_ten() {
    let masked = Raw {
        mask: Some(0x0050),
        ..raw(Form::U16, 1.0)
    };
    assert_eq!(
        masked.decode(&[0xFFFF], Kind::Integer),
        Some(Value::Integer(5)),
        "as they stand"
    );
    assert_eq!(masked.decode(&[0x0040], Kind::Integer), Some(Value::Integer(4)));
    assert!(masked.encode(Value::Integer(5), 0).is_err());
    let state = |count, invert| Raw {
        equals: Some(Equals { count, invert }),
        mask: Some(0x0003),
        ..raw(Form::U16, 1.0)
    };
    assert_eq!(state(3, false).decode(&[0xFFF3], Kind::Bool), Some(Value::Bool(true)));
    assert_eq!(state(3, false).decode(&[0xFFF2], Kind::Bool), Some(Value::Bool(false)));
    assert_eq!(state(0, true).decode(&[0xFFF0], Kind::Bool), Some(Value::Bool(false)));
    let scaled = Raw {
        scale_from: Some(PointIndex::new(0)),
        ..raw(Form::I16, 1.0)
    };
    assert_eq!(scaled.decode(&[1234], Kind::Number), None, "without its power");
    assert_eq!(
        scaled.decode_scaled(&[1234], Kind::Number, -2),
        Some(Value::Number(12.34))
    );
    assert_eq!(
        scaled.decode_scaled(&[0xFFFF], Kind::Number, 3),
        Some(Value::Number(-1000.0))
    );
    assert_eq!(scaled.decode_scaled(&[1], Kind::Number, -32_768), None);
}
