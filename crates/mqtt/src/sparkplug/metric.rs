//! Metrics of the session, and their conversion to metrics of a payload.

use std::time::{Instant, SystemTime, UNIX_EPOCH};

use super::wire::{self, DataType, MetricValue, PropertyContent, PropertySet};
use drivegate_model::drive::{Quality, Value};

/// A moment on two clocks: the monotonic clock for intervals, and the calendar.
#[derive(Debug, Clone, Copy)]
pub(super) struct Moment {
    pub(super) now: Instant,
    pub(super) wall: SystemTime,
}

impl Moment {
    /// The present moment.
    pub(super) fn present() -> Moment {
        Moment {
            now: Instant::now(),
            wall: SystemTime::now(),
        }
    }

    /// This moment as milliseconds since 1970.
    pub(super) fn millis(self) -> u64 {
        self.millis_at(None)
    }

    /// An earlier time, if given, as ms since 1970.
    pub(super) fn millis_at(self, at: Option<Instant>) -> u64 {
        let age = at.map(|at| self.now.saturating_duration_since(at)).unwrap_or_default();
        let time = self.wall.checked_sub(age).unwrap_or(self.wall);
        let since = time.duration_since(UNIX_EPOCH).unwrap_or_default();
        u64::try_from(since.as_millis()).unwrap_or(u64::MAX)
    }

    /// A sample of now: good, or bad without a value.
    pub(super) fn sample(self, value: Option<Datum>) -> Sample {
        Sample {
            quality: if value.is_some() { Quality::Good } else { Quality::Bad },
            value,
            time: self.millis(),
        }
    }
}

/// The value of a metric.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Datum {
    Bool(bool),
    Integer(i64),
    Unsigned(u64),
    Number(f64),
    Text(String),
}

impl Datum {
    pub(super) fn text(text: &str) -> Datum {
        Datum::Text(text.to_string())
    }
}

impl From<Value> for Datum {
    fn from(value: Value) -> Datum {
        match value {
            Value::Bool(state) => Datum::Bool(state),
            Value::Integer(code) => Datum::Integer(code),
            Value::Unsigned(count) => Datum::Unsigned(count),
            Value::Text(text) => Datum::Text(text.shown()),
            // Adding 0.0 turns a negative zero into zero.
            Value::Number(number) => Datum::Number(number + 0.0),
        }
    }
}

/// How soon changes of a metric are published.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Pace {
    /// Published at most once per minimum interval.
    Normal,
    /// A value that changes continuously: published once a second, or together with others.
    Figure,
}

/// The constant part of a metric, sent in the birth.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Definition {
    pub(super) name: String,
    pub(super) datatype: DataType,
    /// Engineering unit; empty if there is none.
    pub(super) unit: String,
    pub(super) low: Option<f64>,
    pub(super) high: Option<f64>,
    pub(super) pace: Pace,
}

/// The part of a metric that changes.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Sample {
    /// `None` unless the quality is good.
    pub(super) value: Option<Datum>,
    pub(super) quality: Quality,
    /// When the value was read, ms since 1970.
    pub(super) time: u64,
}

impl Sample {
    /// Whether the two samples differ in nothing but the time.
    pub(super) fn is_same(&self, other: &Sample) -> bool {
        (&self.value, self.quality) == (&other.value, other.quality)
    }
}

/// How a metric is named in all messages but births.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Naming {
    Name,
    Alias(u64),
}

/// The code of a quality in the property `Quality`.
fn quality_code(quality: Quality) -> u32 {
    match quality {
        Quality::Bad => 0,
        Quality::Good => 192,
        Quality::Stale => 500,
    }
}

impl Definition {
    /// A metric without unit and limits.
    pub(super) fn new(name: &str, datatype: DataType) -> Definition {
        Definition {
            name: name.to_string(),
            datatype,
            unit: String::new(),
            low: None,
            high: None,
            pace: Pace::Normal,
        }
    }

    /// The metric in a birth, with all that is fixed.
    pub(super) fn birth(&self, naming: Naming, sample: &Sample) -> wire::Metric {
        let mut metric = self.metric(sample);
        metric.name = Some(self.name.clone());
        metric.alias = match naming {
            Naming::Name => None,
            Naming::Alias(alias) => Some(alias),
        };
        let mut properties = quality(sample.quality);
        if !self.unit.is_empty() {
            let unit = PropertyContent::String(self.unit.clone());
            properties.push("engUnit", DataType::String, unit);
        }
        for (key, end) in [("engLow", self.low), ("engHigh", self.high)] {
            if let Some(end) = end {
                properties.push(key, DataType::Double, PropertyContent::Double(end));
            }
        }
        metric.properties = Some(properties);
        metric
    }

