//! Replies to refused requests.

use axum::Json;
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};

use super::messages::ErrorReply;
use drivegate_core::plant::{BusHandle, Plant};

/// A reply that refuses a request. Boxed, because it is part of many results.
#[derive(Debug)]
pub(super) struct Refused(Box<Response>);

/// The reply of a handler.
pub(super) type Replied<T = Response> = Result<T, Refused>;

impl From<Response> for Refused {
    fn from(reply: Response) -> Refused {
        Refused(Box::new(reply))
    }
}

impl From<StatusCode> for Refused {
    fn from(status: StatusCode) -> Refused {
        status.into_response().into()
    }
}

impl IntoResponse for Refused {
    fn into_response(self) -> Response {
        *self.0
    }
}

pub(super) fn refused(status: StatusCode, why: impl Into<String>) -> Refused {
    (status, Json(ErrorReply::new(why))).into_response().into()
}

/// A reply with status 404 that lists the known names.
pub(super) fn not_found(error: String, known: Vec<String>) -> Refused {
    let error = Json(ErrorReply { error, known });
    (StatusCode::NOT_FOUND, error).into_response().into()
}

/// The reply where the drive is unknown.
pub(super) fn no_drive(plant: &Plant, name: &str) -> Refused {
    let known = plant.drives().map(|drive| drive.image.spec.name.clone());
    not_found(format!("there is no drive `{name}`"), known.collect())
}

/// The reply where the bus is unknown.
pub(super) fn no_bus(plant: &Plant, name: &str) -> Refused {
    let known = plant.buses.iter().map(|bus| bus.image.spec.name.clone());
    not_found(format!("there is no bus `{name}`"), known.collect())
}

/// The bus with this name.
///
/// # Errors
/// If no bus has this name: contains the reply.
pub(super) fn find_bus<'p>(plant: &'p Plant, name: &str) -> Replied<&'p BusHandle> {
    let found = plant.buses.iter().find(|bus| bus.image.spec.name == name);
    found.ok_or_else(|| no_bus(plant, name))
}
