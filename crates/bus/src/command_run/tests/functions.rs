//! Drives that take only functions 15 and 16, and bits of registers that hold other settings.

use super::*;

const SETTINGS: u16 = 299;

/// A drive that knows only these write functions; it records its requests as function and value.
struct Drive {
    knows: &'static [u8],
    word: u16,
    asked: Vec<(u8, u16)>,
}

impl Drive {
    fn new(knows: &'static [u8]) -> Drive {
        Drive {
            knows,
            word: 0,
            asked: Vec::new(),
        }
    }

    fn answer(&mut self, pdu: &RequestPdu) -> Reply {
        let value = match pdu {
            RequestPdu::WriteRegister { value, .. } => *value,
            RequestPdu::WriteRegisters { values, .. } => values[0],
            RequestPdu::WriteCoil { on, .. } => u16::from(*on),
            RequestPdu::WriteCoils { bits, .. } => u16::from(bits[0]),
            RequestPdu::MaskWrite { and_mask, or_mask, .. } => (self.word & and_mask) | (or_mask & !and_mask),
            _ => self.word,
        };
        self.asked.push((pdu.function(), value));
        match pdu {
            RequestPdu::Read { .. } => Reply::Registers(vec![self.word]),
            _ if !self.knows.contains(&pdu.function()) => Reply::Exception(Exception::FUNCTION),
            _ => {
                self.word = value;
                Reply::Written
            }
        }
    }

    /// Answers a command to its end; returns the requests meanwhile.
    fn carries_out(&mut self, bench: &mut ObedientDrive, mut run: CommandRun) -> (Vec<(u8, u16)>, Outcome) {
        self.asked.clear();
        for _ in 0..20 {
            match run.next(&bench.words, &bench.profile, bench.running, bench.now) {
                Next::Done => return (self.asked.clone(), run.success()),
                Next::Wait(until) => bench.now = until,
                Next::Send(step) => {
                    run.sent(&step);
                    let reply = self.answer(&step.pdu);
                    if let Some(outcome) = run.answered(&step, reply, &mut bench.words) {
                        return (self.asked.clone(), outcome);
                    }
                }
            }
        }
        panic!("the command does not end: {:?}", self.asked);
    }
}

fn profile(text: &str) -> Arc<Profile> {
    let head = "name = \"own\"\nprotocols = [\"modbus-rtu\"]\nbase = \"vacon-nx\"\n";
    Arc::new(Profile::parse("own.toml", &format!("{head}{text}"), false).unwrap())
}

fn stop(bench: &ObedientDrive) -> CommandRun {
    bench.begin(&[("run", 0.0)], Urgency::Stop).0
}

#[test]
fn a_drive_that_takes_only_function_16_is_stopped_and_remembered() {
    let (mut bench, mut drive) = (ObedientDrive::new(1), Drive::new(&[16]));
    drive.word = 1;
    let run = stop(&bench);
    let (asked, outcome) = drive.carries_out(&mut bench, run);
    assert_eq!(asked, [(3, 1), (6, 0), (16, 0)]);
    assert!(outcome.is_ok(), "{outcome:?}");
    for points in [&[("run", 1.0)][..], &[("run", 0.0)], &[("speed_reference", 0.07)]] {
        let run = bench.begin(points, Urgency::Command).0;
        let (asked, outcome) = drive.carries_out(&mut bench, run);
        assert_eq!((asked.len(), asked[0].0, outcome.is_ok()), (1, 16, true), "{points:?}");
    }
    // The drive restarts, and is the same machine as before.
    bench.words.forget();
    let run = stop(&bench);
    let (asked, _) = drive.carries_out(&mut bench, run);
    assert!(matches!(asked.last(), Some((16, word)) if word & 1 == 0), "{asked:?}");
    // After another drive has replaced it, function 06 works again.
    let mut drive = Drive::new(&[6]);
    let run = stop(&bench);
    let (asked, outcome) = drive.carries_out(&mut bench, run);
    assert!(outcome.is_ok(), "{outcome:?}");
    let stops = |(function, word): &(u8, u16)| (*function, word & 1);
    assert_eq!(asked.iter().map(stops).collect::<Vec<_>>(), [(16, 0), (6, 0)]);
}

#[test]
fn a_drive_that_takes_neither_is_asked_once_each() {
    let (mut bench, mut drive) = (ObedientDrive::new(1), Drive::new(&[]));
    bench.words.learn(Table::Holding, 2000, 1);
    for _ in 0..2 {
        let run = stop(&bench);
        let (asked, outcome) = drive.carries_out(&mut bench, run);
        assert_eq!(asked, [(6, 0), (16, 0)]);
        assert_eq!(outcome, Outcome::Exception(Exception::FUNCTION));
    }
}

