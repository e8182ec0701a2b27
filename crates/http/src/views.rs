//! Handlers of the routes that have no separate file.

use std::fmt::Write as _;
use std::sync::Arc;
use std::time::{Instant, SystemTime};

use axum::Json;
use axum::extract::{Extension, Path, RawQuery, Request, State};
use axum::http::header::{self, HeaderMap};
use axum::http::{Method, StatusCode, Uri};
use axum::response::{Html, IntoResponse, Response};

use super::app_state::AppState;
use super::messages::{Health, StoredReading, Why};
use super::params::Parameters;
use super::query::QueryError;
use super::reached::Reached;
use super::replies::{Replied, find_bus, no_drive, not_found, refused};
use super::{api, page, query};
use crate::local::control;
use drivegate_core::parameters::{ParameterFile, Store, StoredFile};
use drivegate_north::{metrics, readiness};

pub(super) async fn status_page(State(app): State<Arc<AppState>>) -> impl IntoResponse {
    let _turn = app.turn().await;
    document(page::render(&app.plant.load(), app.operating.is_on(), Instant::now()))
}

pub(super) fn document(html: String) -> Response {
    let policy = [(header::CONTENT_SECURITY_POLICY, page::SECURITY_POLICY)];
    (policy, Html(html)).into_response()
}

pub(super) async fn asset(Path(name): Path<String>, uri: Uri) -> Response {
    match page::ASSETS.iter().find(|asset| asset.name == name) {
        Some(asset) => ([(header::CONTENT_TYPE, asset.content_type)], asset.body).into_response(),
        None => unknown(uri).await,
    }
}

pub(super) async fn exposition(State(app): State<Arc<AppState>>, headers: HeaderMap) -> Response {
    let _turn = app.turn().await;
    let accept: Vec<&str> = headers
        .get_all(header::ACCEPT)
        .iter()
        .filter_map(|value| value.to_str().ok())
        .collect();
    let (format, content_type) = metrics::Format::accepted(&accept.join(","));
    match metrics::encode(&app.plant.load(), &app.north, Instant::now(), format) {
        Ok(text) => {
            let headers = [(header::CONTENT_TYPE, content_type), (header::VARY, "accept")];
            (headers, text).into_response()
        }
        Err(error) => {
            tracing::error!(target: "drivegate::http", "cannot encode the metrics: {error}; please report this");
            StatusCode::INTERNAL_SERVER_ERROR.into_response()
        }
    }
}

pub(super) async fn ready(State(app): State<Arc<AppState>>) -> Response {
    let reasons = readiness::reasons(&app.plant.load(), &app.north);
    if reasons.is_empty() {
        return "ready\n".into_response();
    }
    let mut text = "not ready\n".to_string();
    for reason in reasons {
        // Writing to a string cannot fail.
        let _ = writeln!(text, "{reason}");
    }
    (StatusCode::SERVICE_UNAVAILABLE, text).into_response()
}

/// Whether the gateway is ready, and why not: 200 in both cases.
pub(super) async fn health(State(app): State<Arc<AppState>>) -> Response {
    let reasons = readiness::reasons(&app.plant.load(), &app.north);
    let ready = reasons.is_empty();
    Json(Health { ready, reasons }).into_response()
}

/// Reloads the configuration: 200 with the changes, or 422 with the errors and nothing changed.
pub(super) async fn reload(Extension(reached): Extension<Reached>, uri: Uri, request: Request) -> Response {
    let Some(local) = reached.local else {
        return unknown(uri).await;
    };
    if !matches!(*request.method(), Method::POST) {
        return StatusCode::METHOD_NOT_ALLOWED.into_response();
    }
    match control::reload(local.control.as_ref(), local.who.to_string()).await {
        Ok(outcome) if outcome.errors.is_empty() => Json(outcome).into_response(),
        Ok(outcome) => (StatusCode::UNPROCESSABLE_ENTITY, Json(outcome)).into_response(),
        Err(why) => refused(StatusCode::SERVICE_UNAVAILABLE, why).into_response(),
    }
}

/// All drives; with `points=`, only these points of each drive.
pub(super) async fn drives(State(app): State<Arc<AppState>>, RawQuery(query): RawQuery) -> Response {
    let shown = query::names(query.as_deref(), "points");
    let _turn = app.turn().await;
    let plant = app.plant.load();
    let clock = api::Clock::new(Instant::now(), SystemTime::now());
    let all: Vec<_> = plant.drives().collect();
    let all: Vec<_> = all
        .iter()
        .map(|drive| api::Drive::new(drive, &app.north.history, clock).only(shown.as_ref()))
        .collect();
    Json(all).into_response()
}

pub(super) async fn drive(State(app): State<Arc<AppState>>, Path(name): Path<String>) -> Replied {
    let plant = app.plant.load();
    let drive = plant.drive(&name).ok_or_else(|| no_drive(&plant, &name))?;
    let clock = api::Clock::new(Instant::now(), SystemTime::now());
    let stops = app.north.drills.stops(&drive, SystemTime::now());
    Ok(Json(api::Drive::new(&drive, &app.north.history, clock).proven(stops)).into_response())
}

