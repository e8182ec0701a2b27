//! Readings of parameters in virtual time: the result is what the drive has, whatever happens on the line, and
//! process data continues.

use std::collections::BTreeSet;
use std::time::Duration;

use drivegate_core::order::{BackgroundRequest, Origin, Outcome, Pace, SourceKind, Ticket};
use drivegate_core::parameters::{Entry, Names, Next, ParameterFile, Reading, differences};
use drivegate_model::drive::{DriveIndex, ModelPoint};
use drivegate_proto::{Protocol, RequestPdu, Table};
use drivegate_sim::faults::FaultPlan;
use drivegate_sim::random::Random;

use super::rig::{PATIENCE, Rig, line};
use super::scenario::Line;

const DRIVE: u8 = 1;

impl Rig {
    /// Makes a background transaction.
    fn in_background(&mut self, pdu: RequestPdu) -> Outcome {
        if !self.is_online(0) {
            return Outcome::Offline;
        }
        let origin = Origin::new(SourceKind::LocalSocket, "test");
        let command_log = self.plant.command_log.clone();
        let (ticket, mut answer) = Ticket::new(origin, "d0-1", String::new(), false, self.now, command_log);
        let request = BackgroundRequest {
            target: DriveIndex::new(0).into(),
            pdu,
            pace: Pace::Slow,
            expires: self.now + PATIENCE,
            ticket,
            passed_on: None,
        };
        self.bus.handle.queue.submit_background(request, self.now);
        self.bus.command_came(self.now);
        let until = self.now + 2 * PATIENCE;
        loop {
            match answer.try_recv() {
                Ok(answer) => return answer.outcome,
                Err(_) => assert!(self.step(until).is_some(), "a request that nobody answers"),
            }
        }
    }

    /// Reads all parameters of the first drive; `meanwhile` runs before each request.
    fn read_parameters(&mut self, known: BTreeSet<u16>, mut meanwhile: impl FnMut(&mut Rig)) -> ParameterFile {
        let profile = self.drive(DRIVE).image.spec.profile.clone();
        let mut reading = Reading::new(profile, known);
        while let Some(pdu) = reading.request() {
            meanwhile(self);
            let outcome = self.in_background(pdu);
            match reading.answered(&outcome) {
                Next::Go => {}
                Next::Pause(time, _) => self.run(time),
                Next::Failed(why) => panic!("{why}"),
            }
        }
        assert_eq!(reading.progress().0, reading.progress().1);
        reading.file("d0-1", "none", "2026-03-02T07:40:12Z", &Names::default())
    }

    /// Gives parameters of the drive random valid values, written at the drive itself.
    fn scramble(&mut self, file: &ParameterFile, random: &mut Random) {
        let profile = self.drive(DRIVE).image.spec.profile.clone();
        for id in file.values.keys() {
            let address = profile.parameters.address(id.name()).unwrap();
            // Values that the drive refuses stay unchanged.
            let write = RequestPdu::WriteRegister {
                address,
                value: random.within(0..=600) as u16,
            };
            self.with_drive(DRIVE, |drive, now| drive.answer(&write, now));
        }
    }
}

fn ready(line: &Line) -> Rig {
    let mut rig = Rig::of(line);
    rig.until("the drives are read", PATIENCE, |rig| {
        (1..=line.drives).all(|address| rig.good(address, ModelPoint::OutputFrequency).is_some())
    });
    rig
}

fn families() -> [Line; 6] {
    let rtu = Protocol::ModbusRtu;
    let families = [
        line("vacon-nx", rtu, 38_400, 1),
        line("eaton-svx", rtu, 38_400, 1),
        line("vacon-cx", rtu, 19_200, 1),
        line("teco-7300pa", Protocol::ModbusAscii, 19_200, 1),
        line("vacon-nx-n2", Protocol::N2, 9600, 1),
        line("teco-7300pa-n2", Protocol::N2, 9600, 1),
    ];
    // Slow cycles leave time on the line: otherwise reading a whole drive would take hours.
    families.map(|family| Line {
        cycle: Duration::from_secs(1),
        slow_cycle: Duration::from_secs(10),
        ..family
    })
}

#[test]
fn what_is_read_is_what_the_drive_has() {
    let mut random = Random::new(5);
    for line in families() {
        let mut rig = ready(&line);
        let first = rig.read_parameters(BTreeSet::new(), |_| ());
        let least = match line.family {
            "vacon-nx" | "eaton-svx" => 30,
            "vacon-cx" => 28,
            "teco-7300pa" => 143,
            "vacon-nx-n2" => 5,
            _ => 19,
        };
        assert_eq!(first.values.len(), least, "{}", line.family);
        assert_eq!(first.missing(), 0, "{}", line.family);
        if line.protocol != Protocol::N2 {
            rig.scramble(&first, &mut random);
        }
        let profile = rig.drive(DRIVE).image.spec.profile.clone();
        // The second reading requests only known addresses, and the file loses nothing when written and parsed.
        let file = ParameterFile::parse(&first.text()).unwrap();
        let before = rig.now;
        let second = rig.read_parameters(Reading::addresses_of(&profile, &file), |_| ());
        assert_eq!(second.values.len(), first.values.len());
        assert!(
            rig.now - before < Duration::from_secs(10),
            "{}: {:?}",
            line.family,
            rig.now - before
        );
        let mut changed = 0;
        for (id, entry) in second.values.iter().filter(|_| line.protocol != Protocol::N2) {
            let address = profile.parameters.address(id.name()).unwrap();
            let word = rig.word(DRIVE, address);
            assert_eq!(
                entry.value.as_ref().map(|value| value.number()),
                Ok(f64::from(word)),
                "{id}"
            );
            changed += usize::from(first.values[id].value != entry.value);
        }
        assert_eq!(differences(&first, &second).len(), changed);
        assert!(
            line.protocol == Protocol::N2 || changed > 3,
            "{}: {changed}",
            line.family
        );
        let statistics = rig.bus.wire.statistics();
        assert_eq!(
            (statistics.silence_violations, statistics.collisions),
            (0, 0),
            "{}",
            line.family
        );
    }
}

