//! Devices that dial in (`tcp-listen://`): modems and converters that connect to the gateway and first send a text.
//!
//! One thread for each address accepts connections and assigns each to a bus by the text that it sends first. A bus
//! whose port has no text accepts any connection. A device that dials in again replaces its connection, which may
//! be dead without notice; a connection without the text never gets the line.

mod entry;

use std::io::{self, Read};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::os::fd::{AsFd, BorrowedFd};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError, Weak};
use std::time::{Duration, Instant};

use ipnet::IpNet;
use rustix::event::{PollFd, PollFlags};

use self::entry::Entry;
use super::{Lost, Names, OpenError, UNACKNOWLEDGED, clock, poll_until, read, write_all};

/// Time after which a connection that has not sent the text is closed.
const PATIENCE: Duration = Duration::from_secs(10);
/// Maximum number of simultaneous connections whose text has not arrived; further ones are closed.
const MOST_PENDING: usize = 32;
/// Longest text that identifies a device.
pub const LONGEST_ID: usize = 64;
/// Time that a bus waits for its device before the bus counts as down.
const WAIT: Duration = Duration::from_secs(2);
/// Interval at which waiting threads check again.
const STEP: Duration = Duration::from_millis(100);
/// Time for which the connection of a bus that ended is kept, and an address that no bus uses stays open: a reload
/// leaves the connections as they are.
const KEPT: Duration = Duration::from_secs(5);

/// The addresses at which devices dial in.
static PLACES: Mutex<Vec<Weak<Shared>>> = Mutex::new(Vec::new());

/// The entry of one bus at an address.
pub(super) struct Place {
    shared: Arc<Shared>,
    id: Vec<u8>,
}

struct Shared {
    address: SocketAddr,
    state: Mutex<State>,
    came: Condvar,
}

struct State {
    lines: Vec<Entry>,
}

impl Shared {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// `host:port` and the text of `tcp-listen://host:port?id=TEXT`.
pub fn split(place: &str) -> (&str, &str) {
    place.split_once("?id=").unwrap_or((place, ""))
}

impl Place {
    /// Listens at the address, unless another bus already listens there.
    fn of(address: &str, id: &str, allow: &[IpNet]) -> io::Result<Place> {
        let address: SocketAddr = address
            .parse()
            .map_err(|_| io::Error::new(io::ErrorKind::InvalidInput, "it is not an address with a port"))?;
        let mut places = PLACES.lock().unwrap_or_else(PoisonError::into_inner);
        places.retain(|place| place.strong_count() > 0);
        let known = places
            .iter()
            .filter_map(Weak::upgrade)
            .find(|shared| shared.address == address);
        let shared = match known {
            Some(shared) => shared,
            None => {
                let shared = listen(address)?;
                places.push(Arc::downgrade(&shared));
                shared
            }
        };
        let id = id.as_bytes().to_vec();
        let mut state = shared.state();
        match state.lines.iter_mut().find(|line| line.id == id) {
            Some(line) => line.begin(allow),
            None => state.lines.push(Entry {
                id: id.clone(),
                allow: allow.to_vec(),
                buses: 1,
                free_since: Instant::now(),
                waiting: None,
                served: None,
            }),
        }
        drop(state);
        Ok(Place { shared, id })
    }

    /// Waits for the device; `None` if it does not connect in time, or the port is no longer used.
    fn wait(&self, go_on: &dyn Fn() -> bool) -> Option<TcpStream> {
        let until = Instant::now() + WAIT;
        let mut state = self.shared.state();
        loop {
            let line = state.lines.iter_mut().find(|line| line.id == self.id)?;
            if let Some(stream) = line.waiting.take() {
                line.served = stream.try_clone().ok();
                return Some(stream);
            }
            drop(state);
            if !go_on() || Instant::now() >= until {
                return None;
            }
            let waited = self.shared.came.wait_timeout(self.shared.state(), STEP);
            state = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut state = self.shared.state();
        if let Some(line) = state.lines.iter_mut().find(|line| line.id == self.id) {
            line.buses = line.buses.saturating_sub(1);
            line.free_since = Instant::now();
        }
    }
}

/// The connection of a device that dialled in.
#[derive(Debug)]
pub(super) struct Dialled {
    stream: TcpStream,
    shared: Weak<Shared>,
    id: Vec<u8>,
}

impl std::fmt::Debug for Shared {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Shared")
            .field("address", &self.address)
            .finish_non_exhaustive()
    }
}

impl Dialled {
    /// Waits for the device of the port `tcp-listen://place`.
    ///
    /// # Errors
    /// If the gateway cannot listen at the address, or the device has not connected within two seconds.
    pub(super) fn wait(
        names: &mut Names,
        port: &str,
        place: &str,
        go_on: &dyn Fn() -> bool,
    ) -> Result<Dialled, OpenError> {
        let (address, id) = split(place);
        let known = match names.dial_in.take() {
            Some(known) => known,
            None => Place::of(address, id, &names.allow).map_err(|reason| OpenError::Listen {
                port: port.to_string(),
                reason,
            })?,
        };
        let stream = known.wait(go_on);
        let shared = Arc::downgrade(&known.shared);
        names.dial_in = Some(known);
        let stream = stream.ok_or_else(|| OpenError::Nobody {
            port: port.to_string(),
            reason: nobody(id),
        })?;
        Ok(Dialled {
            stream,
            shared,
            id: id.as_bytes().to_vec(),
        })
    }

