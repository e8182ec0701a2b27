//! The endpoint by which a master reaches the simulated line: a pseudo-terminal, a real serial port, or a network port.

use drivegate_line::Pty;
use drivegate_proto::{LineFormat, Parity};
use rustix::event::{PollFd, PollFlags};
use rustix::fs::{FlockOperation, flock};
use rustix::termios::{ControlModes, OptionalActions, QueueSelector, ioctl_tiocexcl, tcflush, tcgetattr, tcsetattr};
use std::fs::{File, OpenOptions};
use std::io::{self, ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::os::fd::AsFd;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

mod network;

use network::Network;

/// The kind of endpoint by which a master reaches the line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum EndpointOptions {
    /// A pseudo-terminal, with a symbolic link that keeps its name.
    Pty {
        /// Path of the link; without a link, masters use the pseudo-terminal's own path.
        link: Option<PathBuf>,
    },
    /// A serial port on whose line the simulated drives sit.
    Port {
        /// Path of the port's device.
        path: PathBuf,
    },
    /// Raw serial over TCP, as a serial device server provides it. One master at a time.
    Tcp {
        /// Address to listen on; port 0 takes a free port.
        listen: SocketAddr,
    },
    /// Modbus TCP, as used by a drive with Ethernet on board. One client at a time.
    ModbusTcp {
        /// Address to listen on; port 0 takes a free port.
        listen: SocketAddr,
    },
    /// UDP: each datagram carries one frame of the line.
    Udp {
        /// Address to listen on; port 0 takes a free port.
        listen: SocketAddr,
    },
    /// The line dials in at a gateway, as a modem does.
    Dial {
        /// Address of the gateway to dial.
        server: SocketAddr,
        /// Text to send first after connecting.
        text: String,
    },
}

/// An open endpoint. All reading and writing is non-blocking.
#[derive(Debug)]
pub(super) enum Endpoint {
    Pty(Pty),
    Port(File, PathBuf),
    Tcp {
        listener: TcpListener,
        master: Option<TcpStream>,
    },
    Network(Network),
}

impl Endpoint {
    /// Opens the endpoint; `format` is set on a real serial port.
    pub(super) fn open(options: &EndpointOptions, format: &LineFormat) -> io::Result<Endpoint> {
        match options {
            EndpointOptions::Pty { link } => Pty::open(link.as_deref()).map(Endpoint::Pty),
            EndpointOptions::Port { path } => {
                let explain = |error: io::Error| {
                    let text = format!("cannot open the serial port {}: {error}", path.display());
                    io::Error::new(error.kind(), text)
                };
                open_port(path, format)
                    .map(|file| Endpoint::Port(file, path.clone()))
                    .map_err(explain)
            }
            EndpointOptions::Tcp { listen } => {
                let listener = TcpListener::bind(listen).map_err(|error| cannot_listen(*listen, error))?;
                listener.set_nonblocking(true)?;
                Ok(Endpoint::Tcp { listener, master: None })
            }
            EndpointOptions::ModbusTcp { listen } => Network::modbus_tcp(*listen)
                .map(Endpoint::Network)
                .map_err(|error| cannot_listen(*listen, error)),
            EndpointOptions::Udp { listen } => Network::udp(*listen)
                .map(Endpoint::Network)
                .map_err(|error| cannot_listen(*listen, error)),
            EndpointOptions::Dial { server, text } => Ok(Endpoint::Network(Network::dial(*server, text))),
        }
    }

    /// The port that a master opens: a path, or `tcp://host:port`.
    pub(super) fn address(&self) -> String {
        match self {
            Endpoint::Pty(pty) => pty.path().display().to_string(),
            Endpoint::Port(_, path) => path.display().to_string(),
            Endpoint::Tcp { listener, .. } => listener
                .local_addr()
                .map_or_else(|_| "tcp://?".to_string(), |address| format!("tcp://{address}")),
            Endpoint::Network(network) => network.address(),
        }
    }

