//! The programs that have a serial port open, for messages: a gateway of this machine by its socket, others by the descriptors of
//! their processes, which only root and the user of a process see.

use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::client::{Client, ClientError, Door, GatewayRequest};
use drivegate_gateway::config::{Settings, environment};
use drivegate_http::local::{RuntimeDirectories, SocketPath};
use drivegate_http::messages::Expected;
use drivegate_line::TAKEN;

/// The name of a gateway's process.
const GATEWAY: &str = "drivegate";

/// A process that has a port open.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct PortUser {
    pid: u32,
    name: String,
}

impl fmt::Display for PortUser {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} (pid {})", self.name, self.pid)
    }
}

/// Flags of a socket that listens, in `/proc/net/unix`.
const LISTENS: &str = "00010000";

/// The name that a gateway has for a file in its refusal.
const RUNS_WITH: &str = "the gateway runs with ";

/// A gateway of this machine, and its bus at a port.
#[derive(Debug, PartialEq, Eq)]
struct Owner {
    bus: String,
    /// Configuration of the gateway, where there is one.
    config: Option<PathBuf>,
    /// Name of the gateway, where the configuration can be read.
    name: Option<String>,
}

/// The part of a bus that says where it is.
#[derive(Debug, Deserialize)]
pub(super) struct BusAt {
    pub(super) name: String,
    pub(super) port: String,
}

/// The other programs that have this port open, as far as this user sees them.
pub(super) fn of(port: &str) -> Vec<PortUser> {
    in_proc(Path::new("/proc"), port, std::process::id())
}

/// As [`of`], without gateways: they are its owners.
pub(super) fn strangers(port: &str) -> Vec<PortUser> {
    let mut users = of(port);
    users.retain(|user| user.name != GATEWAY);
    users
}

fn in_proc(proc: &Path, port: &str, own: u32) -> Vec<PortUser> {
    let Ok(device) = Path::new(port).canonicalize() else {
        return Vec::new();
    };
    let numbers = names(proc).into_iter().filter_map(|name| name.parse::<u32>().ok());
    let mut users: Vec<PortUser> = numbers
        .filter(|pid| *pid != own)
        .filter(|pid| has_open(&proc.join(pid.to_string()), &device))
        .map(|pid| {
            let comm = fs::read_to_string(proc.join(pid.to_string()).join("comm")).unwrap_or_default();
            PortUser {
                pid,
                name: comm.trim().to_string(),
            }
        })
        .collect();
    users.sort();
    users
}

/// Whether a process has the device open. The program at the other end of a pseudo-terminal keeps this end open, too, and takes
/// nothing from it.
fn has_open(process: &Path, device: &Path) -> bool {
    let directory = process.join("fd");
    let targets = names(&directory);
    let targets = targets
        .iter()
        .filter_map(|name| fs::read_link(directory.join(name)).ok());
    let targets: Vec<_> = targets.collect();
    let is_terminal_end = device.starts_with("/dev/pts") && targets.iter().any(|target| target.ends_with("ptmx"));
    !is_terminal_end && targets.iter().any(|target| target == device)
}

fn names(directory: &Path) -> Vec<String> {
    let entries = fs::read_dir(directory).into_iter().flatten().flatten();
    entries
        .filter_map(|entry| entry.file_name().into_string().ok())
        .collect()
}

/// Why a port cannot be opened, with the program that has it where that can be seen.
pub(super) fn taken(port: &str, why: String) -> String {
    if !why.contains(TAKEN) {
        return why;
    }
    let users = of(port);
    by_whom(port, owner(port, &users).as_ref(), &users).unwrap_or(why)
}

/// Error and remedy for a port that others have.
fn by_whom(port: &str, owner: Option<&Owner>, users: &[PortUser]) -> Option<String> {
    if let Some(Owner { bus, config, name }) = owner {
        let gateway = name
            .as_ref()
            .map_or_else(|| "a gateway".to_string(), |name| format!("the gateway `{name}`"));
        let config = config.as_ref().map(|config| format!(" --config {}", config.display()));
        return Some(format!(
            "{gateway} has the port for its bus `{bus}`; {port}; `drivegate diagnose {bus}{}` shows what it reads there, or \
             stop the gateway first (systemctl stop drivegate)",
            config.unwrap_or_default()
        ));
    }
    let first = users.first()?;
    let remedy = match first.name.as_str() {
        GATEWAY => "`drivegate diagnose` shows what it reads there, or stop it first".to_string(),
        _ => format!("end that program: kill {}", first.pid),
    };
    Some(format!("{} has the port; {port}; {remedy}", listed(users)))
}

