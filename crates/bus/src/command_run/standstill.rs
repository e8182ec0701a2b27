//! Decides whether an order that does not itself say whether the motor is to run may repeat the remembered run
//! command, from the observed state of the drive. Pure.
//!
//! A drive that restarted, or was stopped at its panel, has lost its run command: the remembered word would
//! start its motor.

use drivegate_core::order::Refusal;

/// State of the motor as the drive reported it during this command, right before the write.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Motor {
    /// The motor runs by the bus, as far as the drive reports its control place.
    Runs,
    /// The motor runs, and is commanded elsewhere.
    RunsElsewise,
    /// The motor is at standstill, or the drive has a fault.
    Stands,
    /// No status shows the state of the motor.
    NotShown,
}

/// The run command in the drive's word, as far as it is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum KnownRun {
    /// The run command of the word is set.
    Run,
    /// The word is neither a run command nor a stop.
    Other,
    Unknown,
}

/// Kind of a write that does not decide whether the motor is to run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Wants {
    /// The direction as part of the control word.
    Direction,
    /// The direction, which has a separate register.
    DirectionElsewhere,
    /// A reset as part of the control word.
    Reset,
    /// The control word before a reset that has a separate register.
    ResetElsewhere,
    /// The end of a reset, which is sent whatever happens.
    ResetEnd,
    /// The order writes other bits of the control word.
    Others,
}

/// The decision which word may be written.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Verdict {
    /// The word is written with its present run command.
    AsItStands,
    /// The word is written without a run command.
    WithoutRun,
    /// Write nothing: the direction is kept for the next start.
    AtNextStart,
    Refused(Refusal),
}

/// Decides the word that an order may write to a drive whose known word is not a stop. `told` means that the drive
/// itself reported its word during this command; the word of a running drive is then current, whichever client
/// commands it.
pub(super) fn judge(wants: Wants, holds: KnownRun, told: bool, motor: Motor) -> Verdict {
    use Verdict::{AsItStands, AtNextStart, WithoutRun};

    let motor = match motor {
        Motor::RunsElsewise if told && holds == KnownRun::Run => Motor::Runs,
        motor => motor,
    };
    match (wants, holds, motor) {
        (Wants::Others, KnownRun::Run | KnownRun::Other, _) if told => AsItStands,
        (Wants::ResetElsewhere, KnownRun::Unknown, Motor::Runs) => AsItStands,
        (Wants::ResetEnd, KnownRun::Unknown | KnownRun::Other, _) => WithoutRun,
        (Wants::DirectionElsewhere, _, Motor::Runs) | (_, KnownRun::Run, Motor::Runs) => AsItStands,
        (Wants::DirectionElsewhere, ..) | (Wants::Direction, KnownRun::Run, _) => AtNextStart,
        (Wants::ResetEnd, KnownRun::Run, _) => WithoutRun,
        (_, KnownRun::Unknown, Motor::Runs) => Verdict::Refused(Refusal::NotKnown(
            "the last command to the drive is unknown; include `run` true or false in this command".to_string(),
        )),
        (Wants::Direction, _, Motor::Runs | Motor::RunsElsewise) => AtNextStart,
        (_, _, Motor::Runs | Motor::RunsElsewise) => refused("the motor runs, but by no run command of this gateway"),
        (Wants::Others, KnownRun::Run, Motor::Stands | Motor::NotShown) => {
            refused("the motor is not seen to run, and this command would repeat a run command")
        }
        (_, _, Motor::Stands | Motor::NotShown) => WithoutRun,
    }
}

/// Whether the verdict depends on the state of the motor.
pub(super) fn depends_on_motor(wants: Wants, holds: KnownRun, told: bool) -> bool {
    match (wants, holds) {
        (Wants::ResetEnd, KnownRun::Other | KnownRun::Unknown) => false,
        _ => wants != Wants::Others || !told,
    }
}

fn refused(why: &str) -> Verdict {
    Verdict::Refused(Refusal::NotAllowed(format!(
        "{why}; no control word was written; include `run` true or false in this command"
    )))
}

/// The refusal of an order because the reads before it had no result.
pub(super) fn not_seen(why: &str) -> Refusal {
    Refusal::NotKnown(format!(
        "whether the motor runs was asked right before the control word would have been written, and {why}; the word was not sent"
    ))
}

