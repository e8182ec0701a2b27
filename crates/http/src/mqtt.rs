//! `GET /api/v1/mqtt`: the links to the brokers, and the messages that wait for them.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::SystemTime;

use axum::Json;
use axum::extract::State;
use axum::response::{IntoResponse, Response};
use serde::Serialize;

use super::app_state::AppState;
use drivegate_north::{LinkState, LinkStatus, MqttStats};

/// The MQTT clients of the gateway.
#[derive(Debug, Serialize, utoipa::ToSchema)]
#[schema(as = Mqtt)]
pub(super) struct Clients {
    /// The links of the clients that run; none without `[mqtt]`.
    links: Vec<Link>,
    /// Messages that wait for the broker.
    waiting: u64,
    /// Messages that brokers took.
    published: u64,
    /// Messages that were given up.
    lost: u64,
}

/// The link of a client to its broker.
#[derive(Debug, Serialize, utoipa::ToSchema)]
#[schema(as = MqttLink)]
struct Link {
    /// `mqtt` or `sparkplug`.
    client: &'static str,
    /// Host and port of the broker that is connected or tried.
    broker: String,
    connected: bool,
    /// Time from which on it is connected, or is not.
    #[serde(serialize_with = "drivegate_core::event::rfc3339")]
    #[schema(value_type = String)]
    since: SystemTime,
    /// Why the last connection ended or did not come about; also while another one is open.
    error: Option<LinkError>,
}

#[derive(Debug, Serialize, utoipa::ToSchema)]
#[schema(as = MqttLinkError)]
struct LinkError {
    #[serde(serialize_with = "drivegate_core::event::rfc3339")]
    #[schema(value_type = String)]
    time: SystemTime,
    text: String,
}

impl Link {
    fn new(client: &'static str, state: LinkState) -> Link {
        let error = state.error.map(|(time, text)| LinkError { time, text });
        Link {
            client,
            broker: state.broker,
            connected: state.connected,
            since: state.since,
            error,
        }
    }
}

impl Clients {
    fn new(stats: &MqttStats) -> Clients {
        let links = [("mqtt", &stats.plain), ("sparkplug", &stats.sparkplug)];
        let shown = |(client, status): (_, &Arc<LinkStatus>)| Some(Link::new(client, status.get()?));
        Clients {
            links: links.into_iter().filter_map(shown).collect(),
            waiting: stats.buffered.load(Ordering::Relaxed),
            published: stats.published.load(Ordering::Relaxed),
            lost: stats.losses().map(|(_, count)| count).sum(),
        }
    }
}

pub(super) async fn clients(State(app): State<Arc<AppState>>) -> Response {
    Json(Clients::new(&app.north.mqtt)).into_response()
}
