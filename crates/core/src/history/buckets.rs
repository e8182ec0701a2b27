//! The newest of equal steps of time. Pure.

/// A figure for each of the newest steps. Steps are numbered from a beginning on; step `n` is at `n % slots.len()`.
#[derive(Debug, Clone)]
pub(super) struct Buckets<T> {
    slots: Box<[T]>,
    newest: u64,
    /// Where the newest is: a division less for every value.
    place: usize,
}

impl<T: Copy + Default> Buckets<T> {
    /// So many steps, all empty: as the default of `T`.
    pub(super) fn new(steps: usize) -> Buckets<T> {
        Buckets {
            slots: vec![T::default(); steps].into(),
            newest: 0,
            place: 0,
        }
    }

    fn len(&self) -> u64 {
        self.slots.len() as u64
    }

    fn place(&self, number: u64) -> usize {
        // A remainder is less than the length, which is one of memory.
        (number % self.len().max(1)) as usize
    }

    fn holds(&self, number: u64) -> bool {
        number <= self.newest && number + self.len() > self.newest
    }

    /// A step to be changed; a newer one than all before takes the place of the oldest. `None` where it is too old to be kept.
    pub(super) fn at(&mut self, number: u64) -> Option<&mut T> {
        if number == self.newest {
            return self.slots.get_mut(self.place);
        }
        if number > self.newest {
            // What was a lap before is not of this time.
            let first = (self.newest + 1).max((number + 1).saturating_sub(self.len()));
            for stale in first..=number {
                let place = self.place(stale);
                if let Some(slot) = self.slots.get_mut(place) {
                    *slot = T::default();
                }
            }
            (self.newest, self.place) = (number, self.place(number));
        }
        let place = self.place(number);
        let holds = self.holds(number);
        self.slots.get_mut(place).filter(|_| holds)
    }

    /// A step; `None` where it is too old or not begun.
    pub(super) fn get(&self, number: u64) -> Option<T> {
        let slot = self.slots.get(self.place(number)).copied();
        slot.filter(|_| self.holds(number))
    }
}
