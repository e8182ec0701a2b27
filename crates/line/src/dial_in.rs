//! Devices that dial in (`tcp-listen://`): modems and converters that connect to the gateway and first send a text.
//!
//! One thread for each address accepts connections and assigns each to a bus by the text that it sends first. A bus
//! whose port has no text accepts any connection. A device that dials in again replaces its connection, which may
//! be dead without notice; a connection without the text never gets the line.

use std::io::{self, Read};
use std::net::{IpAddr, Shutdown, SocketAddr, TcpListener, TcpStream};
use std::os::fd::{AsFd, BorrowedFd};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError, Weak};
use std::time::{Duration, Instant};

use ipnet::IpNet;
use rustix::event::{PollFd, PollFlags};

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

/// The entry of one bus's line.
struct Entry {
    id: Vec<u8>,
    allow: Vec<IpNet>,
    /// Number of buses that have this line: for a moment of a reload it may be the old and the new one.
    buses: usize,
    /// When the last of them ended.
    free_since: Instant,
    /// A connection that the line's bus has not taken yet.
    waiting: Option<TcpStream>,
    /// The connection that the line's bus serves.
    served: Option<TcpStream>,
}

impl Entry {
    /// The device of this line has dialled in, for the first time or again.
    fn take(&mut self, stream: TcpStream) {
        let before = self.served.take().into_iter().chain(self.waiting.take());
        before.for_each(hang_up);
        self.waiting = Some(stream);
    }

    fn is_wanted(&self) -> bool {
        self.buses > 0
    }

    fn allows(&self, from: IpAddr) -> bool {
        self.allow.iter().any(|net| net.contains(&from))
    }

    /// Whether the other end of the connection may dial in. A connection without another end may not.
    fn allows_peer(&self, stream: &TcpStream) -> bool {
        stream
            .peer_addr()
            .is_ok_and(|from| self.allows(from.ip().to_canonical()))
    }

    /// Another bus has the line now, with this `allow`. A device that it does not allow is hung up on.
    fn begin(&mut self, allow: &[IpNet]) {
        self.allow = allow.to_vec();
        self.buses += 1;
        let (waiting, served) = (self.waiting.take(), self.served.take());
        self.waiting = waiting.and_then(|stream| self.kept_if_allowed(stream));
        self.served = served.and_then(|stream| self.kept_if_allowed(stream));
    }

    /// The connection if its device may dial in; otherwise the device is hung up on.
    fn kept_if_allowed(&self, stream: TcpStream) -> Option<TcpStream> {
        if self.allows_peer(&stream) {
            return Some(stream);
        }
        let from = stream
            .peer_addr()
            .map_or_else(|error| error.to_string(), |from| from.to_string());
        tracing::warn!(target: "drivegate::line::dial_in", %from, "hung up on a device that its bus does not allow to dial in any more");
        hang_up(stream);
        None
    }

    /// Whether the bus of this line ended so long ago that no reload brings it back. Its device is hung up on then, so
    /// that it dials in again.
    fn is_over(&mut self, now: Instant) -> bool {
        let is_over = !self.is_wanted() && now.saturating_duration_since(self.free_since) > KEPT;
        if is_over {
            let left = self.served.take().into_iter().chain(self.waiting.take());
            left.for_each(hang_up);
        }
        is_over
    }
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
mod tests {
    use std::io::Write;
    use std::os::fd::AsRawFd;

    use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
    use rustix::time::{ClockId, clock_gettime};

    use super::*;
    use crate::{Line, LineOptions};
    use drivegate_proto::LineFormat;

    fn loopback() -> Vec<IpNet> {
        vec!["127.0.0.0/8".parse().unwrap()]
    }

    fn free_port() -> u16 {
        TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
    }

    fn open(names: &mut Names, port: u16, id: &str) -> Result<Line, OpenError> {
        let format = LineFormat::new(9600, "8N1").unwrap();
        let text = format!("tcp-listen://127.0.0.1:{port}{id}");
        Line::open_by(names, &text, &format, &LineOptions::default(), &|| true).map(|(line, _)| line)
    }

    /// A device that dials in and sends this text.
    fn dials(port: u16, says: &str) -> TcpStream {
        let mut stream = loop {
            match TcpStream::connect(("127.0.0.1", port)) {
                Ok(stream) => break stream,
                Err(_) => std::thread::sleep(Duration::from_millis(10)),
            }
        };
        stream.write_all(says.as_bytes()).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        stream
    }

    fn heard(line: &Line) -> Vec<u8> {
        let mut buffer = [0; 100];
        line.wait(Instant::now() + Duration::from_secs(2), None, false).unwrap();
        let count = line.receive(&mut buffer).unwrap();
        buffer[..count].to_vec()
    }

