//! The choices of a seed: lines, drives, faults, clients.

use std::time::Duration;

use drivegate_core::process_image::{DriveSpec, LeaseAction, OnShutdown, Supervision};
use drivegate_model::drive::RawWrites;
use drivegate_proto::Protocol;
use drivegate_sim::random::Random;

/// The description of a random world.
#[derive(Debug, Clone)]
pub struct Scenario {
    pub seed: u64,
    /// How long the world runs before the gateway stops.
    pub time: Duration,
    pub buses: Vec<Line>,
    pub clients: Vec<Habit>,
    /// Mean time between two incidents (for example, a drive trips, restarts or vanishes); `None` in a world
    /// without incidents.
    pub incidents: Option<Duration>,
    /// Whether the gateway loads a new configuration now and then.
    pub reloads: bool,
    /// Clients that flood a drive seldom pause.
    pub floods: bool,
}

/// A line with its drives.
#[derive(Debug, Clone)]
pub struct Line {
    pub family: &'static str,
    pub protocol: Protocol,
    pub baud: u32,
    pub format: &'static str,
    pub drives: u8,
    pub turnaround: Duration,
    pub response_timeout: Duration,
    pub retries: u32,
    pub cycle: Duration,
    pub slow_cycle: Duration,
    /// Faults of the wire, in the form of `simulate --faults`; empty for a line without faults.
    pub faults: String,
    /// Share of the frames to the gateway in which one more bit is wrong.
    pub flips: f64,
    pub supervision: Option<Supervision>,
    /// How often the gateway writes its orders again.
    pub refresh: Option<Duration>,
    /// The drives' own timeout: they trip when they run and no write came that it counts.
    pub own_timeout: Option<Duration>,
    pub on_shutdown: OnShutdown,
    /// Configured addresses without an answering drive.
    pub dead: Vec<u8>,
    /// Whether the names and units of the drives are in the opposite order.
    pub swapped: bool,
    /// A register that the first drive refuses to report.
    pub refuses: Option<&'static str>,
    /// Further changes to the specs of its drives.
    pub spec: fn(&mut DriveSpec),
}

/// The habits of a client in a world.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Habit {
    /// Over MQTT: single points and whole objects, often two at once.
    Mqtt,
    /// Uses Modbus TCP: words of the common model, and several requests in one segment.
    ModbusTcp,
    /// Orders of all kinds by the function that all north sides use.
    Plain,
    /// Over Modbus TCP: writes 0 to the command word of one drive endlessly.
    StopsInALoop,
    /// Commands one drive as fast as the drive is answered.
    Floods,
    /// Commands all drives of a line as fast as it can, with hardly any stops, so that the queue is full.
    Crowds,
    /// Run and stop of one drive in turn, the next as soon as one is answered.
    Duels,
    /// Commands one drive for a while, is silent for about as long as its lease or for much longer, and returns.
    Operates,
    /// A connection of a client with many connections, by Modbus TCP: each commands the drives of the last line, all
    /// but the last.
    Shares,
    /// Sends a reference every half second to a drive of its own; it must always be served.
    Steady,
}

const FAMILIES: [(&str, Protocol); 8] = [
    ("vacon-nx", Protocol::ModbusRtu),
    ("vacon-nx", Protocol::ModbusRtu),
    ("eaton-svx", Protocol::ModbusRtu),
    ("eaton-hvx", Protocol::ModbusRtu),
    ("vacon-cx", Protocol::ModbusRtu),
    ("teco-7300pa", Protocol::ModbusAscii),
    ("vacon-nx-n2", Protocol::N2),
    ("teco-7300pa-n2", Protocol::N2),
];

const FAULTS: [&str; 17] = [
    "drop",
    "truncate",
    "corrupt",
    "deaf",
    "noise-before",
    "noise-after",
    "foreign-address",
    "foreign-length",
    "stray-function",
    "split",
    "busy",
    "exception:4",
    "exception:5",
    "exception:11",
    "double",
    "late",
    "corrupt",
];

impl Scenario {
    pub fn of(seed: u64) -> Scenario {
        let mut dice = Random::new(seed);
        let calm = dice.chance(0.35);
        let trips = seed.is_multiple_of(2);
        let buses = (0..dice.within(1..=3))
            .map(|_| Line::of(&mut dice, calm, trips))
            .collect();
        let mut clients = vec![Habit::Plain];
        for habit in [
            Habit::Mqtt,
            Habit::ModbusTcp,
            Habit::Plain,
            Habit::StopsInALoop,
            Habit::StopsInALoop,
            Habit::Floods,
            Habit::Crowds,
            Habit::Duels,
            Habit::Operates,
        ] {
            if dice.chance(0.3) {
                clients.push(habit);
            }
        }
        // Some worlds have few clients, because many clients hide certain faults.
        match dice.within(0..=9) {
            0 | 1 => clients = vec![Habit::Operates; dice.within(1..=2) as usize],
            2 => clients = vec![Habit::Duels; dice.within(1..=2) as usize],
            3 => clients = vec![Habit::Crowds],
            _ => {}
        }
        if calm {
            if dice.chance(0.15) {
                clients = vec![Habit::Shares; 48];
            }
            clients.push(Habit::Steady);
        }
        Scenario {
            seed,
            time: Duration::from_millis(dice.within(8_000..=40_000)),
            buses,
            clients,
            incidents: (!calm).then(|| Duration::from_millis(dice.within(700..=8_000))),
            reloads: !calm && dice.chance(0.3),
            floods: false,
        }
    }
}

