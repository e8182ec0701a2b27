//! Reads the body of a request, within limits of size and time.

use std::time::{Duration, Instant};

use axum::body::{Body, Bytes, to_bytes};
use axum::extract::{FromRequest, Request};
use axum::http::StatusCode;
use tokio::time::timeout;

use super::reached::Reached;
use super::replies::{Refused, Replied, refused};
use drivegate_north::command_json::MAX_PAYLOAD;

/// Time limit for the body of a request, counted from the end of its head.
const TIMEOUT: Duration = Duration::from_secs(5);

/// A body, as an argument of a handler.
pub(super) struct Payload(pub(super) Bytes);

impl<S: Sync> FromRequest<S> for Payload {
    type Rejection = Refused;

    async fn from_request(request: Request, _: &S) -> Replied<Payload> {
        let (parts, body) = request.into_parts();
        Ok(Payload(read(body, &Reached::of(&parts)?, MAX_PAYLOAD).await?))
    }
}

/// Reads a body of at most `most` bytes. While the body is incomplete, the connection does not count as in use and
/// yields to others.
///
/// # Errors
/// If the body is too long, incomplete or too slow: contains the reply.
pub(super) async fn read(body: Body, reached: &Reached, most: usize) -> Replied<Bytes> {
    let in_use = |in_use| {
        if let Some(place) = &reached.place {
            place.use_at(Instant::now(), in_use);
        }
    };
    in_use(false);
    let read = timeout(TIMEOUT, to_bytes(body, most)).await;
    in_use(true);
    let (status, error) = match read {
        Ok(Ok(bytes)) => return Ok(bytes),
        Ok(Err(_)) => (
            StatusCode::PAYLOAD_TOO_LARGE,
            format!("the body has more than {most} bytes, or is incomplete"),
        ),
        Err(_) => (
            StatusCode::REQUEST_TIMEOUT,
            format!("the body did not arrive within {} s", TIMEOUT.as_secs()),
        ),
    };
    Err(refused(status, error))
}
