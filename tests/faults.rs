//! The fault matrix: what goes wrong on a line, on a pseudo-terminal with true wire timing, and what the bus makes of it.
//!
//! Every read-only register of a simulated drive holds the drive's address and its own, so a value that came from
//! elsewhere proves itself. A thread looks at the process image all the time while faults are injected.

#![allow(clippy::unwrap_used, clippy::panic, clippy::expect_used, clippy::indexing_slicing)]

mod common;

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use common::{Rig, Setup};
use drivegate::cache::Outcome as Counted;
use drivegate::codec::{LineFormat, Protocol, RequestPdu, Table};
use drivegate::command::{Authority, DEFAULT_EXPIRY, Order, Origin, Outcome, SourceKind};
use drivegate::drive::profile::Profile;
use drivegate::plant::DriveHandle;
use drivegate::sim::faults::{Fault, FaultPlan};
use drivegate::sim::half_duplex::Delivery;

const DRIVES: [u8; 3] = [1, 2, 9];
/// Two blocks of process data that look alike on the wire.
const BLOCKS: [(u16, u16); 2] = [(2100, 3), (2104, 3)];
/// How long faults come at a high rate.
const STORM: Duration = Duration::from_millis(1500);
/// Faults that a case must have met.
const FAULTS_WANTED: u64 = 10;
/// Deadline of an exchange (100 ms, and 11 characters), silence, the exchanges until the next good one, and what a
/// loaded machine adds.
const RECOVERY: Duration = Duration::from_millis(150);

fn twins() -> Arc<Profile> {
    let mut text = String::from(
        "name = \"twins\"\nprotocols = [\"modbus-rtu\", \"modbus-ascii\"]\n\
         [[range]]\ntable = \"holding\"\nfirst = 2000\nlast = 2010\nread = 20\nwrite = 20\n\
         [[range]]\ntable = \"holding\"\nfirst = 2100\nlast = 2110\nread = 20\n\
         [[point]]\nname = \"reference\"\nat = \"holding 2002\"\nclass = \"slow\"\nwrite = true\n",
    );
    for (start, count) in BLOCKS {
        for address in start..start + count {
            text += &format!("[[point]]\nname = \"p{address}\"\nat = \"holding {address}\"\nclass = \"fast\"\n");
        }
    }
    Arc::new(Profile::parse("twins.toml", &text, false).unwrap())
}

/// Looks at the image all the time.
struct Watch {
    stop: Arc<AtomicBool>,
    good: Arc<AtomicU64>,
    thread: std::thread::JoinHandle<Vec<String>>,
}

impl Watch {
    fn begin(handles: Vec<DriveHandle>) -> Watch {
        let (stop, good) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU64::new(0)));
        let (stopped, count) = (stop.clone(), good.clone());
        let thread = std::thread::spawn(move || {
            let mut wrong = Vec::new();
            while !stopped.load(Ordering::Relaxed) {
                for handle in &handles {
                    let address = handle.image.spec.address;
                    let reading = handle.reading(Instant::now());
                    for (start, items) in BLOCKS {
                        for (register, word) in
                            (start..).zip(reading.words(Table::Holding, start, items).unwrap_or_default())
                        {
                            count.fetch_add(1, Ordering::Relaxed);
                            let true_word = u16::from_be_bytes([address, register.to_be_bytes()[1]]);
                            if word != true_word && wrong.len() < 10 {
                                wrong.push(format!("drive {address} register {register}: {word:04X}"));
                            }
                        }
                    }
                }
                std::thread::sleep(Duration::from_micros(300));
            }
            wrong
        });
        Watch { stop, good, thread }
    }

    fn end(self) -> (u64, Vec<String>) {
        self.stop.store(true, Ordering::Relaxed);
        (self.good.load(Ordering::Relaxed), self.thread.join().unwrap())
    }
}

#[derive(Debug, Clone, Copy, Default)]
struct Counts {
    ok: u64,
    exception: u64,
    timeout: u64,
    corrupt: u64,
    foreign: u64,
    faults: u64,
}

impl Counts {
    fn of(rig: &Rig) -> Counts {
        let image = &rig.bus.handle().image;
        let sum = |outcome| image.drives.iter().map(|d| d.counted(outcome)).sum();
        Counts {
            ok: sum(Counted::Ok),
            exception: sum(Counted::Exception),
            timeout: sum(Counted::Timeout),
            corrupt: sum(Counted::Corrupt),
            foreign: image.health().foreign,
            faults: rig.line.statistics().faults,
        }
    }

