//! Every kind of request with its answer in every state of plant and client, and single requests byte by byte. The
//! table is part of `docs/modbus-tcp.md`; `BLESS=1 cargo test --test north answers` writes it.

use std::fmt::Write as _;
use std::time::{Duration, SystemTime};

use drivegate_core::order::Outcome;
use drivegate_core::process_image::{Access, Link};
use drivegate_north::modbus_tcp::Uncached;
use drivegate_proto::Exception;

use drivegate_testkit::{number, rows};

use super::rig::{Client, Rig, frame, options, plant, plant_where, registers, until, words, write};
use crate::support::tools;

/// Unit 1: a Vacon NX without coils and discrete inputs.
const NX: u8 = 1;
/// Unit 4, a family with all four tables.
const METER: u8 = 4;

/// The state of plant and client, a column of the table.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum State {
    Usual,
    NotInWrite,
    Monitor,
    Refuse,
    NoUnit,
    Offline,
    Stale,
    BusDown,
    QueueFull,
    DriveRefuses,
    DriveSilent,
    DriveOwnCode,
}

/// Names of the table's columns with their meaning.
const STATES: [(State, &str, &str); 12] = [
    (
        State::Usual,
        "usual",
        "the drive is online, `access = \"control\"`, the client may write",
    ),
    (
        State::NotInWrite,
        "client",
        "the client may not write: it is not in `write`, or its certificate has no role with that permission",
    ),
    (State::Monitor, "monitor", "the drive has `access = \"monitor\"`"),
    (State::Refuse, "uncached", "`uncached = \"refuse\"`"),
    (
        State::NoUnit,
        "unit",
        "no such unit, or the listener does not serve its bus",
    ),
    (State::Offline, "offline", "the drive is offline"),
    (
        State::Stale,
        "stale",
        "the drive is online but its values are older than `stale_after`",
    ),
    (State::BusDown, "bus", "the port of the bus is not open"),
    (State::QueueFull, "queue", "the queue of the bus is full"),
    (State::DriveRefuses, "refusal", "the drive replies with exception 02"),
    (
        State::DriveSilent,
        "silence",
        "the drive does not reply to this request",
    ),
    (
        State::DriveOwnCode,
        "own code",
        "the drive replies with its own exception code, 0x21",
    ),
];

