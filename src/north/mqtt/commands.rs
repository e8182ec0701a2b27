//! The set topics: from a message to one order, and from its answer to one result.

use std::collections::VecDeque;
use std::hash::{BuildHasher, RandomState};
use std::time::{Duration, Instant, SystemTime};

use serde::Serialize;
use serde_json::Value as Json;
use tokio::task::JoinSet;

use super::connection::is_topic;
use super::outbox::Message;
use super::payload::{self, Topics};
use super::request::{self, Incoming, MAX_NAME, excerpt};
use crate::command::{Answer, CONFIRMED, Order, Origin, Outcome, SourceKind};
use crate::document::nearest;
use crate::drive::ModelPoint;
use crate::plant::Plant;

/// Commands that wait for their answer.
const MAX_RUNNING: usize = 64;
/// Commands that wait for their answer besides, if they are stops.
const MAX_STOPS: usize = 64;
/// Messages remembered to recognise a repetition.
const REMEMBERED: usize = 256;
/// Time for which a command with an `id` is recognised when it comes again.
const REPLAYED: Duration = Duration::from_secs(60);

/// Takes commands and gives their results.
#[derive(Debug)]
pub(super) struct Commands {
    topics: Topics,
    running: JoinSet<(u64, Message)>,
    hasher: RandomState,
    /// Commands taken, oldest first.
    recent: VecDeque<Taken>,
    /// Commands taken so far: their numbers.
    taken: u64,
}

/// A command that was taken.
#[derive(Debug)]
struct Taken {
    number: u64,
    fingerprint: u64,
    packet: u16,
    /// Hash of topic and `id`, where it has one.
    identity: Option<u64>,
    at: Instant,
    /// Once it is there.
    result: Option<Message>,
}

impl Commands {
    pub(super) fn new(topics: Topics) -> Commands {
        Commands {
            topics,
            running: JoinSet::new(),
            hasher: RandomState::new(),
            recent: VecDeque::new(),
            taken: 0,
        }
    }

    /// Takes a message; returns its result if it is there at once. A repetition of a command is answered from memory
    /// and not carried out again: one that the broker marks as such, or the same message with the same `id` within a
    /// minute. A stop is carried out whenever it comes.
    pub(super) fn take(&mut self, incoming: Incoming, plant: &Plant, now: Instant) -> Option<Message> {
        let target = self.topics.parse_set(&incoming.topic)?;
        if incoming.retain && incoming.payload.is_empty() {
            return None; // somebody takes a retained message away
        }
        let reply = Reply::to(&incoming, self.topics.drive(target.drive, "result"), target.drive);
        let origin = Origin {
            kind: SourceKind::Mqtt,
            who: incoming.topic.clone(),
        };
        let what = || excerpt(&incoming.payload);
        let Some(drive) = plant.drive(target.drive) else {
            let name = excerpt(target.drive.as_bytes());
            let why = unknown_drive(target.drive, plant);
            let answer = plant.refuse_unknown(name.trim_matches('`'), &what(), why, origin);
            return Some(reply.answer(request::id(&incoming, target.point), &answer, None));
        };
        let profile = &drive.image.spec.profile;
        let request = request::read(&incoming, target.point, profile);
        let (points, expiry) = match request.order {
            Err(refusal) => return Some(reply.answer(request.id, &drive.refuse(&what(), refusal, origin), None)),
            Ok(order) => order,
        };
        let run = profile.model_index(ModelPoint::Run);
        let stop = points.iter().any(|(i, v)| Some(*i) == run && !v.as_bool());
        let fingerprint = self.fingerprint(&incoming);
        let id = request.id.as_ref().map(Json::to_string);
        let identity = id.map(|id| self.hasher.hash_one((&incoming.topic, id)));
        if !stop && let Some(known) = self.repeated(&incoming, fingerprint, identity, now) {
            return known.result.clone();
        }
        let most = if stop { MAX_RUNNING + MAX_STOPS } else { MAX_RUNNING };
        if self.running.len() >= most {
            let answer = drive.turn_away(&what(), Outcome::QueueFull, origin);
            return Some(reply.answer(request.id, &answer, None));
        }
        let number = self.remember(fingerprint, &incoming, identity, now);
        self.running.spawn(async move {
            let order = Order::Points(points);
            let (answer, confirmed) = drive.order_confirmed(order, origin, true, expiry).await;
            (number, reply.answer(request.id, &answer, confirmed))
        });
        None
    }

