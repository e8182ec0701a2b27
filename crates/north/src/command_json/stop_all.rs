//! The body of a stop of all drives.

use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use super::excerpt;
use drivegate_core::event::RefusedCommand;
use drivegate_core::order::{Origin, Outcome, Refusal};
use drivegate_core::plant::{Plant, turn_away};
use drivegate_core::stop_all::{LONGEST_WAIT, NothingToStop, Scope, WAIT};

/// Names of a stop of several drives, and of its drives, in audit and events.
const STOP_ALL: &str = "stop all";
const DRIVES: &str = "all drives";

/// Body of a request to stop all: which drives are to be stopped.
#[derive(Debug, Default, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct StopBody {
    pub bus: Option<String>,
    pub group: Option<String>,
    pub wait_s: Option<f64>,
}

/// Parses which drives are to be stopped, and how long the answer waits for standstill. An empty body stops all drives.
///
/// # Errors
/// If the request does not specify the drives clearly.
pub fn stop_all(payload: &[u8]) -> Result<(Scope, Duration), Refusal> {
    let unclear = |why: String| {
        let shown = excerpt(payload);
        Refusal::BadValue(format!(
            "{shown} does not say which drives to stop ({why}), so no stop was sent; write {{}}, {{\"bus\": \"NAME\"}} or {{\"group\": \"NAME\"}}"
        ))
    };
    let body = match payload.trim_ascii() {
        [] => StopBody::default(),
        // A list would be taken for an object without keys.
        object @ [b'{', ..] => {
            serde_json::from_slice::<StopBody>(object).map_err(|error| unclear(error.to_string()))?
        }
        _ => return Err(unclear("it is not a JSON object".to_string())),
    };
    let scope = match (body.bus, body.group) {
        (None, None) => Scope::Gateway,
        (Some(bus), None) => Scope::Bus(bus),
        (None, Some(group)) => Scope::Group(group),
        (Some(_), Some(_)) => {
            let why = "both `bus` and `group` are given, so no stop was sent; write one of them";
            return Err(Refusal::BadValue(why.to_string()));
        }
    };
    // An invalid wait must not prevent the stop.
    let wait = body.wait_s.filter(|wait| *wait >= 0.0).unwrap_or(WAIT.as_secs_f64());
    Ok((scope, Duration::from_secs_f64(wait.min(LONGEST_WAIT.as_secs_f64()))))
}

/// Refuses a stop of several drives: audited, counted and published as an event. The words for the client.
pub fn refuse_stop_all(plant: &Plant, refusal: Refusal, origin: &Origin, now: Instant) -> String {
    let why = refusal.to_string();
    let refused = RefusedCommand {
        client: origin.client(),
        reason: refusal.code(),
        kind: refusal.event_kind(),
        bus: "",
        drive: "",
        text: format!("refused {STOP_ALL} from {} {}: {why}", origin.kind.name(), origin.who),
    };
    plant.events.publish_refusal(refused, now);
    let outcome = Outcome::Refused(refusal);
    turn_away(&plant.command_log, DRIVES, STOP_ALL, outcome, origin.clone(), now);
    why
}

/// The reason why nothing is stopped, as a refusal.
pub fn nothing_to_stop(why: &NothingToStop) -> Refusal {
    match why {
        NothingToStop::NotControlled => Refusal::NotAllowed(why.to_string()),
        NothingToStop::Unknown { .. } => Refusal::BadValue(why.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn says_which_drives() {
        let all = Ok((Scope::Gateway, WAIT));
        assert_eq!(stop_all(b""), all);
        assert_eq!(stop_all(b" {} "), all);
        assert_eq!(stop_all(b"{\"wait_s\": -1}"), all);
        assert_eq!(stop_all(b"{\"bus\": \"b\"}"), Ok((Scope::Bus("b".to_string()), WAIT)));
        let group = Scope::Group("g".to_string());
        assert_eq!(
            stop_all(b"{\"group\": \"g\", \"wait_s\": 1e9}"),
            Ok((group, LONGEST_WAIT))
        );
        for bad in [
            "1",
            "[]",
            "{\"bus\": 1}",
            "{\"drive\": \"d\"}",
            "{\"bus\": \"b\", \"group\": \"g\"}",
            "{",
        ] {
            assert!(stop_all(bad.as_bytes()).is_err(), "{bad}");
        }
    }
}
