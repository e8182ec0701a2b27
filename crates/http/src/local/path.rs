//! The path of the local socket: chosen alike by the gateway and its clients, and never taken from a running gateway.

use std::fs::{File, Permissions};
use std::io;
use std::os::unix::fs::{FileTypeExt, MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::time::Duration;

use rustix::fs::{FlockOperation, flock};
use tokio::net::{UnixListener, UnixSocket, UnixStream};

/// Directory of the default path where neither systemd nor the session of a user gives one.
const SYSTEM_DIRECTORY: &str = "/run/drivegate";
/// Maximum number of sockets in one directory: one for each gateway of one user that runs with the default path.
const MAX_GATEWAYS: usize = 16;
/// Owner and group may read and write, which both take to connect.
const MODE: u32 = 0o660;
/// Maximum number of clients that wait to be accepted. A client beyond them gets an error at once, whatever it has to
/// say, so a crowd of programs must fit while a busy machine delays the gateway.
const BACKLOG: u32 = 1024;
/// Tries to lock the directory, while another gateway starts, and the time between them.
const LOCK_TRIES: u32 = 50;
const LOCK_PAUSE: Duration = Duration::from_millis(20);

/// Path where the local socket should be.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum SocketPath {
    /// The default name in the runtime directory.
    #[default]
    Default,
    /// Use this path.
    At(PathBuf),
    /// The local socket is off.
    Off,
}

/// The environment variables that name the directory for runtime files.
#[derive(Debug, Clone, Default)]
pub struct RuntimeDirectories {
    /// `RUNTIME_DIRECTORY`: that of a service, by systemd.
    service: Option<PathBuf>,
    /// `XDG_RUNTIME_DIR` of a user's session.
    session: Option<PathBuf>,
}

impl RuntimeDirectories {
    /// The runtime directories of this process.
    pub fn of_this_process() -> RuntimeDirectories {
        let variable = |name| {
            std::env::var_os(name)
                .map(PathBuf::from)
                .filter(|path| path.is_absolute())
        };
        let first = |path: PathBuf| match path.to_str().and_then(|paths| paths.split_once(':')) {
            Some((first, _)) => PathBuf::from(first),
            None => path,
        };
        RuntimeDirectories {
            service: variable("RUNTIME_DIRECTORY").map(first),
            session: variable("XDG_RUNTIME_DIR"),
        }
    }

    /// All runtime directories, the most specific first.
    fn all(&self) -> impl Iterator<Item = PathBuf> {
        let given = [self.service.clone(), self.session.clone()].into_iter().flatten();
        given.chain([PathBuf::from(SYSTEM_DIRECTORY)])
    }
}

impl SocketPath {
    /// Paths at which a gateway may listen: it uses the first one that no running gateway has.
    pub(super) fn of_gateway(&self, directories: &RuntimeDirectories) -> Vec<PathBuf> {
        match self {
            SocketPath::Default => directories.all().next().map(numbered).unwrap_or_default(),
            SocketPath::At(path) => vec![path.clone()],
            SocketPath::Off => Vec::new(),
        }
    }

    /// Paths at which a client looks for its gateway, which may be a service or run in a session of the same user.
    pub fn of_client(&self, directories: &RuntimeDirectories) -> Vec<PathBuf> {
        match self {
            SocketPath::Default => directories.all().flat_map(numbered).collect(),
            _ => self.of_gateway(directories),
        }
    }
}

/// Numbered socket paths: `drivegate.sock`, `drivegate-2.sock` and so on.
fn numbered(directory: PathBuf) -> Vec<PathBuf> {
    let name = |number| match number {
        1 => "drivegate.sock".to_string(),
        number => format!("drivegate-{number}.sock"),
    };
    (1..=MAX_GATEWAYS).map(|number| directory.join(name(number))).collect()
}

/// A socket that this process listens on; dropping it removes the file of the socket.
#[derive(Debug)]
pub(super) struct Bound {
    pub(super) listener: UnixListener,
    pub(super) path: PathBuf,
    /// Device and inode of the socket file.
    id: (u64, u64),
}

impl Drop for Bound {
    fn drop(&mut self) {
        // The socket still listens, so no other gateway has replaced the file; another program may have.
        if std::fs::symlink_metadata(&self.path).is_ok_and(|file| (file.dev(), file.ino()) == self.id) {
            let _ = std::fs::remove_file(&self.path);
        }
    }
}

/// Listens on the first of `paths` that no running gateway has.
///
/// # Errors
/// If no socket can be bound; contains the reason.
pub(super) async fn bind_first(paths: &[PathBuf]) -> io::Result<Bound> {
    let mut error = io::Error::from(io::ErrorKind::NotFound);
    for path in paths {
        match bind(path).await {
            Ok(bound) => return Ok(bound),
            Err(why) if why.kind() == io::ErrorKind::AddrInUse => error = why,
            Err(why) => return Err(why),
        }
    }
    Err(error)
}

/// Listens on `path`. The file of a killed gateway is replaced, the file of a running one is not. The check and the
/// replacement happen under a lock on the directory, so that two gateways that start together do not both replace
/// it.
async fn bind(path: &Path) -> io::Result<Bound> {
    let directory = path.parent().filter(|parent| !parent.as_os_str().is_empty());
    let directory = directory.unwrap_or(Path::new("."));
    if directory == Path::new(SYSTEM_DIRECTORY) {
        // For a service systemd creates the directory, but not for a gateway that root starts by hand.
        let _ = std::fs::create_dir(directory);
    }
    let _lock = lock(directory).await?;
    remove_if_dead(path).await?;
    let socket = UnixSocket::new_stream()?;
    socket.bind(path)?;
    // The mode is set before the socket listens, so no client can connect earlier.
    std::fs::set_permissions(path, Permissions::from_mode(MODE))?;
    let listener = socket.listen(BACKLOG)?;
    let file = std::fs::symlink_metadata(path)?;
    Ok(Bound {
        listener,
        path: path.to_path_buf(),
        id: (file.dev(), file.ino()),
    })
}

