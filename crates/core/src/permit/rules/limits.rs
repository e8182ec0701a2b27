//! Whether the values of an order still keep the limits, and whether the readings behind those limits are still valid.
//!
//! At the stage "accept" the limits are checked while the order is converted ([`crate::permit::admit`]), since its
//! values come from the range on which they depend. At the stage "write" nothing can have changed: between the
//! first and the last frame of an order no other order to the drive is sent.

use crate::order::{FrequencyRange, Refusal};
use crate::permit::gate::{DriveGate, Gate};
use crate::permit::judge::{Ask, Rule, Stage, Verdict};
use crate::permit::reference_limits::still_keeps_limits;

pub(in crate::permit) const RULE: Rule = Rule {
    stages: &[Stage::Turn],
    binds_stops: false,
    judge,
};

fn judge(ask: &Ask<'_>, _: &DriveGate, _: &Gate) -> Verdict {
    let Some((seen, written)) = ask.seen.and_then(|seen| Some((seen, seen.written?))) else {
        return Verdict::Go;
    };
    let holds = |range: &FrequencyRange| range.holds(&seen.reading, written.range);
    if !ask.intent.ranges.iter().all(holds) {
        return Verdict::refuse(Refusal::NotKnown(
            "the drive's frequency range was written, or changed, since the command was accepted; nothing was written; \
             send it again"
                .to_string(),
        ));
    }
    let kept = still_keeps_limits(&seen.reading, &ask.intent.order, written);
    Verdict::unless(kept.err())
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::time::Duration;

    use super::*;
    use crate::order::{Authority, Effect, Effects, Intent, Order, Origin, SourceKind, Touched};
    use crate::permit::admit;
    use crate::permit::rules::tests::{DRIVE, SECOND, Trial};
    use crate::process_image::Link;
    use crate::testkit::{controlled, profile, window};
    use drivegate_model::drive::Value;
    use drivegate_proto::Table;

    /// Reads the reference in percent and the ends of the frequency range in Hz of a Vacon NX on N2.
    fn read(trial: &Trial, percent: f32, maximum: f32) {
        let floats = [percent, 50.0, 0.0, maximum].map(f32::to_bits);
        let words: Vec<u16> = floats
            .iter()
            .flat_map(|bits| [(bits >> 16) as u16, *bits as u16])
            .collect();
        trial.image.update(|snapshot| {
            snapshot.link = Link::Online(std::time::SystemTime::now());
            snapshot.store(Table::Holding, 0, &words, trial.now);
        });
    }

    /// The order as it was accepted, with what its values rest on.
    fn accepted(trial: &Trial, point: &str, value: f64) -> Intent {
        let spec = &trial.image.spec;
        let order = Order::Points(vec![(spec.profile.point_index(point).unwrap(), Value::Number(value))]);
        let reading = trial.image.reading(trial.now, 10 * SECOND);
        let admitted = admit(order, &reading, Authority::Write).unwrap();
        let effect = Effect::of_command(&admitted.order, admitted.urgency, &spec.profile);
        let effects = Effects::on_one(DRIVE, effect, Touched::Anything);
        Intent {
            ranges: admitted.ranges,
            ..Intent::new(DRIVE, admitted.order, effects, window(trial.now, 2 * SECOND))
        }
    }

    #[test]
    fn at_its_turn_an_order_still_keeps_its_limits_and_what_they_rest_on() {
        let unlimited = f64::INFINITY;
        // The limit of `frequency_reference` in Hz, the order, what happened while it waited, and what becomes of it at its turn.
        let table = [
            (40.0, ("frequency_reference", 30.0), "nothing", "- go -"),
            (40.0, ("frequency_reference", 30.0), "read again", "- go -"),
            (40.0, ("frequency_reference", 30.0), "range written", "- not_writable -"),
            (40.0, ("frequency_reference", 30.0), "range changed", "- not_writable -"),
            (40.0, ("speed_reference", 60.0), "nothing", "- go -"),
            (40.0, ("speed_reference", 60.0), "range changed", "- not_writable -"),
            (unlimited, ("speed_reference", 60.0), "range changed", "- go -"),
            (
                unlimited,
                ("frequency_reference", 30.0),
                "range changed",
                "- not_writable -",
            ),
            (40.0, ("maximum_frequency", 80.0), "nothing", "- go -"),
            (
                40.0,
                ("maximum_frequency", 80.0),
                "reference written",
                "- not_writable -",
            ),
            (40.0, ("maximum_frequency", 80.0), "reference raised", "- bad_value -"),
            (unlimited, ("maximum_frequency", 80.0), "reference raised", "- go -"),
        ];
        let client = Origin::new(SourceKind::Http, "alice");
        for (limit, (point, value), meanwhile, expected) in table {
            let mut spec = controlled("d1", "b", 1, &profile("vacon-nx-n2"));
            if limit < unlimited {
                spec.limits = BTreeMap::from([("frequency_reference".to_string(), 0.0..=limit)]);
            }
            let mut trial = Trial::of(spec);
            read(&trial, 40.0, 50.0);
            let intent = accepted(&trial, point, value);
            let written = trial.now + Duration::from_millis(5);
            trial.now += Duration::from_millis(10);
            match meanwhile {
                "read again" => read(&trial, 40.0, 50.0),
                "range written" => trial.written.range = Some(written),
                "range changed" => read(&trial, 40.0, 60.0),
                "reference written" => trial.written.reference = Some(written),
                "reference raised" => read(&trial, 70.0, 50.0),
                _ => {}
            }
            let verdicts = trial.verdicts_on(&RULE, &intent, &client);
            assert_eq!(verdicts, expected, "limit {limit} Hz: {point} = {value}, {meanwhile}");
        }
    }

    #[test]
    fn no_limit_binds_a_stop_or_a_read() {
        let (trial, client) = (Trial::new(), Origin::new(SourceKind::Http, "alice"));
        for (order, expected) in [("stop", "- - -"), ("read", "- go -"), ("start", "- go -")] {
            assert_eq!(trial.verdicts(&RULE, order, &client), expected, "{order}");
        }
    }
}