/// Error and remedy where no drive answered and others have the port open without a lock.
pub(super) fn takes_replies(port: &str) -> Option<String> {
    readers(port, &of(port))
}

fn readers(port: &str, users: &[PortUser]) -> Option<String> {
    let first = users.first()?;
    Some(format!(
        "no drive answered, but {} has the port open, too, and takes replies from it; {port}; end that program (kill {}) and try \
         again",
        listed(users),
        first.pid
    ))
}

/// `minicom (pid 4711) and cat (pid 4712)`.
pub(super) fn listed(users: &[PortUser]) -> String {
    let all: Vec<String> = users.iter().map(ToString::to_string).collect();
    all.join(" and ")
}

/// The local sockets of a gateway at any path, which its process shows to root and to its own user.
fn sockets_of(process: &Path) -> Vec<PathBuf> {
    let directory = process.join("fd");
    let targets = names(&directory);
    let targets = targets
        .iter()
        .filter_map(|name| fs::read_link(directory.join(name)).ok());
    let open: Vec<String> = targets.map(|target| target.display().to_string()).collect();
    let listed = fs::read_to_string(process.join("net/unix")).unwrap_or_default();
    let paths = listed.lines().filter_map(listening);
    let paths = paths.filter(|(inode, _)| open.contains(&format!("socket:[{inode}]")));
    // A path relative to the directory in which the gateway was started becomes an absolute one.
    let started_in = fs::read_link(process.join("cwd")).unwrap_or_default();
    paths.map(|(_, path)| started_in.join(path)).collect()
}

/// Inode and path of a socket that listens, from a line of `/proc/net/unix`. Connections to it have its path, too.
fn listening(line: &str) -> Option<(&str, &str)> {
    let mut fields = line.split_ascii_whitespace();
    let (flags, inode) = (fields.nth(3)?, fields.nth(2)?);
    let (_, path) = line.split_once(&format!(" {inode} "))?;
    (flags == LISTENS && !path.starts_with('@')).then_some((inode, path))
}

/// The gateway of this machine that has a bus at the port, if its socket can be opened. `users` have the port open.
fn owner(port: &str, users: &[PortUser]) -> Option<Owner> {
    let device = Path::new(port).canonicalize().ok()?;
    let gateways = users.iter().filter(|user| user.name == GATEWAY);
    let mut sockets: Vec<PathBuf> = gateways
        .flat_map(|user| sockets_of(&Path::new("/proc").join(user.pid.to_string())))
        .collect();
    sockets.extend(SocketPath::Default.of_client(&RuntimeDirectories::of_this_process()));
    let runtime = super::runtime().ok()?;
    sockets.into_iter().filter(|socket| socket.exists()).find_map(|socket| {
        let client = Client::through(Door::Socket(socket.clone()));
        let buses: Vec<BusAt> = runtime.block_on(client.view("/api/v1/buses")).ok()?;
        let is_there = |bus: &BusAt| Path::new(&bus.port).canonicalize().is_ok_and(|path| path == device);
        let bus = buses.into_iter().find(is_there)?.name;
        let config = runtime.block_on(config_of(socket));
        let settings = config
            .as_ref()
            .and_then(|config| Settings::load(config, environment()).settings);
        Some(Owner {
            bus,
            config,
            name: settings.map(|settings| settings.gateway),
        })
    })
}

