//! The half-duplex wire: a serial port or a device server (raw serial over TCP, or RFC 2217), opened exclusively, with
//! waits precise to tens of microseconds.
//!
//! The port is opened through tokio-serial's builder and then driven by the bus's own thread with `ppoll`: the timer
//! of an async runtime ticks at a millisecond, which is longer than the silence of a frame at 38400 baud.

mod arrival;
mod clock;
mod datagram;
mod dial_in;
mod first_bytes;
mod mbap;
mod names;
mod options;
mod other_server;
mod pty;
mod receiver;
mod remote;
mod rfc2217;
mod rs485;
mod sys;

pub use arrival::Arrival;
use clock::WakeUps;
pub use clock::{poll_until, sharpen_timers, since_boot, wait_until};
use datagram::Datagrams;
use dial_in::Dialled;
pub use dial_in::{LONGEST_ID, split as split_dial_in};
use mbap::Mbap;
pub use names::Names;
pub use options::{Level, LineOptions, MOST_RTS_DELAY, Rs485, Spin};
pub use pty::Pty;
pub use receiver::Receiver;
use remote::{Raw, Remote};
pub use rfc2217::{ServedPort, escape as telnet_escaped};

use std::cell::{Cell, Ref};
use std::fmt;
use std::io;
use std::net::{TcpStream, UdpSocket};
use std::num::NonZeroUsize;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags};
use rustix::termios::{ControlModes, tcgetattr};
use tokio_serial::{DataBits, FlowControl, Parity as SerialParity, StopBits};

use drivegate_proto::{LineFormat, Parity};

/// Time to reach a device server at one address.
const CONNECT_TIMEOUT: Duration = Duration::from_millis(800);
/// Time after which a connection is lost whose other end has not acknowledged a request.
const UNACKNOWLEDGED: Duration = Duration::from_secs(5);

/// The port cannot be opened: the bus tries again with back-off.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// The path does not exist, is busy, is not a serial port, or may not be used.
    #[error("cannot open {port}: {reason}")]
    Serial {
        /// Path of the port.
        port: String,
        /// The system's error with the remedy.
        reason: String,
    },
    /// The device server cannot be reached.
    #[error("cannot reach {port}: {reason}; check address and port, and that the device server is on")]
    Tcp {
        /// Address of the device server.
        port: String,
        /// The system's error.
        reason: io::Error,
    },
    /// The device server answers, but cannot set up its port.
    #[error("cannot use {port}: {reason}")]
    Remote {
        /// Address of the device server.
        port: String,
        /// The reason with the remedy.
        reason: String,
    },
    /// Devices cannot connect to this address.
    #[error("cannot listen for {port}: {reason}; check the address, and which program has it")]
    Listen {
        /// Address to listen on.
        port: String,
        /// The system's error.
        reason: io::Error,
    },
    /// No device has dialled in.
    #[error("{port}: {reason}")]
    Nobody {
        /// Address to listen on.
        port: String,
        /// The reason with the remedy.
        reason: String,
    },
    /// The kernel cannot switch the direction of this port.
    #[error("{port}: the driver cannot switch RS-485 direction ({reason}); set rs485 = \"off\" or use another adapter")]
    Rs485 {
        /// Path of the port.
        port: String,
        /// The system's error.
        reason: io::Error,
    },
}

impl OpenError {
    /// Whether the connection was refused. A server that still closes the previous connection refuses a new one for
    /// a moment.
    pub fn is_refused(&self) -> bool {
        use io::ErrorKind::{ConnectionAborted, ConnectionRefused, ConnectionReset};
        let refused = [ConnectionAborted, ConnectionRefused, ConnectionReset];
        matches!(self, OpenError::Tcp { reason, .. } if refused.contains(&reason.kind()))
    }
}

/// The port is lost; the bus then closes it and opens it again.
#[derive(Debug, thiserror::Error)]
#[error("the port is lost: {why}")]
pub struct Lost {
    /// The system's error, as text.
    pub why: String,
    /// A device server closed its connection, which some do after each reply or after a pause.
    pub closed: bool,
}

