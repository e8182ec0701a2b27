//! `POST /api/v1/stop`: stops all drives of the gateway, of a bus or of a group.

use std::sync::Arc;
use std::time::Instant;

use axum::Json;
use axum::extract::{Extension, Request, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};

use super::super::body;
use super::super::messages::ErrorReply;
use super::super::routes::{AppState, Reached};
use crate::command_json::{MAX_PAYLOAD, stop_all};
use crate::stop_all::NothingToStop;

/// 200 if every drive stands, 504 if one is not proven to.
pub(in crate::http) async fn stop(
    State(app): State<Arc<AppState>>,
    Extension(reached): Extension<Reached>,
    request: Request,
) -> Response {
    let (parts, body) = request.into_parts();
    let cookies = app.cookies(&reached);
    let operator = app.operating.commander(&parts.headers, &cookies, &reached);
    let operator = match operator.await {
        Ok(operator) => operator,
        Err(denied) => return denied.into_response(),
    };
    let payload = match body::read(body, &reached, MAX_PAYLOAD).await {
        Ok(payload) => payload,
        Err(response) => return response,
    };
    let (scope, wait) = match stop_all(&payload) {
        Ok(wanted) => wanted,
        Err(why) => return error(StatusCode::UNPROCESSABLE_ENTITY, why, Vec::new()),
    };
    let plant = app.plant.load_full();
    let order = plant
        .stop_all
        .order(&plant, &scope, &operator.origin(), wait, Instant::now());
    match order {
        Ok(order) => match order.report.await {
            Ok(report) if report.ok => Json(report).into_response(),
            Ok(report) => (StatusCode::GATEWAY_TIMEOUT, Json(report)).into_response(),
            Err(_) => StatusCode::SERVICE_UNAVAILABLE.into_response(),
        },
        Err(why @ NothingToStop::NotControlled) => error(StatusCode::FORBIDDEN, why.to_string(), Vec::new()),
        Err(why) => {
            let text = why.to_string();
            let NothingToStop::Unknown { known, .. } = why else {
                return error(StatusCode::NOT_FOUND, text, Vec::new());
            };
            error(StatusCode::NOT_FOUND, text, known)
        }
    }
}

fn error(status: StatusCode, error: String, known: Vec<String>) -> Response {
    (status, Json(ErrorReply { error, known })).into_response()
}
