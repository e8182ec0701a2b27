//! Clients that were written elsewhere: Debian's mbpoll, tokio-modbus and pymodbus.

use std::path::{Path, PathBuf};
use std::process::Command;

use drivegate::command::Order;
use tokio_modbus::client::{Reader, Writer};
use tokio_modbus::slave::{Slave, SlaveContext};

use crate::rig::Rig;

/// The output of a client, which must end well unless `fails`.
async fn run(mut command: Command, fails: bool) -> String {
    let output = tokio::task::spawn_blocking(move || {
        command
            .output()
            .unwrap_or_else(|why| panic!("{command:?}: {why}; it is needed for this test"))
    })
    .await
    .unwrap();
    let text = format!(
        "{}{}",
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    );
    assert_eq!(output.status.success(), !fails, "{text}");
    text
}

/// mbpoll with PDU addresses, one poll.
fn mbpoll(rig: &Rig, arguments: &[&str], values: &[&str]) -> Command {
    let mut command = Command::new("mbpoll");
    let port = rig.address().port().to_string();
    command.args(["-m", "tcp", "-0", "-1", "-q", "-p", &port]);
    command.args(arguments).arg("127.0.0.1").args(values);
    command
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn mbpoll_reads_and_commands() {
    let rig = Rig::new().await;
    let text = run(mbpoll(&rig, &["-a", "1", "-r", "32768", "-c", "19"], &[]), false).await;
    for wanted in [
        "[32768]: \t32931",
        "[32769]: \t3",
        "[32772]: \t5000",
        "[32773]: \t2500",
        "[32784]: \t65535",
    ] {
        assert!(text.contains(wanted), "{wanted} is missing in\n{text}");
    }
    let text = run(
        mbpoll(&rig, &["-a", "1", "-t", "3", "-r", "2100", "-c", "11"], &[]),
        false,
    )
    .await;
    assert!(text.contains("[2104]: \t1440"), "{text}");
    let text = run(
        mbpoll(&rig, &["-a", "1", "-t", "4:float", "-B", "-r", "33280", "-c", "9"], &[]),
        false,
    )
    .await;
    assert!(
        text.contains("[33282]: \t25") && text.contains("[33286]: \t12.3"),
        "{text}"
    );
    let text = run(mbpoll(&rig, &["-a", "1", "-r", "33024"], &["1", "5000"]), false).await;
    assert!(text.contains("Written 2 references"), "{text}");
    assert!(matches!(rig.buses[0].orders().as_slice(), [Order::Points(values)] if values.len() == 3));
    let text = run(mbpoll(&rig, &["-a", "2", "-r", "33024"], &["1"]), true).await;
    assert!(text.contains("Illegal function"), "{text}");
    let text = run(mbpoll(&rig, &["-a", "3", "-r", "2100"], &[]), true).await;
    assert!(text.contains("Target device failed to respond"), "{text}");
    let text = run(mbpoll(&rig, &["-a", "77", "-r", "2100"], &[]), true).await;
    assert!(text.contains("Gateway path unavailable"), "{text}");
    rig.end().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn tokio_modbus_reads_and_commands() {
    let rig = Rig::new().await;
    let mut client = tokio_modbus::client::tcp::connect_slave(rig.address(), Slave(1))
        .await
        .unwrap();
    assert_eq!(
        client.read_holding_registers(0x8004, 2).await.unwrap().unwrap(),
        [5000, 2500]
    );
    assert_eq!(client.read_input_registers(500, 2).await.unwrap().unwrap(), [500, 501]);
    client.write_single_register(0x8101, 2500).await.unwrap().unwrap();
    client
        .write_multiple_registers(2000, &[1, 0, 5000])
        .await
        .unwrap()
        .unwrap();
    let refused = client.write_single_register(2100, 1).await.unwrap().unwrap_err();
    assert_eq!(refused, tokio_modbus::ExceptionCode::IllegalDataAddress);
    client.set_slave(Slave(4));
    assert_eq!(client.read_discrete_inputs(3, 2).await.unwrap().unwrap(), [true, false]);
    client.write_single_coil(7, false).await.unwrap().unwrap();
    client.set_slave(Slave(255));
    assert_eq!(client.read_input_registers(0, 3).await.unwrap().unwrap(), [1, 3, 2]);
    rig.end().await;
}

/// The Python of the project's tools, else one with pymodbus.
fn python() -> PathBuf {
    let venv = Path::new(env!("CARGO_MANIFEST_DIR")).join(".tools/venv/bin/python");
    if venv.exists() { venv } else { PathBuf::from("python3") }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn pymodbus_reads_and_commands() {
    let rig = Rig::new().await;
    let mut command = Command::new(python());
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/peers/pymodbus_client.py");
    command.arg(script).arg(rig.address().port().to_string());
    let text = run(command, false).await;
    assert_eq!(text.trim(), "ok");
    rig.end().await;
}
