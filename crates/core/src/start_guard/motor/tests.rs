use super::*;

/// A simulated motor and its time.
struct Play {
    motor: Motor,
    began: Instant,
    number: u64,
}

impl Play {
    fn new() -> Play {
        Play {
            motor: Motor::default(),
            began: Instant::now(),
            number: 0,
        }
    }

    fn at(&self, seconds: f64) -> Instant {
        self.began + Duration::from_secs_f64(seconds)
    }

    /// Lets a run order pass the guard and writes it; returns its effect.
    fn run(&mut self, now: Instant) -> ByRun {
        let by_run = self.motor.by_run();
        self.number += 1;
        if by_run == ByRun::Starts {
            self.motor.reserve(Reserved {
                number: self.number,
                at: now,
                until: now,
                generation: 0,
            });
        }
        self.motor.start_written(self.number, &Arc::from("plc"), now);
        by_run
    }

    /// Processes a reading: `+` and `-` mean that the drive has its run command or not; without them the drive does
    /// not report it.
    fn read(&mut self, what: &str, at: Instant) {
        let commanded = what.ends_with(['+', '-']).then(|| (what.ends_with('+'), at));
        let state = what.trim_end_matches(['+', '-']);
        let unable = match state {
            "fault" => Some((Unable::Fault, at)),
            "unready" => Some((Unable::NotReady, at)),
            _ => None,
        };
        assert!(
            ["runs", "turns", "stands", "fault", "unready"].contains(&state),
            "{what}"
        );
        self.motor.seen(MotorReading {
            running: state == "runs",
            commanded,
            stands: !["runs", "turns"].contains(&state),
            unable,
            at,
        });
    }

    /// Plays steps of the form `1.5 what`; a run order also states its expected effect.
    fn play(&mut self, about: &str, steps: &str) {
        for step in steps.split(", ") {
            let (seconds, what) = step.split_once(' ').unwrap();
            let now = self.at(seconds.parse().unwrap());
            match what {
                "stop" => self.motor.stop_written(now),
                "away" => self.motor.note_offline(),
                "unseen" => self.motor.unseen(),
                _ => match what.strip_prefix("run:") {
                    Some(expected) => {
                        let is = format!("{:?}", self.run(now)).to_lowercase();
                        assert_eq!(is, expected, "{about}: at {seconds} s");
                    }
                    None => self.read(what, now),
                },
            }
        }
    }
}

#[test]
fn a_start_counts_once_a_passage() {
    for (about, steps, counted) in [
        (
            "repeated before it is read that the motor runs",
            "0 stands, 1 run:starts, 1.1 run:repeats, 1.2 stands, 1.3 run:repeats, 1.5 runs, 1.6 run:runs, 9 run:runs",
            1,
        ),
        (
            "repeated while the motor accelerates and is not said to run",
            "0 stands, 1 run:starts, 1.2 turns, 1.3 run:repeats, 5 turns, 5.1 run:repeats, 6 runs, 6.1 run:runs",
            1,
        ),
        (
            "it starts late, and is repeated all the while",
            "0 stands, 1 run:starts, 1.7 stands, 1.8 run:repeats, 2.6 stands, 2.7 run:repeats, 3.5 stands, 3.6 run:repeats, \
             4 runs",
            1,
        ),
        (
            "behind its own stop, or that of anyone else",
            "0 stands, 1 run:starts, 1.2 runs, 2 stop, 2.1 run:starts",
            2,
        ),
        (
            "the same before anything was read",
            "0 stands, 1 run:starts, 1.1 stop, 1.2 run:starts",
            2,
        ),
        (
            "while it slows down behind a stop",
            "0 stands, 1 run:starts, 1.1 runs, 2 stop, 2.1 turns, 2.2 run:starts",
            2,
        ),
        (
            "the drive did not take the stop",
            "0 stands, 1 run:starts, 1.1 runs+, 2 stop, 2.1 runs+, 2.2 run:runs",
            1,
        ),
        (
            "it was stopped at the drive, and slows down",
            "0 stands, 1 run:starts, 1.1 runs+, 2 runs-, 2.1 run:starts",
            2,
        ),
        (
            "it was seen to stand again",
            "0 stands, 1 run:starts, 1.1 runs, 2 stands, 2.1 run:starts",
            2,
        ),
        (
            "it tripped",
            "0 stands, 1 run:starts, 1.1 runs, 2 fault, 2.1 run:starts, 2.2 fault, 2.3 run:vain, 9 stands, 9.1 run:starts, \
             9.2 runs",
            2,
        ),
        (
            "it tripped before it was seen to run",
            "0 stands, 1 run:starts, 1.1 fault, 1.2 run:starts, 1.3 fault, 1.4 run:vain",
            1,
        ),
        (
            "nothing shows what became of the first one",
            "0 stands, 1 run:starts, 1.1 stands, 2.1 stands, 2.2 run:starts",
            2,
        ),
        (
            "the drive has no run command: it did not take the first one",
            "0 stands, 1 run:starts, 1.1 stands-, 1.2 run:repeats, 2.3 stands-, 2.4 run:starts",
            2,
        ),
        (
            "the drive has its run command, and stands at a reference of zero",
            "0 stands, 1 run:starts, 2.5 stands+, 3 run:repeats, 20 stands+, 21 run:repeats, 22 runs, 23 run:runs",
            1,
        ),
        (
            "the drive was away",
            "0 stands, 1 run:starts, 1.1 away, 2 run:starts",
            2,
        ),
        (
            "the drive was away, and runs",
            "0 stands, 1 run:starts, 1.1 away, 3 runs",
            1,
        ),
        (
            "the drive was away, and was started later",
            "0 stands, 1 run:starts, 1.1 away, 33 stands, 34 runs",
            2,
        ),
        (
            "a reading is missing",
            "0 stands, 1 run:starts, 1.1 runs, 2 unseen, 2.1 run:repeats, 3 runs, 3.1 run:runs",
            1,
        ),
        ("at the panel", "0 stands, 1 runs, 2 run:runs, 3 stands, 4 runs", 2),
        ("it ran when it was read first", "0 runs, 1 run:runs", 0),
        (
            "at the panel behind an order",
            "0 stands, 1 run:starts, 1.1 runs, 2 stands, 3 runs",
            2,
        ),
    ] {
        let mut play = Play::new();
        play.play(about, steps);
        assert_eq!(play.motor.starts().count(), counted, "{about}");
    }
}

