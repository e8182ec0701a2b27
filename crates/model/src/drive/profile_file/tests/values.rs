//! Keys that state how a value is read.

use super::*;

/// Cases with one mistake each in the keys that make a value of registers.
#[test]
fn each_mistake_of_a_value() {
    let cases = [
        (
            "type = \"string:0\"",
            "a text of `0` registers is not possible; m:13, point[0].type; write string:1 to string:32",
        ),
        (
            "type = \"u32\"\norder = \"abcd\"",
            "unknown order `abcd`; m:14, point[0].order",
        ),
        (
            "type = \"u32\"\norder = \"CDAB\"\nwords = \"low-first\"",
            "`order` says it already; m:15, point[0].words",
        ),
        ("type = \"i16\"\nmask = 3", "not to i16; m:14, point[0].mask"),
        ("mask = 0", "selects no bits of 1 registers; m:13, point[0].mask"),
        ("mask = 0x10000", "selects no bits of 1 registers; m:13, point[0].mask"),
        (
            "mask = 0x0003\nequals = 4",
            "4 is never reached: the value is 0 to 3; m:14, point[0].equals",
        ),
        ("type = \"f32\"\nequals = 4", "not compared with a whole number; m:14"),
        (
            "equals = 4\nscale = 2",
            "`equals` compares the number in the register, without conversion; m:14, point[0].scale",
        ),
        (
            "invalid = [0x10000]",
            "65536 is more than 1 registers hold; m:13, point[0].invalid",
        ),
        (
            "type = \"string:2\"\ninvalid = [0]",
            "only a numeric register; m:14, point[0].invalid",
        ),
        ("scale_from = \"b\"", "there is no point `b`; m:13, point[0].scale_from"),
        (
            "scale_from = \"a\"",
            "`a` is not a whole number without a scale of its own; m:13",
        ),
        (
            "type = \"string:2\"\nwrite = true",
            "cannot be converted back; m:14, point[0].write",
        ),
        (
            "equals = 1\nwrite = true",
            "cannot be converted back; m:14, point[0].write",
        ),
        (
            "unlisted = true\nwrite = true",
            "only a writable enumeration; m:13, point[0].unlisted",
        ),
        (
            "type = \"string:2\"\n[point.texts]\n1 = \"on\"",
            "a text is not an enumeration; m:14, point[0].texts",
        ),
    ];
    for (lines, wanted) in cases {
        let all = mistakes(
            "m",
            &format!("{HEAD}[[point]]\nname = \"a\"\nat = \"holding 1\"\n{lines}\n"),
        );
        let (what, place) = wanted.split_once("; ").unwrap();
        assert!(
            all.contains(what) && all.contains(place),
            "{lines}\n{wanted} is missing in\n{all}"
        );
        assert_eq!(all.lines().count(), 1, "{lines}\n{all}");
    }
    let model = |name: &str, lines: &str| {
        let place = format!("[[point]]\nname = \"{name}\"\nat = \"holding 1\"\n{lines}\n");
        mistakes("m", &format!("{HEAD}{place}"))
    };
    assert!(model("motor_current", "hidden = true").contains("is a point of the common model"));
    assert!(model("motor_current", "type = \"string:4\"").contains("is not a text in the common model"));
    assert!(model("running", "mask = 3").contains("is true or false"));
    assert_eq!(model("running", "mask = 3\nequals = 3"), "");
    assert!(model("motor_current", "mask = 3\nequals = 3").contains("is a number, not a bit"));
}

#[test]
fn what_the_keys_of_a_value_make() {
    let text = format!(
        "{HEAD}[[point]]\nname = \"power\"\nat = \"holding 0\"\nscale_from = \"power_sf\"\n\
         [[point]]\nname = \"power_sf\"\nat = \"holding 1\"\ntype = \"i16\"\nhidden = true\ninvalid = [0x8000]\n\
         [[point]]\nname = \"mode\"\nat = \"holding 2\"\nmask = 0x0070\nwrite = true\n[point.texts]\n1 = \"a\"\n\
         [[point]]\nname = \"count\"\nat = \"holding 4\"\ntype = \"u64\"\norder = \"CDAB\"\ninvalid = [-1]\n"
    );
    let profile = Profile::parse("p.toml", &text, false).unwrap();
    let point = |name: &str| profile.points.get(profile.point_index(name).unwrap()).unwrap();
    let raw = |name: &str| point(name).raw().unwrap();
    assert_eq!(raw("power").scale_from, profile.point_index("power_sf"));
    assert_eq!(raw("power_sf").invalid, [0x8000]);
    assert!(point("power_sf").hidden);
    assert_eq!(raw("mode").form, Form::Bits { first: 4, count: 3 });
    assert_eq!(raw("mode").encode(Value::Integer(1), 0xFFFF), Ok(vec![0xFF9F]));
    assert_eq!(
        (point("count").kind(), point("power").kind()),
        (Kind::Integer, Kind::Number)
    );
    assert_eq!(raw("count").type_text(), "u64 CDAB");
    assert_eq!(raw("count").decode(&[0xFFFF; 4], Kind::Integer), None);
    assert_eq!(
        raw("count").decode(&[1, 0, 0, 0], Kind::Integer),
        Some(Value::Integer(1))
    );
}

