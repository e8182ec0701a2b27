//! Users who may command, their sessions, and which user sent a request.

use std::collections::HashMap;
use std::hash::{BuildHasher, RandomState};
use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use arc_swap::ArcSwapOption;
use argon2::password_hash::Encoding;
use axum::http::StatusCode;
use axum::http::header::{self, HeaderMap};
use ring::hmac;
use ring::rand::{SecureRandom, SystemRandom};
use subtle::ConstantTimeEq;
use tokio::sync::Semaphore;

use super::super::reached::{LocalUser, Reached};
use super::super::users::{MAX_PASSWORD, User, Users};
use super::commands::SharedReply;
use super::cookies::Cookies;
use super::sessions::{IDLE, Secrets, Session, Sessions};
use super::throttle::{Source, Throttle};
use super::verifier::Verifier;
use drivegate_core::order::{Authority, Grants, Proof, Right, SourceKind};
use drivegate_north::NorthState;
use drivegate_north::command_json::SharedMemory;
use drivegate_north::log_throttle::LogThrottle;
/// Time for which a password that a program sends with each request is not hashed again.
const VERIFIED: Duration = Duration::from_secs(300);
/// Maximum number of remembered passwords, and of addresses that are known to belong to a user.
const MOST_REMEMBERED: usize = 256;
/// Maximum number of commands with pending results, except stops.
pub(super) const IN_PROGRESS: usize = 256;

/// Header with the token of a session.
const CSRF: &str = "x-csrf-token";

/// The state of commands over HTTP. Reloads and changes of listeners keep it.
#[derive(Debug)]
pub(crate) struct Operating {
    /// The users; `None` if commands are off.
    pub(super) users: Arc<ArcSwapOption<Users>>,
    state: Mutex<State>,
    verifier: Verifier,
    /// Hashes names into keys of the throttle.
    pub(super) hasher: RandomState,
    /// Key for the keyed hashes of passwords in memory; `None` if the system has no random numbers: then none are kept.
    key: Option<hmac::Key>,
    /// Recent commands, to recognise repetitions.
    pub(super) commands: Arc<SharedMemory<SharedReply>>,
    pub(super) in_progress: Arc<Semaphore>,
    /// Limits the log of failed logins.
    pub(super) failures: LogThrottle,
}

#[derive(Debug, Default)]
pub(super) struct State {
    pub(super) sessions: Sessions,
    throttle: Throttle,
    /// Passwords that were verified: their keyed hash, their user, and until when they are accepted without Argon2id.
    verified: HashMap<[u8; 32], (Arc<str>, Instant)>,
    /// Addresses from which a user did something, who and when.
    operators: HashMap<IpAddr, (Arc<str>, Instant)>,
}

/// The user of a request.
#[derive(Debug, Clone)]
pub(crate) struct Operator {
    pub(super) user: Arc<str>,
    /// Login name; see [`drivegate_core::order::Origin::with_login`].
    pub(super) login: Arc<str>,
    pub(super) address: IpAddr,
    /// The interface that the user used.
    pub(super) kind: SourceKind,
    pub(super) proof: Proof,
    pub(super) right: Right,
    /// The cookie of the operator's session; `None` for a program.
    pub(super) cookie: Option<String>,
}

impl Operator {
    /// Whether the user may still send requests that change something; this right is equal for every bus.
    pub(super) fn is_still_one(&self) -> bool {
        self.right.allows("")
    }

    /// A user of the local socket.
    fn local(local: &LocalUser, address: IpAddr) -> Operator {
        Operator {
            login: format!("{} {}", local.kind.name(), local.who).into(),
            user: local.who.clone(),
            address,
            kind: local.kind,
            proof: local.proof.clone(),
            right: local.right.clone(),
            cookie: None,
        }
    }
}

/// Why a request is not accepted as one of a user.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum Denied {
    /// The request has neither session nor password.
    #[error("log in first: POST /api/v1/login, or send user and password with each request (HTTP Basic)")]
    NotLoggedIn,
    /// The session has ended, or the cookie never belonged to one.
    #[error("the session has ended; log in again")]
    SessionEnded,
    /// User or password is wrong; the reply does not tell which.
    #[error("wrong user or password")]
    Wrong,
    /// Too many failed logins; the next attempt is possible after this time.
    #[error("too many failed logins; try again in {} s", .0.as_secs() + 1)]
    TooMany(Duration),
    /// Too many passwords wait to be verified.
    #[error("too many logins at once; try again")]
    Busy,
    /// The request comes from a page of another site.
    #[error("the request comes from another origin")]
    OtherOrigin,
    /// The user lost the right while the request was coming in.
    #[error("a reload removed the right of this user while the request arrived; nothing was done")]
    RightLost,
    /// The token of the session is missing or wrong.
    #[error("the header X-CSRF-Token does not have the token of this session")]
    NoToken,
}

