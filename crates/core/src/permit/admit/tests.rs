use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::*;
use crate::process_image::{DriveImage, DriveSpec, Link};
use crate::testkit;
use drivegate_model::drive::RawWrites;
use drivegate_model::drive::parameters::RawValue;
use drivegate_model::drive::profile::Profiles;
use drivegate_model::drive::{PointIndex, Profile};
use drivegate_proto::{Exception, RequestPdu};

fn drive(access: Access) -> DriveImage {
    let profile = testkit::nx();
    let spec = DriveSpec {
        access,
        limits: BTreeMap::from([("speed_reference".to_string(), 0.0..=80.0)]),
        turnaround: Duration::from_millis(2),
        ..DriveSpec::new("pump-1", "line1", 1, Arc::clone(&profile))
    };
    let image = DriveImage::new(spec, Duration::from_secs(1));
    image.update(|s| {
        s.link = Link::Online(std::time::SystemTime::now());
        s.store(Table::Holding, 100, &[1000, 5000], Instant::now());
    });
    image
}

fn try_order(order: Order) -> Result<Admitted, Refusal> {
    let image = drive(Access::Control);
    admit(
        order,
        &image.reading(Instant::now(), Duration::from_secs(1)),
        Authority::Write,
    )
}

fn point(name: &str) -> PointIndex {
    Profiles::built_in().get("vacon-nx").unwrap().point_index(name).unwrap()
}

fn set(points: &[(&str, f64)]) -> Result<Admitted, Refusal> {
    try_order(Order::Points(
        points.iter().map(|(n, v)| (point(n), Value::Number(*v))).collect(),
    ))
}

fn write(address: u16, value: u16) -> Order {
    Order::Write(RequestPdu::write_register(address, value))
}

#[test]
fn authority_comes_first() {
    let image = drive(Access::Monitor);
    let reading = image.reading(Instant::now(), Duration::from_secs(1));
    for (order, may) in [
        (write(2000, 1), Authority::Write),
        (write(9999, 1), Authority::Write),
        (write(2000, 1), Authority::ReadOnly),
    ] {
        assert_eq!(
            admit(order, &reading, may).unwrap_err().exception(),
            Exception::FUNCTION
        );
    }
    assert!(
        admit(
            Order::Read(RequestPdu::read(Table::Holding, 0, 1)),
            &reading,
            Authority::ReadOnly
        )
        .is_ok()
    );
}

#[test]
fn limits_are_told_never_clamped() {
    let refusal = set(&[("speed_reference", 80.5)]).unwrap_err();
    assert_eq!(refusal.exception(), Exception::VALUE);
    assert_eq!(
        refusal.to_string(),
        "`speed_reference` = 80.5 % is outside the limits 0 to 80 %; nothing was written"
    );
    assert!(set(&[("speed_reference", 80.0)]).is_ok());
    assert!(set(&[("speed_reference", f64::NAN)]).is_err());
    assert!(set(&[("run", 0.5)]).is_err());
    assert!(try_order(write(2002, 8001)).is_err(), "raw writes obey the limits too");
    assert!(try_order(write(2002, 8000)).is_ok());
}

/// The limits are 0 to 80 %, and those of the frequency follow from the band of 10 to 50 Hz.
#[test]
fn a_reference_of_before_breaks_a_limit_by_more_than_a_step_of_its_register() {
    let mut image = drive(Access::Control);
    let broken = |image: &DriveImage, word: u16| {
        let reading = image.reading(Instant::now(), Duration::from_secs(1));
        let pdu = RequestPdu::WriteRegisters {
            start: 2000,
            values: vec![1, 0, word],
        };
        broken_limit(&reading, &pdu).map(|refusal| refusal.to_string())
    };
    assert_eq!(broken(&image, 8000), None);
    assert_eq!(broken(&image, 8001), None, "80 %, rounded up");
    let why = broken(&image, 8002).unwrap();
    assert!(why.contains("outside the limits 0 to 80 %"), "{why}");
    image.spec.limits = BTreeMap::from([("frequency_reference".to_string(), 0.0..=30.0)]);
    assert_eq!(broken(&image, 5000), None, "30 Hz");
    let why = broken(&image, 5100).unwrap();
    assert!(why.contains("`frequency_reference` would be 30.4 Hz"), "{why}");
    let unread = DriveImage::new(image.spec.clone(), Duration::from_secs(1));
    assert_eq!(broken(&unread, 5100), None, "the band is not known");
}

