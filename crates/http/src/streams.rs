//! Server-sent events: the events of the plant, and the frames on the buses.
//!
//! A stream ends when the gateway stops and when a reload removes its source; the client then reconnects. A client
//! that is too slow loses the oldest items and receives their number.

use std::convert::Infallible;
use std::fmt::Write as _;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use axum::Json;
use axum::extract::{Extension, RawQuery, State};
use axum::http::{HeaderMap, HeaderName, StatusCode, header};
use axum::response::sse::{Event as Message, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use futures_util::{Stream, StreamExt, stream};
use serde::Serialize;
use serde_json::value::RawValue;
use tokio::sync::broadcast;
use tokio_stream::wrappers::BroadcastStream;
use tokio_stream::wrappers::errors::BroadcastStreamRecvError as Lost;

use super::app_state::AppState;
use super::reached::Client;
use super::replies::{Replied, no_bus};
use super::{messages, query};
use drivegate_core::event::Event;
use drivegate_core::order::Authority;
use drivegate_core::process_image::{Direction, FrameRecord};
use drivegate_north::connection_limit::{ConnectionPermit, LimitReached, Newcomer, NoPlace};
use drivegate_proto::{Protocol, describe};

/// Time after which a browser reconnects.
const RETRY: Duration = Duration::from_secs(2);

/// Interval of comments on a stream without events: they detect dead connections and keep proxies from closing it.
const KEEP_ALIVE: Duration = Duration::from_secs(10);

const LAST_EVENT_ID: HeaderName = HeaderName::from_static("last-event-id");

/// `GET /api/v1/events`: the recent events that the client has not received yet, then each new one. A client that
/// accepts JSON only gets the recent events without a stream.
pub(super) async fn events(
    State(app): State<Arc<AppState>>,
    Extension(client): Extension<Client>,
    headers: HeaderMap,
) -> Response {
    let plant = app.plant.load();
    // Subscribed before the recent events are read: an event in between is in both and is sent once.
    let live = plant.events.subscribe();
    let mut kept = plant.events.recent_lines();
    let newest = kept.last().map_or(0, |(id, _)| *id);
    let seen = header_text(&headers, &LAST_EVENT_ID)
        .and_then(|id| last_seen(id, instance()))
        .filter(|seen| *seen <= newest)
        .unwrap_or(0);
    kept.retain(|(id, _)| *id > seen);
    let accept = header_text(&headers, &header::ACCEPT).unwrap_or_default();
    if accept.contains("application/json") && !accept.contains("text/event-stream") {
        let kept = RecentEvents {
            last: event_id(newest),
            events: kept
                .iter()
                .filter_map(|(_, line)| serde_json::from_str(line).ok())
                .collect(),
        };
        return ([(header::VARY, "accept")], Json(kept)).into_response();
    }
    let permit = match stream_permit(&app, client) {
        Ok(permit) => permit,
        Err(refused) => return full(&refused),
    };
    // Each message is created when the client takes it.
    let kept = stream::iter(kept).map(|(id, line)| Message::default().id(event_id(id)).data(line));
    let live = messages_of(live, move |event| (event.id > newest).then(|| event_message(&event)));
    respond(kept.chain(live), permit)
}

/// `GET /api/v1/trace?bus=`: the frames of one bus, or of all, from now on.
pub(super) async fn trace(
    State(app): State<Arc<AppState>>,
    Extension(client): Extension<Client>,
    RawQuery(query): RawQuery,
) -> Replied {
    let [wanted] = query::parameters(query.as_deref(), &["bus"])?;
    let plant = app.plant.load();
    let buses = plant.buses.iter().map(|bus| &bus.image);
    let streams: Vec<_> = buses
        .filter(|image| wanted.as_ref().is_none_or(|name| *name == image.spec.name))
        .map(|image| {
            let bus = image.spec.name.clone();
            let protocol = image.spec.protocol;
            messages_of(image.trace.subscribe(), move |frame| {
                Some(frame_message(&bus, protocol, &frame))
            })
            .boxed()
        })
        .collect();
    if let (Some(name), true) = (wanted, streams.is_empty()) {
        return Err(no_bus(&plant, &name));
    }
    let permit = stream_permit(&app, client).map_err(|why| full(&why))?;
    Ok(respond(stream::select_all(streams), permit))
}

/// A place for an event stream, or the reply that refuses one. The address with the most streams loses one to an
/// address that has fewer.
fn stream_permit(app: &AppState, client: Client) -> Result<ConnectionPermit, String> {
    let newcomer = Newcomer {
        address: client.address,
        listener: 0,
        cancel: &app.cancel,
    };
    let now = Instant::now();
    match app.listeners.acquire(newcomer, now, || Some(Authority::ReadOnly)) {
        Ok((permit, _)) => {
            permit.place().use_at(now, true);
            Ok(permit)
        }
        Err(NoPlace::Limit(LimitReached::Address(limit))) => {
            Err(format!("{limit} event streams of your address are open"))
        }
        Err(NoPlace::Limit(LimitReached::Total(limit))) => Err(format!("{limit} event streams are open")),
        Err(NoPlace::NotAllowed) => Err("event streams are not allowed".to_string()),
    }
}

fn full(why: &str) -> Response {
    let problem = messages::ErrorReply::new(format!("{why}; close one and try again"));
    let retry = [(header::RETRY_AFTER, "5")];
    (StatusCode::SERVICE_UNAVAILABLE, retry, Json(problem)).into_response()
}

/// Turns received items into messages; lost items are reported by a separate message.
fn messages_of<T: Clone + Send + 'static>(
    receiver: broadcast::Receiver<T>,
    message: impl Fn(T) -> Option<Message> + Send + 'static,
) -> impl Stream<Item = Message> + Send + 'static {
    BroadcastStream::new(receiver).filter_map(move |item| {
        std::future::ready(match item {
            Ok(item) => message(item),
            Err(Lost::Lagged(lost)) => Some(Message::default().event("lagged").data(format!("{{\"lost\":{lost}}}"))),
        })
    })
}

