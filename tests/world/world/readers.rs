//! Readers over HTTP: the JSON of a drive and the metrics show a point as good, or its figure, only if it is fresh
//! and the drive is online.

use std::time::SystemTime;

use drivegate_core::plant::DriveHandle;
use drivegate_model::drive::{Point, PointIndex, PollClass, Profile, Source};
use drivegate_north::NorthState;
use drivegate_north::metrics::{self, Format};
use serde_json::Value as Json;

use super::*;

/// Checks between two readings by HTTP, and readings between two of the metrics.
const EVERY: (usize, usize) = (8, 8);

impl World {
    /// Reads one drive after the other over HTTP.
    pub(super) fn read_by_http(&mut self) {
        self.readings += 1;
        if !self.readings.is_multiple_of(EVERY.0) {
            return;
        }
        let (plant, reading) = (self.plant.load_full(), self.readings / EVERY.0);
        let count = plant.drives().count();
        let drive = plant.drives().nth(reading % count).unwrap();
        let wall = SystemTime::UNIX_EPOCH + (self.now - self.began);
        let json = drivegate_http::drive_json(&drive, &Default::default(), self.now, wall).unwrap();
        check_json(&drive, &plant, &json, self.now);
        if reading.is_multiple_of(EVERY.1) {
            let text = metrics::encode(&plant, &NorthState::default(), self.now, Format::Prometheus).unwrap();
            check_metrics(&drive, &json, &text);
        }
    }
}

fn name_of(point: &Point) -> &str {
    point.model.map_or(&point.name, |model| model.name())
}

fn is_good(json: &Json, profile: &Profile, index: PointIndex) -> bool {
    json["points"][name_of(profile.points.get(index).unwrap())]["quality"] == "good"
}

fn check_json(drive: &DriveHandle, plant: &Plant, json: &Json, now: Instant) {
    let spec = &drive.image.spec;
    let (name, profile) = (&spec.name, &spec.profile);
    let slow = plant.stale_after + 2 * drive.bus.image.spec.slow_cycle;
    let points = &json["points"];
    let monitored = drive.image.snapshot().monitored.clone();
    for (index, point) in profile.points.enumerate() {
        let own = name_of(point);
        let reported = &points[own];
        if reported["quality"] != "good" {
            continue;
        }
        assert!(
            !reported["value"].is_null(),
            "{name}: `{own}` is good, and has no value"
        );
        match &point.source {
            Source::Raw(_) => {
                let most = match point.class {
                    // The value is taken from its monitoring register until comparisons agree.
                    PollClass::Fast if monitored.contains(&index) => slow,
                    PollClass::Fast => plant.stale_after,
                    PollClass::Slow => slow,
                    PollClass::Once | PollClass::Fault | PollClass::Monitor | PollClass::Never => Duration::MAX,
                };
                let age = Duration::from_millis(reported["age_ms"].as_u64().unwrap());
                assert!(json["online"] == true, "{name}: `{own}` is good, and the drive is away");
                assert!(age <= most, "{name}: `{own}` is good, and {age:?} old");
            }
            Source::Derived(derived) if derived.band().is_none() => {
                let reading = drive.reading(now);
                let known = derived
                    .sources()
                    .into_iter()
                    .all(|of| reading.sample(of).quality == Quality::Good);
                assert!(known, "{name}: `{own}` is good, and not all that it rests on is");
            }
            Source::Derived(_) => {}
        }
    }
    for point in [ModelPoint::Running, ModelPoint::Ready] {
        let known = profile
            .model_index(point)
            .is_none_or(|index| is_good(json, profile, index));
        assert!(
            known || json["state"] != point.name(),
            "{name}: {} is not known, and the state",
            point.name()
        );
    }
    assert!(
        json["quality"] != "good" || !json["state"].is_null(),
        "{name}: all is good but the state"
    );
}

/// A point that is not good has no sample.
fn check_metrics(drive: &DriveHandle, json: &Json, text: &str) {
    let (name, profile) = (&drive.image.spec.name, &drive.image.spec.profile);
    let of_drive = format!("drive=\"{name}\"");
    let samples = text.lines().filter(|line| line.starts_with("drivegate_point_value{"));
    let samples: Vec<&str> = samples.filter(|line| line.contains(&of_drive)).collect();
    for (index, point) in profile.points.enumerate() {
        let label = format!("point=\"{}\"", point.name);
        let sample = samples.iter().any(|line| line.contains(&label));
        assert!(
            !sample || is_good(json, profile, index),
            "{name}: `{}` is not good, and has a sample",
            point.name
        );
    }
}
