//! Faults on a simulated line: at random, or scripted for the request of a given number. Pure.

mod shape;

pub use shape::{Burst, Kind};

use super::random::Random;
use drivegate_model::document::{Finding, parse_duration};
use drivegate_proto::{Exception, RequestPdu, Table};
use std::collections::BTreeMap;
use std::str::FromStr;
use std::time::Duration;

/// In what a foreign reply differs from the true one. The data always differs; the check code is valid.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Foreign {
    /// The reply carries the address of another drive.
    Address,
    /// The reply carries another function.
    Function,
    /// The reply has another length.
    Length,
    /// Only the data of the reply differs from the true one.
    Data,
}

/// A fault that happens to one exchange.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    /// The drive does not hear the request.
    Deaf,
    /// The drive carries out the request, but its reply is lost.
    Drop,
    /// Only the first characters of the reply arrive at the master.
    Truncate,
    /// A bit of the reply is wrong.
    Corrupt,
    /// The reply arrives twice.
    Double,
    /// The reply is later by this time.
    Late(Duration),
    /// A foreign reply arrives instead of the true one.
    Foreign(Foreign),
    /// A foreign reply arrives first, and the true one 3.5 characters later.
    Stray(Foreign),
    /// The master receives its own request before the reply.
    Echo,
    /// The master receives its own request, but the drive does not.
    DeafEcho,
    /// Noise runs into the beginning of the reply.
    NoiseBefore,
    /// Noise bytes follow the reply.
    NoiseAfter,
    /// The reply is delivered character by character.
    Split,
    /// The drive refuses the request with this exception code and does not act.
    Exception(u8),
    /// The first character of the reply is lost: the adapter switches to receiving too late.
    ReplyStart,
    /// The last character of the request is lost: the adapter switches to receiving too early.
    CutRequest,
    /// The last character of the request is lost, and the adapter echoes what it sends.
    CutEcho,
    /// A zero byte arrives directly before the reply: the line floats until the drive takes it over.
    ZeroBefore,
    /// A stray character arrives after the reply, while no device sends.
    IdleNoise,
    /// Another drive has the same address, and its reply begins slightly later.
    Twin,
    /// The drive does not receive a request that begins too soon after a reply.
    NeedsPause(Duration),
    /// The mains damage the character of the reply that is on the line at their peak; the value is their frequency, Hz.
    Mains(u8),
}

/// Every fault with its name as an argument; a fault that takes a value has its usual one.
const NAMED: [(&str, Fault); 27] = [
    ("deaf", Fault::Deaf),
    ("drop", Fault::Drop),
    ("truncate", Fault::Truncate),
    ("corrupt", Fault::Corrupt),
    ("double", Fault::Double),
    ("late:50ms", Fault::Late(Duration::from_millis(50))),
    ("foreign-address", Fault::Foreign(Foreign::Address)),
    ("foreign-function", Fault::Foreign(Foreign::Function)),
    ("foreign-length", Fault::Foreign(Foreign::Length)),
    ("stray-address", Fault::Stray(Foreign::Address)),
    ("stray-function", Fault::Stray(Foreign::Function)),
    ("stray-length", Fault::Stray(Foreign::Length)),
    ("echo", Fault::Echo),
    ("deaf-echo", Fault::DeafEcho),
    ("noise-before", Fault::NoiseBefore),
    ("noise-after", Fault::NoiseAfter),
    ("split", Fault::Split),
    ("exception:4", Fault::Exception(4)),
    ("busy", Fault::Exception(6)),
    ("reply-start", Fault::ReplyStart),
    ("cut-request", Fault::CutRequest),
    ("cut-echo", Fault::CutEcho),
    ("zero-before", Fault::ZeroBefore),
    ("idle-noise", Fault::IdleNoise),
    ("twin", Fault::Twin),
    ("needs-pause:10ms", Fault::NeedsPause(Duration::from_millis(10))),
    ("mains:50", Fault::Mains(50)),
];

/// All names of faults as text, for messages.
pub fn names() -> String {
    NAMED.map(|(name, _)| name).join(", ")
}