#[test]
fn frequency_becomes_percent_of_the_band() {
    let admitted = set(&[("frequency_reference", 30.0)]).unwrap();
    assert_eq!(
        admitted.order,
        Order::Points(vec![(point("speed_reference"), Value::Number(50.0))])
    );
    assert!(admitted.reference_only);
    assert!(
        set(&[("frequency_reference", 49.0)]).is_err(),
        "97.5 % is beyond the limit of the percentage"
    );
    let twice = set(&[("frequency_reference", 30.0), ("speed_reference", 50.0)]).unwrap_err();
    assert!(twice.to_string().contains("twice"), "{twice}");
}

/// The value for the reference register of a Vacon NX between 10 and 50 Hz with these limits.
fn ordered(limits: &[(&str, RangeInclusive<f64>)], name: &str, value: f64) -> Result<f64, Refusal> {
    let mut spec = drive(Access::Control).spec;
    spec.limits = limits
        .iter()
        .map(|(name, range)| (name.to_string(), range.clone()))
        .collect();
    let image = DriveImage::new(spec, Duration::from_secs(1));
    image.update(|s| {
        s.link = Link::Online(std::time::SystemTime::now());
        s.store(Table::Holding, 100, &[1000, 5000], Instant::now());
    });
    let order = Order::Points(vec![(point(name), Value::Number(value))]);
    let reading = image.reading(Instant::now(), Duration::from_secs(1));
    match admit(order, &reading, Authority::Write)?.order {
        Order::Points(values) => Ok(values[0].1.as_f64()),
        other => panic!("{other:?}"),
    }
}

#[test]
fn no_order_in_hertz_turns_a_motor_round_below_its_minimum_frequency() {
    for (hertz, percent) in [
        (10.0, 0.0),
        (10.001, 0.0),
        (30.0, 50.0),
        (50.0, 100.0),
        (-30.0, -50.0),
        (-50.0, -100.0),
    ] {
        assert_eq!(ordered(&[], "frequency_reference", hertz), Ok(percent), "{hertz} Hz");
    }
    for hertz in [0.0, 5.0, 9.99, -5.0, -9.99] {
        let refusal = ordered(&[], "frequency_reference", hertz).unwrap_err();
        assert_eq!(refusal.code(), "bad_value", "{hertz} Hz");
        assert_eq!(
            refusal.to_string(),
            format!(
                "`frequency_reference` = {hertz} Hz is below the drive's minimum frequency 10 Hz; nothing was written"
            )
        );
    }
    // A percentage of 0 has no sign.
    for hertz in [-10.0, -10.001] {
        let refusal = ordered(&[], "frequency_reference", hertz).unwrap_err();
        assert_eq!(refusal.code(), "bad_value", "{hertz} Hz");
        assert!(refusal.to_string().contains("0 % has no sign"), "{refusal}");
    }
}

#[test]
fn limits_in_hertz_hold_for_the_frequency_at_which_the_motor_turns() {
    let asked = |limits: RangeInclusive<f64>, percent| {
        let result = ordered(&[("frequency_reference", limits)], "speed_reference", percent);
        result.map_err(|refusal| refusal.code())
    };
    let refused = Err("bad_value");
    // 50 % of the band is 30 Hz, in either direction.
    assert_eq!(asked(-30.0..=30.0, -50.0), Ok(-50.0));
    assert_eq!(asked(-30.0..=30.0, -51.0), refused);
    assert_eq!(asked(0.0..=30.0, 50.0), Ok(50.0));
    assert_eq!(asked(0.0..=30.0, 51.0), refused);
    for percent in [-0.01, -10.0, -25.0, -30.0] {
        assert_eq!(asked(0.0..=30.0, percent), refused, "{percent} %");
    }
    // -0.004 % rounds to 0 %, which is 10 Hz forward.
    assert_eq!(asked(-30.0..=-10.0, -0.004), refused);
}

/// A drive of this profile between 10 and 50 Hz, if its range is known, with one limit. Percent are those of the
/// band between `minimum` and 50 Hz.
fn limited(profile: &Arc<Profile>, name: &str, most: f64) -> DriveImage {
    let spec = DriveSpec {
        access: Access::Control,
        limits: BTreeMap::from([(name.to_string(), 0.0..=most)]),
        frequency_range: Some(10.0..=50.0),
        raw_writes: RawWrites::All,
        ..DriveSpec::new("d", "b", 1, Arc::clone(profile))
    };
    let image = DriveImage::new(spec, Duration::from_secs(1));
    image.update(|s| s.link = Link::Online(std::time::SystemTime::now()));
    image
}

