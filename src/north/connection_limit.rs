//! Limits the connections that are open at one time: in total and for each client address.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// The limits of a server, and the connections that count against them.
#[derive(Debug)]
pub(super) struct ConnectionLimit {
    total: usize,
    per_address: Option<usize>,
    open: Mutex<OpenConnections>,
}

#[derive(Debug, Default)]
struct OpenConnections {
    total: usize,
    /// Only addresses with at least one connection.
    by_address: HashMap<IpAddr, usize>,
}

/// A connection that counts against the limit until this is dropped.
#[derive(Debug)]
pub(super) struct ConnectionPermit {
    limit: Arc<ConnectionLimit>,
    address: IpAddr,
}

/// Why there is no permit, with the limit that was reached.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum LimitReached {
    /// For all clients together.
    Total(usize),
    /// For the address of this client.
    Address(usize),
}

impl ConnectionLimit {
    /// `total` connections, of which one address may have `per_address`; `None` is no limit per address.
    pub(super) fn new(total: usize, per_address: Option<usize>) -> Arc<ConnectionLimit> {
        Arc::new(ConnectionLimit {
            total,
            per_address,
            open: Mutex::default(),
        })
    }

    /// A permit for one connection from `address`.
    ///
    /// # Errors
    /// The limit that is reached.
    pub(super) fn acquire(self: &Arc<Self>, address: IpAddr) -> Result<ConnectionPermit, LimitReached> {
        let mut open = self.lock();
        let own = open.by_address.get(&address).copied().unwrap_or_default();
        if let Some(limit) = self.per_address.filter(|limit| own >= *limit) {
            return Err(LimitReached::Address(limit));
        }
        if open.total >= self.total {
            return Err(LimitReached::Total(self.total));
        }
        open.total += 1;
        open.by_address.insert(address, own + 1);
        Ok(ConnectionPermit {
            limit: self.clone(),
            address,
        })
    }

    fn lock(&self) -> MutexGuard<'_, OpenConnections> {
        self.open.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for ConnectionPermit {
    fn drop(&mut self) {
        let mut open = self.limit.lock();
        open.total = open.total.saturating_sub(1);
        if let Some(own) = open.by_address.get_mut(&self.address) {
            *own = own.saturating_sub(1);
            if *own == 0 {
                open.by_address.remove(&self.address);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limits_in_total_and_per_address() {
        let limit = ConnectionLimit::new(3, Some(2));
        let [one, other, third] = [1, 2, 3].map(|n| IpAddr::from([10, 0, 0, n]));
        let first = limit.acquire(one).unwrap();
        let _second = limit.acquire(one).unwrap();
        assert_eq!(limit.acquire(one).unwrap_err(), LimitReached::Address(2));
        let _other = limit.acquire(other).unwrap();
        assert_eq!(limit.acquire(third).unwrap_err(), LimitReached::Total(3));
        drop(first);
        let again = limit.acquire(third).unwrap();
        drop(again);
        assert_eq!(
            limit.lock().by_address.len(),
            2,
            "addresses without a connection are forgotten"
        );
    }
}
