//! Whether the drive stands as an order takes it to stand: an order that does not itself say whether the motor is to run
//! repeats the run command of the drive's word only to a motor that runs by it.
//!
//! A drive that restarted, or was stopped at its panel, has lost its run command: the remembered word would start its
//! motor. Where the answer depends on that, the motor is read in the same command, right before the word is written.
//!
//! The rule is evaluated only when a word is about to be sent: what the drive shows earlier may have changed by then. Stops
//! and the ends of resets are always sent; the same table then decides only which run command their words contain.

use crate::order::Refusal;
use crate::permit::gate::{DriveGate, Gate};
use crate::permit::judge::{Ask, Rule, Stage, Verdict};

pub(in crate::permit) const RULE: Rule = Rule {
    stages: &[Stage::Write],
    binds_stops: false,
    judge,
};

/// State of the motor as the drive reported it during this command, right before the write.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Motor {
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
pub enum KnownRun {
    /// The run command of the word is set.
    Run,
    /// The word is neither a run command nor a stop.
    Other,
    /// The word is not known.
    Unknown,
}

/// Kind of a write that does not decide whether the motor is to run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Wants {
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

/// Effect of the write on a motor that keeps its run command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OnRunning {
    /// The motor keeps running.
    Harmless,
    /// The reset takes the run command away.
    Stops,
    /// The reset starts a motor that has tripped meanwhile.
    Restarts,
}

/// What the next word of an order would repeat of the drive's word, which is not known to be a stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Repeats {
    /// Kind of the write.
    pub wants: Wants,
    /// The run command that the word would repeat.
    pub holds: KnownRun,
    /// Whether the drive itself reported its word during this command; the word of a running drive is then current,
    /// whichever client commands it.
    pub told: bool,
    /// State of the motor; `None` if it was not read during this command.
    pub motor: Option<Motor>,
    /// Effect of the write on a running motor.
    pub on_running: OnRunning,
}

/// How a word is formed from the drive's word.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// The word is written with its present run command.
    AsItStands,
    /// The word is written without a run command.
    WithoutRun,
    /// Nothing is written: the direction is kept for the next start.
    AtNextStart,
}

/// Note on a direction that is kept for the next start.
pub const AT_NEXT_START: &str = "the direction takes effect with the next start: the motor is not seen to run by a run command \
     of this gateway, and no control word was written";
const STOPS_BY_RESET: &str = "the motor is running, and on this family a reset would stop it; nothing was written";
const RESTARTS_ON_RESET: &str = "the motor is running, and on this family a reset starts a motor that has tripped meanwhile; \
     nothing was written";

fn judge(ask: &Ask<'_>, _: &DriveGate, _: &Gate) -> Verdict {
    let repeats = ask.seen.and_then(|seen| seen.repeats);
    repeats.map_or(Verdict::Go, Repeats::verdict)
}

impl Repeats {
    /// The decision of the rule.
    pub fn verdict(self) -> Verdict {
        match self.motor {
            None if self.depends_on_motor() => Verdict::LookFirst,
            _ => Verdict::unless(self.formed().err()),
        }
    }

    /// How the word is formed. A word that the rule does not permit has no run command.
    pub fn form(self) -> Form {
        self.formed().unwrap_or(Form::WithoutRun)
    }

    /// How the word may be formed, from what is known of the motor.
    fn formed(self) -> Result<Form, Refusal> {
        let form = self.by_motor()?;
        match self.on_running {
            OnRunning::Stops if form == Form::AsItStands => Err(Refusal::NotAllowed(STOPS_BY_RESET.to_string())),
            OnRunning::Restarts if form == Form::AsItStands => Err(Refusal::NotAllowed(RESTARTS_ON_RESET.to_string())),
            OnRunning::Harmless | OnRunning::Stops | OnRunning::Restarts => Ok(form),
        }
    }

    fn by_motor(self) -> Result<Form, Refusal> {
        use Form::{AsItStands, AtNextStart, WithoutRun};

        let Repeats { wants, holds, told, .. } = self;
        let motor = match self.motor.unwrap_or(Motor::NotShown) {
            Motor::RunsElsewise if told && holds == KnownRun::Run => Motor::Runs,
            motor => motor,
        };
        match (wants, holds, motor) {
            (Wants::Others, KnownRun::Run | KnownRun::Other, _) if told => Ok(AsItStands),
            (Wants::ResetElsewhere, KnownRun::Unknown, Motor::Runs) => Ok(AsItStands),
            (Wants::ResetEnd, KnownRun::Unknown | KnownRun::Other, _) => Ok(WithoutRun),
            (Wants::DirectionElsewhere, _, Motor::Runs) | (_, KnownRun::Run, Motor::Runs) => Ok(AsItStands),
            (Wants::DirectionElsewhere, ..) | (Wants::Direction, KnownRun::Run, _) => Ok(AtNextStart),
            (Wants::ResetEnd, KnownRun::Run, _) => Ok(WithoutRun),
            (_, KnownRun::Unknown, Motor::Runs) => Err(Refusal::NotKnown(
                "the last command to the drive is unknown; include `run` true or false in this command".to_string(),
            )),
            (Wants::Direction, _, Motor::Runs | Motor::RunsElsewise) => Ok(AtNextStart),
            (_, _, Motor::Runs | Motor::RunsElsewise) => {
                refused("the motor runs, but by no run command of this gateway")
            }
            (Wants::Others, KnownRun::Run, Motor::Stands | Motor::NotShown) => {
                refused("the motor is not seen to run, and this command would repeat a run command")
            }
            (_, _, Motor::Stands | Motor::NotShown) => Ok(WithoutRun),
        }
    }

