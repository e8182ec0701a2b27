//! How a command ends: code, text and Modbus exception of every result.

use std::fmt;
use std::time::Duration;

use super::audit::Reach;
use super::{CAPACITY, Guarded};
use crate::event::EventKind;
use drivegate_model::drive::why::Fate;
use drivegate_proto::{Exception, Reply};

/// Event that interrupted a started command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Interruption {
    /// A stop arrived meanwhile.
    Stop,
    /// The command expired meanwhile.
    Expired,
    /// The port was lost during the transaction.
    BusDown,
    /// The drive no longer replies.
    Offline,
    /// The gateway stops, or its bus restarts.
    ShuttingDown,
    /// Another client took the exclusive right to the drive.
    Taken,
    /// A reload removed the right of the client.
    RightLost,
}

/// How a command ended.
#[derive(Debug, Clone, PartialEq)]
pub enum Outcome {
    /// The drive acknowledged the command (a read: its reply).
    Acknowledged(Reply),
    /// The drive refused the command.
    Exception(Exception),
    /// The reply leaves the outcome open: 05, or a gateway's 0A or 0B.
    Unknown(Exception),
    /// The command was refused before it reached the bus.
    Refused(Refusal),
    /// The drive did not reply.
    TimedOut,
    /// The drive's reply was invalid: wrong check code or length.
    Garbled,
    /// The command expired while it waited, and was not sent.
    Expired,
    /// A newer reference replaced the command; not sent.
    Replaced,
    /// A stop removed the command; not sent.
    Purged,
    /// A supervision action withdrawn because a client returned; not sent.
    Withdrawn,
    /// The drive acknowledged the value and shows another one.
    NotTaken(String),
    /// The command was started and then interrupted: it is unknown whether the drive received it, or a part of it.
    Interrupted(Interruption),
    /// The rest of the command was not sent, because its stop failed.
    NotStopped,
    /// The drive acknowledged the stop of a command that also does more; the result of the rest.
    StopOnly(Box<Outcome>),
    /// The stop of such a command failed with this outcome, and the rest was not sent.
    StopFailed(Box<Outcome>),
    /// The port is not open.
    BusDown,
    /// The drive is offline, so nothing was sent.
    Offline,
    /// 64 commands wait already.
    QueueFull,
    /// The gateway is shutting down.
    ShuttingDown,
}