#[test]
fn the_profile_may_say_it() {
    let (mut bench, mut drive) = (ObedientDrive::new(1), Drive::new(&[16]));
    bench.profile = profile("ranges = { single_write = 16 }");
    drive.word = 1;
    let run = stop(&bench);
    let (asked, outcome) = drive.carries_out(&mut bench, run);
    assert_eq!((asked, outcome.is_ok()), (vec![(3, 1), (16, 0)], true));
    // The drive accepts only function 15 for coils.
    let mut drive = Drive::new(&[15]);
    bench.profile = Profiles::built_in().get("vacon-cx").unwrap().clone();
    let run = stop(&bench);
    assert_eq!(drive.carries_out(&mut bench, run).0, [(5, 0), (15, 0)]);
    let mut own = (*bench.profile).clone();
    own.functions.coils_by_15 = true;
    (bench.profile, bench.words) = (Arc::new(own), KnownWords::default());
    let run = stop(&bench);
    assert_eq!(drive.carries_out(&mut bench, run).0, [(15, 0)]);
}

fn settings(more: &str) -> ObedientDrive {
    let mut bench = ObedientDrive::new(0);
    let point =
        format!("[[point]]\nname = \"restarts\"\nat = \"holding {SETTINGS}.2\"\nclass = \"once\"\nwrite = true\n");
    bench.profile = profile(&format!("{more}\n{point}"));
    // The known value dates from when the drive came online.
    bench.words.learn(Table::Holding, SETTINGS, 0x0001);
    bench
}

fn sets(bench: &ObedientDrive, on: f64) -> CommandRun {
    bench.begin(&[("restarts", on)], Urgency::Command).0
}

#[test]
fn a_settings_register_is_read_before_one_bit_of_it_is_written() {
    let (mut bench, mut drive) = (settings(""), Drive::new(&[6]));
    drive.word = 0x0130;
    let mut run = sets(&bench, 1.0);
    let read = sends(&bench, &mut run);
    assert_eq!(read.purpose, StepPurpose::ReadWord);
    let reply = drive.answer(&read.pdu);
    assert_eq!(run.answered(&read, reply, &mut bench.words), None);
    assert!(run.is_checked(), "the write goes next on the line");
    // Another request was sent first, so the register is read again.
    run.others_go_first();
    drive.word = 0x0230;
    let (asked, outcome) = drive.carries_out(&mut bench, run);
    assert_eq!(asked, [(3, 0x0230), (6, 0x0234)]);
    assert!(outcome.is_ok());
    // The register is read each time, even right after its own write.
    drive.word = 0x0004;
    let run = sets(&bench, 0.0);
    assert_eq!(drive.carries_out(&mut bench, run).0, [(3, 0x0004), (6, 0)]);
    // The other bits of the control word come from the known word.
    bench.words.learn(Table::Holding, 2000, 0x0100);
    let run = bench.begin(&[("run", 1.0)], Urgency::Command).0;
    assert_eq!(drive.carries_out(&mut bench, run).0, [(6, 0x0101)]);
}

#[test]
fn a_settings_register_that_is_not_told_is_not_written() {
    for running in [false, true] {
        let mut bench = settings("");
        bench.running = running;
        let mut run = sets(&bench, 1.0);
        let read = sends(&bench, &mut run);
        let refused = Reply::Exception(Exception::ADDRESS);
        let ended = run.answered(&read, refused, &mut bench.words);
        assert_eq!(ended, Some(Outcome::Exception(Exception::ADDRESS)));
        let mut run = sets(&bench, 1.0);
        assert_eq!(run.failed(&read, Outcome::TimedOut, 1), None);
        assert_eq!(sends(&bench, &mut run), read);
        assert_eq!(run.failed(&read, Outcome::TimedOut, 1), Some(Outcome::TimedOut));
    }
}

#[test]
fn a_drive_with_function_22_changes_the_bit_itself() {
    let (mut bench, mut drive) = (settings("ranges = { mask_write = true }"), Drive::new(&[6, 22]));
    drive.word = 0x0130;
    let run = sets(&bench, 1.0);
    let (asked, outcome) = drive.carries_out(&mut bench, run);
    assert_eq!((asked, outcome.is_ok()), (vec![(22, 0x0134)], true));
    let run = sets(&bench, 0.0);
    assert_eq!(drive.carries_out(&mut bench, run).0, [(22, 0x0130)]);
    // A drive that does not have function 22 although its profile says so.
    let (mut bench, mut drive) = (settings("ranges = { mask_write = true }"), Drive::new(&[6]));
    drive.word = 0x0130;
    for on in [1.0, 0.0] {
        let run = sets(&bench, on);
        let (asked, outcome) = drive.carries_out(&mut bench, run);
        let word = if on == 1.0 { 0x0134 } else { 0x0130 };
        assert!(
            outcome.is_ok() && asked.ends_with(&[(3, word ^ 4), (6, word)]),
            "{asked:?}"
        );
        assert_eq!(asked.len(), if on == 1.0 { 3 } else { 2 }, "refused once");
    }
}