    fn since(self, before: Counts) -> Counts {
        Counts {
            ok: self.ok - before.ok,
            exception: self.exception - before.exception,
            timeout: self.timeout - before.timeout,
            corrupt: self.corrupt - before.corrupt,
            foreign: self.foreign - before.foreign,
            faults: self.faults - before.faults,
        }
    }
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
    /// Whatever: a write whose echo fails to come loses its acknowledgement, which is taken for the echo.
    Echoes,
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
            Tells::Echoes => c.exception == 0,
            Tells::Exceptions => c.exception > 0 && quiet,
        }
    }
}

struct Row {
    fault: String,
    counts: Counts,
    acknowledged: usize,
    writes: usize,
    good: u64,
    recovery: Option<Duration>,
    violations: Vec<String>,
}

impl fmt::Display for Row {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let c = &self.counts;
        let recovery = self
            .recovery
            .map_or("-".to_string(), |time| format!("{:.1}", time.as_secs_f64() * 1000.0));
        write!(
            f,
            "{:<24}{:>7}{:>6}{:>6}{:>8}{:>8}{:>8}{:>9}{:>9}{:>12}  {}",
            self.fault,
            c.faults,
            c.ok,
            c.exception,
            c.timeout,
            c.corrupt,
            c.foreign,
            format!("{}/{}", self.acknowledged, self.writes),
            self.good,
            recovery,
            if self.violations.is_empty() {
                "ok".to_string()
            } else {
                format!("FAILED: {}", self.violations.join("; "))
            }
        )
    }
}

/// Time from the faulted request to the next exchange that went well.
async fn recovery(rig: &Rig, fault: Fault) -> Duration {
    let sum = || Counts::of(rig);
    let before = sum();
    rig.line.set_faults(FaultPlan::default().at(1, fault));
    let patience = Instant::now() + Duration::from_secs(5);
    while sum().faults == before.faults {
        assert!(Instant::now() < patience, "the fault is never met");
        tokio::time::sleep(Duration::from_micros(100)).await;
    }
    // The fault is met when the drive has heard the request; no earlier exchange can still be counted.
    let (met, ok) = (Instant::now(), sum().ok);
    while sum().ok == ok {
        assert!(Instant::now() < patience, "no exchange goes well behind the fault");
        tokio::time::sleep(Duration::from_micros(100)).await;
    }
    met.elapsed()
}

fn whole(rig: &Rig) -> bool {
    DRIVES.iter().all(|address| {
        let handle = rig.handle(*address);
        let reading = handle.reading(Instant::now());
        BLOCKS
            .iter()
            .all(|(start, count)| reading.words(Table::Holding, *start, *count).is_ok())
    })
}

/// Writes ever new values to one drive while faults come; each acknowledged one must be in the drive.
async fn write_on(rig: &Rig, address: u8, until: Instant) -> (usize, usize, Vec<String>) {
    let (mut acknowledged, mut writes, mut violations) = (0, 0, Vec::new());
    while Instant::now() < until {
        writes += 1;
        let value = 1 + (writes as u16 % 9000);
        let order = Order::Write(RequestPdu::WriteRegister { address: 2002, value });
        let origin = Origin::new(SourceKind::Mqtt, "test");
        let handle = rig.handle(address);
        let mut placed = handle.place(order, origin, Authority::Write, DEFAULT_EXPIRY, Instant::now());
        let answer = placed.answered().await;
        if matches!(answer.outcome, Outcome::Acknowledged(_)) {
            acknowledged += 1;
            let has = rig
                .line
                .with_drive(address, |d, _| d.as_nx().unwrap().state().reference);
            if has != Some(value as i16) {
                violations.push(format!("write of {value} acknowledged, the drive has {has:?}"));
            }
        }
        tokio::time::sleep(Duration::from_millis(7)).await;
    }
    (acknowledged, writes, violations)
}

struct Case {
    fault: &'static str,
    rates: String,
    tells: Tells,
    write: bool,
    delivery: Delivery,
    protocol: Protocol,
}

