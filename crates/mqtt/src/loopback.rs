//! The set topics without a broker and a runtime, for tests and virtual time.

use std::time::{Duration, Instant, SystemTime};

use super::commands::{Commands, Rules};
use super::outbox::Message;
use super::reply::ResponseTopics;
use super::request::Incoming;
use super::topics::Topics;
use drivegate_core::order::{Arrival, Connection, Right};
use drivegate_core::plant::SharedPlant;
use drivegate_north::command_json::SharedMemory;

/// A message that the gateway publishes: the result of a command.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Published {
    /// The result topic of the drive, or the response topic of the command.
    pub topic: String,
    /// JSON.
    pub payload: Vec<u8>,
    /// Correlation data of the command.
    pub correlation: Option<Vec<u8>>,
}

impl From<Message> for Published {
    fn from(message: Message) -> Published {
        Published {
            topic: message.topic.to_string(),
            payload: message.payload,
            correlation: message.correlation,
        }
    }
}

/// The command processing of an MQTT client without a connection. Time is an argument; the calendar advances with
/// it from [`Offline::new`] on.
#[derive(Debug)]
pub struct Loopback {
    plant: SharedPlant,
    commands: Commands,
    results: Vec<Published>,
    begun: (Instant, SystemTime),
    /// The connection over which messages arrive.
    connection: Connection,
}

impl Loopback {
    /// A client that serves the set topics below `base`, at `now`, which is `time` on the calendar.
    pub fn new(base: &str, plant: SharedPlant, now: Instant, time: SystemTime) -> Loopback {
        let gateway = plant.load().gateway.clone();
        let rules = Rules {
            responses: ResponseTopics::new(base, &gateway, Vec::new()),
            require_id: false,
            right: Right::lasting(),
        };
        Loopback {
            plant,
            commands: Commands::new(
                Topics::new(base, &gateway),
                rules,
                SharedMemory::default(),
                Default::default(),
                None,
            ),
            results: Vec::new(),
            begun: (now, time),
            connection: Connection::opened(now),
        }
    }

    /// Receives a message. Its command is in the queue of its bus when this returns.
    pub fn receive(&mut self, mut message: Incoming, now: Instant) {
        let connection = self.connection.clone();
        message.arrival.get_or_insert_with(|| Arrival::over(connection, now));
        let (plant, time) = (self.plant.load(), self.time(now));
        let result = self.commands.take(message, &plant, |_| false, now, time);
        self.results.extend(result.map(Published::from));
    }

    /// The results since the last call, in order.
    pub fn poll(&mut self, now: Instant) -> Vec<Published> {
        let time = self.time(now);
        while let Some(ended) = self.commands.try_finished() {
            let result = self.commands.answer(ended, time);
            self.results.push(result.into());
        }
        std::mem::take(&mut self.results)
    }

    /// Whether any command waits for its answer or for its confirmation.
    pub fn is_waiting(&self) -> bool {
        !self.commands.is_idle()
    }

    fn time(&self, now: Instant) -> SystemTime {
        let (begun, time) = self.begun;
        let passed: Duration = now.saturating_duration_since(begun);
        time + passed
    }
}

#[cfg(test)]
mod tests {
    use drivegate_testkit::next_command;
    use std::sync::Arc;

    use arc_swap::ArcSwap;

    use super::super::fixture;
    use super::*;
    use drivegate_core::order::{Order, Outcome, Urgency};
    use drivegate_model::drive::Value;
    use drivegate_proto::Reply;

    #[test]
    fn forty_pairs_in_virtual_time() {
        let start = Instant::now();
        let plant: SharedPlant = Arc::new(ArcSwap::from_pointee(fixture::plant(&["p1"])));
        let mut client = Loopback::new("drivegate", plant.clone(), start, SystemTime::UNIX_EPOCH);
        let run = plant
            .load()
            .drive("p1")
            .unwrap()
            .image
            .spec
            .profile
            .point_index("run")
            .unwrap();
        for pair in 0..40u16 {
            let now = start + Duration::from_secs(3600) * pair.into();
            fixture::read(&plant.load(), "p1", 1, 0, now);
            for (packet, value) in [(2 * pair, "true"), (2 * pair + 1, "false")] {
                let message = Incoming {
                    topic: "drivegate/hall/drive/p1/set/run".to_string(),
                    payload: value.into(),
                    packet,
                    correlation: Some(packet.to_be_bytes().to_vec()),
                    response_topic: Some("answers".to_string()),
                    ..Incoming::default()
                };
                client.receive(message, now);
            }
            let bus = &plant.load().buses[0];
            let last = next_command(&mut bus.queue.lock(), Urgency::Read, now).unwrap();
            assert_eq!(last.intent.order, Order::Points(vec![(run, Value::Bool(false))]));
            assert!(bus.queue.lock().is_empty(), "the run was removed");
            let taken = now + Duration::from_millis(12);
            let receipt = last.ticket.acknowledge(Outcome::Acknowledged(Reply::Written), taken);
            let results = client.poll(taken);
            assert_eq!(results.len(), 1, "the run; the stop waits for its confirmation");
            assert!(client.is_waiting());
            receipt.confirm(taken);
            let seen = [results, client.poll(taken)].concat().into_iter().map(|published| {
                assert_eq!(published.topic, "answers");
                let json: serde_json::Value = serde_json::from_slice(&published.payload).unwrap();
                (published.correlation.unwrap()[1], json)
            });
            let seen: Vec<_> = seen.collect();
            assert_eq!((seen[0].0, &seen[0].1["result"]), (2 * pair as u8, &"purged".into()));
            assert_eq!(
                (seen[1].0, &seen[1].1["result"]),
                (2 * pair as u8 + 1, &"confirmed".into())
            );
            assert_eq!(seen[1].1["latency_ms"], 12.0);
            let time = seen[1].1["time"].as_str().unwrap();
            let (day, hour) = (pair / 24 + 1, pair % 24);
            assert_eq!(time, format!("1970-01-{day:02}T{hour:02}:00:00.012Z"));
            assert!(!client.is_waiting());
        }
    }
}
