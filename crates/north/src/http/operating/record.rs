//! `POST /api/v1/drives/{name}/recordings`: records a drive, the time before now and the time after.

use std::sync::Arc;

use axum::Json;
use axum::extract::{Extension, Path, State};
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};

use super::super::messages::{ErrorReply, Recorded};
use super::super::routes::{AppState, Reached, no_drive};

/// 200 with the id of the recording, or 409.
pub(in crate::http) async fn record(
    State(app): State<Arc<AppState>>,
    Extension(reached): Extension<Reached>,
    Path(name): Path<String>,
    headers: HeaderMap,
) -> Response {
    let cookies = app.cookies(&reached);
    let operator = match app.operating.commander(&headers, &cookies, &reached).await {
        Ok(operator) => operator,
        Err(denied) => return denied.into_response(),
    };
    let plant = app.plant.load_full();
    if plant.drive(&name).is_none() {
        return no_drive(&plant, &name);
    }
    match plant.recordings.record(&name, &operator.origin().who).await {
        Ok((id, after)) => Json(Recorded {
            id,
            after_s: after.as_secs_f64(),
        })
        .into_response(),
        Err(why) => (StatusCode::CONFLICT, Json(ErrorReply::new(why.to_string()))).into_response(),
    }
}
