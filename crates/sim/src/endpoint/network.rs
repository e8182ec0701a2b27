//! The simulated line on a network: Modbus TCP, datagrams, and a modem that dials in.

use std::io::{self, Write};
use std::net::{SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::os::fd::AsFd;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags};

use super::no_wait;
use drivegate_proto::rtu;

/// Header of a Modbus TCP frame without the unit id.
const HEADER: usize = 6;
/// Longest wait for a connection, and the pause between two tries.
const CONNECT: (Duration, Duration) = (Duration::from_millis(200), Duration::from_secs(1));

/// A simulated line that is reached over a network.
#[derive(Debug)]
pub(crate) struct Network {
    way: Way,
    /// Bytes of a request that is not complete yet.
    received: Vec<u8>,
    /// Bytes that the line has answered so far.
    answered: Vec<u8>,
}

#[derive(Debug)]
enum Way {
    ModbusTcp {
        listener: TcpListener,
        client: Option<TcpStream>,
        /// Transaction id of the request on the line.
        id: [u8; 2],
    },
    Udp {
        socket: UdpSocket,
        client: Option<SocketAddr>,
    },
    Dial {
        server: SocketAddr,
        text: String,
        stream: Option<TcpStream>,
        tried: Option<Instant>,
    },
}

impl Network {
    fn new(way: Way) -> Network {
        Network {
            way,
            received: Vec::new(),
            answered: Vec::new(),
        }
    }

    pub(crate) fn modbus_tcp(listen: SocketAddr) -> io::Result<Network> {
        let listener = TcpListener::bind(listen)?;
        listener.set_nonblocking(true)?;
        Ok(Network::new(Way::ModbusTcp {
            listener,
            client: None,
            id: [0; 2],
        }))
    }

    pub(crate) fn udp(listen: SocketAddr) -> io::Result<Network> {
        let socket = UdpSocket::bind(listen)?;
        socket.set_nonblocking(true)?;
        Ok(Network::new(Way::Udp { socket, client: None }))
    }

    pub(crate) fn dial(server: SocketAddr, text: &str) -> Network {
        Network::new(Way::Dial {
            server,
            text: text.to_string(),
            stream: None,
            tried: None,
        })
    }

    /// The port that a master configures for this network.
    pub(crate) fn address(&self) -> String {
        let at = |scheme: &str, address: io::Result<SocketAddr>| {
            address.map_or_else(|_| format!("{scheme}://?"), |address| format!("{scheme}://{address}"))
        };
        match &self.way {
            Way::ModbusTcp { listener, .. } => at("modbus-tcp", listener.local_addr()),
            Way::Udp { socket, .. } => at("udp", socket.local_addr()),
            Way::Dial { server, text, .. } if text.is_empty() => format!("tcp-listen://{server}"),
            Way::Dial { server, text, .. } => format!("tcp-listen://{server}?id={text}"),
        }
    }