    /// Passes a complete frame to the device.
    pub(super) fn send(&self, frame: &[u8]) -> Result<(), Lost> {
        write_all(self.stream.as_fd(), frame)
    }

    /// Reads the available bytes; returns 0 if there are none.
    pub(super) fn receive(&self, buffer: &mut [u8]) -> Result<usize, Lost> {
        read(self.stream.as_fd(), buffer)
    }
}

impl AsFd for Dialled {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.stream.as_fd()
    }
}

impl Drop for Dialled {
    /// A connection that still works waits for the bus that replaces this one.
    fn drop(&mut self) {
        let Some(shared) = self.shared.upgrade() else { return };
        let mut state = shared.state();
        let line = state.lines.iter_mut().find(|line| line.id == self.id);
        let Some(line) = line.filter(|line| line.waiting.is_none()) else {
            return;
        };
        line.served = None;
        let lives = matches!(self.stream.peek(&mut [0]), Err(error) if error.kind() == io::ErrorKind::WouldBlock);
        if lives {
            line.waiting = self
                .stream
                .try_clone()
                .ok()
                .and_then(|stream| line.kept_if_allowed(stream));
        }
    }
}

fn nobody(id: &str) -> String {
    let what = match id {
        "" => "no device has dialled in".to_string(),
        id => format!("no device has dialled in that says `{id}` first"),
    };
    format!("{what}; check the server's address, port and registration text in the device, and `allow` of the bus")
}

fn listen(address: SocketAddr) -> io::Result<Arc<Shared>> {
    let listener = TcpListener::bind(address)?;
    listener.set_nonblocking(true)?;
    let shared = Arc::new(Shared {
        address,
        state: Mutex::new(State { lines: Vec::new() }),
        came: Condvar::new(),
    });
    let serving = shared.clone();
    std::thread::Builder::new().name("dial-in".to_string()).spawn(move || {
        clock::be_ordinary();
        accept_all(&listener, &serving);
    })?;
    Ok(shared)
}

/// A connection whose text has not arrived yet.
struct Pending {
    stream: TcpStream,
    from: SocketAddr,
    said: Vec<u8>,
    since: Instant,
}

/// Accepts connections until no bus uses the address any more.
fn accept_all(listener: &TcpListener, shared: &Shared) {
    let mut pending: Vec<Pending> = Vec::new();
    let mut failing = false;
    loop {
        let listening = [PollFd::new(listener, PollFlags::IN)];
        let said = pending.iter().map(|one| PollFd::new(&one.stream, PollFlags::IN));
        let mut fds: Vec<PollFd<'_>> = listening.into_iter().chain(said).collect();
        // An error ends the wait early, which is harmless.
        let _ = poll_until(&mut fds, Instant::now() + STEP);
        drop(fds);
        let now = Instant::now();
        match listener.accept() {
            Ok((stream, from)) => {
                failing = false;
                match set_up(&stream) {
                    Ok(()) if pending.len() < MOST_PENDING => pending.push(Pending {
                        stream,
                        from,
                        said: Vec::new(),
                        since: now,
                    }),
                    _ => hang_up(stream),
                }
            }
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
            Err(error) => {
                // The connection stays in the queue of the system, so that the next wait would end at once.
                if !std::mem::replace(&mut failing, true) {
                    tracing::warn!(target: "drivegate::line::dial_in", address = %shared.address, %error, "cannot accept a device");
                }
                std::thread::sleep(STEP);
            }
        }
        if is_unwanted(shared, now) {
            // A bus must not find an address that is about to be released.
            let mut places = PLACES.lock().unwrap_or_else(PoisonError::into_inner);
            if is_unwanted(shared, now) {
                places.retain(|place| place.upgrade().is_some_and(|other| other.address != shared.address));
                return;
            }
        }
        let mut state = shared.state();
        for one in std::mem::take(&mut pending) {
            match identify(one, &mut state, now) {
                Some(waits) => pending.push(waits),
                None => shared.came.notify_all(),
            }
        }
    }
}

