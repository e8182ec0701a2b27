//! Building blocks of the tables of all sections: types of values, kinds of forms, and the forms that several keys share.

pub(super) use std::net::SocketAddr;
pub(super) use std::path::PathBuf;
pub(super) use std::time::Duration;

pub(super) use ipnet::IpNet;
pub(super) use serde_json::{Value, json};

pub(super) use crate::config::key::*;
pub(super) use crate::config::values;
pub(super) use drivegate_model::document::Finding;
use drivegate_model::document::parse_duration;

pub(super) const HOUR: Duration = Duration::from_secs(3600);
/// Range of cadences and timeouts.
pub(super) const TIMES: Time = Time(Duration::from_millis(1)..=HOUR);
/// Sizes of buffers and files.
pub(super) const BUFFER_SIZE: Size = Size(64 << 10..=1 << 40);
pub(super) const SOCKET: Parsed<SocketAddr> = Parsed {
    parse: values::socket::<4001>,
    words: &[],
    pattern: "",
    range: "an address with a port",
};
pub(super) const PATH: Text = Text("", "a path in quotes");
pub(super) const STRING: Text = Text("", "a string in quotes");
pub(super) const NETWORKS: List<IpNet> = List {
    parse: values::network,
    empty: None,
    range: "networks, such as [\"192.168.1.0/24\"]",
};
/// Range of `idle_timeout`.
const IDLE: Time = Time(Duration::from_secs(1)..=Duration::from_secs(7 * 86_400));
pub(super) const IDLE_TIMEOUT: Parsed<Option<Duration>> = Parsed {
    parse: parse_idle,
    words: &["off"],
    pattern: DURATION,
    range: "\"off\", or \"1s\" to \"168h\"",
};

/// How often orders are written again.
pub(super) const REPEATED: Parsed<Option<Duration>> = Parsed {
    parse: parse_refresh,
    words: &["off"],
    pattern: DURATION,
    range: "\"off\", or \"100ms\" to \"60s\"",
};

/// A duration, or `None` for the word `off`.
fn parse_refresh(text: &str) -> Result<Option<Duration>, Finding> {
    match text {
        "off" => Ok(None),
        text => Time(drivegate_model::drive::REFRESH)
            .check(parse_duration(text)?)
            .map(Some),
    }
}

/// A duration, or `None` for the word `off`.
fn parse_idle(text: &str) -> Result<Option<Duration>, Finding> {
    match text {
        "off" => Ok(None),
        text => IDLE.check(parse_duration(text)?).map(Some),
    }
}

/// A list of tables with this schema.
pub(super) fn each(item: Value) -> Value {
    json!({ "type": "array", "items": item })
}