impl Denied {
    pub(crate) fn status(&self) -> StatusCode {
        match self {
            Denied::NotLoggedIn | Denied::SessionEnded | Denied::Wrong => StatusCode::UNAUTHORIZED,
            Denied::TooMany(_) => StatusCode::TOO_MANY_REQUESTS,
            Denied::Busy => StatusCode::SERVICE_UNAVAILABLE,
            Denied::OtherOrigin | Denied::RightLost | Denied::NoToken => StatusCode::FORBIDDEN,
        }
    }
}

/// A user name and a password, as a client sent them.
#[derive(Clone, serde::Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Credentials {
    pub(super) user: String,
    pub(super) password: String,
}

impl Operating {
    pub(crate) fn new(north: &NorthState) -> Operating {
        Operating {
            users: Arc::default(),
            state: Mutex::default(),
            verifier: Verifier::default(),
            hasher: RandomState::default(),
            key: hmac::Key::generate(hmac::HMAC_SHA256, &SystemRandom::new()).ok(),
            commands: north.kept(),
            in_progress: Arc::new(Semaphore::new(IN_PROGRESS)),
            failures: LogThrottle::default(),
        }
    }

    /// Whether commands over HTTP are enabled.
    pub(crate) fn is_on(&self) -> bool {
        self.users.load().is_some()
    }

    /// Sets the users who may command; `None` disables commands. Sessions of users who were removed, or have a new
    /// password, end.
    pub(crate) fn set_users(&self, users: Option<Users>) {
        // A session is looked up under the same lock, so it ends together with its user.
        let mut state = self.state();
        let before = self.users.swap(users.map(Arc::new));
        let after = self.users.load_full();
        let of = |users: &Option<Arc<Users>>, name: &str| users.as_ref().and_then(|users| users.named(name)).cloned();
        let stays = |name: &str| {
            let user: Option<User> = of(&after, name);
            user.is_some() && user == of(&before, name)
        };
        state.sessions.keep(stays);
        state.verified.retain(|_, (user, _)| stays(user));
        state.operators.retain(|_, (user, _)| stays(user));
    }

    /// The authority of connections from an address: those from addresses with a recently active user do not yield
    /// to others, and have reserved places.
    pub(crate) fn authority_at(&self, address: IpAddr, now: Instant) -> Authority {
        if !self.is_on() {
            return Authority::ReadOnly;
        }
        let state = self.state();
        let used = state.operators.get(&address).map(|(_, used)| *used);
        if used.is_some_and(|used| now.saturating_duration_since(used) < IDLE) {
            Authority::Write
        } else {
            Authority::ReadOnly
        }
    }

    /// The user of a request with these headers, by its session or by its password.
    ///
    /// # Errors
    /// If the user may not command; [`Denied::NotLoggedIn`] if the request names no user.
    pub(crate) async fn operator(
        &self,
        headers: &HeaderMap,
        cookies: &Cookies,
        reached: &Reached,
    ) -> Result<Operator, Denied> {
        let address = reached.peer.ip();
        if let Some(local) = &reached.local {
            return Ok(Operator::local(local, address));
        }
        if headers.contains_key(header::AUTHORIZATION) {
            let credentials = basic(headers).ok_or(Denied::NotLoggedIn)?;
            // The right is read afterwards, because comparing the password takes some time.
            let right = self.right_of(&credentials.user);
            let user = self.verified(&credentials, address, Source::of(address)).await?;
            return Ok(Operator {
                login: user.clone(),
                proof: Proof::User(user.clone()),
                right: right.ok_or(Denied::Wrong)?,
                user,
                address,
                kind: SourceKind::Http,
                cookie: None,
            });
        }
        let cookie = cookies.session(headers).ok_or(Denied::NotLoggedIn)?;
        let state = self.state();
        let session = state.sessions.find(&cookie, Instant::now()).cloned();
        let session = session.ok_or(Denied::SessionEnded)?;
        let right = self.right_of(&session.user).ok_or(Denied::SessionEnded)?;
        drop(state);
        Ok(Operator {
            proof: Proof::User(session.user.clone()),
            right,
            user: session.user,
            login: session.login,
            address,
            kind: SourceKind::Http,
            cookie: Some(cookie),
        })
    }

