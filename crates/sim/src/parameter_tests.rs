//! Random parameters of one drive restored to another of its family, frame by frame, write by write.

use std::collections::BTreeSet;
use std::sync::Arc;

use super::model::Command;
use super::random::Random;
use super::simulated_drive::{DriveOptions, ModelOptions, SimulatedDrive, Writes};
use super::slave::{FrameMeaning, Slaves};
use super::*;
use drivegate_core::order::Outcome;
use drivegate_core::parameters::{
    Names, Next, ParameterFile, ParameterWrite, Plan, Reading, Wishes, differences, plan,
};
use drivegate_model::drive::Profile;
use drivegate_model::drive::parameters::RawValue;
use drivegate_model::drive::profile::Profiles;
use drivegate_proto::n2::Session;
use drivegate_proto::{Decoded, Exception, Protocol, Reply, Request, RequestPdu};

const ADDRESS: u8 = 1;
const SEEDS: u64 = 6;
const FORCED: Wishes = Wishes {
    only: Vec::new(),
    force: true,
};

/// A single drive of one family on a line.
struct DriveOnLine {
    profile: Arc<Profile>,
    slaves: Slaves,
    now: SimTime,
}

impl DriveOnLine {
    fn new(profile: &Arc<Profile>) -> DriveOnLine {
        let model = ModelOptions::by_name(profile.simulator.as_deref().unwrap()).unwrap();
        let mut rig = DriveOnLine {
            profile: profile.clone(),
            slaves: Slaves::new([DriveOptions::new(ADDRESS, model)], SimTime::ZERO),
            now: SimTime::ZERO,
        };
        if rig.is_n2() {
            rig.ask(RequestPdu::N2(Session::Identify));
        }
        rig
    }

    /// A drive with random parameters, in the mode in which it accepts parameters.
    fn filled(profile: &Arc<Profile>, seed: u64) -> DriveOnLine {
        let mut rig = DriveOnLine::new(profile);
        rig.drive().fill_parameters(seed);
        rig.drive().set_programming(true);
        rig
    }

    fn is_n2(&self) -> bool {
        self.profile.protocols.contains(&Protocol::N2)
    }

    fn drive(&mut self) -> &mut SimulatedDrive {
        self.slaves.drive(ADDRESS).unwrap()
    }

    fn ask(&mut self, pdu: RequestPdu) -> Reply {
        let protocol = self.profile.protocols[0];
        let request = Request::new(ADDRESS, pdu);
        let (mut frame, mut reply) = (Vec::new(), Vec::new());
        protocol.encode(&request, &mut frame);
        self.now += Duration::from_millis(1);
        match self.slaves.hear(protocol, &frame, self.now) {
            FrameMeaning::Request(asked) => self.slaves.answer(&asked, self.now, &mut reply),
            other => panic!("{request:?}: {other:?}"),
        }
        match protocol.decode(&request, &reply) {
            Decoded::Reply { reply, .. } => reply,
            other => panic!("{request:?}: {other:?}"),
        }
    }

    fn read(&mut self, known: BTreeSet<u16>) -> ParameterFile {
        let mut reading = Reading::new(self.profile.clone(), known);
        while let Some(pdu) = reading.request() {
            let outcome = match self.ask(pdu) {
                Reply::Exception(exception) => Outcome::Exception(exception),
                reply => Outcome::Acknowledged(reply),
            };
            assert_eq!(reading.answered(&outcome), Next::Go);
        }
        reading.file("d", "none", "2026-03-02T07:40:12Z", &Names::default())
    }

    fn write(&mut self, write: &ParameterWrite) -> Reply {
        let address = write.address;
        self.ask(match write.to {
            RawValue::Word(value) => RequestPdu::write_register(address, value),
            RawValue::Float(bits) => RequestPdu::write_registers(address, &[(bits >> 16) as u16, bits as u16]),
        })
    }

    /// Carries out the plan; checks that the drive accepts and saves all values.
    fn carry_out(&mut self, plan: &Plan) {
        for write in &plan.writes {
            assert_eq!(
                self.write(write),
                Reply::Written,
                "{}: {}",
                self.profile.name,
                write.line
            );
        }
        if let Some((address, value)) = plan.handling.save {
            assert_eq!(self.ask(RequestPdu::write_register(address, value)), Reply::Written);
        }
    }
}