/// A limit on one name of a reference applies to all its names, in any unit and by any kind of write, in every profile.
#[test]
fn a_limit_on_one_name_of_a_reference_holds_for_every_way_to_write_it() {
    const NAMES: [&str; 3] = ["speed_reference", "frequency_reference", "frequency_command"];
    for profile in Profiles::built_in().iter() {
        let names = NAMES.iter().filter(|name| profile.point_index(name).is_some());
        let points: Vec<PointIndex> = names.filter_map(|name| profile.point_index(name)).collect();
        // Unverified families may have a reference in percent only, so there are no two names to compare.
        if points.len() < 2 && !profile.verified {
            continue;
        }
        assert!(points.len() >= 2, "{}: percent and Hz", profile.name);
        // 80 % of the band, in the unit of the point.
        let minimum = |image: &DriveImage| {
            let reading = image.reading(Instant::now(), Duration::from_secs(1));
            let mut bands = profile.points.iter().filter_map(|p| match &p.source {
                Source::Derived(derived) => derived.band(),
                Source::Raw(_) => None,
            });
            let (_, low, high) = bands.next_back().unwrap();
            reading.band_for_commands(low, high).unwrap().0
        };
        let low = minimum(&limited(profile, "speed_reference", 100.0));
        let figure = |index: PointIndex, percent: f64| match profile.points.get(index).unwrap().unit.as_str() {
            "%" => percent,
            _ => low + percent / 100.0 * (50.0 - low),
        };
        for limit in &points {
            let image = limited(profile, &profile.points.get(*limit).unwrap().name, figure(*limit, 80.0));
            let asked = |order: Order| {
                let reading = image.reading(Instant::now(), Duration::from_secs(1));
                admit(order, &reading, Authority::Write).map_err(|refusal| refusal.code())
            };
            for way in &points {
                let what = format!(
                    "{}: limit on `{}`, order of `{}`",
                    profile.name,
                    profile.points.get(*limit).unwrap().name,
                    profile.points.get(*way).unwrap().name
                );
                let order = |percent| Order::Points(vec![(*way, Value::Number(figure(*way, percent)))]);
                let admitted = asked(order(79.0)).unwrap_or_else(|code| panic!("{what}: {code}"));
                assert_eq!(asked(order(81.0)), Err("bad_value"), "{what}");
                let Order::Points(values) = admitted.order else {
                    panic!("{what}");
                };
                let (register, _) = values[0];
                let raw = profile.points.get(register).unwrap().raw().unwrap();
                let write = |percent| {
                    let words = raw.encode(Value::Number(figure(register, percent)), 0).unwrap();
                    Order::Write(match words.as_slice() {
                        [value] => RequestPdu::write_register(raw.address, *value),
                        _ => RequestPdu::WriteRegisters {
                            start: raw.address,
                            values: words,
                        },
                    })
                };
                assert!(asked(write(79.0)).is_ok(), "{what}, raw");
                assert_eq!(asked(write(81.0)), Err("bad_value"), "{what}, raw");
            }
        }
    }
}

/// No two writable figures of a built-in profile share a register under names that are not related.
#[test]
fn a_register_has_one_figure_to_limit() {
    for profile in Profiles::built_in().iter() {
        let figures = || {
            profile
                .points
                .iter()
                .filter(|p| p.write && p.kind() != Kind::Bool && p.raw().is_some())
        };
        let places: Vec<(Table, u16)> = figures()
            .filter(|p| p.write_to.is_none())
            .filter_map(Point::raw)
            .flat_map(|raw| raw.addresses().map(|address| (raw.table, address)))
            .collect();
        let unique: std::collections::HashSet<_> = places.iter().collect();
        assert_eq!(unique.len(), places.len(), "{}", profile.name);
    }
}

#[test]
fn stops_are_known_as_such() {
    assert_eq!(
        set(&[("run", 0.0), ("speed_reference", 0.0)]).unwrap().urgency,
        Urgency::Stop
    );
    assert_eq!(set(&[("run", 1.0)]).unwrap().urgency, Urgency::Command);
    assert_eq!(try_order(write(2000, 2)).unwrap().urgency, Urgency::Stop);
    assert_eq!(try_order(write(2000, 1)).unwrap().urgency, Urgency::Command);
    assert_eq!(try_order(write(2002, 0)).unwrap().urgency, Urgency::Command);
}

