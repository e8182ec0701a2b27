//! Connects to a broker over TCP: tries all addresses of its name in turn, at a limited rate.

use std::collections::VecDeque;
use std::io;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use rumqttc::NetworkOptions;
use tokio::net::TcpStream;

use super::Broker;

/// Time limit for TCP, TLS and CONNACK: a broker that is busy, or checks clients in a database, takes some seconds.
pub(super) const ACCEPT_TIMEOUT: Duration = Duration::from_secs(10);
/// Time limit for a TCP connection.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);
/// Number of attempts within a time, to any address.
const ATTEMPTS: usize = 3;
const WITHIN: Duration = Duration::from_secs(1);

/// The last attempts. Time is an argument.
#[derive(Debug, Default)]
struct Pace(VecDeque<Instant>);

impl Pace {
    /// Counts an attempt at `now`, or returns when the next one is allowed.
    fn take(&mut self, now: Instant) -> Result<(), Instant> {
        self.0.retain(|at| now.saturating_duration_since(*at) < WITHIN);
        match self.0.front() {
            Some(first) if self.0.len() >= ATTEMPTS => Err(*first + WITHIN),
            _ => {
                self.0.push_back(now);
                Ok(())
            }
        }
    }
}

/// The connection attempts of one client.
#[derive(Debug, Clone, Default)]
pub(super) struct Dial(Arc<Mutex<Pace>>);

impl Dial {
    /// Connects to the first address that accepts the connection, beginning with number `first`. An address at
    /// which no broker answers does not prevent the others from being tried.
    pub(super) async fn connect(self, broker: Broker, first: usize, options: NetworkOptions) -> io::Result<TcpStream> {
        // rumqttc and TLS require IPv6 addresses without brackets.
        let found = tokio::net::lookup_host((broker.bare_host(), broker.port)).await?;
        self.reach(found.collect(), first, options).await
    }

    async fn reach(
        self,
        mut addresses: Vec<SocketAddr>,
        first: usize,
        options: NetworkOptions,
    ) -> io::Result<TcpStream> {
        let mut failed = io::Error::other("the host has no address");
        let Some(start) = first.checked_rem(addresses.len()) else {
            return Err(failed);
        };
        let each = CONNECT_TIMEOUT / u32::try_from(addresses.len()).unwrap_or(u32::MAX);
        addresses.rotate_left(start);
        for address in addresses {
            self.turn().await;
            // A literal address needs no lookup.
            let attempt = rumqttc::default_socket_connect(address.to_string(), options.clone());
            match tokio::time::timeout(each.max(WITHIN), attempt).await {
                Ok(Ok(stream)) => return Ok(stream),
                Ok(Err(error)) => failed = error,
                Err(_) => failed = io::Error::new(io::ErrorKind::TimedOut, "timed out"),
            }
        }
        Err(failed)
    }

    /// Waits until another attempt is allowed.
    async fn turn(&self) {
        loop {
            let next = self
                .0
                .lock()
                .unwrap_or_else(PoisonError::into_inner)
                .take(Instant::now());
            match next {
                Ok(()) => return,
                Err(at) => tokio::time::sleep_until(at.into()).await,
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn at_most_three_attempts_in_any_second() {
        let (start, mut pace) = (Instant::now(), Pace::default());
        let taken: Vec<u64> = (0..5000)
            .filter(|ms| pace.take(start + Duration::from_millis(*ms)).is_ok())
            .collect();
        assert_eq!(taken.len(), 15);
        assert!(
            taken.windows(4).all(|four| matches!(four, [a, .., d] if d - a >= 1000)),
            "{taken:?}"
        );
    }

    async fn listener() -> (tokio::net::TcpListener, SocketAddr) {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        (listener, address)
    }

    #[tokio::test]
    async fn every_address_has_its_turn() {
        let ((one, a), (_two, b)) = (listener().await, listener().await);
        let reached = async |first| {
            let stream = Dial::default().reach(vec![a, b], first, NetworkOptions::new()).await;
            stream.and_then(|stream| stream.peer_addr()).ok()
        };
        assert_eq!(
            [reached(0).await, reached(1).await, reached(2).await],
            [Some(a), Some(b), Some(a)]
        );
        drop(one);
        assert_eq!(
            [reached(0).await, reached(1).await],
            [Some(b); 2],
            "the other one refuses"
        );
        let none = Dial::default().reach(Vec::new(), 3, NetworkOptions::new()).await;
        assert!(none.unwrap_err().to_string().contains("no address"));
    }

    #[tokio::test]
    async fn names_and_addresses_are_dialled() {
        let (_listener, address) = listener().await;
        for (host, reaches) in [("127.0.0.1", true), ("localhost", true), ("[::1]", false)] {
            let broker = Broker {
                host: host.to_string(),
                port: address.port(),
                path: None,
            };
            let dialled = Dial::default().connect(broker, 0, NetworkOptions::new()).await;
            assert_eq!(dialled.is_ok(), reaches, "{host}");
        }
    }
}
