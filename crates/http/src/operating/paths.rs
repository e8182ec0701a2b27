//! Decides which paths belong to commands.

use axum::http::Method;

/// Whether a path belongs to commands; while commands are off, such a path does not exist.
pub(crate) fn is_operating(path: &str) -> bool {
    let of_drive = |rest: &str| {
        rest.split_once('/')
            .is_some_and(|(_, what)| matches!(what, "commands" | "heartbeat" | "hold"))
    };
    is_session(path)
        || path == "/api/v1/stop"
        || is_drill(path)
        || path.starts_with("/assets/operate.")
        || path.strip_prefix("/api/v1/drives/").is_some_and(of_drive)
}

/// Whether a path is about the session of a user.
pub(crate) fn is_session(path: &str) -> bool {
    matches!(path, "/api/v1/login" | "/api/v1/logout" | "/api/v1/session")
}

/// Whether a request may change something when commands are enabled.
pub(crate) fn may_change(method: &Method, path: &str) -> bool {
    let of_drive = |rest: &str| {
        rest.split_once('/')
            .is_some_and(|(_, what)| matches!(what, "recordings" | "params/reading" | "params/restore"))
    };
    let changes = is_operating(path) || path.strip_prefix("/api/v1/drives/").is_some_and(of_drive);
    let ends_a_drill = *method == Method::DELETE && is_drill(path);
    ends_a_drill || (*method == Method::POST && changes)
}

/// Whether the path belongs to drills.
fn is_drill(path: &str) -> bool {
    path == "/api/v1/drills" || path.starts_with("/api/v1/drills/")
}

/// Whether the request is a command: commands are served on any connection.
pub(crate) fn is_command(method: &Method, path: &str) -> bool {
    may_change(method, path) && (path.ends_with("/commands") || path == "/api/v1/stop" || *method == Method::DELETE)
}
