//! Families whose profiles come from reports: the real gateway with each profile against a drive in Python that was
//! written from the documents of the family, not from the profile. The words in these tests were also worked out by
//! hand.

mod behind_its_back;
mod cases;
mod confirmed;
mod direction;
mod other_stops;
mod own_timeout;
mod parameters;
mod path;
mod status;
mod words;

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use cases::{Case, Order, cases};

use crate::support::process::{PATIENCE, Running, api, free_port, until};
use crate::support::site::{HTTP, LINE1, MODBUS_TCP, Site, curl};
use crate::support::tools::{python, root};

/// Each profile with the module of its Python drive.
pub(super) fn peers() -> impl Iterator<Item = (&'static str, &'static str)> {
    let mut all: Vec<_> = cases().iter().map(|case| (case.profile, case.peer)).collect();
    all.sort_unstable();
    all.dedup();
    all.into_iter()
}

/// A gateway with the drive that it commands.
struct Rig {
    site: Site,
    /// Port of the tool slot. Through it, the tests reach addresses that belong to the common model over Modbus TCP.
    slot: u16,
    /// The slot that also passes broadcasts on.
    raw_slot: u16,
    drive: Running,
    _gateway: Running,
}

impl Rig {
    fn new(case: &Case, unprepared: bool) -> Rig {
        Rig::polled_every("50ms", case, unprepared)
    }

    fn polled_every(cycle: &str, case: &Case, unprepared: bool) -> Rig {
        let more = if unprepared { &["unprepared"][..] } else { &[] };
        Rig::with(cycle, "", case, more)
    }

    /// `keys` are further keys of the drive in the configuration, `more` further arguments of the drive in Python.
    fn with(cycle: &str, keys: &str, case: &Case, more: &[&str]) -> Rig {
        let (port, slot, raw_slot) = (free_port(), free_port(), free_port());
        let bus = LINE1
            .replace("port = \"line1\"", &format!("port = \"tcp://127.0.0.1:{port}\""))
            .replace("name = \"test\"", "name = \"test\"\nsocket = \"own.sock\"");
        let drive = format!(
            "cycle = \"{cycle}\"\nslow_cycle = \"200ms\"\n[[bus.drive]]\nname = \"drive\"\naddress = 1\nprofile = \"{}\"\n\
             access = \"control\"\n{keys}[[bus.slot]]\nlisten = \"127.0.0.1:{slot}\"\naccess = \"write\"\n\
             [[bus.slot]]\nlisten = \"127.0.0.1:{raw_slot}\"\naccess = \"raw\"\n",
            case.profile
        );
        let site = Site::of(&[&bus, &drive, MODBUS_TCP, HTTP]);
        let program = root().join("tests/peers/families/run.py").display().to_string();
        let port = port.to_string();
        let mut arguments = vec![program.as_str(), case.peer, &port];
        arguments.extend(more);
        let drive = Running::start(&python(), &arguments);
        drive.until_printed("ready");
        let gateway = site.run_ready();
        Rig {
            site,
            slot,
            raw_slot,
            drive,
            _gateway: gateway,
        }
    }

    /// Sends the orders and checks that the drive receives each of them.
    fn order(&self, orders: &[Order]) {
        for order in orders {
            let before = self.drive.output().len();
            // On a busy machine the gateway may consider an order older than the stop before it, and answer 06; after a pause
            // of the machine an order has expired, 0B.
            let answer = until("an answer", || {
                Some(self.exchange(order)).filter(|answer| ![6, 11].map(Answer::Exception).contains(answer))
            });
            assert_eq!(answer, Answer::Done, "{order:?}");
            let wanted = order.as_seen();
            until(&wanted, || {
                self.drive.output().get(before..)?.contains(&wanted).then_some(())
            });
        }
    }

    /// Waits until the drive has printed `text` more often than `times`.
    fn printed(&self, text: &str, times: usize) {
        until(text, || {
            (self.drive.output().matches(text).count() > times).then_some(())
        });
    }

    fn is_refused(&self, order: &Order) -> bool {
        self.exchange(order) == Answer::Exception(3)
    }

    fn exchange(&self, order: &Order) -> Answer {
        let pdu = order.pdu();
        let hidden = !matches!(order, Order::Model(..)) && pdu[1] >= 0x80;
        if hidden {
            self.by_slot(1, &pdu)
        } else {
            self.by_modbus_tcp(&pdu)
        }
    }

    fn by_modbus_tcp(&self, pdu: &[u8]) -> Answer {
        let head = [0, 1, 0, 0, 0, pdu.len() as u8 + 1, 1];
        answer(self.site.modbus, &[&head[..], pdu].concat(), 7)
    }