impl Outcome {
    /// The code in results, audit lines and metrics.
    pub fn code(&self) -> &'static str {
        match self {
            Outcome::Acknowledged(_) => "acknowledged",
            Outcome::Exception(_) => "refused_by_drive",
            Outcome::Unknown(_) => "unknown",
            Outcome::Refused(refusal) => refusal.code(),
            Outcome::TimedOut => "timeout",
            Outcome::Garbled => "garbled",
            Outcome::Expired => "expired",
            Outcome::Replaced => "replaced",
            Outcome::Purged => "purged",
            Outcome::Withdrawn => "withdrawn",
            Outcome::NotTaken(_) => "not_taken",
            Outcome::Interrupted(_) => "interrupted",
            Outcome::NotStopped => "not_stopped",
            Outcome::StopOnly(_) => "stop_only",
            Outcome::StopFailed(stop) => stop.code(),
            Outcome::BusDown => "bus_down",
            Outcome::Offline => "offline",
            Outcome::QueueFull => "queue_full",
            Outcome::ShuttingDown => "shutting_down",
        }
    }

    /// How far the command got.
    pub(super) fn reach(&self) -> Reach {
        match self {
            Outcome::Acknowledged(_)
            | Outcome::Exception(_)
            | Outcome::Unknown(_)
            | Outcome::TimedOut
            | Outcome::Garbled
            | Outcome::NotTaken(_)
            | Outcome::Interrupted(_)
            | Outcome::StopOnly(_) => Reach::Sent,
            Outcome::StopFailed(stop) => stop.reach(),
            Outcome::Expired
            | Outcome::Replaced
            | Outcome::Purged
            | Outcome::Withdrawn
            | Outcome::NotStopped
            | Outcome::ShuttingDown => Reach::Queued,
            Outcome::Refused(_) | Outcome::BusDown | Outcome::Offline | Outcome::QueueFull => Reach::Refused,
        }
    }

    /// What became of the command, for the reason why a drive does not run.
    pub(crate) fn fate(&self) -> Fate {
        match self {
            // Only an order with a stop has two parts, and the stop is what matters.
            Outcome::Acknowledged(_) | Outcome::StopOnly(_) => Fate::Taken,
            Outcome::StopFailed(stop) => stop.fate(),
            Outcome::Exception(_) | Outcome::Refused(_) | Outcome::NotTaken(_) => Fate::Refused,
            Outcome::Unknown(_) | Outcome::TimedOut | Outcome::Garbled | Outcome::Interrupted(_) => Fate::Unsure,
            Outcome::Expired
            | Outcome::Replaced
            | Outcome::Purged
            | Outcome::Withdrawn
            | Outcome::NotStopped
            | Outcome::BusDown
            | Outcome::Offline
            | Outcome::QueueFull
            | Outcome::ShuttingDown => Fate::NotSent,
        }
    }

    /// The outcome of a write refused with that exception.
    pub fn of_exception(code: Exception) -> Outcome {
        if code.leaves_open() {
            Outcome::Unknown(code)
        } else {
            Outcome::Exception(code)
        }
    }

    /// Whether the drive accepted the command.
    pub fn is_ok(&self) -> bool {
        matches!(self, Outcome::Acknowledged(_))
    }

    /// The exception for a Modbus TCP client (`docs/modbus-tcp.md`); `None` for success.
    pub fn exception(&self) -> Option<Exception> {
        match self {
            Outcome::Acknowledged(_) => None,
            Outcome::Exception(code) | Outcome::Unknown(code) if code.code() <= 0x0B => Some(*code),
            Outcome::Exception(_) | Outcome::Unknown(_) | Outcome::Garbled | Outcome::NotTaken(_) => {
                Some(Exception::DEVICE_FAILURE)
            }
            Outcome::Refused(refusal) => Some(refusal.exception()),
            Outcome::QueueFull => Some(Exception::BUSY),
            Outcome::BusDown | Outcome::ShuttingDown => Some(Exception::GATEWAY_PATH),
            Outcome::TimedOut | Outcome::Offline | Outcome::Expired | Outcome::NotStopped => {
                Some(Exception::GATEWAY_TARGET)
            }
            // The client must learn which part was not carried out; success would mean both parts.
            Outcome::StopOnly(part) | Outcome::StopFailed(part) => {
                Some(part.exception().unwrap_or(Exception::DEVICE_FAILURE))
            }
            Outcome::Replaced | Outcome::Purged | Outcome::Withdrawn => Some(Exception::BUSY),
            Outcome::Interrupted(Interruption::BusDown | Interruption::ShuttingDown) => Some(Exception::GATEWAY_PATH),
            Outcome::Interrupted(_) => Some(Exception::GATEWAY_TARGET),
        }
    }
}

impl fmt::Display for Outcome {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Outcome::Acknowledged(_) => f.write_str("the drive acknowledged it"),
            Outcome::Exception(code) => write!(f, "the drive refused it with {code}"),
            Outcome::Unknown(code) => {
                write!(
                    f,
                    "the drive replied {code}; whether it executed the command is unknown"
                )
            }
            Outcome::Refused(refusal) => refusal.fmt(f),
            Outcome::TimedOut => f.write_str("the drive did not reply; whether it executed the command is unknown"),
            Outcome::Garbled => {
                f.write_str("the drive's reply was garbled; whether it executed the command is unknown")
            }
            Outcome::Expired => f.write_str("it expired before its turn came; it was not sent"),
            Outcome::Replaced => f.write_str("a newer command replaced it; it was not sent"),
            Outcome::Purged => f.write_str("a stop arrived after it was requested; it was not sent"),
            Outcome::Withdrawn => f.write_str("a client commands the drive again; it was not sent"),
            Outcome::NotTaken(shown) => write!(f, "the drive acknowledged it, but {shown}"),
            Outcome::Interrupted(why) => {
                let why = match why {
                    Interruption::Stop => "a stop arrived",
                    Interruption::Expired => "it expired",
                    Interruption::BusDown => "the bus went down",
                    Interruption::Offline => "the drive went offline",
                    Interruption::ShuttingDown => "the gateway shuts down, or a reload restarts its bus",
                    Interruption::Taken => "another client took the drive",
                    Interruption::RightLost => "a reload removed the right of its client",
                };
                write!(
                    f,
                    "it was started, then {why}; whether the drive executed it is unknown"
                )
            }
            Outcome::NotStopped => f.write_str("the stop of the same command failed; it was not sent"),
            Outcome::StopOnly(rest) => {
                let rest = rest
                    .to_string()
                    .replace("nothing was written", "nothing else was written");
                write!(
                    f,
                    "the drive acknowledged the stop; the rest was not carried out: {rest}"
                )
            }
            Outcome::StopFailed(stop) => write!(f, "{stop}; the rest of the command was not sent"),
            Outcome::BusDown => f.write_str("the bus is down; it was not sent"),
            Outcome::Offline => f.write_str("the drive is offline; it was not sent"),
            Outcome::QueueFull => write!(f, "{CAPACITY} commands are already waiting; it was not sent, try again"),
            Outcome::ShuttingDown => {
                f.write_str("the gateway shuts down, or a reload restarts its bus; it was not sent")
            }
        }
    }
}