/// A kind of request, a row of the table: what, unit, PDU, and the outcome in each state.
const KINDS: &str = "\
03 polled registers                        | 1 | 3 2100 11                            | ok ok ok ok 0A 0B 0B 0A ok ok ok ok
04 the same                                | 1 | 4 2100 11                            | ok ok ok ok 0A 0B 0B 0A ok ok ok ok
03 registers that are not polled           | 1 | 3 500 3                              | ok ok ok 02 0A 0B ok 0A 06 02 0B 04
03 more than the drive's limit per request | 1 | 3 500 31                             | 03 03 03 02 0A 03 03 0A 03 03 03 03
03 across the end of the raw view          | 1 | 3 0x7FFF 2                           | 02 02 02 02 0A 02 02 02 02 02 02 02
03 quantity 0                              | 1 | 3 2100 0                             | 03 03 03 03 0A 03 03 03 03 03 03 03
03 quantity 126                            | 1 | 3 2100 126                           | 03 03 03 03 0A 03 03 03 03 03 03 03
03 or 04 common model, float block         | 1 | 3 0x8000 19                          | ok ok ok ok 0A ok ok ok ok ok ok ok
03 beyond the end of a block               | 1 | 3 0x8014 2                           | 02 02 02 02 0A 02 02 02 02 02 02 02
01 polled coils                            | 4 | 1 7 1                                | ok ok ok ok 0A 0B 0B 0A ok ok ok ok
02 polled discrete inputs                  | 4 | 2 3 2                                | ok ok ok ok 0A 0B 0B 0A ok ok ok ok
01 coils that are not polled               | 4 | 1 9 10                               | ok ok ok 02 0A 0B ok 0A 06 02 0B 04
01 on a drive without coils                | 1 | 1 0 1                                | 01 01 01 01 0A 01 01 01 01 01 01 01
02 on a drive without discrete inputs      | 1 | 2 0 1                                | 01 01 01 01 0A 01 01 01 01 01 01 01
06 command, 0x8100                         | 1 | 6 0x8100 1                           | ok 01 01 ok 0A 0B ok 0A 06 02 0B 04
16 command block                           | 1 | 0x8100 <- 1 2500 0xFFFF 9            | ok 01 01 ok 0A 0B ok 0A 06 02 0B 04
06 heartbeat, 0x8103                       | 1 | 6 0x8103 9                           | ok 01 01 ok 0A ok ok ok ok ok ok ok
06 command with undefined bits             | 1 | 6 0x8100 8                           | 03 01 01 03 0A 03 03 03 03 03 03 03
06 a reference outside the limits          | 1 | 6 0x8101 10001                       | 03 01 01 03 0A 03 03 03 03 03 03 03
06 to the common model                     | 1 | 6 0x8004 1                           | 02 01 01 02 0A 02 02 02 02 02 02 02
06 raw register                            | 1 | 6 2002 5000                          | ok 01 01 ok 0A 0B ok 0A 06 02 0B 04
16 raw registers                           | 1 | 2000 <- 1 0 5000                     | ok 01 01 ok 0A 0B ok 0A 06 02 0B 04
06 raw register, read-only                 | 1 | 6 2100 1                             | 02 01 01 02 0A 02 02 02 02 02 02 02
06 raw register of no writable point       | 1 | 6 101 10000                          | 02 01 01 02 0A 02 02 02 02 02 02 02
16 raw registers, one of no writable point | 1 | 2001 <- 0 5000                       | 02 01 01 02 0A 02 02 02 02 02 02 02
16 the same with the control word          | 1 | 2000 <- 1 0 5000                     | ok 01 01 ok 0A 0B ok 0A 06 02 0B 04
06 raw register, unmapped                  | 1 | 6 7000 1                             | 02 01 01 02 0A 02 02 02 02 02 02 02
06 raw register, value outside the profile | 1 | 6 2002 10001                         | 03 01 01 03 0A 03 03 03 03 03 03 03
16 wrong byte count                        | 1 | bytes 16 0x81 0 0 1 3 0 0 0          | 03 01 01 03 0A 03 03 03 03 03 03 03
05 coil                                    | 4 | 5 7 0xFF00                           | ok 01 01 ok 0A 0B ok 0A 06 02 0B 04
15 coils                                   | 4 | bytes 15 0 7 0 2 1 3                 | ok 01 01 ok 0A 0B ok 0A 06 02 0B 04
05 value neither on nor off                | 4 | 5 7 1                                | 03 01 01 03 0A 03 03 03 03 03 03 03
15 wrong byte count                        | 4 | bytes 15 0 0 0 100 1 0               | 03 01 01 03 0A 03 03 03 03 03 03 03
05 on a drive without coils                | 1 | 5 0 0xFF00                           | 01 01 01 01 0A 01 01 01 01 01 01 01
22 mask write (not supported)              | 1 | 22 2000 0 0                          | 01 01 01 01 0A 01 01 01 01 01 01 01
23 write and read                          | 1 | bytes 23 8 0x34 0 1 7 0xD0 0 1 2 0 1 | ok 01 01 ok 0A 0B 0B 0A 06 02 0B 04
43/14 identification                       | 1 | bytes 43 14 1 0                      | ok ok ok ok 0A ok ok ok ok ok ok ok
43/13, or any other function               | 1 | bytes 43 13 1 0                      | 01 01 01 01 0A 01 01 01 01 01 01 01";

/// A PDU as the tables write it: `3 2100 11` is a function with words, `3 = 5000 2500` has the registers that were read,
/// `2000 <- 1 0` writes registers, `3 ! 2` is an exception, and `bytes 43 14` are bytes.
fn pdu(text: &str) -> Vec<u8> {
    let numbers = |text: &str| -> Vec<u16> {
        let all = text.split_whitespace().map(|part| match part.split_once("..") {
            Some((first, end)) => (number(first)..number(end)).collect(),
            None => vec![number(part)],
        });
        all.flatten().collect()
    };
    if let Some(bytes) = text.strip_prefix("bytes") {
        numbers(bytes).iter().map(|byte| *byte as u8).collect()
    } else if let Some((function, values)) = text.split_once('=') {
        registers(number(function) as u8, &numbers(values))
    } else if let Some((start, values)) = text.split_once("<-") {
        write(number(start), &numbers(values))
    } else if let Some((function, code)) = text.split_once('!') {
        vec![number(function) as u8 | 0x80, number(code) as u8]
    } else {
        let all = numbers(text);
        words(all[0] as u8, &all[1..])
    }
}