    #[test]
    fn two_devices_are_told_apart_by_their_texts_and_a_new_connection_replaces_the_old_one() {
        let port = free_port();
        let device = std::thread::spawn(move || [dials(port, "USR-0002\r\nx"), dials(port, "USR-0001")]);
        let (mut one, mut two) = (Names::allowing(&loopback()), Names::allowing(&loopback()));
        two.dial_in = Some(Place::of(&format!("127.0.0.1:{port}"), "USR-0002", &loopback()).unwrap());
        let first = open(&mut one, port, "?id=USR-0001").unwrap();
        let second = open(&mut two, port, "?id=USR-0002").unwrap();
        let [mut of_second, mut of_first] = device.join().unwrap();
        assert_eq!(heard(&second), b"\r\nx");
        first.send(b"ask").unwrap();
        let mut buffer = [0; 3];
        of_first.read_exact(&mut buffer).unwrap();
        assert_eq!(&buffer, b"ask");
        // The modem restarted without closing its first connection.
        let mut again = dials(port, "USR-0001");
        assert_eq!(of_first.read(&mut buffer).unwrap(), 0, "hung up on");
        let lost = loop {
            match first.receive(&mut buffer) {
                Ok(_) => std::thread::sleep(Duration::from_millis(5)),
                Err(lost) => break lost,
            }
        };
        assert!(lost.closed);
        drop(first);
        let first = open(&mut one, port, "?id=USR-0001").unwrap();
        again.write_all(b"new").unwrap();
        assert_eq!(heard(&first), b"new");
        // A bus that ends leaves the connection to the one that replaces it.
        drop(first);
        drop(one);
        let first = open(&mut Names::allowing(&loopback()), port, "?id=USR-0001").unwrap();
        again.write_all(b"kept").unwrap();
        assert_eq!(heard(&first), b"kept");
        of_second.write_all(b"too").unwrap();
        assert_eq!(heard(&second), b"too");
    }

    fn is_hung_up(device: &mut TcpStream) -> bool {
        match device.read(&mut [0]) {
            Ok(read) => read == 0,
            Err(error) => error.kind() == io::ErrorKind::ConnectionReset,
        }
    }

    /// The line of a bus whose device dials in, however busy the machine is.
    fn served(names: &mut Names, port: u16, id: &str) -> Line {
        let until = Instant::now() + Duration::from_secs(60);
        loop {
            match open(names, port, id) {
                Ok(line) => return line,
                Err(error) => assert!(Instant::now() < until, "{error}"),
            }
        }
    }

    #[test]
    fn a_narrower_allow_hangs_up_what_waits_and_what_is_served() {
        let port = free_port();
        let address = format!("127.0.0.1:{port}");
        let stranger: Vec<IpNet> = vec!["10.0.0.0/8".parse().unwrap()];
        // The connection that a bus left to the one that replaces it.
        let mut names = Names::allowing(&loopback());
        names.dial_in = Some(Place::of(&address, "", &loopback()).unwrap());
        let mut device = dials(port, "");
        drop(served(&mut names, port, ""));
        drop(names);
        let narrowed = Place::of(&address, "", &stranger).unwrap();
        assert!(is_hung_up(&mut device), "it waits");
        assert!(narrowed.wait(&|| false).is_none());
        drop(narrowed);
        // A connection that is served while the new configuration arrives, and returned after that.
        let mut names = Names::allowing(&loopback());
        names.dial_in = Some(Place::of(&address, "", &loopback()).unwrap());
        let mut device = dials(port, "");
        let line = served(&mut names, port, "");
        let narrowed = Place::of(&address, "", &stranger).unwrap();
        assert!(is_hung_up(&mut device), "it is served");
        drop(line);
        assert!(narrowed.wait(&|| false).is_none());
        drop((narrowed, names));
        // A wider one keeps the connection.
        let mut names = Names::allowing(&loopback());
        names.dial_in = Some(Place::of(&address, "", &loopback()).unwrap());
        let mut device = dials(port, "");
        drop(served(&mut names, port, ""));
        let wide: Vec<IpNet> = vec!["0.0.0.0/0".parse().unwrap()];
        let widened = Place::of(&address, "", &wide).unwrap();
        assert!(widened.wait(&|| false).is_some());
        device.write_all(b"x").unwrap();
    }