/// Why a command was refused before it reached the bus.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Refusal {
    /// Writing is off for that client or drive.
    #[error("{0}")]
    NotAllowed(String),
    /// The point or address cannot be written, or does not exist.
    #[error("{0}")]
    NotWritable(String),
    /// The command depends on a value that has not been read from the drive yet. If the drive is silent, its
    /// absence is the reason instead.
    #[error("{0}")]
    NotKnown(String),
    /// The value is outside the type, the profile or the limits, or the command contradicts itself.
    #[error("{0}")]
    BadValue(String),
    /// Another client has a right to the drive that takes precedence over the right of this client.
    #[error("{0}")]
    HeldByOther(Box<Holder>),
    /// A guard does not let the motor start yet.
    #[error("{0}; it was not sent")]
    Guarded(Box<Guarded>),
    /// An interlock of the drive is not satisfied.
    #[error("{0}; it was not sent")]
    Interlocked(String),
    /// A client refused after a stop repeats run, or renews a hold it does not have.
    #[error("{0}")]
    NeedsTake(Box<Holder>),
    /// There is no drive with this name.
    #[error("{0}")]
    UnknownDrive(String),
    /// The drive reports that its motor runs: no parameter is written.
    #[error("{0}")]
    MotorRuns(String),
    /// The value in the drive is neither the one that the restore found nor the one that it is to write.
    #[error("{0}")]
    OtherValue(String),
}

/// The client that blocks a drive for others.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Holder {
    /// Client that holds the drive.
    pub who: String,
    /// Rank of the holder.
    pub rank: String,
    /// The point that is held, and how the hold ends.
    pub keeps: String,
    /// Seconds until the hold expires, if it does.
    pub left_s: Option<u64>,
}

impl fmt::Display for Holder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Holder { who, rank, keeps, .. } = self;
        write!(f, "{who} ({rank}) {keeps}; it was not sent")
    }
}

impl Refusal {
    pub(super) const UNKNOWN_DRIVE: &str = "unknown_drive";

    /// The code of the outcome in results.
    pub fn code(&self) -> &'static str {
        match self {
            Refusal::NotAllowed(_) | Refusal::MotorRuns(_) | Refusal::OtherValue(_) => "not_allowed",
            Refusal::NotWritable(_) | Refusal::NotKnown(_) => "not_writable",
            Refusal::BadValue(_) => "bad_value",
            Refusal::HeldByOther(_) => "held_by_other",
            Refusal::Guarded(_) => "guarded",
            Refusal::Interlocked(_) => "interlocked",
            Refusal::NeedsTake(_) => "needs_take",
            Refusal::UnknownDrive(_) => Refusal::UNKNOWN_DRIVE,
        }
    }

    /// The kind of the event that reports the refusal.
    pub fn event_kind(&self) -> EventKind {
        match self {
            Refusal::Guarded(_) => EventKind::Guarded,
            Refusal::Interlocked(_) => EventKind::Interlock,
            Refusal::NotAllowed(_)
            | Refusal::NotWritable(_)
            | Refusal::NotKnown(_)
            | Refusal::BadValue(_)
            | Refusal::HeldByOther(_)
            | Refusal::NeedsTake(_)
            | Refusal::UnknownDrive(_)
            | Refusal::MotorRuns(_)
            | Refusal::OtherValue(_) => EventKind::RefusedCommand,
        }
    }

    /// The client that blocks the drive, if any.
    pub fn holder(&self) -> Option<&Holder> {
        match self {
            Refusal::HeldByOther(holder) | Refusal::NeedsTake(holder) => Some(holder),
            _ => None,
        }
    }

    /// The Modbus exception for the outcome.
    pub fn exception(&self) -> Exception {
        match self {
            Refusal::NotAllowed(_) | Refusal::MotorRuns(_) | Refusal::OtherValue(_) => Exception::FUNCTION,
            Refusal::NotWritable(_) | Refusal::NotKnown(_) => Exception::ADDRESS,
            Refusal::BadValue(_) => Exception::VALUE,
            Refusal::HeldByOther(_) | Refusal::NeedsTake(_) | Refusal::Guarded(_) | Refusal::Interlocked(_) => {
                Exception::BUSY
            }
            Refusal::UnknownDrive(_) => Exception::GATEWAY_PATH,
        }
    }
}

