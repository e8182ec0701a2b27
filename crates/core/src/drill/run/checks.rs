//! What each step of a drill waits for, and what comes next.

use std::time::{Instant, SystemTime};

use super::{
    AT_SPEED, CUT_OFF_TEXT, Cause, LAST_STOP, READ, Run, SPEED_UP, START_AGAIN, STEADY, Step, UNTOLD_SPEED, text_of,
};
use crate::drill::{DrillState, Kind};
use crate::order::{Authority, Order, Outcome, Refusal};
use crate::plant::{OrderRequest, Placed, Plant};
use crate::process_image::{Reading, Standstill};
use crate::stop_all::OneStop;
use drivegate_model::drive::{ModelPoint, Value};

impl Run {
    pub(super) fn check_start(&mut self, mut placed: Placed, now: Instant) {
        match placed.answer() {
            None => self.step = Step::Starting(placed),
            Some(answer) if answer.outcome.is_ok() => {
                self.report.text = "waiting until the motor turns".to_string();
                self.go(Step::SpeedingUp(None), now);
            }
            // A value that the order needs was not read yet.
            Some(answer)
                if matches!(answer.outcome, Outcome::Refused(Refusal::NotKnown(_)))
                    && now.saturating_duration_since(self.began) < START_AGAIN =>
            {
                self.go(Step::Waiting, now);
            }
            Some(answer) => {
                let why = format!("the motor was not started: {}", answer.outcome);
                self.end(DrillState::NotProven, why, now);
            }
        }
    }

    pub(super) fn check_speed(&mut self, turned: Option<Instant>, reading: &Reading<'_>, now: Instant) {
        // A lease needs a client that sends heartbeats; the drill sends them until it goes silent on purpose.
        self.drive.heartbeat(&self.own, now);
        let turns = matches!(reading.standstill(None), Standstill::Turns(_));
        let turned = if turns { turned.or(Some(now)) } else { None };
        let told = reading
            .model(ModelPoint::ActualSpeed)
            .good()
            .map(|speed| speed.as_f64().abs());
        let at_speed = match (turned, told) {
            (None, _) => false,
            (Some(_), Some(speed)) => speed >= AT_SPEED * self.report.speed,
            (Some(since), None) => now.saturating_duration_since(since) >= UNTOLD_SPEED,
        };
        if at_speed {
            self.report.text = format!("the motor turns at {} %", self.report.speed);
            return self.go(Step::Steady, now);
        }
        if now.saturating_duration_since(self.since) > SPEED_UP {
            let seconds = SPEED_UP.as_secs();
            let why = match (turned, told) {
                (Some(_), Some(speed)) => {
                    format!("the motor reached only {speed:.1} % within {seconds} s of its start")
                }
                _ => format!("the motor did not start to turn within {seconds} s"),
            };
            return self.end(DrillState::NotProven, why, now);
        }
        self.step = Step::SpeedingUp(turned);
    }

    pub(super) fn check_steady(&mut self, reading: &Reading<'_>, now: Instant, time: SystemTime) {
        self.drive.heartbeat(&self.own, now);
        let passed = now.saturating_duration_since(self.since);
        // A motor that stopped before the drill caused the stop proves nothing about that cause.
        let turns = match reading.standstill(Some(self.since)) {
            Standstill::Turns(_) => true,
            Standstill::Stands => {
                let why = "the motor stopped before it was to be stopped".to_string();
                return self.end(DrillState::NotProven, why, now);
            }
            Standstill::Unknown(why) if passed > STEADY + READ => {
                return self.end(
                    DrillState::NotProven,
                    format!("the motor was not read while it ran: {why}"),
                    now,
                );
            }
            Standstill::Unknown(_) => false,
        };
        if passed < STEADY || !turns {
            self.step = Step::Steady;
            return;
        }
        let Some(step) = self.report.steps.get_mut(self.at) else {
            return self.end(DrillState::Passed, "passed".to_string(), now);
        };
        step.cause_at = Some(text_of(time));
        let cause = match step.kind {
            Kind::Order => {
                let run = self.drive.image.spec.profile.model_index(ModelPoint::Run);
                let order = Order::Points(run.map(|run| (run, Value::Bool(false))).into_iter().collect());
                let request = OrderRequest::new(order, self.own.clone(), Authority::Write);
                let placed = self.drive.place(request.within(self.options.limit).at_once(), now);
                self.report.text = "a stop command was sent".to_string();
                Cause::Order(placed)
            }
            Kind::Client => {
                self.report.text = "the client is silent".to_string();
                Cause::Client { stopped: false }
            }
            Kind::Gateway => {
                let until = now + self.options.limit;
                self.lock(Some(until));
                self.report.text = format!(
                    "nothing is sent to the drive for {} s",
                    self.options.limit.as_secs_f64()
                );
                Cause::Gateway(until)
            }
        };
        self.stops = self.drive.stops();
        self.paused = None;
        self.go(Step::Caused(now, cause), now);
    }

    /// Stops the motor and waits for standstill before the next way to stop is tested.
    pub(super) fn check_cleared(&mut self, mut stop: OneStop, plant: &Plant, now: Instant) {
        stop.advance(plant, now);
        self.stops = self.drive.stops();
        if stop.is_acknowledged() && stop.motor_stands(plant, now) {
            self.at += 1;
            return self.begin_step(now);
        }
        if now.saturating_duration_since(self.since) > LAST_STOP {
            let why = "the stop before the next way was not acknowledged, or the motor did not come to standstill"
                .to_string();
            self.at += 1;
            return self.end(DrillState::NotProven, why, now);
        }
        self.step = Step::Clearing(stop);
    }

    /// Stops the motor once the drive is online; a stop to one that is not would fail.
    pub(super) fn check_cut_off(&mut self, plant: &Plant, now: Instant) {
        if let Some(drive) = plant.drive_at(&self.machine) {
            self.drive = drive;
        }
        let waited = now.saturating_duration_since(self.since);
        if waited <= LAST_STOP && !self.drive.reading(now).snapshot.link.is_online() {
            self.step = Step::CutOff;
            return;
        }
        self.end(DrillState::Aborted, CUT_OFF_TEXT.to_string(), now);
    }

    pub(super) fn check_end(
        &mut self,
        state: DrillState,
        mut stop: OneStop,
        plant: &Plant,
        (now, time): (Instant, SystemTime),
    ) {
        stop.advance(plant, now);
        let over = stop.is_acknowledged() || stop.is_refused();
        if !over && now.saturating_duration_since(self.since) <= LAST_STOP {
            self.step = Step::Ending(state, stop);
            return;
        }
        self.report.last_stop = Some(if stop.is_acknowledged() {
            "acknowledged".to_string()
        } else {
            stop.why_not()
        });
        let text = std::mem::take(&mut self.report.text);
        self.finish(state, text, time);
    }
}
