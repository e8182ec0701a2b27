//! The simulator of the product and the independent drives show the same status, bit for bit, in every state.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use drivegate_model::drive::profile::{Profiles, WriteFunctions};
use drivegate_proto::{RequestPdu, Table};
use drivegate_sim::simulated_drive::{DriveOptions, ModelOptions, SimulatedDrive};
use drivegate_testkit::Order::Word;
use drivegate_testkit::{families, number, rows};

use super::cases::{Case, Order, cases};
use super::rtu;
use crate::support::process::{Running, free_port};
use crate::support::tools::{python, root};

/// Columns: profile, and its status registers with the relevant bits: all except fault codes, which each side
/// causes differently. For Hitachi, coils.
const STATUS: &str = "\
abb-acs550         | 3
abb-acs580         | 3
danfoss-fc         | 50199
siemens-v20        | 109
siemens-g120       | 109
schneider-altivar  | 3201
yaskawa-v1000      | 0x2C 0x4B
delta-ms300        | 0x2101
invt-goodrive      | 0x2100
mitsubishi-d700    | 8
invertek-optidrive | 5&0xFF
weg-cfw            | 680
fuji-frenic        | 0x080E
hitachi-wj200      | c14 c15 c16 c19 c23
toshiba-vf-s15     | 0xFD01
ls-g100            | 13
teco-f510          | 0x2520
vacon-10           | 2100";

/// Time that is longer than any of the drives needs to reach a state.
const SETTLED: Duration = Duration::from_secs(20);

/// Time that the independent drives need to reach half of their speed.
const AT_SPEED: Duration = Duration::from_millis(1200);

struct Status {
    table: Table,
    address: u16,
    mask: u16,
}

fn status(text: &str) -> Status {
    let (place, mask) = text
        .split_once('&')
        .map_or((text, u16::MAX), |(place, mask)| (place, number(mask)));
    let (table, address) = match place.strip_prefix('c') {
        Some(coil) => (Table::Coil, coil),
        None => (Table::Holding, place),
    };
    Status {
        table,
        address: number(address),
        mask,
    }
}

/// The simulated and the independent drive of a family.
struct Both {
    peer: Running,
    line: TcpStream,
    simulated: SimulatedDrive,
    functions: WriteFunctions,
    now: Duration,
}

impl Both {
    fn new(case: &Case) -> Both {
        let port = free_port();
        let program = root().join("tests/peers/families/run.py").display().to_string();
        let peer = Running::start(&python(), &[&program, case.peer, &port.to_string(), "slow"]);
        peer.until_printed("ready");
        let line = TcpStream::connect(("127.0.0.1", port)).unwrap();
        line.set_read_timeout(Some(SETTLED)).unwrap();
        let profiles = Profiles::built_in();
        let profile = profiles.get(case.profile).unwrap();
        let model = ModelOptions::of_profile(profile).unwrap();
        let mut both = Both {
            peer,
            line,
            simulated: SimulatedDrive::new(DriveOptions::new(1, model), Duration::ZERO),
            functions: profile.functions,
            now: Duration::ZERO,
        };
        both.wait(100);
        both
    }

    fn wait(&mut self, milliseconds: u64) {
        self.now += Duration::from_millis(milliseconds);
        self.simulated.advance(self.now);
    }

    fn send(&mut self, orders: &[Order]) {
        for order in orders {
            let pdu = match *order {
                Order::Raw(Word(address, word)) | Order::Model(_, address, word) => {
                    self.functions.write_register(address, word)
                }
                Order::Raw(order) => order.pdu(),
            };
            self.by_line(&pdu, 8);
            self.simulated.answer(&pdu, self.now);
            self.wait(100);
        }
    }

    /// The reply of the independent drive on its line.
    fn by_line(&mut self, pdu: &RequestPdu, length: usize) -> Vec<u8> {
        let mut bytes = Vec::new();
        pdu.encode(&mut bytes);
        self.line.write_all(&rtu(1, &bytes)).unwrap();
        let mut reply = vec![0; length];
        self.line.read_exact(&mut reply).unwrap();
        reply
    }

