//! State of a server that outlives it: a reload replaces servers, and the next one of its kind takes the state over.

use std::any::{Any, TypeId};
use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

/// One value of each type that a server keeps here. The types are those of the servers, which this crate does not know.
#[derive(Debug, Default)]
pub(crate) struct Kept(Mutex<HashMap<TypeId, Arc<dyn Any + Send + Sync>>>);

impl Kept {
    /// The value of this type; the first caller creates it.
    pub(crate) fn get<T: Default + Send + Sync + 'static>(&self) -> Arc<T> {
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let value = kept.entry(TypeId::of::<T>()).or_insert_with(|| Arc::<T>::default());
        value.clone().downcast().unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU8, AtomicU16, Ordering};

    use super::*;

    #[test]
    fn each_type_has_one_value() {
        let kept = Kept::default();
        kept.get::<AtomicU8>().store(7, Ordering::Relaxed);
        assert_eq!(kept.get::<AtomicU8>().load(Ordering::Relaxed), 7);
        assert_eq!(kept.get::<AtomicU16>().load(Ordering::Relaxed), 0);
    }
}
