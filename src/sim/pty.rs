//! A pseudo-terminal that looks like a serial port to a master, with a link that keeps its name.

use rustix::fs::{Mode, OFlags, fcntl_setfl};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, QueueSelector, ioctl_tiocnxcl, tcflush, tcgetattr, tcsetattr};
use std::fs;
use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};

/// A pseudo-terminal; dropping it takes path and link away.
#[derive(Debug)]
pub(crate) struct Pty {
    /// The drives' end.
    pub(super) master: OwnedFd,
    /// The master's end, kept open: without it reads at the drives' end fail while no master is connected.
    slave: OwnedFd,
    path: PathBuf,
    link: Option<PathBuf>,
}

impl Pty {
    /// A new pseudo-terminal in raw mode; `link` becomes a symbolic link to it.
    ///
    /// # Errors
    /// No pseudo-terminal is available, or the link cannot be made. Anything but a symbolic link at its path is left alone
    /// and is an error.
    pub(crate) fn open(link: Option<&Path>) -> io::Result<Pty> {
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

    /// What a master opens: the link when there is one.
    pub(crate) fn path(&self) -> &Path {
        self.link.as_deref().unwrap_or(&self.path)
    }

    /// Does what the last close of a serial port does, which the open slave end prevents here: discards unread bytes, and
    /// releases the exclusive access of a master that was killed.
    pub(super) fn settle(&self) {
        let _ = tcflush(&self.slave, QueueSelector::IFlush);
        let _ = ioctl_tiocnxcl(&self.slave);
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

/// Makes `link` point to `target`, in place of an older link.
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
        Ok(found) if !found.is_symlink() => {
            let text = format!(
                "{} exists and is not a symbolic link; choose another path or remove it",
                link.display()
            );
            return Err(io::Error::new(io::ErrorKind::AlreadyExists, text));
        }
        Ok(_) => fs::remove_file(link).map_err(explain)?,
        Err(error) if error.kind() == io::ErrorKind::NotFound => {}
        Err(error) => return Err(explain(error)),
    }
    symlink(target, link).map_err(explain)
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
        let nowhere = directory.path().join("no/such/line");
        assert!(
            Pty::open(Some(&nowhere))
                .unwrap_err()
                .to_string()
                .contains("cannot link")
        );
    }
}