    pub(crate) fn poll_fds(&self) -> Vec<PollFd<'_>> {
        let fds = match &self.way {
            Way::ModbusTcp { listener, client, .. } => {
                let client = client.as_ref().map(AsFd::as_fd);
                std::iter::once(listener.as_fd()).chain(client).collect()
            }
            Way::Udp { socket, .. } => vec![socket.as_fd()],
            Way::Dial { stream, .. } => stream.iter().map(AsFd::as_fd).collect(),
        };
        fds.into_iter()
            .map(|fd| PollFd::from_borrowed_fd(fd, PollFlags::IN))
            .collect()
    }

    /// Connects to the server, if this endpoint is the one that dials and has no connection.
    pub(crate) fn connect(&mut self) {
        if let Way::Dial {
            server,
            text,
            stream: stream @ None,
            tried,
        } = &mut self.way
            && tried.is_none_or(|tried| tried.elapsed() >= CONNECT.1)
        {
            *tried = Some(Instant::now());
            *stream = dialled(*server, text);
        }
    }

    /// Receives the next frame of the master, or bytes of it if the transport has no frames; returns 0 if there are none.
    pub(crate) fn receive(&mut self, buffer: &mut [u8]) -> usize {
        match &mut self.way {
            Way::ModbusTcp { listener, client, id } => {
                if let Ok((stream, _)) = listener.accept()
                    && stream.set_nonblocking(true).is_ok()
                    && stream.set_nodelay(true).is_ok()
                {
                    // A client that connects again has lost its previous connection.
                    (*client, self.received) = (Some(stream), Vec::new());
                }
                let count = super::receive_from(client, buffer);
                self.received.extend(buffer.iter().take(count));
                // Requests that queued up while the process was stalled were given up by the master, so only the
                // last one is answered.
                let mut last = None;
                while let Some(next) = take_adu(&mut self.received) {
                    last = Some(next);
                }
                let Some((asked, frame)) = last else {
                    return 0;
                };
                (*id, self.answered) = (asked, Vec::new());
                fill(buffer, &frame)
            }
            Way::Udp { socket, client } => {
                let Ok((count, from)) = socket.recv_from(buffer) else {
                    return 0;
                };
                (*client, self.answered) = (Some(from), Vec::new());
                count
            }
            Way::Dial { stream, .. } => super::receive_from(stream, buffer),
        }
    }

    /// Sends bytes of the line to the master: complete frames if the transport has frames.
    pub(crate) fn send(&mut self, bytes: &[u8]) -> usize {
        if let Way::Dial { stream, .. } = &mut self.way {
            let Some(open) = stream else { return 0 };
            let sent = no_wait(open.write(bytes));
            if sent.is_err() {
                *stream = None;
            }
            return sent.unwrap_or(0);
        }
        self.answered.extend_from_slice(bytes);
        let Some((unit, pdu)) = rtu::open_frame(&self.answered) else {
            return bytes.len();
        };
        match &mut self.way {
            Way::ModbusTcp { client, id, .. } => {
                let adu = adu(*id, unit, pdu);
                if client.as_mut().is_some_and(|client| client.write_all(&adu).is_err()) {
                    *client = None;
                }
            }
            Way::Udp { socket, client } => {
                if let Some(client) = client {
                    // A datagram may be lost, as on any network.
                    let _ = socket.send_to(&self.answered, *client);
                }
            }
            Way::Dial { .. } => {}
        }
        self.answered.clear();
        bytes.len()
    }
}

fn fill(buffer: &mut [u8], frame: &[u8]) -> usize {
    for (place, byte) in buffer.iter_mut().zip(frame) {
        *place = *byte;
    }
    frame.len().min(buffer.len())
}

/// The first request in `received` as a frame of the line, with its transaction id.
fn take_adu(received: &mut Vec<u8>) -> Option<([u8; 2], Vec<u8>)> {
    let [high_id, low_id, _, _, high, low, ..] = *received.as_slice() else {
        return None;
    };
    let end = HEADER + usize::from(u16::from_be_bytes([high, low]));
    let (unit, pdu) = received.get(HEADER..end)?.split_first()?;
    let mut frame = Vec::new();
    rtu::encode_frame(*unit, pdu, &mut frame);
    received.drain(..end);
    Some(([high_id, low_id], frame))
}

fn adu(id: [u8; 2], unit: u8, pdu: &[u8]) -> Vec<u8> {
    let length = u16::try_from(pdu.len() + 1).unwrap_or(u16::MAX).to_be_bytes();
    [&id[..], &[0, 0], &length, &[unit], pdu].concat()
}

/// Connects to the server and sends the text.
fn dialled(server: SocketAddr, text: &str) -> Option<TcpStream> {
    let connect = || {
        let mut stream = TcpStream::connect_timeout(&server, CONNECT.0)?;
        stream.set_nodelay(true)?;
        stream.write_all(text.as_bytes())?;
        stream.set_nonblocking(true)?;
        Ok::<_, io::Error>(stream)
    };
    connect().ok()
}
