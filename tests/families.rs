//! Every family of the reference, over every protocol it speaks, commanded through the same sequence and read by the
//! same names: what differs is in the profiles, nobody who commands a drive has to know.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "tests may panic"
)]

mod common;

use common::{Rig, Setup};
use drivegate::codec::{LineFormat, Protocol};
use drivegate::drive::profile::Profiles;
use drivegate::drive::{ModelPoint, State, Value};
use drivegate::sim::drive::{DriveOptions, ModelOptions};

/// What a family is called, and what its faults look like in its registers.
struct Family {
    profile: &'static str,
    /// Fault that is provoked, as the drive's own registers show it.
    fault: u16,
    /// The code and the text that everybody sees.
    code: i64,
    text: &'static str,
}

const fn family(profile: &'static str, fault: u16, code: i64, text: &'static str) -> Family {
    Family {
        profile,
        fault,
        code,
        text,
    }
}

const FAMILIES: [Family; 8] = [
    family("vacon-nx", 53, 53, "fieldbus fault"),
    family("vacon-nx-n2", 53, 53, "fieldbus fault"),
    family("eaton-svx", 53, 53, "fieldbus fault"),
    family("eaton-hvx", 53, 53, "fieldbus fault"),
    family("eaton-hvx-n2", 53, 53, "fieldbus fault"),
    family("vacon-cx", 1, 1, "overcurrent"),
    // The lowest bit of the mask, counted from 1.
    family("teco-7300pa", 0x0002, 2, "overvoltage"),
    family("teco-7300pa-n2", 0x0002, 2, "overvoltage"),
];

/// Points that every family has.
const EVERYWHERE: [ModelPoint; 12] = [
    ModelPoint::Ready,
    ModelPoint::Running,
    ModelPoint::Reversed,
    ModelPoint::Fault,
    ModelPoint::AtReference,
    ModelPoint::ZeroSpeed,
    ModelPoint::OutputFrequency,
    ModelPoint::MotorCurrent,
    ModelPoint::MotorVoltage,
    ModelPoint::DcLinkVoltage,
    ModelPoint::FaultCode,
    ModelPoint::SpeedReference,
];

/// The line that a family has by its works.
fn format(protocol: Protocol) -> LineFormat {
    match protocol {
        Protocol::ModbusRtu => LineFormat::new(19_200, "8N2"),
        Protocol::ModbusAscii => LineFormat::new(19_200, "7N2"),
        Protocol::N2 => LineFormat::new(9600, "8N1"),
    }
    .unwrap()
}

fn rig(family: &Family, protocol: Protocol) -> Rig {
    let profile = Profiles::built_in().get(family.profile).unwrap().clone();
    let model = ModelOptions::by_name(profile.simulator.as_deref().unwrap()).unwrap();
    let setup = Setup {
        drives: vec![DriveOptions::new(1, model)],
        protocol,
        format: format(protocol),
        profile,
        ..Setup::new(&[], 9600)
    };
    Rig::of(setup, |spec| {
        // Families that do not tell their frequencies.
        let told = spec.profile.point_index("maximum_frequency").is_some();
        spec.frequency_range = (!told).then_some(0.0..=60.0);
    })
}

async fn set(rig: &Rig, points: &[(&str, f64)]) {
    let outcome = rig.set(1, points).await;
    assert!(outcome.is_ok(), "{points:?}: {outcome}");
}

async fn until(rig: &Rig, what: &str, point: ModelPoint, wanted: bool) {
    rig.until(what, |r| r.good(1, point) == Some(Value::Bool(wanted))).await;
}

fn number(rig: &Rig, point: ModelPoint) -> Option<f64> {
    rig.good(1, point).map(Value::as_f64)
}