impl Lost {
    /// The loss of a serial port: an adapter that is unplugged reads end of file.
    fn of_adapter(self) -> Lost {
        Lost { closed: false, ..self }
    }

    fn new(why: impl Into<String>) -> Lost {
        let (why, closed) = (why.into(), false);
        Lost { why, closed }
    }

    fn of(error: rustix::io::Errno) -> Lost {
        let closed = matches!(error, rustix::io::Errno::CONNRESET | rustix::io::Errno::PIPE);
        Lost {
            closed,
            ..Lost::new(error.to_string())
        }
    }
}

/// The event that ended a wait.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Woken {
    /// Bytes can be read, or the port has disappeared: a read shows which.
    Readable,
    /// A command arrived.
    Command,
    /// The time until which to wait has been reached.
    Time,
}

enum Port {
    Serial(Exclusive),
    Tcp(Raw),
    Rfc2217(Remote),
    ModbusTcp(Mbap),
    Udp(Datagrams),
    Dialled(Dialled),
}

/// The descriptor of a port, to wait for.
enum PortFd<'p> {
    Of(BorrowedFd<'p>),
    /// A socket, which is another one for each request.
    Socket(Ref<'p, UdpSocket>),
}

impl AsFd for PortFd<'_> {
    fn as_fd(&self) -> BorrowedFd<'_> {
        match self {
            PortFd::Of(fd) => *fd,
            PortFd::Socket(socket) => socket.as_fd(),
        }
    }
}

impl fmt::Debug for Port {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Port::Serial(_) => "Serial",
            Port::Tcp(_) => "Tcp",
            Port::Rfc2217(_) => "Rfc2217",
            Port::ModbusTcp(_) => "ModbusTcp",
            Port::Udp(_) => "Udp",
            Port::Dialled(_) => "Dialled",
        })
    }
}

/// An open line.
#[derive(Debug)]
pub struct Line {
    port: Port,
    wake_ups: Cell<WakeUps>,
    /// Whether the end of a precise wait is spun.
    spins: bool,
}

impl Line {
    /// Opens the port exclusively; the texts are warnings.
    ///
    /// # Errors
    /// When the port cannot be opened or does not support the settings.
    pub fn open(port: &str, format: &LineFormat, options: &LineOptions) -> Result<(Line, Vec<String>), OpenError> {
        Line::open_by(&mut Names::default(), port, format, options, &|| true)
    }

    /// Opens a port like [`Line::open`], for callers that open one repeatedly: `names` remembers the addresses of a
    /// device server, and `go_on`, called at least once a second, returns whether the port is still needed.
    ///
    /// # Errors
    /// If the port cannot be opened; see [`Line::open`].
    pub fn open_by(
        names: &mut Names,
        port: &str,
        format: &LineFormat,
        options: &LineOptions,
        go_on: &dyn Fn() -> bool,
    ) -> Result<(Line, Vec<String>), OpenError> {
        let (opened, warnings) = match port.split_once("://") {
            Some(("tcp", address)) => {
                let stream = connect(names, port, address, go_on)?;
                (Port::Tcp(Raw::open(stream, port, &names.other)?), Vec::new())
            }
            Some(("rfc2217", address)) => {
                let stream = connect(names, port, address, go_on)?;
                let LineOptions { rts, dtr, .. } = *options;
                let settings = rfc2217::Settings {
                    format: *format,
                    rts,
                    dtr,
                };
                let (remote, warnings) = Remote::open(stream, port, settings, go_on)?;
                (Port::Rfc2217(remote), warnings)
            }
            Some(("modbus-tcp", address)) => {
                let stream = connect(names, port, address, go_on)?;
                (Port::ModbusTcp(Mbap::new(stream)), Vec::new())
            }
            Some(("udp", address)) => {
                let datagrams = Datagrams::open(names, port, address, go_on)?;
                (Port::Udp(datagrams), Vec::new())
            }
            Some(("tcp-listen", place)) => (Port::Dialled(Dialled::wait(names, port, place, go_on)?), Vec::new()),
            _ => {
                let (fd, warnings) = open_serial(port, format, options)?;
                (Port::Serial(fd), warnings)
            }
        };
        let processors = std::thread::available_parallelism().map_or(1, NonZeroUsize::get);
        let line = Line {
            port: opened,
            wake_ups: Cell::new(WakeUps::new()),
            spins: options.spin.holds(processors),
        };
        if matches!(line.port, Port::Serial(_)) {
            line.clear();
        }
        Ok((line, warnings))
    }

