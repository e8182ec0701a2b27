//! The routes of the HTTP server.

use std::sync::Arc;
use std::time::Instant;

use axum::Router;
use axum::extract::{Extension, Request, State};
use axum::http::header::{self, HeaderMap, HeaderName, HeaderValue};
use axum::http::{Method, StatusCode, Uri};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use tokio_util::sync::CancellationToken;

use super::access::AccessError;
use super::app_state::AppState;
use super::messages::{
    DrillWish, Health, HoldAct, ParameterReading, PointValue, ReadParameters, Recorded, ReloadOutcome, Restore,
    RestoreAct, StoredReading, Why,
};
use super::openapi::{Api, Doc};
use super::operating::{self, Operating};
use super::params::Parameters;
use super::reached::{Client, Coverage, Reached};
use super::{api, documents, event_log, expect, line, mqtt, page, points, recordings, replies, streams, trend, views};
use drivegate_core::drill::DrillReport;
use drivegate_core::history::{Entry, RecordingObject};
use drivegate_core::order::AuditRecord;
use drivegate_core::plant::SharedPlant;
use drivegate_core::stop_all::StopReport;
use drivegate_north::NorthState;
use drivegate_north::command_json::{CommandResult, HoldReply, StopBody};

/// The route exists only at the socket.
const RELOAD: &str = "/api/v1/reload";

/// All routes of the HTTP server.
pub(super) fn router(
    plant: SharedPlant,
    north: Arc<NorthState>,
    operating: Arc<Operating>,
    cancel: CancellationToken,
) -> Router {
    let app = Arc::new(AppState::new(plant, north, operating, cancel));
    described()
        .finished()
        .fallback(views::unknown)
        .with_state(app.clone())
        .layer(middleware::from_fn_with_state(app, guard))
}

