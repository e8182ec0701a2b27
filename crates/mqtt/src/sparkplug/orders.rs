//! DCMD messages: each becomes one order, checked, audited and answered like any other. Sparkplug has no message
//! for results, so they become metrics of the drive. Time is an argument.

use std::collections::VecDeque;
use std::future::poll_fn;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use serde_json::Value as Json;

use super::super::request::Incoming;
use super::model::DriveMetrics;
use super::session::Session;
use super::wire::{self, Metric, MetricValue, Payload};
use drivegate_core::order::{Answer, Arrival, CONFIRMED, DEFAULT_EXPIRY, Proof, Refusal, Right, SourceKind};
use drivegate_core::plant::{Placed, Plant};
use drivegate_model::drive::{ModelPoint, Profile};
use drivegate_north::command_json::{ParsedCommand, SharedMemory, Taken, excerpt, refuse_unknown, resolve};

/// Commands whose result is awaited; the queues of the buses take fewer. The results of further ones are in the audit
/// only.
const AWAITED: usize = 4096;
/// Name in the audit of a command that could not be read.
const UNREAD: &str = "a Sparkplug command";
/// Maximum number of metrics in a command.
const METRICS: usize = 64;

/// The command processing of the Sparkplug node.
#[derive(Debug)]
pub(super) struct Orders {
    /// All messages over the connection to the broker count as one client.
    client: Arc<str>,
    awaited: VecDeque<Awaited>,
    memory: SharedMemory,
    /// The right to write of all hosts.
    right: Right,
}

/// Commands whose results a node leaves to its successor.
#[derive(Debug)]
pub(crate) struct NodeOrdersLeft(VecDeque<Awaited>);

#[derive(Debug)]
struct Awaited {
    drive: String,
    metrics: Vec<usize>,
    placed: Placed,
}

/// The result of a command.
#[derive(Debug, PartialEq)]
pub(super) struct Finished {
    /// Name of the drive: a reload may have moved the drive.
    pub(super) drive: String,
    /// The metrics that were to be changed.
    pub(super) metrics: Vec<usize>,
    /// The code of the result, and the reason if the command failed; empty if it did not.
    pub(super) code: &'static str,
    pub(super) error: String,
}

impl Finished {
    fn of(drive: &str, metrics: Vec<usize>, answer: &Answer, confirmed: Option<Duration>) -> Finished {
        let ok = answer.outcome.is_ok();
        Finished {
            drive: drive.to_string(),
            metrics,
            code: if confirmed.is_some() {
                CONFIRMED
            } else {
                answer.outcome.code()
            },
            error: if ok { String::new() } else { answer.outcome.to_string() },
        }
    }
}

impl Orders {
    /// `memory` outlives this client, so that a command is recognised after a reload; `left` are the commands of
    /// the previous client.
    pub(super) fn new(memory: SharedMemory, right: Right, left: Option<NodeOrdersLeft>) -> Orders {
        Orders {
            client: SourceKind::Sparkplug.name().into(),
            awaited: left.map(|left| left.0).unwrap_or_default(),
            memory,
            right,
        }
    }

    /// The state with which the next client continues.
    pub(super) fn leave(self) -> NodeOrdersLeft {
        NodeOrdersLeft(self.awaited)
    }