    fn fingerprint(&self, incoming: &Incoming) -> u64 {
        let Incoming {
            topic,
            payload,
            response_topic,
            correlation,
            ..
        } = incoming;
        self.hasher.hash_one((topic, payload, response_topic, correlation))
    }

    /// The command that a message repeats. An `id` that was used for something else since is no sign of a repetition.
    fn repeated(&self, incoming: &Incoming, fingerprint: u64, identity: Option<u64>, now: Instant) -> Option<&Taken> {
        let newest_first = || self.recent.iter().rev();
        let same = |known: &&Taken| known.fingerprint == fingerprint;
        let marked = newest_first().find(|known| incoming.dup && known.packet == incoming.packet && same(known));
        let by_id = || {
            let last = newest_first().find(|known| identity.is_some() && known.identity == identity);
            last.filter(|known| now.saturating_duration_since(known.at) < REPLAYED && same(known))
        };
        marked.or_else(by_id)
    }

    fn remember(&mut self, fingerprint: u64, incoming: &Incoming, identity: Option<u64>, now: Instant) -> u64 {
        if self.recent.len() == REMEMBERED {
            self.recent.pop_front();
        }
        self.taken += 1;
        self.recent.push_back(Taken {
            number: self.taken,
            fingerprint,
            packet: incoming.packet,
            identity,
            at: now,
            result: None,
        });
        self.taken
    }

    /// The next result; waits for ever when no command is running. May be cancelled without loss.
    pub(super) async fn finished(&mut self) -> Message {
        loop {
            match self.running.join_next().await {
                Some(Ok((number, message))) => {
                    if let Some(known) = self.recent.iter_mut().find(|known| known.number == number) {
                        known.result = Some(message.clone());
                    }
                    return message;
                }
                Some(Err(error)) => tracing::error!("a command ended unexpectedly: {error}"),
                None => std::future::pending().await,
            }
        }
    }

    /// Whether no command waits for its answer.
    pub(super) fn is_idle(&self) -> bool {
        self.running.is_empty()
    }
}

fn unknown_drive(name: &str, plant: &Plant) -> String {
    let drives: Vec<_> = plant.drives().map(|d| d.image.spec.name.clone()).collect();
    let near = (name.len() <= MAX_NAME).then(|| nearest(name, drives.iter().map(String::as_str)));
    let hint = near
        .flatten()
        .map_or(String::new(), |near| format!("; did you mean `{near}`?"));
    format!("there is no drive {}{hint}", excerpt(name.as_bytes()))
}

/// Where a result goes.
#[derive(Debug, Clone)]
struct Reply {
    topic: String,
    correlation: Option<Vec<u8>>,
    drive: String,
}

#[derive(Serialize)]
struct ResultObject<'r> {
    id: Option<Json>,
    drive: &'r str,
    ok: bool,
    result: &'r str,
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<ErrorObject<'r>>,
    latency_ms: f64,
    /// From acceptance to the read that showed the effect.
    #[serde(skip_serializing_if = "Option::is_none")]
    confirmed_ms: Option<f64>,
    time: String,
}

#[derive(Serialize)]
struct ErrorObject<'r> {
    code: &'r str,
    message: String,
}

impl Reply {
    /// To the response topic of a request that names one, else to the result topic of the drive.
    fn to(incoming: &Incoming, result: String, drive: &str) -> Reply {
        let asked = incoming.response_topic.clone().filter(|topic| is_topic(topic));
        Reply {
            correlation: incoming.correlation.clone().filter(|_| asked.is_some()),
            topic: asked.unwrap_or(result),
            drive: drive.to_string(),
        }
    }

    /// The one result: `confirmed` when a read showed the effect in time, else how the bus answered.
    fn answer(&self, id: Option<Json>, answer: &Answer, confirmed: Option<Duration>) -> Message {
        let text = (!answer.outcome.is_ok()).then(|| answer.outcome.to_string());
        let code = match confirmed {
            Some(_) => CONFIRMED,
            None => answer.outcome.code(),
        };
        self.put(id, code, text, answer.latency, confirmed)
    }

