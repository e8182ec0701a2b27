//! Points derived from the points of the drive. Pure.

use crate::drive::PointIndex;
use std::time::Instant;

use super::control::Mask;
use super::model::{Quality, Sample, Value, tidy};

/// Fraction of the lower end of a band by which a value may be below it because of float rounding.
const ROUNDING: f64 = 1e-9;

/// An end of a band: another point, or a number from the manual.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Bound {
    /// Index of a point of the profile.
    Point(PointIndex),
    /// A fixed bound, in the unit of the band.
    Fixed(f64),
    /// `frequency_range` in the configuration of the drive: the drive itself does not report it.
    Configured,
}

/// How a value is derived from other points, given by their indices in the profile. All of these are raw points.
#[derive(Debug, Clone, PartialEq)]
pub enum Derived {
    /// A percentage of a band: `minimum + of / 100 * (maximum - minimum)`. A minimum above zero applies to both
    /// directions: a negative percentage is the same magnitude in reverse.
    Band {
        /// Index of the point in percent.
        of: PointIndex,
        /// Value at 0 %.
        minimum: Bound,
        /// Value at 100 %.
        maximum: Bound,
    },
    /// A value within a band as a percentage: `100 * (of - minimum) / (maximum - minimum)`, in either direction as well.
    Percent {
        /// Point in the unit of the band.
        of: PointIndex,
        /// Value at 0 %.
        minimum: Bound,
        /// Value at 100 %.
        maximum: Bound,
    },
    /// True while the absolute value of the point is at most `within`.
    Zero {
        /// Index of the source point.
        of: PointIndex,
        /// Greatest distance from zero, in the unit of the point.
        within: f64,
    },
    /// True while the two points differ by at most `within`.
    Equal {
        /// Index of the source point.
        of: PointIndex,
        /// Index of the point to compare with.
        to: PointIndex,
        /// Greatest difference, in the unit of the points.
        within: f64,
    },
    /// True if all of the points are true.
    All {
        /// Indices of the source points.
        of: Vec<PointIndex>,
    },
    /// True if a register is in one of these states.
    State {
        /// The alternatives, of which any makes the point true.
        any: Vec<Mask>,
    },
    /// The sum of the points, each multiplied by its weight. All must come from one reading: otherwise a counter
    /// that rolls over into the next register would seem to decrease.
    Sum {
        /// Indices of the source points.
        of: Vec<PointIndex>,
        /// Weight of each point.
        weights: Vec<f64>,
    },
    /// Number of the lowest set bit, counted from 1; 0 if none is set.
    LowestBit {
        /// The masked point.
        of: PointIndex,
    },
}

