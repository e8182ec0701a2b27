//! The JSON object of the parameters of a drive. Fields are added, never renamed or removed.

use serde::Serialize;

use super::messages::Restore;
use drivegate_core::parameters::{ParameterFile, RestoreStatus, Status};

/// The parameters of a drive.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct Parameters<'a> {
    drive: &'a str,
    /// The last reading of the parameters; `null` if there is none.
    last: Option<LastReading<'a>>,
    /// The reading in progress; `null` if none.
    reading: Option<RunningReading<'a>>,
    /// Why the last try failed.
    error: Option<&'a str>,
    /// The last restore since the gateway started, or the one in progress.
    #[serde(skip_serializing_if = "Option::is_none")]
    restore: Option<Restore>,
}

#[derive(Debug, Serialize, utoipa::ToSchema)]
struct LastReading<'a> {
    family: &'a str,
    identification: &'a str,
    application: String,
    time: &'a str,
    /// The drive's own counters of its line (function 08), as text.
    #[serde(skip_serializing_if = "str::is_empty")]
    counters: &'a str,
    checksum: String,
    missing: usize,
    parameters: Vec<ParameterRow<'a>>,
}

#[derive(Debug, Serialize, utoipa::ToSchema)]
struct ParameterRow<'a> {
    id: &'a str,
    /// The raw value; `null` if the parameter was not read.
    raw: Option<f64>,
    /// Value with its unit or name, as text.
    text: &'a str,
    #[serde(skip_serializing_if = "Option::is_none")]
    why: Option<&'a str>,
}

#[derive(Debug, Serialize, utoipa::ToSchema)]
struct RunningReading<'a> {
    done: usize,
    total: usize,
    remaining_s: Option<f64>,
    waits: Option<&'a str>,
}

impl<'a> Parameters<'a> {
    pub(super) fn new(
        drive: &'a str,
        last: Option<&'a ParameterFile>,
        status: Option<&'a Status>,
        restore: Option<&RestoreStatus>,
    ) -> Parameters<'a> {
        let running = status.filter(|status| status.result.is_none());
        let failed = status.and_then(|status| status.result.as_ref()?.as_ref().err());
        Parameters {
            drive,
            last: last.map(LastReading::new),
            reading: running.map(|status| RunningReading {
                done: status.progress.0,
                total: status.progress.1,
                remaining_s: status.remaining.map(|time| time.as_secs_f64()),
                waits: status.waits.as_deref(),
            }),
            error: failed.map(String::as_str),
            restore: restore.map(Restore::new),
        }
    }
}

impl<'a> LastReading<'a> {
    fn new(file: &'a ParameterFile) -> LastReading<'a> {
        let parameters = file.values.iter().map(|(id, entry)| ParameterRow {
            id: id.name(),
            raw: entry.value.as_ref().ok().map(|value| value.number()),
            text: &entry.note,
            why: entry.value.as_ref().err().map(String::as_str),
        });
        LastReading {
            family: &file.family,
            identification: &file.identification,
            application: file.application(),
            time: &file.time,
            counters: &file.counters,
            checksum: file.checksum(),
            missing: file.missing(),
            parameters: parameters.collect(),
        }
    }
}
