//! A reading of all parameters of a drive: decides the next request and applies replies. Pure.
//!
//! A family lists its parameters or their address ranges. In a range every address is read, and an address refused
//! with 02 does not exist. Later readings read only the addresses found before, until one of them is refused: then
//! the drive has another application, and everything is read again.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use super::file::{Entry, Id, ParameterFile};
use super::names::Names;
use crate::diagnosis::CountedByDrive;
use crate::order::Outcome;
use drivegate_model::drive::Profile;
use drivegate_model::drive::parameters::{Label, Numbering, RawValue};
use drivegate_proto::{Exception, Reply, RequestPdu, Table};

/// Attempts of a request without a reply.
const TRIES: u32 = 4;
/// Tries of a request to a drive that is busy.
const BUSY_TRIES: u32 = 20;
/// Pause before a request to a busy drive is repeated.
const BUSY_PAUSE: Duration = Duration::from_millis(200);
/// Pause before a request to an absent drive is repeated.
const AWAY_PAUSE: Duration = Duration::from_secs(1);

/// What follows a reply during a reading.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Next {
    /// The next request follows.
    Go,
    /// The next request follows after this time, for the reason given.
    Pause(Duration, String),
    /// The reading cannot continue, for this reason.
    Failed(String),
}

#[derive(Debug, Clone, Copy)]
struct Block {
    start: u16,
    /// Number of parameters in the block.
    count: u16,
    tries: u32,
}

/// A reading in progress.
#[derive(Debug)]
pub struct Reading {
    profile: Arc<Profile>,
    todo: VecDeque<Block>,
    found: BTreeMap<u16, Result<RawValue, String>>,
    /// The addresses found by an earlier reading; empty once everything is read.
    known: BTreeSet<u16>,
    total: usize,
    counters: Counters,
}

/// The line counters that the drive itself keeps, read after the parameters if its family has them (function 08).
#[derive(Debug)]
enum Counters {
    /// The family has no counters, or the drive does not report them.
    Absent,
    /// Counters read so far, and the tries of the next one.
    Reading(Vec<u16>, u32),
    Read(CountedByDrive),
}

impl Reading {
    /// Starts a reading of a drive of this family; `known` are the addresses found by an earlier reading.
    pub fn new(profile: Arc<Profile>, known: BTreeSet<u16>) -> Reading {
        let mut reading = Reading {
            profile,
            todo: VecDeque::new(),
            found: BTreeMap::new(),
            known,
            total: 0,
            counters: Counters::Absent,
        };
        if reading.profile.counts_messages {
            reading.counters = Counters::Reading(Vec::new(), 0);
        }
        let first: BTreeSet<u16> = if reading.known.is_empty() {
            reading.everywhere()
        } else {
            reading.known.clone()
        };
        reading.ask(&first);
        reading
    }

    /// The addresses that a file of the same family contains.
    pub fn addresses_of(profile: &Profile, file: &ParameterFile) -> BTreeSet<u16> {
        let ids = file.values.keys();
        ids.filter_map(|id| profile.parameters.address(id.name())).collect()
    }

    /// All addresses that may have a parameter.
    fn everywhere(&self) -> BTreeSet<u16> {
        let list = &self.profile.parameters;
        let spans = list.spans.iter().flat_map(|span| {
            let numbered = |address: &u16| span.numbering != Numbering::Group || span.numbering.id(*address).is_some();
            (span.first..=span.last).filter(numbered)
        });
        let named = list.named.iter().map(|parameter| parameter.address);
        named.chain(spans).collect()
    }

    /// Plans the reads of these addresses: neighbours together, as far as the drive allows.
    fn ask(&mut self, addresses: &BTreeSet<u16>) {
        let words = self.profile.parameter_words();
        self.total = addresses.len();
        self.found.clear();
        self.todo.clear();
        let mut block: Option<Block> = None;
        for &address in addresses {
            let joined = block.and_then(|block| {
                let (most, holes) = self.profile.parameter_read(block.start);
                let count = address.checked_sub(block.start)? / words + 1;
                let next = holes || count == block.count + 1;
                let fits = count <= most && address <= self.profile.parameter_range_end(block.start);
                (next && fits).then_some(Block { count, ..block })
            });
            if joined.is_none() {
                self.todo.extend(block);
            }
            block = joined.or(Some(Block {
                start: address,
                count: 1,
                tries: 0,
            }));
        }
        self.todo.extend(block);
        // What the profile names is what people look for, so it comes before the search for others.
        let todo = std::mem::take(&mut self.todo);
        let (named, others): (Vec<Block>, Vec<Block>) = todo.into_iter().partition(|block| self.names(block));
        self.todo = named.into_iter().chain(others).collect();
    }

