//! Checks files of certificates and secrets: errors, and warnings about who can read them and when they expire.

use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::time::SystemTime;

use drivegate_model::document::{Finding, Reader};
use drivegate_north::tls::{TlsFault, TlsFile, certificate_warnings, unreadable};

/// Permissions of users who are neither owner nor in the group: to read, and to write.
const OTHERS: u32 = 0o006;

/// Warns if every user of this machine can read or replace a file with a secret, which the `key` of the configuration
/// names.
pub(super) fn warn_of_readers(reader: &Reader<'_>, key: &str, path: &Path) {
    // An unreadable file is reported by the code that reads it.
    let Ok(metadata) = std::fs::metadata(path) else { return };
    let mode = metadata.permissions().mode() & 0o777;
    if metadata.is_file() && mode & OTHERS != 0 {
        let shown = path.display();
        reader.warning(
            key,
            format!("{shown} holds a secret, and every user of this machine may read or write it (mode {mode:04o})"),
            format!("chmod o-rw {shown}"),
        );
    }
}

/// A file that the configuration names cannot be read.
pub(super) fn cannot_read(path: &Path, error: &std::io::Error) -> Finding {
    let (what, remedy) = unreadable(path, error);
    Finding::new(what, remedy)
}

/// Reports the problems in the files of an identity, each at the key that names the file, by `name`.
pub(super) fn reported<'k, T>(
    reader: &Reader<'_>,
    loaded: Result<(T, Vec<TlsFault>), Vec<TlsFault>>,
    name: impl Fn(TlsFile) -> &'k str,
) -> Option<T> {
    match loaded {
        Ok((identity, warnings)) => {
            for fault in &warnings {
                let text = fault.to_string();
                let (what, remedy) = parts(&text);
                reader.warning(name(fault.file), what, remedy);
            }
            Some(identity)
        }
        Err(errors) => {
            for fault in &errors {
                let text = fault.to_string();
                let (what, remedy) = parts(&text);
                reader.problem(name(fault.file), what, remedy);
            }
            None
        }
    }
}

/// Warns of certificates in a PEM file by which the server `host` may not be trusted; reports a file without certificates.
pub(super) fn check_certificates(reader: &Reader<'_>, key: &str, path: &Path, host: &str) {
    let loaded = certificate_warnings(path, host, SystemTime::now());
    let loaded = loaded.map(|warnings| ((), warnings)).map_err(|fault| vec![fault]);
    reported(reader, loaded, |_| key);
}

/// Splits the fault of a file, which has the form `what; what to do`.
fn parts(text: &str) -> (&str, &str) {
    text.rsplit_once("; ").unwrap_or((text, ""))
}
