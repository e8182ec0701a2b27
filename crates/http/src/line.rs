//! `GET /api/v1/buses/{bus}`: a bus with the last hour of its line.

use std::sync::{Arc, PoisonError};
use std::time::SystemTime;

use axum::Json;
use axum::extract::{Path, State};
use axum::response::IntoResponse;
use serde::Serialize;

use super::api::{self, fine_millis, rounded};
use super::app_state::AppState;
use super::replies::{Replied, find_bus};
use drivegate_core::history::Clock;
use drivegate_core::history::line::{Exchanges, Figures, LastHour, LineHistory, STEP};
use drivegate_core::plant::BusHandle;
use drivegate_core::process_image::HistogramSnapshot;

/// A bus, its statistics, and their history by minute.
pub(super) async fn bus(State(app): State<Arc<AppState>>, Path(name): Path<String>) -> Replied {
    let plant = app.plant.load();
    let handle = find_bus(&plant, &name)?;
    let _turn = app.turn().await;
    let clock = Clock::read();
    let line = app.north.history.line(&name);
    let hour = match &line {
        Some(line) => line.lock().unwrap_or_else(PoisonError::into_inner).last_hour(clock),
        // The bus is just being started and has no history yet.
        None => LineHistory::new(&handle.image, clock).last_hour(clock),
    };
    Ok(Json(Line::new(handle, hour)).into_response())
}

#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct Line<'b> {
    #[serde(flatten)]
    bus: api::Bus<'b>,
    turnaround: Turnarounds,
    hour: Hour,
    by_drive: Vec<DriveLine<'b>>,
}

/// Load and cycle of the last hour; each step is least, greatest and last value, or `null` without a value.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct Hour {
    #[serde(serialize_with = "drivegate_core::event::rfc3339")]
    #[schema(value_type = String)]
    from: SystemTime,
    step_s: u64,
    load_ratio: Vec<Option<[f64; 3]>>,
    fast_cycle_ms: Vec<Option<[f64; 3]>>,
}

#[derive(Debug, Serialize, utoipa::ToSchema)]
struct DriveLine<'b> {
    drive: &'b str,
    address: u8,
    online: bool,
    turnaround_ms: Option<f64>,
    turnaround: Turnarounds,
    /// Transactions in each step; `null` where the gateway did not run.
    transactions: Vec<Option<u32>>,
    errors: Vec<Option<u32>>,
}

/// Number of replies of the drive, by the time until each reply began.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct Turnarounds {
    /// Upper bound of each count; the last count has no bound.
    le_ms: Vec<Option<f64>>,
    counts: Vec<u64>,
    count: u64,
    sum_ms: f64,
}

impl Turnarounds {
    fn new(times: &[HistogramSnapshot]) -> Turnarounds {
        let bounds = times.first().map_or(&[][..], |first| &first.buckets);
        let of = |place: usize| times.iter().filter_map(move |times| times.buckets.get(place));
        let sum: f64 = times.iter().map(|times| times.sum).sum();
        Turnarounds {
            le_ms: bounds
                .iter()
                .map(|(bound, _)| (*bound < f64::MAX).then(|| rounded(bound * 1000.0, 1000.0)))
                .collect(),
            counts: (0..bounds.len())
                .map(|place| of(place).map(|(_, count)| count).sum())
                .collect(),
            count: times.iter().map(|times| times.count).sum(),
            sum_ms: rounded(sum * 1000.0, 1000.0),
        }
    }
}

impl<'b> Line<'b> {
    fn new(handle: &'b BusHandle, hour: LastHour) -> Line<'b> {
        let figures = |steps: Vec<Option<Figures>>, factor: f64, parts: f64| {
            let show = move |figure: f32| rounded(f64::from(figure) * factor, parts);
            let steps = steps.into_iter();
            steps
                .map(|step| step.map(|(min, max, last)| [min, max, last].map(show)))
                .collect()
        };
        let drives = &handle.image.drives;
        let turnarounds: Vec<HistogramSnapshot> = drives.iter().map(|drive| drive.turnarounds()).collect();
        let by_drive = drives.iter().zip(&turnarounds).zip(&hour.drives);
        let by_drive = by_drive.map(|((image, turnaround), steps)| DriveLine {
            drive: &image.spec.name,
            address: image.spec.address,
            online: image.snapshot().link.is_online(),
            turnaround_ms: image.turnaround().map(fine_millis),
            turnaround: Turnarounds::new(std::slice::from_ref(turnaround)),
            transactions: counts(steps, |exchanges| exchanges.all),
            errors: counts(steps, |exchanges| exchanges.failed),
        });
        Line {
            by_drive: by_drive.collect(),
            bus: api::Bus::new(handle),
            turnaround: Turnarounds::new(&turnarounds),
            hour: Hour {
                from: hour.from,
                step_s: STEP.as_secs(),
                load_ratio: figures(hour.load, 1.0, 10_000.0),
                fast_cycle_ms: figures(hour.cycle, 1000.0, 1000.0),
            },
        }
    }
}

fn counts(steps: &[Option<Exchanges>], of: impl Fn(&Exchanges) -> u32) -> Vec<Option<u32>> {
    steps.iter().map(|step| step.as_ref().map(&of)).collect()
}
