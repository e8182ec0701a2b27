//! Decides whether a request is answered: checks the host it is addressed to, then the token of its sender. Pure.

use std::net::IpAddr;

use axum::http::header::{self, HeaderMap, HeaderName, HeaderValue};
use axum::http::{StatusCode, Uri};
use axum::response::{IntoResponse, Response};

use super::hosts::{Host, Hosts};
use super::replies::refused;
use super::tokens::{Scope, Tokens};

/// Conditions under which a request is answered.
#[derive(Debug, PartialEq)]
pub(super) struct Access {
    pub(super) hosts: Hosts,
    /// The tokens; `None` if no token is needed.
    pub(super) tokens: Option<Tokens>,
}

/// Why a request is refused before it is processed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(super) enum AccessError {
    #[error("the request has no `Host` header, or more than one")]
    HostCount,
    #[error("the `Host` header is not a host name or an address")]
    BadHost,
    #[error("this host name is not in `hosts` of [http]; add it")]
    OtherHost,
    #[error("a token is required: send `Authorization: Bearer …` with one of tokens_file")]
    NoToken,
    #[error("the token is not in tokens_file")]
    UnknownToken,
    #[error("the token lacks the scope `{}`", .0.name())]
    MissingScope(Scope),
}

impl AccessError {
    /// Whether another proof of identity can replace the token.
    pub(super) fn is_for_want_of_a_token(&self) -> bool {
        matches!(
            self,
            AccessError::NoToken | AccessError::UnknownToken | AccessError::MissingScope(_)
        )
    }
}

impl Access {
    /// Whether a request on a connection to this machine's address `local` may be answered.
    ///
    /// # Errors
    /// If the request must not be answered; contains the reason.
    pub(super) fn check(&self, uri: &Uri, headers: &HeaderMap, local: IpAddr) -> Result<(), AccessError> {
        self.check_host(uri, headers, local)?;
        let (Some(tokens), Some(scope)) = (&self.tokens, scope(uri.path())) else {
            return Ok(());
        };
        let token = tokens.find(bearer(headers)?).ok_or(AccessError::UnknownToken)?;
        if token.scopes.contains(&scope) {
            Ok(())
        } else {
            Err(AccessError::MissingScope(scope))
        }
    }

    fn check_host(&self, uri: &Uri, headers: &HeaderMap, local: IpAddr) -> Result<(), AccessError> {
        let mut hosts = headers.get_all(header::HOST).iter();
        let (Some(host), None) = (hosts.next(), hosts.next()) else {
            return Err(AccessError::HostCount);
        };
        let host = host.to_str().map_err(|_| AccessError::BadHost)?;
        // A request sent to a proxy also names the host in its first line, and that name takes precedence (RFC
        // 9112, 3.2.2).
        for text in [Some(host), uri.authority().map(|authority| authority.as_str())]
            .into_iter()
            .flatten()
        {
            let host = Host::parse(text).ok_or(AccessError::BadHost)?;
            if !self.hosts.contain(&host, local) {
                return Err(AccessError::OtherHost);
            }
        }
        Ok(())
    }
}

/// The scope that a token needs for this path; `None` for health checks, which need no token.
fn scope(path: &str) -> Option<Scope> {
    match path {
        "/healthz" | "/readyz" => None,
        "/metrics" => Some(Scope::Metrics),
        _ => Some(Scope::Read),
    }
}

/// The token that a request carries.
fn bearer(headers: &HeaderMap) -> Result<&str, AccessError> {
    let mut given = headers.get_all(header::AUTHORIZATION).iter();
    let (Some(given), None) = (given.next(), given.next()) else {
        return Err(AccessError::NoToken);
    };
    let (scheme, token) = given
        .to_str()
        .ok()
        .and_then(|text| text.split_once(' '))
        .ok_or(AccessError::NoToken)?;
    if scheme.eq_ignore_ascii_case("bearer") {
        Ok(token.trim())
    } else {
        Err(AccessError::NoToken)
    }
}

impl IntoResponse for AccessError {
    fn into_response(self) -> Response {
        let (status, challenge) = match &self {
            AccessError::HostCount | AccessError::BadHost => (StatusCode::BAD_REQUEST, None),
            AccessError::OtherHost => (StatusCode::MISDIRECTED_REQUEST, None),
            AccessError::NoToken => (StatusCode::UNAUTHORIZED, Some("Bearer realm=\"drivegate\"")),
            AccessError::UnknownToken => (
                StatusCode::UNAUTHORIZED,
                Some("Bearer realm=\"drivegate\", error=\"invalid_token\""),
            ),
            AccessError::MissingScope(_) => (
                StatusCode::FORBIDDEN,
                Some("Bearer realm=\"drivegate\", error=\"insufficient_scope\""),
            ),
        };
        let mut response = refused(status, self.to_string()).into_response();
        const CHALLENGE: HeaderName = header::WWW_AUTHENTICATE;
        response
            .headers_mut()
            .extend(challenge.map(|text| (CHALLENGE, HeaderValue::from_static(text))));
        response
    }
}