    fn by_slot(&self, address: u8, pdu: &[u8]) -> Answer {
        answer(self.slot, &rtu(address, pdu), 1)
    }

    /// Gives a command with named values over the local socket; returns status and result.
    fn command(&self, values: &str) -> (u16, serde_json::Value) {
        self.post("drives/drive/commands", values)
    }

    fn post(&self, path: &str, body: &str) -> (u16, serde_json::Value) {
        let socket = self.site.path("own.sock");
        let url = format!("http://gateway/api/v1/{path}");
        curl(&["--unix-socket", &socket, "-d", body, &url])
    }

    /// Number of times that the motor has started to turn.
    fn starts(&self) -> usize {
        let output = self.drive.output();
        output.matches("motor forward").count() + output.matches("motor reverse").count()
    }

    fn state(&self) -> String {
        api(self.site.http, "drive")["state"]
            .as_str()
            .unwrap_or_default()
            .to_string()
    }
}

/// Sends a request on a separate connection; `head` is the number of bytes before the function of the reply. A slot serves four
/// tools, and refuses a connection while it has not noticed the end of former ones; it does not answer what has expired.
fn answer(port: u16, frame: &[u8], head: usize) -> Answer {
    until("a reply", || answer_once(port, frame, head).ok())
}

fn answer_once(port: u16, frame: &[u8], head: usize) -> std::io::Result<Answer> {
    let mut stream = TcpStream::connect(("127.0.0.1", port))?;
    stream.set_read_timeout(Some(PATIENCE / 10))?;
    stream.write_all(frame)?;
    let mut reply = vec![0; head + 2];
    stream.read_exact(&mut reply)?;
    Ok(match reply[head] & 0x80 {
        0 => Answer::Done,
        _ => Answer::Exception(reply[head + 1]),
    })
}

/// The RTU frame of a request.
fn rtu(address: u8, pdu: &[u8]) -> Vec<u8> {
    let mut frame = [&[address], pdu].concat();
    let shift = |crc: u16| if crc & 1 == 1 { crc >> 1 ^ 0xA001 } else { crc >> 1 };
    let crc = frame.iter().fold(0xFFFF, |crc, byte| {
        (0..8).fold(crc ^ u16::from(*byte), |crc, _| shift(crc))
    });
    frame.extend(crc.to_le_bytes());
    frame
}

#[derive(Debug, PartialEq)]
enum Answer {
    Done,
    Exception(u8),
}

/// Checks reference, start, reverse, stop, a fault and its reset, and words that are not passed on.
fn obeys(case: &Case) {
    let rig = Rig::new(case, false);
    let name = case.profile;
    assert_ne!(rig.state(), "running", "{name}");
    rig.order(&case.reference);
    rig.order(&case.start);
    rig.printed("motor forward", 0);
    rig.site.until_state("drive", "running");
    let speed = || {
        rig.site
            .point("drive", "output_frequency")
            .as_f64()
            .filter(|hertz| hertz.abs() > 1.0)
    };
    if case.shows_frequency {
        until("a frequency", speed);
    }
    rig.order(&case.stop);
    rig.printed("motor stopped", 0);
    until("the end of running", || (rig.state() != "running").then_some(()));
    let mut stopped = 1;
    if !case.reverse.is_empty() {
        rig.order(&case.reverse);
        rig.printed("motor reverse", 0);
        rig.site.until_state("drive", "running");
        if case.shows_reversed {
            rig.site.until_point("drive", "reversed", true);
        }
    }
    for order in &case.refused {
        assert!(rig.is_refused(order), "{name}: {order:?}");
    }
    rig.order(&case.stop);
    if !case.reverse.is_empty() {
        rig.printed("motor stopped", stopped);
        stopped += 1;
    }
    rig.order(&case.reference);
    rig.order(&case.start);
    rig.printed("motor forward", 1);
    rig.drive.signal("USR1");
    rig.printed("motor stopped", stopped);
    rig.site.until_state("drive", "fault");
    if !case.reset.is_empty() {
        rig.order(&case.reset);
        rig.printed("\nreset", 0);
        until("the end of the fault", || (rig.state() != "fault").then_some(()));
        // Time in which a reset must not start the motor.
        std::thread::sleep(Duration::from_millis(300));
        assert_eq!(rig.drive.output().matches("motor forward").count(), 2, "{name}");
        assert_ne!(rig.state(), "running", "{name}");
    }
}

