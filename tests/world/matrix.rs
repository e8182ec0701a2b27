//! The fault matrix: faults on a line, byte by byte in virtual time, and their effect on the bus.
//!
//! Every read-only register of a simulated drive contains the drive's address and its own, so a value from another
//! place is noticed.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use drivegate_core::order::{Order, Outcome};
use drivegate_core::plant::Placed;
use drivegate_model::drive::Point;
use drivegate_model::drive::profile::{Profile, Profiles};
use drivegate_proto::wire::Silence;
use drivegate_proto::{Protocol, Table};
use drivegate_sim::faults::{Fault, FaultPlan};
use drivegate_sim::half_duplex::Delivery;
use drivegate_sim::nx::{NxOptions, Values};
use drivegate_sim::simulated_drive::{DriveOptions, ModelOptions};

use super::bus::{Parts, Seen};
use super::orders::unique_reference;
use super::rig::{Counts, Rig, line, write};

const DRIVES: u8 = 3;
/// Time during which faults occur at a high rate.
const STORM: Duration = Duration::from_secs(30);
/// The storm on N2, which is slow.
const N2_STORM: Duration = Duration::from_secs(150);
/// Time between the answer to a write and the next one.
const PAUSE: Duration = Duration::from_millis(7);
/// Time within which all drives are online again after a storm: the longest back-off, and one round.
const BACK: Duration = Duration::from_secs(15);

/// Blocks of process data, two of which look alike on the wire.
const TWINS: &[(u16, u16)] = &[(2100, 3), (2104, 3)];
/// Two pairs of blocks that look alike on the wire.
const PAIRS: &[(u16, u16)] = &[(2100, 2), (2103, 2), (2106, 1), (2108, 1)];

/// A profile with these blocks, by first register and count.
fn blocks(blocks: &[(u16, u16)]) -> Arc<Profile> {
    let mut text = String::from(
        "name = \"twins\"\nprotocols = [\"modbus-rtu\", \"modbus-ascii\"]\n\
         [[range]]\ntable = \"holding\"\nfirst = 2000\nlast = 2010\nread = 20\nwrite = 20\n\
         [[range]]\ntable = \"holding\"\nfirst = 2100\nlast = 2110\nread = 20\n\
         [[point]]\nname = \"reference\"\nat = \"holding 2002\"\nclass = \"slow\"\nwrite = true\n",
    );
    for address in blocks.iter().flat_map(|(first, count)| *first..first + count) {
        text += &format!("[[point]]\nname = \"p{address}\"\nat = \"holding {address}\"\nclass = \"fast\"\n");
    }
    Arc::new(Profile::parse("twins.toml", &text, false).unwrap())
}

