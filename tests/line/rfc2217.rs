//! A device server that is set up over the network, tested with pyserial; and servers of other kinds.

use std::net::TcpListener;
use std::time::Duration;

use drivegate_line::{Level, Line, LineOptions, OpenError};
use drivegate_model::drive::{ModelPoint, State, Value};
use drivegate_proto::LineFormat;
use drivegate_sim::endpoint::EndpointOptions;

use super::rig::{Rig, Setup, reason, with_port};
use crate::support::process::{Running, free_port};
use crate::support::tools::{python, root};

/// pyserial's server in front of that device.
fn server(device: &str, port: u16) -> Running {
    let script = root().join("tests/peers/rfc2217_server.py").display().to_string();
    let server = Running::start(&python(), &[&script, device, &port.to_string()]);
    server.until_printed("listening");
    server
}

#[tokio::test]
async fn drives_behind_a_server_that_is_set_up_over_the_network() {
    let port = free_port();
    let rig = Rig::of(Setup {
        port: Some(format!("rfc2217://127.0.0.1:{port}")),
        response_timeout: Duration::from_secs(2),
        ..Setup::default()
    });
    let server = server(&rig.line.address(), port);
    rig.until("the drive answers", |r| r.state(1) == State::Ready).await;
    // 0xFFFF makes bytes 255 travel in both directions: to telnet they are commands unless they are doubled.
    let outcome = rig.set(1, &[("speed_reference", -0.01)]).await;
    assert!(outcome.is_ok(), "{outcome:?}");
    rig.until("the drive has it", |r| {
        r.good(1, ModelPoint::SpeedReference) == Some(Value::Number(-0.01))
    })
    .await;
    let Rig { bus, line, .. } = rig;
    bus.stop();
    server.until_printed("38400 8N1");
    drop(line);
}

#[test]
fn format_and_levels_are_set_remotely() {
    let (_master, device) = super::port::rustix_pty();
    let port = free_port();
    let server = server(&device, port);
    let options = LineOptions {
        dtr: Level::Off,
        ..LineOptions::default()
    };
    for (baud, format) in [(19_200, "8E2"), (9600, "7O1"), (115_200, "8N1")] {
        let format = LineFormat::new(baud, format).unwrap();
        let (line, warnings) = Line::open(&format!("rfc2217://127.0.0.1:{port}"), &format, &options).unwrap();
        assert_eq!(warnings, Vec::<String>::new());
        drop(line);
        server.until_printed(&format.to_string());
    }
    server.until_printed("DTR off");
}

#[tokio::test]
async fn a_telnet_port_behind_tcp_is_named() {
    let port = free_port();
    let rig = with_port(&format!("tcp://127.0.0.1:{port}"));
    let _server = server(&rig.line.address(), port);
    rig.until("it is recognised", |r| {
        let reason = reason(r);
        reason.contains("speaks telnet") && reason.contains("rfc2217://")
    })
    .await;
    assert!(
        rig.handle(1).image.snapshot().fast_at.is_none(),
        "nothing was read through it"
    );
}

#[test]
fn a_raw_port_behind_rfc2217_is_named() {
    let raw = Rig::of(Setup {
        endpoint: Some(EndpointOptions::Tcp {
            listen: ([127, 0, 0, 1], 0).into(),
        }),
        port: Some("tcp://127.0.0.1:1".to_string()),
        ..Setup::default()
    });
    let silent = TcpListener::bind("127.0.0.1:0").unwrap();
    let silent = format!("rfc2217://{}", silent.local_addr().unwrap());
    for port in [raw.line.address().replace("tcp://", "rfc2217://"), silent] {
        let format = LineFormat::new(9600, "8N1").unwrap();
        let error = Line::open(&port, &format, &LineOptions::default()).unwrap_err();
        assert!(matches!(error, OpenError::Remote { .. }), "{error}");
        let text = error.to_string();
        assert!(text.contains(&port) && text.contains("write tcp://"), "{text}");
    }
}
