//! The build of the program: version and commit.

use std::sync::OnceLock;

/// The version of all packages.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");

static COMMIT: OnceLock<&'static str> = OnceLock::new();

/// Sets the commit of the build. `main` calls this, because only the program's own package is rebuilt with each
/// commit. Later calls have no effect.
pub fn set_commit(commit: Option<&'static str>) {
    if let Some(commit) = commit {
        let _ = COMMIT.set(commit);
    }
}

/// The commit of the build, if known.
pub fn commit() -> Option<&'static str> {
    COMMIT.get().copied()
}
