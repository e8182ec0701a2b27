//! `/api/v1/drives/{name}/hold`: who holds a drive, and taking, renewing, releasing and breaking that.

use std::sync::Arc;
use std::time::Instant;

use axum::Json;
use axum::extract::{Path, State};
use axum::http::StatusCode;
use axum::response::IntoResponse;

use super::super::app_state::AppState;
use super::super::messages::HoldAct;
use super::super::replies::{Replied, refused};
use super::asker::{Ordered, Viewer};
use super::commands::RequestArrival;
use drivegate_core::order::Authority;
use drivegate_core::permit::Verb;
use drivegate_north::command_json::HoldReply;

/// Handler: the holder of the drive.
pub(crate) async fn hold_of(
    State(app): State<Arc<AppState>>,
    Path(name): Path<String>,
    Viewer(operator): Viewer,
) -> Replied {
    let drive = app.drive(&name)?;
    match drive.hold_view(Some(&operator.origin()), Instant::now()) {
        Some((view, own)) => Ok(Json(HoldReply::of(&name, view).own(own)).into_response()),
        None => Err(refused(
            StatusCode::CONFLICT,
            "drives cannot be held: [authority] is off",
        )),
    }
}

/// Takes, renews, releases or breaks the hold of a drive.
pub(crate) async fn hold(
    asked: RequestArrival,
    State(app): State<Arc<AppState>>,
    Path(name): Path<String>,
    Ordered(operator, payload): Ordered,
) -> Replied {
    let wanted = serde_json::from_slice::<HoldAct>(&payload).ok();
    let verb = wanted.and_then(|wanted| Verb::of(&wanted.action)).ok_or_else(|| {
        let why = "the body must be {\"action\": …} with \"take\", \"renew\", \"release\" or \"break\"";
        refused(StatusCode::UNPROCESSABLE_ENTITY, why)
    })?;
    let drive = app.drive(&name)?;
    let (origin, now) = (operator.origin(), Instant::now());
    let done = drive.hold(verb, &origin, Authority::Write, (&asked.complete(), now));
    let status = match &done {
        Ok(_) => StatusCode::OK,
        Err(refusal) if refusal.holder().is_none() && drive.has_authority() => StatusCode::FORBIDDEN,
        Err(_) => StatusCode::CONFLICT,
    };
    let view = drive.hold_view(Some(&origin), now);
    let own = view.as_ref().is_some_and(|(_, own)| *own);
    let reply = HoldReply::new(&name, done, view.map(|(view, _)| view)).own(own);
    Ok((status, Json(reply)).into_response())
}