#[test]
fn addresses_and_counts() {
    let many = |start, count| Order::Write(RequestPdu::write_registers(start, &vec![0; count]));
    assert_eq!(
        try_order(write(2100, 1)).unwrap_err().exception(),
        Exception::ADDRESS,
        "status word"
    );
    assert_eq!(
        try_order(write(7000, 1)).unwrap_err().exception(),
        Exception::ADDRESS,
        "unknown"
    );
    assert_eq!(
        try_order(many(2000, 12)).unwrap_err().exception(),
        Exception::ADDRESS,
        "past the range"
    );
    assert_eq!(
        try_order(many(732, 2)).unwrap_err().exception(),
        Exception::VALUE,
        "one parameter a message"
    );
    assert!(try_order(many(2000, 3)).is_ok());
    assert_eq!(
        try_order(Order::Write(RequestPdu::WriteCoil { address: 0, on: true }))
            .unwrap_err()
            .exception(),
        Exception::ADDRESS
    );
    assert_eq!(set(&[("ready", 1.0)]).unwrap_err().exception(), Exception::ADDRESS);
    let mask = RequestPdu::MaskWrite {
        address: 2000,
        and_mask: 0,
        or_mask: 0,
    };
    assert_eq!(
        try_order(Order::Write(mask)).unwrap_err().exception(),
        Exception::FUNCTION
    );
}

/// A profile whose points share the control word, which its proof refuses.
const PAST: &str = r#"
name = "past"
protocols = ["modbus-rtu"]
range = [{ table = "holding", first = 0, last = 9, read = 10, write = 2 }]
[control]
at = "holding 1"
own_word = "shadow"
run = { bit = 0 }
stop = { bit = 0, is = 0 }
[[point]]
name = "running"
at = "holding 8.0"
class = "fast"
[[point]]
name = "word"
at = "holding 1"
class = "never"
write = true
[[point]]
name = "lever"
at = "holding 1.0"
class = "never"
write = true
[[point]]
name = "beside"
at = "holding 2"
class = "never"
write = true
"#;

#[test]
fn a_point_where_the_drive_is_commanded_is_not_written() {
    let profile = Arc::new(Profile::parse("past.toml", PAST, false).unwrap());
    let spec = DriveSpec {
        access: Access::Control,
        ..DriveSpec::new("pump-1", "line1", 1, Arc::clone(&profile))
    };
    let image = DriveImage::new(spec, Duration::from_secs(1));
    for (name, passes) in [("word", false), ("lever", false), ("beside", true), ("run", true)] {
        let order = Order::Points(vec![(profile.point_index(name).unwrap(), Value::Number(1.0))]);
        let reading = image.reading(Instant::now(), Duration::from_secs(1));
        let refused = admit(order, &reading, Authority::Write).err();
        assert_eq!(refused.is_none(), passes, "{name}: {refused:?}");
        if let Some(refused) = refused {
            assert_eq!(refused.code(), "not_writable", "{name}");
            assert!(refused.to_string().contains("could start the motor"), "{refused}");
        }
    }
}

/// Limits in Hz, and the percentage of 50 Hz, depend on the drive's maximum frequency, which may be changed at its
/// panel. Restoring a control word that was read while the motor ran would start the motor.
#[test]
fn a_parameter_where_the_drive_is_commanded_is_not_written() {
    let profile = testkit::nx();
    let spec = DriveSpec {
        access: Access::Control,
        params: ParamsAccess::Write,
        ..DriveSpec::new("pump-1", "line1", 1, Arc::clone(&profile))
    };
    let restore_lock = Arc::new(RestoreLock::default());
    restore_lock.set(Some("it is being restored".to_string()));
    let image = DriveImage::new(spec, Duration::from_secs(1)).with_restore_lock(restore_lock);
    let reading = image.reading(Instant::now(), Duration::from_secs(1));
    for (address, passes) in [(100, true), (2000, false), (2002, true)] {
        let order = ParameterOrder {
            id: "x".to_string(),
            address,
            from: None,
            to: RawValue::Word(1),
        };
        let refused = parameter(&reading, &order).err();
        assert_eq!(refused.is_none(), passes, "{address}: {refused:?}");
        assert_eq!(profile.parameter_is_writable(address), passes, "{address}");
        if let Some(refused) = refused {
            assert!(
                refused.to_string().contains("lies where the drive is commanded"),
                "{refused}"
            );
        }
    }
}

