//! Speeds that a newer sample contradicts. Points are read at different times, so a speed from before the motor
//! stopped can still be good for as long as its poll class allows. Pure.

use std::time::Instant;

use super::Reading;
use drivegate_model::drive::{ModelPoint, PointIndex, Value};

/// The speed points, each with the value in its unit (%, Hz, rpm) above which the motor certainly turns.
const SPEEDS: [(ModelPoint, f64); 3] = [
    (ModelPoint::ActualSpeed, 0.5),
    (ModelPoint::OutputFrequency, 0.5),
    (ModelPoint::MotorSpeed, 10.0),
];

impl Reading<'_> {
    /// Whether the point is a good speed that is not zero although a newer sample shows that the motor is at standstill, or
    /// zero although a newer one shows that it turns. Other points are not checked: current, torque and power can
    /// have any value at any speed.
    pub fn is_contradicted(&self, point: PointIndex) -> bool {
        let model = self.spec.profile.points.get(point).and_then(|point| point.model);
        let Some((_, certain)) = SPEEDS.iter().find(|(speed, _)| Some(*speed) == model) else {
            return false;
        };
        let sample = self.sample(point);
        let (Some(value), Some(at)) = (sample.good(), sample.at) else {
            return false;
        };
        let newest = self
            .motion()
            .filter(|(seen, _)| *seen > at)
            .max_by_key(|(seen, _)| *seen);
        match (newest, speed_of(value, *certain)) {
            (Some((_, turns)), Some(turned)) => turns != turned,
            // At such a low speed the motor may turn or stand.
            (Some((_, turns)), None) => !turns,
            (None, _) => false,
        }
    }

    /// Whether the motor turns according to each good sample, with the time of the sample.
    fn motion(&self) -> impl Iterator<Item = (Instant, bool)> + '_ {
        let bits = [(ModelPoint::Running, false), (ModelPoint::ZeroSpeed, true)];
        // A running drive may be at zero speed, and a motor that is not at zero speed may be close to it.
        let stands = bits.into_iter().filter_map(|(bit, standing)| {
            let sample = self.model(bit);
            let says = sample.good()?.as_bool() == standing;
            sample.at.filter(|_| says).map(|at| (at, false))
        });
        let speeds = SPEEDS.into_iter().filter_map(|(speed, certain)| {
            let sample = self.model(speed);
            Some((sample.at?, speed_of(sample.good()?, certain)?))
        });
        stands.chain(speeds)
    }
}

/// Whether a motor of this speed turns; `None` if the speed is too low to decide.
fn speed_of(value: Value, certain: f64) -> Option<bool> {
    let speed = value.as_f64().abs();
    if speed == 0.0 {
        Some(false)
    } else {
        (speed > certain).then_some(true)
    }
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, SystemTime};

    use super::*;
    use crate::process_image::Link;
    use crate::testkit;
    use drivegate_proto::Table;

    /// A CX that runs or not, with an output frequency read now and a motor speed read `age` before, 1 rpm and 0.01 Hz.
    fn contradicted(running: u16, hertz: u16, rpm: u16, age: Duration) -> bool {
        let profile = testkit::profile("vacon-cx");
        let image = testkit::image(testkit::monitored("d", "b", 1, &profile));
        let now = Instant::now() + age;
        image.update(|s| {
            s.link = Link::Online(SystemTime::now());
            s.fast_at = Some(now);
            s.store(Table::Input, 1, &[rpm], now - age);
            s.store(Table::DiscreteInput, 2, &[running], now);
            s.store(Table::Input, 0, &[hertz], now);
        });
        let speed = profile.model_index(ModelPoint::MotorSpeed).unwrap();
        image.reading(now, Duration::from_secs(1)).is_contradicted(speed)
    }

    #[test]
    fn an_older_speed_gives_way_to_a_newer_state() {
        let (before, same) = (Duration::from_millis(800), Duration::ZERO);
        assert!(contradicted(0, 0, 1290, before), "0 Hz beside 1290 rpm");
        assert!(!contradicted(0, 0, 1290, same), "of one poll: the motor coasts");
        assert!(!contradicted(1, 2500, 1290, before));
        assert!(contradicted(1, 2500, 0, before), "it has started since");
        assert!(!contradicted(0, 0, 0, before));
        assert!(!contradicted(1, 20, 0, before), "0.2 Hz may be none yet");
        assert!(!contradicted(0, 0, 1290, Duration::from_secs(20)), "stale says enough");
    }
}