impl Derived {
    /// The name of the derivation in profiles.
    #[cfg(test)]
    pub fn name(&self) -> &'static str {
        match self {
            Derived::Band { .. } => "band",
            Derived::Percent { .. } => "percent",
            Derived::Zero { .. } => "zero",
            Derived::Equal { .. } => "equal",
            Derived::All { .. } => "all",
            Derived::State { .. } => "state",
            Derived::Sum { .. } => "sum",
            Derived::LowestBit { .. } => "lowest_bit",
        }
    }

    /// The point that a command to this one is converted to, with the ends of the band.
    pub fn band(&self) -> Option<(PointIndex, Bound, Bound)> {
        match *self {
            Derived::Band { of, minimum, maximum } | Derived::Percent { of, minimum, maximum } => {
                Some((of, minimum, maximum))
            }
            _ => None,
        }
    }

    /// The points that the value itself is derived from, without the ends of a band.
    pub fn sources(&self) -> impl Iterator<Item = PointIndex> {
        let (mut more, mut states): (&[PointIndex], &[Mask]) = (&[], &[]);
        let (first, second) = match self {
            Derived::Band { of, .. }
            | Derived::Percent { of, .. }
            | Derived::Zero { of, .. }
            | Derived::LowestBit { of } => (Some(*of), None),
            Derived::Equal { of, to, .. } => (Some(*of), Some(*to)),
            Derived::All { of } | Derived::Sum { of, .. } => {
                more = of;
                (None, None)
            }
            Derived::State { any } => {
                states = any;
                (None, None)
            }
        };
        let more = more.iter().copied().chain(states.iter().map(|state| state.point));
        first.into_iter().chain(second).chain(more)
    }

    /// All points on which the derived point depends, including the ends of a band.
    pub fn rests_on(&self) -> Vec<PointIndex> {
        self.sources().chain(self.ends()).collect()
    }

    /// The points that are the ends of the band.
    pub fn ends(&self) -> impl Iterator<Item = PointIndex> {
        let ends = self.band().map(|(_, low, high)| [low, high]);
        ends.into_iter().flatten().filter_map(|bound| match bound {
            Bound::Point(point) => Some(point),
            Bound::Fixed(_) | Bound::Configured => None,
        })
    }

    /// The value calculated from these values of the sources; `None` if it cannot be calculated.
    pub fn value(&self, sources: impl IntoIterator<Item = Value>, band: Option<(f64, f64)>) -> Option<Value> {
        let mut sources = sources.into_iter();
        let first = sources.next()?;
        match self {
            Derived::Band { .. } => Some(Value::Number(tidy(in_band(first.as_f64(), band?)))),
            Derived::Percent { .. } => {
                let band = band.filter(|(low, high)| high > low)?;
                let value = first.as_f64();
                // With a lower reference the drive turns at its minimum; a negative zero is the minimum in reverse.
                let percent = percentage(value, band).unwrap_or(0.0_f64.copysign(value));
                Some(Value::Number(tidy(percent)))
            }
            Derived::Zero { within, .. } => Some(Value::Bool(first.as_f64().abs() <= *within)),
            Derived::Equal { within, .. } => {
                let apart = tidy((first.as_f64().abs() - sources.next()?.as_f64().abs()).abs());
                Some(Value::Bool(apart <= *within))
            }
            // `all` would stop early and leave out sources that decide quality and age.
            Derived::All { .. } => Some(Value::Bool(
                sources.fold(first.as_bool(), |all, value| all & value.as_bool()),
            )),
            Derived::State { any } => {
                let words = std::iter::once(first).chain(sources).map(|word| word.as_f64() as u64);
                Some(Value::Bool(
                    any.iter()
                        .zip(words)
                        .fold(false, |is, (state, word)| is | state.holds(word)),
                ))
            }
            Derived::Sum { weights, .. } => {
                let values = std::iter::once(first).chain(sources).map(Value::as_f64);
                let sum: f64 = values.zip(weights).map(|(value, weight)| value * weight).sum();
                sum.is_finite().then(|| Value::Number(tidy(sum)))
            }
            Derived::LowestBit { .. } => {
                let mask = first.as_f64() as u64;
                let number = if mask == 0 {
                    0
                } else {
                    i64::from(mask.trailing_zeros()) + 1
                };
                Some(Value::Integer(number))
            }
        }
    }

    /// The value of the source that makes this point `value`; `None` if it cannot be commanded, such as a value
    /// below a minimum above zero.
    pub fn inverse(&self, value: f64, band: (f64, f64)) -> Option<f64> {
        match self {
            _ if band.1 <= band.0 => None,
            Derived::Band { .. } => percentage(value, band),
            Derived::Percent { .. } => Some(in_band(value, band)),
            _ => None,
        }
    }

    /// The sample derived from those of the sources: the worst quality, the oldest time.
    pub fn sample(&self, sources: impl Iterator<Item = Sample>, band: Option<(f64, f64)>) -> Sample {
        let (mut quality, mut at, mut complete) = (Quality::Good, None::<Instant>, true);
        let of_one_reading = matches!(self, Derived::Sum { .. });
        let values = sources.filter_map(|source| {
            quality = quality.worse(source.quality);
            complete &= !of_one_reading || at.is_none() || at == source.at;
            at = source.at.map(|time| at.map_or(time, |at| at.min(time))).or(at);
            complete &= source.value.is_some();
            source.value
        });
        let value = self.value(values, band).filter(|_| complete).map(unsigned_zero);
        value.map_or(Sample::NONE, |value| Sample {
            value: Some(value),
            quality,
            at,
        })
    }
}