/// Why a drive does not run.
pub(super) async fn why(State(app): State<Arc<AppState>>, Path(name): Path<String>) -> Replied<Json<Why>> {
    let drive = app.drive(&name)?;
    let profile = &drive.image.spec.profile;
    Ok(Json(Why {
        explanation: drive.why(&drive.reading(Instant::now())),
        profile: profile.name.clone(),
        profile_verified: profile.verified,
    }))
}

/// The last reading of a drive's parameters, and the one in progress.
pub(super) async fn params(
    State(app): State<Arc<AppState>>,
    Path(name): Path<String>,
    RawQuery(query): RawQuery,
) -> Replied {
    let as_file = params_as_file(query.as_deref())?;
    let plant = app.plant.load_full();
    let drive = plant.drive(&name).ok_or_else(|| no_drive(&plant, &name))?;
    let machine = drive.machine();
    let status = app.north.parameters.status(&machine);
    let last = match app.north.parameters.last(&machine) {
        Some(file) => Some(file),
        None => stored_params(&app, &name).await?.map(Arc::new),
    };
    if as_file {
        let none = || not_found(format!("no reading of `{name}` is stored"), Vec::new());
        return Ok(last.ok_or_else(none)?.text().into_response());
    }
    let restore = app.north.parameters.restore(&machine);
    let parameters = Parameters::new(&name, last.as_deref(), status.as_ref(), restore.as_ref());
    Ok(Json(parameters).into_response())
}

/// Whether a query requests the last reading as its file.
fn params_as_file(query: Option<&str>) -> Result<bool, QueryError> {
    let [format] = query::parameters(query, &["format"])?;
    match format.as_deref() {
        None | Some("json") => Ok(false),
        Some("file") => Ok(true),
        Some(other) => Err(QueryError::Value {
            name: "format",
            value: other.to_string(),
            expected: "it is `json` or `file`",
        }),
    }
}

/// The last parameter reading on disk.
async fn stored_params(app: &AppState, name: &str) -> Replied<Option<ParameterFile>> {
    let name = name.to_string();
    let latest = from_store(app, move |store| store.latest(&name)).await?;
    Ok(latest.flatten())
}

/// All readings on disk, drive by drive, the oldest first; with `drive` those of one drive.
pub(super) async fn all_params(State(app): State<Arc<AppState>>, RawQuery(query): RawQuery) -> Replied {
    let [drive] = query::parameters(query.as_deref(), &["drive"])?;
    let readings = from_store(&app, move |store| {
        let all = store
            .list()
            .map_err(|error| format!("cannot read the readings: {error}"))?;
        let wanted = all
            .iter()
            .filter(|kept| drive.as_ref().is_none_or(|drive| kept.drive == *drive));
        // A client elsewhere cannot open the path.
        let file = |kept: &StoredFile| kept.path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        Ok(wanted
            .map(|kept| StoredReading::of(kept, file(kept)))
            .collect::<Vec<_>>())
    });
    Ok(Json(readings.await?.unwrap_or_default()).into_response())
}

/// Reads from the store with `read` on a blocking thread, so that other clients do not wait; `None` if readings are
/// not stored.
async fn from_store<T: Send + 'static>(
    app: &AppState,
    read: impl FnOnce(Store) -> Result<T, String> + Send + 'static,
) -> Replied<Option<T>> {
    let Some(store) = app.north.parameters.store() else {
        return Ok(None);
    };
    let found = app.read_files(move || read(store)).await?;
    found
        .map(Some)
        .map_err(|why| refused(StatusCode::INTERNAL_SERVER_ERROR, why))
}

pub(super) async fn buses(State(app): State<Arc<AppState>>) -> Response {
    let plant = app.plant.load();
    let all: Vec<_> = plant.buses.iter().map(api::Bus::new).collect();
    Json(all).into_response()
}

/// The diagnosis of the line of a bus.
pub(super) async fn diagnosis(State(app): State<Arc<AppState>>, Path(name): Path<String>) -> Replied {
    let plant = app.plant.load();
    let diagnosis = find_bus(&plant, &name)?.image.diagnosis.load();
    Ok(Json(api::Diagnosis::new(&name, &diagnosis)).into_response())
}

/// The last commands, the newest last; with `drive`, only the commands to one drive.
pub(super) async fn audit(State(app): State<Arc<AppState>>, RawQuery(query): RawQuery) -> Replied {
    let [drive] = query::parameters(query.as_deref(), &["drive"])?;
    let plant = app.plant.load();
    if let Some(drive) = drive.as_ref().filter(|drive| plant.drive(drive).is_none()) {
        return Err(no_drive(&plant, drive));
    }
    let _turn = app.turn().await;
    let records = plant.command_log.audit().recent(drive.as_deref());
    let list = format!("[{}]", records.join(","));
    Ok(([(header::CONTENT_TYPE, "application/json")], list).into_response())
}

pub(super) async fn unknown(uri: Uri) -> Response {
    if uri.path().starts_with("/api/") {
        return not_found(format!("there is nothing at {}", uri.path()), Vec::new()).into_response();
    }
    let text = "there is nothing here; the status page is at /\n";
    (StatusCode::NOT_FOUND, text).into_response()
}
