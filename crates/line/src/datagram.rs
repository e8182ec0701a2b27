//! A device that takes one frame of the line in each datagram (`udp://`).
//!
//! Each request is sent from a separate socket, and so from a separate port: a late or duplicate datagram is
//! addressed to a port that is no longer open, and cannot be mistaken for the reply to another request.

use std::cell::{Ref, RefCell};
use std::io;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};

use super::{Lost, Names, OpenError};

/// The connection to a device by datagrams.
#[derive(Debug)]
pub(super) struct Datagrams {
    device: SocketAddr,
    /// Socket of the last request.
    socket: RefCell<UdpSocket>,
}

impl Datagrams {
    /// # Errors
    /// If the name has no address, or the system provides no socket.
    pub(super) fn open(
        names: &mut Names,
        port: &str,
        address: &str,
        go_on: &dyn Fn() -> bool,
    ) -> Result<Datagrams, OpenError> {
        let failed = |reason| OpenError::Tcp {
            port: port.to_string(),
            reason,
        };
        let found = names.addresses(address, go_on).map_err(failed)?;
        let device = found.first().copied();
        let device = device.ok_or_else(|| failed(io::ErrorKind::NotFound.into()))?;
        let socket = socket_to(device).map_err(failed)?;
        Ok(Datagrams {
            device,
            socket: RefCell::new(socket),
        })
    }

    /// Passes a complete frame to the network.
    pub(super) fn send(&self, frame: &[u8]) -> Result<(), Lost> {
        let socket = socket_to(self.device).map_err(|error| Lost::new(error.to_string()))?;
        let sent = socket.send(frame);
        *self.socket.borrow_mut() = socket;
        match sent {
            Ok(_) => Ok(()),
            // The frame is lost, which can happen on any network.
            Err(error) if is_of_network(&error) => Ok(()),
            Err(error) => Err(Lost::new(error.to_string())),
        }
    }

    /// Reads a datagram that answers the last request. Returns 0 if no such datagram has arrived.
    pub(super) fn receive(&self, buffer: &mut [u8]) -> Result<usize, Lost> {
        match self.socket.borrow().recv(buffer) {
            Ok(count) => Ok(count),
            Err(error) if error.kind() == io::ErrorKind::WouldBlock || is_of_network(&error) => Ok(0),
            Err(error) => Err(Lost::new(error.to_string())),
        }
    }

    /// The socket to wait for.
    pub(super) fn socket(&self) -> Ref<'_, UdpSocket> {
        self.socket.borrow()
    }
}

/// Whether the error means that the device, or the way to it, is not available now.
fn is_of_network(error: &io::Error) -> bool {
    use io::ErrorKind::{ConnectionRefused, HostUnreachable, Interrupted, NetworkDown, NetworkUnreachable};
    [
        ConnectionRefused,
        HostUnreachable,
        Interrupted,
        NetworkDown,
        NetworkUnreachable,
    ]
    .contains(&error.kind())
}

fn socket_to(device: SocketAddr) -> io::Result<UdpSocket> {
    let any: SocketAddr = match device {
        SocketAddr::V4(_) => (Ipv4Addr::UNSPECIFIED, 0).into(),
        SocketAddr::V6(_) => (Ipv6Addr::UNSPECIFIED, 0).into(),
    };
    let socket = UdpSocket::bind(any)?;
    socket.set_nonblocking(true)?;
    // A connected socket receives only datagrams of the device.
    match socket.connect(device) {
        Err(error) if !is_of_network(&error) => Err(error),
        _ => Ok(socket),
    }
}

#[cfg(test)]
mod tests {
    use std::os::fd::AsFd;
    use std::time::{Duration, Instant};

    use rustix::event::{PollFd, PollFlags};

    use super::*;
    use crate::poll_until;

    fn received(datagrams: &Datagrams) -> Vec<u8> {
        let until = Instant::now() + Duration::from_millis(200);
        let socket = datagrams.socket();
        poll_until(&mut [PollFd::from_borrowed_fd(socket.as_fd(), PollFlags::IN)], until).unwrap();
        let mut buffer = [0; 300];
        let count = datagrams.receive(&mut buffer).unwrap();
        buffer[..count].to_vec()
    }

    #[test]
    fn only_the_answer_to_the_last_request_is_heard() {
        let device = UdpSocket::bind("127.0.0.1:0").unwrap();
        let address = device.local_addr().unwrap().to_string();
        let datagrams = Datagrams::open(&mut Names::default(), "udp://x", &address, &|| true).unwrap();
        let mut buffer = [0; 300];
        let mut ask = |frame: &[u8]| {
            datagrams.send(frame).unwrap();
            let (count, from) = device.recv_from(&mut buffer).unwrap();
            assert_eq!(&buffer[..count], frame);
            from
        };
        let first = ask(b"one");
        let second = ask(b"two");
        assert_ne!(first, second);
        device.send_to(b"late", first).unwrap();
        assert_eq!(received(&datagrams), b"");
        device.send_to(b"own", second).unwrap();
        assert_eq!(received(&datagrams), b"own");
        let other = UdpSocket::bind("127.0.0.1:0").unwrap();
        other.send_to(b"forged", second).unwrap();
        assert_eq!(received(&datagrams), b"");
    }

    #[test]
    fn a_device_that_is_not_there_is_silent() {
        let nobody = UdpSocket::bind("127.0.0.1:0")
            .unwrap()
            .local_addr()
            .unwrap()
            .to_string();
        let datagrams = Datagrams::open(&mut Names::default(), "udp://x", &nobody, &|| true).unwrap();
        for _ in 0..3 {
            datagrams.send(b"?").unwrap();
            assert_eq!(received(&datagrams), b"");
        }
    }
}