/// The routes of the API, with their description.
fn described() -> Api {
    const TEXT: &str = "text/plain";
    const EVENTS: &str = "text/event-stream";
    const POINT: &str = "names, separated by commas";
    const TIME: &str = "RFC 3339, seconds since 1970, or an age such as 10min";
    Api::new()
        .get("/", Doc::text("Status page", "text/html"), views::status_page)
        .get(
            "/assets/{name}",
            Doc::text("A file of the status page", "application/octet-stream"),
            views::asset,
        )
        .get(
            "/docs/",
            Doc::text("List of the documentation", "text/html"),
            documents::list,
        )
        .get("/docs/{name}", Doc::text("A document", TEXT), documents::one)
        .get("/metrics", Doc::text("Metrics for Prometheus", TEXT), views::exposition)
        .get(
            "/healthz",
            Doc::text("Whether the process is healthy", TEXT),
            || async { "ok\n" },
        )
        .get(
            "/readyz",
            Doc::text("Whether the gateway is ready, else 503", TEXT),
            views::ready,
        )
        .get(
            "/api/v1/health",
            Doc::object::<Health>("Whether the gateway is ready, and why not"),
            views::health,
        )
        .post(
            RELOAD,
            Doc::object::<ReloadOutcome>("Reads the configuration again; at the local socket only")
                .failing_with::<ReloadOutcome>(),
            views::reload,
        )
        .get(
            "/api/v1/drives",
            Doc::list::<api::Drive<'_>>("All drives").query(&[("points", POINT)]),
            views::drives,
        )
        .get(
            "/api/v1/drives/{name}",
            Doc::object::<api::Drive<'_>>("A drive"),
            views::drive,
        )
        .get(
            "/api/v1/drives/{name}/points",
            Doc::list::<PointValue>("Points of a drive").query(&[("names", POINT)]),
            points::points,
        )
        .get(
            "/api/v1/drives/{name}/why",
            Doc::object::<Why>("Why a drive does not run"),
            views::why,
        )
        .get(
            "/api/v1/drives/{name}/trend",
            Doc::object::<trend::DriveTrends<'_>>(
                "Trend of values, a list for several; without `point`, which ones are kept",
            )
            .or::<trend::Shown<'_>>()
            .or_list::<trend::Shown<'_>>()
            .query(&[
                ("point", POINT),
                ("from", TIME),
                ("to", TIME),
                ("format", "json or csv"),
            ]),
            trend::trend,
        )
        .post(
            "/api/v1/drives/{name}/recordings",
            Doc::object::<Recorded>("Records a drive"),
            operating::record,
        )
        .get(
            "/api/v1/drives/{name}/params",
            Doc::object::<Parameters<'_>>("The last reading of the parameters, and what is in progress").query(&[(
                "format",
                "json, or file: the last reading as `drivegate params` writes it",
            )]),
            views::params,
        )
        .get(
            "/api/v1/drives/{name}/params/reading",
            Doc::object::<ParameterReading>("Progress of the reading of parameters"),
            operating::parameters::progress,
        )
        .post(
            "/api/v1/drives/{name}/params/reading",
            Doc::object::<ParameterReading>("Starts reading parameters").body::<ReadParameters>(),
            operating::parameters::read,
        )
        .get(
            "/api/v1/drives/{name}/params/restore",
            Doc::object::<Restore>("Progress of the restore of parameters"),
            operating::parameters::restore_progress,
        )
        .post(
            "/api/v1/drives/{name}/params/restore",
            Doc::object::<Restore>("Prepares a restore of parameters, or continues it").body::<RestoreAct>(),
            operating::parameters::restore,
        )
        .get(
            "/api/v1/drives/{name}/commands",
            Doc::object::<operating::Commandable<'_>>("The points that can be commanded"),
            operating::commands_of,
        )
        .post(
            "/api/v1/drives/{name}/commands",
            Doc::object::<CommandResult<'_>>("Commands a drive: points and their values, `id`, `expires_ms`, `wait`")
                .any_body()
                .failing_with::<CommandResult<'_>>(),
            operating::command,
        )
        .post(
            "/api/v1/drives/{name}/heartbeat",
            Doc::text("Renews the lease of a drive; 204", TEXT),
            operating::heartbeat,
        )
        .get(
            "/api/v1/drives/{name}/hold",
            Doc::object::<HoldReply<'_>>("Who holds a drive"),
            operating::hold_of,
        )
        .post(
            "/api/v1/drives/{name}/hold",
            Doc::object::<HoldReply<'_>>("Takes, renews, releases or breaks the hold").body::<HoldAct>(),
            operating::hold,
        )
        .get("/api/v1/buses", Doc::list::<api::Bus<'_>>("All buses"), views::buses)
        .get(
            "/api/v1/buses/{name}",
            Doc::object::<line::Line<'_>>("A bus, with the last hour of its line"),
            line::bus,
        )
        .get(
            "/api/v1/buses/{name}/diagnosis",
            Doc::object::<api::Diagnosis<'_>>("The diagnosis of the line of a bus"),
            views::diagnosis,
        )
        .get(
            "/api/v1/mqtt",
            Doc::object::<mqtt::Clients>("The links to the brokers, and what waits for them"),
            mqtt::clients,
        )
        .get(
            "/api/v1/audit",
            Doc::list::<AuditRecord>("The last commands").query(&[("drive", "only those for this drive")]),
            views::audit,
        )
        .get(
            "/api/v1/params",
            Doc::list::<StoredReading>("Stored readings of parameters").query(&[("drive", "only those of this drive")]),
            views::all_params,
        )
        .get("/api/v1/recordings", Doc::list::<Entry>("Recordings"), recordings::list)
        .get(
            "/api/v1/recordings/{id}",
            Doc::object::<RecordingObject<'_>>("A recording")
                .query(&[("format", "json, csv, pcap, or dgrec: as the gateway keeps it")]),
            recordings::one,
        )
        .get(
            "/api/v1/events",
            Doc::object::<streams::RecentEvents<'_>>("Events; as a stream unless only JSON is accepted"),
            streams::events,
        )
        .get(
            "/api/v1/events/log",
            Doc::list::<event_log::Shown<'_>>("Events, including earlier runs, newest first").query(&[
                ("kind", POINT),
                ("drive", "only of this drive"),
                ("bus", "only of this bus"),
                ("text", "only those that contain this"),
                ("before", "time, or number of an event"),
                ("limit", "1 to 1000"),
            ]),
            event_log::log,
        )
        .get(
            "/api/v1/trace",
            Doc::text("The frames on a bus", EVENTS).query(&[("bus", "only of this bus")]),
            streams::trace,
        )
        .post(
            "/api/v1/login",
            Doc::object::<operating::SessionReply<'_>>("Starts a session").body::<operating::Credentials>(),
            operating::log_in,
        )
        .post(
            "/api/v1/logout",
            Doc::text("Ends the session; 204", TEXT),
            operating::log_out,
        )
        .get(
            "/api/v1/session",
            Doc::object::<operating::SessionReply<'_>>("The session"),
            operating::session,
        )
        .post(
            "/api/v1/stop",
            Doc::object::<StopReport>("Stops all drives; 504 unless all are known to have stopped")
                .body::<StopBody>()
                .failing_with::<StopReport>(),
            operating::stop,
        )
        .get(
            "/api/v1/drills",
            Doc::list::<DrillReport>("Drills, the newest first"),
            operating::drills,
        )
        .post(
            "/api/v1/drills",
            Doc::object::<DrillReport>("Arms a drill; 201").body::<DrillWish>(),
            operating::arm_drill,
        )
        .get(
            "/api/v1/drills/{id}",
            Doc::object::<DrillReport>("A drill"),
            operating::drill,
        )
        .delete(
            "/api/v1/drills/{id}",
            Doc::object::<DrillReport>("Ends a drill, which stops the motor"),
            operating::end_drill,
        )
        .post(
            "/api/v1/drills/{id}/start",
            Doc::object::<DrillReport>("Starts an armed drill within 60 s; only for the client that armed it"),
            operating::start_drill,
        )
}