    fn fd(&self) -> PortFd<'_> {
        PortFd::Of(match &self.port {
            Port::Serial(fd) => fd.as_fd(),
            Port::Tcp(raw) => raw.as_fd(),
            Port::Rfc2217(remote) => remote.stream.as_fd(),
            Port::ModbusTcp(mbap) => mbap.as_fd(),
            Port::Udp(datagrams) => return PortFd::Socket(datagrams.socket()),
            Port::Dialled(dialled) => dialled.as_fd(),
        })
    }

    /// Passes a complete frame to the port, without waiting until it is on the wire.
    ///
    /// # Errors
    /// If the port has disappeared or does not accept the frame within 100 ms.
    pub fn send(&self, frame: &[u8]) -> Result<(), Lost> {
        match &self.port {
            Port::Serial(fd) => write_all(fd.as_fd(), frame).map_err(Lost::of_adapter),
            Port::Tcp(raw) => raw.send(frame),
            Port::Rfc2217(remote) => remote.send(frame),
            Port::ModbusTcp(mbap) => mbap.send(frame),
            Port::Udp(datagrams) => datagrams.send(frame),
            Port::Dialled(dialled) => dialled.send(frame),
        }
    }

    /// Reads the available bytes without waiting; returns 0 if there are none.
    ///
    /// # Errors
    /// If the port is lost (an unplugged adapter reads end of file or EIO), or turns out not to be a raw port.
    pub fn receive(&self, buffer: &mut [u8]) -> Result<usize, Lost> {
        match &self.port {
            Port::Serial(fd) => read(fd.as_fd(), buffer).map_err(Lost::of_adapter),
            Port::Tcp(raw) => raw.receive(buffer),
            Port::Rfc2217(remote) => remote.receive(buffer),
            Port::ModbusTcp(mbap) => mbap.receive(buffer),
            Port::Udp(datagrams) => datagrams.receive(buffer),
            Port::Dialled(dialled) => dialled.receive(buffer),
        }
    }

    /// Waits for bytes, for a command where `wake` is given, or for the time. The end of the wait is met to some ten
    /// microseconds when `precise`, unless the line does not spin.
    ///
    /// # Errors
    /// When the system refuses to wait, which only a closed descriptor can cause.
    pub fn wait(&self, until: Instant, wake: Option<BorrowedFd<'_>>, precise: bool) -> Result<Woken, Lost> {
        let precise = precise && self.spins;
        let spin = if precise {
            self.wake_ups.get().spin()
        } else {
            Duration::ZERO
        };
        let asleep = until.checked_sub(spin).unwrap_or(until);
        let mut sleeps = precise && Instant::now() < asleep;
        let fd = self.fd();
        let port = || PollFd::from_borrowed_fd(fd.as_fd(), PollFlags::IN);
        while Instant::now() < until {
            let woken = match wake {
                None => poll_port(&mut [port()], asleep)?.then_some(Woken::Readable),
                Some(wake) => {
                    let mut fds = [port(), PollFd::from_borrowed_fd(wake, PollFlags::IN)];
                    let ready = poll_port(&mut fds, asleep)?;
                    let [port, _] = fds.map(|fd| !fd.revents().is_empty());
                    ready.then_some(if port { Woken::Readable } else { Woken::Command })
                }
            };
            if let Some(woken) = woken {
                return Ok(woken);
            }
            if std::mem::take(&mut sleeps) {
                let mut wake_ups = self.wake_ups.get();
                if let Some(late) = Instant::now().checked_duration_since(asleep) {
                    wake_ups.note(late);
                    self.wake_ups.set(wake_ups);
                }
            }
        }
        Ok(Woken::Time)
    }
}

