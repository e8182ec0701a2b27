//! Parameters with their ranges, as any simulated drive keeps them.

/// One parameter.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Parameter {
    /// Its ID or address.
    pub key: u16,
    /// Least value.
    pub min: u16,
    /// Greatest value.
    pub max: u16,
    /// Present value.
    pub value: u16,
}

/// Why a parameter cannot be written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refused {
    /// There is no such parameter.
    Unknown,
    /// The value is outside the parameter's range.
    Value,
}

/// The parameters of one drive by ascending key.
#[derive(Debug, Clone)]
pub(crate) struct ParameterSet(Vec<Parameter>);

impl ParameterSet {
    /// Of (key, minimum, maximum, default); keys may come in any order, the first of equal ones counts.
    pub(crate) fn new(parameters: impl IntoIterator<Item = (u16, u16, u16, u16)>) -> ParameterSet {
        let mut all: Vec<Parameter> = parameters
            .into_iter()
            .map(|(key, min, max, value)| Parameter { key, min, max, value })
            .collect();
        all.sort_by_key(|parameter| parameter.key);
        all.dedup_by_key(|parameter| parameter.key);
        ParameterSet(all)
    }

    fn find(&self, key: u16) -> Result<usize, Refused> {
        self.0
            .binary_search_by_key(&key, |parameter| parameter.key)
            .map_err(|_| Refused::Unknown)
    }

    /// The value of a parameter.
    pub(crate) fn get(&self, key: u16) -> Option<u16> {
        self.find(key).ok().and_then(|at| self.0.get(at)).map(|p| p.value)
    }

    /// The value of a parameter that every drive of the model has; 0 when it has not.
    pub(crate) fn number(&self, key: u16) -> u16 {
        self.get(key).unwrap_or(0)
    }

    /// Whether `value` may be written.
    ///
    /// # Errors
    /// No such parameter, or a value outside its range.
    pub(crate) fn check(&self, key: u16, value: u16) -> Result<(), Refused> {
        let at = self.find(key)?;
        let inside = self.0.get(at).is_some_and(|p| (p.min..=p.max).contains(&value));
        if inside { Ok(()) } else { Err(Refused::Value) }
    }

    /// Writes a parameter that [`ParameterSet::check`] allows.
    ///
    /// # Errors
    /// As [`ParameterSet::check`]; nothing is written then.
    pub(crate) fn set(&mut self, key: u16, value: u16) -> Result<(), Refused> {
        self.check(key, value)?;
        let at = self.find(key)?;
        if let Some(parameter) = self.0.get_mut(at) {
            parameter.value = value;
        }
        Ok(())
    }

    /// All of them, by ascending key.
    pub(crate) fn iter(&self) -> impl Iterator<Item = &Parameter> {
        self.0.iter()
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
}