    /// The user's right to write, which lasts as long as the file has the user with this password.
    fn right_of(&self, user: &str) -> Option<Right> {
        let user = self.users.load().as_ref()?.named(user)?.clone();
        let users = self.users.clone();
        Some(Right::of(Arc::new(UserRight { users, user })))
    }

    pub(super) fn session(&self, cookie: &str, now: Instant) -> Option<Session> {
        self.is_on().then(|| self.state().sessions.find(cookie, now).cloned())?
    }

    /// The user of a request that changes something; also checks that the request comes from the gateway's own page.
    ///
    /// # Errors
    /// If no user is signed in, or the request does not come from this gateway's own page.
    pub(crate) async fn commander(
        &self,
        headers: &HeaderMap,
        cookies: &Cookies,
        reached: &Reached,
    ) -> Result<Operator, Denied> {
        if reached.local.is_some() {
            // Browsers do not use the local socket, and the permissions of its file decide who may.
            return self.operator(headers, cookies, reached).await;
        }
        is_own_origin(headers)?;
        let operator = self.operator(headers, cookies, reached).await?;
        if let Some(cookie) = &operator.cookie {
            self.check_csrf(headers, cookie)?;
        }
        self.used(&operator, Instant::now());
        Ok(operator)
    }

    /// Whether the request repeats the CSRF token of its session.
    pub(super) fn check_csrf(&self, headers: &HeaderMap, cookie: &str) -> Result<(), Denied> {
        let session = self.session(cookie, Instant::now()).ok_or(Denied::SessionEnded)?;
        let given = headers.get(CSRF).map_or(&[][..], |value| value.as_bytes());
        if bool::from(given.ct_eq(session.csrf.as_bytes())) {
            Ok(())
        } else {
            Err(Denied::NoToken)
        }
    }

    /// Notes that the user was active: the session and the places of the address are kept.
    fn used(&self, operator: &Operator, now: Instant) {
        let mut state = self.state();
        if let Some(cookie) = &operator.cookie {
            state.sessions.used(cookie, now);
        }
        let operators = &mut state.operators;
        operators.retain(|_, (_, used)| now.saturating_duration_since(*used) < IDLE);
        if operators.len() >= MOST_REMEMBERED
            && !operators.contains_key(&operator.address)
            && let Some(oldest) = operators
                .iter()
                .min_by_key(|(_, (_, used))| *used)
                .map(|(address, _)| *address)
        {
            operators.remove(&oldest);
        }
        operators.insert(operator.address, (operator.user.clone(), now));
    }

    /// The user with this password. A password that was verified shortly before is not hashed again.
    pub(super) async fn verified(
        &self,
        given: &Credentials,
        address: IpAddr,
        source: Source,
    ) -> Result<Arc<str>, Denied> {
        let Some(users) = self.users.load_full() else {
            return Err(Denied::NotLoggedIn);
        };
        let mark = self.mark(given);
        let known = mark.and_then(|mark| Some((mark, self.state().verified.get(&mark).cloned()?)));
        let source = match known {
            Some((_, (user, until))) if Instant::now() < until => return Ok(user),
            // The password was verified before: failures of others at this address must not delay it.
            Some((mark, _)) => Source::Known(self.hasher.hash_one(mark)),
            None => source,
        };
        let name = self.hasher.hash_one(&given.user);
        let failures = self.state().throttle.begin(source, name, Instant::now());
        let failures = failures.map_err(Denied::TooMany)?;
        // Neither the answer nor its time may reveal whether the user exists.
        let user = users.named(&given.user);
        let too_long = given.password.len() > MAX_PASSWORD;
        let password = if too_long { "" } else { given.password.as_str() };
        let hashes = users.hashes(&given.user);
        let right = self.verifier.verify(hashes, password, address, failures).await;
        let mut state = self.state();
        match (right, user) {
            (None, _) => {
                state.throttle.withdraw(source, name);
                Err(Denied::Busy)
            }
            // A reload may have removed the user meanwhile.
            (Some(true), Some(user)) if !too_long && self.has(user) => {
                state.throttle.succeeded(source, name);
                let name: Arc<str> = user.name.as_str().into();
                if let Some(mark) = mark {
                    state.remember(mark, &name, Instant::now());
                }
                Ok(name)
            }
            _ => Err(Denied::Wrong),
        }
    }