    /// Addresses of a block.
    fn addresses(&self, block: &Block) -> impl Iterator<Item = u16> {
        let words = self.profile.parameter_words();
        (0..block.count).filter_map({
            let start = block.start;
            move |place| start.checked_add(place.checked_mul(words)?)
        })
    }

    /// Whether the profile names a parameter of the block.
    fn names(&self, block: &Block) -> bool {
        let list = &self.profile.parameters;
        self.addresses(block).any(|address| list.by_address(address).is_some())
    }

    /// What is read now: `parameters 101 to 130`, or `looking for others: 1200 to 1229`; none at the end.
    pub fn now(&self) -> Option<String> {
        let block = self.todo.front()?;
        let list = &self.profile.parameters;
        let ids: Vec<String> = self.addresses(block).filter_map(|address| list.id(address)).collect();
        let ids = match ids.as_slice() {
            [] => return None,
            [one] => one.clone(),
            [first, .., last] => format!("{first} to {last}"),
        };
        Some(if self.names(block) {
            format!("parameters {ids}")
        } else {
            format!("looking for others: {ids}")
        })
    }

    /// The next request to send; `None` if all requests were sent.
    pub fn request(&self) -> Option<RequestPdu> {
        let Some(block) = self.todo.front() else {
            return match &self.counters {
                Counters::Reading(so_far, _) => Some(CountedByDrive::request(so_far)),
                Counters::Absent | Counters::Read(_) => None,
            };
        };
        Some(RequestPdu::Read {
            table: Table::Holding,
            start: block.start,
            count: block.count * self.profile.parameter_words(),
        })
    }

    /// Number of addresses requested so far, and of all.
    pub fn progress(&self) -> (usize, usize) {
        let open: usize = self.todo.iter().map(|block| usize::from(block.count)).sum();
        (self.total.saturating_sub(open), self.total)
    }

    /// Takes the outcome of the request that [`Reading::request`] gave; returns what to do next.
    pub fn answered(&mut self, outcome: &Outcome) -> Next {
        let Some(mut block) = self.todo.pop_front() else {
            return self.counted(outcome);
        };
        let words = self.profile.parameter_words();
        match outcome {
            Outcome::Acknowledged(reply) => {
                let values = reply.words().unwrap_or_default();
                if values.len() != usize::from(block.count * words) {
                    return Next::Failed("the length of the reply differs from what was requested".to_string());
                }
                let addresses = (block.start..).step_by(usize::from(words));
                for (address, words) in addresses.zip(values.chunks(usize::from(words))) {
                    self.take(address, words);
                }
                Next::Go
            }
            Outcome::Exception(Exception::ADDRESS | Exception::VALUE) if block.count > 1 => {
                self.split(block);
                Next::Go
            }
            Outcome::Exception(Exception::ADDRESS) => self.absent(block.start),
            Outcome::Exception(Exception::BUSY) if block.tries < BUSY_TRIES => {
                block.tries += 1;
                self.todo.push_front(block);
                Next::Pause(BUSY_PAUSE, "the drive is busy".to_string())
            }
            Outcome::TimedOut | Outcome::Garbled | Outcome::Unknown(_) if block.tries < TRIES => {
                block.tries += 1;
                self.todo.push_front(block);
                Next::Go
            }
            Outcome::Exception(_) | Outcome::TimedOut | Outcome::Garbled | Outcome::Unknown(_) if block.count > 1 => {
                self.split(block);
                Next::Go
            }
            Outcome::Exception(_) => {
                self.found.insert(block.start, Err(outcome.to_string()));
                Next::Go
            }
            Outcome::TimedOut | Outcome::Garbled | Outcome::Unknown(_) => {
                self.found
                    .insert(block.start, Err("the drive gave no valid reply".to_string()));
                Next::Go
            }
            Outcome::Refused(refusal) => Next::Failed(refusal.to_string()),
            Outcome::ShuttingDown => Next::Failed("the gateway is shutting down, or the bus restarts".to_string()),
            Outcome::Expired => {
                self.todo.push_front(block);
                Next::Go
            }
            away => {
                self.todo.push_front(block);
                let why = match away {
                    Outcome::Offline => "the drive does not reply".to_string(),
                    Outcome::BusDown => "the bus is down".to_string(),
                    other => other.to_string(),
                };
                Next::Pause(AWAY_PAUSE, why)
            }
        }
    }

