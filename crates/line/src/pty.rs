//! A pseudo-terminal that looks like a serial port to any program that opens it, with a link whose name stays the same.

use rustix::fs::{Mode, OFlags, fchmod, fcntl_setfl};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, QueueSelector, ioctl_tiocnxcl, tcflush, tcgetattr, tcsetattr};
use std::fs;
use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::fs::{fchown, symlink};
use std::path::{Path, PathBuf};

/// Directory in which the system has its pseudo-terminals.
const TERMINALS: &str = "/dev/pts";

/// A pseudo-terminal; dropping it removes path and link. Its file descriptor is our own end.
#[derive(Debug)]
pub struct Pty {
    /// Our own end of the pseudo-terminal.
    master: OwnedFd,
    /// The end for the other program, kept open: otherwise reads at our own end would fail while no program has the
    /// port open.
    slave: OwnedFd,
    path: PathBuf,
    link: Option<PathBuf>,
}

impl Pty {
    /// Opens a new pseudo-terminal in raw mode; `link` becomes a symbolic link to it.
    ///
    /// # Errors
    /// If no pseudo-terminal is available, or the link cannot be made. Whatever exists at the path of the link and is
    /// not a symbolic link to a pseudo-terminal is left unchanged and is an error.
    pub fn open(link: Option<&Path>) -> io::Result<Pty> {
        let flags = OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC;
        let master = openpt(flags)?;
        grantpt(&master)?;
        unlockpt(&master)?;
        fcntl_setfl(&master, OFlags::RDWR | OFlags::NONBLOCK)?;
        let name = ptsname(&master, Vec::new())?;
        let slave = rustix::fs::open(&*name, OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC, Mode::empty())?;
        let mut attributes = tcgetattr(&slave)?;
        attributes.make_raw();
        tcsetattr(&slave, OptionalActions::Now, &attributes)?;
        let path = PathBuf::from(name.to_string_lossy().into_owned());
        if let Some(link) = link {
            point(link, &path)?;
        }
        Ok(Pty {
            master,
            slave,
            path,
            link: link.map(Path::to_path_buf),
        })
    }

    /// Lets the group of this process open the terminal as well: mode 0660.
    ///
    /// # Errors
    /// If the system refuses to change the mode.
    pub fn share(&self) -> io::Result<()> {
        fchown(&self.slave, None, Some(rustix::process::getegid().as_raw()))?;
        fchmod(&self.slave, Mode::from_raw_mode(0o660))?;
        Ok(())
    }

    /// Reads the available bytes, without waiting.
    ///
    /// # Errors
    /// If there are no bytes, or the system reports another error.
    pub fn read(&self, buffer: &mut [u8]) -> io::Result<usize> {
        Ok(rustix::io::read(&self.master, buffer)?)
    }

    /// Writes as many bytes as there is room for, without waiting.
    ///
    /// # Errors
    /// If there is no room, or the system reports another error.
    pub fn write(&self, bytes: &[u8]) -> io::Result<usize> {
        Ok(rustix::io::write(&self.master, bytes)?)
    }

    /// The path that the other program opens: the link, if one exists.
    pub fn path(&self) -> &Path {
        self.link.as_deref().unwrap_or(&self.path)
    }

    /// Discards bytes that were written and not read yet.
    pub fn discard_unread(&self) {
        let _ = tcflush(&self.slave, QueueSelector::IFlush);
    }

    /// Does what the last close of a serial port does and the open slave end prevents here: discards unread bytes,
    /// and releases the exclusive access of a program that was killed.
    pub fn settle(&self) {
        self.discard_unread();
        let _ = ioctl_tiocnxcl(&self.slave);
    }
}

impl AsFd for Pty {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.master.as_fd()
    }
}

impl Drop for Pty {
    fn drop(&mut self) {
        let Some(link) = &self.link else { return };
        if fs::read_link(link).is_ok_and(|target| target == self.path) {
            let _ = fs::remove_file(link);
        }
    }
}

