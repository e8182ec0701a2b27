//! TLS of all servers and clients: their files, whom they trust, and the text for what fails.
//!
//! | module | what it is |
//! |---|---|
//! | `pem` | reads certificates, keys and revocation lists from files |
//! | `certificate`, `key` | what the gateway itself reads from a certificate, and from its key |
//! | `identity` | certificate and key of a server or a client |
//! | `server_trust` | which servers a client trusts |
//! | `client_trust` | which clients a server trusts, with revocation lists |
//! | `fault` | what is wrong with a file, and the remedy |
//! | `explain` | why a connection failed, and the remedy |

pub(crate) mod certificate;
mod client_trust;
mod explain;
mod fault;
mod identity;
mod key;
mod pem;
mod server_trust;

use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use rustls::crypto::{self, CryptoProvider};

pub use self::client_trust::ClientTrust;
pub use self::explain::{BROKER, GATEWAY, Peer, explain, in_words, is_handshake_end};
pub use self::fault::{TlsFault, TlsFile};
pub use self::identity::ServerIdentity;
pub use self::pem::unreadable;
pub use self::server_trust::{certificate_warnings, client};

/// Last second of the year 9999, which certificates without an expiry date contain.
const LAST_DATE: u64 = 253_402_300_799;

/// The cryptographic provider that the whole gateway uses.
fn provider() -> Arc<CryptoProvider> {
    Arc::new(crypto::ring::default_provider())
}

/// A time as seconds since 1970.
pub(crate) fn seconds(time: SystemTime) -> u64 {
    time.duration_since(UNIX_EPOCH).unwrap_or_default().as_secs()
}

/// A time in seconds since 1970 for messages.
fn date(seconds: u64) -> String {
    let time = UNIX_EPOCH.checked_add(Duration::from_secs(seconds.min(LAST_DATE)));
    time.map_or_else(String::new, |time| humantime::format_rfc3339_seconds(time).to_string())
}