    /// Whether the decision depends on the state of the motor.
    fn depends_on_motor(self) -> bool {
        match (self.wants, self.holds) {
            (Wants::ResetEnd, KnownRun::Other | KnownRun::Unknown) => false,
            _ => self.wants != Wants::Others || !self.told,
        }
    }
}

fn refused(why: &str) -> Result<Form, Refusal> {
    Err(Refusal::NotAllowed(format!(
        "{why}; no control word was written; include `run` true or false in this command"
    )))
}

/// The refusal of an order because the reads before it had no result.
pub fn not_seen(why: &str) -> Refusal {
    Refusal::NotKnown(format!(
        "whether the motor runs was asked right before the control word would have been written, and {why}; the word was not sent"
    ))
}

/// Judges the write of a parameter, by whether the motor was seen to run in the same command; `None` if the drive's reply
/// does not show that.
///
/// # Errors
/// If the motor is not seen at standstill; contains the refusal.
pub fn parameter(runs: Option<bool>) -> Result<(), Refusal> {
    match runs {
        Some(false) => Ok(()),
        Some(true) | None => Err(Refusal::MotorRuns(
            "the motor is running, and parameters are written only while it is stopped; nothing was written"
                .to_string(),
        )),
    }
}

/// The refusal of a parameter write because the family does not report whether the motor is stopped.
pub fn running_unknown(profile: &str) -> Refusal {
    Refusal::NotWritable(format!(
        "profile `{profile}` does not say where the drive reports whether its motor runs; no parameter is written"
    ))
}

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

    fn repeats(wants: Wants, holds: KnownRun, told: bool, motor: Option<Motor>) -> Repeats {
        Repeats {
            wants,
            holds,
            told,
            motor,
            on_running: OnRunning::Harmless,
        }
    }

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
                let of_row = repeats(wants, holds, told, Some(motor));
                let form = match of_row.formed() {
                    Ok(Form::AsItStands) => "r",
                    Ok(Form::WithoutRun) => "w",
                    Ok(Form::AtNextStart) => "n",
                    Err(Refusal::NotKnown(_)) => "?",
                    Err(_) => "x",
                };
                assert_eq!(form, expected, "{of_row:?}");
                let goes = of_row.verdict() == Verdict::Go;
                assert_eq!(goes, !["?", "x"].contains(&expected), "{of_row:?}");
                assert!(goes || of_row.form() == Form::WithoutRun, "{of_row:?}");
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
                let all = MOTORS.map(|motor| repeats(wants, holds, told, Some(motor)).formed());
                let same = all.iter().all(|formed| *formed == all[0]);
                let asked = repeats(wants, holds, told, None).verdict() == Verdict::LookFirst;
                assert_eq!(same, !asked, "{wants:?} {holds:?} {told}");
            }
        }
    }

    /// For every kind of order, a run command from memory is only sent to a motor that is seen to run.
    #[test]
    fn no_run_command_from_memory_reaches_a_motor_that_is_not_seen_to_run() {
        for wants in WANTS {
            for motor in [
                None,
                Some(Motor::RunsElsewise),
                Some(Motor::Stands),
                Some(Motor::NotShown),
            ] {
                let from_memory = repeats(wants, KnownRun::Run, false, motor);
                assert_ne!(from_memory.form(), Form::AsItStands, "{from_memory:?}");
            }
        }
    }

    /// A reset that would stop or restart a running motor is refused; at standstill nothing hinders it.
    #[test]
    fn a_reset_does_not_change_a_running_motor() {
        for (on_running, why) in [
            (OnRunning::Stops, "a reset would stop it"),
            (OnRunning::Restarts, "a reset starts a motor"),
        ] {
            let of = |motor| Repeats {
                on_running,
                ..repeats(Wants::Reset, KnownRun::Run, true, Some(motor))
            };
            let refused = of(Motor::Runs).formed().unwrap_err();
            assert!(refused.to_string().contains(why), "{refused}");
            assert_eq!(of(Motor::Stands).formed(), Ok(Form::WithoutRun));
        }
    }
}
