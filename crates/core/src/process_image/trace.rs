//! The frames on a line, for subscribers; costs nothing without subscribers.

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use tokio::sync::broadcast;

/// Number of frames that wait for a listener. A listener that lags further behind loses the oldest ones.
const IN_FLIGHT: usize = 1024;

/// The direction of a frame on the line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Direction {
    /// From the gateway to a drive.
    Request,
    /// From a drive to the gateway.
    Reply,
}

/// A frame, or bytes that are not a frame.
#[derive(Debug, Clone, PartialEq)]
pub struct FrameRecord {
    /// Time of a request: when the port accepted it. Time of a reply: when its last byte arrived. Time of a
    /// timeout: when the reply was given up.
    pub time: SystemTime,
    /// Time from the end of the previous frame (for the first one: the opening of the port) to the start of this
    /// one; `None` if nothing arrived. Ends of requests and starts of replies are calculated from the wire time.
    pub gap: Option<Duration>,
    /// Sender of the frame.
    pub direction: Direction,
    /// The drive of the transaction; `None` for bytes between two transactions.
    pub drive: Option<String>,
    /// The bytes on the wire; empty if nothing arrived.
    pub bytes: Vec<u8>,
    /// The bytes in plain words ([`drivegate_proto::describe`]).
    pub decode: String,
    /// The result: empty for a request, then `ok`, `exception 02 …`, `corrupt: …`, `foreign`, `echo`, `timeout`.
    pub verdict: String,
}

/// The trace of the frames on one line.
#[derive(Debug, Clone)]
pub struct Trace(broadcast::Sender<Arc<FrameRecord>>);

impl Default for Trace {
    fn default() -> Self {
        Trace(broadcast::channel(IN_FLIGHT).0)
    }
}

impl Trace {
    /// Whether anyone has subscribed to the trace.
    pub fn has_listener(&self) -> bool {
        self.0.receiver_count() > 0
    }

    /// Publishes a frame to the listeners; the record is only built when there are any.
    pub fn publish(&self, record: impl FnOnce() -> FrameRecord) {
        if self.has_listener() {
            // The last subscriber may have left meanwhile, which is not an error.
            let _ = self.0.send(Arc::new(record()));
        }
    }

    /// Receives all frames from now on.
    pub fn subscribe(&self) -> broadcast::Receiver<Arc<FrameRecord>> {
        self.0.subscribe()
    }
}
