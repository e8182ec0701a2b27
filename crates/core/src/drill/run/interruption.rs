//! Events that end a drill early: another client, the machine, a reload.

use std::sync::Arc;
use std::time::Instant;

use tokio::sync::broadcast::error::TryRecvError;

use super::{Cause, Run, Step, named};
use crate::drill::Kind;
use crate::order::{AuditRecord, Origin, SourceKind};
use crate::plant::Plant;
use crate::process_image::Reading;
use drivegate_model::drive::ModelPoint;

/// Speed above `max_speed` that ends a drill, %.
const TOO_FAST: f64 = 5.0;

/// The reason when a drive is switched to local control.
pub(super) const LOCAL: &str = "the drive was switched to local control";

pub(super) fn is_local(reading: &Reading<'_>) -> bool {
    let remote = reading.model(ModelPoint::Remote);
    remote.good().is_some_and(|remote| !remote.as_bool())
}

impl Run {
    /// The reason to end the drill early, if there is one.
    pub(super) fn interruption(&mut self, plant: &Plant, now: Instant) -> Option<String> {
        let there = plant.drive_at(&self.machine);
        if !there.is_some_and(|there| Arc::ptr_eq(&there.image, &self.drive.image)) {
            return Some("a reload changed the drive or its bus".to_string());
        }
        if !self.who.right().allows(&self.report.bus) {
            return Some("a reload removed the right of its client to write".to_string());
        }
        if let Some(why) = self.others() {
            return Some(why);
        }
        let silent = matches!(self.step, Step::Caused(_, Cause::Gateway(_)));
        let reading = self.drive.reading(now);
        if silent {
            return None;
        }
        if !reading.snapshot.link.is_online() {
            return Some("the drive went offline".to_string());
        }
        // While a drill cuts off the gateway, the drive's fieldbus supervision may stop the motor with a fault.
        let may_have_fault = matches!(self.step, Step::Clearing(_)) && self.kind() == Some(Kind::Gateway);
        if reading.is_set(ModelPoint::Fault) && !may_have_fault {
            return Some("the drive has a fault".to_string());
        }
        if is_local(&reading) {
            return Some(LOCAL.to_string());
        }
        let speed = reading
            .model(ModelPoint::ActualSpeed)
            .good()
            .map(|speed| speed.as_f64().abs());
        speed
            .filter(|speed| *speed > self.options.max_speed + TOO_FAST)
            .map(|speed| format!("the motor turns at {speed:.1} %, more than max_speed of [drill]"))
    }

    /// Checks whether another client gave the drive an order, and who.
    fn others(&mut self) -> Option<String> {
        let stops = self.drive.stops();
        if stops != self.stops {
            self.stops = stops;
            let by = self.drive.last_stop_by();
            let expected = match &mut self.step {
                Step::Caused(_, Cause::Client { stopped }) if by.as_ref().is_some_and(Origin::is_lease) => {
                    *stopped = true;
                    true
                }
                _ => false,
            };
            let own = by
                .as_ref()
                .is_some_and(|by| by.client() == self.own.client() && by.who == self.own.who);
            if !expected && !own {
                let by = by.map_or_else(|| "another client".to_string(), |by| named(&by));
                return Some(format!("{by} stopped the drive"));
            }
        }
        loop {
            match self.records.as_mut()?.try_recv() {
                Ok(record) if record.drive != self.report.drive => {}
                Ok(record) if record.client == self.own.who => {}
                Ok(record) if record.source == SourceKind::Supervision.name() => {}
                Ok(record) => {
                    let AuditRecord {
                        source,
                        client,
                        command,
                        ..
                    } = &*record;
                    return Some(format!("{source} {client} sent a command: {command}"));
                }
                Err(TryRecvError::Empty | TryRecvError::Closed) => return None,
                Err(TryRecvError::Lagged(_)) => {
                    return Some("too many commands arrived to tell who sent them".to_string());
                }
            }
        }
    }
}