async fn run(case: &Case) -> Row {
    let format = match case.protocol {
        Protocol::ModbusAscii => "7E1",
        Protocol::ModbusRtu | Protocol::N2 => "8N1",
    };
    let setup = Setup {
        profile: twins(),
        delivery: case.delivery,
        protocol: case.protocol,
        format: LineFormat::new(115_200, format).unwrap(),
        ..Setup::new(&DRIVES, 115_200).tagged()
    };
    let rig = Rig::of(setup, |_| {});
    rig.until("all drives are read", whole).await;
    let watch = Watch::begin(DRIVES.iter().map(|a| rig.handle(*a)).collect());
    let mut violations = Vec::new();
    let single: Option<Fault> = case.fault.parse().ok();
    let mut median = None;
    if let Some(fault) = single {
        // The median: another process may take the processor away once.
        let mut times = Vec::new();
        for _ in 0..5 {
            times.push(recovery(&rig, fault).await);
            tokio::time::sleep(Duration::from_millis(30)).await;
        }
        times.sort();
        median = times.get(2).copied();
        if median > Some(RECOVERY) {
            violations.push(format!("recovery takes longer than {RECOVERY:?}"));
        }
    }
    let before = Counts::of(&rig);
    rig.line.set_faults(FaultPlan::new(case.rates.parse().unwrap(), 7));
    let (mut acknowledged, mut writes) = (0, 0);
    // Faults that end in a timeout are rare in the time of one storm, when drives go offline rarer still.
    for _ in 0..4 {
        let until = Instant::now() + STORM;
        if case.write {
            let (more, tried, wrong) = write_on(&rig, DRIVES[0], until).await;
            violations.extend(wrong);
            acknowledged += more;
            writes += tried;
        } else {
            tokio::time::sleep(until - Instant::now()).await;
        }
        if Counts::of(&rig).since(before).faults >= FAULTS_WANTED {
            break;
        }
    }
    // What the last fault brings is waited for.
    rig.line.set_faults(FaultPlan::default());
    tokio::time::sleep(Duration::from_millis(150)).await;
    let counts = Counts::of(&rig).since(before);
    if case.tells == Tells::Exceptions {
        // A refused register stays refused for a minute; the drives are there.
        let online = |r: &Rig| r.bus.handle().image.online() == DRIVES.len();
        rig.until("all drives answer again", online).await;
    } else {
        rig.until("all drives are read again", whole).await;
    }
    let (good, wrong) = watch.end();
    violations.extend(wrong);
    if !case.tells.fits(&counts) {
        violations.push(format!("the counters do not tell {:?}", case.tells));
    }
    if good == 0 {
        violations.push("nothing was good".to_string());
    }
    if counts.faults < FAULTS_WANTED {
        violations.push("hardly a fault was met".to_string());
    }
    let s = rig.line.statistics();
    // A late reply to a request that was repeated is believed, rightly; the drive's second reply then meets the next
    // request on the line. The simulator counts that, and nobody who does not know the future can avoid it.
    // So it is with an echo now and then, taken for the acknowledgement of a write when it comes as late as one.
    let unavoidable = if case.rates.contains("late") || case.tells == Tells::Echoes {
        counts.faults
    } else {
        0
    };
    if s.silence_violations.max(s.collisions).max(s.bad_crc) > unavoidable {
        violations.push(format!(
            "{} silence violations, {} collisions, {} broken requests",
            s.silence_violations, s.collisions, s.bad_crc
        ));
    }
    Row {
        fault: case.fault.to_string(),
        counts,
        acknowledged,
        writes,
        good,
        recovery: median,
        violations,
    }
}

async fn matrix(title: &str, cases: &[Case]) {
    let mut table = format!(
        "{title}\n{:<24}{:>7}{:>6}{:>6}{:>8}{:>8}{:>8}{:>9}{:>9}{:>12}  verdict\n",
        "fault", "met", "ok", "exc", "timeout", "corrupt", "foreign", "writes", "good", "recovery/ms"
    );
    let mut failed = false;
    for case in cases {
        let row = run(case).await;
        failed |= !row.violations.is_empty();
        table += &format!("{row}\n");
    }
    println!("{table}");
    assert!(!failed, "{table}");
}

fn case(fault: &'static str, tells: Tells) -> Case {
    Case {
        fault,
        rates: format!("{fault}=0.3"),
        tells,
        write: true,
        delivery: Delivery::Whole,
        protocol: Protocol::ModbusRtu,
    }
}

#[tokio::test]
async fn replies_lost_broken_and_late() {
    let cases = [
        case("deaf", Tells::Timeouts),
        case("drop", Tells::Timeouts),
        case("truncate", Tells::Corrupt),
        case("corrupt", Tells::Corrupt),
        case("double", Tells::Foreign),
        case("late:20ms", Tells::Nothing),
        case("late:101ms", Tells::Timeouts),
        case("late:103ms", Tells::Timeouts),
        case("late:106ms", Tells::Timeouts),
        case("late:150ms", Tells::Timeouts),
        case("late:400ms", Tells::Timeouts),
        Case {
            rates: "late:110ms=1".to_string(),
            ..case("always late", Tells::Timeouts)
        },
        Case {
            rates: "late:104ms=0.2,late:107ms=0.2,late:120ms=0.2,drop=0.1".to_string(),
            ..case("late and dropped", Tells::Timeouts)
        },
    ];
    matrix("Replies lost, broken and late", &cases).await;
}