/// The single result of a command.
#[derive(Debug, Clone, PartialEq)]
pub struct Answer {
    /// How the command ended.
    pub outcome: Outcome,
    /// Time from acceptance to result.
    pub latency: Duration,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_refused_did_not_expire() {
        let refusals = [
            Refusal::NotAllowed(String::new()),
            Refusal::NotWritable(String::new()),
            Refusal::BadValue(String::new()),
            Refusal::Interlocked(String::new()),
            Refusal::HeldByOther(Box::default()),
            Refusal::NeedsTake(Box::default()),
        ];
        for refusal in refusals {
            assert_eq!(Outcome::Refused(refusal.clone()).fate(), Fate::Refused, "{refusal:?}");
        }
        for (outcome, fate) in [
            (Outcome::NotTaken("it shows state 3".to_string()), Fate::Refused),
            (Outcome::Exception(Exception::VALUE), Fate::Refused),
            (Outcome::Expired, Fate::NotSent),
            (Outcome::StopFailed(Box::new(Outcome::TimedOut)), Fate::Unsure),
            (Outcome::StopOnly(Box::new(Outcome::Expired)), Fate::Taken),
        ] {
            assert_eq!(outcome.fate(), fate, "{outcome:?}");
        }
    }

    #[test]
    fn the_page_has_every_result() {
        let page = include_str!("../../../../docs/commands.md");
        let refusals = [
            Refusal::NotAllowed,
            Refusal::NotWritable,
            Refusal::BadValue,
            Refusal::UnknownDrive,
        ];
        let mut outcomes: Vec<Outcome> = refusals.iter().map(|r| Outcome::Refused(r(String::new()))).collect();
        let held = [Refusal::HeldByOther(Box::default()), Refusal::NeedsTake(Box::default())];
        outcomes.extend(held.map(Outcome::Refused));
        outcomes.extend([
            Outcome::Refused(Refusal::Interlocked(String::new())),
            Outcome::Acknowledged(Reply::Written),
            Outcome::TimedOut,
            Outcome::Garbled,
            Outcome::Expired,
            Outcome::Replaced,
            Outcome::Purged,
            Outcome::Withdrawn,
            Outcome::NotTaken(String::new()),
            Outcome::Interrupted(Interruption::Stop),
            Outcome::NotStopped,
            Outcome::BusDown,
            Outcome::Offline,
            Outcome::QueueFull,
            Outcome::ShuttingDown,
        ]);
        for outcome in outcomes {
            let exception = outcome
                .exception()
                .map_or("none".to_string(), |e| format!("{:02X}", e.code()));
            let row = format!("| `{}` | {exception} |", outcome.code());
            assert!(page.contains(&row), "docs/commands.md lacks {row}");
        }
        assert!(page.contains("| `guarded` | 06 | 409 |"));
        for with_code in [Outcome::Exception, Outcome::Unknown] {
            assert!(page.contains(&format!("| `{}` |", with_code(Exception::BUSY).code())));
        }
        assert!(page.contains(&format!(
            "| `{}` |",
            Outcome::StopOnly(Box::new(Outcome::Purged)).code()
        )));
        assert_eq!(
            Outcome::Exception(Exception::Modbus(0x33)).exception(),
            Some(Exception::DEVICE_FAILURE)
        );
        assert_eq!(Outcome::Exception(Exception::BUSY).exception(), Some(Exception::BUSY));
    }
}
