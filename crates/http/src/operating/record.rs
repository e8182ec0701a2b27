//! `POST /api/v1/drives/{name}/recordings`: records a drive, the time before now and the time after.

use std::sync::Arc;

use axum::Json;
use axum::extract::{Path, State};
use axum::http::StatusCode;

use super::super::app_state::AppState;
use super::super::messages::Recorded;
use super::super::replies::{Replied, no_drive, refused};
use super::asker::Commander;

/// 200 with the id of the recording, or 409.
pub(crate) async fn record(
    State(app): State<Arc<AppState>>,
    Path(name): Path<String>,
    Commander(operator): Commander,
) -> Replied<Json<Recorded>> {
    let plant = app.plant.load_full();
    if plant.drive(&name).is_none() {
        return Err(no_drive(&plant, &name));
    }
    let made = app.north.recordings.record(&name, &operator.origin().who).await;
    let (id, after) = made.map_err(|why| refused(StatusCode::CONFLICT, why.to_string()))?;
    let after_s = after.as_secs_f64();
    Ok(Json(Recorded { id, after_s }))
}
