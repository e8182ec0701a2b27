//! Metrics of the drives, but those of the common drive model.

use std::time::{Instant, SystemTime};

use super::model::{self, MODEL};
use super::series::{Labels, Row, SeriesValue, rows};
use crate::NorthState;
use drivegate_core::drill::Proof;
use drivegate_core::history::counters::Totals;
use drivegate_core::permit::{HoldState, HoldView};
use drivegate_core::plant::DriveHandle;
use drivegate_core::process_image::{DriveImage, Outcome, Reading, public_points};
use drivegate_core::start_guard::Reason;
use drivegate_model::drive::{ModelPoint, PointIndex, State, Value};

/// A drive, read once for all families.
pub(super) struct DriveFigures<'a> {
    pub(super) labels: Labels,
    handle: &'a DriveHandle,
    image: &'a DriveImage,
    reading: Reading<'a>,
    /// Good numbers of the public points with their names, in their order.
    values: Vec<(PointIndex, &'a str, f64)>,
    /// The last proofs that the motor stops.
    proofs: Vec<Proof>,
    /// Who holds the drive, and how many commands came from others.
    hold: Option<(HoldView, u64)>,
    /// Counted starts and run time; absent if the drive does not report whether it runs.
    totals: Option<Totals>,
}

impl<'a> DriveFigures<'a> {
    pub(super) fn of(handle: &'a DriveHandle, north: &NorthState, now: Instant) -> DriveFigures<'a> {
        let image = &*handle.image;
        let (reading, profile) = (handle.reading(now), &image.spec.profile);
        let good = |index| {
            let value = reading.sample(index).good().and_then(Value::exact_f64);
            value.filter(|value| value.is_finite())
        };
        let points = public_points(profile).into_iter();
        let drills = north.drills.options().is_some();
        let hold = handle.hold_view(None, now);
        let unheld = || handle.bus.queue.lock().gate.unheld(handle.index);
        let counts_runs = profile.model_index(ModelPoint::Running).is_some();
        DriveFigures {
            labels: labels(image),
            values: points
                .filter_map(|(index, name)| Some((index, name, good(index)?)))
                .collect(),
            proofs: if drills {
                north.drills.proofs(&handle.machine())
            } else {
                Vec::new()
            },
            hold: hold.map(|(view, _)| (view, unheld())),
            totals: counts_runs.then(|| north.history.totals(&image.spec.name)),
            handle,
            image,
            reading,
        }
    }

    /// The good number of a point of the common model.
    pub(super) fn model(&self, point: ModelPoint) -> Option<f64> {
        let wanted = self.image.spec.profile.model_index(point)?;
        let found = self.values.iter().find(|(index, ..)| *index == wanted);
        found.map(|(.., value)| *value)
    }

    /// The good numbers of the points that have no family of their own: name, unit and number.
    fn others(&self) -> impl Iterator<Item = (&str, &str, f64)> {
        let points = &self.image.spec.profile.points;
        self.values.iter().filter_map(|(index, name, value)| {
            let point = points.get(*index)?;
            let has_own = point.model.is_some_and(|model| MODEL.contains(&model));
            (!has_own).then_some((*name, point.unit.as_str(), *value))
        })
    }
}

/// Labels of a drive.
pub(super) fn labels(image: &DriveImage) -> Labels {
    Labels::of([("bus", &image.spec.bus), ("drive", &image.spec.name)])
}

/// All families of drives, in the order of the output.
pub(super) fn families<'a>() -> Vec<Row<DriveFigures<'a>>> {
    let tables = [
        state_families(),
        model::families(),
        counted_families(),
        permit_families(),
    ];
    tables.into_iter().flatten().collect()
}

fn state_families<'a>() -> Vec<Row<DriveFigures<'a>>> {
    rows! { DriveFigures<'a>;
        Gauge "drivegate_drive_up" "Whether the drive replies: 1, else 0 (also before its first reply)."
            => |drive, series| series.add(drive.reading.snapshot.link.is_online());
        Gauge "drivegate_drive_state"
            "State of the drive: 1 for the state it is in, 0 for the others; absent while it is unknown."
            => |drive, series| if let Some(current) = drive.reading.state() {
                for one in State::ALL {
                    series.with("state", one.name(), one == current);
                }
            };
        Gauge "drivegate_drive_blocked" "Why the motor does not run: 1 for each cause; absent while it runs."
            => |drive, series| for cause in drive.handle.why(&drive.reading).names() {
                series.with("reason", cause, true);
            };
        Gauge "drivegate_drive_fault_info" "Text of the active fault: 1; absent without a fault."
            => |drive, series| {
                let text = drive.reading.fault_text();
                if drive.reading.is_set(ModelPoint::Fault) && !text.is_empty() {
                    series.with("text", text, true);
                }
            };
        Gauge "drivegate_drive_sample_age_seconds" "Age of the drive's process data; absent while it was never read."
            => |drive, series| series.add_some(drive.reading.age().map(|age| age.as_secs_f64()));
    }
}

fn counted_families<'a>() -> Vec<Row<DriveFigures<'a>>> {
    rows! { DriveFigures<'a>;
        Gauge "drivegate_point_value" "Points of a drive that have no metric of their own, in their unit; true is 1."
            => |drive, series| for (point, unit, value) in drive.others() {
                series.with_both(("point", point.to_string().into()), ("unit", unit.to_string().into()), value);
            };
        Counter "drivegate_drive_transactions_total" "Transactions with the drive by outcome."
            => |drive, series| for outcome in Outcome::ALL {
                series.with("outcome", outcome.name(), drive.image.counted(outcome));
            };
        Gauge "drivegate_drive_turnaround_seconds"
            "Time from the end of the last request to the start of the drive's reply."
            => |drive, series| series.add_some(drive.image.turnaround().map(|time| time.as_secs_f64()));
    }
}

fn permit_families<'a>() -> Vec<Row<DriveFigures<'a>>> {
    rows! { DriveFigures<'a>;
        Counter "drivegate_starts_refused_total" "Starts of a guarded drive that were refused, by reason."
            => |drive, series| {
                let guards = drive.handle.bus.queue.guards().filter(|guards| guards.guards(drive.handle.index));
                if let Some(counted) = guards.map(|guards| guards.refused(drive.handle.index)) {
                    for reason in Reason::ALL {
                        series.with("reason", reason.name(), counted.get(&reason).copied().unwrap_or_default());
                    }
                }
            };
        Counter "drivegate_supervision_actions_total"
            "Leases that expired while the drive ran or had its run command set."
            => |drive, series| series.add(drive.image.supervisions());
        Counter "drivegate_supervision_failed_total"
            "Failed attempts at the action of a lease, or at the stop at shutdown."
            => |drive, series| series.add(drive.image.supervision_failures());
        Gauge "drivegate_drive_unsupervised" "1 if a drive with supervision was found running after the start and is not yet commanded, else 0."
            => |drive, series| if drive.image.spec.supervision.is_some() {
                series.add(drive.image.is_unsupervised());
            };
        Counter "drivegate_refresh_writes_total"
            "Write requests by which what was ordered is written again for the drive's own timeout."
            => |drive, series| if drive.image.spec.refresh.is_some() {
                series.add(drive.image.refresh_writes());
            };
        Gauge "drivegate_drive_held" "1 for the rank of the client that holds the drive; no series while nobody does."
            => |drive, series| if let Some((view, _)) = &drive.hold
                && let (HoldState::Held, Some(rank)) = (view.state, &view.rank)
            {
                series.with("rank", rank.to_string(), true);
            };
        Counter "drivegate_orders_unheld_total"
            "Commands from clients that did not hold the drive, executed in advisory mode."
            => |drive, series| series.add_some(drive.hold.as_ref().map(|(_, unheld)| *unheld));
        Gauge "drivegate_drill_age_seconds"
            "Time since the last completed drill of that kind; no series before the first."
            => |drive, series| for proof in &drive.proofs {
                series.with("kind", proof.kind.name(), proof.age(SystemTime::now()).as_secs_f64());
            };
        Gauge "drivegate_drill_passed" "1 if the motor stopped in time in that drill."
            => |drive, series| for proof in &drive.proofs {
                series.with("kind", proof.kind.name(), proof.passed);
            };
        Counter "drivegate_drive_starts_total" "Observed starts of the motor; kept across restarts of the gateway."
            => |drive, series| series.add_some(drive.totals.map(|totals| totals.starts));
        Counter "drivegate_drive_running_seconds_total"
            "Observed run time of the motor; kept across restarts of the gateway."
            => |drive, series| series.add_some(drive.totals.map(|totals| SeriesValue::Total(totals.running_seconds)));
    }
}
