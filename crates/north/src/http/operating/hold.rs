//! `/api/v1/drives/{name}/hold`: who holds a drive, and taking, renewing, releasing and breaking that.

use std::sync::Arc;
use std::time::Instant;

use axum::Json;
use axum::extract::{Extension, Path, Request, State};
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use serde::Deserialize;

use super::super::body;
use super::super::routes::{AppState, Reached, no_drive};
use crate::command::{Authority, Verb};
use crate::command_json::{HoldReply, MAX_PAYLOAD};
use crate::http::messages::ErrorReply;

#[derive(Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub(in crate::http) struct HoldAct {
    /// `take`, `renew`, `release` or `break`.
    action: String,
}

/// Who holds the drive.
pub(in crate::http) async fn hold_of(
    State(app): State<Arc<AppState>>,
    Extension(reached): Extension<Reached>,
    Path(name): Path<String>,
    headers: HeaderMap,
) -> Response {
    let cookies = app.cookies(&reached);
    let operator = match app.operating.operator(&headers, &cookies, &reached).await {
        Ok(operator) => operator,
        Err(denied) => return denied.into_response(),
    };
    let plant = app.plant.load();
    let Some(drive) = plant.drive(&name) else {
        return no_drive(&plant, &name);
    };
    match drive.hold_view(Some(&operator.origin()), Instant::now()) {
        Some((view, own)) => Json(HoldReply::of(&name, view).own(own)).into_response(),
        None => error(StatusCode::CONFLICT, "nobody holds drives here: [authority] is off"),
    }
}

/// Takes, renews, releases or breaks the hold.
pub(in crate::http) async fn hold(
    State(app): State<Arc<AppState>>,
    Extension(reached): Extension<Reached>,
    Path(name): Path<String>,
    request: Request,
) -> Response {
    let (parts, body) = request.into_parts();
    let cookies = app.cookies(&reached);
    let operator = app.operating.commander(&parts.headers, &cookies, &reached).await;
    let operator = match operator {
        Ok(operator) => operator,
        Err(denied) => return denied.into_response(),
    };
    let payload = match body::read(body, &reached, MAX_PAYLOAD).await {
        Ok(payload) => payload,
        Err(response) => return response,
    };
    let wanted = serde_json::from_slice::<HoldAct>(&payload).ok();
    let Some(verb) = wanted.and_then(|wanted| Verb::of(&wanted.action)) else {
        let text = "the body is {\"action\": …} with \"take\", \"renew\", \"release\" or \"break\"";
        return error(StatusCode::UNPROCESSABLE_ENTITY, text);
    };
    let plant = app.plant.load();
    let Some(drive) = plant.drive(&name) else {
        return no_drive(&plant, &name);
    };
    let (origin, now) = (operator.origin(), Instant::now());
    let done = drive.hold(verb, &origin, Authority::Write, now);
    let status = match &done {
        Ok(_) => StatusCode::OK,
        Err(refusal) if refusal.holder().is_none() && drive.is_guarded() => StatusCode::FORBIDDEN,
        Err(_) => StatusCode::CONFLICT,
    };
    let view = drive.hold_view(Some(&origin), now);
    let own = view.as_ref().is_some_and(|(_, own)| *own);
    let reply = HoldReply::new(&name, done, view.map(|(view, _)| view)).own(own);
    (status, Json(reply)).into_response()
}

fn error(status: StatusCode, text: &str) -> Response {
    (status, Json(ErrorReply::new(text))).into_response()
}
