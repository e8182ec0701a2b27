//! Places for connections: so many in all, so many for one address. Pure.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// The places of a server.
#[derive(Debug)]
pub(super) struct Places {
    most: usize,
    most_of_one: Option<usize>,
    taken: Mutex<Taken>,
}

#[derive(Debug, Default)]
struct Taken {
    all: usize,
    /// Addresses that have any.
    by_address: HashMap<IpAddr, usize>,
}

/// A place that is taken; free again when dropped.
#[derive(Debug)]
pub(super) struct Place {
    places: Arc<Places>,
    address: IpAddr,
}

/// There is no place; with the limit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Full {
    /// For anybody.
    All(usize),
    /// For this address.
    Address(usize),
}

impl Places {
    pub(super) fn new(most: usize, most_of_one: Option<usize>) -> Arc<Places> {
        Arc::new(Places {
            most,
            most_of_one,
            taken: Mutex::default(),
        })
    }

    pub(super) fn take(self: &Arc<Self>, address: IpAddr) -> Result<Place, Full> {
        let mut taken = self.lock();
        let own = taken.by_address.get(&address).copied().unwrap_or_default();
        if let Some(most) = self.most_of_one.filter(|most| own >= *most) {
            return Err(Full::Address(most));
        }
        if taken.all >= self.most {
            return Err(Full::All(self.most));
        }
        taken.all += 1;
        taken.by_address.insert(address, own + 1);
        Ok(Place {
            places: self.clone(),
            address,
        })
    }

    fn lock(&self) -> MutexGuard<'_, Taken> {
        self.taken.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut taken = self.places.lock();
        taken.all = taken.all.saturating_sub(1);
        if let Some(own) = taken.by_address.get_mut(&self.address) {
            *own = own.saturating_sub(1);
            if *own == 0 {
                taken.by_address.remove(&self.address);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn in_all_and_of_one_address() {
        let places = Places::new(3, Some(2));
        let [one, other, third] = [1, 2, 3].map(|n| IpAddr::from([10, 0, 0, n]));
        let first = places.take(one).unwrap();
        let _second = places.take(one).unwrap();
        assert_eq!(places.take(one).unwrap_err(), Full::Address(2));
        let _other = places.take(other).unwrap();
        assert_eq!(places.take(third).unwrap_err(), Full::All(3));
        drop(first);
        let again = places.take(third).unwrap();
        drop(again);
        assert_eq!(places.lock().by_address.len(), 2, "nothing is kept of who has left");
    }
}
