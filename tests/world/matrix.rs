//! The fault matrix: what goes wrong on a line, byte by byte in virtual time, and what the bus makes of it.
//!
//! Every read-only register of a simulated drive holds the drive's address and its own, so a value that came from
//! elsewhere proves itself.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use drivegate::codec::wire::Silence;
use drivegate::codec::{Protocol, Table};
use drivegate::command::{Order, Outcome};
use drivegate::drive::Point;
use drivegate::drive::profile::{Profile, Profiles};
use drivegate::plant::Placed;
use drivegate::sim::drive::{DriveOptions, ModelOptions};
use drivegate::sim::faults::{Fault, FaultPlan};
use drivegate::sim::half_duplex::Delivery;
use drivegate::sim::nx::{NxOptions, Values};

use super::bus::{Parts, Seen};
use super::orders::unique_reference;
use super::rig::{Counts, Rig, line, write};

const DRIVES: u8 = 3;
/// How long faults come at a high rate.
const STORM: Duration = Duration::from_secs(30);
/// Time between the answer to a write and the next one.
const PAUSE: Duration = Duration::from_millis(7);
/// Time in which all drives are back behind a storm: the longest back-off, and a round.
const BACK: Duration = Duration::from_secs(15);

/// Two blocks of process data that look alike on the wire.
fn twins() -> Arc<Profile> {
    let mut text = String::from(
        "name = \"twins\"\nprotocols = [\"modbus-rtu\", \"modbus-ascii\"]\n\
         [[range]]\ntable = \"holding\"\nfirst = 2000\nlast = 2010\nread = 20\nwrite = 20\n\
         [[range]]\ntable = \"holding\"\nfirst = 2100\nlast = 2110\nread = 20\n\
         [[point]]\nname = \"reference\"\nat = \"holding 2002\"\nclass = \"slow\"\nwrite = true\n",
    );
    for address in (2100..2103).chain(2104..2107) {
        text += &format!("[[point]]\nname = \"p{address}\"\nat = \"holding {address}\"\nclass = \"fast\"\n");
    }
    Arc::new(Profile::parse("twins.toml", &text, false).unwrap())
}

fn rig(protocol: Protocol, delivery: Delivery) -> Rig {
    let (baud, profile) = match protocol {
        Protocol::N2 => (9600, Profiles::built_in().get("vacon-nx-n2").unwrap().clone()),
        Protocol::ModbusRtu | Protocol::ModbusAscii => (115_200, twins()),
    };
    let drive = |address| {
        let values = Values::Tagged(address);
        let model = ModelOptions::Nx(NxOptions {
            values,
            ..NxOptions::default()
        });
        DriveOptions::new(address, model)
    };
    let parts = Parts {
        profile,
        drives: (1..=DRIVES).map(drive).collect(),
        faults: FaultPlan::default(),
        delivery,
        silence: if protocol == Protocol::N2 {
            Silence::Spec
        } else {
            Silence::Chars
        },
    };
    let mut rig = Rig::new(&line("vacon-nx", protocol, baud, DRIVES), parts);
    rig.until("all drives are read", BACK, Rig::is_whole);
    rig.run(BACK);
    rig
}

/// What the counters must tell of a fault.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Tells {
    /// Nothing: the exchange goes well.
    Nothing,
    Timeouts,
    Corrupt,
    Foreign,
    ForeignAndTimeouts,
    Exceptions,
    /// Whatever, but the line goes on.
    All,
}

impl Tells {
    fn fits(self, c: &Counts) -> bool {
        let quiet = c.timeout == 0 && c.corrupt == 0;
        match self {
            // The first write behind a change of the echo may have to tell the echo by its time.
            Tells::Nothing => quiet && c.exception == 0 && c.foreign <= 1,
            Tells::Timeouts => c.timeout > 0 && c.exception == 0,
            // A bit error may lengthen the reply, a cut one may be as short as nothing.
            Tells::Corrupt => c.corrupt > 0 && c.timeout == 0 && c.exception == 0,
            Tells::Foreign => c.foreign > 0 && c.timeout == 0 && c.exception == 0,
            Tells::ForeignAndTimeouts => c.foreign > 0 && c.timeout > 0 && c.exception == 0,
            Tells::Exceptions => c.exception > 0 && quiet,
            Tells::All => true,
        }
    }
}

