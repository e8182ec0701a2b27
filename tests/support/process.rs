//! Processes that end with their test, and helpers for their output and signals.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixDatagram, UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicU16, AtomicU32, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use super::tools::tool;

/// Longest wait for an event that must happen, even on a very busy machine.
pub(crate) const PATIENCE: Duration = Duration::from_secs(240);

/// A running process; killed when dropped.
pub(crate) struct Running {
    child: Child,
    output: Arc<Mutex<String>>,
}

impl Running {
    /// Starts a program and keeps its output.
    pub(crate) fn start(program: &Path, arguments: &[&str]) -> Running {
        Running::spawn(Command::new(program).args(arguments))
    }

    /// Starts the prepared command and keeps its output.
    pub(crate) fn spawn(command: &mut Command) -> Running {
        let mut child = command
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap_or_else(|error| panic!("cannot start {command:?}: {error}"));
        let output = Arc::new(Mutex::new(String::new()));
        keep(child.stdout.take().unwrap(), &output);
        keep(child.stderr.take().unwrap(), &output);
        Running { child, output }
    }

    /// Starts drivegate.
    pub(crate) fn drivegate(arguments: &[&str]) -> Running {
        Running::spawn(&mut drivegate(arguments))
    }

    /// Whether the process is still running.
    pub(crate) fn runs(&mut self) -> bool {
        self.child.try_wait().unwrap().is_none()
    }

    /// Output of the process so far.
    pub(crate) fn output(&self) -> String {
        self.output.lock().unwrap().clone()
    }

    /// Waits until the program has printed `text`.
    pub(crate) fn until_printed(&self, text: &str) -> String {
        until(&format!("the output `{text}`"), || {
            self.output().contains(text).then(|| self.output())
        })
    }

    /// Id of the process.
    pub(crate) fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Sends a signal, such as `INT`.
    pub(crate) fn signal(&self, name: &str) {
        let pid = self.child.id().to_string();
        assert!(
            Command::new("kill")
                .args([&format!("-{name}"), &pid])
                .status()
                .unwrap()
                .success()
        );
    }

    /// Reloads the configuration and waits until the gateway runs with it.
    pub(crate) fn reload(&self) {
        let done = || self.output().matches("configuration reloaded").count();
        let before = done();
        self.signal("HUP");
        until("the reload", || {
            let output = self.output();
            assert!(!output.contains("reload rejected"), "{output}");
            (done() > before).then_some(())
        });
    }

    /// Stops all threads of the process (SIGSTOP); on a busy machine that takes a moment.
    pub(crate) fn stand(&self) {
        self.signal("STOP");
        let tasks = format!("/proc/{}/task", self.child.id());
        let stands = |task: std::io::Result<std::fs::DirEntry>| {
            let stat = std::fs::read_to_string(task.unwrap().path().join("stat")).unwrap_or_default();
            // The state follows the name, which is in parentheses.
            stat.rsplit(") ").next().is_none_or(|rest| rest.starts_with('T'))
        };
        until("standstill", || {
            std::fs::read_dir(&tasks).unwrap().all(stands).then_some(())
        });
    }

    /// Waits until the process ends.
    pub(crate) fn ended(&mut self) -> ExitStatus {
        until("the end of the process", || self.child.try_wait().unwrap())
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
        if std::thread::panicking() {
            eprintln!("--- output of process {}\n{}", self.child.id(), self.output());
        }
    }
}

/// The program, with runtime files separate from those of gateways on this machine, and with its own state directory.
pub(crate) fn drivegate(arguments: &[&str]) -> Command {
    static STARTED: AtomicU32 = AtomicU32::new(0);
    let number = STARTED.fetch_add(1, Ordering::Relaxed);
    let own = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("{}/{number}", env!("CARGO_CRATE_NAME")));
    // The directory may be left from an earlier run of the tests.
    let _ = std::fs::remove_dir_all(&own);
    let (state, temporary) = (own.join("state"), own.join("tmp"));
    // Files of a demo that is killed stay out of the machine's temporary directory.
    std::fs::create_dir_all(&temporary).expect("a directory in that of the tests");
    let mut command = Command::new(env!("CARGO_BIN_EXE_drivegate"));
    command
        .args(arguments)
        .env_remove("RUNTIME_DIRECTORY")
        .env("XDG_RUNTIME_DIR", env!("CARGO_TARGET_TMPDIR"))
        .env("STATE_DIRECTORY", state)
        .env("TMPDIR", temporary);
    command
}

/// The socket through which systemd receives notifications of a service, for a service that runs with a watchdog of
/// one second.
pub(crate) struct Notifications(UnixDatagram, PathBuf);

impl Notifications {
    /// Notifications over the socket at this path.
    pub(crate) fn at(file: PathBuf) -> Notifications {
        let socket = UnixDatagram::bind(&file).unwrap();
        socket.set_read_timeout(Some(PATIENCE)).unwrap();
        Notifications(socket, file)
    }

    /// Makes the program send its notifications here.
    pub(crate) fn of<'c>(&self, command: &'c mut Command) -> &'c mut Command {
        command.env("NOTIFY_SOCKET", &self.1).env("WATCHDOG_USEC", "1000000")
    }

    /// Waits for one that has this text.
    pub(crate) fn until(&self, wanted: &str) {
        let mut bytes = [0; 1000];
        loop {
            let count = self.0.recv(&mut bytes).expect("a notification");
            if String::from_utf8_lossy(&bytes[..count]).contains(wanted) {
                return;
            }
        }
    }
}

