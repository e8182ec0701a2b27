//! Login and logout of users.

use std::hash::BuildHasher;
use std::sync::Arc;
use std::time::Instant;

use axum::Json;
use axum::extract::{Extension, Request, State};
use axum::http::StatusCode;
use axum::http::header::{self, HeaderMap, HeaderValue};
use axum::response::{IntoResponse, Response};
use ring::rand::{SecureRandom, SystemRandom};
use serde::Serialize;

use super::super::app_state::AppState;
use super::super::body;
use super::super::reached::Reached;
use super::super::replies::{Refused, Replied, refused};
use super::cookies::{Cookies, known_as};
use super::sessions::Session;
use super::state::{Credentials, Denied, Operating, is_own_origin};
use super::throttle::Source;

/// Maximum number of bytes of the body of a login.
const MAX_LOGIN: usize = 4096;

/// A session, for the page.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(crate) struct SessionReply<'s> {
    user: &'s str,
    /// Token that the client sends in the header X-CSRF-Token.
    csrf: &'s str,
    /// s
    expires_in: u64,
}

impl<'s> SessionReply<'s> {
    fn new(session: &'s Session, now: Instant) -> SessionReply<'s> {
        SessionReply {
            user: &session.user,
            csrf: &session.csrf,
            expires_in: session.expires_in(now).as_secs(),
        }
    }
}

impl From<Denied> for Refused {
    fn from(denied: Denied) -> Refused {
        let mut response = refused(denied.status(), denied.to_string()).into_response();
        let headers = response.headers_mut();
        match denied {
            // HTTP Basic is not offered here: a browser would ask for a password and then send it with every
            // request that any page makes.
            Denied::NotLoggedIn | Denied::SessionEnded | Denied::Wrong => {
                headers.insert(
                    header::WWW_AUTHENTICATE,
                    HeaderValue::from_static("Session realm=\"drivegate\""),
                );
            }
            Denied::TooMany(wait) => {
                headers.insert(header::RETRY_AFTER, (wait.as_secs() + 1).into());
            }
            Denied::Busy => {
                headers.insert(header::RETRY_AFTER, 1.into());
            }
            Denied::OtherOrigin | Denied::RightLost | Denied::NoToken => {}
        }
        response.into()
    }
}

/// `POST /api/v1/login`
pub(crate) async fn log_in(
    State(app): State<Arc<AppState>>,
    Extension(reached): Extension<Reached>,
    request: Request,
) -> Replied {
    let (parts, body) = request.into_parts();
    let (operating, cookies) = (&app.operating, app.cookies(&reached));
    is_own_origin(&parts.headers)?;
    let body = body::read(body, &reached, MAX_LOGIN).await?;
    let given = credentials(&parts.headers, &body).ok_or_else(|| {
        let why = "send {\"user\": …, \"password\": …} as application/json";
        refused(StatusCode::BAD_REQUEST, why)
    })?;
    let address = reached.peer.ip();
    let source = operating.source(&given, &cookies, &parts.headers, &reached);
    let user = match operating.verified(&given, address, source).await {
        Ok(user) => user,
        Err(denied) => {
            if let Some(suppressed) = operating.failures.permit(Instant::now()) {
                let user: String = given.user.chars().take(64).collect();
                tracing::warn!(target: "drivegate::http", client = %address, user, suppressed, "HTTP: login refused: {denied}");
            }
            return Err(denied.into());
        }
    };
    let now = Instant::now();
    let unavailable = || StatusCode::INTERNAL_SERVER_ERROR;
    let (session, cookie) = operating.begin(&user, address, now).ok_or_else(unavailable)?;
    tracing::info!(target: "drivegate::http", client = %address, user = %user, "HTTP: logged in");
    let mut response = Json(SessionReply::new(&session, now)).into_response();
    let set = [cookies.set_session(&cookie), operating.mark_browser(&user, &cookies)];
    for value in set.into_iter().flatten() {
        response.headers_mut().append(header::SET_COOKIE, value);
    }
    Ok(response)
}

/// Reads the login of a page of the gateway; a form of another page would have another content type.
fn credentials(headers: &HeaderMap, body: &[u8]) -> Option<Credentials> {
    let kind = headers.get(header::CONTENT_TYPE)?.to_str().ok()?;
    let kind = kind.split(';').next()?.trim();
    if kind.eq_ignore_ascii_case("application/json") {
        serde_json::from_slice(body).ok()
    } else {
        None
    }
}

impl Operating {
    /// Which count of failures applies to a login: the one of its browser if that has logged in as this user
    /// before, otherwise the one of its address.
    fn source(&self, given: &Credentials, cookies: &Cookies, headers: &HeaderMap, reached: &Reached) -> Source {
        let known = cookies.known(headers).and_then(|mark| {
            let users = self.users.load_full()?;
            let number = known_as(&mark, users.named(&given.user)?)?;
            Some(Source::Known(self.hasher.hash_one(number)))
        });
        known.unwrap_or_else(|| Source::of(reached.peer.ip()))
    }

    /// The cookie that identifies the browser from now on.
    fn mark_browser(&self, user: &str, cookies: &Cookies) -> Option<HeaderValue> {
        let mut number = [0; 16];
        SystemRandom::new().fill(&mut number).ok()?;
        cookies.set_known(self.users.load_full()?.named(user)?, &number)
    }
}

/// `GET /api/v1/session`: the logged-in user; `user` is null without one.
pub(crate) async fn session(
    State(app): State<Arc<AppState>>,
    Extension(reached): Extension<Reached>,
    headers: HeaderMap,
) -> Response {
    let now = Instant::now();
    let cookie = app.cookies(&reached).session(&headers);
    match cookie.and_then(|cookie| app.operating.session(&cookie, now)) {
        Some(session) => Json(SessionReply::new(&session, now)).into_response(),
        None => Json(serde_json::json!({ "user": null })).into_response(),
    }
}

/// `POST /api/v1/logout`: ends the session, if any.
pub(crate) async fn log_out(
    State(app): State<Arc<AppState>>,
    Extension(reached): Extension<Reached>,
    headers: HeaderMap,
) -> Replied {
    let (operating, cookies) = (&app.operating, app.cookies(&reached));
    is_own_origin(&headers)?;
    if let Some(cookie) = cookies.session(&headers) {
        match operating.check_csrf(&headers, &cookie) {
            Ok(()) => operating.state().sessions.end(&cookie),
            Err(Denied::SessionEnded) => {}
            Err(denied) => return Err(denied.into()),
        }
    }
    let mut response = StatusCode::NO_CONTENT.into_response();
    let cleared = cookies.clear_session().map(|value| (header::SET_COOKIE, value));
    response.headers_mut().extend(cleared);
    Ok(response)
}