/// A row: a fault, and what comes of it.
#[derive(Clone)]
struct Row {
    fault: String,
    rates: String,
    tells: Tells,
    /// Good exchanges, of those of the sound line, at least.
    share: f64,
    /// Whether drives are now and then taken for dead.
    vanish: bool,
    delivery: Delivery,
}

struct Met {
    counts: Counts,
    acknowledged: u32,
    writes: u32,
    share: f64,
    vanished: u32,
    recovery: Option<Duration>,
    wrong: Vec<String>,
}

impl fmt::Display for Met {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let c = &self.counts;
        let recovery = self.recovery.map_or("-".to_string(), |time| format!("{time:.1?}"));
        write!(
            f,
            "{:>6}{:>7}{:>6}{:>8}{:>8}{:>8}{:>6}/{:<6}{:>6.3}{:>5}{:>10}  {}",
            c.faults,
            c.ok,
            c.exception,
            c.timeout,
            c.corrupt,
            c.foreign,
            self.acknowledged,
            self.writes,
            self.share,
            self.vanished,
            recovery,
            if self.wrong.is_empty() {
                "ok".to_string()
            } else {
                format!("FAILED: {}", self.wrong.join("; "))
            }
        )
    }
}

/// A line with a client that writes ever new values to the first drive, and all that is watched meanwhile.
struct Watched {
    rig: Rig,
    protocol: Protocol,
    truth: BTreeMap<(usize, Table, u16), u16>,
    waiting: Option<(Placed, u16)>,
    next_write: std::time::Instant,
    acknowledged: u32,
    writes: u32,
    vanished: u32,
    online: [bool; DRIVES as usize],
    wrong: Vec<String>,
}

impl Watched {
    fn new(protocol: Protocol, delivery: Delivery) -> Watched {
        let rig = rig(protocol, delivery);
        let mut watched = Watched {
            next_write: rig.now,
            rig,
            protocol,
            truth: BTreeMap::new(),
            waiting: None,
            acknowledged: 0,
            writes: 0,
            vanished: 0,
            online: [true; DRIVES as usize],
            wrong: Vec::new(),
        };
        for drive in 0..usize::from(DRIVES) {
            watched.truth.extend(watched.stored(drive));
        }
        if protocol != Protocol::N2 {
            for (&(drive, _, register), &word) in &watched.truth {
                assert_eq!(word, u16::from_be_bytes([drive as u8 + 1, register.to_be_bytes()[1]]));
            }
        }
        watched
    }

    /// What the image has of the process data of a drive.
    fn stored(&self, drive: usize) -> Vec<((usize, Table, u16), u16)> {
        let image = &self.rig.bus.handle.image.drives[drive];
        let snapshot = image.snapshot();
        let commanded = |table: Table, at: u16| {
            let points = &image.spec.profile.points;
            let covers = |point: &Point| point.write && point.raw().is_some_and(|raw| raw.covers(table, at));
            points.iter().any(covers)
        };
        let words = image.plan.reads.iter();
        let words = words.flat_map(|read| (read.start..read.start + read.count).map(|at| (read.table, at)));
        let stored = words
            .filter(|(table, at)| !commanded(*table, *at))
            .filter_map(|(table, at)| Some(((drive, table, at), snapshot.word(table, at)?)));
        stored.collect()
    }

    fn run(&mut self, time: Duration, writes: bool) {
        let end = self.rig.now + time;
        loop {
            self.client(writes);
            let until = if writes && self.waiting.is_none() {
                self.next_write.min(end)
            } else {
                end
            };
            match self.rig.step(until) {
                Some(seen) => seen.iter().for_each(|one| self.look(one)),
                None if self.rig.now >= end => return,
                None => {}
            }
        }
    }