impl FromStr for Fault {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let (name, value) = match text.split_once(':') {
            Some((name, value)) => (name, Some(value)),
            None => (text, None),
        };
        let is_meant = |(known, _): &&(&str, Fault)| known.split(':').next() == Some(name);
        let Some((_, usual)) = NAMED.iter().find(is_meant) else {
            return Err(format!("`{text}` is not a fault; valid faults: {}", names()));
        };
        let Some(value) = value else { return Ok(*usual) };
        let duration = || parse_duration(value).map_err(|error| Finding::from(error).to_string());
        match (name, usual) {
            (_, Fault::Late(_)) => duration().map(Fault::Late),
            (_, Fault::NeedsPause(_)) => duration().map(Fault::NeedsPause),
            (_, Fault::Mains(_)) => mains(value).map(Fault::Mains),
            ("exception", _) => exception_code(value).map(Fault::Exception),
            _ => Err(format!(
                "`{name}` is not a fault that takes a value; valid faults: {}",
                names()
            )),
        }
    }
}

fn mains(text: &str) -> Result<u8, String> {
    let hertz = text.parse().ok().filter(|hertz| [50, 60].contains(hertz));
    hertz.ok_or_else(|| format!("`{text}` is not a frequency of the mains; write mains:50 or mains:60"))
}

fn exception_code(text: &str) -> Result<u8, String> {
    text.parse()
        .ok()
        .filter(|code| *code != 0)
        .ok_or_else(|| format!("`{text}` is not an exception code; write 1 to 255, such as exception:4"))
}

/// Faults with their probabilities: `drop=0.01,late:50ms=0.02`.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Rates(Vec<(Fault, f64)>);

impl FromStr for Rates {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let mut rates = Vec::new();
        for part in text.split(',').map(str::trim).filter(|part| !part.is_empty()) {
            let (fault, rate) = part
                .split_once('=')
                .ok_or_else(|| format!("`{part}` has no probability; write it as {part}=0.01"))?;
            let probability =
                rate.parse().ok().filter(|p| (0.0..=1.0).contains(p)).ok_or_else(|| {
                    format!("`{rate}` is not a probability; write a number from 0 to 1, such as 0.01")
                })?;
            rates.push((fault.parse()?, probability));
        }
        let sum: f64 = rates.iter().map(|(_, p)| p).sum();
        if sum > 1.0 {
            Err(format!("the probabilities of `{text}` add up to more than 1"))
        } else {
            Ok(Rates(rates))
        }
    }
}

/// Which requests are affected by which fault.
#[derive(Debug, Clone)]
pub struct FaultPlan {
    rates: Rates,
    script: BTreeMap<u64, Fault>,
    only: Vec<u8>,
    /// A register that one drive refuses to read: address, table, register, and the exception.
    refused: Option<(u8, Table, u16, Exception)>,
    while_running: bool,
    /// A second plan, which is used for requests without a fault in this plan.
    other: Option<Box<FaultPlan>>,
    random: Random,
    asked: u64,
}

impl Default for FaultPlan {
    fn default() -> Self {
        FaultPlan::new(Rates::default(), 1)
    }
}

impl FaultPlan {
    /// Random faults; the seed determines which request gets which fault.
    pub fn new(rates: Rates, seed: u64) -> FaultPlan {
        FaultPlan {
            rates,
            script: BTreeMap::new(),
            only: Vec::new(),
            refused: None,
            while_running: false,
            other: None,
            random: Random::new(seed),
            asked: 0,
        }
    }

    /// Sets the fault for the request with this number. Number 1 is the first valid request to a drive that answers
    /// after the plan takes effect.
    #[must_use]
    pub fn on_request(mut self, number: u64, fault: Fault) -> FaultPlan {
        self.script.insert(number, fault);
        self
    }

    /// Confines the faults (and the counting) to requests to these addresses.
    #[must_use]
    pub fn only(mut self, addresses: &[u8]) -> FaultPlan {
        self.only = addresses.to_vec();
        self
    }

