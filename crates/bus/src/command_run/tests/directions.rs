//! Stops that name a direction, and resets of drives whose commands are coils.

use super::*;
use drivegate_core::order::written;

fn bench(profile: &str) -> ObedientDrive {
    ObedientDrive {
        profile: Profiles::built_in().get(profile).unwrap().clone(),
        ..ObedientDrive::new(0)
    }
}

/// Carries the command out at a drive that takes every write, reads all coils as set and all registers as 0; its writes.
fn writes(bench: &mut ObedientDrive, points: &[(&str, f64)], urgency: Urgency) -> Vec<RequestPdu> {
    let (mut command, _answer) = bench.begin(points, urgency);
    let mut writes = Vec::new();
    for _ in 0..50 {
        let step = match command.next(&bench.words, &bench.profile, false, bench.now) {
            Next::Done => break,
            Next::Wait(until) => {
                bench.now = until;
                continue;
            }
            Next::Send(step) => step,
        };
        command.sent(&step);
        let reply = match step.pdu {
            RequestPdu::Read { table, count, .. } if table.is_bits() => Reply::Bits(vec![true; count.into()]),
            RequestPdu::Read { count, .. } => Reply::Registers(vec![0; count.into()]),
            ref write => {
                writes.push(write.clone());
                Reply::Written
            }
        };
        bench.words.advance_to(bench.now);
        if command.answered(&step, reply, &mut bench.words).is_some() {
            break;
        }
    }
    command.note_direction(&mut bench.words);
    writes
}

fn coil(address: u16, on: bool) -> RequestPdu {
    RequestPdu::WriteCoil { address, on }
}

#[test]
fn a_stop_that_names_the_direction_writes_it_where_it_has_a_coil() {
    for family in ["vacon-cx", "hitachi-wj200", "vacon-nx-n2", "teco-7300pa-n2"] {
        let mut bench = bench(family);
        let stop = [("run", 0.0), ("reverse", 0.0)];
        let written = writes(&mut bench, &stop, Urgency::Stop);
        assert_eq!(written, [coil(0, false), coil(1, false)], "{family}: the stop first");
        let written = writes(&mut bench, &stop[..1], Urgency::Stop);
        assert_eq!(written, [coil(0, false)], "{family}");
    }
}

/// Family, control word, run command in reverse and forward, from the manuals.
const PAIRS: [(&str, u16, u16, u16); 6] = [
    ("yaskawa-v1000", 1, 2, 1),
    ("mitsubishi-d700", 8, 4, 2),
    ("fuji-frenic", 0x0706, 2, 1),
    ("ls-g100", 5, 4, 2),
    ("invt-goodrive", 0x2000, 2, 1),
    ("delta-ms300", 0x2000, 0x22, 0x12),
];

#[test]
fn a_run_command_behind_a_stop_turns_as_the_stop_ordered() {
    for (family, address, back, forward) in PAIRS {
        let mut bench = bench(family);
        let mut last = |points: &[(&str, f64)], urgency| {
            let last = writes(&mut bench, points, urgency).pop();
            written(&last.unwrap()).unwrap().1
        };
        let word = |value| vec![(address, value)];
        assert_eq!(last(&[("run", 1.0), ("reverse", 1.0)], Urgency::Command), word(back));
        // A stop that does not name the direction leaves it.
        last(&[("run", 0.0)], Urgency::Stop);
        assert_eq!(last(&[("run", 1.0)], Urgency::Command), word(back), "{family}");
        last(&[("run", 0.0), ("reverse", 0.0)], Urgency::Stop);
        assert_eq!(last(&[("run", 1.0)], Urgency::Command), word(forward), "{family}");
    }
}

#[test]
fn a_reset_takes_the_coil_of_the_run_command_away_whatever_was_read() {
    let mut bench = bench("vacon-cx");
    bench.words.learn(Table::Coil, 0, 0);
    let written = writes(&mut bench, &[("fault_reset", 1.0)], Urgency::Command);
    assert_eq!(written, [coil(0, false), coil(2, false), coil(2, true), coil(2, false)]);
}

/// Family, control word, and its run words forward and in reverse, from the manuals: families whose word is not read back, and
/// which have the direction in it.
const UNREADABLE: [(&str, u16, u16, u16); 10] = [
    ("weg-cfw", 682, 0x17, 0x13),
    ("danfoss-fc", 49999, 0x047C, 0x847C),
    ("teco-f510", 0x2501, 1, 3),
    ("toshiba-vf-s15", 0xFA00, 0xC400, 0xC600),
    ("yaskawa-v1000", 1, 1, 2),
    ("mitsubishi-d700", 8, 2, 4),
    ("fuji-frenic", 0x0706, 1, 2),
    ("ls-g100", 5, 2, 4),
    ("invt-goodrive", 0x2000, 1, 2),
    ("delta-ms300", 0x2000, 0x12, 0x22),
];

/// The word that a run command without a direction writes.
fn run_alone(bench: &mut ObedientDrive) -> Vec<(u16, u16)> {
    let last = writes(bench, &[("run", 1.0)], Urgency::Command).pop();
    written(&last.unwrap()).unwrap().1
}