    /// The status words of both drives.
    fn words(&mut self, status: &Status) -> (u16, u16) {
        let read = RequestPdu::read(status.table, status.address, 1);
        let simulated = self.simulated.answer(&read, self.now).unwrap().into_words().unwrap()[0];
        let independent = match status.table {
            Table::Coil => u16::from(self.by_line(&read, 6)[3] & 1),
            _ => {
                let reply = self.by_line(&read, 7);
                u16::from_be_bytes([reply[3], reply[4]])
            }
        };
        (simulated & status.mask, independent & status.mask)
    }
}

/// Stops both drives at speed; returns whether they agree while the motor slows down. If the machine stalled
/// meanwhile, the independent drive may have stopped before it was read, and is started again.
fn passes_through_the_same(both: &mut Both, case: &Case, all: &[Status]) -> bool {
    both.send(&case.start);
    both.wait(10_000);
    std::thread::sleep(AT_SPEED);
    let before = both.peer.output().len();
    both.send(&case.stop);
    loop {
        let same = all.iter().all(|status| {
            let (simulated, independent) = both.words(status);
            simulated == independent
        });
        let is_over = both.peer.output()[before..].contains("motor stopped");
        if same || is_over {
            return same && !is_over;
        }
    }
}

fn agrees(case: &Case, all: &[Status]) {
    let mut both = Both::new(case);
    let name = case.profile;
    let family = families().into_iter().find(|family| family.profile == name).unwrap();
    let turns_back = !family.reverse.is_empty();
    let shows_the_same = |both: &mut Both, state: &str| {
        let deadline = Instant::now() + SETTLED;
        loop {
            let words: Vec<(u16, u16)> = all.iter().map(|status| both.words(status)).collect();
            if words.iter().all(|(simulated, independent)| simulated == independent) {
                break;
            }
            assert!(
                Instant::now() < deadline,
                "{name}, {state}: simulated and independent {words:04x?}"
            );
            std::thread::sleep(Duration::from_millis(20));
        }
    };
    shows_the_same(&mut both, "switched on");
    both.send(&case.reference);
    both.send(&case.start);
    both.wait(10_000);
    shows_the_same(&mut both, "running forward");
    let passes = (0..5).any(|_| passes_through_the_same(&mut both, case, all));
    assert!(passes, "{name}, coming down: other words than the independent drive's");
    both.wait(10_000);
    shows_the_same(&mut both, "stopped");
    if turns_back {
        both.send(&case.reverse);
        both.wait(10_000);
        shows_the_same(&mut both, "running in reverse");
        both.send(&case.stop);
        both.wait(10_000);
        shows_the_same(&mut both, "stopped again");
    }
    both.send(&case.reference);
    both.send(&case.start);
    both.wait(10_000);
    shows_the_same(&mut both, "running forward again");
    both.peer.signal("USR1");
    both.simulated.trip(3);
    both.wait(100);
    shows_the_same(&mut both, "tripped");
    if !case.reset.is_empty() {
        both.send(&case.reset);
        both.wait(10_000);
        shows_the_same(&mut both, "reset");
    }
}

/// Tests every third family, so that three tests run side by side.
fn every_third(first: usize) {
    let rows = rows::<2>(STATUS);
    let cases = cases();
    assert_eq!(rows.len(), cases.len());
    for (case, [profile, registers]) in cases.iter().zip(rows).skip(first).step_by(3) {
        assert_eq!(case.profile, profile);
        let all: Vec<Status> = registers.split_whitespace().map(status).collect();
        agrees(case, &all);
    }
}

#[test]
fn simulated_drives_show_what_independent_ones_show_1() {
    every_third(0);
}

#[test]
fn simulated_drives_show_what_independent_ones_show_2() {
    every_third(1);
}

#[test]
fn simulated_drives_show_what_independent_ones_show_3() {
    every_third(2);
}