/// The families with parameters, and the addresses of the parameters in their simulated drives.
fn families() -> Vec<(Arc<Profile>, BTreeSet<u16>)> {
    let all = Profiles::built_in();
    // Profiles of a single application are left out: they have the parameters of their base. Families that are simulated by their
    // profile have no rules of their own for parameters.
    let has_model = |profile: &Profile| profile.simulator.as_deref().and_then(ModelOptions::by_name).is_some();
    let all = all
        .iter()
        .filter(|profile| profile.base.is_none() && has_model(profile) && !profile.parameters.is_empty());
    let families: Vec<_> = all
        .map(|profile| {
            let file = DriveOnLine::new(profile).read(BTreeSet::new());
            (profile.clone(), Reading::addresses_of(profile, &file))
        })
        .collect();
    assert_eq!(families.len(), 8);
    families
}

#[test]
fn the_parameters_of_any_drive_go_to_any_other_of_its_family_and_back() {
    let mut written = 0;
    for ((profile, known), seed) in families()
        .into_iter()
        .flat_map(|family| (1..=SEEDS).map(move |seed| (family.clone(), seed)))
    {
        let wanted = DriveOnLine::filled(&profile, seed).read(known.clone());
        let mut rig = DriveOnLine::filled(&profile, seed + 1000);
        let present = rig.read(known.clone());
        let (plan, _) = plan(&profile, &wanted, &present, &FORCED).unwrap();
        let half = plan.writes.len() / 2;
        written += plan.writes.len();
        rig.carry_out(&plan);
        let left: BTreeSet<_> = differences(&wanted, &rig.read(known.clone()))
            .into_iter()
            .map(|difference| difference.id)
            .collect();
        let left_out: BTreeSet<_> = plan.left_out.iter().map(|(id, _)| id.clone()).collect();
        assert_eq!(left, left_out, "{}", profile.name);
        check_wear(&mut rig, &plan);

        // A restore that was interrupted half way is completely undone.
        let mut rig = DriveOnLine::filled(&profile, seed + 1000);
        for write in &plan.writes[..half] {
            assert_eq!(rig.write(write), Reply::Written);
        }
        rig.carry_out(&plan.back(half));
        assert_eq!(differences(&present, &rig.read(known)), [], "{}", profile.name);
    }
    assert!(written > 1000, "{written}");
}

/// The reading continues with function 08 if the family has counters; without them, the reading is whole as well.
#[test]
fn the_counters_of_a_drive_are_read_behind_its_parameters() {
    for (profile, known) in families() {
        let mut rig = DriveOnLine::new(&profile);
        let file = rig.read(known.clone());
        // The counters are read one after the other, and count these reads too.
        let (received, own) = (known.len() + 1, known.len() + 4);
        let of = format!("{received} messages received, 0 damaged, {own} to this drive");
        if profile.counts_messages {
            assert!(file.counters.starts_with(&of), "{}: {}", profile.name, file.counters);
        } else {
            assert_eq!(file.counters, "", "{}", profile.name);
        }
        assert_eq!(ParameterFile::parse(&file.text()), Ok(file.clone()), "{}", profile.name);

        // A drive may refuse function 08, or stop answering after its last parameter; the reading is complete in
        // both cases.
        for end in [Outcome::Exception(Exception::Modbus(1)), Outcome::TimedOut] {
            let mut reading = Reading::new(profile.clone(), known.clone());
            let mut last = 0;
            while let Some(pdu) = reading.request() {
                let outcome = match pdu {
                    RequestPdu::Diagnostics { .. } => end.clone(),
                    pdu => match rig.ask(pdu) {
                        Reply::Exception(exception) => Outcome::Exception(exception),
                        reply => Outcome::Acknowledged(reply),
                    },
                };
                last += u32::from(reading.progress().0 == reading.progress().1);
                assert_eq!(reading.answered(&outcome), Next::Go);
            }
            let without = reading.file("d", "none", "2026-03-02T07:40:12Z", &Names::default());
            assert_eq!(
                (without.counters.as_str(), &without.values),
                ("", &file.values),
                "{}",
                profile.name
            );
            assert!(last <= 5, "{}: asked {last} times", profile.name);
        }
    }
}