/// Whether no bus has asked for the address for some time. Forgets the lines whose bus ended.
fn is_unwanted(shared: &Shared, now: Instant) -> bool {
    let mut state = shared.state();
    state.lines.retain_mut(|line| !line.is_over(now));
    state.lines.is_empty()
}

fn set_up(stream: &TcpStream) -> io::Result<()> {
    stream.set_nonblocking(true)?;
    stream.set_nodelay(true)?;
    // A modem that lost its network sends nothing; the system would keep trying for a quarter of an hour.
    rustix::net::sockopt::set_tcp_user_timeout(stream, UNACKNOWLEDGED.as_millis() as u32)?;
    Ok(())
}

/// Decides about a new connection: it is given to its line, is closed, or waits for its text.
fn identify(mut one: Pending, state: &mut State, now: Instant) -> Option<Pending> {
    let from = one.from.ip().to_canonical();
    let mut allowed = state
        .lines
        .iter()
        .filter(|line| line.is_wanted() && line.allows(from))
        .peekable();
    if allowed.peek().is_none() {
        tracing::warn!(target: "drivegate::line::dial_in", from = %one.from, "hung up on a device that no bus allows to dial in");
        hang_up(one.stream);
        return None;
    }
    let id = match allowed.next().filter(|line| line.id.is_empty()) {
        Some(line) => Some(line.id.clone()),
        None => match read_greeting(&mut one) {
            Greeting::Nothing if now.saturating_duration_since(one.since) < PATIENCE => return Some(one),
            Greeting::Nothing => None,
            Greeting::Gone => return None,
            Greeting::Text => {
                let ids = state
                    .lines
                    .iter()
                    .filter(|line| line.is_wanted() && line.allows(from))
                    .map(|line| &line.id);
                match belongs_to(&one.said, ids) {
                    Belongs::To(id) => Some(id),
                    Belongs::ToNobody => None,
                    Belongs::Unknown if now.saturating_duration_since(one.since) < PATIENCE => return Some(one),
                    Belongs::Unknown => None,
                }
            }
        },
    };
    match id.and_then(|id| state.lines.iter_mut().find(|line| line.id == id)) {
        Some(line) => line.take(one.stream),
        None => {
            let said = one.said.escape_ascii().to_string();
            tracing::warn!(target: "drivegate::line::dial_in", from = %one.from, said, "hung up on a device that did \
                                                                                        not say the text of a bus");
            hang_up(one.stream);
        }
    }
    None
}

enum Greeting {
    Nothing,
    Text,
    Gone,
}

/// Reads the text that a device sends first, and no byte more: the bytes after the text belong to the line.
fn read_greeting(one: &mut Pending) -> Greeting {
    let mut byte = [0];
    match one.stream.read(&mut byte) {
        Ok(0) => Greeting::Gone,
        Ok(_) => {
            one.said.extend(byte);
            Greeting::Text
        }
        Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
            if one.said.is_empty() {
                Greeting::Nothing
            } else {
                Greeting::Text
            }
        }
        Err(_) => Greeting::Gone,
    }
}

#[derive(Debug, PartialEq, Eq)]
enum Belongs {
    To(Vec<u8>),
    ToNobody,
    /// The received bytes are the beginning of a text.
    Unknown,
}

/// Finds the line of a device by the text that it sent. Line ends before the text are ignored; those after it are
/// passed to the line, which counts them as bytes between transactions.
fn belongs_to<'i>(said: &[u8], ids: impl Iterator<Item = &'i Vec<u8>>) -> Belongs {
    let said = said.trim_ascii_start();
    let mut may = said.is_empty();
    for id in ids {
        if said == id.as_slice() {
            return Belongs::To(id.clone());
        }
        may |= id.starts_with(said);
    }
    if may { Belongs::Unknown } else { Belongs::ToNobody }
}

fn hang_up(stream: TcpStream) {
    if let Err(error) = stream.shutdown(Shutdown::Both) {
        tracing::debug!(target: "drivegate::line::dial_in", %error, "the connection was gone already");
    }
}

#[cfg(test)]
mod tests;
