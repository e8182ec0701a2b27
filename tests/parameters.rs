//! Parameters that somebody changes at the drive, while the gateway converts and limits commands by them.

mod common;

use std::ops::RangeInclusive;

use common::Rig;
use drivegate::codec::RequestPdu;
use drivegate::command::{Outcome, Refusal};
use drivegate::drive::{ModelPoint, State, Value};

/// Maximum frequency, ID 102, 0.01 Hz; PDU address.
const MAXIMUM_FREQUENCY: u16 = 101;
const LIMITS: RangeInclusive<f64> = 0.0..=50.0;

/// 50 Hz are all of 50 Hz and half of 100 Hz.
#[tokio::test]
async fn a_maximum_frequency_changed_at_the_panel_is_followed() {
    let rig = Rig::start_with(&[1], 38_400, |spec| {
        spec.limits.insert("frequency_reference".to_string(), LIMITS);
    })
    .await;
    let shown = |rig: &Rig| {
        let handle = rig.handle(1);
        let index = handle.image.spec.profile.point_index("maximum_frequency").unwrap();
        handle.reading(std::time::Instant::now()).sample(index).good()
    };
    rig.until("the drive answers", |r| {
        r.state(1) == State::Ready && shown(r) == Some(Value::Number(50.0))
    })
    .await;
    assert!(rig.set(1, &[("frequency_reference", 50.0)]).await.is_ok());
    rig.until("the reference is there", |r| {
        r.good(1, ModelPoint::SpeedReference) == Some(Value::Number(100.0))
    })
    .await;

    let panel = RequestPdu::WriteRegister {
        address: MAXIMUM_FREQUENCY,
        value: 10_000,
    };
    rig.line.with_drive(1, |drive, now| drive.answer(&panel, now));
    rig.until("the panel's value is read", |r| shown(r) == Some(Value::Number(100.0)))
        .await;
    for beyond in [("frequency_reference", 50.5), ("speed_reference", 50.5)] {
        let outcome = rig.set(1, &[beyond]).await;
        assert!(
            matches!(outcome, Outcome::Refused(Refusal::BadValue(_))),
            "{beyond:?}: {outcome:?}"
        );
    }
    assert!(rig.set(1, &[("frequency_reference", 50.0)]).await.is_ok());
    rig.until("half of the range is written", |r| {
        r.good(1, ModelPoint::SpeedReference) == Some(Value::Number(50.0))
    })
    .await;
}
