//! Prometheus metrics: the plant at one time as families of series (`docs/http.md`).
//!
//! Metrics are added, never renamed or removed. Every drive is read once per scrape, so its series are consistent.
//! A point that is not good has no series, so that a graph shows a gap instead of an old value.

mod drive;
mod families;
mod model;
mod process;
mod series;

use std::fmt;
use std::time::Instant;

use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, MetricEncoder};
use prometheus_client::metrics::MetricType;
use prometheus_client::registry::Registry;

use self::series::{Families, Kind, SeriesValue};
use super::NorthState;
use drivegate_core::plant::Plant;

/// Text formats of the metrics.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// Prometheus text format 0.0.4: the family of a counter is named like its series.
    Prometheus,
    /// OpenMetrics 1.0.0: the family of a counter is named without the `_total` of its series; ends with `# EOF`.
    OpenMetrics,
}

/// The content types, with the versions of OpenMetrics that can be requested. The content is equal in all these versions.
const TYPES: [(Format, &str, &str); 3] = [
    (
        Format::OpenMetrics,
        "1.0.0",
        "application/openmetrics-text; version=1.0.0; charset=utf-8",
    ),
    (
        Format::OpenMetrics,
        "0.0.1",
        "application/openmetrics-text; version=0.0.1; charset=utf-8",
    ),
    (Format::Prometheus, "0.0.4", "text/plain; version=0.0.4; charset=utf-8"),
];

impl Format {
    /// The format for an `Accept` header, and its content type: OpenMetrics if the client prefers it, with a known
    /// version or without one.
    pub fn accepted(accept: &str) -> (Format, &'static str) {
        let weight_of = |format: Format, version: &str| {
            let wanted: &[&str] = match format {
                Format::OpenMetrics => &["application/openmetrics-text"],
                Format::Prometheus => &["text/plain", "text/*"],
            };
            let ranges = accept.split(',').filter_map(|range| weight(range, wanted));
            let fits =
                ranges.filter(|(named, _)| format == Format::Prometheus || named.is_none_or(|named| named == version));
            fits.map(|(_, weight)| weight).fold(0.0, f64::max)
        };
        // A client that accepts none of the types gets the plain text.
        let [.., (format, _, plain)] = TYPES;
        let (mut best, mut chosen) = (0.0, (format, plain));
        for (format, version, content_type) in TYPES {
            let weight = weight_of(format, version);
            if weight > best {
                (best, chosen) = (weight, (format, content_type));
            }
        }
        chosen
    }
}

/// Version and weight of a media range in an `Accept` header, if the range is one of `wanted`.
fn weight<'r>(range: &'r str, wanted: &[&str]) -> Option<(Option<&'r str>, f64)> {
    let mut parts = range.split(';').map(str::trim);
    let media = parts.next()?;
    if !wanted.iter().any(|w| w.eq_ignore_ascii_case(media)) {
        return None;
    }
    let (mut version, mut weight) = (None, 1.0);
    for (name, value) in parts.filter_map(|part| part.split_once('=')) {
        match name.trim() {
            "q" | "Q" => weight = value.trim().parse().map_or(1.0, |q: f64| q.clamp(0.0, 1.0)),
            name if name.eq_ignore_ascii_case("version") => version = Some(value.trim().trim_matches('"')),
            _ => {}
        }
    }
    Some((version, weight))
}

/// All metrics of the gateway as text.
///
/// # Errors
/// If the encoder fails, which does not happen when writing to a string.
pub fn encode(plant: &Plant, stats: &NorthState, now: Instant, format: Format) -> Result<String, fmt::Error> {
    let mut registry = Registry::default();
    registry.register_collector(Box::new(Scrape {
        families: families::collect(plant, stats, now),
        format,
    }));
    let mut text = String::new();
    match format {
        Format::Prometheus => prometheus_client::encoding::text::encode_registry(&mut text, &registry)?,
        Format::OpenMetrics => prometheus_client::encoding::text::encode(&mut text, &registry)?,
    }
    Ok(text)
}

#[derive(Debug)]
struct Scrape {
    families: Families,
    format: Format,
}

impl Collector for Scrape {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> Result<(), fmt::Error> {
        for (family, series) in self.families.iter() {
            let kind = match family.kind {
                Kind::Gauge => MetricType::Gauge,
                Kind::Counter => MetricType::Counter,
                Kind::Histogram => MetricType::Histogram,
            };
            let name = match (self.format, family.kind) {
                (Format::OpenMetrics, Kind::Counter) => family.name.trim_end_matches("_total"),
                _ => family.name,
            };
            let mut metric = encoder.encode_descriptor(name, family.help, None, kind)?;
            for (_, labels, figure) in series {
                if labels.is_empty() {
                    self.figure(figure, &mut metric)?;
                } else {
                    self.figure(figure, &mut metric.encode_family(labels)?)?;
                }
            }
        }
        Ok(())
    }
}

