//! A device server behind TCP: its port is set up over the network (`rfc2217://`), or is raw (`tcp://`), which its
//! first bytes confirm.

use std::cell::RefCell;
use std::net::{SocketAddr, TcpStream};
use std::os::fd::{AsFd, BorrowedFd};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags};

use super::first_bytes::{FirstBytes, Server};
use super::other_server::OtherServer;
use super::rfc2217::{Session, Settings, State, escape};
use super::{Lost, OpenError, poll_port, read, write_all};

/// Time limit for the server to agree and to set up its port.
const NEGOTIATION: Duration = Duration::from_secs(3);
/// Interval at which `go_on` of waiting callers is called.
const STEP: Duration = Duration::from_millis(100);

/// A raw TCP connection to a device server.
#[derive(Debug)]
pub(super) struct Raw {
    stream: TcpStream,
    opened: Instant,
    server: Option<SocketAddr>,
    /// The first bytes received; `None` once they are known to come from a line.
    first: RefCell<Option<FirstBytes>>,
    other: OtherServer,
}

impl Raw {
    /// Opens the connection; `other` is what earlier connections have shown about the server.
    ///
    /// # Errors
    /// If the server speaks Modbus TCP.
    pub(super) fn open(stream: TcpStream, port: &str, other: &OtherServer) -> Result<Raw, OpenError> {
        if other.is_found() && !other.is_gone(&stream) {
            return Err(OpenError::Remote {
                port: port.to_string(),
                reason: Server::ModbusTcp.words().to_string(),
            });
        }
        Ok(Raw {
            server: stream.peer_addr().ok(),
            stream,
            opened: Instant::now(),
            first: RefCell::new(Some(FirstBytes::default())),
            other: other.clone(),
        })
    }

    /// Passes a complete frame to the server.
    pub(super) fn send(&self, frame: &[u8]) -> Result<(), Lost> {
        if let Some(first) = self.first.borrow_mut().as_mut() {
            first.sent(frame);
            if first.is_empty() {
                self.other.nothing_came(&self.stream, self.opened, frame);
            }
        }
        write_all(self.stream.as_fd(), frame)
    }

    /// Reads the available data; returns 0 if there is none.
    ///
    /// # Errors
    /// If the port is lost, or is not a raw one: frames, stops among them, would never arrive.
    pub(super) fn receive(&self, buffer: &mut [u8]) -> Result<usize, Lost> {
        let count = read(self.stream.as_fd(), buffer).map_err(|lost| self.explained(lost))?;
        let mut first = self.first.borrow_mut();
        let Some(seen) = first.as_mut() else { return Ok(count) };
        match seen.received(buffer.get(..count).unwrap_or_default()) {
            None => Ok(count),
            Some(Server::Raw) => {
                *first = None;
                Ok(count)
            }
            Some(server) => {
                if server == Server::ModbusTcp {
                    self.other.recognised(seen.unit());
                }
                Err(Lost::new(server.words()))
            }
        }
    }
}

impl Raw {
    /// The reason for the loss, where another kind of server is known; a server that closed the connection at a request
    /// is checked.
    fn explained(&self, lost: Lost) -> Lost {
        if self.other.is_found() {
            return Lost::new(Server::ModbusTcp.words());
        }
        let first = self.first.borrow();
        let unit = first
            .as_ref()
            .filter(|first| first.is_empty())
            .and_then(FirstBytes::first_unit);
        if let Some((server, unit)) = self.server.zip(unit).filter(|_| lost.closed) {
            self.other.hung_up(server, unit);
        }
        lost
    }
}

impl AsFd for Raw {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.stream.as_fd()
    }
}

/// A connection by RFC 2217.
#[derive(Debug)]
pub(super) struct Remote {
    pub(super) stream: TcpStream,
    session: RefCell<Session>,
}

impl Remote {
    /// Makes the server set up its port; the returned texts are warnings.
    ///
    /// # Errors
    /// When the server cannot be set up, does not answer within three seconds, or `go_on` returned false.
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
                        "the device server does not confirm {missing}; check its settings"
                    )));
                }
            }
            let mut fds = [PollFd::from_borrowed_fd(remote.stream.as_fd(), PollFlags::IN)];
            poll_port(&mut fds, until.min(Instant::now() + STEP)).map_err(|lost| failed(lost.why))?;
            // Bytes received before the line was set up are dropped.
            remote.receive(&mut buffer).map_err(|lost| failed(lost.why))?;
        }
        let (took, asked) = (remote.session.borrow().took(), settings.format.to_string());
        let warnings = if took == asked {
            Vec::new()
        } else {
            vec![format!(
                "{port} reports {took} instead of {asked}; check that the device server supports it"
            )]
        };
        Ok((remote, warnings))
    }

    /// Passes a complete frame to the server.
    pub(super) fn send(&self, frame: &[u8]) -> Result<(), Lost> {
        write_all(self.stream.as_fd(), &escape(frame))
    }

    /// Reads the available data and answers the server's requests; 0 means no data.
    pub(super) fn receive(&self, buffer: &mut [u8]) -> Result<usize, Lost> {
        let count = read(self.stream.as_fd(), buffer)?;
        let mut data = Vec::with_capacity(count);
        let mut session = self.session.borrow_mut();
        let replies = session.take(buffer.get(..count).unwrap_or_default(), &mut data);
        if let State::Refused(why) = session.state() {
            return Err(Lost::new(*why));
        }
        write_all(self.stream.as_fd(), &replies)?;
        // Decoded data is never longer than the bytes that it was decoded from.
        for (place, byte) in buffer.iter_mut().zip(&data) {
            *place = *byte;
        }
        Ok(data.len())
    }
}
