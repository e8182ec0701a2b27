//! The line of one bus at an address: which devices may have it, and the connections of its device.

use std::net::{IpAddr, TcpStream};
use std::time::Instant;

use ipnet::IpNet;

use super::{KEPT, hang_up};

/// The entry of one bus's line.
pub(super) struct Entry {
    pub(super) id: Vec<u8>,
    pub(super) allow: Vec<IpNet>,
    /// Number of buses that have this line: for a moment of a reload it may be the old and the new one.
    pub(super) buses: usize,
    /// When the last of them ended.
    pub(super) free_since: Instant,
    /// A connection that the line's bus has not taken yet.
    pub(super) waiting: Option<TcpStream>,
    /// The connection that the line's bus serves.
    pub(super) served: Option<TcpStream>,
}

impl Entry {
    /// The device of this line has dialled in, for the first time or again.
    pub(super) fn take(&mut self, stream: TcpStream) {
        let before = self.served.take().into_iter().chain(self.waiting.take());
        before.for_each(hang_up);
        self.waiting = Some(stream);
    }

    pub(super) fn is_wanted(&self) -> bool {
        self.buses > 0
    }

    pub(super) fn allows(&self, from: IpAddr) -> bool {
        self.allow.iter().any(|net| net.contains(&from))
    }

    /// Whether the other end of the connection may dial in. A connection without another end may not.
    fn allows_peer(&self, stream: &TcpStream) -> bool {
        stream
            .peer_addr()
            .is_ok_and(|from| self.allows(from.ip().to_canonical()))
    }

    /// Another bus has the line now, with this `allow`. A device that it does not allow is hung up on.
    pub(super) fn begin(&mut self, allow: &[IpNet]) {
        self.allow = allow.to_vec();
        self.buses += 1;
        let (waiting, served) = (self.waiting.take(), self.served.take());
        self.waiting = waiting.and_then(|stream| self.kept_if_allowed(stream));
        self.served = served.and_then(|stream| self.kept_if_allowed(stream));
    }

    /// The connection if its device may dial in; otherwise the device is hung up on.
    pub(super) fn kept_if_allowed(&self, stream: TcpStream) -> Option<TcpStream> {
        if self.allows_peer(&stream) {
            return Some(stream);
        }
        let from = stream
            .peer_addr()
            .map_or_else(|error| error.to_string(), |from| from.to_string());
        tracing::warn!(target: "drivegate::line::dial_in", %from, "hung up on a device that its bus does not allow to dial in any more");
        hang_up(stream);
        None
    }

    /// Whether the bus of this line ended so long ago that no reload brings it back. Its device is hung up on then, so
    /// that it dials in again.
    pub(super) fn is_over(&mut self, now: Instant) -> bool {
        let is_over = !self.is_wanted() && now.saturating_duration_since(self.free_since) > KEPT;
        if is_over {
            let left = self.served.take().into_iter().chain(self.waiting.take());
            left.for_each(hang_up);
        }
        is_over
    }
}
