//! Destination and content of the results of commands.

use std::time::SystemTime;

use super::outbox::Message;
use super::request::Incoming;
use drivegate_core::order::Answer;
use drivegate_core::plant::Shown;
use drivegate_north::command_json::{CommandResult, Id};

/// Maximum number of levels of a response topic.
const LEVELS: usize = 128;

/// The response topics that results may be published to.
#[derive(Debug, Clone)]
pub(super) struct ResponseTopics {
    /// The gateway's own topics, `{base}/{gateway}`.
    own: String,
    /// Topic below which other gateways have their topics.
    base: String,
    /// Filters of topics below `base` that are nevertheless allowed.
    allowed: Vec<String>,
}

impl ResponseTopics {
    pub(super) fn new(base: &str, gateway: &str, allowed: Vec<String>) -> ResponseTopics {
        ResponseTopics {
            own: format!("{base}/{gateway}"),
            base: base.to_string(),
            allowed,
        }
    }

    fn allow(&self, topic: &str) -> bool {
        let sound = !topic.is_empty()
            && u16::try_from(topic.len()).is_ok()
            && !topic.starts_with('$')
            && !topic.contains(['+', '#', '\0'])
            && topic.split('/').count() <= LEVELS;
        let matches = || self.allowed.iter().any(|filter| matches(filter, topic));
        sound && !is_below(topic, &self.own) && (!is_below(topic, &self.base) || matches())
    }
}

/// Whether `topic` equals `parent` or is below it.
fn is_below(topic: &str, parent: &str) -> bool {
    let rest = topic.strip_prefix(parent);
    rest.is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
}

fn matches(filter: &str, topic: &str) -> bool {
    let mut levels = topic.split('/');
    for wanted in filter.split('/') {
        match (wanted, levels.next()) {
            ("#", _) => return true,
            ("+", Some(_)) => {}
            (wanted, Some(level)) if wanted == level => {}
            _ => return false,
        }
    }
    levels.next().is_none()
}

/// The destination of a result.
#[derive(Debug)]
pub(super) struct Reply {
    topic: String,
    correlation: Option<Vec<u8>>,
    drive: String,
}

impl Reply {
    /// The topic for the result: the response topic of the request or, without one, the result topic of the drive.
    pub(super) fn to(incoming: &Incoming, result: String, drive: &str, allowed: &ResponseTopics) -> Reply {
        let asked = incoming.response_topic.clone().filter(|topic| allowed.allow(topic));
        Reply {
            correlation: incoming.correlation.clone().filter(|_| asked.is_some()),
            topic: asked.unwrap_or(result),
            drive: drive.to_string(),
        }
    }

    pub(super) fn topic(&self) -> &str {
        &self.topic
    }

    /// The message with this result.
    pub(super) fn with(&self, payload: Vec<u8>) -> Message {
        Message {
            correlation: self.correlation.clone(),
            ..Message::not_retained(self.topic.as_str(), payload)
        }
    }

    /// Number of bytes whose length the client controls.
    pub(super) fn bytes(&self) -> usize {
        self.topic.len() + self.correlation.as_ref().map_or(0, Vec::len)
    }

    /// The only result: `confirmed` if a read showed the effect in time, otherwise the answer of the bus.
    pub(super) fn message(&self, id: Option<Id>, answer: &Answer, shown: Shown, time: SystemTime) -> Message {
        self.with(CommandResult::new(id.as_ref(), &self.drive, answer, shown, time).to_json())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn response_topics_stay_away_from_those_of_gateways() {
        let topics = ResponseTopics::new("plant/a", "hall", vec!["plant/a/answers/+".to_string()]);
        for good in ["answers", "plant/b", "plant/ab/hall", "/x", "plant/a/answers/7", "a/$b"] {
            assert!(topics.allow(good), "{good}");
        }
        let deep = vec!["a"; LEVELS + 1].join("/");
        let long = "a".repeat(70_000);
        for bad in [
            "",
            "a/+",
            "#",
            "a\0b",
            "$SYS/x",
            "$share/g/t",
            "plant/a",
            "plant/a/hall",
            "plant/a/hall/drive/p1/set",
            "plant/a/other/drive/p1/set",
            "plant/a/answers",
            "plant/a/answers/7/8",
            &deep,
            &long,
        ] {
            assert!(!topics.allow(bad), "{bad}");
        }
        let everything = ResponseTopics::new("plant/a", "hall", vec!["#".to_string()]);
        assert!(everything.allow("plant/a/other/x") && !everything.allow("plant/a/hall/x"));
    }

    #[test]
    fn filters_match_as_in_mqtt() {
        for (filter, topic, expected) in [
            ("a/#", "a", true),
            ("a/#", "a/b/c", true),
            ("a/+/c", "a/b/c", true),
            ("a/+", "a", false),
            ("a/+", "a/b/c", false),
            ("a", "b", false),
        ] {
            assert_eq!(matches(filter, topic), expected, "{filter} {topic}");
        }
    }
}
