//! Names of device servers. The system may need more than ten seconds to report that no name server answers, and a
//! bus that waits that long would seem to hang: so a separate thread makes the lookup, and the bus waits for it in
//! short steps.

use std::io;
use std::net::{SocketAddr, ToSocketAddrs};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::time::{Duration, Instant};

use ipnet::IpNet;

use super::clock;
use super::dial_in::Place;
use super::other_server::OtherServer;

/// Longest wait for the result of a lookup.
const PATIENCE: Duration = Duration::from_secs(2);
/// Interval at which `go_on` of waiting callers is called.
const STEP: Duration = Duration::from_millis(100);

type Found = io::Result<Vec<SocketAddr>>;

/// The addresses of one device server: at most one thread looks them up, and the last valid ones are kept.
pub struct Names {
    ask: Arc<dyn Fn(&str) -> Found + Send + Sync>,
    patience: Duration,
    known: Vec<SocketAddr>,
    /// The result of a lookup still in progress.
    asked: Option<Receiver<Found>>,
    /// The last error of the system instead of an address: repeated until there is another result, so that the reason
    /// why a bus is down changes only when the cause does.
    failure: Option<String>,
    /// Whether the last lookup found nothing.
    doubtful: bool,
    /// The kind of server, once recognised.
    pub(super) other: OtherServer,
    /// Networks from which devices may dial in.
    pub(super) allow: Vec<IpNet>,
    /// The address to which devices connect.
    pub(super) dial_in: Option<Place>,
}

impl std::fmt::Debug for Names {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Names")
            .field("known", &self.known)
            .finish_non_exhaustive()
    }
}

impl Default for Names {
    fn default() -> Names {
        Names::asking(|address| address.to_socket_addrs().map(Iterator::collect), PATIENCE)
    }
}

impl Names {
    /// Names for a line to which a device may connect from these networks.
    pub fn allowing(allow: &[IpNet]) -> Names {
        Names {
            allow: allow.to_vec(),
            ..Names::default()
        }
    }

    fn asking(ask: impl Fn(&str) -> Found + Send + Sync + 'static, patience: Duration) -> Names {
        Names {
            ask: Arc::new(ask),
            patience,
            known: Vec::new(),
            asked: None,
            failure: None,
            doubtful: false,
            other: OtherServer::default(),
            allow: Vec::new(),
            dial_in: None,
        }
    }

    /// The addresses of `host:port`, at least one: those that the system returns, else the last known ones. `go_on` is
    /// called several times a second while the answer is awaited; false ends the wait.
    ///
    /// # Errors
    /// If there is no address, no answer within two seconds, or `go_on` returned false.
    pub fn addresses(&mut self, address: &str, go_on: &dyn Fn() -> bool) -> Found {
        if let Ok(literal) = address.parse() {
            return Ok(vec![literal]);
        }
        let found = match self.asked.take() {
            // A lookup in progress is not waited for again while there is an address to try.
            Some(asked) if !self.known.is_empty() => self.wait(asked, Duration::ZERO, go_on),
            Some(asked) => self.wait(asked, self.patience, go_on),
            None => {
                let asked = self.ask(address);
                asked.and_then(|asked| self.wait(asked, self.patience, go_on))
            }
        };
        let found = found.and_then(|found| {
            if found.is_empty() {
                Err(io::Error::new(io::ErrorKind::NotFound, "the name has no address"))
            } else {
                Ok(found)
            }
        });
        match found {
            Ok(found) => {
                self.known = found;
                self.failure = None;
                self.doubtful = false;
            }
            Err(error) if self.known.is_empty() || error.kind() == io::ErrorKind::Interrupted => return Err(error),
            Err(error) => {
                if !std::mem::replace(&mut self.doubtful, true) {
                    tracing::warn!(target: "drivegate::line::names", "cannot resolve {address}: {error}; continuing \
                                                                      with the last known addresses");
                }
            }
        }
        Ok(self.known.clone())
    }

    /// Looks the name up in a thread. That thread cannot be cancelled; it ends when the system gives up.
    fn ask(&self, address: &str) -> io::Result<Receiver<Found>> {
        let (answer, asked) = sync_channel(1);
        let (ask, address) = (self.ask.clone(), address.to_string());
        std::thread::Builder::new().name("names".to_string()).spawn(move || {
            clock::be_ordinary();
            // The receiver no longer exists if the bus has ended.
            let _ = answer.send(ask(&address));
        })?;
        Ok(asked)
    }

