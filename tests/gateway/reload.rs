//! Signals and reloads: clients stay connected, and no hanging file delays a stop.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::process::Command;

use crate::support::process::{Notifications, PATIENCE, Running, drivegate, get, until, until_ready};
use crate::support::site::{HTTP, LINE1, MODBUS_TCP, Site, controlled};

const READ: [u8; 12] = [0, 1, 0, 0, 0, 6, 1, 3, 0x08, 0x36, 0, 1];
const WRITE: [u8; 12] = [0, 1, 0, 0, 0, 6, 1, 6, 0x81, 0x01, 0x07, 0xD0];
const MAY_NOT_WRITE: [u8; 9] = [0, 1, 0, 0, 0, 3, 1, 0x86, 1];

fn site() -> Site {
    Site::of(&[LINE1, &controlled("pump-1", 1, ""), MODBUS_TCP, HTTP])
}

/// A client that stays connected.
struct Client(TcpStream);

impl Client {
    fn connect(port: u16) -> Client {
        let stream = TcpStream::connect(SocketAddr::from(([127, 0, 0, 1], port))).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        Client(stream)
    }

    fn ask(&mut self, request: &[u8]) -> Vec<u8> {
        self.0.write_all(request).unwrap();
        let mut answer = vec![0; 6];
        self.0.read_exact(&mut answer).expect("an answer");
        let length = usize::from(answer[5]);
        answer.resize(6 + length, 0);
        self.0.read_exact(&mut answer[6..]).unwrap();
        answer
    }

    fn is_closed(&mut self) -> bool {
        matches!(self.0.read(&mut [0]), Ok(0) | Err(_))
    }
}

#[test]
fn clients_stay_connected_over_a_reload() {
    let site = site();
    let _line = site.line(&[1]);
    let gateway = site.run_ready();
    let mut client = Client::connect(site.modbus);
    until("a write", || (client.ask(&WRITE) == WRITE).then_some(()));

    // A new address that cannot be bound disconnects nobody.
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let before = site.change(
        &format!("127.0.0.1:{}", site.http),
        &taken.local_addr().unwrap().to_string(),
    );
    site.change("write = [\"127.0.0.1/32\"]", "write = []");
    gateway.signal("HUP");
    let log = gateway.until_printed("keeping the current configuration");
    assert!(
        log.contains("reload rejected") && log.contains("another program uses it"),
        "{log}"
    );
    assert_eq!(client.ask(&WRITE), WRITE);
    assert_eq!(get(site.http, "/readyz").unwrap().0, 200);

    // The reload changes rights and limits, and the connection follows them.
    site.configure(&[&before]);
    site.change("write = [\"127.0.0.1/32\"]", "write = []\nmax_connections = 5");
    gateway.signal("HUP");
    gateway.until_printed("configuration reloaded");
    assert_eq!(client.ask(&WRITE), MAY_NOT_WRITE);
    assert_eq!(client.ask(&READ).len(), 11);

    // A client that is no longer allowed is disconnected.
    site.change("write = []", "write = []\nallow = [\"127.0.0.2/32\"]");
    gateway.signal("HUP");
    assert!(client.is_closed());
    until("both reloads", || {
        (gateway.output().matches("configuration reloaded").count() == 2).then_some(())
    });
}

#[test]
fn an_address_that_overlaps_the_old_one_takes_its_place() {
    let site = site();
    let _line = site.line(&[1]);
    let gateway = site.run_ready();
    site.change("listen = [\"127.0.0.1:", "listen = [\"0.0.0.0:");
    gateway.signal("HUP");
    gateway.until_printed("configuration reloaded");
    assert_eq!(Client::connect(site.modbus).ask(&READ).len(), 11);
    assert_eq!(get(site.http, "/readyz").unwrap().0, 200);
}

#[test]
fn signals_count_from_the_first_moment() {
    let site = site();
    let _line = site.line(&[1]);
    for round in 0..20 {
        let mut gateway = site.run();
        // The signal handlers are installed before any other thread starts; before that the program only reads its
        // arguments.
        let handled = || {
            let status = std::fs::read_to_string(format!("/proc/{}/status", gateway.pid())).ok()?;
            let caught = status.lines().find_map(|line| line.strip_prefix("SigCgt:"))?;
            (u64::from_str_radix(caught.trim(), 16).ok()? & 1 == 1).then_some(())
        };
        until("a handler of SIGHUP", handled);
        gateway.signal("HUP");
        if round % 2 == 0 {
            until_ready(site.http);
            gateway.until_printed("configuration reloaded");
        }
        gateway.signal("TERM");
        assert!(gateway.ended().success(), "round {round}");
    }
}

fn make_pipe(site: &Site, name: &str) {
    let made = Command::new("mkfifo").arg(site.file(name)).status().unwrap();
    assert!(made.success());
}

#[test]
fn a_file_that_cannot_be_read_holds_up_neither_the_watchdog_nor_a_stop() {
    let site = site();
    let _line = site.line(&[1]);
    let notified = Notifications::at(site.file("notify"));
    let run = || {
        let mut command = drivegate(&["run", "--config", &site.config()]);
        Running::spawn(notified.of(&mut command))
    };
    let mut gateway = run();
    notified.until("READY=1");
    // `profile_dirs` is the folder of the site.
    make_pipe(&site, "pipe.toml");
    gateway.signal("HUP");
    notified.until("RELOADING=1");
    notified.until("WATCHDOG=1");
    notified.until("WATCHDOG=1");
    assert_eq!(Client::connect(site.modbus).ask(&READ).len(), 11);
    gateway.signal("TERM");
    assert!(gateway.ended().success());
    gateway.until_printed("drivegate has stopped");

    // A start with such a file can be ended as well.
    let mut gateway = run();
    let reads = || {
        let tasks = std::fs::read_dir(format!("/proc/{}/task", gateway.pid())).ok()?;
        let mut names = tasks.filter_map(|task| std::fs::read_to_string(task.ok()?.path().join("comm")).ok());
        names.any(|name| name.trim() == "load").then_some(())
    };
    until("the configuration is being read", reads);
    gateway.signal("TERM");
    assert!(gateway.ended().success());
}