fn keep(stream: impl Read + Send + 'static, output: &Arc<Mutex<String>>) {
    let output = output.clone();
    std::thread::spawn(move || {
        for line in BufReader::new(stream).lines().map_while(Result::ok) {
            let mut output = output.lock().unwrap();
            output.push_str(&line);
            output.push('\n');
        }
    });
}

/// A connection to a local socket, which a gateway may open a moment after its HTTP server.
pub(crate) fn local(socket: impl AsRef<Path>) -> UnixStream {
    until("the local socket", || UnixStream::connect(&socket).ok())
}

/// Waits until `ask` returns an answer.
pub(crate) fn until<T>(what: &str, mut ask: impl FnMut() -> Option<T>) -> T {
    let deadline = Instant::now() + PATIENCE;
    loop {
        if let Some(answer) = ask() {
            return answer;
        }
        assert!(Instant::now() < deadline, "never came: {what}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// A free TCP port that no other test gets, of this process or another one, as long as this process runs: otherwise
/// a socket that is closed and bound again could collide with another test. The port is outside the range that the
/// kernel assigns, so that no other program gets it by chance.
pub(crate) fn free_port() -> u16 {
    static NEXT: AtomicU16 = AtomicU16::new(0);
    static CLAIMED: Mutex<Vec<UnixListener>> = Mutex::new(Vec::new());
    let first = 10_000 + (std::process::id() % 200) as u16 * 100;
    loop {
        let port = first + NEXT.fetch_add(1, Ordering::Relaxed) % 2_000;
        let name = SocketAddr::from_abstract_name(format!("drivegate-test-port-{port}")).expect("a short name");
        let Ok(claim) = UnixListener::bind_addr(&name) else {
            continue;
        };
        CLAIMED.lock().unwrap().push(claim);
        if TcpListener::bind(("127.0.0.1", port)).is_ok() {
            return port;
        }
    }
}

/// Status and body of a GET.
pub(crate) fn get(port: u16, path: &str) -> Option<(u16, String)> {
    let mut stream = TcpStream::connect(("127.0.0.1", port)).ok()?;
    stream.set_read_timeout(Some(PATIENCE)).ok()?;
    write!(
        stream,
        "GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
    )
    .ok()?;
    let mut text = String::new();
    stream.read_to_string(&mut text).ok()?;
    let status = text.get(9..12)?.parse().ok()?;
    Some((status, text.split_once("\r\n\r\n")?.1.to_string()))
}

/// Waits until the gateway reports that it is ready.
pub(crate) fn until_ready(http: u16) {
    until("200 from /readyz", || {
        get(http, "/readyz").filter(|(status, _)| *status == 200)
    });
}

/// A drive as `/api/v1/drives` shows it. A gateway that already polls its drives may open its HTTP server a moment later.
pub(crate) fn api(http: u16, drive: &str) -> serde_json::Value {
    let (status, body) = until("an answer over HTTP", || get(http, &format!("/api/v1/drives/{drive}")));
    assert_eq!(status, 200, "{body}");
    serde_json::from_str(&body).unwrap()
}

/// The good value of a point.
pub(crate) fn point(http: u16, drive: &str, name: &str) -> serde_json::Value {
    let point = api(http, drive)["points"][name].clone();
    if point["quality"] == "good" {
        point["value"].clone()
    } else {
        serde_json::Value::Null
    }
}

/// Reads `count` registers by mbpoll.
pub(crate) fn mbpoll_read(port: u16, unit: u8, start: u16, count: u16) -> Result<Vec<u16>, String> {
    let text = mbpoll(port, unit, start, &["-c", &count.to_string()], &[])?;
    let value = |line: &str| {
        let text = line
            .trim_start()
            .strip_prefix('[')?
            .split_once("]:")?
            .1
            .trim()
            .to_string();
        let number: i32 = text.split_whitespace().next()?.parse().ok()?;
        Some(number as u16)
    };
    Ok(text.lines().filter_map(value).collect())
}

/// Writes registers by mbpoll: one value by function 6, several by function 16.
pub(crate) fn mbpoll_write(port: u16, unit: u8, start: u16, values: &[u16]) -> Result<(), String> {
    let values: Vec<String> = values.iter().map(u16::to_string).collect();
    let values: Vec<&str> = values.iter().map(String::as_str).collect();
    let text = mbpoll(port, unit, start, &[], &values)?;
    if text.contains("Written") { Ok(()) } else { Err(text) }
}

/// Reads registers, and repeats the request until it succeeds: on a busy machine a request may time out.
pub(crate) fn read_registers(port: u16, unit: u8, start: u16, count: u16) -> Vec<u16> {
    until("registers", || mbpoll_read(port, unit, start, count).ok())
}

/// Writes registers, again until that is acknowledged.
pub(crate) fn write_registers(port: u16, unit: u8, start: u16, values: &[u16]) {
    until("a write", || mbpoll_write(port, unit, start, values).ok());
}

fn mbpoll(port: u16, unit: u8, start: u16, options: &[&str], values: &[&str]) -> Result<String, String> {
    let (port, unit, start) = (port.to_string(), unit.to_string(), start.to_string());
    let mut arguments = vec![
        "-m", "tcp", "-p", &port, "-a", &unit, "-0", "-r", &start, "-1", "-o", "10",
    ];
    arguments.extend(options);
    arguments.push("127.0.0.1");
    arguments.extend(values);
    let output = Command::new(tool("mbpoll")).args(&arguments).output().unwrap();
    let text = [output.stdout, output.stderr].concat();
    let text = String::from_utf8_lossy(&text).into_owned();
    if output.status.success() && !text.contains("failed") {
        Ok(text)
    } else {
        Err(text)
    }
}