    fn client(&mut self, writes: bool) {
        if let Some((placed, value)) = &mut self.waiting {
            let Some(answer) = placed.answer() else { return };
            if matches!(answer.outcome, Outcome::Acknowledged(_)) {
                self.acknowledged += 1;
                let slaves = self.rig.bus.wire.slaves();
                let has = slaves.drive(1).unwrap().as_nx().unwrap().state().reference;
                if has != *value as i16 {
                    self.wrong
                        .push(format!("write of {value} acknowledged, the drive has {has}"));
                }
            }
            self.waiting = None;
            self.next_write = self.rig.now + PAUSE;
        }
        if writes && self.next_write <= self.rig.now {
            self.writes += 1;
            let value = 1 + (self.writes % 900) as u16;
            let order = if self.protocol == Protocol::N2 {
                let (point, wanted, _) = unique_reference(&self.rig.bus.profile, usize::from(value));
                Order::Points(vec![(point, wanted)])
            } else {
                write(2002, value)
            };
            self.waiting = Some((self.rig.place(1, order), value));
        }
    }

    /// Behind an exchange: is all that is stored true, and is the drive still there?
    fn look(&mut self, seen: &Seen) {
        let Seen::Over(asked) = seen else { return };
        for (at, word) in self.stored(asked.drive) {
            if self.truth.get(&at) != Some(&word) && self.wrong.len() < 5 {
                self.wrong.push(format!("{at:?}: {word:04X}"));
            }
        }
        let online = self.rig.is_online(asked.drive);
        self.vanished += u32::from(self.online[asked.drive] && !online);
        self.online[asked.drive] = online;
    }

    /// The longest time from a request that meets the fault to the next exchange that goes well.
    fn recovery(&mut self, fault: Fault) -> Duration {
        let mut longest = Duration::ZERO;
        for _ in 0..10 {
            let before = self.rig.counts().faults;
            self.rig.set_faults(FaultPlan::default().at(1, fault));
            let met = |rig: &Rig| rig.counts().faults > before;
            self.rig.until("the fault is met", BACK, met);
            let ok = self.rig.counts().ok;
            let took = self.rig.until("one goes well", BACK, |rig| rig.counts().ok > ok);
            longest = longest.max(took);
            self.run(Duration::from_millis(1_700), false);
        }
        longest
    }
}

/// Good exchanges of a sound line in the time of a storm.
fn sound(protocol: Protocol, delivery: Delivery) -> u64 {
    let mut watched = Watched::new(protocol, delivery);
    let before = watched.rig.counts();
    watched.run(STORM, true);
    assert!(watched.wrong.is_empty(), "{:?}", watched.wrong);
    watched.rig.counts().since(before).ok
}

fn meet(row: &Row, protocol: Protocol, sound: u64) -> Met {
    let mut watched = Watched::new(protocol, row.delivery);
    let single: Option<Fault> = row.fault.parse().ok();
    let recovery = single.map(|fault| watched.recovery(fault));
    let before = watched.rig.counts();
    watched.rig.set_faults(FaultPlan::new(row.rates.parse().unwrap(), 7));
    watched.run(STORM, true);
    let ok = watched.rig.counts().since(before).ok;
    // What the last fault brings is waited for, and the drives that were taken for dead.
    watched.rig.set_faults(FaultPlan::default());
    watched.run(BACK / 10, false);
    let counts = watched.rig.counts().since(before);
    watched.run(BACK, false);
    let Watched {
        rig,
        mut wrong,
        acknowledged,
        writes,
        vanished,
        ..
    } = watched;
    let s = rig.bus.wire.statistics();
    let mut must = |holds: bool, what: String| {
        if !holds {
            wrong.push(what);
        }
    };
    must(row.tells.fits(&counts), format!("the counters do not tell {:?}", row.tells));
    must(counts.faults >= 100, "hardly a fault was met".to_string());
    // A refused register stays refused for a minute; the drives are there.
    let back = (0..usize::from(DRIVES)).all(|drive| rig.is_online(drive));
    let refused = matches!(row.tells, Tells::Exceptions | Tells::All);
    must(back && (refused || rig.is_whole()), "drives are away behind it".to_string());
    let share = ok as f64 / sound as f64;
    must(share >= row.share, format!("less than {} of the sound line", row.share));
    must((vanished > 0) == row.vanish, format!("drives vanished {vanished} times"));
    must(recovery.is_none_or(|time| time <= longest(protocol)), "a long time to recover".to_string());
    must(s.silence_violations == 0, format!("{} silence violations", s.silence_violations));
    must(s.collisions == 0, format!("{} collisions", s.collisions));
    must(s.bad_crc == 0, format!("{} broken requests", s.bad_crc));
    must(s.provoked_overlaps == 0, format!("{} requests met noise", s.provoked_overlaps));
    Met {
        counts,
        acknowledged,
        writes,
        share,
        vanished,
        recovery,
        wrong,
    }
}