#[test]
fn a_run_command_alone_turns_a_motor_forward_of_which_nothing_is_known() {
    for (family, address, forward, _) in UNREADABLE {
        let mut fresh = bench(family);
        assert_eq!(run_alone(&mut fresh), [(address, forward)], "{family}");
        // A stop before knows nothing either.
        let mut stopped = bench(family);
        writes(&mut stopped, &[("run", 0.0)], Urgency::Stop);
        assert_eq!(run_alone(&mut stopped), [(address, forward)], "{family}: behind a stop");
    }
}

#[test]
fn a_run_command_alone_never_reverses_a_motor_that_turns() {
    for (family, address, forward, back) in UNREADABLE {
        for (reverse, word) in [(0.0, forward), (1.0, back)] {
            // An outage, a lost reply and a write by another way in leave the word unknown.
            let mut ordered = bench(family);
            writes(&mut ordered, &[("run", 1.0), ("reverse", reverse)], Urgency::Command);
            ordered.words.forget();
            assert_eq!(run_alone(&mut ordered), [(address, word)], "{family}: ordered");
            let control = ordered.profile.control.clone().unwrap();
            let place = control.at;
            let mut raw = bench(family);
            raw.words
                .written(&raw.profile.functions.write_register(place.address, word));
            raw.words.forget();
            assert_eq!(run_alone(&mut raw), [(address, word)], "{family}: raw");
            let mut lost = bench(family);
            lost.words
                .in_doubt(place.table, &[(place.address, word)], Some(&control));
            assert_eq!(run_alone(&mut lost), [(address, word)], "{family}: in doubt");
            // The motor still turns as before: it slows down first, to turn as was ordered last.
            let mut slows = bench(family);
            slows
                .words
                .written(&slows.profile.functions.write_register(place.address, word));
            slows.words.forget();
            slows.words.see_turning(Some(reverse == 0.0));
            assert_eq!(run_alone(&mut slows), [(address, word)], "{family}: slows down");
            // The gateway has restarted: only the status of the drive shows how the motor turns.
            let mut restarted = bench(family);
            restarted.words.see_turning(Some(reverse == 1.0));
            assert_eq!(run_alone(&mut restarted), [(address, word)], "{family}: shown");
            // A stop orders no direction: the next start behind it turns forward, whoever turned the motor before.
            let mut stopped = bench(family);
            stopped.words.see_turning(Some(true));
            writes(&mut stopped, &[("run", 0.0)], Urgency::Stop);
            stopped.words.see_turning(None);
            assert_eq!(run_alone(&mut stopped), [(address, forward)], "{family}: behind a stop");
        }
    }
}

#[test]
fn a_coil_that_is_0_in_reverse_is_written_before_the_first_run_command() {
    // The L200 and L2002 of Hitachi: coil 1 = 1 is forward.
    let text = std::fs::read_to_string(concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../profiles/hitachi-wj200.toml"
    ))
    .unwrap();
    let inverted = text.replace(
        "reverse = { point = \"direction_command\", bit = 0 }",
        "reverse = { point = \"direction_command\", bit = 0, is = 0 }",
    );
    assert_ne!(inverted, text);
    let profile = Profile::parse("l200.toml", &inverted, false).unwrap();
    let mut bench = ObedientDrive {
        profile: Arc::new(profile),
        ..ObedientDrive::new(0)
    };
    let run = [("run", 1.0)];
    assert_eq!(
        writes(&mut bench, &run, Urgency::Command),
        [coil(1, true), coil(0, true)]
    );
    bench.words.forget();
    assert_eq!(
        writes(&mut bench, &run, Urgency::Command),
        [coil(1, true), coil(0, true)],
        "as ordered last"
    );
    bench.words = KnownWords::default();
    bench.words.see_turning(Some(true));
    assert_eq!(
        writes(&mut bench, &run, Urgency::Command),
        [coil(1, false), coil(0, true)]
    );
}

/// Family and its stop word by ramp, from the manuals: what is written where nothing is known of the drive's own word.
const STOPS: [(&str, u16); 10] = [
    ("abb-acs550", 0x047E),
    ("abb-acs580", 0x047E),
    ("schneider-altivar", 0x0007),
    ("siemens-g120", 0x047E),
    ("siemens-v20", 0x047E),
    ("danfoss-fc", 0x043C),
    ("weg-cfw", 0x0016),
    ("toshiba-vf-s15", 0xC000),
    ("teco-f510", 0),
    ("vacon-10", 0),
];

#[test]
fn a_stop_without_a_known_word_stops_by_ramp() {
    for (family, word) in STOPS {
        let mut bench = bench(family);
        let stop = writes(&mut bench, &[("run", 0.0)], Urgency::Stop).remove(0);
        let (_, items) = written(&stop).unwrap();
        assert_eq!(items[0].1, word, "{family}");
    }
    // A word of `also_stop` coasts or stops quickly; the gateway writes none.
    for profile in Profiles::built_in().iter() {
        let Some(control) = profile.control.as_ref().filter(|control| control.stop.place.is_none()) else {
            continue;
        };
        for reverse in [false, true] {
            let word = control.stop_word(control.unknown_word(reverse));
            let coasts = control.also_stop.iter().any(|stop| stop.holds(word));
            assert!(
                !coasts && control.is_own_stop(control.at, word),
                "{}: {word:04X}",
                profile.name
            );
        }
    }
}
