//! Which build of the program this is.

use std::sync::OnceLock;

/// The version of the packages, the same for all.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");

static COMMIT: OnceLock<&'static str> = OnceLock::new();

/// Notes the commit of the build; `main` does so, because only the program's own package is built again with each
/// commit. Without effect after the first call.
pub fn set_commit(commit: Option<&'static str>) {
    if let Some(commit) = commit {
        let _ = COMMIT.set(commit);
    }
}

/// The commit of the build, if known.
pub fn commit() -> Option<&'static str> {
    COMMIT.get().copied()
}
