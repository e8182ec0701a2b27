//! Other words by which a drive stops, written by a client over every interface: the motor stops, and no later
//! order without a run command starts it.

use std::io::Write;
use std::net::TcpStream;
use std::time::Duration;

use drivegate_model::drive::profile::Profiles;
use drivegate_testkit::Order::{Pair, Word};
use drivegate_testkit::number;

use super::cases::Order::Raw;
use super::cases::{Case, cases};
use super::{Answer, Rig, rtu};

/// Columns: profile, control word, and the other stop words, by hand from the manuals; they contain the bits of a
/// run command.
const WORDS: &str = "\
abb-acs550         | 0      | 0x47D 0x47B 0x477 0x7D
abb-acs580         | 0      | 0x47D 0x47B 0x477 0x7B
danfoss-fc         | 49999  | 0x474 0x46C 0x478 0x8474
siemens-v20        | 99     | 0x47D 0x47B 0x477
siemens-g120       | 99     | 0x47D 0x47B 0x477 0xC7D
schneider-altivar  | 8501   | 0xB 0xD 0x80B
invt-goodrive      | 0x2000 | 6
invertek-optidrive | 0      | 9 3 0xB
weg-cfw            | 682    | 0x15 0x57 0x55
toshiba-vf-s15     | 0xFA00 | 0xCC00 0xCE00 0xD400
ls-g100            | 5      | 0x10 0x12";

/// The interface by which a word is sent.
#[derive(Debug, Clone, Copy)]
enum Way {
    Alone,
    /// The word is sent together with the reference by function 16.
    Block,
    Slot,
    Broadcast,
}

impl Rig {
    /// Writes the word; returns whether this interface can be used for the drive.
    fn stops_by(&self, way: Way, address: u16, word: u16, reference: Option<u16>) -> bool {
        let pdu = Raw(Word(address, word)).pdu();
        let done = match (way, reference) {
            (Way::Alone, _) if address >= 0x8000 => return false,
            (Way::Alone, _) => self.by_modbus_tcp(&pdu),
            (Way::Block, None) => return false,
            (Way::Block, Some(other)) => {
                let block = if other < address {
                    Pair(other, 0, word)
                } else {
                    Pair(address, word, 0)
                };
                self.by_modbus_tcp(&Raw(block).pdu())
            }
            (Way::Slot, _) => self.by_slot(1, &pdu),
            (Way::Broadcast, _) => {
                let mut stream = TcpStream::connect(("127.0.0.1", self.raw_slot)).unwrap();
                stream.write_all(&rtu(0, &pdu)).unwrap();
                // A broadcast gets no answer.
                std::thread::sleep(Duration::from_millis(500));
                Answer::Done
            }
        };
        assert_eq!(done, Answer::Done, "{word:#06x} by {way:?}");
        true
    }
}

/// The register of the reference, if one write can set it together with the control word.
fn beside(case: &Case, address: u16) -> Option<u16> {
    let profile = Profiles::built_in().get(case.profile).unwrap().clone();
    let range = profile.range(drivegate_proto::Table::Holding, address)?;
    let other = case.reference_register()?;
    (range.write >= 2 && range.addresses.contains(&other) && address.abs_diff(other) == 1).then_some(other)
}

fn stops_otherwise(case: &Case, address: u16, words: &str) {
    let rig = Rig::new(case, false);
    let name = case.profile;
    let profile = Profiles::built_in().get(name).unwrap().clone();
    let has = |point: &str| profile.point_index(point).is_some();
    let reference = beside(case, address);
    for word in words.split_whitespace().map(number) {
        for way in [Way::Alone, Way::Block, Way::Slot, Way::Broadcast] {
            // Toshiba's emergency off is a trip.
            rig.order(&case.stop);
            rig.order(&case.reset);
            rig.order(&case.reference);
            let before = rig.starts();
            rig.order(&case.start);
            rig.printed("motor forward", before);
            rig.site.until_state("drive", "running");
            let stopped = rig.drive.output().matches("motor stopped").count();
            if !rig.stops_by(way, address, word, reference) {
                rig.order(&case.stop);
                rig.printed("motor stopped", stopped);
                continue;
            }
            rig.printed("motor stopped", stopped);
            for (point, values) in [
                ("reverse", "{\"reverse\": true}"),
                ("speed_reference", "{\"speed_reference\": 60}"),
                ("reverse", "{\"reverse\": false, \"speed_reference\": 50}"),
                ("fault_reset", "{\"fault_reset\": true}"),
            ] {
                if has(point) {
                    let (_, result) = rig.command(values);
                    assert_ne!(result["error"]["code"], "bad_value", "{name}: {values}: {result}");
                }
            }
            std::thread::sleep(Duration::from_millis(300));
            let printed = rig.drive.output();
            assert_eq!(rig.starts(), before + 1, "{name}: {word:#06x} by {way:?}\n{printed}");
        }
    }
}

fn every_third(first: usize) {
    let cases = cases();
    for row in WORDS.lines().skip(first).step_by(3) {
        println!("{row}");
        let mut cells = row.split('|').map(str::trim);
        let mut cell = || cells.next().unwrap();
        let (name, address, words) = (cell(), number(cell()), cell());
        let case = cases.iter().find(|case| case.profile == name).unwrap();
        stops_otherwise(case, address, words);
    }
}

#[test]
fn other_stops_stop_and_nothing_later_runs_1() {
    every_third(0);
}

#[test]
fn other_stops_stop_and_nothing_later_runs_2() {
    every_third(1);
}

#[test]
fn other_stops_stop_and_nothing_later_runs_3() {
    every_third(2);
}

/// The table above contains every other stop word that a profile names; a profile based on another has those of its base.
#[test]
fn every_other_stop_of_the_profiles_is_tried() {
    let profiles = Profiles::built_in();
    for profile in profiles.iter().filter(|profile| profile.base.is_none()) {
        let Some(control) = profile.control_table() else {
            continue;
        };
        let row = WORDS.lines().find(|row| row.starts_with(&format!("{} ", profile.name)));
        let words: Vec<u16> = row.map_or(Vec::new(), |row| {
            row.rsplit('|').next().unwrap().split_whitespace().map(number).collect()
        });
        for stop in &control.also_stop {
            let tried = words.iter().any(|word| stop.holds(*word));
            assert!(tried, "{}: {stop:?}", profile.name);
        }
        let known = |word: &u16| control.also_stop.iter().any(|stop| stop.holds(*word));
        assert!(words.iter().all(known), "{}", profile.name);
    }
}
