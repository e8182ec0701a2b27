//! The certificates of the connected TLS clients. A client stays connected only while its certificate would admit it
//! again with the same rights: after a reload, and when one of its certificates expires.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, SystemTime};

use rustls_pki_types::CertificateDer;
use tokio_util::sync::CancellationToken;

use super::tls::{Requirements, Role};
use crate::connection_limit::Rights;
use crate::tls::{certificate, seconds};
use drivegate_core::order::Authority;

/// Longest time between two looks at the calendar, which can be set at any time.
const LOOK: Duration = Duration::from_secs(60);

/// The connected clients, and the requirements for their certificates.
#[derive(Debug)]
pub(super) struct OpenClients(Mutex<State>);

#[derive(Debug)]
struct State {
    requirements: Arc<Requirements>,
    open: HashMap<u64, OpenClient>,
    next: u64,
}

#[derive(Debug)]
struct OpenClient {
    /// Certificate chain of the client, the client's certificate first.
    chain: Vec<CertificateDer<'static>>,
    role_name: Option<String>,
    role: Role,
    /// The client's name in the log.
    who: String,
    refused: CancellationToken,
    /// Rights of the client; `None` until it has a place.
    rights: Option<Rights>,
}

impl OpenClient {
    /// Why the client must be disconnected; `None` if it may stay.
    fn objection(&self, requirements: &Requirements, now: SystemTime) -> Option<String> {
        if let Err(error) = requirements.check(&self.chain, now) {
            return Some(format!("its certificate is no longer accepted: {error}"));
        }
        let changed = requirements.role(self.role_name.as_deref()) != self.role;
        changed.then(|| "the rights of its role have changed".to_string())
    }

    fn disconnect(&self, why: &str) {
        tracing::warn!(target: "drivegate::north::modbus_tcp", client = %self.who, "Modbus TCP: disconnecting a client: {why}");
        if let Some(rights) = &self.rights {
            rights.set(Authority::ReadOnly);
        }
        self.refused.cancel();
    }
}

impl OpenClients {
    pub(super) fn new(requirements: Requirements) -> Arc<OpenClients> {
        Arc::new(OpenClients(Mutex::new(State {
            requirements: Arc::new(requirements),
            open: HashMap::new(),
            next: 0,
        })))
    }

    /// The requirements for new clients.
    pub(super) fn requirements(&self) -> Arc<Requirements> {
        self.lock().requirements.clone()
    }

    /// Checks all clients against new requirements at `now`, and disconnects those that do not meet them.
    pub(super) fn renew(&self, requirements: Requirements, now: SystemTime) {
        let mut state = self.lock();
        for client in state.open.values() {
            if let Some(why) = client.objection(&requirements, now) {
                client.disconnect(&why);
            }
        }
        state.requirements = Arc::new(requirements);
    }

    /// Registers a client whose `chain` was verified against `verified`, with the role in its certificate.
    ///
    /// # Errors
    /// If the requirements changed in the meantime and no longer admit the client.
    pub(super) fn admit(
        self: &Arc<Self>,
        verified: &Arc<Requirements>,
        chain: Vec<CertificateDer<'static>>,
        role_name: Option<String>,
        who: String,
    ) -> Result<(CertificateGuard, Role), rustls::Error> {
        let ends = chain.iter().filter_map(|der| certificate::read(der).ok());
        let ends = ends.map(|certificate| certificate.not_after).collect();
        let mut state = self.lock();
        if !Arc::ptr_eq(&state.requirements, verified) {
            state.requirements.check(&chain, SystemTime::now())?;
        }
        let role = state.requirements.role(role_name.as_deref());
        let refused = CancellationToken::new();
        let id = state.next;
        state.next += 1;
        let client = OpenClient {
            chain,
            role_name,
            role,
            who,
            refused: refused.clone(),
            rights: None,
        };
        state.open.insert(id, client);
        let guard = CertificateGuard {
            clients: self.clone(),
            id,
            ends,
            refused,
        };
        Ok((guard, role))
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A connected TLS client; it counts as disconnected when this value is dropped.
#[derive(Debug)]
pub(super) struct CertificateGuard {
    clients: Arc<OpenClients>,
    id: u64,
    /// When the client's certificates expire, seconds since 1970.
    ends: Vec<u64>,
    refused: CancellationToken,
}

impl CertificateGuard {
    /// Sets the rights of the client, which end with its certificate or its role.
    pub(super) fn watch(&self, rights: &Rights) {
        let mut state = self.clients.lock();
        if let Some(client) = state.open.get_mut(&self.id) {
            client.rights = Some(rights.clone());
        }
        if self.refused.is_cancelled() {
            rights.set(Authority::ReadOnly);
        }
    }

    /// Waits until the client must be disconnected: a reload no longer admits it, or a certificate of its chain has
    /// expired.
    pub(super) async fn refused(&self) {
        tokio::select! {
            () = self.refused.cancelled() => {}
            () = self.expired() => {}
        }
    }

    async fn expired(&self) {
        let mut now = SystemTime::now();
        loop {
            let checked = now;
            tokio::time::sleep(time_to_next(&self.ends, now)).await;
            now = SystemTime::now();
            if any_between(&self.ends, checked, now) && self.is_refused(now) {
                return;
            }
        }
    }

    /// Whether the client must be disconnected.
    fn is_refused(&self, now: SystemTime) -> bool {
        let state = self.clients.lock();
        let Some(client) = state.open.get(&self.id) else {
            return true;
        };
        let why = client.objection(&state.requirements, now);
        if let Some(why) = &why {
            client.disconnect(why);
        }
        why.is_some()
    }
}

impl Drop for CertificateGuard {
    fn drop(&mut self) {
        self.clients.lock().open.remove(&self.id);
    }
}

/// Time until the next of `ends` has passed, at most [`LOOK`]. A certificate is valid through its last second.
fn time_to_next(ends: &[u64], now: SystemTime) -> Duration {
    let now = seconds(now);
    let left = ends.iter().filter(|end| **end >= now).min().map(|end| end + 1 - now);
    left.map_or(LOOK, Duration::from_secs).min(LOOK)
}

/// Whether one of `ends` was valid at `before` and has ended at `now`.
fn any_between(ends: &[u64], before: SystemTime, now: SystemTime) -> bool {
    let (before, now) = (seconds(before), seconds(now));
    ends.iter().any(|end| (before..now).contains(end))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn certificates_are_looked_at_when_one_is_over() {
        let at = |seconds| SystemTime::UNIX_EPOCH + Duration::from_secs(seconds);
        let secs = Duration::from_secs;
        assert_eq!(time_to_next(&[1000, 1010], at(995)), secs(6));
        assert_eq!(time_to_next(&[1000, 1010], at(1000)), secs(1), "its last second");
        assert_eq!(time_to_next(&[1000, 1010], at(1001)), secs(10));
        assert_eq!(time_to_next(&[1000], at(1001)), LOOK);
        assert_eq!(time_to_next(&[u64::MAX - 1], at(0)), LOOK, "no end");
        assert!(!any_between(&[1000], at(990), at(1000)));
        assert!(any_between(&[1000], at(990), at(1001)));
        assert!(any_between(&[1000], at(1000), at(5000)), "the calendar was set forward");
        assert!(!any_between(&[1000], at(1001), at(5000)));
        assert!(!any_between(&[1000], at(5000), at(900)), "or back");
    }
}