impl Scrape {
    fn figure(&self, figure: &SeriesValue, metric: &mut MetricEncoder<'_>) -> Result<(), fmt::Error> {
        type NoLabels = [(&'static str, &'static str); 0];
        match (figure, self.format) {
            (SeriesValue::Value(value), _) => gauge(*value, metric),
            // The library appends `_total` to a counter; in the older format the name already ends with that.
            (SeriesValue::Count(count), Format::Prometheus) => metric.encode_gauge(count),
            (SeriesValue::Count(count), Format::OpenMetrics) => metric.encode_counter::<NoLabels, _, u64>(count, None),
            (SeriesValue::Total(total), Format::Prometheus) => metric.encode_gauge(total),
            (SeriesValue::Total(total), Format::OpenMetrics) => metric.encode_counter::<NoLabels, _, f64>(total, None),
            (SeriesValue::Histogram(times), _) => {
                // The image marks the unbounded bucket by the greatest number.
                let buckets: Vec<(f64, u64)> = times
                    .buckets
                    .iter()
                    .map(|&(bound, count)| (if bound == f64::MAX { f64::INFINITY } else { bound }, count))
                    .collect();
                metric.encode_histogram::<NoLabels>(times.sum, times.count, &buckets, None)
            }
        }
    }
}

/// Whole numbers without a fraction: `1`, not `1.0`.
fn gauge(value: f64, metric: &mut MetricEncoder<'_>) -> Result<(), fmt::Error> {
    const EXACT: f64 = 9_007_199_254_740_992.0;
    if value.fract() == 0.0 && value.abs() < EXACT {
        metric.encode_gauge(&(value as i64))
    } else {
        metric.encode_gauge(&value)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::time::Duration;

    use drivegate_testkit::{STALE_AFTER, bus, bus_spec, image, monitored, nx};

    use super::*;
    use drivegate_core::process_image::{DriveImage, DriveSpec, LeaseAction, Supervision};

    fn drive(name: &str, supervision: Option<Supervision>) -> Arc<DriveImage> {
        image(DriveSpec {
            supervision,
            ..monitored(name, "line1", 1, &nx())
        })
    }

    fn plant(drives: Vec<Arc<DriveImage>>) -> Plant {
        Plant::new("pump-house", STALE_AFTER, vec![bus(bus_spec("line1"), drives)])
    }

    #[test]
    fn a_drive_that_runs_unsupervised_has_a_gauge_where_it_has_supervision() {
        let supervision = Supervision {
            timeout: Duration::from_secs(5),
            action: LeaseAction::Stop,
            adopt: false,
        };
        let pump = drive("pump-1", Some(supervision));
        let plant = plant(vec![pump.clone(), drive("fan-2", None)]);
        let gauge = || {
            let text = encode(&plant, &NorthState::default(), Instant::now(), Format::Prometheus).unwrap();
            let of = |line: &&str| line.contains("drivegate_drive_unsupervised") && !line.starts_with("# HELP");
            text.lines().filter(of).map(str::to_string).collect::<Vec<_>>()
        };
        let shown = |value: &str| {
            let series = format!("drivegate_drive_unsupervised{{bus=\"line1\",drive=\"pump-1\"}} {value}");
            vec!["# TYPE drivegate_drive_unsupervised gauge".to_string(), series]
        };
        assert_eq!(gauge(), shown("0"));
        pump.set_unsupervised(true);
        assert_eq!(gauge(), shown("1"));
        pump.set_unsupervised(false);
        assert_eq!(gauge(), shown("0"));
        let page = include_str!("../../../../docs/http.md");
        assert!(page.contains("`drivegate_drive_unsupervised`"));
    }

    #[test]
    fn open_metrics_only_on_request() {
        let prometheus = "application/openmetrics-text;version=1.0.0,application/openmetrics-text;version=0.0.1;\
            q=0.75,text/plain;version=0.0.4;q=0.5,*/*;q=0.1";
        let is_open = |accept: &str, version: &str| {
            let wanted = format!("application/openmetrics-text; version={version}; charset=utf-8");
            Format::accepted(accept) == (Format::OpenMetrics, wanted.as_str())
        };
        assert!(is_open(prometheus, "1.0.0"));
        // Requested alone: the response has the requested version.
        assert!(is_open("application/openmetrics-text; version=1.0.0", "1.0.0"));
        assert!(is_open("application/openmetrics-text; version=0.0.1", "0.0.1"));
        let quoted = "application/openmetrics-text;version=\"0.0.1\", text/plain;q=0.3";
        assert!(is_open(quoted, "0.0.1"));
        assert!(is_open("application/openmetrics-text", "1.0.0"));
        for plain in [
            "",
            "*/*",
            "text/plain",
            "application/openmetrics-text;q=0",
            "application/openmetrics-text;q=0.2, text/plain;q=0.9",
            "application/json, text/*",
            "application/openmetrics-text; version=2.0.0",
            "application/openmetrics-text; version=2.0.0, text/plain;q=0.1",
        ] {
            let plain_text = (Format::Prometheus, "text/plain; version=0.0.4; charset=utf-8");
            assert_eq!(Format::accepted(plain), plain_text, "{plain}");
        }
        assert!(is_open("Application/OpenMetrics-Text; q=0.5, */*", "1.0.0"));
    }
}