impl Line {
    /// A line; in worlds where it `trips`, drives with a lease also have a timeout of their own.
    fn of(dice: &mut Random, calm: bool, trips: bool) -> Line {
        let (family, protocol) = FAMILIES[dice.within(0..=FAMILIES.len() as u64 - 1) as usize];
        let ms = Duration::from_millis;
        let (baud, format) = match protocol {
            Protocol::N2 => (9600, "8N1"),
            Protocol::ModbusAscii => ([9600, 19_200][dice.within(0..=1) as usize], "7E1"),
            Protocol::ModbusRtu => ([9600, 19_200, 38_400, 115_200][dice.within(0..=3) as usize], "8N1"),
        };
        let most = if protocol == Protocol::N2 { 3 } else { 6 };
        let crowd = protocol == Protocol::ModbusRtu && dice.chance(0.06);
        let drives = if crowd { 30 } else { dice.within(1..=most) as u8 };
        let turnaround = Duration::from_micros(dice.within(500..=12_000));
        let response_timeout = match protocol {
            Protocol::N2 => ms(250),
            _ => [ms(30), ms(60), ms(100)][dice.within(0..=2) as usize],
        };
        let timeout = ms(dice.within(300..=3_000));
        let action = match dice.within(0..=9) {
            0..=6 => LeaseAction::Stop,
            7 => LeaseAction::LeaveRunning,
            _ => LeaseAction::SpeedReference(20.0),
        };
        let supervised = dice.chance(0.6);
        // Without the dice, as `spec`: lines that have a lease and registers that are not stored; every second one where the
        // drives have no timeout of their own.
        let can_repeat = supervised && protocol != Protocol::N2;
        let repeats = can_repeat && (trips || timeout.as_millis().is_multiple_of(2));
        // A quarter of the line at most: a round is about a hundred characters.
        let round = Duration::from_micros(u64::from(1_100_000_000 / baud)) + 4 * turnaround;
        let every = (4 * round * u32::from(drives)).max(ms(200));
        Line {
            refresh: repeats.then_some(every),
            // Longer than a feeding may take on a sound line, see `check_feeding`.
            own_timeout: (repeats && trips).then_some(6 * every + ms(1_000)),
            family,
            protocol,
            baud,
            format,
            drives,
            turnaround,
            response_timeout,
            retries: dice.within(0..=2) as u32,
            cycle: ms([10, 50, 200][dice.within(0..=2) as usize]),
            slow_cycle: ms([1_000, 1_000, 4_000, 6_000][dice.within(0..=3) as usize]),
            flips: if !calm && dice.chance(0.15) { 0.05 } else { 0.0 },
            faults: if calm || dice.chance(0.25) {
                String::new()
            } else {
                faults(dice, response_timeout)
            },
            supervision: supervised.then_some(Supervision {
                timeout,
                action,
                adopt: dice.chance(0.3),
            }),
            on_shutdown: if dice.chance(0.6) {
                OnShutdown::Stop
            } else {
                OnShutdown::LeaveRunning
            },
            dead: if dice.chance(0.2) && drives > 1 {
                vec![drives]
            } else {
                Vec::new()
            },
            swapped: false,
            refuses: (!calm && dice.chance(0.15)).then_some("running"),
            // Chosen without random numbers, so that the rest of the world does not change.
            spec: match drives % 3 {
                0 => |spec| spec.raw_writes = RawWrites::All,
                1 => |_| {},
                _ => |spec| spec.raw_writes = RawWrites::Ranges(vec![0..=1_994, 9_893..=9_893]),
            },
        }
    }

    /// Whether the line has faults on its wire.
    pub fn is_noisy(&self) -> bool {
        !self.faults.is_empty() || self.flips > 0.0
    }

    /// Whether bits of replies change on the way in a manner that a weak checksum does not detect.
    pub fn flips_bits(&self) -> bool {
        self.flips > 0.0 || self.faults.contains("corrupt")
    }

    /// Whether replies may be duplicated, or arrive when they are no longer expected.
    pub fn is_late(&self) -> bool {
        ["late", "double", "stray"]
            .iter()
            .any(|fault| self.faults.contains(fault))
    }
}

/// Up to four kinds of faults, seldom or often.
fn faults(dice: &mut Random, response_timeout: Duration) -> String {
    let mut kinds: Vec<String> = Vec::new();
    for _ in 0..dice.within(1..=4) {
        let fault = FAULTS[dice.within(0..=FAULTS.len() as u64 - 1) as usize];
        let rate = [0.005, 0.02, 0.08, 0.2][dice.within(0..=3) as usize] / 1.2;
        let fault = match fault {
            // Delays from just after the timeout to the time when a reply is forgotten.
            "late" => format!(
                "late:{}ms",
                response_timeout.as_millis() as u64 * dice.within(105..=290) / 100
            ),
            other => other.to_string(),
        };
        kinds.push(format!("{fault}={rate}"));
    }
    kinds.join(",")
}