/// A drive that is not prepared does not run, and is not reported as running.
fn stays(case: &Case) {
    let rig = Rig::new(case, true);
    rig.order(&case.reference);
    rig.order(&case.start);
    std::thread::sleep(Duration::from_millis(500));
    assert!(!rig.drive.output().contains("motor"), "{}", case.profile);
    assert_ne!(rig.state(), "running", "{}", case.profile);
    rig.order(&case.stop);
}

/// The common model's command word.
fn command(run: bool, reverse: bool, reset: bool) -> Order {
    Order::Model(u16::from(run) | u16::from(reverse) << 1 | u16::from(reset) << 2, 0, 0)
}

/// Orders of the common model: the gateway makes the words, and the drive must do as ordered.
fn obeys_the_common_model(case: &Case) {
    let rig = Rig::new(case, false);
    let name = case.profile;
    let done = |order: Order| {
        assert_eq!(
            rig.exchange(&order),
            Answer::Done,
            "{name}: {order:?}\n{}",
            rig.drive.output()
        )
    };
    // The drives of these two peers reverse by the sign of the reference.
    let turns_back = !["abb", "invertek"].contains(&case.peer);
    rig.order(&case.reference);
    done(command(true, false, false));
    rig.printed("motor forward", 0);
    rig.site.until_state("drive", "running");
    // The repeated command changes nothing.
    done(command(true, false, false));
    std::thread::sleep(Duration::from_millis(200));
    assert!(!rig.drive.output().contains("motor stopped"), "{name}");
    done(command(false, false, false));
    rig.printed("motor stopped", 0);
    until("the end of running", || (rig.state() != "running").then_some(()));
    if turns_back {
        done(command(false, true, false));
        std::thread::sleep(Duration::from_millis(300));
        assert!(
            !rig.drive.output().contains("motor reverse"),
            "{name}: the direction starts nothing"
        );
        done(command(true, true, false));
        rig.printed("motor reverse", 0);
        rig.site.until_state("drive", "running");
        done(command(false, true, false));
        rig.printed("motor stopped", 1);
        until("the end of running", || (rig.state() != "running").then_some(()));
    }
    let forward = rig.drive.output().matches("motor forward").count();
    done(command(true, false, false));
    rig.printed("motor forward", forward);
    let stopped = rig.drive.output().matches("motor stopped").count();
    rig.drive.signal("USR1");
    rig.printed("motor stopped", stopped);
    rig.site.until_state("drive", "fault");
    done(command(false, false, true));
    rig.printed("\nreset", 0);
    until("the end of the fault", || (rig.state() != "fault").then_some(()));
    std::thread::sleep(Duration::from_millis(300));
    assert_eq!(
        rig.drive.output().matches("motor forward").count(),
        forward + 1,
        "{name}"
    );
    assert_ne!(rig.state(), "running", "{name}: no reset starts the motor");
    done(command(true, false, false));
    rig.printed("motor forward", forward + 1);
    done(command(false, false, false));
}

/// A start that the drive does not carry out fails if the family has a start sequence, and leaves no run command in
/// the drive.
fn fails_to_start(case: &Case) {
    let rig = Rig::new(case, true);
    rig.order(&case.reference);
    let answer = rig.exchange(&command(true, false, false));
    assert_eq!(answer != Answer::Done, case.has_sequence(), "{}", case.profile);
    std::thread::sleep(Duration::from_millis(300));
    assert!(!rig.drive.output().contains("motor"), "{}", case.profile);
    assert_eq!(
        rig.exchange(&command(false, false, false)),
        Answer::Done,
        "{}",
        case.profile
    );
}

/// Tests every third family, so that three tests run side by side.
fn every_third(first: usize, check: fn(&Case)) {
    for case in cases().iter().skip(first).step_by(3) {
        println!("{}", case.profile);
        check(case);
    }
}

#[test]
fn drives_obey_their_words_1() {
    every_third(0, obeys);
}

#[test]
fn drives_obey_their_words_2() {
    every_third(1, obeys);
}

#[test]
fn drives_obey_their_words_3() {
    every_third(2, obeys);
}

#[test]
fn unprepared_drives_stay_1() {
    every_third(0, stays);
}

#[test]
fn unprepared_drives_stay_2() {
    every_third(1, stays);
}

#[test]
fn unprepared_drives_stay_3() {
    every_third(2, stays);
}

#[test]
fn drives_obey_the_common_model_1() {
    every_third(0, obeys_the_common_model);
}

#[test]
fn drives_obey_the_common_model_2() {
    every_third(1, obeys_the_common_model);
}

#[test]
fn drives_obey_the_common_model_3() {
    every_third(2, obeys_the_common_model);
}

#[test]
fn a_start_that_is_not_followed_fails() {
    for case in cases().iter().filter(|case| case.has_sequence()) {
        fails_to_start(case);
    }
}