    /// Processes a command for the device with this name. When this returns, its order is in the queue of the bus,
    /// or the result is returned. `target` is the drive of that name, with its index in the session.
    pub(super) fn take(
        &mut self,
        incoming: &Incoming,
        device: &str,
        target: Option<(usize, &DriveMetrics)>,
        session: &Session,
        plant: &Plant,
        now: Instant,
    ) -> Option<Finished> {
        let origin = incoming
            .origin(&self.client, SourceKind::Sparkplug)
            .proven(Proof::Sparkplug)
            .with_right(self.right.clone());
        let Some((place, metrics)) = target else {
            refuse_unknown(plant, device, UNREAD, origin, now);
            return None;
        };
        let drive = &metrics.drive;
        let placed = |metric: &Metric| session.metric(place, metric.name.as_deref(), metric.alias);
        let request = match Request::read(incoming, placed) {
            Ok(request) => request,
            Err(refusal) => {
                let answer = drive.refuse(UNREAD, refusal, origin, now);
                return Some(Finished::of(device, Vec::new(), &answer, None));
            }
        };
        let touched = request.metrics();
        let refused = |answer: &Answer| Some(Finished::of(device, touched.clone(), answer, None));
        let life = incoming.expiry.map(|s| Duration::from_secs(s.into()));
        let expiry = life.map_or(DEFAULT_EXPIRY, |life| life.min(DEFAULT_EXPIRY));
        let profile = &drive.image.spec.profile;
        let mut asked = match request.asked(profile, session, place, expiry) {
            Err(refusal) => return refused(&drive.refuse(&request.what(), refusal, origin, now)),
            Ok(asked) => asked,
        };
        if asked.does_more(profile)
            && request.timestamp.is_some()
            && let Err(why) = self.remember(incoming, now)
        {
            asked.refused = Some(Refusal::NotAllowed(why.to_string()));
        }
        let arrival = incoming.arrival.clone().unwrap_or_else(|| Arrival::now(now));
        let mut placed = match asked.place(drive, &request.what(), origin, arrival, now) {
            Ok(placed) => placed,
            Err(answer) => return refused(&answer),
        };
        if let Some(answer) = placed.answer().filter(|answer| !answer.outcome.is_ok()) {
            return refused(&answer);
        }
        if self.awaited.len() < AWAITED {
            self.awaited.push_back(Awaited {
                drive: device.to_string(),
                metrics: touched,
                placed,
            });
        }
        None
    }

    /// A bridge that forwards messages in a loop cannot start a motor a second time: a payload with an unchanged
    /// time is not executed again.
    fn remember(&self, incoming: &Incoming, now: Instant) -> Result<(), &'static str> {
        let taken = Taken {
            topic: &incoming.topic,
            payload: &incoming.payload,
            ..Taken::default()
        };
        let mut memory = self.memory.lock();
        // Only the payload identifies the message; it contains the time.
        let print = memory.fingerprint(&taken, Some(""));
        if memory.repeated(&taken, print, 0, now).is_some() {
            return Err(
                "it repeats an earlier command: the same payload with the same time; send it with its own time",
            );
        }
        if !memory.has_room(now) {
            return Err("too many commands within ten minutes; nothing was written");
        }
        memory.remember(&taken, print, 0, now);
        Ok(())
    }

    /// The next order that ends; pending while no order is in progress. Cancel safe.
    pub(super) async fn finished(&mut self) -> Finished {
        poll_fn(|cx| self.poll_finished(cx)).await
    }

    fn poll_finished(&mut self, cx: &mut Context<'_>) -> Poll<Finished> {
        let ready = |awaited: &mut Awaited| match awaited.placed.poll_answer(cx) {
            Poll::Ready(answer) if answer.outcome.is_ok() => awaited.placed.poll_confirmation(cx).is_ready(),
            Poll::Ready(_) => true,
            Poll::Pending => false,
        };
        let place = self.awaited.iter_mut().position(ready);
        let ended = place.and_then(|place| self.awaited.remove(place));
        let finished = ended.and_then(|mut awaited| {
            let (answer, confirmed) = (awaited.placed.answer()?, awaited.placed.shown().after);
            Some(Finished::of(&awaited.drive, awaited.metrics, &answer, confirmed))
        });
        finished.map_or(Poll::Pending, Poll::Ready)
    }

    /// Whether no order waits for a result.
    pub(super) fn is_idle(&self) -> bool {
        self.awaited.is_empty()
    }
}

/// The request contained in a message.
struct Request {
    /// The metrics in the order of the message, with their indices in the session.
    metrics: Vec<(Metric, Option<usize>)>,
    timestamp: Option<u64>,
}

impl Request {
    fn read(incoming: &Incoming, place: impl Fn(&Metric) -> Option<usize>) -> Result<Request, Refusal> {
        if incoming.retain {
            let why = "a retained message is never a command; publish it without the retain flag and clear the topic";
            return Err(Refusal::NotAllowed(why.to_string()));
        }
        if let Some(bytes) = incoming.oversized {
            let why = format!("the payload has {bytes} bytes, at most 65536 are allowed");
            return Err(Refusal::BadValue(why));
        }
        let payload = Payload::decoded(&incoming.payload)
            .map_err(|why| Refusal::BadValue(format!("the payload is not Sparkplug B: {why}")))?;
        let placed = |mut metric: Metric| {
            // Some hosts send the field empty in addition to an alias.
            metric.name = metric.name.filter(|name| !name.is_empty());
            let place = place(&metric);
            (metric, place)
        };
        Ok(Request {
            metrics: payload.metrics.into_iter().map(placed).collect(),
            timestamp: payload.timestamp,
        })
    }

