//! Which metrics the node and its drives have, and what they are now. Time is an argument.

use std::time::{Instant, SystemTime, UNIX_EPOCH};

use super::super::payload;
use super::metric::{Datum, Definition, Pace, Sample};
use super::wire::DataType;
use crate::drive::model::Kind;
use crate::drive::profile::Form;
use crate::drive::{ModelPoint, Point, PointIndex, Quality, State};
use crate::plant::{BusHandle, DriveHandle, Plant};
use crate::process_image::Reading;

/// The result of the last command over Sparkplug: its code, and why it failed.
pub(super) const COMMAND_RESULT: &str = "command_result";
pub(super) const COMMAND_ERROR: &str = "command_error";

/// Milliseconds since 1970.
pub(super) fn millis(time: SystemTime) -> u64 {
    let since = time.duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_millis()).unwrap_or(u64::MAX)
}

/// Time as the sources of metrics need it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Moment {
    pub(super) now: Instant,
    /// The time of day then.
    pub(super) wall: SystemTime,
}

impl Moment {
    fn millis_at(self, at: Option<Instant>) -> u64 {
        let age = at.map(|at| self.now.saturating_duration_since(at)).unwrap_or_default();
        millis(self.wall.checked_sub(age).unwrap_or(self.wall))
    }

    /// A value that is known at any time.
    fn known(self, value: Datum) -> Sample {
        Sample {
            value: Some(value),
            quality: Quality::Good,
            time: millis(self.wall),
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Source {
    Point(PointIndex),
    /// The text of an enumeration.
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

/// One drive: where its metrics come from.
#[derive(Debug)]
pub(super) struct DriveMetrics {
    pub(super) drive: DriveHandle,
    sources: Vec<Source>,
    /// Code and text of the result of the last command.
    result: Option<(String, String)>,
}

impl DriveMetrics {
    /// With their definitions; `commands` says whether commands over Sparkplug are served.
    pub(super) fn new(drive: DriveHandle, commands: bool) -> (DriveMetrics, Vec<Definition>) {
        let spec = &drive.image.spec;
        let mut all = vec![(Source::State, text("state"))];
        for (index, name) in payload::published_points(&spec.profile) {
            let Some(point) = spec.profile.points.get(index) else {
                continue;
            };
            let range = spec.limits_of(index);
            let definition = Definition {
                name: name.to_string(),
                datatype: datatype(point),
                unit: point.unit.clone(),
                low: range.as_ref().map(|range| *range.start()),
                high: range.as_ref().map(|range| *range.end()),
                pace: Pace::Normal,
            };
            all.push((Source::Point(index), definition));
            if let Some((name, _)) = payload::text_beside(point, None) {
                all.push((Source::TextOf(index), text(&name)));
            }
        }
        if spec.profile.model_index(ModelPoint::FaultCode).is_some() {
            all.push((Source::FaultText, text("fault_text")));
        }
        if drive.is_guarded() {
            all.push((Source::HoldState, text("Hold/State")));
            all.push((Source::Holder, text("Hold/Holder")));
            all.push((Source::HoldRank, text("Hold/Rank")));
            let left = Definition {
                datatype: DataType::Int64,
                unit: "s".to_string(),
                pace: Pace::Figure,
                ..text("Hold/Left")
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

    /// Whether the drive is there, and its metrics, in the order of their definitions.
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
            // What is no longer good is so now.
            let at = sample.at.filter(|_| sample.quality == Quality::Good);
            (sample.good(), sample.quality, moment.millis_at(at))
        };
        match source {
            Source::Point(index) => {
                let (value, quality, time) = of(index);
                Sample {
                    value: value.map(Datum::from),
                    quality,
                    time,
                }
            }
            Source::TextOf(index) => {
                let (value, quality, time) = of(index);
                let point = reading.spec.profile.points.get(index);
                let text = value.map(|value| point.and_then(|p| p.text_of(value)).unwrap_or_default());
                Sample {
                    value: text.map(|text| Datum::Text(text.to_string())),
                    quality,
                    time,
                }
            }
            Source::State => {
                let state = reading.state();
                let fast_at = reading.snapshot.fast_at.filter(|_| !reading.is_stale());
                Sample {
                    value: state.map(|state: State| Datum::Text(state.name().to_string())),
                    quality: if state.is_some() {
                        Quality::Good
                    } else {
                        reading.overall()
                    },
                    time: moment.millis_at(fast_at),
                }
            }
            Source::FaultText => {
                let code = reading.model(ModelPoint::FaultCode);
                let good = code.good().is_some();
                Sample {
                    value: good.then(|| Datum::Text(reading.fault_text())),
                    quality: code.quality,
                    time: moment.millis_at(code.at.filter(|_| good)),
                }
            }
            Source::HoldState | Source::Holder | Source::HoldRank | Source::HoldLeft => {
                let view = self.drive.hold_view(None, moment.now).map(|(view, _)| view);
                let value = view.map(|view| match source {
                    Source::HoldState => Datum::Text(view.state.name().to_string()),
                    Source::Holder => Datum::Text(view.holder.unwrap_or_default().to_string()),
                    Source::HoldRank => Datum::Text(view.rank.unwrap_or_default().to_string()),
                    _ => Datum::Integer(view.left_s.and_then(|left| i64::try_from(left).ok()).unwrap_or(-1)),
                });
                Sample {
                    quality: if value.is_some() { Quality::Good } else { Quality::Bad },
                    value,
                    time: millis(moment.wall),
                }
            }
            Source::CommandResult | Source::CommandError => {
                let (code, error) = self.result.as_ref().map_or(("", ""), |(c, e)| (c.as_str(), e.as_str()));
                let text = if source == Source::CommandResult { code } else { error };
                moment.known(Datum::Text(text.to_string()))
            }
        }
    }
}

fn text(name: &str) -> Definition {
    Definition {
        name: name.to_string(),
        datatype: DataType::String,
        unit: String::new(),
        low: None,
        high: None,
        pace: Pace::Normal,
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

/// The metrics of the node: `Bus/{bus}/…`, as in the health object of the bus.
pub(super) fn node_definitions(plant: &Plant) -> Vec<Definition> {
    use Pace::{Figure, Normal};
    let of_bus = |bus: &BusHandle| {
        let of = |leaf: &str, datatype, unit: &str, pace| Definition {
            name: format!("Bus/{}/{leaf}", bus.image.spec.name),
            datatype,
            unit: unit.to_string(),
            low: None,
            high: None,
            pace,
        };
        [
            of("state", DataType::String, "", Normal),
            of("reason", DataType::String, "", Normal),
            of("drives", DataType::Int64, "", Normal),
            of("online", DataType::Int64, "", Normal),
            of("load", DataType::Double, "", Figure),
            of("fast_cycle_ms", DataType::Double, "ms", Figure),
            of("slow_cycle_ms", DataType::Double, "ms", Figure),
            of("transactions", DataType::Int64, "", Figure),
            of("errors", DataType::Int64, "", Figure),
            of("queue", DataType::Int64, "", Figure),
        ]
    };
    plant.buses.iter().flat_map(of_bus).collect()
}

/// Their values, in the same order.
pub(super) fn node_samples(plant: &Plant, moment: Moment) -> Vec<Sample> {
    let of_bus = |bus: &BusHandle| {
        let (state, figures) = payload::bus_now(bus);
        let count = |count: u64| moment.known(Datum::Integer(i64::try_from(count).unwrap_or(i64::MAX)));
        let figure = |figure: Option<f64>| match figure {
            Some(figure) => moment.known(Datum::Number(figure)),
            None => Sample {
                value: None,
                quality: Quality::Bad,
                time: millis(moment.wall),
            },
        };
        let word = if state.up { "up" } else { "down" };
        [
            moment.known(Datum::Text(word.to_string())),
            moment.known(Datum::Text(state.reason.unwrap_or_default())),
            count(state.drives as u64),
            count(state.online as u64),
            figure(figures.load),
            figure(figures.fast_cycle_ms),
            figure(figures.slow_cycle_ms),
            count(figures.transactions),
            count(figures.errors),
            count(figures.queue as u64),
        ]
    };
    plant.buses.iter().flat_map(of_bus).collect()
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

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
        let (definitions, samples) = (node_definitions(&plant), node_samples(&plant, moment));
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
