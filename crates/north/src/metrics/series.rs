//! Families of series, with their labels and values.

use std::borrow::Cow;
use std::fmt;
use std::sync::Arc;

use prometheus_client::encoding::{EncodeLabel, EncodeLabelSet, LabelSetEncoder};

use drivegate_core::process_image::HistogramSnapshot;

/// A label of a series: name and value.
pub(super) type Label = (&'static str, Cow<'static, str>);

/// Labels of a metric series. A plant has thousands of series, so the series of one drive share their common labels.
#[derive(Debug, Clone, Default)]
pub(super) struct Labels {
    of: Option<Arc<[Label]>>,
    own: [Option<Label>; 2],
}

impl Labels {
    pub(super) fn of<const N: usize>(labels: [(&'static str, &str); N]) -> Labels {
        let owned = labels.map(|(name, value)| (name, Cow::Owned(value.to_string())));
        Labels {
            of: Some(Arc::new(owned)),
            own: [None, None],
        }
    }

    /// The labels with one more label.
    pub(super) fn with(&self, name: &'static str, value: impl Into<Cow<'static, str>>) -> Labels {
        Labels {
            of: self.of.clone(),
            own: [Some((name, value.into())), None],
        }
    }

    /// The labels with two more labels.
    pub(super) fn with_both(&self, first: Label, second: Label) -> Labels {
        Labels {
            of: self.of.clone(),
            own: [Some(first), Some(second)],
        }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.of.is_none() && self.own.iter().all(Option::is_none)
    }
}

impl EncodeLabelSet for Labels {
    fn encode(&self, encoder: &mut LabelSetEncoder<'_>) -> fmt::Result {
        let shared = self.of.iter().flat_map(|of| of.iter());
        let mut all = shared.chain(self.own.iter().flatten());
        all.try_for_each(|label| label.encode(encoder.encode_label()))
    }
}

/// Kind of a metric family.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Gauge,
    Counter,
    Histogram,
}

#[derive(Debug)]
pub(super) enum SeriesValue {
    /// Value of a gauge.
    Value(f64),
    /// Value of a counter of events.
    Count(u64),
    /// Value of a counter of seconds.
    Total(f64),
    Histogram(HistogramSnapshot),
}

impl From<f64> for SeriesValue {
    fn from(value: f64) -> SeriesValue {
        SeriesValue::Value(value)
    }
}

impl From<u64> for SeriesValue {
    fn from(count: u64) -> SeriesValue {
        SeriesValue::Count(count)
    }
}

impl From<HistogramSnapshot> for SeriesValue {
    fn from(times: HistogramSnapshot) -> SeriesValue {
        SeriesValue::Histogram(times)
    }
}

/// Converts true to 1 and false to 0.
impl From<bool> for SeriesValue {
    fn from(it_is: bool) -> SeriesValue {
        SeriesValue::Value(f64::from(u8::from(it_is)))
    }
}

/// The common part of the series of one name.
#[derive(Debug, Clone, Copy)]
pub(super) struct Family {
    pub(super) name: &'static str,
    pub(super) help: &'static str,
    pub(super) kind: Kind,
}

/// Index of a metric family.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct FamilyId(usize);

/// All series of a scrape in one list: a separate list for each family would fragment the heap with every scrape.
#[derive(Debug, Default)]
pub(super) struct Families {
    families: Vec<Family>,
    series: Vec<(FamilyId, Labels, SeriesValue)>,
}

impl Families {
    pub(super) fn gauge(&mut self, name: &'static str, help: &'static str) -> FamilyId {
        self.family(Kind::Gauge, name, help)
    }

    pub(super) fn counter(&mut self, name: &'static str, help: &'static str) -> FamilyId {
        self.family(Kind::Counter, name, help)
    }

    pub(super) fn histogram(&mut self, name: &'static str, help: &'static str) -> FamilyId {
        self.family(Kind::Histogram, name, help)
    }

    fn family(&mut self, kind: Kind, name: &'static str, help: &'static str) -> FamilyId {
        self.families.push(Family { name, help, kind });
        FamilyId(self.families.len() - 1)
    }

    pub(super) fn add(&mut self, family: FamilyId, labels: Labels, figure: impl Into<SeriesValue>) {
        self.series.push((family, labels, figure.into()));
    }

    /// A family of one series without labels.
    pub(super) fn one(&mut self, kind: Kind, name: &'static str, help: &'static str, figure: impl Into<SeriesValue>) {
        let family = self.family(kind, name, help);
        self.add(family, Labels::default(), figure);
    }

    /// Brings together the series of each family without changing their order.
    pub(super) fn sort(&mut self) {
        self.series.sort_by_key(|(family, ..)| *family);
    }

    /// The families that have series, with these.
    pub(super) fn iter(&self) -> impl Iterator<Item = (&Family, &[(FamilyId, Labels, SeriesValue)])> {
        let chunks = self.series.chunk_by(|a, b| a.0 == b.0);
        chunks.filter_map(|series| Some((self.families.get(series.first()?.0.0)?, series)))
    }
}