    /// File descriptors to poll for input.
    pub(super) fn poll_fds(&self) -> Vec<PollFd<'_>> {
        let wanted = |fd| PollFd::from_borrowed_fd(fd, PollFlags::IN);
        match self {
            Endpoint::Pty(pty) => vec![wanted(pty.as_fd())],
            Endpoint::Port(file, _) => vec![wanted(file.as_fd())],
            Endpoint::Tcp { listener, master } => {
                let master = master.as_ref().map(|stream| wanted(stream.as_fd()));
                std::iter::once(wanted(listener.as_fd())).chain(master).collect()
            }
            Endpoint::Network(network) => network.poll_fds(),
        }
    }

    /// Receives bytes from the master; returns 0 if there are none.
    ///
    /// # Errors
    /// If the port no longer exists.
    pub(super) fn receive(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        match self {
            Endpoint::Pty(pty) => no_wait(pty.read(buffer)),
            Endpoint::Port(file, path) => match file.read(buffer) {
                // A port without data returns WouldBlock; end of file means that it was unplugged.
                Ok(0) => Err(io::Error::new(
                    ErrorKind::UnexpectedEof,
                    format!("{} is gone", path.display()),
                )),
                result => no_wait(result),
            },
            Endpoint::Tcp { listener, master } => {
                let count = receive_from(master, buffer);
                // A second connection is closed at once, unless the first has just ended.
                if let Ok((stream, _)) = listener.accept()
                    && master.is_none()
                    && stream.set_nonblocking(true).is_ok()
                    && stream.set_nodelay(true).is_ok()
                {
                    *master = Some(stream);
                }
                Ok(count)
            }
            Endpoint::Network(network) => Ok(network.receive(buffer)),
        }
    }

    /// Sends bytes to the master; returns how many bytes the master accepted.
    ///
    /// # Errors
    /// If the port no longer exists.
    pub(super) fn send(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self {
            Endpoint::Pty(pty) => no_wait(pty.write(bytes)),
            Endpoint::Port(file, _) => no_wait(file.write(bytes)),
            Endpoint::Tcp { master, .. } => {
                let Some(stream) = master else { return Ok(0) };
                let sent = no_wait(stream.write(bytes));
                if sent.is_err() {
                    *master = None;
                }
                Ok(sent.unwrap_or(0))
            }
            Endpoint::Network(network) => Ok(network.send(bytes)),
        }
    }

    /// Dials in, if the line does so and has no connection.
    pub(super) fn connect(&mut self) {
        if let Endpoint::Network(network) = self {
            network.connect();
        }
    }

    /// The line has been idle for a while.
    pub(super) fn settle(&self) {
        if let Endpoint::Pty(pty) = self {
            pty.settle();
        }
    }
}

fn cannot_listen(listen: SocketAddr, error: io::Error) -> io::Error {
    io::Error::new(error.kind(), format!("cannot listen on {listen}: {error}"))
}

/// Bytes of a connected master; an ended connection is forgotten.
fn receive_from(master: &mut Option<TcpStream>, buffer: &mut [u8]) -> usize {
    let Some(stream) = master else { return 0 };
    match stream.read(buffer) {
        Ok(count) if count > 0 => count,
        Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => 0,
        _ => {
            *master = None;
            0
        }
    }
}

fn no_wait(result: io::Result<usize>) -> io::Result<usize> {
    match result {
        Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => Ok(0),
        other => other,
    }
}

/// Opens a serial port in raw mode with this format, exclusively for this process.
fn open_port(path: &Path, format: &LineFormat) -> io::Result<File> {
    let flags = rustix::fs::OFlags::NOCTTY | rustix::fs::OFlags::NONBLOCK;
    let file = OpenOptions::new()
        .read(true)
        .write(true)
        .custom_flags(flags.bits() as i32)
        .open(path)?;
    flock(&file, FlockOperation::NonBlockingLockExclusive)?;
    ioctl_tiocexcl(&file)?;
    let mut attributes = tcgetattr(&file)?;
    attributes.make_raw();
    let modes = &mut attributes.control_modes;
    modes.insert(ControlModes::CREAD | ControlModes::CLOCAL);
    modes.remove(ControlModes::CSIZE | ControlModes::PARENB | ControlModes::PARODD | ControlModes::CSTOPB);
    modes.insert(if format.data_bits == 7 {
        ControlModes::CS7
    } else {
        ControlModes::CS8
    });
    match format.parity {
        Parity::None => {}
        Parity::Even => modes.insert(ControlModes::PARENB),
        Parity::Odd => modes.insert(ControlModes::PARENB | ControlModes::PARODD),
    }
    if format.stop_bits == 2 {
        modes.insert(ControlModes::CSTOPB);
    }
    attributes.set_speed(format.baud)?;
    tcsetattr(&file, OptionalActions::Now, &attributes)?;
    tcflush(&file, QueueSelector::IOFlush)?;
    Ok(file)
}