    fn put(
        &self,
        id: Option<Json>,
        code: &str,
        error: Option<String>,
        latency: Duration,
        confirmed: Option<Duration>,
    ) -> Message {
        let object = ResultObject {
            id,
            drive: &self.drive,
            ok: error.is_none(),
            result: code,
            error: error.map(|message| ErrorObject { code, message }),
            latency_ms: payload::milliseconds(latency),
            confirmed_ms: confirmed.map(payload::milliseconds),
            time: payload::rfc3339(SystemTime::now()),
        };
        // Strings, figures and what was JSON before: this cannot fail.
        let payload = serde_json::to_vec(&object).unwrap_or_default();
        Message {
            correlation: self.correlation.clone(),
            ..Message::passing(self.topic.as_str(), payload)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::fixture;
    use super::*;
    use crate::codec::Reply as BusReply;
    use crate::command::Urgency;
    struct Bench {
        plant: Plant,
        commands: Commands,
        now: Instant,
        events: tokio::sync::broadcast::Receiver<std::sync::Arc<crate::event::Event>>,
    }

    impl Bench {
        fn new() -> Bench {
            let plant = fixture::plant(&["p1"]);
            fixture::read(&plant, "p1", 1, 0, Instant::now());
            Bench {
                events: plant.events.subscribe(),
                commands: Commands::new(Topics::new("drivegate", "hall")),
                now: Instant::now(),
                plant,
            }
        }

        fn take(&mut self, incoming: Incoming) -> Option<Message> {
            self.commands.take(incoming, &self.plant, self.now)
        }

        fn queued(&self) -> usize {
            self.plant.buses[0].queue.lock().len()
        }

        /// Lets the spawned commands get as far as they can, then acknowledges one.
        async fn acknowledge(&mut self) -> Json {
            loop {
                let command = self.plant.buses[0].queue.lock().pop(Urgency::Read, Instant::now());
                if let Some(command) = command {
                    let outcome = Outcome::Acknowledged(BusReply::Written);
                    command.ticket.answer(outcome, Instant::now());
                    return json(&self.commands.finished().await);
                }
                tokio::task::yield_now().await;
            }
        }
    }

    fn json(message: &Message) -> Json {
        serde_json::from_slice(&message.payload).unwrap()
    }

    fn set(topic: &str, payload: &str) -> Incoming {
        Incoming {
            topic: format!("drivegate/hall/drive/{topic}"),
            payload: payload.into(),
            packet: 1,
            ..Incoming::default()
        }
    }

    #[tokio::test]
    async fn a_command_is_carried_out_and_answered() {
        let mut bench = Bench::new();
        assert_eq!(bench.take(set("p1/set", r#"{"id": 5, "run": true}"#)), None);
        let result = bench.acknowledge().await;
        assert_eq!(result["id"], 5);
        assert_eq!(
            (&result["ok"], &result["result"]),
            (&true.into(), &"acknowledged".into())
        );
        assert!(result["latency_ms"].is_number() && result.get("error").is_none());
        assert!(bench.commands.is_idle());
    }

    #[tokio::test]
    async fn a_response_topic_gets_the_result_and_the_correlation() {
        let mut bench = Bench::new();
        let request = Incoming {
            response_topic: Some("client/7".to_string()),
            correlation: Some(vec![1, 0, 255]),
            ..set("p1/set", "no")
        };
        let result = bench.take(request.clone()).unwrap();
        assert_eq!(
            (result.topic.as_ref(), result.correlation),
            ("client/7", Some(vec![1, 0, 255]))
        );
        for bad in ["", "a/+", "#", "a\0b"] {
            let request = Incoming {
                response_topic: Some(bad.to_string()),
                ..request.clone()
            };
            let result = bench.take(request).unwrap();
            assert_eq!(result.topic.as_ref(), "drivegate/hall/drive/p1/result", "{bad:?}");
            assert_eq!(result.correlation, None);
        }
    }

    #[tokio::test]
    async fn refusals_are_told_audited_and_answered_and_nothing_is_queued() {
        let mut bench = Bench::new();
        for (incoming, code) in [
            (set("p1/set", "{"), "bad_value"),
            (set("p1/set", r#"{"ready": true}"#), "not_writable"),
            (
                Incoming {
                    retain: true,
                    ..set("p1/set", r#"{"run": true}"#)
                },
                "not_allowed",
            ),
        ] {
            let result = json(&bench.take(incoming).unwrap());
            assert_eq!((&result["ok"], &result["error"]["code"]), (&false.into(), &code.into()));
            assert!(!result["error"]["message"].as_str().unwrap().is_empty());
            let event = bench.events.try_recv().unwrap();
            assert_eq!(event.kind, crate::event::EventKind::RefusedCommand);
        }
        assert_eq!(bench.queued(), 0);
        assert_eq!(bench.plant.writes.results().values().sum::<u64>(), 3);
        let result = json(&bench.take(set("p11/set", r#"{"id": 21, "run": true}"#)).unwrap());
        assert_eq!(
            (&result["error"]["code"], &result["id"]),
            (&"unknown_drive".into(), &21.into())
        );
        let unknown = (crate::command::SourceKind::Mqtt, "unknown_drive");
        assert_eq!(bench.plant.writes.results().get(&unknown), Some(&1));
        let record = bench.plant.writes.audit().recent().pop().unwrap();
        assert_eq!((record.result, record.drive.as_str()), ("unknown_drive", "p11"));
        assert!(
            result["error"]["message"]
                .as_str()
                .unwrap()
                .contains("did you mean `p1`?")
        );
        let cleared = Incoming {
            retain: true,
            ..set("p1/set", "")
        };
        assert_eq!(bench.take(cleared), None, "somebody cleans up");
        assert!(bench.events.try_recv().is_err());
    }

    #[tokio::test]
    async fn limits_are_refused_where_all_orders_are() {
        let mut bench = Bench::new();
        assert_eq!(bench.take(set("p1/set/speed_reference", "101")), None);
        let result = json(&bench.commands.finished().await);
        assert_eq!(result["error"]["code"], "bad_value");
        assert_eq!(bench.take(set("p1/set", "{}")), None);
        let result = json(&bench.commands.finished().await);
        assert!(result["error"]["message"].as_str().unwrap().contains("names no point"));
        assert_eq!(bench.queued(), 0);
    }

    #[tokio::test]
    async fn a_repetition_is_answered_from_memory() {
        let mut bench = Bench::new();
        let first = set("p1/set", r#"{"id": 1, "run": true}"#);
        assert_eq!(bench.take(first.clone()), None);
        let repeated = Incoming {
            dup: true,
            ..first.clone()
        };
        assert_eq!(
            bench.take(repeated.clone()),
            None,
            "still running: its result comes once"
        );
        let result = bench.acknowledge().await;
        assert_eq!(json(&bench.take(repeated.clone()).unwrap()), result);
        assert!(bench.commands.is_idle() && bench.queued() == 0);
        // Published again by a client that did not see the acknowledgement: the same id, not marked by the broker.
        let again = Incoming {
            packet: 2,
            ..first.clone()
        };
        assert_eq!(json(&bench.take(again.clone()).unwrap()), result);
        // Another order under the same id, and the same one a minute later, are new commands.
        assert_eq!(
            bench.take(set("p1/set", r#"{"id": 1, "run": true, "reverse": true}"#)),
            None
        );
        bench.acknowledge().await;
        assert_eq!(
            bench.take(again.clone()),
            None,
            "the id was used for something else since"
        );
        bench.acknowledge().await;
        assert!(bench.take(again.clone()).is_some());
        bench.now += REPLAYED;
        assert_eq!(bench.take(again), None);
        bench.acknowledge().await;
        // Without an id only the broker's mark tells a repetition.
        let bare = set("p1/set", r#"{"speed_reference": 5}"#);
        for _ in 0..2 {
            assert_eq!(bench.take(bare.clone()), None);
            bench.acknowledge().await;
        }
        assert!(bench.take(Incoming { dup: true, ..bare }).is_some());
    }

    #[tokio::test]
    async fn a_stop_is_carried_out_whenever_it_comes() {
        let mut bench = Bench::new();
        let stop = set("p1/set", r#"{"id": 2, "run": false}"#);
        for _ in 0..2 {
            assert_eq!(bench.take(stop.clone()), None);
            bench.acknowledge().await;
        }
        for _ in 0..MAX_RUNNING {
            assert_eq!(bench.take(set("p1/set/run", "1")), None);
        }
        assert!(bench.take(set("p1/set/run", "1")).is_some(), "full");
        assert_eq!(bench.take(stop), None, "a stop still gets in");
    }

    #[tokio::test]
    async fn too_many_commands_at_one_time_are_refused() {
        let mut bench = Bench::new();
        for _ in 0..MAX_RUNNING {
            assert_eq!(bench.take(set("p1/set/run", "1")), None);
        }
        let result = json(&bench.take(set("p1/set/run", "1")).unwrap());
        assert_eq!(result["error"]["code"], "queue_full");
    }
}