/// The configuration of the gateway at this socket: a gateway names it to a client that expects another.
async fn config_of(socket: PathBuf) -> Option<PathBuf> {
    let client = Client::for_socket(&SocketPath::At(socket), Expected::Configuration(PathBuf::new()));
    match client.ask(&GatewayRequest::view("/api/v1/health")).await {
        Err(ClientError::NotFound(missed)) => {
            let file = missed.others.first()?.split_once(RUNS_WITH)?.1;
            Some(PathBuf::from(file))
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    #[test]
    fn programs_are_found_by_their_descriptors() {
        let root = tempfile::tempdir().unwrap();
        let path = |name: &str| root.path().canonicalize().unwrap().join(name);
        fs::write(path("ttyUSB0"), "").unwrap();
        symlink(path("ttyUSB0"), path("by-id")).unwrap();
        for (pid, comm, target) in [
            ("12", "minicom\n", "ttyUSB0"),
            ("9", "drivegate\n", "ttyUSB0"),
            ("7", "cat\n", "ttyUSB1"),
            ("self", "x\n", "ttyUSB0"),
            ("99", "me\n", "ttyUSB0"),
        ] {
            let process = path("proc").join(pid);
            fs::create_dir_all(process.join("fd")).unwrap();
            fs::write(process.join("comm"), comm).unwrap();
            symlink(path(target), process.join("fd/3")).unwrap();
        }
        let port = path("by-id").display().to_string();
        let users = in_proc(&path("proc"), &port, 99);
        assert_eq!(listed(&users), "drivegate (pid 9) and minicom (pid 12)");
        assert!(in_proc(&path("proc"), "/dev/none", 99).is_empty());
        let taken = readers(&port, &users[1..]).unwrap();
        assert!(
            taken.starts_with("no drive answered, but minicom (pid 12) has the port open, too"),
            "{taken}"
        );
        assert!(taken.contains("end that program (kill 12)"), "{taken}");
        assert_eq!(readers(&port, &[]), None);
    }

    #[test]
    fn the_sockets_of_a_gateway_are_found_at_any_path() {
        let root = tempfile::tempdir().unwrap();
        let process = root.path();
        for directory in ["fd", "net"] {
            fs::create_dir(process.join(directory)).unwrap();
        }
        let listed = "Num       RefCount Protocol Flags    Type St Inode Path\n\
            0000000000000001: 00000002 00000000 00010000 0001 01  4507 /srv/plant a/own.sock\n\
            0000000000000002: 00000003 00000000 00000000 0001 03  4508 /srv/plant a/own.sock\n\
            0000000000000003: 00000002 00000000 00010000 0001 01  4509 next.sock\n\
            0000000000000004: 00000002 00000000 00010000 0001 01 45107 /run/of-another.sock\n\
            0000000000000005: 00000002 00000000 00010000 0001 01 45108 @abstract\n\
            0000000000000006: 00000003 00000000 00000000 0001 03 45109\n";
        fs::write(process.join("net/unix"), listed).unwrap();
        symlink("/srv/started", process.join("cwd")).unwrap();
        for (number, inode) in [4507, 4508, 4509, 45108, 45109].iter().enumerate() {
            let link = process.join("fd").join(number.to_string());
            symlink(format!("socket:[{inode}]"), link).unwrap();
        }
        let wanted = ["/srv/plant a/own.sock", "/srv/started/next.sock"].map(PathBuf::from);
        assert_eq!(sockets_of(process), wanted);
    }

    #[test]
    fn the_owner_of_a_port_is_named() {
        let user = |name: &str| PortUser {
            pid: 4711,
            name: name.to_string(),
        };
        let owner = |config: Option<&str>, name: Option<&str>| Owner {
            bus: "line1".to_string(),
            config: config.map(PathBuf::from),
            name: name.map(str::to_string),
        };
        let told = |owner: Option<Owner>, users: &[PortUser]| by_whom("/dev/x", owner.as_ref(), users);
        for (owner, users, wanted) in [
            (
                Some(owner(Some("/etc/d.toml"), Some("pump-house"))),
                &[user("drivegate")][..],
                "the gateway `pump-house` has the port for its bus `line1`; /dev/x; `drivegate diagnose line1 --config \
                 /etc/d.toml` shows what it reads there, or stop the gateway first",
            ),
            (
                Some(owner(None, None)),
                &[],
                "a gateway has the port for its bus `line1`; /dev/x; `drivegate diagnose line1` shows",
            ),
            (
                None,
                &[user("drivegate")],
                "drivegate (pid 4711) has the port; /dev/x; `drivegate diagnose`",
            ),
            (
                None,
                &[user("minicom")],
                "minicom (pid 4711) has the port; /dev/x; end that program: kill 4711",
            ),
        ] {
            let told = told(owner, users).unwrap();
            assert!(told.starts_with(wanted), "{told}");
        }
        assert_eq!(told(None, &[]), None);
        assert_eq!(taken("/dev/x", "Permission denied".to_string()), "Permission denied");
    }
}