    #[test]
    fn a_device_whose_text_no_bus_has_any_more_is_hung_up() {
        let port = free_port();
        let address = format!("127.0.0.1:{port}");
        let _stays = Place::of(&address, "A1", &loopback()).unwrap();
        let mut names = Names::allowing(&loopback());
        names.dial_in = Some(Place::of(&address, "A2", &loopback()).unwrap());
        let mut device = dials(port, "A2");
        drop(served(&mut names, port, "?id=A2"));
        drop(names);
        assert!(is_hung_up(&mut device), "it can dial in again");
        // Again, its bus gets it.
        let mut names = Names::allowing(&loopback());
        names.dial_in = Some(Place::of(&address, "A2", &loopback()).unwrap());
        let mut device = dials(port, "A2");
        let line = served(&mut names, port, "?id=A2");
        device.write_all(b"x").unwrap();
        assert_eq!(heard(&line), b"x");
    }

    /// Runs in a process of its own, whose descriptors it may use up.
    #[test]
    fn a_process_without_descriptors_pauses_between_its_tries() {
        const ALONE: &str = "DRIVEGATE_DIAL_IN_ALONE";
        if std::env::var_os(ALONE).is_none() {
            let name = "dial_in::tests::a_process_without_descriptors_pauses_between_its_tries";
            let mut alone = std::process::Command::new(std::env::current_exe().unwrap());
            let output = alone.args(["--exact", name]).env(ALONE, "1").output().unwrap();
            let text = String::from_utf8_lossy(&output.stdout).into_owned();
            assert!(output.status.success() && text.contains("1 passed"), "{text}");
            return;
        }
        let port = free_port();
        let place = Place::of(&format!("127.0.0.1:{port}"), "", &loopback()).unwrap();
        let before = getrlimit(Resource::Nofile);
        let limit = |current| {
            let maximum = before.maximum;
            setrlimit(Resource::Nofile, Rlimit { current, maximum }).unwrap();
        };
        // The next descriptor, which the device gets, is the last one.
        let next = std::fs::File::open("/dev/null").unwrap().as_raw_fd();
        limit(u64::try_from(next).ok().map(|next| next + 1));
        let _device = dials(port, "");
        let used = || Duration::try_from(clock_gettime(ClockId::ProcessCPUTime)).unwrap();
        let begun = used();
        std::thread::sleep(Duration::from_secs(2));
        let used = used() - begun;
        assert!(used < Duration::from_millis(200), "{used:?} of the processor");
        limit(before.current);
        let until = Instant::now() + Duration::from_secs(60);
        while place.wait(&|| true).is_none() {
            assert!(
                Instant::now() < until,
                "it gets its line as soon as there are descriptors"
            );
        }
    }

    #[test]
    fn nobody_without_the_text_or_the_right_gets_the_line() {
        let port = free_port();
        let mut names = Names::allowing(&loopback());
        names.dial_in = Some(Place::of(&format!("127.0.0.1:{port}"), "A1", &loopback()).unwrap());
        for wrong in ["B", "GET / HTTP/1.1\r\n", "A2"] {
            assert_eq!(dials(port, wrong).read(&mut [0]).unwrap_or(0), 0, "{wrong}");
        }
        let error = open(&mut names, port, "?id=A1").unwrap_err();
        assert!(
            error
                .to_string()
                .contains("no device has dialled in that says `A1` first"),
            "{error}"
        );
        let began = Instant::now();
        assert_eq!(dials(port, "").read(&mut [0]).unwrap(), 0, "silent");
        assert!(began.elapsed() >= PATIENCE);
        let port = free_port();
        let stranger: Vec<IpNet> = vec!["10.0.0.0/8".parse().unwrap()];
        let _place = Place::of(&format!("127.0.0.1:{port}"), "", &stranger).unwrap();
        assert_eq!(dials(port, "").read(&mut [0]).unwrap(), 0);
    }

    #[test]
    fn an_address_is_let_go_when_no_bus_wants_it_any_more() {
        let port = free_port();
        drop(Place::of(&format!("127.0.0.1:{port}"), "", &loopback()).unwrap());
        let until = Instant::now() + Duration::from_secs(30);
        while TcpListener::bind(("127.0.0.1", port)).is_err() {
            assert!(Instant::now() < until);
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    #[test]
    fn a_text_is_known_by_its_bytes() {
        let ids = [b"USR-1".to_vec(), b"X".to_vec()];
        let of = |said: &[u8]| belongs_to(said, ids.iter());
        assert_eq!(of(b""), Belongs::Unknown);
        assert_eq!(of(b"\r\nUSR"), Belongs::Unknown);
        assert_eq!(of(b"USR-1"), Belongs::To(b"USR-1".to_vec()));
        assert_eq!(of(b"USR-2"), Belongs::ToNobody);
        assert_eq!(split("0.0.0.0:5020?id=USR-0001"), ("0.0.0.0:5020", "USR-0001"));
        assert_eq!(split("0.0.0.0:5020"), ("0.0.0.0:5020", ""));
    }
}