    /// Confines the faults to times at which a drive of the line runs.
    #[must_use]
    pub fn while_running(mut self) -> FaultPlan {
        self.while_running = true;
        self
    }

    /// Adds a second plan, used for requests without a fault in this one.
    #[must_use]
    pub fn and(mut self, other: FaultPlan) -> FaultPlan {
        self.other = Some(Box::new(other));
        self
    }

    /// Makes the drive at `address` refuse every read of that register with exception 02.
    #[must_use]
    pub fn refusing(self, address: u8, table: Table, register: u16) -> FaultPlan {
        self.refusing_with(Exception::ADDRESS, address, table, register)
    }

    /// Makes every read of that register of the drive at `address` end with this exception.
    #[must_use]
    pub fn refusing_with(mut self, exception: Exception, address: u8, table: Table, register: u16) -> FaultPlan {
        self.refused = Some((address, table, register, exception));
        self
    }

    /// Removes random and scripted faults but keeps the refusals: a drive continues to refuse the same registers.
    #[must_use]
    pub fn without_faults(self) -> FaultPlan {
        FaultPlan {
            refused: self.refused,
            ..FaultPlan::default()
        }
    }

    /// The exception by which the drive at `address` refuses a request because it reads certain registers.
    pub fn refuses(&self, address: u8, request: &RequestPdu) -> Option<Exception> {
        let RequestPdu::Read { table, start, count } = request else {
            return None;
        };
        let (of, refused, register, exception) = self.refused?;
        let end = u32::from(*start) + u32::from(*count);
        let reads = of == address && refused == *table && register >= *start && u32::from(register) < end;
        reads.then_some(exception)
    }

    /// The fault for the next request, addressed to `address`; `runs` returns whether a drive of the line runs.
    pub fn next(&mut self, address: u8, runs: impl Fn() -> bool) -> Option<Fault> {
        let own = self.own(address, &runs);
        own.or_else(|| self.other.as_mut()?.next_of_other(address, &runs))
    }

    fn next_of_other(&mut self, address: u8, runs: &dyn Fn() -> bool) -> Option<Fault> {
        let own = self.own(address, runs);
        own.or_else(|| self.other.as_mut()?.next_of_other(address, runs))
    }