/// Makes `link` point to `target`, instead of a link that an earlier pseudo-terminal left, in one step.
fn point(link: &Path, target: &Path) -> io::Result<()> {
    let explain = |error: io::Error| {
        let text = format!(
            "cannot link {} to {}: {error}; choose a path that may be written",
            link.display(),
            target.display()
        );
        io::Error::new(error.kind(), text)
    };
    match fs::symlink_metadata(link) {
        Ok(_) => match fs::read_link(link) {
            Ok(left) if left.starts_with(TERMINALS) => {}
            _ => {
                let text = format!(
                    "{} exists and is not a symbolic link to a pseudo-terminal; choose another path or remove it",
                    link.display()
                );
                return Err(io::Error::new(io::ErrorKind::AlreadyExists, text));
            }
        },
        Err(error) if error.kind() == io::ErrorKind::NotFound => return symlink(target, link).map_err(explain),
        Err(error) => return Err(explain(error)),
    }
    let mut aside = link.as_os_str().to_owned();
    aside.push(format!(".{}", std::process::id()));
    let aside = PathBuf::from(aside);
    // Removes the link of a killed process that had the number of this one.
    let _ = fs::remove_file(&aside);
    symlink(target, &aside).map_err(explain)?;
    fs::rename(&aside, link).map_err(|error| {
        let _ = fs::remove_file(&aside);
        explain(error)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn links_come_and_go_and_files_are_left_alone() {
        let directory = tempfile::tempdir().unwrap();
        let link = directory.path().join("line1");
        let first = Pty::open(Some(&link)).unwrap();
        assert_eq!(fs::read_link(&link).unwrap(), first.path);
        assert_eq!(first.path(), link);
        let second = Pty::open(Some(&link)).unwrap();
        assert_eq!(fs::read_link(&link).unwrap(), second.path);
        drop(first);
        assert!(fs::symlink_metadata(&link).is_ok(), "the newer link stays");
        drop(second);
        assert!(fs::symlink_metadata(&link).is_err());

        fs::write(&link, "precious").unwrap();
        let error = Pty::open(Some(&link)).unwrap_err();
        assert!(error.to_string().contains("not a symbolic link"), "{error}");
        assert_eq!(fs::read_to_string(&link).unwrap(), "precious");
        let other = directory.path().join("by-id");
        symlink("/dev/ttyUSB0", &other).unwrap();
        assert!(Pty::open(Some(&other)).is_err(), "the link to an adapter stays");
        assert_eq!(fs::read_link(&other).unwrap(), Path::new("/dev/ttyUSB0"));
        let nowhere = directory.path().join("no/such/line");
        assert!(
            Pty::open(Some(&nowhere))
                .unwrap_err()
                .to_string()
                .contains("cannot link")
        );
    }
    #[test]
    fn the_group_may_open_it() {
        use std::os::unix::fs::MetadataExt;
        let pty = Pty::open(None).unwrap();
        pty.share().unwrap();
        let metadata = fs::metadata(&pty.path).unwrap();
        assert_eq!(metadata.mode() & 0o777, 0o660);
        assert_eq!(metadata.gid(), rustix::process::getegid().as_raw());
    }

    #[test]
    fn what_was_not_read_is_discarded() {
        let pty = Pty::open(None).unwrap();
        let mut port = fs::OpenOptions::new().read(true).write(true).open(&pty.path).unwrap();
        pty.write(b"late").unwrap();
        pty.discard_unread();
        pty.write(b"now").unwrap();
        let mut heard = [0; 8];
        let count = io::Read::read(&mut port, &mut heard).unwrap();
        assert_eq!(&heard[..count], b"now");
        io::Write::write_all(&mut port, &[1, 3, 255]).unwrap();
        assert_eq!(pty.read(&mut heard).unwrap(), 3);
        assert_eq!(&heard[..3], [1, 3, 255]);
    }
}
