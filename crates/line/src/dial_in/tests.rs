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