#[test]
fn nothing_is_written_by_reading() {
    for line in families() {
        let mut rig = ready(&line);
        rig.bus.wire.record(1_000_000);
        rig.read_parameters(BTreeSet::new(), |_| ());
        let functions: BTreeSet<u8> = match line.protocol {
            Protocol::ModbusRtu => rig.requests().iter().map(|frame| frame.bytes[1]).collect(),
            _ => continue,
        };
        // Function 08 reads the counters of a drive that has counters.
        let reads = |function: &u8| (1..=4).contains(function) || *function == 8;
        assert!(functions.iter().all(reads), "{functions:?}");
        assert_eq!(functions.contains(&8), line.family == "vacon-cx", "{}", line.family);
    }
}

#[test]
fn a_reading_goes_on_after_outages_and_noise_and_is_true() {
    for seed in 0..20 {
        let mut random = Random::new(seed);
        let mut rig = ready(&line("teco-7300pa", Protocol::ModbusAscii, 19_200, 1));
        rig.set_faults(FaultPlan::new("drop=0.05,corrupt=0.05".parse().unwrap(), seed));
        let file = rig.read_parameters(BTreeSet::new(), |rig| match random.within(0..=12) {
            0 => {
                rig.set_alive(DRIVE, false);
                rig.run(Duration::from_millis(random.within(10..=3000)));
                rig.set_alive(DRIVE, true);
            }
            1 => {
                rig.bus.set_open(false, rig.now);
                rig.run(Duration::from_millis(50));
                rig.bus.set_open(true, rig.now);
            }
            _ => rig.run(Duration::from_millis(random.within(0..=50))),
        });
        rig.set_faults(FaultPlan::default());
        let profile = rig.drive(DRIVE).image.spec.profile.clone();
        let read = |entry: &Entry| entry.value.as_ref().ok().map(|value| value.number());
        let mut missing = 0;
        for (id, entry) in &file.values {
            let address = profile.parameters.address(id.name()).unwrap();
            match read(entry) {
                Some(value) => assert_eq!(value, f64::from(rig.word(DRIVE, address)), "seed {seed}: {id}"),
                None => missing += 1,
            }
        }
        assert_eq!(file.values.len(), 143, "seed {seed}");
        assert!(missing <= 3, "seed {seed}: {missing}");
    }
}

#[test]
fn another_application_is_found_out() {
    let mut rig = ready(&line("vacon-nx", Protocol::ModbusRtu, 38_400, 1));
    // An earlier reading found one that this application has not.
    let known = BTreeSet::from([100, 101, 399]);
    let file = rig.read_parameters(known, |_| ());
    assert_eq!(file.values.len(), 30, "the drive is asked for everything");
}

/// Rounds of process data in that time.
fn rounds(rig: &Rig) -> u64 {
    rig.bus.handle.image.fast_cycles.snapshot().count
}

#[test]
fn process_data_keeps_its_rate_while_parameters_are_read() {
    // Some of these lines cannot keep their cycle, and one has time left over.
    for (baud, drives, cycle) in [(9600, 6, 10), (19_200, 12, 10), (38_400, 4, 100)] {
        let line = Line {
            cycle: Duration::from_millis(cycle),
            ..line("vacon-nx", Protocol::ModbusRtu, baud, drives)
        };
        let mut rig = ready(&line);
        rig.run(Duration::from_secs(20));
        let minute = Duration::from_secs(60);
        let before = rounds(&rig);
        rig.run(minute);
        let alone = rounds(&rig) - before;
        let (begun, until) = (rounds(&rig), rig.now + minute);
        let mut asked = 0;
        while rig.now < until {
            let pdu = RequestPdu::Read {
                table: Table::Holding,
                start: 100 + asked % 20,
                count: 1,
            };
            assert!(matches!(
                rig.in_background(pdu),
                Outcome::Acknowledged(_) | Outcome::Exception(_)
            ));
            asked += 1;
        }
        let reading = rounds(&rig) - begun;
        println!(
            "{baud} baud, {drives} drives, cycle {cycle} ms: {alone} rounds a minute alone, {reading} while {asked} parameters were read"
        );
        assert!(
            reading as f64 >= 0.98 * alone as f64,
            "{baud} baud: {reading} of {alone} rounds"
        );
        assert!(asked >= 15, "{baud} baud: {asked}");
    }
}
