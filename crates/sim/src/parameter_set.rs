//! Parameters of a simulated drive of any model with their ranges, and a record of the writes received over the bus.

use std::collections::BTreeMap;

use super::random::Random;
use drivegate_proto::Exception;

#[derive(Debug, Clone, Copy)]
pub(crate) struct Parameter {
    /// ID or address of the parameter.
    pub key: u16,
    /// Minimum valid value.
    pub min: u16,
    /// Greatest valid value.
    pub max: u16,
    /// Present value of the parameter.
    pub value: u16,
}

/// Why a parameter was not written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Refused {
    /// There is no parameter with this key.
    Unknown,
    /// The value is outside the parameter's range, or beyond a parameter that limits it.
    Value,
}

/// How often a parameter was written over the bus.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Writes {
    /// Number of writes that the drive accepted.
    pub taken: u32,
    /// Number of writes during which the inverter fed the motor.
    pub while_fed: u32,
    /// Writes into the memory that keeps values without power; this memory endures a limited number of writes.
    pub stored_writes: u32,
}

/// The parameters of one drive.
#[derive(Debug, Clone)]
pub(crate) struct ParameterSet {
    /// The parameters by ascending key.
    all: Vec<Parameter>,
    /// Pairs of keys: the first is never below the second.
    limits: Vec<(u16, u16)>,
    /// Whether each write goes into the memory that keeps values without power.
    kept_at_once: bool,
    writes: BTreeMap<u16, Writes>,
}

impl From<Refused> for Exception {
    fn from(refused: Refused) -> Exception {
        match refused {
            Refused::Unknown => Exception::ADDRESS,
            Refused::Value => Exception::VALUE,
        }
    }
}

impl ParameterSet {
    /// A set of parameters from (key, minimum, maximum, default); keys may come in any order, and the first of
    /// equal ones is used.
    pub(crate) fn new(parameters: impl IntoIterator<Item = (u16, u16, u16, u16)>) -> ParameterSet {
        let mut all: Vec<Parameter> = parameters
            .into_iter()
            .map(|(key, min, max, value)| Parameter { key, min, max, value })
            .collect();
        all.sort_by_key(|parameter| parameter.key);
        all.dedup_by_key(|parameter| parameter.key);
        ParameterSet {
            all,
            limits: Vec::new(),
            kept_at_once: false,
            writes: BTreeMap::new(),
        }
    }

    /// The first of each pair is never below the second.
    pub(crate) fn limited(mut self, limits: impl IntoIterator<Item = (u16, u16)>) -> ParameterSet {
        self.limits.extend(limits);
        self
    }

    /// A set whose values are stored permanently with each write over the bus.
    pub(crate) fn kept_at_once(mut self) -> ParameterSet {
        self.kept_at_once = true;
        self
    }

    fn find(&self, key: u16) -> Result<usize, Refused> {
        self.all
            .binary_search_by_key(&key, |parameter| parameter.key)
            .map_err(|_| Refused::Unknown)
    }

    /// The value of a parameter.
    pub(crate) fn get(&self, key: u16) -> Option<u16> {
        self.find(key).ok().and_then(|at| self.all.get(at)).map(|p| p.value)
    }

    /// The value of a parameter that every drive of the model has; 0 if it is missing.
    pub(crate) fn number(&self, key: u16) -> u16 {
        self.get(key).unwrap_or(0)
    }

    /// Whether `value` may be written.
    ///
    /// # Errors
    /// If there is no such parameter, or the value is outside its range or beyond a parameter that limits it.
    pub(crate) fn check(&self, key: u16, value: u16) -> Result<(), Refused> {
        let at = self.find(key)?;
        let inside = self.all.get(at).is_some_and(|p| (p.min..=p.max).contains(&value));
        let crossed = self.limits.iter().any(|&(upper, lower)| {
            (key == upper && value < self.number(lower)) || (key == lower && value > self.number(upper))
        });
        if inside && !crossed {
            Ok(())
        } else {
            Err(Refused::Value)
        }
    }