#[tokio::test]
async fn replies_of_others_echoes_and_noise() {
    let echo = |rates: &str, fault, write| Case {
        rates: rates.to_string(),
        write,
        ..case(fault, Tells::Nothing)
    };
    let cases = [
        case("foreign-address", Tells::ForeignAndTimeouts),
        case("foreign-function", Tells::ForeignAndTimeouts),
        case("foreign-length", Tells::ForeignAndTimeouts),
        case("stray-address", Tells::Foreign),
        case("stray-function", Tells::Foreign),
        case("stray-length", Tells::Foreign),
        echo("echo=1", "echo", true),
        Case {
            tells: Tells::Echoes,
            ..echo("echo=0.3", "echo now and then", true)
        },
        Case {
            tells: Tells::Timeouts,
            ..echo("echo=0.7,deaf-echo=0.3", "echo, drive deaf", true)
        },
        case("noise-before", Tells::Foreign),
        case("noise-after", Tells::Foreign),
        case("split", Tells::Nothing),
    ];
    matrix("Replies of others, echoes and noise", &cases).await;
}

#[tokio::test]
async fn modbus_ascii_meets_the_same() {
    let echoing = Case {
        rates: "echo=1".to_string(),
        ..case("echo", Tells::Nothing)
    };
    let deaf = Case {
        rates: "echo=0.7,deaf-echo=0.3".to_string(),
        ..case("echo, drive deaf", Tells::Timeouts)
    };
    // A reply without its line feed is incomplete, and that is told when the deadline is over.
    let cases = [
        case("drop", Tells::Timeouts),
        case("truncate", Tells::Corrupt),
        case("corrupt", Tells::Corrupt),
        case("double", Tells::Foreign),
        case("late:20ms", Tells::Nothing),
        case("late:104ms", Tells::Timeouts),
        case("late:150ms", Tells::Timeouts),
        case("foreign-address", Tells::ForeignAndTimeouts),
        case("foreign-function", Tells::ForeignAndTimeouts),
        case("stray-address", Tells::Foreign),
        case("stray-length", Tells::Foreign),
        echoing,
        deaf,
        // Before a colon it is no matter at all.
        case("noise-before", Tells::Nothing),
        case("noise-after", Tells::Foreign),
        case("split", Tells::Nothing),
        case("exception:4", Tells::Exceptions),
        case("busy", Tells::Exceptions),
    ]
    .map(|case| Case {
        protocol: Protocol::ModbusAscii,
        ..case
    });
    matrix("Modbus ASCII", &cases).await;
}

#[tokio::test]
async fn exceptions_and_busy() {
    let exceptions = [
        "exception:1",
        "exception:2",
        "exception:3",
        "exception:4",
        "exception:5",
        "busy",
    ];
    let cases = exceptions.map(|fault| case(fault, Tells::Exceptions));
    matrix("Exceptions", &cases).await;
}

#[tokio::test]
async fn all_at_once_and_handed_over_as_a_fifo_does() {
    let all = "deaf=0.03,drop=0.04,truncate=0.04,corrupt=0.05,double=0.05,late:104ms=0.03,late:130ms=0.03,\
               foreign-address=0.04,foreign-length=0.04,stray-function=0.04,noise-before=0.05,noise-after=0.05,busy=0.03";
    let storm = |fault, delivery, protocol| Case {
        rates: all.to_string(),
        delivery,
        protocol,
        ..case(fault, Tells::ForeignAndTimeouts)
    };
    let (rtu, ascii) = (Protocol::ModbusRtu, Protocol::ModbusAscii);
    let mut rows = Vec::new();
    for case in [
        storm("everything", Delivery::Whole, rtu),
        storm("everything, by character", Delivery::Chunks(1), rtu),
        storm("everything, by 14", Delivery::Chunks(14), rtu),
        storm("ASCII everything", Delivery::Whole, ascii),
        storm("ASCII, by character", Delivery::Chunks(1), ascii),
        storm("ASCII, by 14", Delivery::Chunks(14), ascii),
    ] {
        let mut row = run(&case).await;
        // Here exceptions are among it.
        row.violations.retain(|v| !v.starts_with("the counters"));
        println!("{row}");
        rows.push(row);
    }
    assert!(rows.iter().all(|row| row.violations.is_empty()));
    assert!(rows.iter().all(|row| row.counts.ok > 50), "the line goes on");
}
