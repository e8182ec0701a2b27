//! Limits of references: by every name and register of one reference, in percent and in hertz.

use std::ops::RangeInclusive;

use super::*;

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