    /// Sets a parameter as [`ParameterSet::check`] allows, not over the bus.
    ///
    /// # Errors
    /// The errors of [`ParameterSet::check`]: then no value is set.
    pub(crate) fn set(&mut self, key: u16, value: u16) -> Result<(), Refused> {
        self.check(key, value)?;
        let at = self.find(key)?;
        if let Some(parameter) = self.all.get_mut(at) {
            parameter.value = value;
        }
        Ok(())
    }

    /// A write over the bus: as [`ParameterSet::set`], and recorded; `fed` whether the inverter feeds the motor.
    ///
    /// # Errors
    /// The errors of [`ParameterSet::check`]: then no value is written.
    pub(crate) fn write(&mut self, key: u16, value: u16, fed: bool) -> Result<(), Refused> {
        self.set(key, value)?;
        let writes = self.writes.entry(key).or_default();
        writes.taken += 1;
        writes.while_fed += u32::from(fed);
        writes.stored_writes += u32::from(self.kept_at_once);
        Ok(())
    }

    /// The memory that keeps the parameter without power was written.
    pub(crate) fn record_kept(&mut self, key: u16) {
        self.writes.entry(key).or_default().stored_writes += 1;
    }

    /// Writes received over the bus, by key.
    pub(crate) fn writes(&self) -> &BTreeMap<u16, Writes> {
        &self.writes
    }

    /// Copies the values of a set with equal parameters.
    pub(crate) fn take_values(&mut self, other: &ParameterSet) {
        self.all.clone_from(&other.all);
    }

    /// Gives all parameters except `spared` random values that writes could have set.
    pub(crate) fn fill(&mut self, random: &mut Random, spared: &[u16]) {
        for p in self.all.iter_mut().filter(|p| !spared.contains(&p.key)) {
            // The value stays inside the parameter's range.
            p.value = random.within(u64::from(p.min)..=u64::from(p.max)) as u16;
        }
        for &(upper, lower) in &self.limits.clone() {
            let most = self.number(upper);
            if let Ok(at) = self.find(lower)
                && let Some(parameter) = self.all.get_mut(at)
            {
                parameter.value = parameter.value.min(most);
            }
        }
    }

    /// All parameters in ascending order of their keys.
    pub(crate) fn iter(&self) -> impl Iterator<Item = &Parameter> {
        self.all.iter()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges() {
        let mut set = ParameterSet::new([(9, 0, 3, 1), (2, 5, 10, 5), (9, 0, 9, 9)]);
        assert_eq!(
            set.iter().map(|p| (p.key, p.value)).collect::<Vec<_>>(),
            [(2, 5), (9, 1)]
        );
        assert_eq!(set.set(9, 3), Ok(()));
        assert_eq!((set.get(9), set.get(3), set.number(3)), (Some(3), None, 0));
        assert_eq!(
            (set.set(9, 4), set.set(2, 4)),
            (Err(Refused::Value), Err(Refused::Value))
        );
        assert_eq!(set.set(3, 0), Err(Refused::Unknown));
    }

    #[test]
    fn limits_and_the_record_of_writes() {
        let mut set = ParameterSet::new([(1, 0, 9, 2), (2, 0, 9, 5)]).limited([(2, 1)]);
        assert_eq!((set.check(1, 5), set.check(1, 6)), (Ok(()), Err(Refused::Value)));
        assert_eq!(
            (set.write(2, 1, false), set.write(2, 7, true)),
            (Err(Refused::Value), Ok(()))
        );
        assert_eq!(set.write(2, 8, false), Ok(()));
        set.record_kept(2);
        let writes = Writes {
            taken: 2,
            while_fed: 1,
            stored_writes: 1,
        };
        assert_eq!(set.writes(), &BTreeMap::from([(2, writes)]));
        let mut random = Random::new(1);
        let filled: Vec<(u16, u16)> = (0..50)
            .map(|_| {
                set.fill(&mut random, &[]);
                (set.number(1), set.number(2))
            })
            .collect();
        assert!(filled.iter().all(|(lower, upper)| lower <= upper && *upper <= 9));
        assert!(filled.iter().any(|values| *values != filled[0]));
        let before = set.number(1);
        set.fill(&mut random, &[1, 2]);
        assert_eq!(set.number(1), before);
    }
}