    fn own(&mut self, address: u8, runs: &dyn Fn() -> bool) -> Option<Fault> {
        if !self.only.is_empty() && !self.only.contains(&address) || self.while_running && !runs() {
            return None;
        }
        self.asked += 1;
        if let Some(fault) = self.script.remove(&self.asked) {
            return Some(fault);
        }
        if self.rates.0.is_empty() {
            return None;
        }
        let mut dice = self.random.unit();
        for &(fault, probability) in &self.rates.0 {
            if dice < probability {
                return Some(fault);
            }
            dice -= probability;
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::shape::foreign;
    use super::*;
    use drivegate_proto::{Decoded, Protocol, Request, RequestPdu, Table, rtu};

    const RTU: Protocol = Protocol::ModbusRtu;

    const SILENCE: Duration = Duration::from_micros(911);

    fn exchange() -> (Request, Vec<u8>, Vec<u8>) {
        let request = Request::new(1, RequestPdu::read(Table::Holding, 2100, 2));
        let (mut asked, mut reply) = (Vec::new(), Vec::new());
        rtu::encode_request(&request, &mut asked);
        rtu::encode_frame(1, &[3, 4, 1, 2, 3, 4], &mut reply);
        (request, asked, reply)
    }

    fn shaped(text: &str) -> Vec<Burst> {
        let (_, asked, reply) = exchange();
        FaultPlan::default().shape(Some(text.parse().unwrap()), RTU, &asked, reply, SILENCE)
    }

    #[test]
    fn names_are_read_and_complete() {
        for (name, known) in NAMED {
            let fault: Fault = name.parse().unwrap();
            assert_eq!(fault, known);
            let (_, asked, reply) = exchange();
            FaultPlan::default().shape(Some(fault), RTU, &asked, reply, SILENCE);
        }
        for bad in ["", "drip", "drop:3", "exception:0", "exception:x", "late:x"] {
            assert!(bad.parse::<Fault>().is_err(), "{bad}");
        }
        assert_eq!("busy".parse(), Ok(Fault::Exception(6)));
        let rates: Rates = "drop=0.01, late:150ms=0.02".parse().unwrap();
        assert_eq!(
            rates.0,
            [(Fault::Drop, 0.01), (Fault::Late(Duration::from_millis(150)), 0.02)]
        );
        for bad in ["drop", "drop=2", "drop=x", "drop=0.6,busy=0.6", "what=0.1"] {
            assert!(bad.parse::<Rates>().is_err(), "{bad}");
        }
    }

    #[test]
    fn chance_script_and_addresses() {
        let rates: Rates = "drop=0.1,corrupt=0.2".parse().unwrap();
        let mut plan = FaultPlan::new(rates.clone(), 5);
        let seen: Vec<_> = (0..10_000).map(|_| plan.next(1, || false)).collect();
        let count = |wanted| seen.iter().filter(|fault| **fault == wanted).count();
        assert!((900..1100).contains(&count(Some(Fault::Drop))));
        assert!((1850..2150).contains(&count(Some(Fault::Corrupt))));
        let mut again = FaultPlan::new(rates, 5);
        assert!(
            seen.iter().all(|fault| *fault == again.next(1, || false)),
            "the same seed, the same faults"
        );

        let mut script = FaultPlan::default().on_request(2, Fault::Echo).only(&[7]);
        let seen: Vec<_> = [1, 7, 1, 7, 7].map(|address| script.next(address, || false)).to_vec();
        assert_eq!(seen, [None, None, None, Some(Fault::Echo), None]);
    }

    #[test]
    fn no_shape_is_believed_but_the_true_reply() {
        let (request, asked, reply) = exchange();
        let decode = |bytes: &[u8]| rtu::decode_reply(&request, bytes);
        let truth = decode(&reply);
        assert!(matches!(truth, Decoded::Reply { .. }));
        assert!(matches!(decode(&shaped("truncate")[0].bytes), Decoded::Incomplete));
        assert!(!matches!(decode(&shaped("corrupt")[0].bytes), Decoded::Reply { .. }));
        for name in ["foreign-address", "foreign-function", "foreign-length"] {
            let burst = &shaped(name)[0];
            assert_eq!(
                decode(&burst.bytes),
                Decoded::Foreign {
                    used: burst.bytes.len()
                },
                "{name}"
            );
        }
        let stray = shaped("stray-length");
        assert_eq!((decode(&stray[1].bytes), stray[1].gap), (truth.clone(), SILENCE));
        let echo = shaped("echo");
        assert_eq!(
            (echo[0].kind, &echo[0].bytes, &echo[1].bytes),
            (Kind::Echo, &asked, &reply)
        );
        assert_eq!(shaped("double").len(), 2);
        assert_eq!(shaped("late:20ms")[0].gap, Duration::from_millis(20));
        assert!(shaped("drop").is_empty() && shaped("deaf").is_empty());
        assert_eq!(shaped("split")[0].kind, Kind::Split);
        assert_eq!(shaped("noise-after")[1].kind, Kind::Provoked);
        assert_eq!(decode(&shaped("noise-before")[1].bytes), truth);
    }

    /// A foreign reply to a write or an exception is a valid frame as well.
    #[test]
    fn foreign_frames_to_any_reply_are_sound() {
        for pdu in [
            vec![6, 7, 0xD0, 0, 1],
            vec![0x83, 2],
            vec![16, 7, 0xD0, 0, 3],
            vec![4, 2, 0, 1],
        ] {
            for what in [Foreign::Address, Foreign::Function, Foreign::Length] {
                let mut reply = Vec::new();
                rtu::encode_frame(247, &pdu, &mut reply);
                let frame = foreign(what, RTU, &reply);
                assert!(rtu::open_frame(&frame).is_some() && frame != reply, "{what:?} {pdu:?}");
            }
        }
    }
}
