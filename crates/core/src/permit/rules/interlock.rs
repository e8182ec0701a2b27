//! Whether the interlock points of a start are read, good and have the required values; also for a reference that
//! would turn a motor whose run command is on.

use crate::order::Refusal;
use crate::permit::gate::{DriveGate, Gate};
use crate::permit::judge::{Ask, Rule, Stage, Verdict};
use crate::process_image::Reading;
use crate::start_guard::ByRun;
use drivegate_model::drive::{ModelPoint, Value};

/// Output frequency in Hz below which a motor with its run command on counts as standing or in sleep mode.
const TURNS: f64 = 0.5;

pub(in crate::permit) const RULE: Rule = Rule {
    stages: &[Stage::Accept, Stage::Turn, Stage::Write],
    binds_stops: false,
    judge,
};

fn judge(ask: &Ask<'_>, _: &DriveGate, gate: &Gate) -> Verdict {
    let Some(starts) = &gate.starts else { return Verdict::Go };
    let effect = ask.effect();
    let begins = effect.starts() && starts.by_run(ask.drive) != ByRun::Runs;
    let wakes = || effect.reference && ask.seen.is_some_and(|seen| waits_for_a_reference(&seen.reading));
    if !begins && !wakes() {
        return Verdict::Go;
    }
    let unmet = starts.interlocked(ask.drive, ask.now);
    Verdict::unless(unmet.map(|unmet| Refusal::Interlocked(unmet.why)))
}

/// Whether the run command of the drive is on and the motor is at standstill: a reference can then make it turn.
fn waits_for_a_reference(reading: &Reading<'_>) -> bool {
    let stands = || match reading.model(ModelPoint::OutputFrequency).good().map(Value::as_f64) {
        Some(hertz) => hertz.abs() < TURNS,
        None => !reading.is_set(ModelPoint::Running),
    };
    reading.is_set(ModelPoint::Run) && stands()
}
