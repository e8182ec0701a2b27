//! Parameters of a drive, read and restored: begun by a POST, looked at by a GET.

use std::sync::Arc;

use axum::Json;
use axum::extract::{Extension, Path, Request, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use serde::de::DeserializeOwned;

use super::super::body;
use super::super::messages::{ErrorReply, ParameterReading, ReadParameters, Restore, RestoreAct};
use super::super::routes::{AppState, Reached, no_drive};
use crate::command::{Origin, Pace};
use crate::parameter_jobs::{Again, How, begin_reading, carry_out, prepare, release, take_up};
use crate::parameters::{Id, ParameterFile, Wishes};
use crate::plant::DriveHandle;

/// Most bytes of a request: a file of some thousand parameters.
const MAX_BODY: usize = 256 * 1024;

/// `POST …/params/reading`: begins to read, unless that goes on.
pub(in crate::http) async fn read(
    State(app): State<Arc<AppState>>,
    Extension(reached): Extension<Reached>,
    Path(name): Path<String>,
    request: Request,
) -> Response {
    let begun = async {
        let (how, drive, origin) = asked::<ReadParameters>(&app, &reached, &name, request).await?;
        let how = How {
            afresh: how.afresh,
            pace: if how.brisk { Pace::Brisk } else { Pace::Slow },
        };
        let vault = app.plant.load().parameters.clone();
        begin_reading(&vault, drive.clone(), origin, how).map_err(conflict)?;
        Ok(reading(&app, &drive))
    };
    begun.await.unwrap_or_else(|response| response)
}

/// `GET …/params/reading`: how far it is, and the file once it is over.
pub(in crate::http) async fn progress(State(app): State<Arc<AppState>>, Path(name): Path<String>) -> Response {
    let plant = app.plant.load_full();
    match plant.drive(&name) {
        Some(drive) => reading(&app, &drive),
        None => no_drive(&plant, &name),
    }
}

/// `POST …/params/restore`
pub(in crate::http) async fn restore(
    State(app): State<Arc<AppState>>,
    Extension(reached): Extension<Reached>,
    Path(name): Path<String>,
    request: Request,
) -> Response {
    let acted = async {
        let (act, drive, origin) = asked::<RestoreAct>(&app, &reached, &name, request).await?;
        act_on(&app, &drive, act, origin).await.map_err(conflict)?;
        Ok(restored(&app, &drive))
    };
    acted.await.unwrap_or_else(|response| response)
}

/// `GET …/params/restore`: how far it is.
pub(in crate::http) async fn look(State(app): State<Arc<AppState>>, Path(name): Path<String>) -> Response {
    let plant = app.plant.load_full();
    match plant.drive(&name) {
        Some(drive) => restored(&app, &drive),
        None => no_drive(&plant, &name),
    }
}

/// What is asked for, of which drive, and by whom.
async fn asked<T: DeserializeOwned>(
    app: &AppState,
    reached: &Reached,
    name: &str,
    request: Request,
) -> Result<(T, DriveHandle, Origin), Response> {
    let (parts, body) = request.into_parts();
    let cookies = app.cookies(reached);
    let operator = app.operating.commander(&parts.headers, &cookies, reached).await;
    let operator = operator.map_err(IntoResponse::into_response)?;
    let body = body::read(body, reached, MAX_BODY).await?;
    let asked = serde_json::from_slice(&body).map_err(|error| {
        let error = ErrorReply::new(format!("the body is not understood: {error}"));
        (StatusCode::UNPROCESSABLE_ENTITY, Json(error)).into_response()
    })?;
    let plant = app.plant.load_full();
    let drive = plant.drive(name).ok_or_else(|| no_drive(&plant, name))?;
    Ok((asked, drive, operator.origin()))
}

async fn act_on(app: &AppState, drive: &DriveHandle, act: RestoreAct, origin: Origin) -> Result<(), String> {
    let shared = &app.plant;
    match act {
        RestoreAct::Prepare { file, only, force } => {
            let wanted = ParameterFile::parse(&file).map_err(|why| format!("the file is not understood: {why}"))?;
            let wishes = Wishes {
                only: only.iter().map(|id| Id::new(id)).collect(),
                force,
            };
            let vault = shared.load().parameters.clone();
            prepare(&vault, drive.clone(), wanted, wishes, origin).map(drop)
        }
        RestoreAct::CarryOut { number } => carry_out(shared, drive, number, origin),
        RestoreAct::Resume => take_up(shared, drive, Again::Resume, origin).await,
        RestoreAct::Undo => take_up(shared, drive, Again::Undo, origin).await,
        RestoreAct::Release => release(shared, drive, &origin).await,
    }
}

fn reading(app: &AppState, drive: &DriveHandle) -> Response {
    match app.plant.load().parameters.status(&drive.machine()) {
        Some(status) => Json(ParameterReading::new(&status)).into_response(),
        None => conflict(format!(
            "the parameters of `{}` were not read yet",
            drive.image.spec.name
        )),
    }
}

fn restored(app: &AppState, drive: &DriveHandle) -> Response {
    match app.plant.load().parameters.restore(&drive.machine()) {
        Some(status) => Json(Restore::new(&status)).into_response(),
        None => conflict(format!(
            "no parameters of `{}` were restored since the gateway started",
            drive.image.spec.name
        )),
    }
}

fn conflict(why: String) -> Response {
    (StatusCode::CONFLICT, Json(ErrorReply::new(why))).into_response()
}