/// Deadline of an exchange, silence, and the exchanges until the next good one.
fn longest(protocol: Protocol) -> Duration {
    protocol.usual_timeout() * 5 / 4
}

fn matrix(protocol: Protocol, rows: impl IntoIterator<Item = Row>) {
    let mut table = format!(
        "{protocol:?}\n{:<24}{:>6}{:>7}{:>6}{:>8}{:>8}{:>8}{:>13}{:>6}{:>5}{:>10}\n",
        "fault", "met", "ok", "exc", "timeout", "corrupt", "foreign", "writes", "share", "gone", "recovery"
    );
    let sound = sound(protocol, Delivery::Whole);
    let mut failed = false;
    for row in rows {
        let met = meet(&row, protocol, sound);
        failed |= !met.wrong.is_empty();
        table += &format!("{:<24}{met}\n", row.fault);
    }
    println!("{table}");
    assert!(!failed, "{table}");
}

fn row(fault: &str, tells: Tells, share: f64) -> Row {
    Row {
        fault: fault.to_string(),
        rates: format!("{fault}=0.3"),
        tells,
        share,
        vanish: matches!(tells, Tells::Timeouts | Tells::ForeignAndTimeouts),
        delivery: Delivery::Whole,
    }
}

fn named(fault: &str, rates: &str, tells: Tells, share: f64) -> Row {
    Row {
        rates: rates.to_string(),
        ..row(fault, tells, share)
    }
}

const FAULTS: [&str; 21] = [
    "deaf", "drop", "truncate", "corrupt", "double", "late:20ms", "late:101ms", "late:103ms", "late:106ms", "late:150ms",
    "late:400ms", "foreign-address", "foreign-function", "foreign-length", "stray-address", "stray-function", "stray-length",
    "noise-before", "noise-after", "split", "busy",
];

#[test]
fn probe_all() {
    for protocol in [Protocol::ModbusRtu, Protocol::ModbusAscii, Protocol::N2] {
        let mut rows: Vec<Row> = FAULTS.iter().map(|f| row(f, Tells::All, 0.0)).collect();
        rows.push(named("echo", "echo=1", Tells::All, 0.0));
        rows.push(named("echo now and then", "echo=0.3", Tells::All, 0.0));
        rows.push(named("echo, drive deaf", "echo=0.7,deaf-echo=0.3", Tells::All, 0.0));
        rows.push(named("always late", "late:110ms=1", Tells::All, 0.0));
        rows.push(row("exception:4", Tells::All, 0.0));
        for delivery in [Delivery::Chunks(1), Delivery::Chunks(14)] {
            for fault in ["double", "noise-after", "noise-before", "corrupt", "stray-length"] {
                rows.push(Row { delivery, ..row(fault, Tells::All, 0.0) });
            }
        }
        let _ = std::panic::catch_unwind(|| matrix(protocol, rows));
    }
}
