//! Line diagnosis: each cause on a simulated line, and lines without faults.

use std::collections::BTreeSet;
use std::time::Duration;

use drivegate_core::diagnosis::Cause;
use drivegate_proto::Protocol;
use drivegate_sim::faults::FaultPlan;
use drivegate_sim::half_duplex::Delivery;

use super::bus::Parts;
use super::number;
use super::rig::{Rig, line};
use super::scenario::Line;

const SECOND: Duration = Duration::from_secs(1);
/// Time within which each cause must be reported.
const TOLD: Duration = Duration::from_secs(60);

/// When the drive is started in cases where a running drive disturbs the line.
const RUNS_FROM: Duration = Duration::from_secs(20);

/// Reported causes, each with the address of its drive (0: none).
type Told = BTreeSet<(Cause, u8)>;

/// The lines of the usual tests.
fn lines() -> [Line; 3] {
    [
        line("vacon-nx", Protocol::ModbusRtu, 38_400, 6),
        line("teco-7300pa", Protocol::ModbusAscii, 19_200, 5),
        line("vacon-nx-n2", Protocol::N2, 9600, 5),
    ]
}

/// A cause, and the expected report on a line with a number of drives.
struct Case {
    name: &'static str,
    faults: fn(u8, u64) -> FaultPlan,
    parts: fn(&mut Parts),
    told: fn(u8) -> Vec<(Cause, u8)>,
    /// Whether a drive runs from [`RUNS_FROM`] on.
    runs: bool,
}

fn plan(rates: &str, seed: u64) -> FaultPlan {
    FaultPlan::new(rates.parse().unwrap(), seed)
}

fn case(name: &'static str, faults: fn(u8, u64) -> FaultPlan, told: fn(u8) -> Vec<(Cause, u8)>) -> Case {
    let (parts, runs) = (|_: &mut Parts| {}, false);
    Case {
        name,
        faults,
        parts,
        told,
        runs,
    }
}

fn cases() -> Vec<Case> {
    let nothing = |_, seed| plan("", seed);
    vec![
        case(
            "one drive",
            |_, seed| plan("corrupt=0.15,drop=0.15", seed).only(&[3]),
            |_| vec![(Cause::OneDrive, 3)],
        ),
        case(
            "one drive late",
            |_, seed| plan("late:150ms=0.2,late:600ms=0.2", seed).only(&[2]),
            |_| vec![(Cause::OneDrive, 2)],
        ),
        case(
            "from an address on",
            |drives, seed| plan("corrupt=0.15,drop=0.1", seed).only(&(drives - 1..=drives).collect::<Vec<u8>>()),
            |_| vec![(Cause::FromAddress, 0)],
        ),
        case(
            "twice",
            |_, seed| plan("twin=1", seed).only(&[2]),
            |_| vec![(Cause::AddressTwice, 2)],
        ),
        Case {
            runs: true,
            ..case(
                "running",
                |_, seed| plan("corrupt=0.1,drop=0.1", seed).while_running(),
                |_| vec![(Cause::WhileRunning, 0)],
            )
        },
        case(
            "mains 50",
            |_, seed| plan("mains:50=0.5", seed),
            |_| vec![(Cause::Mains, 0)],
        ),
        case(
            "mains 60",
            |_, seed| plan("mains:60=0.5", seed),
            |_| vec![(Cause::Mains, 0)],
        ),
        case(
            "zero before",
            |_, seed| plan("zero-before=0.2", seed),
            |_| vec![(Cause::Bias, 0)],
        ),
        case(
            "idle noise",
            |_, seed| plan("idle-noise=0.1", seed),
            |_| vec![(Cause::Bias, 0)],
        ),
        case(
            "reply start",
            |_, seed| plan("reply-start=0.2", seed),
            |_| vec![(Cause::ReplyStartLost, 0)],
        ),
        case(
            "request end",
            |_, seed| plan("cut-request=0.1", seed),
            |_| vec![(Cause::RequestEndLost, 0)],
        ),
        case(
            "request end heard",
            |_, seed| plan("cut-echo=0.2", seed),
            |_| vec![(Cause::RequestEndLost, 0)],
        ),
        case("echo", |_, seed| plan("echo=1", seed), |_| vec![(Cause::Echo, 0)]),
        Case {
            parts: |parts| parts.delivery = Delivery::Steps(Duration::from_millis(16)),
            ..case("latency", nothing, |_| vec![(Cause::LatencyTimer, 0)])
        },
        case(
            "pause",
            |_, seed| plan("needs-pause:12ms=0.3", seed),
            |_| vec![(Cause::SilenceTooShort, 0)],
        ),
        Case {
            parts: |parts| parts.wire_speed = 3,
            ..case("another baud", nothing, |_| vec![(Cause::FasterThanBaud, 0)])
        },
        case(
            "silent",
            |_, seed| plan("deaf=1", seed),
            |_| vec![(Cause::AllSilent, 0)],
        ),
        case(
            "noise",
            |_, seed| plan("corrupt=0.05,deaf=0.02", seed),
            |_| vec![(Cause::Noise, 0)],
        ),
        case(
            "one drive and echo",
            |_, seed| {
                plan("corrupt=0.12,drop=0.12", seed)
                    .only(&[3])
                    .and(plan("echo=1", seed + 1))
            },
            |_| vec![(Cause::OneDrive, 3), (Cause::Echo, 0)],
        ),
        case(
            "twice and zeros",
            |_, seed| plan("twin=1", seed).only(&[2]).and(plan("zero-before=0.3", seed + 1)),
            |_| vec![(Cause::AddressTwice, 2), (Cause::Bias, 0)],
        ),
        case(
            "one drive and noise",
            |_, seed| {
                plan("corrupt=0.15,drop=0.15", seed)
                    .only(&[3])
                    .and(plan("corrupt=0.03", seed + 1))
            },
            |_| vec![(Cause::OneDrive, 3), (Cause::Noise, 0)],
        ),
        Case {
            parts: |parts| parts.delivery = Delivery::Steps(Duration::from_millis(16)),
            ..case(
                "latency and reply start",
                |_, seed| plan("reply-start=0.2", seed),
                |_| vec![(Cause::LatencyTimer, 0), (Cause::ReplyStartLost, 0)],
            )
        },
    ]
}

