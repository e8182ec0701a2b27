//! Reads the section `[gateway]`.

use std::path::{Path, PathBuf};

use super::keys::GATEWAY;
use super::{stale, values};
use drivegate_http::local::SocketPath;
use drivegate_model::document::{Problem, Reader};
use drivegate_model::drive::profile::Profiles;

/// The default state directory.
const STATE_DIR: &str = "/var/lib/drivegate";

/// The valid settings of `[gateway]`.
pub(super) struct Gateway {
    pub(super) name: Option<String>,
    pub(super) socket: SocketPath,
    pub(super) state_dir: PathBuf,
    pub(super) profile_dirs: Vec<PathBuf>,
    pub(super) profiles: Profiles,
    pub(super) stale_after: stale::Written,
    pub(super) errors: Vec<Problem>,
}

impl Default for Gateway {
    fn default() -> Gateway {
        Gateway {
            name: None,
            socket: SocketPath::Default,
            state_dir: default_state_dir(),
            profile_dirs: Vec::new(),
            profiles: Profiles::built_in(),
            stale_after: None,
            errors: Vec::new(),
        }
    }
}

pub(super) fn read(reader: &Reader<'_>, base: &Path) -> Gateway {
    let name = GATEWAY.name.read(reader);
    let socket = read_socket(reader, base);
    let state_dir = GATEWAY.state_dir.written(reader);
    let state_dir = state_dir.map_or_else(default_state_dir, |dir| values::resolved(base, dir));
    let mut profiles = Profiles::built_in();
    let mut errors = Vec::new();
    let dirs = GATEWAY.profile_dirs.get(reader);
    let profile_dirs: Vec<PathBuf> = dirs.into_iter().map(|dir| values::resolved(base, dir)).collect();
    for dir in &profile_dirs {
        match std::fs::read_dir(dir) {
            Ok(_) => errors.extend(profiles.load(dir)),
            Err(error) => reader.problem(
                GATEWAY.profile_dirs.name,
                format!("cannot read {}: {error}", dir.display()),
                "create the directory or remove it from profile_dirs",
            ),
        }
    }
    let stale_after = stale::written(&GATEWAY.stale_after, reader);
    reader.finish();
    Gateway {
        name,
        socket,
        state_dir,
        profile_dirs,
        profiles,
        stale_after,
        errors,
    }
}

/// Reads where the local socket should be.
pub(super) fn read_socket(reader: &Reader<'_>, base: &Path) -> SocketPath {
    match GATEWAY.socket.written(reader) {
        None => SocketPath::Default,
        Some(path) if path.as_os_str().is_empty() => SocketPath::Off,
        Some(path) => SocketPath::At(values::resolved(base, path)),
    }
}

/// The state directory of the systemd unit, else the usual one.
fn default_state_dir() -> PathBuf {
    let given = std::env::var("STATE_DIRECTORY").unwrap_or_default();
    match given.split(':').next() {
        Some(dir) if !dir.is_empty() => PathBuf::from(dir),
        _ => PathBuf::from(STATE_DIR),
    }
}