    fn metrics(&self) -> Vec<usize> {
        let metrics = self.metrics.iter().take(METRICS);
        metrics.filter_map(|(_, place)| *place).collect()
    }

    /// Text for the audit if the request is refused before it becomes a command.
    fn what(&self) -> String {
        let name = |(metric, _): &(Metric, Option<usize>)| {
            let value = json(metric).map_or_else(|| "null".to_string(), |value| value.to_string());
            match (&metric.name, metric.alias) {
                (Some(name), _) => format!("{name}={value}"),
                (None, Some(alias)) => format!("alias {alias}={value}"),
                (None, None) => format!("?={value}"),
            }
        };
        let all: Vec<String> = self.metrics.iter().take(8).map(name).collect();
        excerpt(all.join(" ").as_bytes())
    }

    /// The command for the device with this index in the session.
    fn asked(
        &self,
        profile: &Profile,
        session: &Session,
        device: usize,
        expiry: Duration,
    ) -> Result<ParsedCommand, Refusal> {
        let alias = |metric| session.alias(device, metric);
        let name = |metric| session.definition(device, metric).map(|d| d.name.clone());
        let point = |(metric, place): &(Metric, Option<usize>)| {
            if let (Some(name), Some(sent), Some(own)) = (&metric.name, metric.alias, place.and_then(alias))
                && sent != own
                && sent != 0
            {
                let name = excerpt(name.as_bytes());
                return Err(Refusal::BadValue(format!(
                    "the metric {name} has the alias {own}, not {sent}; send the name or the alias, and request a \
                     birth with `Node Control/Rebirth` if the aliases are old"
                )));
            }
            let name = match (&metric.name, place.and_then(name)) {
                (Some(name), _) => name.clone(),
                (None, Some(name)) => name,
                (None, None) => {
                    let alias = metric
                        .alias
                        .map_or_else(|| "none".to_string(), |alias| alias.to_string());
                    return Err(Refusal::NotWritable(format!(
                        "no metric of the drive has the alias {alias}; request a birth with `Node Control/Rebirth`"
                    )));
                }
            };
            let value = json(metric).ok_or_else(|| {
                let name = excerpt(name.as_bytes());
                Refusal::BadValue(format!(
                    "{name} has no value that can be commanded (null, a text, not finite)"
                ))
            })?;
            resolve(profile, &name, &value)
        };
        let (mut points, mut refused) = (Vec::new(), None);
        let count = self.metrics.len();
        if count > METRICS {
            let why = format!("the command has {count} metrics, at most {METRICS} are allowed");
            refused = Some(Refusal::BadValue(why));
        }
        // When there are too many metrics only the stop is evaluated.
        let run = profile.model_point(ModelPoint::Run).map(|point| point.name.as_str());
        let is_run = |(metric, place): &&(Metric, Option<usize>)| {
            place.and_then(name).as_deref().or(metric.name.as_deref()) == run && run.is_some()
        };
        for metric in self.metrics.iter().filter(|metric| count <= METRICS || is_run(metric)) {
            match point(metric) {
                Ok(point) => points.push(point),
                Err(refusal) => refused = refused.or(Some(refusal)),
            }
        }
        ParsedCommand::new(points, expiry, refused, profile)
    }
}

/// The value of a metric, for any type of number that the host sends; `None` for null, for texts and for values
/// such as NaN.
fn json(metric: &Metric) -> Option<Json> {
    if metric.is_null == Some(true) {
        return None;
    }
    let unsigned = metric.datatype.is_some_and(wire::is_unsigned);
    let number = |number: f64| serde_json::Number::from_f64(number).map(Json::Number);
    match metric.value.as_ref()? {
        MetricValue::Boolean(state) => Some(Json::Bool(*state)),
        MetricValue::Int(word) if unsigned => Some(Json::from(*word)),
        MetricValue::Int(word) => Some(Json::from(word.cast_signed())),
        MetricValue::Long(word) if unsigned => Some(Json::from(*word)),
        MetricValue::Long(word) => Some(Json::from(word.cast_signed())),
        // The value as the decimal that the host meant: 33.3, not 33.29999923706055.
        MetricValue::Float(value) => number(value.to_string().parse().ok()?),
        MetricValue::Double(value) => number(*value),
        MetricValue::String(_) => None,
    }
}

#[cfg(test)]
mod tests;
