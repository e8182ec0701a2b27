use std::collections::BTreeMap;
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

mod limits;

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
