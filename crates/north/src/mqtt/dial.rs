//! Reaches a broker by TCP: by all addresses of its name in turn, and no more often than it should be tried.

use std::collections::VecDeque;
use std::io;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use rumqttc::NetworkOptions;
use tokio::net::TcpStream;

use super::Broker;

/// Time limit for TCP, TLS and CONNACK.
pub(super) const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);
/// So many attempts within so long, to whatever address.
const ATTEMPTS: usize = 3;
const WITHIN: Duration = Duration::from_secs(1);

/// The last attempts. Time is an argument.
#[derive(Debug, Default)]
struct Pace(VecDeque<Instant>);

impl Pace {
    /// Counts an attempt at `now`, or says when it may follow.
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

/// The attempts of one client.
#[derive(Debug, Clone, Default)]
pub(super) struct Dial(Arc<Mutex<Pace>>);

impl Dial {
    /// Connects to the first address that takes the connection, beginning with that of number `first`: an address behind which no
    /// broker answers does not keep the others from being tried.
    pub(super) async fn connect(self, broker: Broker, first: usize, options: NetworkOptions) -> io::Result<TcpStream> {
        // rumqttc and TLS require IPv6 addresses without brackets.
        let found = tokio::net::lookup_host((broker.bare_host(), broker.port)).await?;
        let mut addresses: Vec<_> = found.collect();
        let mut failed = io::Error::other(format!("{} has no address", broker.host));
        if addresses.is_empty() {
            return Err(failed);
        }
        let count = addresses.len();
        addresses.rotate_left(first % count);
        let each = CONNECT_TIMEOUT / u32::try_from(count).unwrap_or(u32::MAX);
        for address in addresses {
            self.turn().await;
            // A literal address: nothing is looked up.
            let attempt = rumqttc::default_socket_connect(address.to_string(), options.clone());
            match tokio::time::timeout(each.max(WITHIN), attempt).await {
                Ok(Ok(stream)) => return Ok(stream),
                Ok(Err(error)) => failed = error,
                Err(_) => failed = io::Error::new(io::ErrorKind::TimedOut, "timed out"),
            }
        }
        Err(failed)
    }

    /// Waits until another attempt may follow.
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

    #[tokio::test]
    async fn an_attempt_begins_with_the_address_whose_turn_it_is() {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let port = listener.local_addr().unwrap().port();
        for host in ["127.0.0.1", "localhost"] {
            for first in 0..3 {
                let host = host.to_string();
                let dialled = Dial::default().connect(Broker { host, port }, first, NetworkOptions::new());
                assert!(dialled.await.is_ok(), "{first}");
            }
        }
        drop(listener);
        let broker = Broker {
            host: "[::1]".to_string(),
            port,
        };
        assert!(Dial::default().connect(broker, 0, NetworkOptions::new()).await.is_err());
    }
}
