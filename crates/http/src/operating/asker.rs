//! The user of a request, as an argument of its handler. A user's right to change something is checked when the
//! head of the request has arrived, and again when its body is complete, since a reload may have happened in
//! between.

use std::sync::Arc;

use axum::body::Bytes;
use axum::extract::{FromRequest, FromRequestParts, Request};
use axum::http::request::Parts;

use super::super::app_state::AppState;
use super::super::body;
use super::super::reached::Reached;
use super::super::replies::{Refused, Replied};
use super::state::{Denied, Operator};
use drivegate_north::command_json::MAX_PAYLOAD;

/// A user who may see the state of the operating part.
pub(crate) struct Viewer(pub(crate) Operator);

/// A user who may send requests that change something.
pub(crate) struct Commander(pub(super) Operator);

/// A user with a complete request, whose body has at most this many bytes.
pub(crate) struct Ordered<const MOST_BYTES: usize = MAX_PAYLOAD>(pub(super) Operator, pub(super) Bytes);

impl FromRequestParts<Arc<AppState>> for Viewer {
    type Rejection = Refused;

    async fn from_request_parts(parts: &mut Parts, app: &Arc<AppState>) -> Replied<Viewer> {
        let reached = Reached::of(parts)?;
        let (headers, cookies) = (&parts.headers, app.cookies(&reached));
        Ok(Viewer(app.operating.operator(headers, &cookies, &reached).await?))
    }
}

impl FromRequestParts<Arc<AppState>> for Commander {
    type Rejection = Refused;

    async fn from_request_parts(parts: &mut Parts, app: &Arc<AppState>) -> Replied<Commander> {
        let reached = Reached::of(parts)?;
        let (headers, cookies) = (&parts.headers, app.cookies(&reached));
        Ok(Commander(app.operating.commander(headers, &cookies, &reached).await?))
    }
}

impl<const MOST_BYTES: usize> FromRequest<Arc<AppState>> for Ordered<MOST_BYTES> {
    type Rejection = Refused;

    async fn from_request(request: Request, app: &Arc<AppState>) -> Replied<Ordered<MOST_BYTES>> {
        let (mut parts, body) = request.into_parts();
        let Commander(operator) = Commander::from_request_parts(&mut parts, app).await?;
        let body = body::read(body, &Reached::of(&parts)?, MOST_BYTES).await?;
        if operator.is_still_one() {
            Ok(Ordered(operator, body))
        } else {
            Err(Denied::RightLost.into())
        }
    }
}
