//! `/api/v1/drills`: arming, starting and ending a drill, and what drills have proven.

use std::sync::Arc;
use std::time::{Instant, SystemTime};

use axum::Json;
use axum::extract::{Path, State};
use axum::http::StatusCode;
use axum::response::IntoResponse;

use super::super::app_state::AppState;
use super::super::messages::DrillWish;
use super::super::replies::{Refused, Replied, not_found, refused};
use super::asker::{Commander, Ordered};
use super::commands::RequestArrival;
use drivegate_core::drill::{DrillRefusal, DrillReport, Kind};

/// Handler: all known drills, newest first.
pub(crate) async fn drills(State(app): State<Arc<AppState>>) -> Json<Vec<DrillReport>> {
    Json(app.north.drills.reports())
}

/// Handler: the report of one drill.
pub(crate) async fn drill(State(app): State<Arc<AppState>>, Path(id): Path<String>) -> Replied<Json<DrillReport>> {
    let report = app.north.drills.report(&id);
    report.map(Json).ok_or_else(|| why_not(&DrillRefusal::Unknown(id)))
}

/// Arms a drill and answers with status 201.
pub(crate) async fn arm_drill(
    asked: RequestArrival,
    State(app): State<Arc<AppState>>,
    Ordered(operator, payload): Ordered,
) -> Replied {
    let wish: DrillWish = serde_json::from_slice(&payload).map_err(|error| {
        let form = "{\"drive\": …, \"kinds\": [\"order\", \"client\", \"gateway\"], \"speed\": …}";
        refused(StatusCode::UNPROCESSABLE_ENTITY, format!("the body is {form}: {error}"))
    })?;
    let drive = app.drive(&wish.drive)?;
    let meant = drive.is_meant(operator.origin().kind, &asked.complete());
    meant.map_err(|refusal| refused(StatusCode::CONFLICT, refusal.to_string()))?;
    let kinds = if wish.kinds.is_empty() {
        &Kind::ALL[..]
    } else {
        &wish.kinds
    };
    let (now, time) = (Instant::now(), SystemTime::now());
    let armed = app
        .north
        .drills
        .arm(&drive, (kinds, wish.speed), &operator.origin(), now, time);
    let report = armed.map_err(|refusal| why_not(&refusal))?;
    Ok((StatusCode::CREATED, Json(report)).into_response())
}

/// Handler: starts an armed drill.
pub(crate) async fn start_drill(
    State(app): State<Arc<AppState>>,
    Path(id): Path<String>,
    Commander(operator): Commander,
) -> Replied<Json<DrillReport>> {
    let plant = app.plant.load();
    let (now, time) = (Instant::now(), SystemTime::now());
    let started = app.north.drills.start(&plant, &id, &operator.origin(), now, time);
    started.map(Json).map_err(|refusal| why_not(&refusal))
}

/// Handler: ends a drill, which stops the motor.
pub(crate) async fn end_drill(
    State(app): State<Arc<AppState>>,
    Path(id): Path<String>,
    Commander(operator): Commander,
) -> Replied<Json<DrillReport>> {
    let ended = app
        .north
        .drills
        .abort(&id, &operator.origin(), Instant::now(), SystemTime::now());
    ended.map(Json).map_err(|refusal| why_not(&refusal))
}

fn why_not(refusal: &DrillRefusal) -> Refused {
    let text = refusal.to_string();
    match refusal {
        DrillRefusal::Unknown(_) => not_found(text, Vec::new()),
        DrillRefusal::NotPossible(_) => refused(StatusCode::UNPROCESSABLE_ENTITY, text),
        DrillRefusal::NotNow(_) => refused(StatusCode::CONFLICT, text),
    }
}