/// Note on a direction that is kept for the next start.
pub(super) const AT_NEXT_START: &str = "the direction takes effect with the next start: the motor is not seen to run by a run command \
     of this gateway, and no control word was written";

#[cfg(test)]
mod tests {
    use super::*;

    const WANTS: [Wants; 6] = [
        Wants::Direction,
        Wants::DirectionElsewhere,
        Wants::Reset,
        Wants::ResetElsewhere,
        Wants::ResetEnd,
        Wants::Others,
    ];
    const MOTORS: [Motor; 4] = [Motor::Runs, Motor::RunsElsewise, Motor::Stands, Motor::NotShown];
    const HELD: [KnownRun; 3] = [KnownRun::Run, KnownRun::Other, KnownRun::Unknown];

    /// Letters: r with the present run command, w without run, n at the next start, x refused, ? refused as
    /// unknown. One column for each entry of `WANTS`.
    const TABLE: &str = "\
        Run     told Runs         r r r r r r
        Run     told RunsElsewise r r r r r r
        Run     told Stands       n n w w w r
        Run     told NotShown     n n w w w r
        Run     kept Runs         r r r r r r
        Run     kept RunsElsewise n n x x w x
        Run     kept Stands       n n w w w x
        Run     kept NotShown     n n w w w x
        Other   told Runs         n r x x w r
        Other   told RunsElsewise n n x x w r
        Other   told Stands       w n w w w r
        Other   told NotShown     w n w w w r
        Other   kept Runs         n r x x w x
        Other   kept RunsElsewise n n x x w x
        Other   kept Stands       w n w w w w
        Other   kept NotShown     w n w w w w
        Unknown kept Runs         ? r ? r w ?
        Unknown kept RunsElsewise n n x x w x
        Unknown kept Stands       w n w w w w
        Unknown kept NotShown     w n w w w w";

    #[test]
    fn what_an_order_without_run_may_write() {
        let mut rows = 0;
        for row in TABLE.lines() {
            let mut cells = row.split_whitespace();
            let mut cell = || cells.next().unwrap();
            let (holds, told, motor) = (cell(), cell() == "told", cell());
            let holds = HELD.into_iter().find(|of| format!("{of:?}") == holds).unwrap();
            let motor = MOTORS.into_iter().find(|of| format!("{of:?}") == motor).unwrap();
            for (wants, expected) in WANTS.into_iter().zip(cells) {
                let verdict = match judge(wants, holds, told, motor) {
                    Verdict::AsItStands => "r",
                    Verdict::WithoutRun => "w",
                    Verdict::AtNextStart => "n",
                    Verdict::Refused(Refusal::NotKnown(_)) => "?",
                    Verdict::Refused(_) => "x",
                };
                assert_eq!(verdict, expected, "{wants:?} {holds:?} told: {told} {motor:?}");
                rows += 1;
            }
        }
        assert_eq!(rows, 6 * 20);
    }

    /// In all cases in which no read is made, the verdict does not depend on the motor.
    #[test]
    fn a_look_is_spared_only_where_it_decides_nothing() {
        for (wants, holds) in WANTS.into_iter().flat_map(|wants| HELD.map(|holds| (wants, holds))) {
            for told in [true, false]
                .into_iter()
                .filter(|told| !told || holds != KnownRun::Unknown)
            {
                let all = MOTORS.map(|motor| judge(wants, holds, told, motor));
                let same = all.iter().all(|verdict| *verdict == all[0]);
                assert_eq!(
                    same,
                    !depends_on_motor(wants, holds, told),
                    "{wants:?} {holds:?} {told}"
                );
            }
        }
    }

    /// For every kind of order, a run command from memory is only sent to a motor that is seen to run.
    #[test]
    fn no_run_command_from_memory_reaches_a_motor_that_is_not_seen_to_run() {
        for wants in WANTS {
            for motor in [Motor::RunsElsewise, Motor::Stands, Motor::NotShown] {
                let verdict = judge(wants, KnownRun::Run, false, motor);
                assert_ne!(verdict, Verdict::AsItStands, "{wants:?} {motor:?}");
            }
        }
    }
}