/// A serial port that was opened exclusively.
struct Exclusive(OwnedFd);

impl AsFd for Exclusive {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }
}

impl Drop for Exclusive {
    /// The kernel keeps the exclusive mode of a port until its last descriptor is closed and all is sent; until then
    /// opening it again fails as busy.
    fn drop(&mut self) {
        if let Err(error) = rustix::termios::ioctl_tiocnxcl(&self.0) {
            // The adapter may have been unplugged.
            tracing::debug!(target: "drivegate::line", "the exclusive mode of the port was not released: {error}");
        }
    }
}

/// Writes all bytes to a non-blocking port.
fn write_all(port: BorrowedFd<'_>, mut bytes: &[u8]) -> Result<(), Lost> {
    let deadline = Instant::now() + Duration::from_millis(100);
    while !bytes.is_empty() {
        match rustix::io::write(port, bytes) {
            Ok(taken) => bytes = bytes.get(taken..).unwrap_or_default(),
            Err(rustix::io::Errno::INTR) => {}
            Err(rustix::io::Errno::AGAIN) => {
                if Instant::now() >= deadline {
                    return Err(Lost::new("it accepts no more bytes"));
                }
                poll_port(&mut [PollFd::from_borrowed_fd(port, PollFlags::OUT)], deadline)?;
            }
            Err(error) => return Err(Lost::of(error)),
        }
    }
    Ok(())
}

/// Reads the available bytes; returns 0 if there are none.
fn read(port: BorrowedFd<'_>, buffer: &mut [u8]) -> Result<usize, Lost> {
    match rustix::io::read(port, buffer) {
        Ok(0) => Err(Lost {
            closed: true,
            ..Lost::new("it reads end of file")
        }),
        Ok(count) => Ok(count),
        Err(rustix::io::Errno::AGAIN | rustix::io::Errno::INTR) => Ok(0),
        Err(error) => Err(Lost::of(error)),
    }
}

/// Waits for a command, for the time, or for the device, without a port to listen to; returns whether the device
/// may have appeared.
pub fn wait_without_port(until: Instant, wake: BorrowedFd<'_>, arrival: Option<&Arrival>) -> bool {
    let readable = |fd| PollFd::from_borrowed_fd(fd, PollFlags::IN);
    // An error ends the wait early, which is harmless.
    let _ = match arrival {
        None => poll_until(&mut [readable(wake)], until),
        Some(arrival) => poll_until(&mut [readable(wake), readable(arrival.fd())], until),
    };
    arrival.is_some_and(Arrival::take)
}

