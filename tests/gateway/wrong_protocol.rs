//! A converter set to Modbus TCP, and a client set to RTU over TCP, both from pymodbus: each mistake is reported,
//! and communication works once the setting is corrected.

use crate::support::process::{Running, api, free_port, get, until};
use crate::support::site::{HTTP, MODBUS_TCP, Site, drive};
use crate::support::tools::{python, root, run_well};

fn server(port: u16, framer: &str) -> Running {
    let script = root().join("tests/peers/modbus_server.py").display().to_string();
    let server = Running::start(&python(), &[&script, &port.to_string(), framer]);
    server.until_printed("listening");
    server
}

/// The silence of the first connection lasts 5 s.
#[test]
fn a_modbus_tcp_server_behind_tcp_is_named_and_a_raw_port_is_used() {
    let converter = free_port();
    let line = format!(
        "[gateway]\nname = \"test\"\n[[bus]]\nname = \"line1\"\nport = \"tcp://127.0.0.1:{converter}\"\nbaud = 38400\n\
         response_timeout = \"2s\"\n"
    );
    let site = Site::of(&[&line, &drive("pump-1", 1, ""), HTTP]);
    let wrong = server(converter, "socket");
    let gateway = site.run();
    let ready = || get(site.http, "/readyz");
    until("the server is recognised", || {
        let (_, text) = ready()?;
        let told = text.contains("a Modbus TCP server answers on this port") && text.contains("raw TCP");
        told.then_some(())
    });
    let told = gateway.until_printed("bus line1 is down: the port is lost: a Modbus TCP server answers");
    assert_eq!(told.matches("bus line1 is down").count(), 1, "{told}");
    drop(wrong);
    let _right = server(converter, "rtu");
    until("the raw port is used", || {
        (api(site.http, "pump-1")["state"] != "offline").then_some(())
    });
    until("the gateway is ready", || (ready()?.0 == 200).then_some(()));
}

#[test]
fn a_client_with_frames_of_rtu_is_named() {
    let line = "[gateway]\nname = \"test\"\n[[bus]]\nname = \"line1\"\nport = \"line1\"\nbaud = 38400\n";
    let site = Site::of(&[line, &drive("pump-1", 1, ""), MODBUS_TCP, HTTP]);
    let gateway = site.run();
    gateway.until_printed("drivegate is running");
    let script = root().join("tests/peers/rtu_client.py").display().to_string();
    // From address 0, where the request looks like the start of a Modbus TCP frame, and from an address where it does not.
    for (start, count) in [("0", "10"), ("0", "2"), ("2100", "11")] {
        let said = run_well(&python(), &[&script, &site.modbus.to_string(), start, count]);
        assert!(said.contains("closed"), "{said}");
    }
    let told = gateway.until_printed("the client speaks Modbus RTU over TCP; set it to Modbus TCP");
    assert_eq!(
        told.matches("speaks Modbus RTU over TCP").count(),
        1,
        "once in a while: {told}"
    );
}
