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