    fn has(&self, user: &User) -> bool {
        let users = self.users.load();
        users
            .as_ref()
            .is_some_and(|users| users.named(&user.name) == Some(user))
    }

    /// The stored mark of a verified user and password.
    fn mark(&self, given: &Credentials) -> Option<[u8; 32]> {
        // A name with a zero byte would belong to no user, because no name contains one.
        let text = format!("{}\0{}", given.user, given.password);
        hmac::sign(self.key.as_ref()?, text.as_bytes()).as_ref().try_into().ok()
    }

    /// Starts a session of a user who logged in; `None` if the system has no random numbers.
    pub(super) fn begin(&self, user: &Arc<str>, address: IpAddr, now: Instant) -> Option<(Session, String)> {
        let random = SystemRandom::new();
        let mut secrets = Secrets {
            cookie: [0; 32],
            csrf: [0; 32],
        };
        random.fill(&mut secrets.cookie).ok()?;
        random.fill(&mut secrets.csrf).ok()?;
        let (session, cookie) = self.state().sessions.begin(user, secrets, now);
        let operator = Operator {
            user: user.clone(),
            login: session.login.clone(),
            address,
            kind: SourceKind::Http,
            proof: Proof::User(user.clone()),
            right: Right::lasting(),
            cookie: Some(cookie.clone()),
        };
        self.used(&operator, now);
        Some((session, cookie))
    }

    pub(super) fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[derive(Debug)]
struct UserRight {
    users: Arc<ArcSwapOption<Users>>,
    user: User,
}

impl Grants for UserRight {
    fn may_write(&self, _: &str) -> bool {
        let users = self.users.load();
        users
            .as_ref()
            .is_some_and(|users| users.named(&self.user.name) == Some(&self.user))
    }
}

impl State {
    fn remember(&mut self, mark: [u8; 32], user: &Arc<str>, now: Instant) {
        // The table has at most one entry for each user, since each has one password.
        if self.verified.len() < MOST_REMEMBERED {
            self.verified.insert(mark, (user.clone(), now + VERIFIED));
        }
    }
}

/// Whether a request can come from a page of this gateway. Browsers report the page that sent a request; programs
/// report nothing.
///
/// # Errors
/// If the request comes from a page of another origin.
pub(super) fn is_own_origin(headers: &HeaderMap) -> Result<(), Denied> {
    let text = |name| headers.get_all(name).iter().map(|value| value.to_str().unwrap_or("\0"));
    let host = text(header::HOST).next().unwrap_or_default();
    let is_host = |origin: &str| {
        let (scheme, authority) = origin.split_once("://").unwrap_or_default();
        let port = match scheme {
            "https" => ":443",
            "http" => ":80",
            _ => return false,
        };
        let bare = |text: &str| text.strip_suffix(port).unwrap_or(text).to_ascii_lowercase();
        !authority.is_empty() && bare(authority) == bare(host)
    };
    let mut site = text(header::HeaderName::from_static("sec-fetch-site"));
    if text(header::ORIGIN).all(is_host) && site.all(|site| matches!(site, "same-origin" | "none")) {
        Ok(())
    } else {
        Err(Denied::OtherOrigin)
    }
}

/// User and password of HTTP Basic.
fn basic(headers: &HeaderMap) -> Option<Credentials> {
    let mut given = headers.get_all(header::AUTHORIZATION).iter();
    let (Some(given), None) = (given.next(), given.next()) else {
        return None;
    };
    let (scheme, text) = given.to_str().ok()?.split_once(' ')?;
    if !scheme.eq_ignore_ascii_case("basic") {
        return None;
    }
    // A longer text is not a valid password.
    let mut bytes = [0; 512];
    let bytes = Encoding::B64
        .decode(text.trim().trim_end_matches('='), &mut bytes)
        .ok()?;
    let text = std::str::from_utf8(bytes).ok()?;
    let (user, password) = text.split_once(':')?;
    Some(Credentials {
        user: user.to_string(),
        password: password.to_string(),
    })
}

/// The header of HTTP Basic for `USER:PASSWORD`.
pub fn basic_authorization(user_and_password: &str) -> String {
    let mut text = vec![0; Encoding::B64.encoded_len(user_and_password.as_bytes())];
    // The buffer is large enough.
    let text = Encoding::B64
        .encode(user_and_password.as_bytes(), &mut text)
        .unwrap_or_default();
    let padding = "=".repeat(text.len().next_multiple_of(4) - text.len());
    format!("Basic {text}{padding}")
}

#[cfg(test)]
mod tests;
