//! `POST /api/v1/stop`: stops all drives of the gateway, of a bus or of a group.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Instant;

use axum::Json;
use axum::extract::{FromRequestParts, State};
use axum::http::StatusCode;
use axum::http::request::Parts;
use axum::response::IntoResponse;

use super::super::app_state::AppState;
use super::super::replies::{Replied, not_found, refused};
use super::asker::Ordered;
use drivegate_core::order::Refusal;
use drivegate_core::plant::Plant;
use drivegate_core::stop_all::{NamedDrives, NothingToStop};
use drivegate_north::command_json::{nothing_to_stop, refuse_stop_all, stop_all};

/// The plant when the head of a request had arrived.
pub(crate) struct PlantAtHead(Arc<Plant>);

impl FromRequestParts<Arc<AppState>> for PlantAtHead {
    type Rejection = Infallible;

    async fn from_request_parts(_: &mut Parts, app: &Arc<AppState>) -> Result<PlantAtHead, Infallible> {
        Ok(PlantAtHead(app.plant.load_full()))
    }
}

/// Replies 200 if every drive is at standstill, 504 if the standstill of a drive is not proven.
pub(crate) async fn stop(
    State(app): State<Arc<AppState>>,
    PlantAtHead(earlier): PlantAtHead,
    Ordered(operator, payload): Ordered,
) -> Replied {
    let (plant, origin, now) = (app.plant.load_full(), operator.origin(), Instant::now());
    let refuse = |refusal: Refusal| refuse_stop_all(&plant, refusal, &origin, now);
    let (scope, wait) =
        stop_all(&payload).map_err(|refusal| refused(StatusCode::UNPROCESSABLE_ENTITY, refuse(refusal)))?;
    // A reload since the head may have given the name to other drives.
    let scope = if Arc::ptr_eq(&earlier, &plant) {
        Ok(scope)
    } else {
        scope.as_of(&NamedDrives::of(&earlier))
    };
    let order = scope.and_then(|scope| app.north.stop_all.order(&plant, &scope, &origin, wait, now));
    let order = order.map_err(|why| match (refuse(nothing_to_stop(&why)), why) {
        (text, NothingToStop::NotControlled) => refused(StatusCode::FORBIDDEN, text),
        (text, NothingToStop::Unknown { known, .. }) => not_found(text, known),
    })?;
    let report = order.report.await;
    let report = report.map_err(|_| StatusCode::SERVICE_UNAVAILABLE)?;
    let status = if report.ok {
        StatusCode::OK
    } else {
        StatusCode::GATEWAY_TIMEOUT
    };
    Ok((status, Json(report)).into_response())
}
