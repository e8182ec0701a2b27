//! The metrics of the node and its drives, and their present values. Time is an argument.

use std::time::SystemTime;

use super::super::payload;
use super::metric::{Datum, Definition, Moment, Pace, Sample};
use super::wire::DataType;
use drivegate_core::plant::{BusHandle, DriveHandle, Plant};
use drivegate_core::process_image::Reading;
use drivegate_model::drive::model::Kind;
use drivegate_model::drive::profile::Form;
use drivegate_model::drive::{ModelPoint, Point, PointIndex, Quality, State};

/// Name of the metric for the result of the last command over Sparkplug: its code, and why it failed.
pub(super) const COMMAND_RESULT: &str = "command_result";
pub(super) const COMMAND_ERROR: &str = "command_error";

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Source {
    Point(PointIndex),
    /// The text of an enumeration point.
    TextOf(PointIndex),
    State,
    FaultText,
    HoldState,
    Holder,
    HoldRank,
    HoldLeft,
    CommandResult,
    CommandError,
}

/// A drive with the sources of its metrics.
#[derive(Debug)]
pub(super) struct DriveMetrics {
    pub(super) drive: DriveHandle,
    sources: Vec<Source>,
    /// Code and text of the result of the last command.
    result: Option<(String, String)>,
}

impl DriveMetrics {
    /// The metrics with their definitions; `commands` sets whether commands over Sparkplug are accepted.
    pub(super) fn new(drive: DriveHandle, commands: bool) -> (DriveMetrics, Vec<Definition>) {
        let spec = &drive.image.spec;
        let text = |name: &str| Definition::new(name, DataType::String);
        let mut all = vec![(Source::State, text("state"))];
        for (index, name) in payload::published_points(&spec.profile) {
            let Some(point) = spec.profile.points.get(index) else {
                continue;
            };
            let range = spec.limits_of(index);
            let definition = Definition {
                unit: point.unit.clone(),
                low: range.as_ref().map(|range| *range.start()),
                high: range.as_ref().map(|range| *range.end()),
                ..Definition::new(name, datatype(point))
            };
            all.push((Source::Point(index), definition));
            if let Some((name, _)) = payload::text_beside(point, None) {
                all.push((Source::TextOf(index), text(&name)));
            }
        }
        if spec.profile.model_index(ModelPoint::FaultCode).is_some() {
            all.push((Source::FaultText, text("fault_text")));
        }
        if drive.has_authority() {
            all.push((Source::HoldState, text("Hold/State")));
            all.push((Source::Holder, text("Hold/Holder")));
            all.push((Source::HoldRank, text("Hold/Rank")));
            let left = Definition {
                unit: "s".to_string(),
                pace: Pace::Figure,
                ..Definition::new("Hold/Left", DataType::Int64)
            };
            all.push((Source::HoldLeft, left));
        }
        if commands {
            all.push((Source::CommandResult, text(COMMAND_RESULT)));
            all.push((Source::CommandError, text(COMMAND_ERROR)));
        }
        let (sources, definitions) = all.into_iter().unzip();
        let metrics = DriveMetrics {
            drive,
            sources,
            result: None,
        };
        (metrics, definitions)
    }

    pub(super) fn set_result(&mut self, code: &str, error: String) {
        self.result = Some((code.to_string(), error));
    }

    /// The result of the last command, when the metrics are remade.
    pub(super) fn keep_result_of(&mut self, before: &DriveMetrics) {
        self.result = before.result.clone();
    }

    /// Whether the drive is online, and the samples of its metrics in the order of their definitions.
    pub(super) fn samples(&self, reading: &Reading<'_>, wall: SystemTime) -> Vec<Sample> {
        let moment = Moment { now: reading.now, wall };
        self.sources
            .iter()
            .map(|source| self.sample(*source, reading, moment))
            .collect()
    }

    fn sample(&self, source: Source, reading: &Reading<'_>, moment: Moment) -> Sample {
        let of = |index| {
            let sample = reading.sample(index);
            // For a sample that is no longer good, the present time is used.
            let at = sample.at.filter(|_| sample.quality == Quality::Good);
            (sample.good(), sample.quality, at)
        };
        let (value, quality, at) = match source {
            Source::Point(index) => {
                let (value, quality, at) = of(index);
                (value.map(Datum::from), quality, at)
            }
            Source::TextOf(index) => {
                let (value, quality, at) = of(index);
                let point = reading.spec.profile.points.get(index);
                let text = value.map(|value| point.and_then(|p| p.text_of(value)).unwrap_or_default());
                (text.map(Datum::text), quality, at)
            }
            Source::State => {
                let state = reading.state();
                let quality = state.map_or(reading.overall(), |_| Quality::Good);
                let fast_at = reading.snapshot.fast_at.filter(|_| !reading.is_stale());
                (state.map(|state: State| Datum::text(state.name())), quality, fast_at)
            }
            Source::FaultText => {
                let code = reading.model(ModelPoint::FaultCode);
                let good = code.good().is_some();
                let text = good.then(|| Datum::Text(reading.fault_text()));
                (text, code.quality, code.at.filter(|_| good))
            }
            Source::HoldState | Source::Holder | Source::HoldRank | Source::HoldLeft => {
                let view = self.drive.hold_view(None, moment.now).map(|(view, _)| view);
                let value = view.map(|view| match source {
                    Source::HoldState => Datum::text(view.state.name()),
                    Source::Holder => Datum::Text(view.holder.unwrap_or_default().to_string()),
                    Source::HoldRank => Datum::Text(view.rank.unwrap_or_default().to_string()),
                    _ => Datum::Integer(view.left_s.and_then(|left| i64::try_from(left).ok()).unwrap_or(-1)),
                });
                return moment.sample(value);
            }
            Source::CommandResult | Source::CommandError => {
                let (code, error) = self.result.as_ref().map_or(("", ""), |(c, e)| (c.as_str(), e.as_str()));
                let text = if source == Source::CommandResult { code } else { error };
                return moment.sample(Some(Datum::text(text)));
            }
        };
        let time = moment.millis_at(at);
        Sample { value, quality, time }
    }
}