#[test]
fn one_to_a_drive_that_cannot_start_is_none_until_that_ends() {
    for (about, steps, counted) in [
        (
            "held at a drive with a fault",
            "0 fault, 1 run:starts, 1.1 run:repeats, 1.2 fault, 1.3 run:vain, 2 run:vain, 60 fault, 61 run:vain",
            0,
        ),
        (
            "until the fault ends",
            "0 fault, 1 run:starts, 1.2 fault, 1.3 run:vain, 5 stands, 5.1 run:starts, 5.2 run:repeats, 5.3 runs",
            1,
        ),
        (
            "the run command that stands starts it when the fault ends",
            "0 fault, 1 run:starts, 1.2 fault, 1.3 run:vain, 5 runs, 5.1 run:runs",
            1,
        ),
        (
            "given and taken away by turns",
            "0 fault, 1 run:starts, 1.1 fault, 1.2 stop, 1.3 run:starts, 1.4 fault, 1.5 stop, 1.6 run:starts, 1.7 fault",
            0,
        ),
        (
            "not ready",
            "0 unready, 1 run:starts, 1.5 unready, 1.6 run:repeats, 2 unready, 2.1 run:vain, 9 unready, 9.1 run:vain",
            0,
        ),
        (
            "not ready, until it is",
            "0 unready, 1 run:starts, 2 unready, 2.1 run:vain, 3 stands, 3.1 run:starts, 3.2 runs",
            1,
        ),
        (
            "the words of the start make it ready",
            "0 unready, 1 run:starts, 1.1 unready, 1.2 runs, 1.3 run:runs",
            1,
        ),
        (
            "the same, and it trips",
            "0 unready, 1 run:starts, 1.1 stands, 1.2 fault, 1.3 run:starts",
            2,
        ),
        (
            "the fault ended before it was written",
            "0 fault, 1 run:starts, 1.1 stands, 1.2 fault, 1.3 fault",
            1,
        ),
    ] {
        let mut play = Play::new();
        play.play(about, steps);
        assert_eq!(play.motor.starts().count(), counted, "{about}");
    }
}

#[test]
fn what_was_in_vain_leaves_the_time_that_the_motor_stands() {
    let guard = Guard {
        min_off: Duration::from_secs(30),
        ..Guard::default()
    };
    let mut play = Play::new();
    play.play("trip", "0 stands, 1 run:starts, 1.1 runs, 10 fault, 40 fault");
    let refused = |play: &Play, seconds| play.motor.hindered(&guard, play.at(seconds)).map(|wait| wait.reason);
    assert_eq!(
        (refused(&play, 39.9), refused(&play, 40.0)),
        (Some(Reason::MinOff), None)
    );
    play.play("held", "41 run:starts, 41.1 fault, 41.2 run:vain, 50 stands");
    assert_eq!(refused(&play, 50.0), None, "it has stood since 10 s");
}

#[test]
fn a_motor_that_starts_long_after_its_word_counts_from_then() {
    let mut play = Play::new();
    play.play(
        "enabled at a terminal",
        "0 stands, 1 run:starts, 2 stands+, 300 stands+, 600 runs+",
    );
    assert_eq!(play.motor.starts().collect::<Vec<_>>(), [play.at(600.0)]);
    assert!(play.motor.is_ordinary_stop("plc", None), "its client started it");
}
