//! A drive and orders to it, for the tables of the rules: each table shows what one rule alone decides.

use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::order::{Effect, Effects, Intent, Order, Origin, ParameterOrder, Touched, Urgency};
use crate::permit::gate::{DriveGate, Gate};
use crate::permit::judge::{Ask, DriveFacts, Rule, Stage, Verdict};
use crate::permit::reference_limits::LastWritten;
use crate::process_image::{DriveImage, DriveSpec};
use crate::testkit::{controlled, image, nx, read, window};
use drivegate_model::drive::parameters::RawValue;
use drivegate_model::drive::{DriveIndex, ModelPoint, Value};
use drivegate_proto::{RequestPdu, Table};

pub(super) const SECOND: Duration = Duration::from_secs(1);
pub(super) const DRIVE: DriveIndex = DriveIndex::new(0);
/// Process data of a Vacon NX whose motor is at standstill.
pub(super) const STANDS: &[u16] = &[0x41, 0, 0, 0];
/// Process data of a Vacon NX whose motor runs at 25 Hz.
pub(super) const RUNS: &[u16] = &[0x03, 0, 0, 2500];

/// A Vacon NX with state that a rule judges.
pub(super) struct Trial {
    pub(super) gate: Gate,
    pub(super) drive: DriveGate,
    pub(super) image: Arc<DriveImage>,
    /// Time at which the drive was read, and an order arrives and is judged.
    pub(super) now: Instant,
    /// Last writes of reference and frequency range.
    pub(super) written: LastWritten,
}

impl Trial {
    /// A drive that no rule keeps from orders; its motor is at standstill.
    pub(super) fn new() -> Trial {
        Trial::of(controlled("d1", "b", 1, &nx()))
    }

    pub(super) fn of(spec: DriveSpec) -> Trial {
        let (image, now) = (image(spec), Instant::now() + 100 * SECOND);
        read(&image, 2100, STANDS, now);
        Trial {
            gate: Gate::default(),
            drive: DriveGate::default(),
            image,
            now,
            written: LastWritten::default(),
        }
    }

    /// An order to the drive: a start, a reference, a reset, a reverse, a stop, a read, or a parameter of a restore.
    pub(super) fn intent(&self, what: &str) -> Intent {
        let profile = &self.image.spec.profile;
        let point = |point: ModelPoint, value: Value| Order::Points(vec![(profile.model_index(point).unwrap(), value)]);
        let order = match what {
            "start" => point(ModelPoint::Run, Value::Bool(true)),
            "stop" => point(ModelPoint::Run, Value::Bool(false)),
            "reverse" => point(ModelPoint::Reverse, Value::Bool(true)),
            "reset" => point(ModelPoint::FaultReset, Value::Bool(true)),
            "reference" => point(ModelPoint::SpeedReference, Value::Number(20.0)),
            "read" => Order::Read(RequestPdu::Read {
                table: Table::Holding,
                start: 2100,
                count: 1,
            }),
            "parameter" => Order::Parameter(ParameterOrder {
                id: "P1".to_string(),
                address: 100,
                from: None,
                to: RawValue::Word(1),
            }),
            other => panic!("no order {other}"),
        };
        let urgency = match what {
            "stop" => Urgency::Stop,
            "read" => Urgency::Read,
            _ => Urgency::Command,
        };
        let effect = Effect::of_command(&order, urgency, profile);
        let effects = Effects::on_one(DRIVE, effect, Touched::of(&order, &[], profile));
        Intent::new(DRIVE, order, effects, window(self.now, 2 * SECOND))
    }

    /// What the rule says of that order of a client when it is accepted, at its turn, and before each write.
    pub(super) fn verdicts(&self, rule: &Rule, what: &str, origin: &Origin) -> String {
        self.verdicts_on(rule, &self.intent(what), origin)
    }

    /// As [`Trial::verdicts`]; "-" at the moments at which the rule is not asked about the order.
    pub(super) fn verdicts_on(&self, rule: &Rule, intent: &Intent, origin: &Origin) -> String {
        let stages = [Stage::Accept, Stage::Turn, Stage::Write];
        let said = stages.map(|stage| {
            let binds = rule.binds_stops || !intent.effects.on(DRIVE).stops;
            if !binds || !rule.stages.contains(&stage) {
                return "-".to_string();
            }
            let seen = DriveFacts {
                reading: self.image.reading(self.now, 10 * SECOND),
                written: (stage != Stage::Accept).then_some(self.written),
                run: None,
                repeats: None,
            };
            let ask = Ask {
                stage,
                now: self.now,
                drive: DRIVE,
                intent,
                origin,
                seen: Some(&seen),
            };
            match (rule.judge)(&ask, &self.drive, &self.gate) {
                Verdict::Go => "go".to_string(),
                Verdict::Wait(until) => format!("wait {}", until.duration_since(self.now).as_millis()),
                Verdict::LookFirst => "look".to_string(),
                Verdict::Refuse(outcome) => outcome.code().to_string(),
            }
        });
        said.join(" ")
    }
}