    /// The metric in a data message; `before` is the quality that was published last.
    pub(super) fn data(&self, naming: Naming, sample: &Sample, before: Option<Quality>) -> wire::Metric {
        let mut metric = self.metric(sample);
        match naming {
            Naming::Name => metric.name = Some(self.name.clone()),
            Naming::Alias(alias) => metric.alias = Some(alias),
        }
        let plain = sample.quality == Quality::Good && before == Some(Quality::Good);
        metric.properties = (!plain).then(|| quality(sample.quality));
        metric
    }

    fn metric(&self, sample: &Sample) -> wire::Metric {
        wire::Metric {
            timestamp: Some(sample.time),
            datatype: Some(self.datatype.code()),
            is_null: sample.value.is_none().then_some(true),
            value: sample.value.as_ref().map(|value| value.on_the_wire(self.datatype)),
            ..wire::Metric::default()
        }
    }
}

impl Datum {
    fn on_the_wire(&self, datatype: DataType) -> MetricValue {
        match (self, datatype) {
            (Datum::Bool(state), _) => MetricValue::Boolean(*state),
            (Datum::Unsigned(count), _) => MetricValue::Long(*count),
            (Datum::Integer(code), DataType::Double) => MetricValue::Double(*code as f64),
            (Datum::Integer(code), _) => MetricValue::Long(code.cast_unsigned()),
            (Datum::Number(number), _) => MetricValue::Double(*number),
            (Datum::Text(text), _) => MetricValue::String(text.clone()),
        }
    }
}

fn quality(quality: Quality) -> PropertySet {
    let mut properties = PropertySet::default();
    let code = PropertyContent::Int(quality_code(quality));
    properties.push("Quality", DataType::Int32, code);
    properties
}

#[cfg(test)]
mod tests {
    use super::*;

    fn current() -> Definition {
        Definition {
            name: "motor_current".to_string(),
            datatype: DataType::Double,
            unit: "A".to_string(),
            low: None,
            high: Some(120.0),
            pace: Pace::Normal,
        }
    }

    fn sample(value: Option<f64>, quality: Quality) -> Sample {
        Sample {
            value: value.map(Datum::Number),
            quality,
            time: 5,
        }
    }

    #[test]
    fn births_have_everything() {
        let metric = current().birth(Naming::Alias(9), &sample(Some(1.5), Quality::Good));
        assert_eq!((metric.name.as_deref(), metric.alias), (Some("motor_current"), Some(9)));
        assert_eq!(
            (metric.timestamp, metric.datatype, metric.is_null),
            (Some(5), Some(10), None)
        );
        assert_eq!(metric.value, Some(MetricValue::Double(1.5)));
        let properties = metric.properties.unwrap();
        assert_eq!(properties.keys, ["Quality", "engUnit", "engHigh"]);
        let values: Vec<_> = properties.values.into_iter().filter_map(|p| p.value).collect();
        let expected = [
            PropertyContent::Int(192),
            PropertyContent::String("A".to_string()),
            PropertyContent::Double(120.0),
        ];
        assert_eq!(values, expected);
    }

    #[test]
    fn what_is_not_good_is_null_with_its_quality() {
        let (good, stale) = (sample(Some(1.5), Quality::Good), sample(None, Quality::Stale));
        let code = |metric: &wire::Metric| {
            let properties = metric.properties.as_ref()?;
            Some((properties.keys.clone(), properties.values.first()?.value.clone()?))
        };
        let quality = |code| Some((vec!["Quality".to_string()], PropertyContent::Int(code)));
        let metric = current().data(Naming::Name, &good, Some(Quality::Good));
        assert_eq!((metric.name.as_deref(), metric.alias), (Some("motor_current"), None));
        assert_eq!((code(&metric), metric.is_null), (None, None));
        let metric = current().data(Naming::Alias(9), &stale, Some(Quality::Good));
        assert_eq!((metric.name, metric.alias, metric.is_null), (None, Some(9), Some(true)));
        let metric = current().data(Naming::Alias(9), &stale, Some(Quality::Stale));
        assert_eq!((code(&metric), metric.value.as_ref()), (quality(500), None));
        let metric = current().data(Naming::Alias(9), &good, Some(Quality::Stale));
        assert_eq!((code(&metric), metric.is_null), (quality(192), None));
        let metric = current().data(Naming::Alias(9), &sample(None, Quality::Bad), None);
        assert_eq!(code(&metric), quality(0));
    }
}
