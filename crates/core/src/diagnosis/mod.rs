//! Diagnoses a line from its normal traffic with a few counters per drive and rules that evaluate them. Pure:
//! transactions and time are arguments.
//!
//! - [`signature`]: what the bytes of one transaction show: the echo, a stray byte before the reply, a reply without its beginning.
//! - [`counters`]: the kinds of counters.
//! - [`figures`]: what was counted in the last minute, for each drive and for the line. Bounded: see [`figures::BYTES_PER_DRIVE`].
//! - `known`: what is known of each drive, and which stand out.
//! - [`rules`]: one rule for each cause. A rule that compares drives finds nothing until most of them have had enough
//!   requests.
//! - [`hold`]: a verdict changes only on lasting evidence.
//! - [`own_timeout`]: a drive that its own timeout tripped soon after a command.
//! - [`unanswered`]: registers to which a drive never replies.
//! - [`words`]: the texts of causes and remedies.

pub mod counters;
pub mod debounce;
mod failure_rates;
pub mod figures;
pub mod own_timeout;
pub mod rules;
pub mod signature;
pub mod texts;
pub mod unanswered;

use std::fmt;
use std::time::{Duration, SystemTime};

use serde::Serialize;

use drivegate_model::drive::DriveIndex;
use drivegate_proto::RequestPdu;

pub use figures::{Drive, End, Exchange, Figures, Line};

/// A possible cause of line errors.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Cause {
    /// No drive of the line answers.
    AllSilent,
    /// A single drive is bad, the others are good.
    OneDrive,
    /// All drives from one address upward are bad.
    FromAddress,
    /// A drive has never answered, others do.
    NeverAnswered,
    /// Two drives reply to the same address.
    AddressTwice,
    /// Errors occur only while drives run.
    WhileRunning,
    /// Errors occur in phase with the mains.
    Mains,
    /// Stray bytes while the line is idle.
    Bias,
    /// The first bytes of replies are lost.
    ReplyStartLost,
    /// The last bytes of requests are lost.
    RequestEndLost,
    /// The adapter receives the requests that it sends.
    Echo,
    /// A USB adapter delivers in steps of 16 ms.
    LatencyTimer,
    /// Requests sent soon after a reply are ignored.
    SilenceTooShort,
    /// The port was lost repeatedly.
    PortResets,
    /// A device server closes its connection repeatedly.
    ConnectionCloses,
    /// Replies arrive faster than the configured baud rate allows.
    FasterThanBaud,
    /// The drive answers, but never reads of certain registers.
    RegisterUnanswered,
    /// A drive was tripped by its own communication timeout soon after a command.
    OwnTimeout,
    /// Errors occur without a pattern.
    Noise,
}

impl Cause {
    /// All causes, in the order in which the documentation lists them.
    pub const ALL: [Cause; 19] = [
        Cause::AllSilent,
        Cause::OneDrive,
        Cause::FromAddress,
        Cause::NeverAnswered,
        Cause::AddressTwice,
        Cause::WhileRunning,
        Cause::Mains,
        Cause::Bias,
        Cause::ReplyStartLost,
        Cause::RequestEndLost,
        Cause::Echo,
        Cause::LatencyTimer,
        Cause::SilenceTooShort,
        Cause::PortResets,
        Cause::ConnectionCloses,
        Cause::FasterThanBaud,
        Cause::RegisterUnanswered,
        Cause::OwnTimeout,
        Cause::Noise,
    ];

    /// The word for the cause in payloads and metrics.
    pub const fn name(self) -> &'static str {
        match self {
            Cause::AllSilent => "all_silent",
            Cause::OneDrive => "one_drive",
            Cause::FromAddress => "from_address",
            Cause::NeverAnswered => "never_answered",
            Cause::AddressTwice => "address_twice",
            Cause::WhileRunning => "while_running",
            Cause::Mains => "mains",
            Cause::Bias => "bias",
            Cause::ReplyStartLost => "reply_start_lost",
            Cause::RequestEndLost => "request_end_lost",
            Cause::Echo => "echo",
            Cause::LatencyTimer => "latency_timer",
            Cause::SilenceTooShort => "silence_too_short",
            Cause::PortResets => "port_resets",
            Cause::ConnectionCloses => "connection_closes",
            Cause::FasterThanBaud => "faster_than_baud",
            Cause::RegisterUnanswered => "register_unanswered",
            Cause::OwnTimeout => "own_timeout",
            Cause::Noise => "noise",
        }
    }
}

/// How certain a verdict is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Certainty {
    /// The cause would explain the symptoms, but so would other causes.
    Fits,
    /// The usual cause of such evidence; other causes would usually show different signs.
    Likely,
    /// The cause itself was observed.
    Certain,
}

impl Certainty {
    /// The word for the certainty in JSON and MQTT payloads.
    pub const fn name(self) -> &'static str {
        match self {
            Certainty::Fits => "fits",
            Certainty::Likely => "likely",
            Certainty::Certain => "certain",
        }
    }
}

/// A finding of a rule. Its drives are given by their index on the bus.
#[derive(Debug, Clone, PartialEq)]
pub struct Finding {
    pub cause: Cause,
    /// The drive, if the cause concerns a single one.
    pub drive: Option<DriveIndex>,
    /// How certain the finding is.
    pub certainty: Certainty,
    /// The evidence for the cause, as text.
    pub evidence: String,
    /// The remedy for this finding, if it is more specific than the remedy of its cause.
    pub remedy: Option<String>,
}

impl Finding {
    /// The remedy: what to check or change at the line or the drive.
    pub fn remedy(&self) -> &str {
        self.remedy.as_deref().unwrap_or(self.cause.remedy())
    }
}

