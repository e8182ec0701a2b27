//! Limits the connections that are open at one time, in total and for each client address, and decides which connection
//! yields when a limit is reached. [`decide`] is pure; [`ConnectionLimit`] keeps the connections it decides about.

use std::cmp::Reverse;
use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::Instant;

use tokio_util::sync::CancellationToken;

use drivegate_core::order::Authority;

/// Maximum number of displaced connections that are not closed yet.
const MAX_CLOSING: usize = 32;

/// How many connections a server may have open.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Maximum number of connections of all clients in total.
    pub total: usize,
    /// How many of all connections are kept for clients that may write.
    pub reserved: usize,
    pub per_address: usize,
}

impl Limits {
    /// `total` connections, at most `per_address` from one address.
    pub fn new(total: usize, per_address: usize) -> Limits {
        Limits {
            total,
            reserved: 0,
            per_address,
        }
    }

    /// Maximum number of displaced connections that are still closing; beyond it, new connections are refused instead.
    fn closing(&self) -> usize {
        self.total.min(MAX_CLOSING)
    }

    /// Maximum number of connections that have a file descriptor.
    pub fn files(&self) -> usize {
        self.total + self.closing()
    }

    /// Reserves an eighth of the connections, at least one of two, for clients that may write.
    pub fn with_reserve(self) -> Limits {
        let reserved = if self.total < 2 { 0 } else { (self.total / 8).max(1) };
        Limits { reserved, ..self }
    }
}

/// An open connection, as [`decide`] needs it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Open {
    address: IpAddr,
    authority: Authority,
    /// Whether the connection keeps its place when another one from its address arrives; see [`ConnectionPlace::use_at`].
    in_use: bool,
    /// Time of the connection's last use, ms.
    used: u64,
}

/// Whether and how a new connection is admitted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Decision {
    Admit,
    /// Accept the connection in place of the open one with this index.
    Replace(usize),
    Refuse(LimitReached),
}

/// The limit that keeps a connection out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LimitReached {
    /// The limit for all clients together.
    Total(usize),
    /// The limit for the address of this client.
    Address(usize),
}

/// Decides about a new connection from `address`.
///
/// A connection in use is not closed for another one from the same address, unless only the new one may write. If
/// no place is left, the address with the most connections loses its longest idle one to an address that has fewer.
/// A client that may write never yields to one that may not.
fn decide<I>(limits: &Limits, open: I, address: IpAddr, authority: Authority) -> Decision
where
    I: Iterator<Item = Open> + Clone,
{
    let mut held: HashMap<IpAddr, usize> = HashMap::new();
    let (mut total, mut readers) = (0, 0);
    for connection in open.clone() {
        *held.entry(connection.address).or_default() += 1;
        total += 1;
        readers += usize::from(connection.authority == Authority::ReadOnly);
    }
    let count = |address: &IpAddr| held.get(address).copied().unwrap_or_default();
    let own = count(&address);
    let address_full = own >= limits.per_address;
    let free = total < limits.total
        && (authority == Authority::Write || readers < limits.total.saturating_sub(limits.reserved));
    if free && !address_full {
        return Decision::Admit;
    }
    let yields = |connection: &Open| {
        let writes = connection.authority == Authority::Write;
        match (writes, authority) {
            (true, Authority::ReadOnly) => false,
            _ if connection.address != address => !address_full && count(&connection.address) > own,
            (false, Authority::Write) => true,
            _ => !connection.in_use,
        }
    };
    let candidates = open.enumerate().filter(|(_, connection)| yields(connection));
    let first = candidates.min_by_key(|(_, connection)| {
        let writes = connection.authority == Authority::Write;
        (
            writes,
            Reverse(count(&connection.address)),
            connection.in_use,
            connection.used,
        )
    });
    match first {
        Some((index, _)) => Decision::Replace(index),
        None if address_full => Decision::Refuse(LimitReached::Address(limits.per_address)),
        None => Decision::Refuse(LimitReached::Total(limits.total)),
    }
}

