//! The hold of a drive as JSON.

use serde::Serialize;

use super::result::ErrorObject;
use drivegate_core::order::Refusal;
use drivegate_core::permit::HoldView;

/// The holder of a drive, and the result of an action on the hold.
#[derive(Debug, Clone, Serialize, utoipa::ToSchema)]
pub struct HoldReply<'r> {
    drive: &'r str,
    #[serde(skip_serializing_if = "Option::is_none")]
    ok: Option<bool>,
    #[serde(skip_serializing_if = "Option::is_none")]
    result: Option<&'static str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<ErrorObject>,
    #[serde(flatten)]
    hold: HoldFields,
    /// Whether the hold is the client's own.
    #[serde(skip_serializing_if = "Option::is_none")]
    own: Option<bool>,
}

/// The fields of the hold in the JSON of a drive. Comparison ignores the remaining time, which changes by itself.
#[derive(Debug, Clone, Default, Serialize, utoipa::ToSchema)]
pub struct HoldFields {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hold: Option<&'static str>,
    pub holder: Option<String>,
    pub holder_rank: Option<String>,
    pub hold_left_s: Option<u64>,
}

impl PartialEq for HoldFields {
    fn eq(&self, other: &HoldFields) -> bool {
        let told = |fields: &HoldFields| (fields.hold, fields.holder.clone(), fields.holder_rank.clone());
        told(self) == told(other)
    }
}

impl From<HoldView> for HoldFields {
    fn from(view: HoldView) -> HoldFields {
        HoldFields {
            hold: Some(view.state.name()),
            holder: view.holder.map(|holder| holder.to_string()),
            holder_rank: view.rank.map(|rank| rank.to_string()),
            hold_left_s: view.left_s,
        }
    }
}

impl<'r> HoldReply<'r> {
    /// The published state of a drive's hold.
    pub fn of(drive: &'r str, view: HoldView) -> HoldReply<'r> {
        HoldReply {
            drive,
            ok: None,
            result: None,
            error: None,
            hold: view.into(),
            own: None,
        }
    }

    /// The result of an action on the hold; `seen` is the state of the hold if the action was refused.
    pub fn new(drive: &'r str, done: Result<HoldView, Refusal>, seen: Option<HoldView>) -> HoldReply<'r> {
        let (hold, refusal) = match done {
            Ok(view) => (Some(view), None),
            Err(refusal) => (seen, Some(refusal)),
        };
        HoldReply {
            drive,
            ok: Some(refusal.is_none()),
            result: refusal.as_ref().map(Refusal::code),
            error: refusal.map(|refusal| ErrorObject {
                code: refusal.code(),
                message: refusal.to_string(),
            }),
            hold: hold.map(HoldFields::from).unwrap_or_default(),
            own: None,
        }
    }

    pub fn own(mut self, own: bool) -> HoldReply<'r> {
        self.own = Some(own);
        self
    }
}