fn told(rig: &Rig) -> Told {
    let image = &rig.bus.handle.image;
    let address = |name: &String| image.drives.iter().find(|d| d.spec.name == *name).unwrap().spec.address;
    let diagnosis = image.diagnosis.load();
    diagnosis
        .verdicts
        .iter()
        .map(|one| (one.verdict, one.drive.as_ref().map_or(0, address)))
        .collect()
}

/// Lets time pass; with `runs`, a drive is started in between.
fn pass(rig: &mut Rig, time: Duration, runs: bool, mut each: impl FnMut(&Rig, Duration)) {
    let mut gone = Duration::ZERO;
    while gone < time {
        if runs && gone == RUNS_FROM {
            let order = rig.points(1, &[("run", 1.0)]);
            drop(rig.place(1, order));
        }
        rig.run(SECOND);
        gone += SECOND;
        each(rig, gone);
    }
}

fn run_case(case: &Case, line: &Line, seed: u64) -> Result<Duration, String> {
    let mut parts = Parts::of(0, line, seed);
    parts.faults = (case.faults)(line.drives, seed);
    (case.parts)(&mut parts);
    let mut rig = Rig::new(line, parts);
    let wanted: Told = (case.told)(line.drives).into_iter().collect();
    let (mut came, mut wrong) = (None, None);
    // The cause is there from the beginning, or with the first drive that runs.
    let time = if case.runs { RUNS_FROM + TOLD } else { TOLD };
    pass(&mut rig, time, case.runs, |rig, gone| {
        let told = told(rig);
        if let Some(other) = told.difference(&wanted).next() {
            wrong.get_or_insert((gone, *other));
        }
        if told == wanted {
            came.get_or_insert(gone);
        }
    });
    let name = (case.name, line.protocol.name(), seed);
    let evidence = || -> String {
        let diagnosis = rig.bus.handle.image.diagnosis.load();
        let texts = diagnosis
            .verdicts
            .iter()
            .map(|one| format!("\n    {:?}: {}", one.verdict, one.evidence));
        texts
            .chain(diagnosis.drives.iter().map(|one| format!("\n    {one:?}")))
            .collect()
    };
    match (wrong, came) {
        (Some((gone, wrong)), _) => Err(format!("{name:?}: {wrong:?} after {gone:?}{}", evidence())),
        (None, None) => Err(format!(
            "{name:?}: {:?} instead of {wanted:?}{}",
            told(&rig),
            evidence()
        )),
        (None, Some(came)) => Ok(came),
    }
}