fn poll_port(fds: &mut [PollFd<'_>], until: Instant) -> Result<bool, Lost> {
    poll_until(fds, until).map_err(|error| Lost::new(error.to_string()))
}

fn connect(names: &mut Names, port: &str, address: &str, go_on: &dyn Fn() -> bool) -> Result<TcpStream, OpenError> {
    let failed = |reason| OpenError::Tcp {
        port: port.to_string(),
        reason,
    };
    let mut last = io::ErrorKind::Interrupted.into();
    for address in names.addresses(address, go_on).map_err(failed)? {
        if !go_on() {
            break;
        }
        match TcpStream::connect_timeout(&address, CONNECT_TIMEOUT) {
            Ok(stream) => {
                stream.set_nodelay(true).map_err(failed)?;
                // A server without power does not answer; the system would keep trying for a quarter of an hour.
                let patience = rustix::net::sockopt::set_tcp_user_timeout(&stream, UNACKNOWLEDGED.as_millis() as u32);
                patience.map_err(|error| failed(error.into()))?;
                stream.set_nonblocking(true).map_err(failed)?;
                return Ok(stream);
            }
            Err(error) => last = error,
        }
    }
    Err(failed(last))
}

fn open_serial(port: &str, format: &LineFormat, options: &LineOptions) -> Result<(Exclusive, Vec<String>), OpenError> {
    let parity = match format.parity {
        Parity::None => SerialParity::None,
        Parity::Even => SerialParity::Even,
        Parity::Odd => SerialParity::Odd,
    };
    let tty = tokio_serial::new(port, format.baud)
        .data_bits(if format.data_bits == 7 {
            DataBits::Seven
        } else {
            DataBits::Eight
        })
        .parity(parity)
        .stop_bits(if format.stop_bits == 2 {
            StopBits::Two
        } else {
            StopBits::One
        })
        .flow_control(FlowControl::None)
        .exclusive(true)
        .open_native()
        .map_err(|error| OpenError::Serial {
            port: port.to_string(),
            reason: explain(&error, port),
        })?;
    let fd = Exclusive(sys::own(tty));
    let serial = |reason: io::Error| OpenError::Serial {
        port: port.to_string(),
        reason: reason.to_string(),
    };
    rustix::fs::fcntl_setfl(&fd, rustix::fs::OFlags::NONBLOCK).map_err(|e| serial(e.into()))?;
    let mut warnings = Vec::new();
    if options.rs485 != Rs485::Off {
        let differences =
            rs485::enable(options, |request| sys::set_rs485(&fd, request)).map_err(|reason| OpenError::Rs485 {
                port: port.to_string(),
                reason,
            })?;
        if !differences.is_empty() {
            warnings.push(format!(
                "{port}: the driver does not support all configured RS-485 settings: {}",
                differences.join("; ")
            ));
        }
    }
    if let Err(error) = sys::set_levels(&fd, options.rts, options.dtr)
        && !options.receives_only
    {
        return Err(OpenError::Serial {
            port: port.to_string(),
            reason: format!("the driver cannot set RTS and DTR ({error}); leave `rts` and `dtr` out"),
        });
    }
    if let Err(error) = sys::low_latency(&fd) {
        tracing::debug!(target: "drivegate::line", port, "no low-latency mode: {error}");
    }
    if let Some(read_back) = read_back(&fd).filter(|f| f != &format.to_string()) {
        warnings.push(format!(
            "{port} reports {read_back} instead of {format}; check that the adapter supports it"
        ));
    }
    Ok((fd, warnings))
}

impl Line {
    /// Discards bytes that were received before the gateway used the line.
    fn clear(&self) {
        let mut buffer = [0u8; 512];
        while matches!(self.receive(&mut buffer), Ok(count) if count > 0) {}
    }
}

/// The character format that the port reports.
fn read_back(fd: &Exclusive) -> Option<String> {
    let modes = tcgetattr(fd).ok()?;
    let data = if modes.control_modes.contains(ControlModes::CS8) {
        8
    } else {
        7
    };
    let parity = match (
        modes.control_modes.contains(ControlModes::PARENB),
        modes.control_modes.contains(ControlModes::PARODD),
    ) {
        (false, _) => 'N',
        (true, false) => 'E',
        (true, true) => 'O',
    };
    let stop = if modes.control_modes.contains(ControlModes::CSTOPB) {
        2
    } else {
        1
    };
    Some(format!("{} {data}{parity}{stop}", modes.output_speed()))
}

/// The reason for a port that another program has locked; more follows.
pub const TAKEN: &str = "another program has it";

fn explain(error: &tokio_serial::Error, port: &str) -> String {
    let text = error.to_string();
    let remedy = match error.kind() {
        tokio_serial::ErrorKind::Io(io::ErrorKind::NotFound) => {
            "check that the adapter is plugged in and the path is right"
        }
        tokio_serial::ErrorKind::Io(io::ErrorKind::PermissionDenied) => {
            "add the user to the group of the port (dialout)"
        }
        // A lock, or the kernel's exclusive mode.
        tokio_serial::ErrorKind::NoDevice | tokio_serial::ErrorKind::Io(io::ErrorKind::WouldBlock) => {
            return format!(
                "{text}; {TAKEN}; end that program (`sudo fuser -v {port}` names it), or use another port for this bus"
            );
        }
        _ => {
            "it is not a serial port or does not work as one; give the path of the adapter, such as \
            /dev/serial/by-id/…"
        }
    };
    format!("{text}; {remedy}")
}
