//! Destination and content of the results of commands.

use std::time::{Duration, SystemTime};

use serde::Serialize;
use serde_json::Value as Json;

use super::connection::is_topic;
use super::outbox::Message;
use super::payload;
use super::request::Incoming;
use crate::command::{Answer, CONFIRMED};

/// Destination of a result.
#[derive(Debug)]
pub(super) struct Reply {
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
    /// The response topic of the request, or the result topic of the drive if it has none.
    pub(super) fn to(incoming: &Incoming, result: String, drive: &str) -> Reply {
        let asked = incoming.response_topic.clone().filter(|topic| is_topic(topic));
        Reply {
            correlation: incoming.correlation.clone().filter(|_| asked.is_some()),
            topic: asked.unwrap_or(result),
            drive: drive.to_string(),
        }
    }

    /// Number of bytes whose length the client controls.
    pub(super) fn bytes(&self) -> usize {
        self.topic.len() + self.correlation.as_ref().map_or(0, Vec::len)
    }

    /// The one result: `confirmed` if a read showed the effect in time, else the answer of the bus.
    pub(super) fn message(
        &self,
        id: Option<Json>,
        answer: &Answer,
        confirmed: Option<Duration>,
        time: SystemTime,
    ) -> Message {
        let code = match confirmed {
            Some(_) => CONFIRMED,
            None => answer.outcome.code(),
        };
        let error = (!answer.outcome.is_ok()).then(|| answer.outcome.to_string());
        let object = ResultObject {
            id,
            drive: &self.drive,
            ok: error.is_none(),
            result: code,
            error: error.map(|message| ErrorObject { code, message }),
            latency_ms: payload::milliseconds(answer.latency),
            confirmed_ms: confirmed.map(payload::milliseconds),
            time: payload::rfc3339(time),
        };
        // Strings, numbers and previous JSON can always be serialized.
        let payload = serde_json::to_vec(&object).unwrap_or_default();
        Message {
            correlation: self.correlation.clone(),
            ..Message::not_retained(self.topic.as_str(), payload)
        }
    }
}
