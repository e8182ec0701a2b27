use std::collections::BTreeMap;
use std::time::Duration;

use super::super::admit;
use super::*;
use crate::order::Authority;
use crate::process_image::{Access, DriveImage, DriveSpec, Link};
use crate::testkit;
use drivegate_model::drive::{PointIndex, RawWrites};
use drivegate_proto::{Protocol, RequestPdu};

/// A drive with this limit on a point, whose registers were read `ago`.
fn drive(profile: &str, limit: (&str, f64), words: &[(Table, u16, &[u16])], ago: Duration) -> DriveImage {
    let profile = testkit::profile(profile);
    let spec = DriveSpec {
        access: Access::Control,
        raw_writes: RawWrites::All,
        limits: BTreeMap::from([(limit.0.to_string(), 0.0..=limit.1)]),
        ..DriveSpec::new("pump-1", "line1", 1, profile)
    };
    let image = DriveImage::new(spec, Duration::from_secs(1));
    image.update(|snapshot| {
        snapshot.link = Link::Online(std::time::SystemTime::now());
        for (table, start, words) in words {
            snapshot.store(*table, *start, words, Instant::now().checked_sub(ago).unwrap());
        }
    });
    image
}

fn float(value: f32) -> [u16; 2] {
    let bits = value.to_bits();
    [(bits >> 16) as u16, bits as u16]
}

/// A Vacon NX on N2 between 0 and 50 Hz, with that reference in percent, and 40 Hz as limit.
fn on_n2(percent: f32, ago: Duration) -> DriveImage {
    let words: Vec<u16> = [float(percent), float(50.0), float(0.0), float(50.0)].concat();
    drive(
        "vacon-nx-n2",
        ("frequency_reference", 40.0),
        &[(Table::Holding, 0, &words)],
        ago,
    )
}

fn point(image: &DriveImage, name: &str) -> PointIndex {
    image.spec.profile.point_index(name).unwrap()
}

fn set(image: &DriveImage, name: &str, value: f64) -> Result<(), Refusal> {
    let order = Order::Points(vec![(point(image, name), Value::Number(value))]);
    let reading = image.reading(Instant::now(), Duration::from_secs(60));
    admit(order, &reading, Authority::Write).map(|_| ())
}

#[test]
fn what_a_limit_rests_on_is_judged_with_the_reference_that_stands() {
    let image = on_n2(80.0, Duration::ZERO);
    let why = set(&image, "maximum_frequency", 100.0).unwrap_err();
    assert!(matches!(why, Refusal::BadValue(_)));
    assert_eq!(
        why.to_string(),
        "with that `maximum_frequency` the present reference would make `frequency_reference` 80 Hz, outside the limits 0 to 40 Hz; nothing was \
         written; lower the reference first"
    );
    assert!(set(&image, "maximum_frequency", 45.0).is_ok(), "80 % of it are 36 Hz");
    assert!(set(&image, "maximum_frequency", 50.0).is_ok());
    let lower = on_n2(40.0, Duration::ZERO);
    assert!(set(&lower, "maximum_frequency", 100.0).is_ok(), "40 % of it are 40 Hz");
    assert!(set(&lower, "maximum_frequency", 101.0).is_err());
    assert!(
        set(&on_n2(0.0, Duration::ZERO), "minimum_frequency", 41.0).is_err(),
        "0 % are 41 Hz"
    );
    assert!(set(&lower, "current_limit", 7.0).is_ok(), "nothing rests on that");
}

#[test]
fn a_raw_write_is_judged_alike() {
    let image = on_n2(80.0, Duration::ZERO);
    let raw = |value| {
        let pdu = RequestPdu::write_registers(6, &float(value));
        let reading = image.reading(Instant::now(), Duration::from_secs(60));
        admit(Order::Write(pdu), &reading, Authority::Write).map(|_| ())
    };
    assert!(image.spec.profile.protocols.contains(&Protocol::N2));
    assert!(matches!(raw(100.0), Err(Refusal::BadValue(_))));
    assert!(raw(45.0).is_ok());
}

#[test]
fn a_limit_in_percent_rests_on_the_frequency_range_too() {
    let words: &[(Table, u16, &[u16])] = &[(Table::Holding, 0, &[4000])];
    let image = drive("vacon-cx", ("speed_reference", 80.0), words, Duration::ZERO);
    let address = image
        .spec
        .profile
        .points
        .get(point(&image, "maximum_frequency"))
        .unwrap()
        .raw()
        .unwrap()
        .address;
    image.update(|snapshot| snapshot.store(Table::Holding, address, &[50], Instant::now()));
    let raw = |image: &DriveImage, value| {
        let pdu = RequestPdu::write_register(address, value);
        let reading = image.reading(Instant::now(), Duration::from_secs(60));
        admit(Order::Write(pdu), &reading, Authority::Write).map(|_| ())
    };
    assert!(
        matches!(raw(&image, 40), Err(Refusal::BadValue(_))),
        "40 Hz are 100 % of 40 Hz"
    );
    assert!(raw(&image, 60).is_ok());
}

#[test]
fn a_reference_that_is_not_known_is_not_taken_to_be_low() {
    let long_ago = on_n2(10.0, Duration::from_secs(8));
    assert!(matches!(
        set(&long_ago, "maximum_frequency", 60.0),
        Err(Refusal::NotKnown(_))
    ));
    let unlimited = DriveImage::new(
        DriveSpec {
            limits: BTreeMap::new(),
            ..long_ago.spec.clone()
        },
        Duration::from_secs(1),
    );
    unlimited.update(|snapshot| snapshot.link = Link::Online(std::time::SystemTime::now()));
    assert!(set(&unlimited, "maximum_frequency", 60.0).is_ok());
}

#[test]
fn what_was_written_since_the_reference_was_read_counts_when_the_order_is_begun() {
    let image = on_n2(40.0, Duration::from_secs(6));
    let now = Instant::now();
    let reading = image.reading(now, Duration::from_secs(60));
    let order = Order::Points(vec![(point(&image, "maximum_frequency"), Value::Number(100.0))]);
    let begun = |reference: Option<u64>, range: Option<u64>| {
        let ago = |seconds: u64| now.checked_sub(Duration::from_secs(seconds)).unwrap();
        let last = LastWritten {
            reference: reference.map(ago),
            range: range.map(ago),
        };
        still_keeps_limits(&reading, &order, last)
    };
    assert!(begun(None, None).is_ok());
    assert!(begun(Some(7), Some(7)).is_ok());
    assert!(matches!(begun(Some(1), None), Err(Refusal::NotKnown(_))));
    assert!(
        matches!(begun(None, Some(1)), Err(Refusal::NotKnown(_))),
        "the minimum is not known"
    );
}

#[test]
fn a_restore_names_the_limits_that_it_passes() {
    let mut image = on_n2(80.0, Duration::ZERO);
    let passed = |image: &DriveImage, value| {
        let reading = image.reading(Instant::now(), Duration::from_secs(60));
        limits_passed(&reading, [(6, RawValue::Float(f32::to_bits(value)))].into_iter())
    };
    assert_eq!(passed(&image, 45.0), Vec::<String>::new());
    assert!(passed(&image, 100.0)[0].contains("would make `frequency_reference` 80 Hz"));
    image.spec.limits.insert("maximum_frequency".to_string(), 0.0..=60.0);
    assert_eq!(passed(&image, 100.0).len(), 2);
    assert_eq!(
        passed(&image, 61.0)[0],
        "`maximum_frequency` would be 61 Hz, outside the limits 0 to 60 Hz of `pump-1`"
    );
}