    fn wait(&mut self, asked: Receiver<Found>, patience: Duration, go_on: &dyn Fn() -> bool) -> Found {
        let until = Instant::now() + patience;
        loop {
            let left = until.saturating_duration_since(Instant::now());
            let ended = match asked.recv_timeout(left.min(STEP)) {
                Ok(found) => {
                    self.failure = found.as_ref().err().map(io::Error::to_string);
                    return found;
                }
                Err(RecvTimeoutError::Disconnected) => return Err(io::Error::other("the resolver thread has ended")),
                Err(RecvTimeoutError::Timeout) if !go_on() => io::ErrorKind::Interrupted.into(),
                Err(RecvTimeoutError::Timeout) if left.is_zero() => {
                    let known = self.failure.as_deref();
                    io::Error::new(
                        io::ErrorKind::TimedOut,
                        known.unwrap_or("no name server answered in time"),
                    )
                }
                Err(RecvTimeoutError::Timeout) => continue,
            };
            self.asked = Some(asked);
            return Err(ended);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;
    use std::sync::Mutex;
    use std::sync::atomic::{AtomicUsize, Ordering};
    use std::sync::mpsc::{Sender, channel};

    use super::*;

    const NAME: &str = "device-server:4001";

    /// A name server that answers when the test commands it, and the number of lookups.
    fn names() -> (Names, Sender<Found>, Arc<AtomicUsize>) {
        let (say, said) = channel();
        let (said, asked) = (Mutex::new(said), Arc::new(AtomicUsize::new(0)));
        let count = asked.clone();
        let ask = move |name: &str| {
            assert_eq!(name, NAME);
            count.fetch_add(1, Ordering::SeqCst);
            said.lock().unwrap().recv().unwrap()
        };
        (Names::asking(ask, Duration::from_millis(150)), say, asked)
    }

    fn on() -> bool {
        true
    }

    fn kind(found: Found) -> io::ErrorKind {
        found.unwrap_err().kind()
    }

    fn at(text: &str) -> Vec<SocketAddr> {
        vec![text.parse().unwrap()]
    }

    #[test]
    fn an_address_is_nobodys_name() {
        let (mut names, _, asked) = names();
        assert_eq!(names.addresses("127.0.0.1:502", &on).unwrap(), at("127.0.0.1:502"));
        assert_eq!(names.addresses("[::1]:502", &on).unwrap(), at("[::1]:502"));
        assert_eq!(asked.load(Ordering::SeqCst), 0);
    }

    #[test]
    fn a_name_server_that_hangs_is_asked_once_and_waited_for_in_steps() {
        let (mut names, say, asked) = names();
        let steps = Cell::new(0);
        let step = || {
            steps.set(steps.get() + 1);
            true
        };
        for _ in 0..2 {
            assert_eq!(kind(names.addresses(NAME, &step)), io::ErrorKind::TimedOut);
        }
        assert!(steps.get() >= 4, "{}", steps.get());
        say.send(Err(io::Error::other("temporary failure"))).unwrap();
        names.patience = Duration::from_secs(30);
        assert_eq!(kind(names.addresses(NAME, &on)), io::ErrorKind::Other);
        names.patience = Duration::from_millis(1);
        let silent = names.addresses(NAME, &on).unwrap_err();
        assert_eq!(
            (silent.kind(), silent.to_string().as_str()),
            (io::ErrorKind::TimedOut, "temporary failure")
        );
        say.send(Ok(at("10.0.0.9:4001"))).unwrap();
        names.patience = Duration::from_secs(30);
        assert_eq!(names.addresses(NAME, &on).unwrap(), at("10.0.0.9:4001"));
        assert_eq!(asked.load(Ordering::SeqCst), 2, "one thread for each answer");
    }

    #[test]
    fn a_wait_ends_when_its_bus_does() {
        let (mut names, _say, _) = names();
        names.patience = Duration::from_secs(3600);
        assert_eq!(kind(names.addresses(NAME, &|| false)), io::ErrorKind::Interrupted);
    }

    #[test]
    fn the_last_good_addresses_are_used_while_there_are_none() {
        let (mut names, say, asked) = names();
        say.send(Ok(Vec::new())).unwrap();
        names.patience = Duration::from_secs(30);
        assert_eq!(kind(names.addresses(NAME, &on)), io::ErrorKind::NotFound);
        say.send(Ok(at("10.0.0.9:4001"))).unwrap();
        assert_eq!(names.addresses(NAME, &on).unwrap(), at("10.0.0.9:4001"));
        say.send(Err(io::Error::other("temporary failure"))).unwrap();
        assert_eq!(names.addresses(NAME, &on).unwrap(), at("10.0.0.9:4001"));
        names.patience = Duration::from_millis(1);
        for _ in 0..3 {
            assert_eq!(names.addresses(NAME, &on).unwrap(), at("10.0.0.9:4001"));
        }
        say.send(Ok(at("10.0.0.10:4001"))).unwrap();
        let deadline = Instant::now() + Duration::from_secs(30);
        while names.addresses(NAME, &on).unwrap() != at("10.0.0.10:4001") {
            assert!(Instant::now() < deadline);
        }
        assert_eq!(asked.load(Ordering::SeqCst), 4, "one thread since there was no answer");
    }
}