/// A cause with its evidence, as the gateway shows it to people.
#[derive(Debug, Clone, PartialEq, Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct Verdict {
    /// The cause of the errors.
    #[schema(value_type = String)]
    pub verdict: Cause,
    /// The drive, if the cause concerns a single one.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub drive: Option<String>,
    /// How certain the verdict is.
    #[schema(value_type = String)]
    pub certainty: Certainty,
    /// Meaning of the cause, in a few words.
    pub meaning: String,
    /// The evidence for the cause.
    pub evidence: String,
    /// The remedy for the cause.
    pub remedy: String,
    /// What to check and set on drives of the affected families, from their profiles.
    #[serde(skip_serializing_if = "Vec::is_empty", default)]
    pub steps: Vec<String>,
    /// Since when the verdict holds, RFC 3339.
    pub since: String,
}

/// The diagnosis of a line at one time.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Diagnosis {
    /// When the diagnosis was made; `None` before the first diagnosis.
    pub at: Option<SystemTime>,
    /// The present verdicts, most significant first.
    pub verdicts: Vec<Verdict>,
    /// Number of valid replies in the last minute from addresses to which no request was sent.
    pub wrong_address: u32,
    /// The counters of the last minute, one entry per drive in the order of the file.
    pub drives: Vec<Counted>,
}

/// The counters of one drive in the last minute.
#[derive(Debug, Clone, Default, PartialEq, Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct Counted {
    /// Name of the drive.
    pub drive: String,
    /// Transactions with a valid reply.
    pub answered: u32,
    /// Requests to the drive without a reply.
    pub silent: u32,
    /// Invalid replies of the drive.
    pub damaged: u32,
    /// Replies, damaged or valid, with a stray byte before them.
    pub stray_before: u32,
    /// Damaged replies whose first bytes were missing; the rest was valid.
    pub start_lost: u32,
    /// Replies after the time limit.
    pub late: u32,
    /// Further replies to one request after the valid one.
    pub second: u32,
    /// Longest time to the start of a reply, ms.
    pub slowest_ms: f64,
    /// The error counters that the drive keeps itself, if it has any and counted errors.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub by_drive: Option<CountedByDrive>,
}

/// The counters that a drive itself has kept since they were cleared (function 08, subfunctions 0B to 0F); they
/// wrap at 65536.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct CountedByDrive {
    /// Valid messages that the drive saw on the line, for any address.
    pub messages: u16,
    /// Damaged messages that the drive saw.
    pub damaged: u16,
    /// Exceptions that the drive sent.
    pub exceptions: u16,
    /// Messages addressed to the drive.
    pub own: u16,
    /// Messages to the drive without an answer; broadcasts are among them [inference].
    pub unanswered: u16,
}

impl CountedByDrive {
    /// The first subfunction of function 08 that reads a counter; the other counters follow in order.
    const FIRST: u16 = 0x0B;

    /// The request for the next counter.
    pub fn request(so_far: &[u16]) -> RequestPdu {
        let place = u16::try_from(so_far.len().min(4)).unwrap_or_default();
        RequestPdu::Diagnostics {
            subfunction: CountedByDrive::FIRST + place,
            data: 0,
        }
    }

    /// All five counters, in the order of their subfunctions; `None` while some are missing.
    pub fn complete(counters: &[u16]) -> Option<CountedByDrive> {
        let &[messages, damaged, exceptions, own, unanswered] = counters else {
            return None;
        };
        Some(CountedByDrive {
            messages,
            damaged,
            exceptions,
            own,
            unanswered,
        })
    }

    /// The increase of the counters since `before`.
    #[must_use]
    pub fn since(&self, before: &CountedByDrive) -> CountedByDrive {
        CountedByDrive {
            messages: self.messages.wrapping_sub(before.messages),
            damaged: self.damaged.wrapping_sub(before.damaged),
            exceptions: self.exceptions.wrapping_sub(before.exceptions),
            own: self.own.wrapping_sub(before.own),
            unanswered: self.unanswered.wrapping_sub(before.unanswered),
        }
    }

    /// The direction of the line that is disturbed, as text. Derived from the number of messages that the drive
    /// received damaged between two readings, and the number of its replies that arrived damaged here. `None` if
    /// neither number shows a disturbance.
    pub fn direction(&self, name: &str, damaged_here: u32) -> Option<String> {
        let CountedByDrive { messages, damaged, .. } = self;
        match (*damaged, damaged_here) {
            (0, 0) => None,
            (0, here) => Some(format!(
                "{name} received all {messages} messages intact, but {here} of its replies arrived damaged: the \
                 direction from the drive to the gateway is disturbed"
            )),
            (damaged, 0) => Some(format!(
                "{name} received {damaged} messages damaged and {messages} intact, and its replies arrived intact: \
                 the direction from the gateway to the drive is disturbed"
            )),
            (damaged, here) => Some(format!(
                "{name} received {damaged} messages damaged and {messages} intact, and {here} of its replies arrived \
                 damaged: both directions are disturbed"
            )),
        }
    }
}

impl fmt::Display for CountedByDrive {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let CountedByDrive {
            messages,
            damaged,
            exceptions,
            own,
            unanswered,
        } = self;
        write!(
            f,
            "{messages} messages received, {damaged} damaged, {own} to this drive, {unanswered} of them unanswered, \
             {exceptions} exceptions sent"
        )
    }
}

/// Interval at which the rules are applied.
pub const STEP: Duration = Duration::from_secs(5);

#[cfg(test)]
mod tests;