fn rig(protocol: Protocol, delivery: Delivery, data: &[(u16, u16)]) -> Rig {
    let (baud, profile) = match protocol {
        Protocol::N2 => (9600, Profiles::built_in().get("vacon-nx-n2").unwrap().clone()),
        Protocol::ModbusRtu | Protocol::ModbusAscii => (115_200, blocks(data)),
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
        flips: 0.0,
        wire_speed: 1,
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

/// Effect of a fault on the counters.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Shows {
    /// The fault has no effect: the transaction succeeds.
    Nothing,
    /// No reply is accepted; drives are now and then considered offline.
    Timeouts,
    Corrupt,
    Foreign,
    ForeignAndTimeouts,
    Exceptions,
    /// Any effect may appear, but the line keeps working.
    All,
}

impl Shows {
    fn fits(self, c: &Counts) -> bool {
        let quiet = c.timeout == 0 && c.corrupt == 0;
        match self {
            // The first write after a change of the echo may have to recognise the echo by its time.
            Shows::Nothing => quiet && c.exception == 0 && c.foreign <= 1,
            Shows::Timeouts => c.timeout > 0 && c.exception == 0,
            // A bit error may lengthen the reply, and a cut one may be empty.
            Shows::Corrupt => c.corrupt > 0 && c.timeout == 0 && c.exception == 0,
            Shows::Foreign => c.foreign > 0 && c.timeout == 0 && c.exception == 0,
            Shows::ForeignAndTimeouts => c.foreign > 0 && c.timeout > 0 && c.exception == 0,
            Shows::Exceptions => c.exception > 0 && quiet,
            Shows::All => true,
        }
    }
}

/// A row of the matrix: a fault, and the effects that it must have.
#[derive(Clone)]
struct Row {
    fault: String,
    rates: String,
    shows: Shows,
    /// Minimum share of good exchanges, compared with a line without faults.
    share: f64,
    /// Whether drives are sometimes considered offline; `None` in a storm of all faults, where both are possible.
    vanish: Option<bool>,
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
        Watched::of(protocol, rig(protocol, delivery, TWINS))
    }

    fn of(protocol: Protocol, rig: Rig) -> Watched {
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

    /// Process data of a drive in the image.
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

    /// Checks after a transaction whether all stored values are true, and whether the drive is still online.
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

    /// The longest time from a request with the fault to the next successful exchange.
    fn recovery(&mut self, fault: Fault) -> Duration {
        let mut longest = Duration::ZERO;
        for _ in 0..10 {
            let before = self.rig.counts().faults;
            self.rig.set_faults(FaultPlan::default().on_request(1, fault));
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

fn storm(protocol: Protocol) -> Duration {
    if protocol == Protocol::N2 { N2_STORM } else { STORM }
}

/// Number of successful exchanges of a line without faults in the time of a storm.
fn sound(protocol: Protocol, delivery: Delivery) -> u64 {
    let mut watched = Watched::new(protocol, delivery);
    let before = watched.rig.counts();
    watched.run(storm(protocol), true);
    watched.run(Duration::from_secs(1), false);
    assert!(watched.wrong.is_empty(), "{:?}", watched.wrong);
    watched.rig.counts().since(before).ok
}

fn meet(row: &Row, protocol: Protocol, sound: u64) -> Met {
    let mut watched = Watched::new(protocol, row.delivery);
    let single: Option<Fault> = row.fault.parse().ok();
    let recovery = single.map(|fault| watched.recovery(fault));
    let before = watched.rig.counts();
    watched.rig.set_faults(FaultPlan::new(row.rates.parse().unwrap(), 7));
    watched.run(storm(protocol), true);
    // When an echo stops, the acknowledgement of a write is lost with it.
    watched.run(Duration::from_secs(1), false);
    let ok = watched.rig.counts().since(before).ok;
    // Waits for the effects of the last fault, and until drives that counted as offline are online again.
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
    must(
        row.shows.fits(&counts),
        format!("the counters do not show {:?}", row.shows),
    );
    must(counts.faults >= 50, "hardly a fault was met".to_string());
    // A refused register stays refused for a minute, but the drives are online.
    let back = (0..usize::from(DRIVES)).all(|drive| rig.is_online(drive));
    let refused = matches!(row.shows, Shows::Exceptions | Shows::All);
    must(
        back && (refused || rig.is_whole()),
        "drives are away behind it".to_string(),
    );
    let share = ok as f64 / sound as f64;
    must(share >= row.share, format!("less than {} of the sound line", row.share));
    must(
        row.vanish.is_none_or(|vanish| vanish == (vanished > 0)),
        format!("drives vanished {vanished} times"),
    );
    must(
        recovery.is_none_or(|time| time <= longest(protocol)),
        "a long time to recover".to_string(),
    );
    must(
        s.silence_violations == 0,
        format!("{} silence violations", s.silence_violations),
    );
    // A late reply to a repeated request is accepted, correctly; the second reply of the drive then arrives during
    // the next request. This cannot be avoided without knowing the future.
    let late = row.rates.contains("late");
    must(late || s.collisions == 0, format!("{} collisions", s.collisions));
    must(s.bad_crc == 0, format!("{} broken requests", s.bad_crc));
    // A frame that is noticed only at its end, when the line already seemed silent, collides with the next request as well.
    let unseen = late || (row.rates.contains("double") && row.delivery != Delivery::Chunks(1));
    let met = s.provoked_overlaps;
    must(unseen || met == 0, format!("{met} requests met noise"));
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
    // The reply to a poll of N2 may be a long report, which is waited for at 9600 baud.
    let report = if protocol == Protocol::N2 { 2 } else { 1 };
    protocol.usual_timeout() * 5 / 4 * report
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

fn row(fault: &str, shows: Shows, share: f64) -> Row {
    Row {
        fault: fault.to_string(),
        rates: format!("{fault}=0.3"),
        shows,
        share,
        vanish: Some(matches!(shows, Shows::Timeouts | Shows::ForeignAndTimeouts)),
        delivery: Delivery::Whole,
    }
}

fn named(fault: &str, rates: &str, shows: Shows, share: f64) -> Row {
    Row {
        rates: rates.to_string(),
        ..row(fault, shows, share)
    }
}

/// A row like one with whole replies, but delivered in chunks.
fn by(chunk: u8, row: Row) -> Row {
    Row {
        delivery: Delivery::Chunks(chunk),
        ..row
    }
}

const ALL: &str = "deaf=0.03,drop=0.04,truncate=0.04,corrupt=0.05,double=0.05,late:104ms=0.03,late:130ms=0.03,\
                   foreign-address=0.04,foreign-length=0.04,stray-function=0.04,noise-before=0.05,noise-after=0.05,busy=0.03";

fn storm_of_all(name: &str) -> Row {
    Row {
        vanish: None,
        ..named(name, ALL, Shows::All, 0.05)
    }
}

#[test]
fn modbus_rtu() {
    use Shows::*;
    let rows = [
        row("deaf", Timeouts, 0.05),
        row("drop", Timeouts, 0.05),
        row("truncate", Corrupt, 0.05),
        row("corrupt", Corrupt, 0.35),
        row("double", Foreign, 0.95),
        by(1, row("double", Foreign, 0.85)),
        row("late:20ms", Nothing, 0.28),
        row("late:101ms", Timeouts, 0.05),
        row("late:103ms", Timeouts, 0.05),
        row("late:106ms", Timeouts, 0.05),
        row("late:150ms", Timeouts, 0.05),
        row("late:400ms", Timeouts, 0.05),
        named("always late", "late:110ms=1", Timeouts, 0.000_5),
        named(
            "late and dropped",
            "late:104ms=0.2,late:107ms=0.2,late:120ms=0.2,drop=0.1",
            Timeouts,
            0.01,
        ),
        row("foreign-address", ForeignAndTimeouts, 0.05),
        row("foreign-function", ForeignAndTimeouts, 0.05),
        row("foreign-length", ForeignAndTimeouts, 0.05),
        row("stray-address", Foreign, 0.85),
        row("stray-function", Foreign, 0.85),
        row("stray-length", Foreign, 0.85),
        named("echo", "echo=1", Nothing, 0.99),
        named("echo now and then", "echo=0.3", All, 0.5),
        named("echo, drive deaf", "echo=0.7,deaf-echo=0.3", Timeouts, 0.03),
        row("noise-before", Foreign, 0.95),
        row("noise-after", Foreign, 0.95),
        by(1, row("noise-after", Foreign, 0.95)),
        row("split", Nothing, 0.99),
        row("exception:1", Exceptions, 0.2),
        row("exception:2", Exceptions, 0.2),
        row("exception:3", Exceptions, 0.2),
        row("exception:4", Exceptions, 0.7),
        row("exception:5", Exceptions, 0.7),
        row("busy", Exceptions, 0.7),
        storm_of_all("everything"),
        by(1, storm_of_all("everything, by 1")),
        by(14, storm_of_all("everything, by 14")),
    ];
    matrix(Protocol::ModbusRtu, rows);
}

#[test]
fn modbus_ascii() {
    use Shows::*;
    let rows = [
        row("deaf", Timeouts, 0.05),
        row("drop", Timeouts, 0.05),
        row("truncate", Corrupt, 0.05),
        row("corrupt", Corrupt, 0.65),
        row("double", Foreign, 0.95),
        by(1, row("double", Foreign, 0.85)),
        row("late:20ms", Nothing, 0.38),
        row("late:104ms", Timeouts, 0.07),
        row("late:150ms", Timeouts, 0.07),
        row("foreign-address", ForeignAndTimeouts, 0.07),
        row("foreign-function", ForeignAndTimeouts, 0.07),
        row("foreign-length", ForeignAndTimeouts, 0.07),
        row("stray-address", Foreign, 0.85),
        row("stray-function", Foreign, 0.85),
        row("stray-length", Foreign, 0.8),
        named("echo", "echo=1", Nothing, 0.99),
        named("echo, drive deaf", "echo=0.7,deaf-echo=0.3", Timeouts, 0.03),
        // Noise before a colon has no effect.
        row("noise-before", Nothing, 0.95),
        row("noise-after", Foreign, 0.95),
        by(1, row("noise-after", Foreign, 0.95)),
        by(14, row("noise-after", Foreign, 0.95)),
        row("split", Nothing, 0.99),
        row("exception:4", Exceptions, 0.7),
        row("busy", Exceptions, 0.7),
        storm_of_all("everything"),
        by(1, storm_of_all("everything, by 1")),
        by(14, storm_of_all("everything, by 14")),
    ];
    matrix(Protocol::ModbusAscii, rows);
}

#[test]
fn n2() {
    use Shows::*;
    let rows = [
        row("deaf", Timeouts, 0.15),
        row("drop", Timeouts, 0.15),
        row("truncate", Corrupt, 0.15),
        row("corrupt", Corrupt, 0.22),
        row("double", Foreign, 0.95),
        by(1, row("double", Foreign, 0.9)),
        row("late:20ms", Nothing, 0.75),
        row("late:255ms", Timeouts, 0.15),
        row("late:275ms", Timeouts, 0.15),
        row("late:400ms", Timeouts, 0.10),
        // No reply of N2 names its drive, so a foreign one cannot be recognised and is not tested.
        row("foreign-address", Timeouts, 0.15),
        row("foreign-function", Timeouts, 0.15),
        row("foreign-length", Timeouts, 0.15),
        row("stray-address", Nothing, 0.9),
        named("echo", "echo=1", Nothing, 0.99),
        named("echo now and then", "echo=0.3", Nothing, 0.99),
        named("echo, drive deaf", "echo=0.7,deaf-echo=0.3", Timeouts, 0.13),
        row("noise-before", All, 0.5),
        row("noise-after", Foreign, 0.95),
        by(1, row("noise-after", Foreign, 0.95)),
        row("split", Nothing, 0.99),
        row("exception:4", Exceptions, 0.65),
        row("busy", Exceptions, 0.65),
        storm_of_all("everything"),
        by(1, storm_of_all("everything, by 1")),
    ];
    matrix(Protocol::N2, rows);
}

/// A late reply arrives damaged in place of the reply to a later request, which is late too: the garbage proves nothing.
#[test]
fn late_replies_that_are_mangled_settle_nothing() {
    for protocol in [Protocol::ModbusRtu, Protocol::ModbusAscii] {
        let mut watched = Watched::of(protocol, rig(protocol, Delivery::Whole, PAIRS));
        watched
            .rig
            .set_faults(FaultPlan::new("late:106ms=0.3,late:130ms=0.2".parse().unwrap(), 7));
        watched.rig.bus.flips = 0.3;
        watched.run(10 * STORM, true);
        assert!(watched.wrong.is_empty(), "{protocol:?}: {:?}", watched.wrong);
    }
}
