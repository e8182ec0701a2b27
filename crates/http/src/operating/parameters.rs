//! Parameters of a drive, read and restored: started by a POST, looked at by a GET.

use std::sync::Arc;

use axum::Json;
use axum::extract::{Path, State};
use axum::http::StatusCode;
use serde::de::DeserializeOwned;

use super::super::app_state::AppState;
use super::super::messages::{ParameterReading, PreparedRestore, ReadParameters, Restore, RestoreAct, RestoreWish};
use super::super::replies::{Refused, Replied, refused};
use super::asker::Ordered;
use super::commands::RequestArrival;
use drivegate_core::order::{Origin, Pace};
use drivegate_core::parameters::{Id, ParameterFile, Wishes};
use drivegate_core::plant::DriveHandle;
use drivegate_north::parameter_jobs::{Again, How, begin_reading, carry_out, prepare, release, take_up};

/// Maximum number of bytes of a request: a parameter file with some thousand parameters.
const MAX_BODY: usize = 256 * 1024;

/// `POST …/params/reading`: starts a reading, unless one is in progress.
pub(crate) async fn read(
    State(app): State<Arc<AppState>>,
    Path(name): Path<String>,
    Ordered(operator, body): Ordered<MAX_BODY>,
) -> Replied<Json<ParameterReading>> {
    let how: ReadParameters = understood(&body)?;
    let drive = app.drive(&name)?;
    let how = How {
        afresh: how.afresh,
        pace: if how.brisk { Pace::Brisk } else { Pace::Slow },
    };
    begin_reading(&app.north.parameters, drive.clone(), operator.origin(), how).map_err(conflict)?;
    reading(&app, &drive)
}

/// `GET …/params/reading`: progress of the reading, and its file once it has ended.
pub(crate) async fn progress(
    State(app): State<Arc<AppState>>,
    Path(name): Path<String>,
) -> Replied<Json<ParameterReading>> {
    reading(&app, &app.drive(&name)?)
}

/// `POST …/params/restore`
pub(crate) async fn restore(
    asked: RequestArrival,
    State(app): State<Arc<AppState>>,
    Path(name): Path<String>,
    Ordered(operator, body): Ordered<MAX_BODY>,
) -> Replied<Json<Restore>> {
    let act: RestoreAct = understood(&body)?;
    let drive = app.drive(&name)?;
    let origin = operator.origin();
    let meant = drive.is_meant(origin.kind, &asked.complete());
    meant.map_err(|refusal| conflict(refusal.to_string()))?;
    act_on(&app, &drive, act, origin).await.map_err(conflict)?;
    restored(&app, &drive)
}

/// `GET …/params/restore`: progress of the restore.
pub(crate) async fn restore_progress(
    State(app): State<Arc<AppState>>,
    Path(name): Path<String>,
) -> Replied<Json<Restore>> {
    restored(&app, &app.drive(&name)?)
}

fn understood<T: DeserializeOwned>(body: &[u8]) -> Replied<T> {
    let failed = |error| format!("the body is invalid: {error}");
    serde_json::from_slice(body).map_err(|error| refused(StatusCode::UNPROCESSABLE_ENTITY, failed(error)))
}

async fn act_on(app: &AppState, drive: &DriveHandle, act: RestoreAct, origin: Origin) -> Result<(), String> {
    let (shared, vault) = (&app.plant, &app.north.parameters);
    match act {
        RestoreAct::Prepare(RestoreWish { file, only, force }) => {
            let wanted = ParameterFile::parse(&file).map_err(|why| format!("the file is invalid: {why}"))?;
            let wishes = Wishes {
                only: only.iter().map(|id| Id::new(id)).collect(),
                force,
            };
            prepare(vault, drive.clone(), wanted, wishes, origin).map(drop)
        }
        RestoreAct::CarryOut(PreparedRestore { number }) => carry_out(shared, vault, drive, number, origin),
        RestoreAct::Resume => take_up(shared, vault, drive, Again::Resume, origin).await,
        RestoreAct::Undo => take_up(shared, vault, drive, Again::Undo, origin).await,
        RestoreAct::Release => release(shared, vault, drive, &origin).await,
    }
}

fn reading(app: &AppState, drive: &DriveHandle) -> Replied<Json<ParameterReading>> {
    let status = app.north.parameters.status(&drive.machine());
    let name = &drive.image.spec.name;
    let status = status.ok_or_else(|| conflict(format!("the parameters of `{name}` have not been read yet")))?;
    Ok(Json(ParameterReading::new(&status)))
}

fn restored(app: &AppState, drive: &DriveHandle) -> Replied<Json<Restore>> {
    let status = app.north.parameters.restore(&drive.machine());
    let name = &drive.image.spec.name;
    let none = || {
        conflict(format!(
            "no parameters of `{name}` have been restored since the gateway started"
        ))
    };
    Ok(Json(Restore::new(&status.ok_or_else(none)?)))
}

fn conflict(why: String) -> Refused {
    refused(StatusCode::CONFLICT, why)
}
