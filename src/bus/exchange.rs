//! The reply of a request that is on the line: the I/O around a [`Transaction`].

use std::time::Instant;

use super::transaction::{Ended, Step, Transaction};
use crate::line::{Line, Lost, Woken};

/// Listens until the transaction, begun at `began`, has ended; `heard` is told of all bytes as they come.
///
/// # Errors
/// When the port is gone.
pub(super) fn await_reply(
    line: &Line,
    transaction: &mut Transaction<'_>,
    began: Instant,
    mut heard: impl FnMut(&[u8], Instant),
) -> Result<Ended, Lost> {
    let mut buffer = [0u8; 512];
    let mut step = transaction.on_time(began);
    loop {
        let until = match step {
            Step::Done(ended) => return Ok(ended),
            Step::Wait(until) => until,
        };
        let woken = line.wait(until, None, false)?;
        let now = Instant::now();
        step = match woken {
            Woken::Readable => {
                let count = line.receive(&mut buffer)?;
                let bytes = buffer.get(..count).unwrap_or_default();
                heard(bytes, now);
                transaction.on_bytes(now, bytes)
            }
            _ => transaction.on_time(now),
        };
    }
}
