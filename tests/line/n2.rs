//! An N2 slave that was written elsewhere.

use std::sync::Arc;
use std::time::Duration;

use drivegate_model::drive::{ModelPoint, Profile, Value};
use drivegate_proto::Protocol;

use super::rig::{Rig, Setup};
use crate::support::process::{Running, until};
use crate::support::tools::{root, tool};

/// The objects that the independent slave has.
const PEER: &str = r#"
name = "peer"
title = "An N2 slave in another language"
protocols = ["n2"]
[[range]]
table = "input"
first = 0
last = 3
read = 2
[[range]]
table = "discrete-input"
first = 0
last = 1
read = 1
[[range]]
table = "holding"
first = 0
last = 1
read = 2
write = 2
[[point]]
name = "output_frequency"
at = "input 2"
type = "f32"
class = "fast"
[[point]]
name = "running"
at = "discrete-input 1"
class = "fast"
[[point]]
name = "speed_reference"
at = "holding 0"
type = "f32"
range = [0.0, 100.0]
class = "fast"
write = true
"#;

async fn is_good(rig: &Rig, point: ModelPoint, value: Value) {
    rig.until(&format!("{} = {value}", point.name()), |r| {
        r.good(1, point) == Some(value)
    })
    .await;
}

#[tokio::test]
async fn an_n2_slave_in_python() {
    for form in ["plain", "byte"] {
        let script = root().join("tests/peers/n2_slave.py");
        // The peer prints its port, then each frame that it receives.
        let peer = Running::start(&tool("python3"), &[&script.display().to_string(), form]);
        let lines = || peer.output().lines().map(str::to_string).collect::<Vec<_>>();
        let port = until("its port", || lines().into_iter().next());
        let port = format!("tcp://127.0.0.1:{port}");
        let profile = Profile::parse("peer.toml", PEER, false).unwrap();
        let rig = Rig::of(Setup {
            protocol: Protocol::N2,
            profile: Arc::new(profile),
            port: Some(port),
            response_timeout: Duration::from_millis(500),
            ..Setup::default()
        });
        is_good(&rig, ModelPoint::OutputFrequency, Value::Number(25.0)).await;
        is_good(&rig, ModelPoint::Running, Value::Bool(true)).await;
        assert!(rig.set(1, &[("speed_reference", 50.0)]).await.is_ok());
        is_good(&rig, ModelPoint::SpeedReference, Value::Number(50.0)).await;
        // The slave answers faster than a line could, so a doubtful answer is requested again, and requests are not
        // counted in this test. A test in virtual time proves that nothing is written twice.
        let frames = ["0111020388", "0112020288", "017203014248000020", "017303018F"];
        let heard = || lines().split_off(1);
        until("all frames", || {
            let heard = heard();
            frames
                .iter()
                .all(|frame| heard.iter().any(|line| line == frame))
                .then_some(())
        });
        // After a pause of the machine a request is sent again.
        let mut first = heard();
        first.dedup();
        assert_eq!(first[..3], ["01FA7", "0104C5", "0105C6"]);
    }
}