    /// Takes the drive's answer for a counter. The parameters do not wait for counters that the drive does not report.
    fn counted(&mut self, outcome: &Outcome) -> Next {
        if let Counters::Reading(so_far, tries) = &mut self.counters {
            match outcome {
                Outcome::Acknowledged(Reply::Diagnostics(count)) => {
                    so_far.push(*count);
                    *tries = 0;
                    if let Some(all) = CountedByDrive::complete(so_far) {
                        self.counters = Counters::Read(all);
                    }
                }
                Outcome::TimedOut | Outcome::Garbled | Outcome::Unknown(_) | Outcome::Expired if *tries < TRIES => {
                    *tries += 1;
                }
                _ => self.counters = Counters::Absent,
            }
        }
        Next::Go
    }

    fn take(&mut self, address: u16, words: &[u16]) {
        // Words in an unused gap of a block are not parameters.
        if self.profile.parameters.id(address).is_none() {
            return;
        }
        let value = match RawValue::of_words(words) {
            Some(RawValue::Float(bits)) if !f32::from_bits(bits).is_finite() => {
                Err("the object does not hold a number".to_string())
            }
            Some(value) => Ok(value),
            None => Err("the length of the reply differs from what was requested".to_string()),
        };
        self.found.insert(address, value);
    }

    /// Requests each address of a refused block separately, to find the refused one.
    fn split(&mut self, block: Block) {
        let alone = |start| Block {
            start,
            count: 1,
            tries: 0,
        };
        let list = &self.profile.parameters;
        let blocks = self.addresses(&block).filter(|address| list.id(*address).is_some());
        let (named, others): (Vec<Block>, Vec<Block>) = blocks.map(alone).partition(|block| self.names(block));
        named.into_iter().rev().for_each(|block| self.todo.push_front(block));
        self.todo.extend(others);
    }

    /// No parameter exists at this address. If an earlier reading found one there, all addresses are requested again.
    fn absent(&mut self, address: u16) -> Next {
        if self.known.contains(&address) {
            self.known.clear();
            let all = self.everywhere();
            self.ask(&all);
        }
        Next::Go
    }

    /// The result as a file; `names` take precedence over the names of the family.
    pub fn file(&self, drive: &str, identification: &str, time: &str, names: &Names) -> ParameterFile {
        let list = &self.profile.parameters;
        let values = self.found.iter().filter_map(|(address, value)| {
            let id = Id::new(&list.id(*address)?);
            let label = names
                .get(&id)
                .or_else(|| list.by_address(*address).map(|parameter| &parameter.label));
            let note = label.map_or(String::new(), |label| note(label, value.as_ref().ok().copied()));
            let value = value.clone();
            Some((id, Entry { value, note }))
        });
        ParameterFile {
            drive: drive.to_string(),
            family: self.profile.name.clone(),
            identification: identification.to_string(),
            time: time.to_string(),
            counters: match &self.counters {
                Counters::Read(counted) => counted.to_string(),
                Counters::Absent | Counters::Reading(..) => String::new(),
            },
            values: values.collect(),
        }
    }
}

/// The readable note: the value in its unit, and the name.
fn note(label: &Label, value: Option<RawValue>) -> String {
    let shown = value.map_or(String::new(), |value| label.value(value));
    match (shown.as_str(), label.name.as_str()) {
        ("", name) => name.to_string(),
        (shown, "") => shown.to_string(),
        (shown, name) => format!("{shown}, {name}"),
    }
}

impl ParameterFile {
    /// The file with what people read remade, by the user's names and then those of the family.
    #[must_use]
    pub fn named(mut self, profile: &Profile, names: &Names) -> ParameterFile {
        for (id, entry) in &mut self.values {
            let own = || {
                Some(
                    &profile
                        .parameters
                        .by_address(profile.parameters.address(id.name())?)?
                        .label,
                )
            };
            if let Some(label) = names.get(id).or_else(own) {
                entry.note = note(label, entry.value.as_ref().ok().copied());
            }
        }
        self
    }
}