/// The rights of a client; a reload can change them while the client is connected.
#[derive(Debug, Clone)]
pub struct Rights(Arc<AtomicBool>);

impl Rights {
    /// The present authority of the client.
    pub(super) fn authority(&self) -> Authority {
        if self.0.load(Ordering::Relaxed) {
            Authority::Write
        } else {
            Authority::ReadOnly
        }
    }

    /// Changes the rights of the client from now on.
    pub fn set(&self, authority: Authority) {
        self.0.store(authority == Authority::Write, Ordering::Relaxed);
    }
}

impl From<Authority> for Rights {
    fn from(authority: Authority) -> Rights {
        Rights(Arc::new(AtomicBool::new(authority == Authority::Write)))
    }
}

/// Why the gateway closes a connection that works.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum CloseReason {
    /// A newer connection took the place; see [`decide`].
    #[error("closed in favour of another client, because the maximum number of connections is reached")]
    Displaced,
    /// A reload does not allow the client any more.
    #[error("closed: the new configuration does not allow it")]
    NotAllowed,
    /// The client's certificate, or the rights of its role, ended.
    #[error("closed: its certificate is no longer accepted with the same rights")]
    CertificateRefused,
}

/// The place that one connection has under a limit.
#[derive(Debug)]
pub struct ConnectionPlace {
    address: IpAddr,
    /// The listener that accepted the connection.
    listener: usize,
    rights: Rights,
    in_use: AtomicBool,
    /// Time of the last use, ms after `start`.
    used: AtomicU64,
    start: Instant,
    closing: CancellationToken,
    why: OnceLock<CloseReason>,
}

impl ConnectionPlace {
    /// Address of the client.
    pub(super) fn address(&self) -> IpAddr {
        self.address
    }

    /// The rights of the client.
    pub fn rights(&self) -> &Rights {
        &self.rights
    }

    /// Token that is cancelled when the connection must end: its place is needed, [`ConnectionPlace::close`] was
    /// called, or its server stops.
    pub fn closing(&self) -> &CancellationToken {
        &self.closing
    }

    /// Why the connection must end; `None` if only its server stops.
    pub fn close_reason(&self) -> Option<CloseReason> {
        self.why.get().copied()
    }

    /// Ends the connection; the first reason is kept. The client loses its right to write, unless its place is
    /// merely given to another client.
    pub(super) fn close(&self, why: CloseReason) {
        if why != CloseReason::Displaced {
            self.rights.set(Authority::ReadOnly);
        }
        let _ = self.why.set(why);
        self.closing.cancel();
    }

    /// Notes that the connection was used at `now`, and whether it counts as `in_use` from then on.
    pub fn use_at(&self, now: Instant, in_use: bool) {
        let used = now.saturating_duration_since(self.start).as_millis();
        self.used
            .store(u64::try_from(used).unwrap_or(u64::MAX), Ordering::Relaxed);
        self.in_use.store(in_use, Ordering::Relaxed);
    }

    /// Whether the connection is in use.
    pub fn is_in_use(&self) -> bool {
        self.in_use.load(Ordering::Relaxed)
    }

    fn open(self: &Arc<ConnectionPlace>) -> Open {
        Open {
            address: self.address,
            authority: self.rights.authority(),
            in_use: self.is_in_use(),
            used: self.used.load(Ordering::Relaxed),
        }
    }
}

/// The limits of a server, and the connections that count against them.
#[derive(Debug)]
pub struct ConnectionLimit {
    start: Instant,
    table: Mutex<Table>,
}

#[derive(Debug)]
struct Table {
    limits: Limits,
    open: Vec<Arc<ConnectionPlace>>,
    /// Displaced connections that are not closed yet.
    closing: usize,
}

/// A connection that counts against the limit until this is dropped.
#[derive(Debug)]
pub struct ConnectionPermit {
    limit: Arc<ConnectionLimit>,
    place: Arc<ConnectionPlace>,
}

