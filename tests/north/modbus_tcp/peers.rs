//! Clients that were written elsewhere work off one script of reads and writes: Debian's mbpoll (libmodbus), pymodbus,
//! modbus-serial and jsmodbus (Node), tokio-modbus.

use std::process::Command;

use drivegate_core::order::Order;
use serde::Deserialize;
use tokio_modbus::client::{Reader, Writer};
use tokio_modbus::slave::{Slave, SlaveContext};

use super::rig::Rig;
use crate::support::tools;

/// A request of `tests/peers/script.json`, with the result that it must have.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Step {
    what: String,
    unit: u8,
    function: u8,
    address: u16,
    /// Expected result of a read; its length is the count.
    #[serde(default)]
    expect: Vec<u16>,
    /// Values of a write.
    #[serde(default)]
    values: Vec<u16>,
    exception: Option<u8>,
}

fn script() -> Vec<Step> {
    let text = std::fs::read_to_string(tools::root().join("tests/peers/script.json")).unwrap();
    serde_json::from_str(&text).unwrap()
}

/// Whether the client program succeeded, and its output.
async fn run(mut command: Command) -> (bool, String) {
    let output = tokio::task::spawn_blocking(move || {
        command
            .output()
            .unwrap_or_else(|why| panic!("{command:?}: {why}; run tests/tools/install.sh"))
    });
    let output = output.await.unwrap();
    let text = [output.stdout, output.stderr].concat();
    (output.status.success(), String::from_utf8_lossy(&text).into_owned())
}

/// Checks that the script's allowed writes have reached the bus.
fn assert_written(rig: &Rig) {
    let written = rig.buses.iter().flat_map(|bus| bus.orders());
    let written = written.filter(|order| !matches!(order, Order::Read(_))).count();
    let wanted = script()
        .iter()
        .filter(|s| !s.values.is_empty() && s.exception.is_none())
        .count();
    assert_eq!(written, wanted);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn mbpoll() {
    let rig = Rig::new().await;
    let port = rig.address().port().to_string();
    for step in script() {
        let mut command = Command::new(tools::tool("mbpoll"));
        let kind = match step.function {
            1 | 5 | 15 => "0",
            2 => "1",
            4 => "3",
            _ => "4",
        };
        command.args(["-m", "tcp", "-0", "-1", "-q", "-o", "10", "-p", &port, "-t", kind]);
        command.args(["-a", &step.unit.to_string(), "-r", &step.address.to_string()]);
        if step.values.is_empty() {
            command.args(["-c", &step.expect.len().to_string()]);
        }
        command.arg("127.0.0.1").args(step.values.iter().map(u16::to_string));
        let (done, text) = run(command).await;
        let name = match step.exception {
            None => "",
            Some(1) => "Illegal function",
            Some(2) => "Illegal data address",
            Some(3) => "Illegal data value",
            Some(10) => "Gateway path unavailable",
            Some(11) => "Target device failed to respond",
            Some(code) => panic!("exception {code} is not in the script so far"),
        };
        assert!(
            done == step.exception.is_none() && text.contains(name),
            "{}: {text}",
            step.what
        );
        for (address, value) in (step.address..).zip(&step.expect).filter(|_| done) {
            let line = text
                .lines()
                .find_map(|line| line.strip_prefix(&format!("[{address}]:")));
            let shown = line.and_then(|line| line.split_whitespace().next()).unwrap_or_default();
            assert_eq!(shown, value.to_string(), "{}: {text}", step.what);
        }
    }
    assert_written(&rig);
    rig.end().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn tokio_modbus() {
    let rig = Rig::new().await;
    let mut client = tokio_modbus::client::tcp::connect_slave(rig.address(), Slave(1))
        .await
        .unwrap();
    let numbers = |bits: Vec<bool>| bits.into_iter().map(u16::from).collect::<Vec<u16>>();
    for step in script() {
        client.set_slave(Slave(step.unit));
        let (address, count) = (step.address, step.expect.len() as u16);
        let bits: Vec<bool> = step.values.iter().map(|v| *v != 0).collect();
        let none = |()| Vec::new();
        let answer = match step.function {
            1 => client.read_coils(address, count).await.unwrap().map(numbers),
            2 => client.read_discrete_inputs(address, count).await.unwrap().map(numbers),
            3 => client.read_holding_registers(address, count).await.unwrap(),
            4 => client.read_input_registers(address, count).await.unwrap(),
            5 => client.write_single_coil(address, bits[0]).await.unwrap().map(none),
            6 => client
                .write_single_register(address, step.values[0])
                .await
                .unwrap()
                .map(none),
            15 => client.write_multiple_coils(address, &bits).await.unwrap().map(none),
            _ => client
                .write_multiple_registers(address, &step.values)
                .await
                .unwrap()
                .map(none),
        };
        let wanted = match step.exception {
            Some(code) => Err(code),
            None => Ok(step.expect),
        };
        assert_eq!(answer.map_err(u8::from), wanted, "{}", step.what);
    }
    assert_written(&rig);
    rig.end().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn pymodbus() {
    let rig = Rig::new().await;
    let mut command = Command::new(tools::python());
    command
        .arg(tools::root().join("tests/peers/pymodbus_client.py"))
        .arg(rig.address().port().to_string());
    assert_eq!(run(command).await, (true, "ok\n".to_string()));
    assert_written(&rig);
    rig.end().await;
}

async fn node(library: &str) {
    let rig = Rig::new().await;
    let mut command = Command::new(tools::tool("node"));
    command.env("NODE_PATH", tools::root().join(".tools/node/node_modules"));
    command
        .arg(tools::root().join("tests/peers/node_client.js"))
        .arg(library)
        .arg(rig.address().port().to_string());
    assert_eq!(run(command).await, (true, "ok\n".to_string()));
    assert_written(&rig);
    rig.end().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn modbus_serial() {
    node("modbus-serial").await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn jsmodbus() {
    node("jsmodbus").await;
}