/// The value at `percent` of a band. A lower end above zero is the minimum of a drive that turns no slower in
/// either direction, and a negative percentage turns it in reverse (reference/drives.md 3.5). Any other band is
/// linear.
fn in_band(percent: f64, (low, high): (f64, f64)) -> f64 {
    if low > 0.0 && percent < 0.0 {
        -in_band(-percent, (low, high))
    } else {
        low + percent / 100.0 * (high - low)
    }
}

/// The percentage at which a band has `value`; `None` if the value is between the minima of the two directions.
fn percentage(value: f64, (low, high): (f64, f64)) -> Option<f64> {
    if low <= 0.0 {
        return Some((value - low) / (high - low) * 100.0);
    }
    let above = value.abs() - low;
    let percent = above.max(0.0) / (high - low) * 100.0;
    (above >= -low * ROUNDING).then_some(percent.copysign(value))
}

/// Removes the sign of zero, since displayed values have no negative zero.
fn unsigned_zero(value: Value) -> Value {
    match value {
        Value::Number(number) => Value::Number(number + 0.0),
        other => other,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const A: PointIndex = PointIndex::new(0);
    const B: PointIndex = PointIndex::new(1);
    const BAND: Option<(f64, f64)> = Some((10.0, 50.0));

    fn ends() -> (Bound, Bound) {
        (Bound::Fixed(10.0), Bound::Fixed(50.0))
    }

    #[test]
    fn bands_both_ways() {
        let (minimum, maximum) = ends();
        let band = Derived::Band {
            of: A,
            minimum,
            maximum,
        };
        let percent = Derived::Percent {
            of: A,
            minimum,
            maximum,
        };
        assert_eq!(band.value([Value::Number(50.0)], BAND), Some(Value::Number(30.0)));
        assert_eq!(percent.value([Value::Number(30.0)], BAND), Some(Value::Number(50.0)));
        assert_eq!(band.inverse(30.0, (10.0, 50.0)), Some(50.0));
        assert_eq!(percent.inverse(50.0, (10.0, 50.0)), Some(30.0));
        assert_eq!(percent.value([Value::Number(30.0)], Some((5.0, 5.0))), None);
        assert_eq!(percent.value([Value::Number(30.0)], None), None);
        assert_eq!(band.inverse(30.0, (5.0, 5.0)), None);
    }

    /// reference/drives.md 3.5: the sign of a reference turns the motor round, the magnitude counts from the minimum frequency.
    #[test]
    fn a_minimum_above_zero_is_that_of_either_direction() {
        let ((minimum, maximum), range) = (ends(), (10.0, 50.0));
        let band = Derived::Band {
            of: A,
            minimum,
            maximum,
        };
        let percent = Derived::Percent {
            of: A,
            minimum,
            maximum,
        };
        for (share, hertz) in [
            (0.0, 10.0),
            (50.0, 30.0),
            (-50.0, -30.0),
            (-100.0, -50.0),
            (-25.0, -20.0),
        ] {
            assert_eq!(band.value([Value::Number(share)], BAND), Some(Value::Number(hertz)));
            assert_eq!(percent.value([Value::Number(hertz)], BAND), Some(Value::Number(share)));
            assert_eq!(band.inverse(hertz, range), Some(share));
            assert_eq!(percent.inverse(share, range), Some(hertz));
        }
        for hertz in [0.0, 5.0, 9.99, -5.0, -9.99] {
            assert_eq!(band.inverse(hertz, range), None, "{hertz} Hz");
        }
        for exact in [10.0, 10.0 - 1e-9, 10.0 + 1e-9] {
            let share = band.inverse(exact, range).unwrap();
            assert!((0.0..1e-6).contains(&share) && share.is_sign_positive(), "{share} %");
        }
        // The motor turns at its minimum. The displayed value then has no sign, the limited one does.
        let seen = |hertz: f64| {
            let sample = Sample {
                value: Some(Value::Number(hertz)),
                quality: Quality::Good,
                at: None,
            };
            percent.sample([sample].into_iter(), BAND).value.unwrap().as_f64()
        };
        assert_eq!((seen(5.0), seen(-5.0)), (0.0, 0.0));
        assert!(seen(-5.0).is_sign_positive());
        let limited = percent.value([Value::Number(-5.0)], BAND).unwrap().as_f64();
        assert!(limited == 0.0 && limited.is_sign_negative());
    }

    proptest! {
        /// A value ordered in one unit converts to the other one and back with its sign, for any band.
        #[test]
        fn there_and_back(low in 0.01f64..100.0, width in 0.1f64..100.0, share in -100.0f64..100.0, line in any::<bool>()) {
            let low = if line { -low } else { low };
            let range = (low, low + width);
            let (minimum, maximum) = ends();
            let band = Derived::Band { of: A, minimum, maximum };
            let percent = Derived::Percent { of: A, minimum, maximum };
            prop_assume!(share != 0.0);
            let hertz = band.value([Value::Number(share)], Some(range)).unwrap().as_f64();
            prop_assert!(low <= 0.0 || (hertz < 0.0) == (share < 0.0));
            prop_assert!(low <= 0.0 || (low - 1e-6..=low + width + 1e-6).contains(&hertz.abs()));
            // The result must match to a millionth, the precision of stored values.
            let near = |a: f64, b: f64, by: f64| (a - b).abs() <= by;
            prop_assert!(near(percent.value([Value::Number(hertz)], Some(range)).unwrap().as_f64(), share, 1e-3));
            prop_assert!(near(percent.inverse(share, range).unwrap(), hertz, 1e-6));
            // The exact value; the one above may be rounded to below the minimum.
            let exact = percent.inverse(share, range).unwrap();
            let back = band.inverse(exact, range).unwrap();
            prop_assert!(near(back, share, 1e-6));
            prop_assert!(near(band.value([Value::Number(back)], Some(range)).unwrap().as_f64(), exact, 1e-6));
        }
    }

    #[test]
    fn states_and_codes() {
        let number = Value::Number;
        let zero = Derived::Zero { of: A, within: 0.0 };
        assert_eq!(zero.value([number(0.0)], None), Some(Value::Bool(true)));
        assert_eq!(zero.value([number(-0.01)], None), Some(Value::Bool(false)));
        let equal = Derived::Equal {
            of: A,
            to: B,
            within: 0.01,
        };
        assert_eq!(
            equal.value([number(10.0), number(10.01)], None),
            Some(Value::Bool(true))
        );
        assert_eq!(
            equal.value([number(10.0), number(10.02)], None),
            Some(Value::Bool(false))
        );
        assert_eq!(equal.value([number(10.0)], None), None);
        let all = Derived::All { of: vec![A, B] };
        assert_eq!(
            all.value([Value::Bool(true), Value::Bool(false)], None),
            Some(Value::Bool(false))
        );
        let lowest = Derived::LowestBit { of: A };
        for (mask, code) in [(0, 0), (1, 1), (0x0204, 3), (0x1000, 13), (0x8000, 16)] {
            assert_eq!(lowest.value([Value::Integer(mask)], None), Some(Value::Integer(code)));
        }
    }

    #[test]
    fn the_worst_source_counts() {
        let sample = |quality| Sample {
            value: Some(Value::Bool(true)),
            quality,
            at: None,
        };
        let all = Derived::All { of: vec![A, B] };
        let made = all.sample([sample(Quality::Good), sample(Quality::Stale)].into_iter(), None);
        assert_eq!((made.value, made.quality), (Some(Value::Bool(true)), Quality::Stale));
        assert_eq!(
            all.sample([sample(Quality::Good), Sample::NONE].into_iter(), None),
            Sample::NONE
        );
    }
}
