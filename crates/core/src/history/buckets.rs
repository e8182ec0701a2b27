//! Figures for the newest steps of time; all steps have the same length. Pure.

/// A figure for each of the newest steps. Steps are numbered from the first one on; the figure of step `n` is at `n % slots.len()`.
#[derive(Debug, Clone)]
pub(super) struct Buckets<T> {
    slots: Box<[T]>,
    newest: u64,
    /// Place of the newest step, kept to save a division for every value.
    place: usize,
}

impl<T: Copy + Default> Buckets<T> {
    /// Creates `steps` empty slots, each the default of `T`.
    pub(super) fn new(steps: usize) -> Buckets<T> {
        Buckets {
            slots: vec![T::default(); steps].into(),
            newest: 0,
            place: 0,
        }
    }

    /// Sets the number of steps to keep; the newest steps stay.
    pub(super) fn resize(&mut self, steps: usize) {
        let mut new = Buckets::new(steps);
        let oldest = (self.newest + 1).saturating_sub(self.len());
        for number in oldest..=self.newest {
            if let (Some(kept), Some(slot)) = (self.get(number), new.step_mut(number)) {
                *slot = kept;
            }
        }
        *self = new;
    }

    /// Number of steps that are kept.
    pub(super) fn steps(&self) -> usize {
        self.slots.len()
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

    /// The step with this number, to be changed; a number newer than all before replaces the oldest step. `None` if
    /// the step is too old to be kept.
    pub(super) fn step_mut(&mut self, number: u64) -> Option<&mut T> {
        if number == self.newest {
            return self.slots.get_mut(self.place);
        }
        if number > self.newest {
            // Slots of the previous lap are cleared before they are used for new times.
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

    /// The step with this number; `None` if it is too old or has not begun.
    pub(super) fn get(&self, number: u64) -> Option<T> {
        let slot = self.slots.get(self.place(number)).copied();
        slot.filter(|_| self.holds(number))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_newest_steps_stay_when_there_is_room_for_fewer_or_more() {
        let mut buckets = Buckets::new(10);
        for number in 0..25_u64 {
            *buckets.step_mut(number).unwrap() = number;
        }
        buckets.resize(4);
        assert_eq!(
            (19..26).map(|n| buckets.get(n)).collect::<Vec<_>>(),
            [None, None, Some(21), Some(22), Some(23), Some(24), None]
        );
        buckets.resize(8);
        assert_eq!(
            (buckets.get(17), buckets.get(21), buckets.steps()),
            (Some(0), Some(21), 8)
        );
        *buckets.step_mut(25).unwrap() = 25;
        assert_eq!((buckets.get(24), buckets.get(25)), (Some(24), Some(25)));
    }
}