fn datatype(point: &Point) -> DataType {
    match point.kind() {
        Kind::Bool => DataType::Boolean,
        Kind::Integer if point.raw().is_some_and(|raw| raw.form == Form::U64) => DataType::UInt64,
        Kind::Integer => DataType::Int64,
        Kind::Text => DataType::String,
        Kind::Number => DataType::Double,
    }
}

/// The metrics of the node with their present values: `Bus/{bus}/…`, as in the health object of the bus.
pub(super) fn node_metrics(plant: &Plant, moment: Moment) -> (Vec<Definition>, Vec<Sample>) {
    use DataType::{Double, Int64, String};
    use Pace::{Figure, Normal};
    let of_bus = |bus: &BusHandle| {
        let (state, figures) = payload::bus_now(bus);
        let of = |leaf: &str, datatype, unit: &str, pace, value| {
            let definition = Definition {
                unit: unit.to_string(),
                pace,
                ..Definition::new(&format!("Bus/{}/{leaf}", bus.image.spec.name), datatype)
            };
            (definition, moment.sample(value))
        };
        let text = |text: &str| Some(Datum::text(text));
        let count = |count: u64| Some(Datum::Integer(i64::try_from(count).unwrap_or(i64::MAX)));
        let figure = |figure: Option<f64>| figure.map(Datum::Number);
        let reason = state.reason.unwrap_or_default();
        [
            of("state", String, "", Normal, text(if state.up { "up" } else { "down" })),
            of("reason", String, "", Normal, text(&reason)),
            of("drives", Int64, "", Normal, count(state.drives as u64)),
            of("online", Int64, "", Normal, count(state.online as u64)),
            of("load", Double, "", Figure, figure(figures.load)),
            of("fast_cycle_ms", Double, "ms", Figure, figure(figures.fast_cycle_ms)),
            of("slow_cycle_ms", Double, "ms", Figure, figure(figures.slow_cycle_ms)),
            of("transactions", Int64, "", Figure, count(figures.transactions)),
            of("errors", Int64, "", Figure, count(figures.errors)),
            of("queue", Int64, "", Figure, count(figures.queue as u64)),
        ]
    };
    plant.buses.iter().flat_map(of_bus).unzip()
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant, UNIX_EPOCH};

    use super::super::super::fixture;
    use super::*;

    #[test]
    fn metrics_of_a_drive_have_units_ranges_and_the_time_of_their_reading() {
        let plant = fixture::plant(&["p1"]);
        let start = Instant::now();
        fixture::read(&plant, "p1", 3, 2500, start);
        let (metrics, definitions) = DriveMetrics::new(plant.drive("p1").unwrap(), true);
        let place = |name: &str| definitions.iter().position(|d| d.name == name).unwrap();
        let current = &definitions[place("motor_current")];
        assert_eq!((current.unit.as_str(), current.datatype), ("A", DataType::Double));
        let reference = &definitions[place("speed_reference")];
        assert_eq!((reference.low, reference.high), (Some(-100.0), Some(100.0)));
        assert_eq!(definitions[place("fault_code")].datatype, DataType::Int64);
        assert_eq!(definitions[place("running")].datatype, DataType::Boolean);
        let wall = UNIX_EPOCH + Duration::from_secs(1000);
        let at = |ms| {
            let reading = metrics.drive.reading(start + Duration::from_millis(ms));
            metrics.samples(&reading, wall + Duration::from_millis(ms))
        };
        let seen = at(400);
        let frequency = &seen[place("output_frequency")];
        assert_eq!(
            (&frequency.value, frequency.time),
            (&Some(Datum::Number(25.0)), 1_000_000)
        );
        assert_eq!(seen[place("state")].value, Some(Datum::Text("running".to_string())));
        let later = at(2000);
        let frequency = &later[place("output_frequency")];
        assert_eq!((&frequency.value, frequency.quality), (&None, Quality::Stale));
        assert_eq!(frequency.time, 1_002_000, "it is not good now");
        let heat = &seen[place("heatsink_temperature")];
        assert_eq!((&heat.value, heat.quality), (&None, Quality::Bad), "never read");
    }

    #[test]
    fn each_metric_of_the_node_has_its_value() {
        let plant = fixture::plant(&["p1"]);
        let moment = Moment {
            now: Instant::now(),
            wall: UNIX_EPOCH,
        };
        let (definitions, samples) = node_metrics(&plant, moment);
        assert_eq!(definitions.len(), samples.len());
        let value = |name: &str| {
            let place = definitions.iter().position(|d| d.name == name).unwrap();
            samples[place].value.clone()
        };
        assert_eq!(value("Bus/line1/state"), Some(Datum::Text("up".to_string())));
        assert_eq!(value("Bus/line1/drives"), Some(Datum::Integer(1)));
        assert_eq!(value("Bus/line1/fast_cycle_ms"), None);
    }
}