/// Stop, run forward, 50 %, reverse, a provoked fault, reset, stop.
async fn operate(family: &Family, protocol: Protocol) {
    let rig = rig(family, protocol);
    rig.until("all common points", |r| {
        EVERYWHERE.iter().all(|p| r.good(1, *p).is_some())
    })
    .await;
    set(&rig, &[("run", 0.0)]).await;
    assert_eq!(rig.state(1), State::Ready, "a healthy drive at rest");
    assert_eq!(rig.good(1, ModelPoint::ZeroSpeed), Some(Value::Bool(true)));

    set(&rig, &[("run", 1.0), ("reverse", 0.0), ("speed_reference", 50.0)]).await;
    rig.until("running", |r| r.state(1) == State::Running).await;
    until(&rig, "at reference", ModelPoint::AtReference, true).await;
    rig.until("the reference read back", |r| {
        number(r, ModelPoint::SpeedReference) == Some(50.0)
    })
    .await;
    // At reference may be told from some hertz before it on.
    rig.until("half of 50 or 60 Hz", |r| {
        number(r, ModelPoint::OutputFrequency).is_some_and(|output| [25.0, 30.0].contains(&output))
    })
    .await;
    assert_eq!(rig.good(1, ModelPoint::Reversed), Some(Value::Bool(false)));
    assert_eq!(rig.good(1, ModelPoint::ZeroSpeed), Some(Value::Bool(false)));
    assert!(number(&rig, ModelPoint::MotorCurrent).unwrap() > 0.0);

    set(&rig, &[("reverse", 1.0)]).await;
    until(&rig, "reversed", ModelPoint::Reversed, true).await;
    assert_eq!(rig.state(1), State::Running, "turning it round does not stop it");

    rig.line.with_drive(1, |drive, _| drive.trip(family.fault)).unwrap();
    rig.until("the fault", |r| r.state(1) == State::Fault).await;
    let code = Some(Value::Integer(family.code));
    rig.until("its code", |r| r.good(1, ModelPoint::FaultCode) == code)
        .await;
    let handle = rig.handle(1);
    assert_eq!(handle.reading(std::time::Instant::now()).fault_text(), family.text);

    set(&rig, &[("fault_reset", 1.0)]).await;
    rig.until("ready again", |r| r.state(1) == State::Ready).await;
    rig.until("no code", |r| {
        r.good(1, ModelPoint::FaultCode) == Some(Value::Integer(0))
    })
    .await;
    until(&rig, "standing", ModelPoint::ZeroSpeed, true).await;
    assert_eq!(rig.state(1), State::Ready, "a reset starts nothing");

    set(&rig, &[("run", 1.0), ("reverse", 0.0)]).await;
    rig.until("running once more", |r| r.state(1) == State::Running).await;
    set(&rig, &[("run", 0.0)]).await;
    rig.until("stopped", |r| r.state(1) == State::Ready).await;
}

/// A family over each protocol it speaks.
fn family_operates(name: &str) {
    let family = FAMILIES.iter().find(|f| f.profile == name).unwrap();
    let protocols = Profiles::built_in().get(name).unwrap().protocols.clone();
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .unwrap();
    for protocol in protocols {
        runtime.block_on(operate(family, protocol));
    }
}

macro_rules! families {
    ($($test:ident $name:literal,)*) => {
        $(#[test]
        fn $test() {
            family_operates($name);
        })*

        #[test]
        fn no_family_is_left_out() {
            let built_in = Profiles::built_in();
            assert_eq!(built_in.names().count(), FAMILIES.len());
            assert!(built_in.names().all(|name| [$($name),*].contains(&name)));
        }
    };
}

families! {
    vacon_nx "vacon-nx",
    vacon_nx_n2 "vacon-nx-n2",
    eaton_svx "eaton-svx",
    eaton_hvx "eaton-hvx",
    eaton_hvx_n2 "eaton-hvx-n2",
    vacon_cx "vacon-cx",
    teco_7300pa "teco-7300pa",
    teco_7300pa_n2 "teco-7300pa-n2",
}
