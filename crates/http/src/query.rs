//! Parses the query of a request: `?name=value&…`. Pure.

use std::collections::HashSet;
use std::time::{Duration, SystemTime};

use axum::Json;
use axum::http::StatusCode;
use axum::response::IntoResponse;
use percent_encoding::percent_decode_str;

use super::messages::ErrorReply;
use super::replies::Refused;
use drivegate_model::document::parse_duration;

/// Why a query string is not valid.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(super) enum QueryError {
    #[error("unknown parameter `{0}`")]
    Unknown(String, &'static [&'static str]),
    #[error("`{0}` is given twice")]
    Twice(&'static str),
    #[error("`{name}={value}` is invalid: {expected}")]
    Value {
        name: &'static str,
        value: String,
        expected: &'static str,
    },
}

impl From<QueryError> for Refused {
    fn from(error: QueryError) -> Refused {
        let known = match &error {
            QueryError::Unknown(_, known) => known.iter().map(|name| (*name).to_string()).collect(),
            _ => Vec::new(),
        };
        let error = error.to_string();
        let reply = (StatusCode::BAD_REQUEST, Json(ErrorReply { error, known }));
        reply.into_response().into()
    }
}

/// The values of the parameters `known`, in their order; an empty value counts as absent.
///
/// # Errors
/// If an unknown parameter is given, or a known one twice.
pub(super) fn parameters<const N: usize>(
    query: Option<&str>,
    known: &'static [&'static str; N],
) -> Result<[Option<String>; N], QueryError> {
    let mut values = [const { None }; N];
    for pair in query.unwrap_or_default().split('&').filter(|pair| !pair.is_empty()) {
        let (name, value) = pair.split_once('=').unwrap_or((pair, ""));
        let place = known.iter().position(|known| *known == name);
        let slot = place.and_then(|place| Some((known.get(place)?, values.get_mut(place)?)));
        let (name, slot) = slot.ok_or_else(|| QueryError::Unknown(name.to_string(), known))?;
        let value = value.replace('+', " ");
        let value = percent_decode_str(&value).decode_utf8_lossy().into_owned();
        if !value.is_empty() && slot.replace(value).is_some() {
            return Err(QueryError::Twice(name));
        }
    }
    Ok(values)
}

/// The names in a list such as `points=ready,running`; `None` without this parameter. Other parameters are ignored.
pub(super) fn names(query: Option<&str>, parameter: &str) -> Option<HashSet<String>> {
    let pairs = query.unwrap_or_default().split('&');
    let value = pairs
        .filter_map(|pair| pair.split_once('='))
        .find(|(name, _)| *name == parameter);
    let (_, value) = value?;
    let value = percent_decode_str(value).decode_utf8_lossy();
    let names = value.split(',').filter(|name| !name.is_empty());
    Some(names.map(str::to_string).collect())
}

/// A time: RFC 3339 in UTC, seconds since 1970, or an age such as `10min`.
///
/// # Errors
/// If the text is not a time in one of these forms.
pub(super) fn time(name: &'static str, value: &str, now: SystemTime) -> Result<SystemTime, QueryError> {
    let seconds = || {
        let seconds: f64 = value.parse().ok()?;
        let since = Duration::try_from_secs_f64(seconds).ok()?;
        SystemTime::UNIX_EPOCH.checked_add(since)
    };
    let age = || now.checked_sub(parse_duration(value).ok()?);
    let at = seconds().or_else(|| humantime::parse_rfc3339(value).ok()).or_else(age);
    let at = at.map(|at| at.max(SystemTime::UNIX_EPOCH));
    at.ok_or_else(|| QueryError::Value {
        name,
        value: value.to_string(),
        expected: "a time is RFC 3339 in UTC (2026-03-01T12:00:00Z), seconds since 1970, or an age such as 10min or 24h",
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const KNOWN: &[&str; 2] = &["bus", "from"];

    #[test]
    fn names_and_values() {
        let of = |query: &str| parameters(Some(query), KNOWN);
        assert_eq!(parameters(None, KNOWN), Ok([None, None]));
        assert_eq!(of("bus="), Ok([None, None]));
        assert_eq!(of("&from=1%20h&"), Ok([None, Some("1 h".to_string())]));
        assert_eq!(of("from=1+h&bus=line1").unwrap()[1].as_deref(), Some("1 h"));
        assert!(of("bus=%ff").is_ok(), "not a name, but valid");
        assert_eq!(of("bus=a&bus=b"), Err(QueryError::Twice("bus")));
        let unknown = of("line=1").unwrap_err();
        assert_eq!(unknown.to_string(), "unknown parameter `line`");
        let reply = Refused::from(unknown).into_response();
        assert_eq!(reply.status(), StatusCode::BAD_REQUEST);
    }

    #[test]
    fn lists_of_names() {
        let of = |query: &str| names(Some(query), "points");
        assert_eq!(names(None, "points"), None);
        assert_eq!(of("point=a"), None);
        assert_eq!(of("points="), Some(HashSet::new()));
        assert_eq!(
            of("_=1&points=a,b%2Cc"),
            Some(["a", "b", "c"].map(str::to_string).into())
        );
    }

    #[test]
    fn times() {
        let now = SystemTime::UNIX_EPOCH + Duration::from_secs(1_800_000_000);
        let of = |text: &str| time("from", text, now);
        assert_eq!(of("10min"), Ok(now - Duration::from_secs(600)));
        assert_eq!(of("1800000000"), Ok(now));
        assert_eq!(of("1799999999.5"), Ok(now - Duration::from_millis(500)));
        assert_eq!(of("2027-01-15T08:00:00Z"), Ok(now));
        assert_eq!(of("9999999999999h"), Ok(SystemTime::UNIX_EPOCH));
        for wrong in ["yesterday", "-1", "NaN", "1e300", "10 parsecs", "99999999999999999999h"] {
            let error = of(wrong).unwrap_err().to_string();
            assert!(error.contains(wrong) && error.contains("10min"), "{error}");
        }
    }
}
