//! A measuring rod: the least that a Modbus RTU master can do on a port. Write, read until the expected length, keep
//! 3.5 characters of silence, next.
//!
//! The bare master schedules nothing, retries nothing and accepts any reply. Its rate on a simulated line is what
//! operating system and pseudo-terminal leave of the wire's limit, and is therefore the reference for the rate of a
//! bus task.

use drivegate_line::{poll_until, sharpen_timers, wait_until};
use drivegate_proto::{Decoded, LineFormat, Request, rtu};
use rustix::event::{PollFd, PollFlags};
use std::fs::{File, OpenOptions};
use std::io::{self, ErrorKind, Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::time::{Duration, Instant};

/// Options of the measurement with the bare master.
#[derive(Debug, Clone, Copy)]
pub(crate) struct BareOptions {
    /// Baud rate and character format of the line.
    pub(crate) format: LineFormat,
    /// Silence between the end of a reply and the next request.
    pub(crate) silence: Duration,
    /// Time for a reply after the request's last character.
    pub(crate) timeout: Duration,
    /// Part of the silence during which the master spins on the clock instead of sleeping.
    pub(crate) spin: Duration,
}

/// The rate that the wire allows: request, 3.5 characters that mark its end, turnaround, reply, silence.
pub(crate) fn wire_limit(options: &BareOptions, request: &Request, turnaround: Duration) -> f64 {
    let characters = request.pdu.encoded_len() + request.pdu.reply_len() + 2 * rtu::OVERHEAD;
    let format = &options.format;
    let exchange = format.chars(characters) + format.silence_chars() + turnaround + options.silence;
    1.0 / exchange.as_secs_f64()
}

/// Sends `requests` in turn for `time`.
///
/// # Errors
/// If the port cannot be opened, or was lost.
pub(crate) fn run(port: &Path, options: &BareOptions, requests: &[Request], time: Duration) -> io::Result<()> {
    sharpen_timers();
    let flags = rustix::fs::OFlags::NOCTTY | rustix::fs::OFlags::NONBLOCK;
    let mut port = OpenOptions::new()
        .read(true)
        .write(true)
        .custom_flags(flags.bits() as i32)
        .open(port)?;
    let mut frame = Vec::new();
    let mut reply = Vec::with_capacity(512);
    let start = Instant::now();
    for request in requests.iter().cycle() {
        if start.elapsed() >= time {
            break;
        }
        frame.clear();
        rtu::encode_request(request, &mut frame);
        reply.clear();
        exchange(&mut port, options, request, &frame, &mut reply)?;
        wait_until(Instant::now() + options.silence, options.spin);
    }
    Ok(())
}

/// A transaction, which ends with a reply, a corrupt frame or the timeout: the transcript of the line has the bytes
/// received.
fn exchange(
    port: &mut File,
    options: &BareOptions,
    request: &Request,
    frame: &[u8],
    reply: &mut Vec<u8>,
) -> io::Result<()> {
    port.write_all(frame)?;
    let characters = frame.len() + request.pdu.reply_len() + rtu::OVERHEAD;
    let deadline = Instant::now() + options.format.chars(characters) + options.timeout;
    let mut buffer = [0u8; 256];
    loop {
        let mut fds = [PollFd::new(port, PollFlags::IN)];
        if !poll_until(&mut fds, deadline)? && Instant::now() >= deadline {
            return Ok(());
        }
        match port.read(&mut buffer) {
            Ok(0) => return Err(io::Error::new(ErrorKind::UnexpectedEof, "the port is gone")),
            Ok(count) => reply.extend_from_slice(buffer.get(..count).unwrap_or_default()),
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => continue,
            Err(error) => return Err(error),
        }
        match rtu::decode_reply(request, reply) {
            Decoded::Incomplete | Decoded::Foreign { .. } => {}
            Decoded::Reply { .. } | Decoded::Corrupt(_) => return Ok(()),
        }
    }
}
