//! A device server behind TCP: its port set up over the network (`rfc2217://`), and a telnet port that passes for a raw
//! one (`tcp://`) recognised by its first bytes.

use std::cell::{Cell, RefCell};
use std::net::TcpStream;
use std::os::fd::AsFd;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags};

use super::rfc2217::{Session, Settings, State, escape, is_greeting};
use super::{Lost, OpenError, poll_port, read, write_all};

/// Time for the server to agree and to set up its port.
const NEGOTIATION: Duration = Duration::from_secs(3);
/// Whoever waits is asked this often whether to go on.
const STEP: Duration = Duration::from_millis(100);

/// A raw connection.
#[derive(Debug)]
pub(super) struct Raw {
    pub(super) stream: TcpStream,
    /// The first bytes that came, up to three, and how many; `None` once it is known that they are no telnet.
    first: Cell<Option<([u8; 3], usize)>>,
}

impl Raw {
    pub(super) fn new(stream: TcpStream) -> Raw {
        Raw {
            stream,
            first: Cell::new(Some(([0; 3], 0))),
        }
    }

    /// Looks at bytes that came.
    ///
    /// # Errors
    /// When they are those of a telnet server. It would take a byte 255 in a request for a command and double it in a reply:
    /// frames with that byte, stops among them, would never arrive.
    pub(super) fn look_at(&self, bytes: &[u8]) -> Result<(), Lost> {
        let Some((mut first, mut count)) = self.first.get() else {
            return Ok(());
        };
        for (place, byte) in first.iter_mut().skip(count).zip(bytes) {
            *place = *byte;
            count += 1;
        }
        match is_greeting(first.get(..count).unwrap_or_default()) {
            None => self.first.set(Some((first, count))),
            Some(false) => self.first.set(None),
            Some(true) => {
                return Err(Lost::new(
                    "the device server speaks telnet on this port; write rfc2217:// instead of tcp://, or the server's raw TCP port",
                ));
            }
        }
        Ok(())
    }
}

/// A connection by RFC 2217.
#[derive(Debug)]
pub(super) struct Remote {
    pub(super) stream: TcpStream,
    session: RefCell<Session>,
}

impl Remote {
    /// Has the server set up its port; the texts are warnings.
    ///
    /// # Errors
    /// When the server cannot, does not within three seconds, or is not wanted any more.
    pub(super) fn open(
        stream: TcpStream,
        port: &str,
        settings: Settings,
        go_on: &dyn Fn() -> bool,
    ) -> Result<(Remote, Vec<String>), OpenError> {
        let failed = |reason: String| OpenError::Remote {
            port: port.to_string(),
            reason,
        };
        let (session, first) = Session::new(settings);
        let session = RefCell::new(session);
        let remote = Remote { stream, session };
        write_all(remote.stream.as_fd(), &first).map_err(|lost| failed(lost.why))?;
        let until = Instant::now() + NEGOTIATION;
        let mut buffer = [0; 512];
        loop {
            match remote.session.borrow().state() {
                State::Ready => break,
                State::Refused(why) => return Err(failed((*why).to_string())),
                State::Asked | State::Setting if go_on() && Instant::now() < until => {}
                State::Asked => {
                    return Err(failed(
                        "the server does not speak telnet with RFC 2217; write tcp:// if this is a raw port"
                            .to_string(),
                    ));
                }
                State::Setting => {
                    let missing = remote.session.borrow().missing();
                    return Err(failed(format!(
                        "the device server does not confirm {missing}; look at its settings"
                    )));
                }
            }
            let mut fds = [PollFd::from_borrowed_fd(remote.stream.as_fd(), PollFlags::IN)];
            poll_port(&mut fds, until.min(Instant::now() + STEP)).map_err(|lost| failed(lost.why))?;
            // What the line said before it was set up is of no use.
            remote.receive(&mut buffer).map_err(|lost| failed(lost.why))?;
        }
        let (took, asked) = (remote.session.borrow().took(), settings.format.to_string());
        let warnings = match took == asked {
            true => Vec::new(),
            false => vec![format!(
                "{port} reports {took} where {asked} was asked for; check that the device server can do it"
            )],
        };
        Ok((remote, warnings))
    }

    /// Gives a whole frame to the server.
    pub(super) fn send(&self, frame: &[u8]) -> Result<(), Lost> {
        write_all(self.stream.as_fd(), &escape(frame))
    }

    /// Reads the data that is there, answering what the server asks; 0 is nothing.
    pub(super) fn receive(&self, buffer: &mut [u8]) -> Result<usize, Lost> {
        let count = read(self.stream.as_fd(), buffer)?;
        let mut data = Vec::with_capacity(count);
        let mut session = self.session.borrow_mut();
        let replies = session.take(buffer.get(..count).unwrap_or_default(), &mut data);
        if let State::Refused(why) = session.state() {
            return Err(Lost::new(*why));
        }
        write_all(self.stream.as_fd(), &replies)?;
        // The data is never longer than what it was decoded from.
        for (place, byte) in buffer.iter_mut().zip(&data) {
            *place = *byte;
        }
        Ok(data.len())
    }
}
