//! The result of a command as JSON.

use std::time::{Duration, SystemTime};

use serde::Serialize;

use super::Id;
use drivegate_core::order::{Answer, CONFIRMED, Outcome, Refusal, milliseconds, milliseconds_or_null};
use drivegate_core::plant::Shown;

/// The only result of a command: `confirmed` if a read showed the effect in time, otherwise the answer of the bus.
#[derive(Debug, Clone, Serialize, utoipa::ToSchema)]
pub struct CommandResult<'r> {
    #[schema(value_type = serde_json::Value)]
    id: Option<&'r Id>,
    drive: &'r str,
    ok: bool,
    result: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<ErrorObject>,
    /// Refusal code for the rest of a command of which only the stop was executed.
    #[serde(skip_serializing_if = "Option::is_none")]
    rest: Option<&'static str>,
    /// Time after which a refused start may be retried.
    #[serde(skip_serializing_if = "Option::is_none")]
    retry_after_ms: Option<u64>,
    #[serde(flatten)]
    #[schema(value_type = KeptBy)]
    kept_by: Option<KeptBy>,
    #[serde(rename = "latency_ms", serialize_with = "milliseconds")]
    #[schema(value_type = f64)]
    latency: Duration,
    /// Time from acceptance to the read that showed the command's effect.
    #[serde(
        rename = "confirmed_ms",
        serialize_with = "milliseconds_or_null",
        skip_serializing_if = "Option::is_none"
    )]
    #[schema(value_type = Option<f64>)]
    confirmed: Option<Duration>,
    /// Why no read can show the effect of an acknowledged command.
    #[serde(skip_serializing_if = "Option::is_none")]
    note: Option<String>,
    #[serde(serialize_with = "drivegate_core::event::rfc3339")]
    #[schema(value_type = String)]
    time: SystemTime,
}

#[derive(Debug, Clone, Serialize, utoipa::ToSchema)]
pub(super) struct ErrorObject {
    pub(super) code: &'static str,
    pub(super) message: String,
}

/// The client that keeps others from the drive.
#[derive(Debug, Clone, Serialize, utoipa::ToSchema)]
struct KeptBy {
    #[schema(required = false)]
    holder: String,
    #[schema(required = false)]
    holder_rank: String,
    hold_left_s: Option<u64>,
}

/// The holder that is the reason for this outcome.
fn kept_by(outcome: &Outcome) -> Option<KeptBy> {
    match outcome {
        Outcome::Refused(refusal) => refusal.holder().map(|holder| KeptBy {
            holder: holder.who.clone(),
            holder_rank: holder.rank.clone(),
            hold_left_s: holder.left_s,
        }),
        Outcome::StopOnly(part) | Outcome::StopFailed(part) => kept_by(part),
        _ => None,
    }
}

impl<'r> CommandResult<'r> {
    /// The result at `time` of the command with this `id`, as far as reads have confirmed it so far.
    pub fn new(
        id: Option<&'r Id>,
        drive: &'r str,
        answer: &Answer,
        shown: Shown,
        time: SystemTime,
    ) -> CommandResult<'r> {
        let code = match shown.after {
            Some(_) => CONFIRMED,
            None => answer.outcome.code(),
        };
        let error = (!answer.outcome.is_ok()).then(|| answer.outcome.to_string());
        CommandResult {
            id,
            drive,
            ok: error.is_none(),
            result: code,
            error: error.map(|message| ErrorObject { code, message }),
            rest: match &answer.outcome {
                Outcome::StopOnly(rest) => Some(rest.code()),
                _ => None,
            },
            retry_after_ms: match &answer.outcome {
                Outcome::Refused(Refusal::Guarded(guarded)) => Some(guarded.retry_after_ms()),
                _ => None,
            },
            kept_by: kept_by(&answer.outcome),
            latency: answer.latency,
            confirmed: shown.after,
            note: shown.unseen,
            time,
        }
    }

    /// The result as the JSON that the client receives.
    pub fn to_json(&self) -> Vec<u8> {
        // Strings, numbers and previous JSON can always be serialized.
        serde_json::to_vec(self).unwrap_or_default()
    }
}