/// All that the profile names is read before the search for others begins, and what is read now is said.
#[test]
fn what_the_profile_names_is_read_first() {
    let (mut with_search, profiles) = (0, Profiles::built_in());
    for profile in profiles.iter().filter(|profile| !profile.parameters.is_empty()) {
        if profile.simulator.as_deref().and_then(ModelOptions::by_name).is_none() {
            continue;
        }
        let mut rig = DriveOnLine::new(profile);
        let mut reading = Reading::new(profile.clone(), BTreeSet::new());
        let mut searching = false;
        while let Some(pdu) = reading.request() {
            let now = reading.now();
            let (RequestPdu::Read { start, .. }, Some(now)) = (&pdu, &now) else {
                break;
            };
            let id = profile.parameters.id(*start).unwrap_or_default();
            assert!(now.contains(&id), "{}: {now} is not {id}", profile.name);
            searching = searching || now.starts_with("looking for others: ");
            let is_named = profile.parameters.by_address(*start).is_some();
            assert!(!(searching && is_named), "{}: {now}", profile.name);
            let outcome = match rig.ask(pdu) {
                Reply::Exception(exception) => Outcome::Exception(exception),
                reply => Outcome::Acknowledged(reply),
            };
            assert_eq!(reading.answered(&outcome), Next::Go);
        }
        with_search += u32::from(searching);
    }
    assert!(with_search > 3, "{with_search}");
}

/// Checks that each parameter was written once, and that the drive's memory was written as often.
fn check_wear(rig: &mut DriveOnLine, plan: &Plan) {
    let (profile, is_n2) = (rig.profile.clone(), rig.is_n2());
    let writes = rig.drive().parameter_writes();
    let taken: u32 = writes.values().map(|writes| writes.taken).sum();
    assert_eq!(taken as usize, plan.writes.len(), "{}", profile.name);
    assert!(
        writes
            .values()
            .all(|writes| writes.taken <= 1 && writes.stored_writes <= 1 && writes.while_fed == 0)
    );
    // N2 objects have other addresses.
    for write in plan.writes.iter().filter(|_| !is_n2) {
        let expected = Writes {
            taken: 1,
            while_fed: 0,
            stored_writes: u32::from(!write.volatile),
        };
        assert_eq!(writes[&write.address], expected, "{}", write.line);
    }
}

/// A locked drive refuses exactly the parameters that the plan marks, by the profile's rule for PRGM and DRIVE.
#[test]
fn a_locked_drive_refuses_what_the_plan_says_it_will() {
    for (profile, known) in families() {
        let wanted = DriveOnLine::filled(&profile, 1).read(known.clone());
        let mut rig = DriveOnLine::filled(&profile, 2);
        rig.drive().set_programming(false);
        let (plan, _) = plan(&profile, &wanted, &rig.read(known), &FORCED).unwrap();
        let lock = profile.parameters.rules.lock.clone();
        let code = plan.handling.needs.clone().and_then(|need| need.exception);
        assert_eq!(lock.is_some(), profile.name.starts_with("teco"));
        for write in &plan.writes {
            let is_locked = lock
                .as_ref()
                .is_some_and(|lock| drivegate_model::drive::parameters::has(&lock.of, write.address));
            let reply = rig.write(write);
            match (is_locked, code) {
                (true, None) => panic!("the plan does not say what the lock returns"),
                (true, code) => {
                    let refused = match reply {
                        Reply::Exception(refused) => Some(refused.code()),
                        _ => None,
                    };
                    assert_eq!(refused, code, "{}", write.line);
                }
                (false, _) => assert_eq!(reply, Reply::Written, "{}", write.line),
            }
        }
    }
}

#[test]
fn a_write_while_the_motor_is_fed_is_recorded() {
    let mut random = Random::new(3);
    for (profile, known) in families() {
        let mut rig = DriveOnLine::new(&profile);
        rig.drive().command(Command {
            run: true,
            reverse: false,
            reference: 5000,
        });
        rig.now += Duration::from_secs(2);
        let wanted = rig.read(known);
        let parameters = &profile.parameters;
        let free = wanted
            .read_values()
            .filter_map(|(id, value)| Some((parameters.address(id.name())?, value)));
        let locked = |address| {
            parameters
                .rules
                .lock
                .as_ref()
                .is_some_and(|lock| drivegate_model::drive::parameters::has(&lock.of, address))
        };
        let free: Vec<(u16, RawValue)> = free.filter(|(address, _)| !locked(*address)).collect();
        let (address, value) = free[random.within(0..=free.len() as u64 - 1) as usize];
        let write = ParameterWrite {
            id: drivegate_core::parameters::Id::new("any"),
            address,
            from: value,
            to: value,
            line: String::new(),
            volatile: false,
        };
        assert!(rig.drive().state().running, "{}", profile.name);
        assert_eq!(rig.write(&write), Reply::Written);
        let fed: u32 = rig
            .drive()
            .parameter_writes()
            .values()
            .map(|writes| writes.while_fed)
            .sum();
        assert_eq!(fed, 1, "{}", profile.name);
    }
}
