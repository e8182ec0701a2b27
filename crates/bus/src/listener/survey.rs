//! Records which addresses and registers another master polls, and how often. Pure: time is an argument.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use super::decoder::{Exchange, Traffic};
use crate::transaction::Ended;
use drivegate_model::drive::Profile;
use drivegate_model::drive::profile::Profiles;
use drivegate_proto::{Protocol, Reply, RequestPdu, Table, describe};

/// Different requests to one address that are counted apart.
const MOST_REQUESTS: usize = 256;

/// A request, each time it was received.
#[derive(Debug, Clone)]
pub struct SurveyedRequest {
    /// The request as text.
    pub what: String,
    /// Table, first address and count of a read.
    pub read: Option<(Table, u16, u16)>,
    /// Number of times that the request was received.
    pub count: u64,
    /// Number of answers with values or an acknowledgement.
    pub answered: u64,
    /// Number of refusals of this request.
    pub refused: u64,
    first: Instant,
    last: Instant,
}

impl SurveyedRequest {
    /// Mean time between two of these requests, if it was received at least twice.
    pub fn cycle(&self) -> Option<Duration> {
        let intervals = u32::try_from(self.count.checked_sub(1)?).ok().filter(|n| *n > 0)?;
        Some(self.last.saturating_duration_since(self.first) / intervals)
    }
}

/// The observed traffic of one address.
#[derive(Debug, Clone, Default)]
pub struct Address {
    /// Each request of the other master, keyed by its text.
    pub requests: BTreeMap<String, SurveyedRequest>,
    /// Requests that got an answer, perhaps a refusal.
    pub answered: u64,
    /// Number of requests without an answer.
    pub silent: u64,
    /// Damaged replies, or replies to an uncertain request.
    pub doubtful: u64,
    /// Sum of the times from request to answer.
    turnaround: Duration,
}

impl Address {
    /// Mean time from the end of a request to the beginning of its answer.
    pub fn turnaround(&self) -> Option<Duration> {
        let answered = u32::try_from(self.answered).ok().filter(|n| *n > 0)?;
        Some(self.turnaround / answered)
    }

    /// The profiles for this protocol whose registers include all answered reads; those that name most of the
    /// registers come first. Empty if nothing was read.
    pub fn fitting(&self, profiles: &Profiles, protocol: Protocol) -> Vec<String> {
        let answered = self.requests.values().filter(|asked| asked.answered > 0);
        let reads: Vec<(Table, u16, u16)> = answered.filter_map(|asked| asked.read).collect();
        let speaking = profiles.iter().filter(|profile| profile.protocols.contains(&protocol));
        let named = |profile: &Profile| -> usize {
            let covers = |table: Table, address: u16| {
                let table = profile.canonical(table);
                reads.iter().any(|(of, start, count)| {
                    profile.canonical(*of) == table && (*start..start.saturating_add(*count)).contains(&address)
                })
            };
            let raw = profile.points.iter().filter_map(|point| point.raw());
            raw.filter(|raw| covers(raw.table, raw.address)).count()
        };
        let holds = |profile: &Profile| {
            reads.iter().all(|(table, start, count)| {
                let last = start.saturating_add(count.saturating_sub(1));
                profile.range(*table, *start).is_some() && profile.range(*table, last).is_some()
            })
        };
        let mut fitting: Vec<(usize, String)> = speaking
            .filter(|profile| !reads.is_empty() && holds(profile))
            .map(|profile| (named(profile), profile.name.clone()))
            .filter(|(named, _)| *named > 0)
            .collect();
        fitting.sort_by_key(|(named, _)| std::cmp::Reverse(*named));
        fitting.into_iter().map(|(_, name)| name).collect()
    }
}

/// The observed traffic of a line.
#[derive(Debug, Default)]
pub struct Survey {
    /// The drives by address; 0 is the broadcast.
    pub addresses: BTreeMap<u8, Address>,
    /// Number of requests received.
    pub requests: u64,
    /// Bytes that belong to no transaction.
    pub stray: u64,
    first: Option<Instant>,
    last: Option<Instant>,
}

impl Survey {
    /// Adds a received frame to the survey.
    pub fn add(&mut self, protocol: Protocol, heard: &Traffic) {
        let (began, at) = match heard {
            Traffic::Stray { bytes, at, .. } => {
                self.stray += bytes.len() as u64;
                (*at, *at)
            }
            Traffic::Exchange(exchange) => {
                self.exchange(protocol, exchange);
                (exchange.began, exchange.sent)
            }
        };
        self.first.get_or_insert(began);
        self.last = Some(at);
    }

    fn exchange(&mut self, protocol: Protocol, exchange: &Exchange) {
        self.requests += 1;
        let address = self.addresses.entry(exchange.address).or_default();
        let sure = exchange.doubt.is_none();
        match &exchange.ended {
            Some(Ended::Reply(_)) if sure => {
                address.answered += 1;
                let replied = exchange.replied.unwrap_or(exchange.at);
                address.turnaround += replied.saturating_duration_since(exchange.sent);
            }
            Some(Ended::Reply(_) | Ended::Corrupt(_)) => address.doubtful += 1,
            Some(Ended::Silent) => address.silent += 1,
            None => {}
        }
        let pdu = exchange.request.as_ref().map(|request| &request.pdu);
        let what = pdu.map_or("a command of another kind".to_string(), |pdu| {
            request_text(protocol, pdu)
        });
        if address.requests.len() >= MOST_REQUESTS && !address.requests.contains_key(&what) {
            return;
        }
        let asked = address.requests.entry(what.clone()).or_insert_with(|| SurveyedRequest {
            what,
            read: match pdu {
                Some(RequestPdu::Read { table, start, count }) => Some((*table, *start, *count)),
                _ => None,
            },
            count: 0,
            answered: 0,
            refused: 0,
            first: exchange.began,
            last: exchange.began,
        });
        asked.count += 1;
        asked.last = exchange.began;
        match &exchange.ended {
            Some(Ended::Reply(Reply::Exception(_))) if sure => asked.refused += 1,
            Some(Ended::Reply(_)) if sure => asked.answered += 1,
            _ => {}
        }
    }

    /// Time for which the line was monitored.
    pub fn time(&self) -> Duration {
        let ends = self.first.zip(self.last);
        ends.map_or(Duration::ZERO, |(first, last)| last.saturating_duration_since(first))
    }

    /// The cycle of the other master: the cycle of the request that it repeats most often.
    pub fn cycle(&self) -> Option<Duration> {
        let all = self.addresses.values().flat_map(|address| address.requests.values());
        all.max_by_key(|asked| asked.count).and_then(SurveyedRequest::cycle)
    }
}

/// Text of a request without the values that it writes, which differ each time.
fn request_text(protocol: Protocol, pdu: &RequestPdu) -> String {
    let text = describe::request_on(protocol, pdu);
    match text.split_once(" = ") {
        Some((what, _)) if pdu.is_write() => what.to_string(),
        _ => text,
    }
}