#[test]
fn no_command_rests_on_an_old_parameter() {
    let start = Instant::now();
    let at = |seconds: f64| start + Duration::from_secs_f64(seconds);
    let of = |slow_cycle: u64, frequency_range| {
        let spec = DriveSpec {
            limits: BTreeMap::from([("frequency_reference".to_string(), 0.0..=50.0)]),
            frequency_range,
            ..drive(Access::Control).spec
        };
        let image = DriveImage::new(spec, Duration::from_secs(slow_cycle));
        image.update(|s| {
            s.link = Link::Online(std::time::SystemTime::now());
            s.store(Table::Holding, 100, &[0, 5000], start);
        });
        image
    };
    let set = |image: &DriveImage, now, name: &str, value| {
        let order = Order::Points(vec![(point(name), Value::Number(value))]);
        let admitted = admit(order, &image.reading(now, Duration::from_secs(60)), Authority::Write)?;
        match admitted.order {
            Order::Points(values) => Ok(values[0].1.as_f64()),
            other => panic!("{other:?}"),
        }
    };
    let old = |result| matches!(result, Err(Refusal::NotKnown(_)));
    let image = of(1, None);
    assert_eq!(set(&image, at(5.0), "frequency_reference", 50.0), Ok(100.0));
    assert!(old(set(&image, at(5.1), "frequency_reference", 50.0)));
    assert!(old(set(&image, at(5.1), "speed_reference", 10.0)), "its limit is in Hz");
    image.update(|s| s.store(Table::Holding, 100, &[0, 10_000], at(5.1)));
    assert_eq!(set(&image, at(6.0), "frequency_reference", 50.0), Ok(50.0));
    for name in ["frequency_reference", "speed_reference"] {
        let refusal = set(&image, at(6.0), name, 50.5).unwrap_err();
        assert_eq!(refusal.exception(), Exception::VALUE, "{name}");
    }
    // A line that cannot be faster than its cycle.
    let image = of(20, None);
    assert_eq!(set(&image, at(22.5), "frequency_reference", 25.0), Ok(50.0));
    assert!(old(set(&image, at(22.6), "frequency_reference", 25.0)));
    let image = of(1, Some(0.0..=40.0));
    assert_eq!(
        set(&image, at(3.0), "frequency_reference", 20.0),
        Ok(40.0),
        "its own first"
    );
    assert_eq!(
        set(&image, at(9.0), "frequency_reference", 20.0),
        Ok(50.0),
        "else the configured one"
    );
}

/// A TECO drive, whose reference is a frequency, written elsewhere than it is read, with a limit in percent.
fn in_hertz(maximum: Option<u16>, order: impl Fn(&dyn Fn(&str) -> PointIndex) -> Order) -> Result<Admitted, Refusal> {
    let profile = testkit::profile("teco-7300pa");
    let mut spec = drive(Access::Control).spec;
    spec.profile = Arc::clone(&profile);
    let image = DriveImage::new(spec, Duration::from_secs(1));
    image.update(|s| {
        s.link = Link::Online(std::time::SystemTime::now());
        if let Some(maximum) = maximum {
            s.store(Table::Holding, 0x0201, &[maximum], Instant::now());
        }
    });
    let order = order(&|name| profile.point_index(name).unwrap());
    admit(
        order,
        &image.reading(Instant::now(), Duration::from_secs(1)),
        Authority::Write,
    )
}

#[test]
fn a_command_goes_where_the_drive_takes_it_within_the_limits_of_the_other_unit() {
    let set = |maximum, name: &str, value: f64| {
        in_hertz(maximum, |point| {
            Order::Points(vec![(point(name), Value::Number(value))])
        })
    };
    let command = Profiles::built_in()
        .get("teco-7300pa")
        .unwrap()
        .point_index("frequency_command")
        .unwrap();
    for (name, value) in [
        ("speed_reference", 50.0),
        ("frequency_reference", 30.0),
        ("frequency_command", 30.0),
    ] {
        let admitted = set(Some(600), name, value).unwrap();
        assert_eq!(
            admitted.order,
            Order::Points(vec![(command, Value::Number(30.0))]),
            "{name}"
        );
    }
    // 80 % of 60 Hz is 48 Hz.
    for (name, value) in [
        ("speed_reference", 81.0),
        ("frequency_reference", 49.0),
        ("frequency_command", 49.0),
    ] {
        assert_eq!(
            set(Some(600), name, value).unwrap_err().exception(),
            Exception::VALUE,
            "{name}"
        );
        assert!(set(None, name, value).is_err(), "{name}: what 80 % are is not known");
    }
    let raw = |value| in_hertz(Some(600), |_| write(0x0002, value));
    assert!(raw(4800).is_ok());
    assert_eq!(raw(4801).unwrap_err().exception(), Exception::VALUE);
}