/// Values that need other registers, or half of one: transformer ratios, a counter in two registers, two bytes in one.
#[test]
fn what_is_made_of_several_registers_or_of_half_of_one() {
    let text = format!(
        "{HEAD}[[point]]\nname = \"current\"\nat = \"holding 0\"\nscale = 0.001\nfactor_from = \"ct\"\n\
         [[point]]\nname = \"power\"\nat = \"holding 1\"\nfactor_from = [\"ct\", \"pt\"]\n\
         [[point]]\nname = \"ct\"\nat = \"holding 2\"\nclass = \"once\"\n\
         [[point]]\nname = \"pt\"\nat = \"holding 3\"\nscale = 0.1\nclass = \"once\"\n\
         [[point]]\nname = \"kwh\"\nat = \"holding 4\"\n[[point]]\nname = \"mwh\"\nat = \"holding 5\"\n\
         [[point]]\nname = \"total\"\nderive = \"sum\"\nof = [\"mwh\", \"kwh\"]\nweights = [1000, 1]\nunit = \"kWh\"\n\
         [[point]]\nname = \"high\"\nat = \"holding 6\"\ntype = \"i8\"\nbyte = \"high\"\n\
         [[point]]\nname = \"low\"\nat = \"holding 6\"\ntype = \"i8\"\n"
    );
    let profile = Profile::parse("p.toml", &text, false).unwrap();
    let point = |name: &str| profile.points.get(profile.point_index(name).unwrap()).unwrap();
    let raw = |name: &str| point(name).raw().unwrap();
    let index = |name: &str| profile.point_index(name).unwrap();
    assert_eq!(raw("current").factor_from, [index("ct")]);
    assert_eq!(raw("power").factor_from, [index("ct"), index("pt")]);
    let of = vec![index("mwh"), index("kwh")];
    let weights = vec![1000.0, 1.0];
    assert_eq!(point("total").source, Source::Derived(Derived::Sum { of, weights }));
    assert_eq!(point("total").kind(), Kind::Number);
    let byte = |name: &str, word: u16| raw(name).decode(&[word], Kind::Number);
    for (word, high, low) in [(0xFF7F, -1.0, 127.0), (0x80FF, -128.0, -1.0), (0x0180, 1.0, -128.0)] {
        assert_eq!(byte("high", word), Some(Value::Number(high)));
        assert_eq!(byte("low", word), Some(Value::Number(low)));
    }
    assert_eq!(raw("power").decode(&[7], Kind::Number), None, "not without its factors");
}

#[test]
fn each_mistake_of_a_value_of_several_registers() {
    let cases = [
        ("type = \"i8\"\nbyte = \"upper\"", "a register has no byte `upper`"),
        ("byte = \"high\"", "u16 is not one byte of a register"),
        ("type = \"i8\"\nwrite = true", "cannot be converted back"),
        ("factor_from = \"b\"", "there is no point `b`"),
        ("factor_from = \"a\"", "`a` is not a number of a register of its own"),
        (
            "equals = 1\nfactor_from = \"c\"",
            "`equals` compares the number in the register, without conversion",
        ),
        ("factor_from = \"c\"\nwrite = true", "cannot be converted back"),
        ("factor_from = \"n\"", "`n` is never read"),
    ];
    let rest = "[[point]]\nname = \"c\"\nat = \"holding 2\"\n\
                [[point]]\nname = \"n\"\nat = \"holding 3\"\nclass = \"never\"\n";
    for (lines, wanted) in cases {
        let own = format!("[[point]]\nname = \"a\"\nat = \"holding 1\"\n{lines}\n");
        let all = mistakes("m", &format!("{HEAD}{own}{rest}"));
        assert!(all.contains(wanted), "{lines}\n{wanted} is missing in\n{all}");
    }
    let sums = [
        ("of = [\"c\"]", "a sum has two parts at least"),
        ("of = [\"c\", \"c\"]\nweights = [1]", "1 weights for 2 points"),
        ("of = [\"c\", \"f\"]", "no single request reads all parts of `s`"),
        ("of = [\"c\", \"far\"]", "no single request reads all parts of `s`"),
        ("of = [\"c\", \"n\"]", "`n` is never read"),
    ];
    let more = "[[point]]\nname = \"f\"\nat = \"holding 4\"\nclass = \"fast\"\n\
                [[point]]\nname = \"far\"\nat = \"holding 90\"\n";
    for (lines, wanted) in sums {
        let own = format!("[[point]]\nname = \"s\"\nderive = \"sum\"\n{lines}\n");
        let all = mistakes("m", &format!("{HEAD}{own}{rest}{more}"));
        assert!(all.contains(wanted), "{lines}\n{wanted} is missing in\n{all}");
    }
}