/// Refuses requests that are meant for another host or lack a token, and all methods that could change something, commands
/// apart; sets the common headers of all replies.
async fn guard(
    State(app): State<Arc<AppState>>,
    Extension(reached): Extension<Reached>,
    request: Request,
    next: Next,
) -> Response {
    let coverage = request.extensions().get::<Client>().map(|client| client.coverage);
    let (method, path) = (request.method(), request.uri().path());
    let is_local = reached.local.is_some();
    // The local socket needs no login.
    let is_on = app.operating.is_on() || (is_local && !operating::is_session(path));
    // A command from an address of a user is also served on the reserved connections.
    let is_urgent = ["/healthz", "/readyz"].contains(&path) || (is_on && operating::is_command(method, path));
    let access = if is_local {
        Ok(())
    } else {
        reached.access.check(request.uri(), request.headers(), reached.address)
    };
    let refusal = match access {
        Ok(()) => None,
        Err(error) => refused(&app, &reached, error, request.uri().clone(), request.headers().clone()).await,
    };
    let mut response = if let Some(refusal) = refusal {
        refusal
    } else if coverage == Some(Coverage::Health) && !is_urgent {
        let why = "too many connections are open; close some and try again";
        let refusal = replies::refused(StatusCode::SERVICE_UNAVAILABLE, why);
        ([(header::RETRY_AFTER, "5")], refusal).into_response()
    } else if let Err((status, why)) = expect::check(request.headers(), &app.plant.load(), &reached) {
        replies::refused(status, why).into_response()
    } else if (is_on && operating::may_change(method, path)) || (is_local && path == RELOAD) {
        next.run(request).await
    } else if !matches!(*method, Method::GET | Method::HEAD) {
        let text = if is_on {
            "this is read-only: use GET or HEAD"
        } else {
            "this interface is read-only: use GET or HEAD"
        };
        let allow = [(header::ALLOW, HeaderValue::from_static("GET, HEAD"))];
        (allow, replies::refused(StatusCode::METHOD_NOT_ALLOWED, text)).into_response()
    } else if !is_on && operating::is_operating(path) {
        views::unknown(request.uri().clone()).await
    } else {
        next.run(request).await
    };
    const SET: [(HeaderName, &str); 3] = [
        (header::CACHE_CONTROL, "no-store"),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
    ];
    for (name, value) in SET {
        response.headers_mut().insert(name, HeaderValue::from_static(value));
    }
    response
}

/// The reply to a request that is refused because of its host or its token; `None` if the request is to be answered.
async fn refused(
    app: &AppState,
    reached: &Reached,
    refusal: AccessError,
    uri: Uri,
    headers: HeaderMap,
) -> Option<Response> {
    let path = uri.path();
    if refusal.is_for_want_of_a_token() && app.operating.is_on() && path != "/metrics" {
        // Users read as bearers of tokens do, and have to get as far as the login.
        if operating::is_operating(path) || path.starts_with("/assets/") {
            return None;
        }
        let cookies = app.cookies(reached);
        if app.operating.operator(&headers, &cookies, reached).await.is_ok() {
            return None;
        }
        if path == "/" {
            return Some(views::document(page::render_login(&app.plant.load())));
        }
    }
    if let Some(suppressed) = reached.refusals.permit(Instant::now()) {
        let peer = reached.peer;
        tracing::warn!(target: "drivegate::http", %peer, suppressed, "HTTP: request refused: {refusal}");
    }
    Some(refusal.into_response())
}
