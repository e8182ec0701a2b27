//! Refusals of a client that does not hold the drive, with their texts. Pure.

use std::time::Duration;

use super::{Claim, Rules};
use crate::order::{Holder, Refusal};

/// Why a command, or an action on the hold, is refused.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Denial {
    /// The client is not a principal of `[authority]`.
    Nobody,
    /// Another client holds the drive.
    Held(Claim, Duration),
    /// The stop of another client reserved the drive.
    Reserved(Claim, Duration),
    /// The stop of another client refused this client's run command, and repeating it does not start the motor.
    NeedsTake(Claim),
    /// The drive is under local control.
    Local,
    /// The client repeats its own acknowledged stop while another client holds the drive or, if the time is zero,
    /// started the motor.
    Repeats(Claim, Duration),
    /// The client wants to renew a hold that it does not have.
    NotHeld,
}

/// Seconds, rounded up: 0 means that nothing is left.
pub(super) fn seconds(left: Duration) -> u64 {
    left.as_secs() + u64::from(left.subsec_nanos() > 0)
}

impl Denial {
    /// The denial as the refusal for the client.
    pub fn refusal(&self, rules: &Rules) -> Refusal {
        let holder = |claim: &Claim, left: Duration, keeps: String| {
            Box::new(Holder {
                who: claim.name.to_string(),
                rank: rules.rank(claim.rank).to_string(),
                keeps,
                left_s: Some(seconds(left)),
            })
        };
        match self {
            Denial::Nobody => Refusal::NotAllowed(
                "this client is not a principal of [authority], so it may only stop; nothing was written".to_string(),
            ),
            Denial::Held(by, left) => {
                let keeps = format!("holds the drive for another {} s, longer if renewed", seconds(*left));
                Refusal::HeldByOther(holder(by, *left, keeps))
            }
            Denial::Reserved(by, left) => {
                let keeps = format!("stopped the drive, which is reserved for another {} s", seconds(*left));
                Refusal::HeldByOther(holder(by, *left, keeps))
            }
            Denial::Repeats(by, left) => {
                let has = if left.is_zero() {
                    "started the motor"
                } else {
                    "holds the drive"
                };
                let keeps = format!("{has}, and this only repeats an earlier stop");
                Refusal::HeldByOther(holder(by, *left, keeps))
            }
            Denial::NeedsTake(by) => {
                let keeps = "stopped the drive while this client kept sending run; send a stop, or take the drive, \
                             before run"
                    .to_string();
                Refusal::NeedsTake(holder(by, Duration::ZERO, keeps))
            }
            Denial::Local => Refusal::HeldByOther(Box::new(Holder {
                who: "the drive's local control place".to_string(),
                rank: "local".to_string(),
                keeps: "controls the drive until `remote` is set again".to_string(),
                left_s: None,
            })),
            Denial::NotHeld => Refusal::NeedsTake(Box::new(Holder {
                who: "nobody".to_string(),
                rank: "none".to_string(),
                keeps: "holds the drive: there is nothing to renew; take it".to_string(),
                left_s: Some(0),
            })),
        }
    }
}
