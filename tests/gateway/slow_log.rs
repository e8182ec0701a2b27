//! The log is not read any more: a full pipe must not block a client.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::process::{Child, Command};

use crate::support::process::{PATIENCE, get, until};
use crate::support::site::{HTTP, LINE1, MODBUS_TCP, Site, controlled};

struct Unread(Child);

impl Drop for Unread {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn ask(client: &mut TcpStream, unit: u8, pdu: &[u8; 5]) -> Vec<u8> {
    client
        .write_all(&[&[0, 1, 0, 0, 0, 6, unit], &pdu[..]].concat())
        .unwrap();
    let mut header = [0; 6];
    client.read_exact(&mut header).expect("an answer within the timeout");
    let mut rest = vec![0; usize::from(header[5])];
    client.read_exact(&mut rest).unwrap();
    rest.split_off(1)
}

#[test]
fn a_log_that_nobody_reads_holds_nobody_up() {
    let modbus = MODBUS_TCP.replace("127.0.0.1/32", "127.0.0.9/32");
    let site = Site::of(&[LINE1, &controlled("pump", 1, ""), &modbus, HTTP]);
    let (log, writer) = std::io::pipe().unwrap();
    let mut other = writer.try_clone().unwrap();
    let mut gateway = Command::new(env!("CARGO_BIN_EXE_drivegate"));
    gateway.args(["run", "--config", &site.config()]).stderr(writer);
    let mut gateway = Unread(gateway.spawn().unwrap());
    until("the metrics", || get(site.http, "/metrics"));
    // A pipe holds 64 KiB: this blocks until the reader closes.
    let filling = std::thread::spawn(move || other.write_all(&vec![b'x'; 1 << 20]));
    let mut client = TcpStream::connect(("127.0.0.1", site.modbus)).unwrap();
    client.set_read_timeout(Some(PATIENCE)).unwrap();
    // The gateway refuses each request, because the client is not in `write`.
    for _ in 0..1000 {
        assert_eq!(ask(&mut client, 1, &[6, 0x81, 0x00, 0, 0]), [0x86, 1]);
    }
    assert_eq!(
        ask(&mut client, 255, &[4, 0, 0, 0, 1]),
        [4, 2, 0, 0],
        "the bus is down, as it must be"
    );
    let pid = gateway.0.id().to_string();
    assert!(Command::new("kill").args(["-TERM", &pid]).status().unwrap().success());
    let status = until("the end", || gateway.0.try_wait().unwrap());
    assert!(status.success(), "{status}");
    drop(log);
    assert!(filling.join().unwrap().is_err(), "the pipe was full");
}