/// The reply; `permit` is released when the stream ends or the client disconnects.
fn respond(messages: impl Stream<Item = Message> + Send + 'static, permit: ConnectionPermit) -> Response {
    // A first message is sent at once, so that the client sees the stream open before the first event.
    let hello = Message::default().retry(RETRY).comment("open");
    let messages = stream::iter([hello])
        .chain(messages)
        .take_until(permit.place().closing().clone().cancelled_owned())
        .map(move |message| {
            let _held = &permit;
            Ok::<_, Infallible>(message)
        });
    let keep_alive = KeepAlive::new().interval(KEEP_ALIVE).text("alive");
    // Without this header, proxies such as nginx would buffer the reply until it ends.
    let unbuffered = [(HeaderName::from_static("x-accel-buffering"), "no")];
    (unbuffered, Sse::new(messages).keep_alive(keep_alive)).into_response()
}

/// Identifies this run of the program, since the numbers of events restart with each run.
fn instance() -> &'static str {
    static INSTANCE: OnceLock<String> = OnceLock::new();
    INSTANCE.get_or_init(|| {
        let start = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        format!("{:x}", start.as_millis())
    })
}

/// Number of the last event of this run that the client has received, if any.
fn last_seen(id: &str, instance: &str) -> Option<u64> {
    let number = match id.split_once('-') {
        Some((run, number)) if run == instance => number,
        Some(_) => return None,
        None => id,
    };
    number.trim().parse().ok()
}

fn event_id(number: u64) -> String {
    format!("{}-{number}", instance())
}

/// The recent events, for a client that polls.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct RecentEvents<'e> {
    /// The id for `Last-Event-ID` in the next request.
    last: String,
    #[schema(value_type = Vec<Event>)]
    events: Vec<&'e RawValue>,
}

fn event_message(event: &Event) -> Message {
    json(Message::default().id(event_id(event.id)), event)
}

fn header_text<'h>(headers: &'h HeaderMap, name: &HeaderName) -> Option<&'h str> {
    headers.get(name).and_then(|value| value.to_str().ok())
}

/// A frame in JSON.
#[derive(Debug, Serialize)]
struct Frame<'f> {
    bus: &'f str,
    time: String,
    gap_us: Option<u64>,
    direction: Direction,
    drive: Option<&'f str>,
    hex: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    text: Option<String>,
    decode: &'f str,
    verdict: &'f str,
}

fn frame_message(bus: &str, protocol: Protocol, record: &FrameRecord) -> Message {
    let frame = Frame {
        bus,
        time: humantime::format_rfc3339_micros(record.time).to_string(),
        gap_us: record.gap.map(|gap| u64::try_from(gap.as_micros()).unwrap_or(u64::MAX)),
        direction: record.direction,
        drive: record.drive.as_deref(),
        hex: hex(&record.bytes),
        text: protocol.is_text().then(|| describe::text(&record.bytes)),
        decode: &record.decode,
        verdict: &record.verdict,
    };
    json(Message::default(), &frame)
}

fn json(message: Message, data: &impl Serialize) -> Message {
    // Strings and numbers can always be serialized.
    message.data(serde_json::to_string(data).unwrap_or_else(|_| "{}".to_string()))
}

/// `01 03 08 34`.
fn hex(bytes: &[u8]) -> String {
    let mut text = String::with_capacity(bytes.len() * 3);
    for (place, byte) in bytes.iter().enumerate() {
        let gap = if place == 0 { "" } else { " " };
        // Writing to a string cannot fail.
        let _ = write!(text, "{gap}{byte:02X}");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn event_ids_of_other_runs_are_ignored() {
        assert_eq!(last_seen("a1-7", "a1"), Some(7));
        assert_eq!(last_seen("a2-7", "a1"), None);
        assert_eq!(last_seen("7", "a1"), Some(7));
        for invalid in ["", "-", "a1-", "a1-x", "x"] {
            assert_eq!(last_seen(invalid, "a1"), None, "{invalid}");
        }
    }

    #[test]
    fn bytes_as_in_the_manuals() {
        assert_eq!(hex(&[0x01, 0x03, 0xAB]), "01 03 AB");
        assert_eq!(hex(&[]), "");
    }
}
