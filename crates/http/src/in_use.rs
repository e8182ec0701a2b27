//! A connection is in use from the moment its request is complete until its reply is produced; an event stream is in use
//! until it ends. A client that does not read its replies does not keep a connection in use.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Instant;

use hyper::body::{Body, Frame, SizeHint};

use drivegate_north::connection_limit::ConnectionPlace;

/// Marks a connection as in use until this is dropped.
#[derive(Debug)]
pub(super) struct InUse(Arc<ConnectionPlace>);

impl InUse {
    pub(super) fn new(place: Arc<ConnectionPlace>) -> InUse {
        place.use_at(Instant::now(), true);
        InUse(place)
    }

    /// A body that keeps the connection in use until its end.
    pub(super) fn until_end_of<B>(self, body: B) -> InUseBody<B> {
        InUseBody { body, _in_use: self }
    }
}

impl Drop for InUse {
    fn drop(&mut self) {
        self.0.use_at(Instant::now(), false);
    }
}

/// The body of a reply, which keeps the connection in use.
#[derive(Debug)]
pub(super) struct InUseBody<B> {
    body: B,
    _in_use: InUse,
}

impl<B: Body + Unpin> Body for InUseBody<B> {
    type Data = B::Data;
    type Error = B::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Self::Data>, Self::Error>>> {
        Pin::new(&mut self.body).poll_frame(context)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}