#[test]
fn each_cause_is_told_within_a_minute() {
    let (first, count) = (
        number("DIAGNOSIS_FROM").unwrap_or(1),
        number("DIAGNOSIS_SEEDS").unwrap_or(1),
    );
    let only = std::env::var("DIAGNOSIS_ONLY").ok();
    let mut wrong = Vec::new();
    for line in lines() {
        for case in cases()
            .iter()
            .filter(|case| only.as_ref().is_none_or(|only| case.name.contains(only)))
        {
            for seed in first..first + count {
                match run_case(case, &line, seed) {
                    Ok(came) => println!("{:>12} {:<24} seed {seed}: {came:?}", line.protocol.name(), case.name),
                    Err(text) => {
                        println!("{text}");
                        wrong.push(text);
                    }
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{} of all: {}", wrong.len(), wrong.join("\n"));
}

/// A line without a fault, and incidents that are not faults of the line.
struct Sound {
    name: String,
    line: Line,
    parts: fn(&mut Parts),
    each: fn(&mut Rig, u64),
}

fn sound_lines() -> Vec<Sound> {
    let sound = |name: &str, line: &Line, each: fn(&mut Rig, u64)| Sound {
        name: format!("{} {} {name}", line.family, line.protocol.name()),
        line: line.clone(),
        parts: |_| {},
        each,
    };
    let nothing: fn(&mut Rig, u64) = |_, _| {};
    let mut all = Vec::new();
    for usual in lines() {
        all.push(sound("as it is", &usual, nothing));
        let one_off = Line {
            dead: vec![2],
            ..usual.clone()
        };
        all.push(sound("one off", &one_off, nothing));
        let two_off = Line {
            dead: vec![usual.drives - 1, usual.drives],
            ..usual.clone()
        };
        all.push(sound("the last two off", &two_off, nothing));
        all.push(sound("one restarts", &usual, |rig, second| {
            if second % 150 == 30 || second % 150 == 37 {
                rig.with_drive(3, |drive, now| {
                    if second % 150 == 30 {
                        drive.power_off()
                    } else {
                        drive.power_on(now)
                    }
                });
            }
        }));
        all.push(sound("commands", &usual, |rig, second| {
            let address = 1 + (second % 4) as u8;
            let order = rig.points(
                address,
                &[
                    ("run", f64::from(u8::from(second % 7 < 4))),
                    ("speed_reference", (second % 90) as f64),
                ],
            );
            drop(rig.place(address, order));
        }));
        all.push(sound(
            "rare errors",
            &Line {
                faults: "corrupt=0.0004,drop=0.0004".to_string(),
                ..usual.clone()
            },
            nothing,
        ));
        let slow = Line {
            turnaround: Duration::from_millis(70),
            ..usual.clone()
        };
        all.push(sound("slow replies", &slow, nothing));
        all.push(sound("the port goes once", &usual, |rig, second| match second {
            100 => rig.bus.set_open(false, rig.now),
            104 => rig.bus.set_open(true, rig.now),
            _ => {}
        }));
        for cycle in [16, 20, 40, 50, 80, 400, 1000] {
            let paced = Line {
                cycle: Duration::from_millis(cycle),
                drives: 3,
                ..usual.clone()
            };
            all.push(sound(&format!("every {cycle} ms"), &paced, nothing));
        }
        all.push(Sound {
            parts: |parts| parts.delivery = Delivery::Chunks(14),
            ..sound("in chunks", &usual, nothing)
        });
    }
    for (family, protocol, baud, drives) in [
        ("vacon-nx", Protocol::ModbusRtu, 115_200, 32),
        ("vacon-nx", Protocol::ModbusRtu, 9600, 1),
        ("eaton-svx", Protocol::ModbusRtu, 19_200, 10),
        ("eaton-hvx", Protocol::ModbusRtu, 19_200, 4),
        ("vacon-cx", Protocol::ModbusRtu, 9600, 4),
        ("teco-7300pa", Protocol::ModbusRtu, 19_200, 4),
        ("eaton-hvx-n2", Protocol::N2, 9600, 10),
        ("teco-7300pa-n2", Protocol::N2, 9600, 16),
    ] {
        all.push(sound("as it is", &line(family, protocol, baud, drives), nothing));
    }
    all
}

#[test]
fn nothing_is_told_of_a_sound_line() {
    let minutes = number("DIAGNOSIS_MINUTES").unwrap_or(10);
    let only = std::env::var("DIAGNOSIS_ONLY").ok();
    let mut wrong = Vec::new();
    for sound in sound_lines()
        .iter()
        .filter(|sound| only.as_ref().is_none_or(|only| sound.name.contains(only)))
    {
        let mut parts = Parts::of(0, &sound.line, 5);
        (sound.parts)(&mut parts);
        let mut rig = Rig::new(&sound.line, parts);
        // A drive that was never present is not a fault of the line, and is reported as such.
        let never: Told = sound
            .line
            .dead
            .iter()
            .map(|dead| (Cause::NeverAnswered, *dead))
            .collect();
        for second in 0..minutes * 60 {
            (sound.each)(&mut rig, second);
            rig.run(SECOND);
            let (told, late) = (told(&rig), second > TOLD.as_secs());
            if !told.is_subset(&never) || (late && told != never) {
                let diagnosis = rig.bus.handle.image.diagnosis.load();
                wrong.push(format!(
                    "{} after {second} s: {:?}\n    {:?}",
                    sound.name, diagnosis.verdicts, diagnosis.drives
                ));
                println!("{}", wrong.last().unwrap());
                break;
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn a_drive_that_never_answered_is_told_until_it_answers() {
    for line in lines() {
        let mut rig = Rig::new(&line, Parts::of(0, &line, 5));
        rig.with_drive(2, |drive, _| drive.power_off());
        let never: Told = [(Cause::NeverAnswered, 2)].into();
        rig.run(TOLD);
        assert_eq!(told(&rig), never, "{}", line.family);
        let diagnosis = rig.bus.handle.image.diagnosis.load();
        let verdict = &diagnosis.verdicts[0];
        assert!(
            verdict
                .evidence
                .contains("(address 2) has never answered since the bus was started"),
            "{verdict:?}"
        );
        assert!(verdict.remedy.contains("drivegate scan"), "{verdict:?}");
        // The steps to check are those of this family.
        let lamp = match line.family {
            "teco-7300pa" => "teco-7300pa: LED 3 dark: line, terminals, or no master (inference)",
            family => &format!("{family}: green LED (FS) steady: the board is active and has seen no message yet"),
        };
        assert!(verdict.steps.iter().any(|step| step.starts_with(lamp)), "{verdict:?}");
        // The drive is switched on and off again, so it has answered once.
        rig.with_drive(2, |drive, now| drive.power_on(now));
        rig.run(2 * TOLD);
        assert_eq!(told(&rig), Told::new(), "{}", line.family);
        rig.with_drive(2, |drive, _| drive.power_off());
        rig.run(2 * TOLD);
        assert_eq!(told(&rig), Told::new(), "{}", line.family);
    }
}

/// A Vacon CX counts the damaged messages it receives (function 08): with that the verdict shows which direction is
/// bad.
#[test]
fn a_drive_that_counts_tells_which_direction_is_bad() {
    let evidence = |rates: &str| {
        let mut rig = Rig::new(
            &line("vacon-cx", Protocol::ModbusRtu, 9600, 3),
            Parts {
                faults: plan(rates, 7).only(&[2]),
                ..Parts::of(0, &line("vacon-cx", Protocol::ModbusRtu, 9600, 3), 7)
            },
        );
        let end = rig.now + 200 * SECOND;
        while rig.now < end {
            rig.run(SECOND);
        }
        let diagnosis = rig.bus.handle.image.diagnosis.load_full();
        let of_it = diagnosis
            .verdicts
            .iter()
            .find(|verdict| verdict.verdict == Cause::OneDrive);
        let counted = diagnosis.drives[1].by_drive;
        assert!(counted.is_some_and(|counted| counted.own > 100), "{counted:?}");
        // The counters of a drive on a line without faults are not read.
        assert_eq!(diagnosis.drives[0].by_drive, None);
        of_it.map(|verdict| verdict.evidence.clone()).unwrap_or_default()
    };
    let back = evidence("corrupt=0.2");
    assert!(
        back.contains("the direction from the drive to the gateway is disturbed"),
        "{back}"
    );
}
