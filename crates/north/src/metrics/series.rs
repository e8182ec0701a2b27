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

/// A family, and the series that a `T` has in it.
#[derive(Debug)]
pub(super) struct Row<T> {
    pub(super) family: Family,
    pub(super) series: fn(&T, &mut Series<'_>),
}

/// Writes the rows of a table: the `T`, then kind, name and help of each family, and a closure that adds the series.
macro_rules! rows {
    ($of:ty; $($kind:ident $name:literal $help:literal => $series:expr;)*) => {{
        use $crate::metrics::series::{Family, Kind, Row};
        let rows: Vec<Row<$of>> = vec![$(Row::<$of> {
            family: Family { name: $name, help: $help, kind: Kind::$kind },
            series: $series,
        }),*];
        rows
    }};
}
pub(super) use rows;

/// The series of one family and one `T` of its [`Row`], whose labels they have.
#[derive(Debug)]
pub(super) struct Series<'a> {
    all: &'a mut Vec<(usize, Labels, SeriesValue)>,
    family: usize,
    labels: &'a Labels,
}

impl Series<'_> {
    pub(super) fn add(&mut self, figure: impl Into<SeriesValue>) {
        self.labelled(self.labels.clone(), figure);
    }

    /// No series if the figure is absent.
    pub(super) fn add_some(&mut self, figure: Option<impl Into<SeriesValue>>) {
        if let Some(figure) = figure {
            self.add(figure);
        }
    }

    /// A series with one more label.
    pub(super) fn with(
        &mut self,
        name: &'static str,
        value: impl Into<Cow<'static, str>>,
        figure: impl Into<SeriesValue>,
    ) {
        self.labelled(self.labels.with(name, value), figure);
    }

    /// A series with two more labels.
    pub(super) fn with_both(&mut self, first: Label, second: Label, figure: impl Into<SeriesValue>) {
        self.labelled(self.labels.with_both(first, second), figure);
    }

    /// A series with labels of its own.
    pub(super) fn labelled(&mut self, labels: Labels, figure: impl Into<SeriesValue>) {
        self.all.push((self.family, labels, figure.into()));
    }
}

/// All series of a scrape in one list, each with the index of its family: a separate list for each family would fragment the
/// heap with every scrape.
#[derive(Debug, Default)]
pub(super) struct Families {
    families: Vec<Family>,
    series: Vec<(usize, Labels, SeriesValue)>,
}

impl Families {
    /// Adds the families of a table, with the series of these things.
    pub(super) fn fill<T>(&mut self, table: &[Row<T>], things: impl IntoIterator<Item = (Labels, T)>) {
        let first = self.families.len();
        self.families.extend(table.iter().map(|row| row.family));
        for (labels, thing) in things {
            for (family, row) in (first..).zip(table) {
                let mut series = Series {
                    all: &mut self.series,
                    family,
                    labels: &labels,
                };
                (row.series)(&thing, &mut series);
            }
        }
    }

    /// Brings together the series of each family without changing their order.
    pub(super) fn sort(&mut self) {
        self.series.sort_by_key(|(family, ..)| *family);
    }

    /// The families that have series, with these.
    pub(super) fn iter(&self) -> impl Iterator<Item = (&Family, &[(usize, Labels, SeriesValue)])> {
        let chunks = self.series.chunk_by(|a, b| a.0 == b.0);
        chunks.filter_map(|series| Some((self.families.get(series.first()?.0)?, series)))
    }
}
