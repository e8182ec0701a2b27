//! What is answered to what: every kind of request in every state of plant and client, and single requests byte by byte.
//! `docs/modbus-tcp.md` shows the table of the former; `BLESS=1 cargo test --test north answers` writes it.

use std::fmt::Write as _;
use std::time::{Duration, SystemTime};

use drivegate::codec::Exception;
use drivegate::command::Outcome;
use drivegate::north::modbus_tcp::Uncached;
use drivegate::process_image::{Access, Link};

use super::rig::{Client, Rig, frame, options, plant, plant_where, registers, until, words, write};
use crate::support::tools;

const PROCESS_DATA: [u16; 11] = [0x0023, 0x2000, 5000, 2500, 1440, 123, 455, 387, 2301, 540, 0];

/// Unit 1, a Vacon NX with its coils and discrete inputs missing.
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

/// Names of the columns, and what they stand for.
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
fn kinds() -> Vec<(&'static str, u8, Vec<u8>, &'static str)> {
    let identify = vec![43, 14, 1, 0];
    vec![
        (
            "03 polled registers",
            NX,
            words(3, &[2100, 11]),
            "ok ok ok ok 0A 0B 0B 0A ok ok ok ok",
        ),
        (
            "04 the same",
            NX,
            words(4, &[2100, 11]),
            "ok ok ok ok 0A 0B 0B 0A ok ok ok ok",
        ),
        (
            "03 registers that are not polled",
            NX,
            words(3, &[500, 3]),
            "ok ok ok 02 0A 0B ok 0A 06 02 0B 04",
        ),
        (
            "03 more than the drive's limit per request",
            NX,
            words(3, &[500, 31]),
            "03 03 03 02 0A 03 03 0A 03 03 03 03",
        ),
        (
            "03 across the end of the raw view",
            NX,
            words(3, &[0x7FFF, 2]),
            "02 02 02 02 0A 02 02 02 02 02 02 02",
        ),
        (
            "03 quantity 0",
            NX,
            words(3, &[2100, 0]),
            "03 03 03 03 0A 03 03 03 03 03 03 03",
        ),
        (
            "03 quantity 126",
            NX,
            words(3, &[2100, 126]),
            "03 03 03 03 0A 03 03 03 03 03 03 03",
        ),
        (
            "03 or 04 common model, float block",
            NX,
            words(3, &[0x8000, 19]),
            "ok ok ok ok 0A ok ok ok ok ok ok ok",
        ),
        (
            "03 beyond the end of a block",
            NX,
            words(3, &[0x8014, 2]),
            "02 02 02 02 0A 02 02 02 02 02 02 02",
        ),
        (
            "01 polled coils",
            METER,
            words(1, &[7, 1]),
            "ok ok ok ok 0A 0B 0B 0A ok ok ok ok",
        ),
        (
            "02 polled discrete inputs",
            METER,
            words(2, &[3, 2]),
            "ok ok ok ok 0A 0B 0B 0A ok ok ok ok",
        ),
        (
            "01 coils that are not polled",
            METER,
            words(1, &[9, 10]),
            "ok ok ok 02 0A 0B ok 0A 06 02 0B 04",
        ),
        (
            "01 on a drive without coils",
            NX,
            words(1, &[0, 1]),
            "01 01 01 01 0A 01 01 01 01 01 01 01",
        ),
        (
            "02 on a drive without discrete inputs",
            NX,
            words(2, &[0, 1]),
            "01 01 01 01 0A 01 01 01 01 01 01 01",
        ),
        (
            "06 command, 0x8100",
            NX,
            words(6, &[0x8100, 1]),
            "ok 01 01 ok 0A 0B ok 0A 06 02 0B 04",
        ),
        (
            "16 command block",
            NX,
            write(0x8100, &[1, 2500, 0xFFFF, 9]),
            "ok 01 01 ok 0A 0B ok 0A 06 02 0B 04",
        ),
        (
            "06 heartbeat, 0x8103",
            NX,
            words(6, &[0x8103, 9]),
            "ok 01 01 ok 0A ok ok ok ok ok ok ok",
        ),
        (
            "06 command with undefined bits",
            NX,
            words(6, &[0x8100, 8]),
            "03 01 01 03 0A 03 03 03 03 03 03 03",
        ),
        (
            "06 a reference outside the limits",
            NX,
            words(6, &[0x8101, 10_001]),
            "03 01 01 03 0A 03 03 03 03 03 03 03",
        ),
        (
            "06 to the common model",
            NX,
            words(6, &[0x8004, 1]),
            "02 01 01 02 0A 02 02 02 02 02 02 02",
        ),
        (
            "06 raw register",
            NX,
            words(6, &[2002, 5000]),
            "ok 01 01 ok 0A 0B ok 0A 06 02 0B 04",
        ),
        (
            "16 raw registers",
            NX,
            write(2000, &[1, 0, 5000]),
            "ok 01 01 ok 0A 0B ok 0A 06 02 0B 04",
        ),
        (
            "06 raw register, read-only",
            NX,
            words(6, &[2100, 1]),
            "02 01 01 02 0A 02 02 02 02 02 02 02",
        ),
        (
            "06 raw register of no writable point",
            NX,
            words(6, &[101, 10_000]),
            "02 01 01 02 0A 02 02 02 02 02 02 02",
        ),
        (
            "16 raw registers, one of no writable point",
            NX,
            write(2001, &[0, 5000]),
            "02 01 01 02 0A 02 02 02 02 02 02 02",
        ),
        (
            "16 the same with the control word",
            NX,
            write(2000, &[1, 0, 5000]),
            "ok 01 01 ok 0A 0B ok 0A 06 02 0B 04",
        ),
        (
            "06 raw register, unmapped",
            NX,
            words(6, &[7000, 1]),
            "02 01 01 02 0A 02 02 02 02 02 02 02",
        ),
        (
            "06 raw register, value outside the profile",
            NX,
            words(6, &[2002, 10_001]),
            "03 01 01 03 0A 03 03 03 03 03 03 03",
        ),
        (
            "16 wrong byte count",
            NX,
            vec![16, 0x81, 0, 0, 1, 3, 0, 0, 0],
            "03 01 01 03 0A 03 03 03 03 03 03 03",
        ),
        (
            "05 coil",
            METER,
            words(5, &[7, 0xFF00]),
            "ok 01 01 ok 0A 0B ok 0A 06 02 0B 04",
        ),
        (
            "15 coils",
            METER,
            vec![15, 0, 7, 0, 2, 1, 3],
            "ok 01 01 ok 0A 0B ok 0A 06 02 0B 04",
        ),
        (
            "05 value neither on nor off",
            METER,
            words(5, &[7, 1]),
            "03 01 01 03 0A 03 03 03 03 03 03 03",
        ),
        (
            "15 wrong byte count",
            METER,
            vec![15, 0, 0, 0, 100, 1, 0],
            "03 01 01 03 0A 03 03 03 03 03 03 03",
        ),
        (
            "05 on a drive without coils",
            NX,
            words(5, &[0, 0xFF00]),
            "01 01 01 01 0A 01 01 01 01 01 01 01",
        ),
        (
            "22 mask write (not supported)",
            NX,
            words(22, &[2000, 0, 0]),
            "01 01 01 01 0A 01 01 01 01 01 01 01",
        ),
        (
            "23 read and write (not supported)",
            NX,
            vec![23, 8, 0x34, 0, 1, 7, 0xD0, 0, 1, 2, 0, 1],
            "01 01 01 01 0A 01 01 01 01 01 01 01",
        ),
        (
            "43/14 identification",
            NX,
            identify,
            "ok ok ok ok 0A ok ok ok ok ok ok ok",
        ),
        (
            "43/13, or any other function",
            NX,
            vec![43, 13, 1, 0],
            "01 01 01 01 0A 01 01 01 01 01 01 01",
        ),
    ]
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
        State::DriveRefuses => Some(Outcome::Exception(Exception(2))),
        State::DriveSilent => Some(Outcome::TimedOut),
        State::DriveOwnCode => Some(Outcome::Exception(Exception(0x21))),
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

/// Fills both queues; the clients that wait there must live on.
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
    let kinds = kinds();
    let mut found: Vec<Vec<String>> = vec![Vec::new(); kinds.len()];
    for (state, _, _) in STATES {
        let (rig, mut client) = scene(state).await;
        let waiting = if state == State::QueueFull {
            fill_queues(&rig).await
        } else {
            Vec::new()
        };
        for ((_, unit, request, _), row) in kinds.iter().zip(&mut found) {
            row.push(outcome(request, &client.ask(*unit, request).await));
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
    for ((what, _, _, wanted), row) in kinds.iter().zip(&found) {
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

/// Single requests to the plant of these tests and their answers, byte by byte.
fn examples() -> Vec<(&'static str, u8, Vec<u8>, Vec<u8>)> {
    let common = [
        0x80A3, 3, 0, 5000, 2500, 1440, 123, 455, 387, 2301, 540, 420, 0xFFFF, 0xFFFF, 0xFFFF, 0xFFFF, 5000, 2500,
    ];
    let (no_function, no_address, no_value) = (1, 2, 3);
    let refused = |function: u8, code: u8| vec![function | 0x80, code];
    vec![
        ("process data", 1, words(3, &[2100, 11]), registers(3, &PROCESS_DATA)),
        (
            "input is holding",
            1,
            words(4, &[2100, 11]),
            registers(4, &PROCESS_DATA),
        ),
        ("part of a poll", 1, words(3, &[2102, 2]), registers(3, &[5000, 2500])),
        ("status, state", 1, words(3, &[0x8000, 2]), registers(3, &common[..2])),
        ("fault code on", 1, words(4, &[0x8003, 16]), registers(4, &common[2..])),
        (
            "command block",
            1,
            words(3, &[0x8100, 4]),
            registers(3, &[1, 5000, 2500, 0]),
        ),
        ("float", 1, words(4, &[0x8200, 2]), registers(4, &[0x4248, 0])),
        ("monitored drive", 2, words(3, &[0x8004, 1]), registers(3, &[5000])),
        ("forwarded", 1, words(3, &[500, 3]), registers(3, &[500, 501, 502])),
        (
            "forwarded, limit",
            1,
            words(3, &[500, 30]),
            registers(3, &(500..530).collect::<Vec<u16>>()),
        ),
        (
            "forwarded, partly polled",
            1,
            words(3, &[7, 3]),
            registers(3, &[7, 8, 9]),
        ),
        ("discrete inputs", 4, words(2, &[3, 2]), vec![2, 1, 0b01]),
        ("coil", 4, words(1, &[7, 1]), vec![1, 1, 1]),
        ("forwarded bits", 4, words(1, &[9, 10]), vec![1, 2, 0b0100_1001, 0b10]),
        ("input", 4, words(4, &[5, 1]), registers(4, &[77])),
        (
            "common model of a meter",
            4,
            words(3, &[0x8000, 1]),
            registers(3, &[0x8002]),
        ),
        ("write coil", 4, words(5, &[7, 0xFF00]), words(5, &[7, 0xFF00])),
        ("write coils", 4, vec![15, 0, 7, 0, 2, 1, 3], words(15, &[7, 2])),
        ("raw write", 1, words(6, &[2002, 5000]), words(6, &[2002, 5000])),
        ("raw writes", 1, write(2000, &[1, 0, 5000]), words(16, &[2000, 3])),
        ("command", 1, words(6, &[0x8100, 1]), words(6, &[0x8100, 1])),
        (
            "commands",
            1,
            write(0x8100, &[1, 2500, 0xFFFF, 9]),
            words(16, &[0x8100, 4]),
        ),
        ("heartbeat", 1, words(6, &[0x8103, 9]), words(6, &[0x8103, 9])),
        ("no such unit", 9, words(3, &[0, 1]), refused(3, 0x0A)),
        ("no such unit 0", 0, words(3, &[0x8000, 1]), refused(3, 0x0A)),
        (
            "no such unit, unknown function",
            254,
            vec![0x41, 1],
            refused(0x41, 0x0A),
        ),
        ("unknown function", 1, vec![0x41, 1], refused(0x41, no_function)),
        ("diagnostics", 1, words(8, &[0, 0]), refused(8, no_function)),
        ("exception as function", 1, vec![0x83, 1], refused(0x83, no_function)),
        (
            "coils on a drive without",
            1,
            words(1, &[0, 1]),
            refused(1, no_function),
        ),
        (
            "inputs on a drive without",
            1,
            words(2, &[0, 0]),
            refused(2, no_function),
        ),
        (
            "coil write without coils",
            1,
            words(5, &[0, 0xFF00]),
            refused(5, no_function),
        ),
        ("mask write", 1, words(22, &[2000, 0, 0]), refused(22, no_function)),
        (
            "read and write",
            1,
            vec![23, 8, 0x34, 0, 1, 7, 0xD0, 0, 1, 2, 0, 1],
            refused(23, no_function),
        ),
        ("quantity 0", 1, words(3, &[2100, 0]), refused(3, no_value)),
        ("quantity 126", 1, words(3, &[2100, 126]), refused(3, no_value)),
        ("quantity 65535", 1, words(4, &[0, 65_535]), refused(4, no_value)),
        ("short read", 1, vec![3, 0, 0, 0], refused(3, no_value)),
        ("long read", 1, vec![3, 0, 0, 0, 1, 0], refused(3, no_value)),
        ("function only", 1, vec![3], refused(3, no_value)),
        (
            "past the last address",
            1,
            words(3, &[0xFFFF, 2]),
            refused(3, no_address),
        ),
        ("out of the raw view", 1, words(3, &[0x7FFF, 2]), refused(3, no_address)),
        (
            "out of the common model",
            1,
            words(3, &[0x8014, 2]),
            refused(3, no_address),
        ),
        (
            "after the common model",
            1,
            words(3, &[0x8015, 1]),
            refused(3, no_address),
        ),
        (
            "out of the command block",
            1,
            words(3, &[0x8103, 2]),
            refused(3, no_address),
        ),
        (
            "out of the float block",
            1,
            words(4, &[0x8219, 2]),
            refused(4, no_address),
        ),
        (
            "beyond the drive's limit",
            1,
            words(3, &[500, 31]),
            refused(3, no_value),
        ),
        (
            "beyond the limit of process data",
            1,
            words(3, &[2100, 21]),
            refused(3, no_value),
        ),
        ("beyond the limit of bits", 4, words(1, &[9, 17]), refused(1, no_value)),
        (
            "write to a monitored drive",
            2,
            words(6, &[0x8100, 1]),
            refused(6, no_function),
        ),
        ("same, raw", 2, words(6, &[2000, 1]), refused(6, no_function)),
        (
            "same, wrong address",
            2,
            words(6, &[0x8000, 1]),
            refused(6, no_function),
        ),
        (
            "same, wrong count",
            2,
            vec![16, 0x81, 0, 0, 1, 3, 0, 0, 0],
            refused(16, no_function),
        ),
        ("same, heartbeat", 2, words(6, &[0x8103, 1]), refused(6, no_function)),
        (
            "write to the common model",
            1,
            words(6, &[0x8000, 1]),
            refused(6, no_address),
        ),
        (
            "write to the float block",
            1,
            write(0x8200, &[0, 0]),
            refused(16, no_address),
        ),
        (
            "write past the command block",
            1,
            write(0x8103, &[0, 0]),
            refused(16, no_address),
        ),
        (
            "write into the command block from below",
            1,
            write(0x80FF, &[0, 0]),
            refused(16, no_address),
        ),
        (
            "raw write into the blocks",
            1,
            write(0x7FFF, &[0, 0]),
            refused(16, no_address),
        ),
        (
            "write to the status word",
            1,
            words(6, &[2100, 1]),
            refused(6, no_address),
        ),
        (
            "write to an unmapped address",
            1,
            words(6, &[7000, 1]),
            refused(6, no_address),
        ),
        (
            "wrong address and value",
            1,
            write(2100, &[0xFFFF]),
            refused(16, no_address),
        ),
        (
            "beyond the range, raw",
            1,
            words(6, &[2002, 10_001]),
            refused(6, no_value),
        ),
        ("beyond the range", 1, words(6, &[0x8101, 10_001]), refused(6, no_value)),
        ("two parameters", 1, write(732, &[1, 2]), refused(16, no_value)),
        (
            "maximum frequency, raw",
            1,
            words(6, &[101, 10_000]),
            refused(6, no_address),
        ),
        (
            "general control word alone",
            1,
            words(6, &[2001, 0]),
            refused(6, no_address),
        ),
        ("command bits", 1, words(6, &[0x8100, 8]), refused(6, no_value)),
        ("two references", 1, write(0x8101, &[5000, 2500]), refused(16, no_value)),
        (
            "no reference",
            1,
            write(0x8101, &[0x8000, 0xFFFF]),
            refused(16, no_value),
        ),
        ("beyond the band", 1, words(6, &[0x8102, 5001]), refused(6, no_value)),
        ("coil value", 4, words(5, &[7, 1]), refused(5, no_value)),
        (
            "odd byte count",
            1,
            vec![16, 0x81, 0, 0, 1, 3, 0, 0, 0],
            refused(16, no_value),
        ),
        (
            "byte count too small",
            4,
            vec![15, 0, 0, 0, 100, 1, 0],
            refused(15, no_value),
        ),
        (
            "write of quantity 0",
            1,
            vec![16, 0x81, 0, 0, 0, 0],
            refused(16, no_value),
        ),
        (
            "write of 124 registers",
            1,
            vec![16, 0, 0, 0, 124, 248],
            refused(16, no_value),
        ),
        ("gateway", 255, words(4, &[0, 4]), registers(4, &[1, 3, 2, 500])),
        (
            "gateway, holding",
            255,
            words(3, &[16, 4]),
            registers(3, &[1, 1, 1, 500]),
        ),
        (
            "gateway, cycle unknown",
            255,
            words(4, &[4, 2]),
            registers(4, &[0xFFFF, 0xFFFF]),
        ),
        ("after the last bus", 255, words(4, &[32, 1]), refused(4, no_address)),
        (
            "gateway has no blocks",
            255,
            words(4, &[0x8000, 1]),
            refused(4, no_address),
        ),
        (
            "gateway accepts no writes",
            255,
            words(6, &[0, 1]),
            refused(6, no_function),
        ),
        ("gateway has no bits", 255, words(1, &[0, 1]), refused(1, no_function)),
        ("gateway, quantity 0", 255, words(4, &[0, 0]), refused(4, no_value)),
    ]
}

#[tokio::test]
async fn answers_byte_by_byte() {
    let rig = Rig::new().await;
    let mut client = rig.client().await;
    let examples = examples();
    for (what, unit, request, answer) in &examples {
        assert_eq!(client.ask(*unit, request).await, *answer, "{what}");
    }
    let counted: u64 = rig.stats.modbus_tcp.requests().iter().map(|(_, _, n)| n).sum();
    assert_eq!(counted, examples.len() as u64);
    rig.end().await;
}

/// Holds a part of the page against what the tests have found; `BLESS=1` writes it.
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