#[test]
fn registers_without_a_writable_point_need_the_configuration() {
    let image = drive(Access::Control);
    let mut open = image.spec.clone();
    open.raw_writes = RawWrites::Ranges(vec![101..=101]);
    let open = DriveImage::new(open, Duration::from_secs(1));
    let asked = |image: &DriveImage, order| {
        let reading = image.reading(Instant::now(), Duration::from_secs(1));
        admit(order, &reading, Authority::Write).map(|admitted| admitted.urgency)
    };
    let block = |start, values: &[u16]| Order::Write(RequestPdu::write_registers(start, values));
    let refused = asked(&image, write(101, 10_000)).unwrap_err();
    assert_eq!(
        (refused.exception(), refused.code()),
        (Exception::ADDRESS, "not_writable")
    );
    assert!(
        refused.to_string().contains("add [101, 101] to `raw_writes`"),
        "{refused}"
    );
    assert_eq!(asked(&open, write(101, 6_000)), Ok(Urgency::Command));
    assert!(asked(&open, write(100, 0)).is_err());
    // One refused item of the block refuses the whole block.
    assert!(asked(&image, block(2001, &[0, 5000])).is_err());
    // Together with the control word, the block is sent, but only within the limits. A stop is the control word alone.
    assert_eq!(asked(&image, block(2000, &[1, 0, 5000])), Ok(Urgency::Command));
    assert_eq!(asked(&image, block(2000, &[0, 0, 5000])), Ok(Urgency::Command));
    assert_eq!(asked(&image, write(2000, 0)), Ok(Urgency::Stop));
    assert_eq!(
        asked(&image, block(2000, &[1, 0, 8001])).unwrap_err().exception(),
        Exception::VALUE
    );
}

#[test]
fn a_write_on_n2_is_one_whole_object() {
    let profile = testkit::profile("eaton-hvx-n2");
    let spec = DriveSpec {
        access: Access::Control,
        raw_writes: RawWrites::All,
        ..DriveSpec::new("ahu-1", "line4", 1, profile)
    };
    let image = DriveImage::new(spec, Duration::from_secs(1));
    image.update(|s| s.link = Link::Online(std::time::SystemTime::now()));
    let reading = image.reading(Instant::now(), Duration::from_secs(1));
    let (float, ao1_ao2) = ([0x41C8, 0], [0x41C8, 0, 0x41C8, 0]);
    let registers = |start, values: &[u16]| RequestPdu::WriteRegisters {
        start,
        values: values.to_vec(),
    };
    let coils = |start, bits: &[bool]| RequestPdu::WriteCoils {
        start,
        bits: bits.to_vec(),
    };
    let (address, value) = (Some(Exception::ADDRESS), Some(Exception::VALUE));
    // AO 1 and 2 are points. AO 8 has no name; the raw range ends after AO 8. BO 9 and 10 do not exist.
    for (pdu, wanted) in [
        (registers(0, &float), None),
        (registers(14, &float), None),
        (registers(0, &float[..1]), value),
        (registers(14, &float[..1]), value),
        (RequestPdu::write_register(14, 1), value),
        (registers(0, &ao1_ao2), value),
        (registers(12, &ao1_ao2), value),
        (registers(1, &float), address),
        (registers(13, &float), address),
        (registers(1, &float[..1]), address),
        (RequestPdu::write_register(15, 1), address),
        (registers(13, &ao1_ao2[..3]), address),
        (registers(14, &ao1_ao2), address),
        (registers(16, &float), address),
        (coils(1, &[true]), None),
        (coils(1, &[true, true]), value),
        (coils(8, &[true]), address),
    ] {
        let refused = admit(Order::Write(pdu.clone()), &reading, Authority::Write).err();
        assert_eq!(refused.map(|refusal| refusal.exception()), wanted, "{pdu:?}");
    }
}