/// A gateway in that state, with a client.
async fn scene(state: State) -> (Rig, Client) {
    let mut options = options();
    if state == State::Refuse {
        options.uncached = Uncached::Refuse;
    }
    let mut plant = match state {
        State::Monitor => plant_where(|spec| spec.access = Access::Monitor),
        State::NoUnit => plant_where(|spec| spec.unit += 100),
        _ => plant(),
    };
    if state == State::Stale {
        plant.stale_after = Duration::from_nanos(1);
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
    let rig = Rig::of(plant, options).await;
    for bus in &rig.plant.load().buses {
        for drive in &bus.image.drives {
            if state == State::Offline {
                drive.update(|s| s.link = Link::Offline(SystemTime::now()));
            }
        }
        bus.image.update_health(|h| h.up = state != State::BusDown);
    }
    let outcome = match state {
        State::DriveRefuses => Some(Outcome::Exception(Exception::Modbus(2))),
        State::DriveSilent => Some(Outcome::TimedOut),
        State::DriveOwnCode => Some(Outcome::Exception(Exception::Modbus(0x21))),
        _ => None,
    };
    if let Some(outcome) = outcome {
        for bus in &rig.buses {
            let outcome = outcome.clone();
            bus.answers(move |_| Some(outcome.clone()));
        }
    }
    let from = if state == State::NotInWrite {
        [127, 0, 0, 2]
    } else {
        [127, 0, 0, 1]
    };
    let client = Client::connect_from(from, rig.address()).await;
    (rig, client)
}

/// Fills both queues; returns the clients that wait there, which must be kept alive.
async fn fill_queues(rig: &Rig) -> Vec<Client> {
    let mut waiting = Vec::new();
    for (bus, unit, address) in [(0, NX, 2003), (1, METER, 50)] {
        rig.buses[bus].pause(true);
        for n in 1..=4 {
            let mut client = rig.client().await;
            let batch: Vec<u8> = (0..16u16)
                .flat_map(|t| frame(t, unit, &words(6, &[address, t])))
                .collect();
            client.send(&batch).await;
            waiting.push(client);
            until("16 more wait", || rig.buses[bus].waiting() == 16 * n).await;
        }
    }
    waiting
}

/// `ok`, or the code of the exception.
fn outcome(request: &[u8], answer: &[u8]) -> String {
    if answer[0] == request[0] {
        return "ok".to_string();
    }
    assert_eq!((answer.len(), answer[0]), (2, request[0] | 0x80), "{answer:?}");
    format!("{:02X}", answer[1])
}

#[tokio::test]
async fn every_request_in_every_state() {
    let kinds = rows::<4>(KINDS);
    let mut found: Vec<Vec<String>> = vec![Vec::new(); kinds.len()];
    for (state, _, _) in STATES {
        let (rig, mut client) = scene(state).await;
        let waiting = if state == State::QueueFull {
            fill_queues(&rig).await
        } else {
            Vec::new()
        };
        for ([_, unit, request, _], row) in kinds.iter().zip(&mut found) {
            let request = pdu(request);
            row.push(outcome(&request, &client.ask(unit.parse().unwrap(), &request).await));
        }
        rig.buses.iter().for_each(|bus| bus.pause(false));
        drop(waiting);
        rig.end().await;
    }
    let (mut table, mut wrong) = (String::from("|request|"), String::new());
    for (_, name, _) in STATES {
        let _ = write!(table, "{name}|");
    }
    table.push_str("\n|---|");
    STATES.iter().for_each(|_| table.push_str("---|"));
    for ([what, _, _, wanted], row) in kinds.iter().zip(&found) {
        let cells = row.join(" ");
        if cells != *wanted {
            let _ = writeln!(wrong, "{what}: found {cells}, wanted {wanted}");
        }
        let _ = write!(table, "\n|{what}|{}|", row.join("|"));
    }
    assert_eq!(wrong, "");
    table.push_str("\n\n|column|state|\n|---|---|");
    for (_, name, what) in STATES {
        let _ = write!(table, "\n|{name}|{what}|");
    }
    documented("answers", &table);
}

/// Columns: description, unit id, request, answer. Single requests to the plant of these tests, byte by byte.
const EXAMPLES: &str = "\
process data                            |   1 | 3 2100 11                            | 3 = 0x0023 0x2000 5000 2500 1440 123 455 387 2301 540 0
input is holding                        |   1 | 4 2100 11                            | 4 = 0x0023 0x2000 5000 2500 1440 123 455 387 2301 540 0
part of a poll                          |   1 | 3 2102 2                             | 3 = 5000 2500
status, state                           |   1 | 3 0x8000 2                           | 3 = 0x80A3 3
fault code on                           |   1 | 4 0x8003 16                          | 4 = 0 5000 2500 1440 123 455 387 2301 540 420 0xFFFF 0xFFFF 0xFFFF 0xFFFF 5000 2500
command block                           |   1 | 3 0x8100 4                           | 3 = 1 5000 2500 0
float                                   |   1 | 4 0x8200 2                           | 4 = 0x4248 0
monitored drive                         |   2 | 3 0x8004 1                           | 3 = 5000
forwarded                               |   1 | 3 500 3                              | 3 = 500 501 502
forwarded, limit                        |   1 | 3 500 30                             | 3 = 500..530
forwarded, partly polled                |   1 | 3 7 3                                | 3 = 7 8 9
discrete inputs                         |   4 | 2 3 2                                | bytes 2 1 1
coil                                    |   4 | 1 7 1                                | bytes 1 1 1
forwarded bits                          |   4 | 1 9 10                               | bytes 1 2 0x49 2
input                                   |   4 | 4 5 1                                | 4 = 77
common model of a meter                 |   4 | 3 0x8000 1                           | 3 = 0x8002
write coil                              |   4 | 5 7 0xFF00                           | 5 7 0xFF00
write coils                             |   4 | bytes 15 0 7 0 2 1 3                 | 15 7 2
raw write                               |   1 | 6 2002 5000                          | 6 2002 5000
raw writes                              |   1 | 2000 <- 1 0 5000                     | 16 2000 3
command                                 |   1 | 6 0x8100 1                           | 6 0x8100 1
commands                                |   1 | 0x8100 <- 1 2500 0xFFFF 9            | 16 0x8100 4
heartbeat                               |   1 | 6 0x8103 9                           | 6 0x8103 9
no such unit                            |   9 | 3 0 1                                | 3 ! 0x0A
no such unit 0                          |   0 | 3 0x8000 1                           | 3 ! 0x0A
no such unit, unknown function          | 254 | bytes 0x41 1                         | 0x41 ! 0x0A
unknown function                        |   1 | bytes 0x41 1                         | 0x41 ! 1
diagnostics                             |   1 | 8 0 0                                | 8 ! 1
exception as function                   |   1 | bytes 0x83 1                         | 0x83 ! 1
coils on a drive without                |   1 | 1 0 1                                | 1 ! 1
inputs on a drive without               |   1 | 2 0 0                                | 2 ! 1
coil write without coils                |   1 | 5 0 0xFF00                           | 5 ! 1
mask write                              |   1 | 22 2000 0 0                          | 22 ! 1
write and read                          |   1 | bytes 23 8 0x34 0 1 7 0xD0 0 1 2 0 1 | 23 = 0x0023
quantity 0                              |   1 | 3 2100 0                             | 3 ! 3
quantity 126                            |   1 | 3 2100 126                           | 3 ! 3
quantity 65535                          |   1 | 4 0 65535                            | 4 ! 3
short read                              |   1 | bytes 3 0 0 0                        | 3 ! 3
long read                               |   1 | bytes 3 0 0 0 1 0                    | 3 ! 3
function only                           |   1 | bytes 3                              | 3 ! 3
past the last address                   |   1 | 3 0xFFFF 2                           | 3 ! 2
out of the raw view                     |   1 | 3 0x7FFF 2                           | 3 ! 2
out of the common model                 |   1 | 3 0x8014 2                           | 3 ! 2
after the common model                  |   1 | 3 0x8015 1                           | 3 ! 2
out of the command block                |   1 | 3 0x8103 2                           | 3 ! 2
out of the float block                  |   1 | 4 0x8219 2                           | 4 ! 2
beyond the drive's limit                |   1 | 3 500 31                             | 3 ! 3
beyond the limit of process data        |   1 | 3 2100 21                            | 3 ! 3
beyond the limit of bits                |   4 | 1 9 17                               | 1 ! 3
write to a monitored drive              |   2 | 6 0x8100 1                           | 6 ! 1
same, raw                               |   2 | 6 2000 1                             | 6 ! 1
same, wrong address                     |   2 | 6 0x8000 1                           | 6 ! 1
same, wrong count                       |   2 | bytes 16 0x81 0 0 1 3 0 0 0          | 16 ! 1
same, heartbeat                         |   2 | 6 0x8103 1                           | 6 ! 1
write to the common model               |   1 | 6 0x8000 1                           | 6 ! 2
write to the float block                |   1 | 0x8200 <- 0 0                        | 16 ! 2
write past the command block            |   1 | 0x8103 <- 0 0                        | 16 ! 2
write into the command block from below |   1 | 0x80FF <- 0 0                        | 16 ! 2
raw write into the blocks               |   1 | 0x7FFF <- 0 0                        | 16 ! 2
write to the status word                |   1 | 6 2100 1                             | 6 ! 2
write to an unmapped address            |   1 | 6 7000 1                             | 6 ! 2
wrong address and value                 |   1 | 2100 <- 0xFFFF                       | 16 ! 2
beyond the range, raw                   |   1 | 6 2002 10001                         | 6 ! 3
beyond the range                        |   1 | 6 0x8101 10001                       | 6 ! 3
two parameters                          |   1 | 732 <- 1 2                           | 16 ! 3
maximum frequency, raw                  |   1 | 6 101 10000                          | 6 ! 2
general control word alone              |   1 | 6 2001 0                             | 6 ! 2
command bits                            |   1 | 6 0x8100 8                           | 6 ! 3
two references                          |   1 | 0x8101 <- 5000 2500                  | 16 ! 3
no reference                            |   1 | 0x8101 <- 0x8000 0xFFFF              | 16 ! 3
beyond the band                         |   1 | 6 0x8102 5001                        | 6 ! 3
coil value                              |   4 | 5 7 1                                | 5 ! 3
odd byte count                          |   1 | bytes 16 0x81 0 0 1 3 0 0 0          | 16 ! 3
byte count too small                    |   4 | bytes 15 0 0 0 100 1 0               | 15 ! 3
write of quantity 0                     |   1 | bytes 16 0x81 0 0 0 0                | 16 ! 3
write of 124 registers                  |   1 | bytes 16 0 0 0 124 248               | 16 ! 3
gateway                                 | 255 | 4 0 4                                | 4 = 1 3 2 500
gateway, holding                        | 255 | 3 16 4                               | 3 = 1 1 1 500
gateway, cycle unknown                  | 255 | 4 4 2                                | 4 = 0xFFFF 0xFFFF
after the last bus                      | 255 | 4 32 1                               | 4 ! 2
gateway has no blocks                   | 255 | 4 0x8000 1                           | 4 ! 2
gateway accepts no writes               | 255 | 6 0 1                                | 6 ! 1
gateway has no bits                     | 255 | 1 0 1                                | 1 ! 1
gateway, quantity 0                     | 255 | 4 0 0                                | 4 ! 3";

#[tokio::test]
async fn answers_byte_by_byte() {
    let rig = Rig::new().await;
    let mut client = rig.client().await;
    let examples = rows::<4>(EXAMPLES);
    for [what, unit, request, answer] in &examples {
        let answered = client.ask(unit.parse().unwrap(), &pdu(request)).await;
        assert_eq!(answered, pdu(answer), "{what}");
    }
    let counted: u64 = rig.stats.modbus_tcp.requests().iter().map(|(_, _, n)| n).sum();
    assert_eq!(counted, examples.len() as u64);
    rig.end().await;
}

/// Compares a part of the page with the results of the tests; `BLESS=1` writes it.
fn documented(part: &str, found: &str) {
    let page = tools::root().join("docs/modbus-tcp.md");
    let text = std::fs::read_to_string(&page).unwrap();
    let (begin, end) = (
        format!("<!-- {part}: generated -->\n"),
        format!("\n<!-- {part}: end -->"),
    );
    let (before, rest) = text.split_once(&begin).expect("the mark of the part");
    let (shown, after) = rest.split_once(&end).expect("the end of the part");
    if shown.trim() == found.trim() {
        return;
    }
    assert!(
        std::env::var_os("BLESS").is_some(),
        "docs/modbus-tcp.md does not show in `{part}` what is answered; read the difference, then write it by \
         BLESS=1 cargo test --test north answers"
    );
    std::fs::write(&page, format!("{before}{begin}\n{}\n{end}{after}", found.trim())).unwrap();
}
