//! Notices that the device of a port may have returned: by inotify, on the directories where its path and the links
//! in it would appear. Without inotify, only the pauses between attempts apply.

use std::mem::MaybeUninit;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};

use rustix::fs::inotify::{self, CreateFlags, Reader, WatchFlags};

/// Maximum number of nested links that are followed.
const MOST_LINKS: usize = 8;
/// A node or link is created, or its permissions change, which is the last step of the system.
const SEEN: WatchFlags = WatchFlags::CREATE
    .union(WatchFlags::MOVED_TO)
    .union(WatchFlags::ATTRIB)
    .union(WatchFlags::ONLYDIR);

/// Waits for the device of a port.
#[derive(Debug)]
pub struct Arrival {
    inotify: OwnedFd,
    /// Each watched directory with the name that may appear in it.
    watched: Vec<(i32, PathBuf)>,
}

impl Arrival {
    /// Watches for the device `port` from now on. `None` for device servers, and if the system has no inotify
    /// instance left.
    pub fn of(port: &str) -> Option<Arrival> {
        if port.contains("://") {
            return None;
        }
        let watch = || -> rustix::io::Result<Arrival> {
            let inotify = inotify::init(CreateFlags::NONBLOCK | CreateFlags::CLOEXEC)?;
            let mut watched = Vec::new();
            for (directory, name) in steps(Path::new(port)) {
                watched.push((inotify::add_watch(&inotify, &directory, SEEN)?, name));
            }
            Ok(Arrival { inotify, watched })
        };
        watch()
            .inspect_err(|error| {
                tracing::debug!(target: "drivegate::line::arrival", port, "cannot watch for the \
                                                                                            device: {error}; polling \
                                                                                            for it instead")
            })
            .ok()
    }

    /// File descriptor that is readable when something has appeared.
    pub fn fd(&self) -> BorrowedFd<'_> {
        self.inotify.as_fd()
    }

    /// Whether the arrivals since the last call concern the device; forgets these arrivals.
    pub fn take(&self) -> bool {
        let mut buffer = [MaybeUninit::uninit(); 4096];
        let mut reader = Reader::new(&self.inotify, &mut buffer);
        let mut concerns = false;
        while let Ok(event) = reader.next() {
            let name = event.file_name().map(|name| name.to_bytes());
            let is_wanted =
                |(watch, wanted): &(i32, PathBuf)| *watch == event.wd() && name == Some(wanted.as_os_str().as_bytes());
            concerns |= self.watched.iter().any(is_wanted);
        }
        concerns
    }
}

/// Where to watch: for the path and each link in it, the nearest existing directory and the name missing there or,
/// if everything exists, its directory and its own name.
fn steps(port: &Path) -> Vec<(PathBuf, PathBuf)> {
    let mut steps = Vec::new();
    let mut path = port.to_path_buf();
    for _ in 0..MOST_LINKS {
        let Some((directory, name)) = step(&path) else { break };
        let target = std::fs::read_link(directory.join(&name));
        steps.push((directory.clone(), name));
        match target {
            Ok(target) => path = directory.join(target),
            Err(_) => break,
        }
    }
    steps
}

fn step(path: &Path) -> Option<(PathBuf, PathBuf)> {
    let mut name = path.file_name()?;
    for directory in path.ancestors().skip(1) {
        let directory = if directory.as_os_str().is_empty() {
            Path::new(".")
        } else {
            directory
        };
        if directory.is_dir() {
            return Some((directory.to_path_buf(), PathBuf::from(name)));
        }
        name = directory.file_name()?;
    }
    None
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::fs::{PermissionsExt, symlink};
    use std::time::{Duration, Instant};

    use rustix::event::{PollFd, PollFlags};

    use super::*;

    /// Waits until something concerns the device; without inotify this would take a minute, and fail.
    fn arrives(arrival: &Arrival) -> bool {
        let deadline = Instant::now() + Duration::from_secs(60);
        while Instant::now() < deadline {
            let fd = arrival.fd();
            let mut fds = [PollFd::from_borrowed_fd(fd, PollFlags::IN)];
            let _ = super::super::poll_until(&mut fds, deadline);
            if arrival.take() {
                return true;
            }
        }
        false
    }

    #[test]
    fn links_their_targets_and_missing_directories_are_noticed_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path();
        let port = root.join("serial/by-id/usb-1");
        let of = || Arrival::of(port.to_str().unwrap()).unwrap();
        // The steps of the system when an adapter is plugged in.
        let arrival = of();
        fs::write(root.join("ttyUSB7"), "").unwrap();
        assert!(!arrival.take(), "another device");
        fs::create_dir(root.join("serial")).unwrap();
        assert!(arrives(&arrival));
        let arrival = of();
        fs::create_dir(root.join("serial/by-id")).unwrap();
        assert!(arrives(&arrival));
        let arrival = of();
        symlink("../../ttyUSB0", &port).unwrap();
        assert!(arrives(&arrival));
        let arrival = of();
        assert!(!arrival.take());
        fs::write(root.join("ttyUSB0"), "").unwrap();
        assert!(arrives(&arrival));
        let arrival = of();
        fs::set_permissions(root.join("ttyUSB0"), fs::Permissions::from_mode(0o660)).unwrap();
        assert!(arrives(&arrival));
    }

    #[test]
    fn device_servers_and_links_in_a_circle_are_no_obstacle() {
        assert!(Arrival::of("tcp://127.0.0.1:1").is_none());
        let folder = tempfile::tempdir().unwrap();
        let port = folder.path().join("a");
        symlink("a", &port).unwrap();
        assert_eq!(steps(&port).len(), MOST_LINKS);
        assert!(Arrival::of(port.to_str().unwrap()).is_some());
    }
}