async fn lock(directory: &Path) -> io::Result<File> {
    let file = File::open(directory)?;
    for _ in 0..LOCK_TRIES {
        match flock(&file, FlockOperation::NonBlockingLockExclusive) {
            Ok(()) => return Ok(file),
            Err(rustix::io::Errno::WOULDBLOCK) => tokio::time::sleep(LOCK_PAUSE).await,
            Err(error) => return Err(error.into()),
        }
    }
    Err(io::Error::other("another program keeps its directory locked"))
}

/// Removes a stale socket.
async fn remove_if_dead(path: &Path) -> io::Result<()> {
    let in_use = |why| Err(io::Error::new(io::ErrorKind::AddrInUse, why));
    match std::fs::symlink_metadata(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
        Err(error) => return Err(error),
        Ok(file) if !file.file_type().is_socket() => {
            return Err(io::Error::other("its path is taken by a file that is not a socket"));
        }
        Ok(_) => {}
    }
    match UnixStream::connect(path).await {
        Err(error) if error.kind() == io::ErrorKind::ConnectionRefused => std::fs::remove_file(path),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        // The backlog of the other socket is full, so a gateway is listening there.
        Err(error) if error.kind() == io::ErrorKind::WouldBlock => in_use("another gateway listens there"),
        Err(error) => Err(error),
        Ok(_) => in_use("another gateway listens there"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn directories(service: Option<&str>, session: Option<&str>) -> RuntimeDirectories {
        RuntimeDirectories {
            service: service.map(PathBuf::from),
            session: session.map(PathBuf::from),
        }
    }

    #[test]
    fn a_client_looks_wherever_its_gateway_may_listen() {
        let service = directories(Some("/run/drivegate"), None);
        let session = directories(None, Some("/run/user/1000"));
        let neither = directories(None, None);
        let shell = &session;
        for (gateway, first) in [
            (&service, "/run/drivegate/drivegate.sock"),
            (&session, "/run/user/1000/drivegate.sock"),
            (&neither, "/run/drivegate/drivegate.sock"),
        ] {
            let listens = SocketPath::Default.of_gateway(gateway);
            assert_eq!(listens.first(), Some(&PathBuf::from(first)));
            let looks = SocketPath::Default.of_client(shell);
            assert!(listens.iter().all(|path| looks.contains(path)), "{listens:?}");
        }
        let at = SocketPath::At("/tmp/own.sock".into());
        assert_eq!(at.of_gateway(&service), [PathBuf::from("/tmp/own.sock")]);
        assert_eq!(at.of_client(&session), [PathBuf::from("/tmp/own.sock")]);
        assert!(SocketPath::Off.of_gateway(&service).is_empty() && SocketPath::Off.of_client(&service).is_empty());
    }

    #[tokio::test]
    async fn the_file_of_a_dead_gateway_is_replaced_and_that_of_a_live_one_is_not() {
        let folder = tempfile::tempdir().unwrap();
        let paths = numbered(folder.path().to_path_buf());
        let path = &paths[0];
        // A process that was killed leaves such a file.
        drop(std::os::unix::net::UnixListener::bind(path).unwrap());
        assert!(path.exists());
        let first = bind(path).await.unwrap();
        assert_eq!(std::fs::metadata(path).unwrap().permissions().mode() & 0o777, 0o660);
        let refused = bind(path).await.unwrap_err();
        assert_eq!(refused.kind(), io::ErrorKind::AddrInUse, "{refused}");
        let second = bind_first(&paths).await.unwrap();
        assert_eq!(second.path, paths[1], "a second gateway takes the next name");
        assert!(
            UnixStream::connect(path).await.is_ok(),
            "the first one was not disturbed"
        );
        drop(first);
        assert!(!path.exists() && paths[1].exists(), "each removes its own");
        let third = bind_first(&paths).await.unwrap();
        assert_eq!(&third.path, path);
        // Another program replaces the socket with its own file.
        std::fs::remove_file(path).unwrap();
        std::fs::write(path, "mine").unwrap();
        drop(third);
        assert!(path.exists(), "what is not its own stays");
        let refused = bind_first(&paths).await.unwrap_err();
        assert!(refused.to_string().contains("not a socket"), "{refused}");
    }

    #[tokio::test]
    async fn a_crowd_connects_before_any_client_is_accepted() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("own.sock");
        let _bound = bind(&path).await.unwrap();
        let mut crowd = Vec::new();
        for number in 0..200 {
            let client = UnixStream::connect(&path).await;
            crowd.push(client.unwrap_or_else(|error| panic!("client {number}: {error}")));
        }
    }

    #[tokio::test]
    async fn of_many_that_start_together_each_has_its_own() {
        let folder = tempfile::tempdir().unwrap();
        let paths = numbered(folder.path().to_path_buf());
        drop(std::os::unix::net::UnixListener::bind(&paths[0]).unwrap());
        let all = futures_util::future::join_all((0..MAX_GATEWAYS).map(|_| bind_first(&paths))).await;
        let mut taken: Vec<PathBuf> = all.iter().map(|bound| bound.as_ref().unwrap().path.clone()).collect();
        taken.sort();
        taken.dedup();
        assert_eq!(taken.len(), MAX_GATEWAYS);
        let full = bind_first(&paths).await.unwrap_err();
        assert_eq!(full.kind(), io::ErrorKind::AddrInUse);
    }
}
