//! Who gives a request, as an argument of its handler.

use std::sync::Arc;

use axum::extract::FromRequestParts;
use axum::http::request::Parts;

use super::super::app_state::AppState;
use super::super::reached::Reached;
use super::super::replies::{Refused, Replied};
use super::state::Operator;

/// Who may see what commands are for.
pub(in crate::http) struct Viewer(pub(in crate::http) Operator);

/// Who may give a request that changes something.
pub(in crate::http) struct Commander(pub(super) Operator);

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