impl ConnectionPermit {
    pub fn place(&self) -> &Arc<ConnectionPlace> {
        &self.place
    }
}

/// A new connection that asks for a connection place.
#[derive(Debug, Clone, Copy)]
pub struct Newcomer<'c> {
    /// Address of the client.
    pub address: IpAddr,
    /// The listener that accepted the connection, for [`ConnectionLimit::review`].
    pub listener: usize,
    /// Ends the connection together with its server.
    pub cancel: &'c CancellationToken,
}

/// Why a connection is not accepted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NoPlace {
    /// The client may not connect at all.
    NotAllowed,
    /// A limit is reached and no other connection yields.
    Limit(LimitReached),
}

impl ConnectionLimit {
    pub fn new(limits: Limits) -> Arc<ConnectionLimit> {
        let table = Table {
            limits,
            open: Vec::new(),
            closing: 0,
        };
        Arc::new(ConnectionLimit {
            start: Instant::now(),
            table: Mutex::new(table),
        })
    }

    /// Applies other limits to newcomers; open connections stay.
    pub fn set_limits(&self, limits: Limits) {
        self.lock().limits = limits;
    }

    /// A place for a new connection, and the address of the connection that it displaced. `judge` returns the
    /// rights of the client, or that it may not connect; it is called while no [`ConnectionLimit::review`] runs, so
    /// that a reload misses no connection.
    ///
    /// # Errors
    /// If the connection gets no place; contains the reason.
    pub fn acquire(
        self: &Arc<Self>,
        newcomer: Newcomer<'_>,
        now: Instant,
        judge: impl FnOnce() -> Option<Authority>,
    ) -> Result<(ConnectionPermit, Option<IpAddr>), NoPlace> {
        let mut table = self.lock();
        let authority = judge().ok_or(NoPlace::NotAllowed)?;
        let open = table.open.iter().map(ConnectionPlace::open);
        let displaced = match decide(&table.limits, open, newcomer.address, authority) {
            Decision::Admit => None,
            Decision::Refuse(limit) => return Err(NoPlace::Limit(limit)),
            Decision::Replace(_) if table.closing >= table.limits.closing() => {
                return Err(NoPlace::Limit(LimitReached::Total(table.limits.total)));
            }
            Decision::Replace(index) => {
                let displaced = table.open.remove(index);
                table.closing += 1;
                displaced.close(CloseReason::Displaced);
                Some(displaced.address)
            }
        };
        let place = Arc::new(ConnectionPlace {
            address: newcomer.address,
            listener: newcomer.listener,
            rights: authority.into(),
            in_use: AtomicBool::new(false),
            used: AtomicU64::new(0),
            start: self.start,
            closing: newcomer.cancel.child_token(),
            why: OnceLock::new(),
        });
        place.use_at(now, false);
        table.open.push(place.clone());
        let limit = self.clone();
        Ok((ConnectionPermit { limit, place }, displaced))
    }

    /// Judges the open connections of one listener again: `judge` returns the rights of each from now on, or `None`
    /// to close it.
    pub(super) fn review(&self, listener: usize, judge: impl Fn(&ConnectionPlace) -> Option<Authority>) {
        let table = self.lock();
        for place in table.open.iter().filter(|place| place.listener == listener) {
            match judge(place) {
                Some(authority) => place.rights.set(authority),
                None => place.close(CloseReason::NotAllowed),
            }
        }
    }

    fn lock(&self) -> MutexGuard<'_, Table> {
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for ConnectionPermit {
    fn drop(&mut self) {
        let mut table = self.limit.lock();
        match table.open.iter().position(|place| Arc::ptr_eq(place, &self.place)) {
            Some(index) => drop(table.open.remove(index)),
            None => table.closing = table.closing.saturating_sub(1),
        }
    }
}

#[cfg(test)]
mod tests;
