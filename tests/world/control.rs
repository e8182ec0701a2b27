//! Families with `[control]`: orders in any sequence on a line that loses, damages and delays frames, to a drive
//! that trips and is switched to panel control. An acknowledged stop stays in force, only a run command starts the
//! motor, and after the faults everything recovers.

use std::time::Duration;

use drivegate_core::order::Outcome;
use drivegate_model::drive::profile::Profiles;
use drivegate_model::drive::{ModelPoint, State};
use drivegate_proto::Protocol;
use drivegate_sim::faults::FaultPlan;
use drivegate_sim::random::Random;

use super::rig::{Rig, line};
use super::scenario::Line;

const FAULTS: &str = "drop=0.05,corrupt=0.05,busy=0.03,late:80ms=0.03";
const ORDERS: usize = 60;

fn works(family: &'static str, faults: &str) -> Line {
    Line {
        format: "8N1",
        faults: faults.to_string(),
        response_timeout: Duration::from_millis(100),
        spec: |spec| spec.frequency_range = Some(0.0..=50.0),
        ..line(family, Protocol::ModbusRtu, 19_200, 1)
    }
}

/// State that the orders so far allow the motor.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Allowed {
    /// A stop was acknowledged, and no start was given since.
    Stands,
    /// A run command was given, whatever its outcome was.
    MayRun,
}

struct World {
    rig: Rig,
    family: &'static str,
    dice: Random,
    allowed: Allowed,
    turns_by_point: bool,
    /// Name of the point that takes the reference, in Hz or percent.
    reference: &'static str,
}

impl World {
    fn new(family: &'static str, seed: u64) -> World {
        let rig = Rig::of(&works(family, FAULTS));
        let profile = rig.drive(1).image.spec.profile.clone();
        let takes = |name: &&str| {
            profile
                .point_index(name)
                .is_some_and(|index| profile.points.get(index).unwrap().write)
        };
        let mut references = ["frequency_reference", "speed_reference"].into_iter();
        World {
            family,
            dice: Random::new(seed),
            allowed: Allowed::Stands,
            reference: references.find(takes).expect("a reference"),
            turns_by_point: profile.model_index(ModelPoint::Reverse).is_some(),
            rig,
        }
    }

    fn reference(&mut self) -> (&'static str, f64) {
        (self.reference, f64::from(self.dice.within(0..=39) as u32) + 10.0)
    }

    /// Gives an order and waits for its outcome; permission for a run counts from the order, a stop from its
    /// acknowledgement.
    fn order(&mut self, points: &[(&str, f64)]) -> Outcome {
        let run = points.iter().find(|(name, _)| *name == "run").map(|(_, value)| *value);
        if run == Some(1.0) {
            self.allowed = Allowed::MayRun;
        }
        let outcome = self.rig.set(1, points);
        if run == Some(0.0) && outcome.is_ok() {
            self.allowed = Allowed::Stands;
        }
        self.look(points);
        outcome
    }

    /// Moves the motor as the orders allow, now and for some time.
    fn look(&mut self, points: &[(&str, f64)]) {
        for _ in 0..4 {
            let state = self.rig.with_drive(1, |drive, _| drive.state());
            let commanded = state.running && state.output.abs() > 0.0 && self.speeds_up();
            assert!(
                !(commanded && self.allowed == Allowed::Stands),
                "{}: runs though it was stopped, after {points:?}",
                self.family
            );
            self.rig.run(Duration::from_millis(50));
        }
    }

    /// A motor that was stopped slows down.
    fn speeds_up(&mut self) -> bool {
        let output = |rig: &mut Rig| rig.with_drive(1, |drive, _| drive.state().output.abs());
        let before = output(&mut self.rig);
        self.rig.run(Duration::from_millis(40));
        output(&mut self.rig) > before + 0.01
    }

    fn any_order(&mut self) {
        let reference = self.reference();
        let reverse = ("reverse", f64::from(self.dice.within(0..=1) as u32));
        match self.dice.within(0..=8) {
            0 | 1 => drop(self.order(&[("run", 0.0)])),
            2 => drop(self.order(&[("run", 1.0), reference])),
            3 if self.turns_by_point => drop(self.order(&[("run", 1.0), reverse])),
            4 if self.turns_by_point => drop(self.order(&[reverse])),
            5 => drop(self.order(&[reference])),
            6 if self.resets() => drop(self.order(&[("fault_reset", 1.0)])),
            7 => {
                self.rig.with_drive(1, |drive, _| drive.trip(3));
                // After a fault, only a new run command starts the motor; a reset does not.
                self.allowed = Allowed::Stands;
                self.look(&[("a fault", 1.0)]);
            }
            8 if self.resets() => drop(self.order(&[("run", 0.0), ("fault_reset", 1.0)])),
            _ => self.rig.run(Duration::from_millis(300)),
        }
    }

    fn resets(&self) -> bool {
        let profile = &self.rig.drive(1).image.spec.profile;
        profile.model_index(ModelPoint::FaultReset).is_some()
    }

    /// Checks that without faults everything works as in the beginning.
    fn heals(&mut self, seed: u64) {
        self.rig.set_faults(FaultPlan::new(Default::default(), seed));
        self.rig.run(Duration::from_secs(30));
        let stopped = self.order(&[("run", 0.0)]);
        assert!(stopped.is_ok(), "{}: {stopped}", self.family);
        if self.rig.state(1) == State::Fault {
            if !self.resets() {
                return;
            }
            let reset = self.order(&[("fault_reset", 1.0)]);
            assert!(reset.is_ok(), "{}: {reset}", self.family);
        }
        self.rig.until("the end of the fault", super::rig::PATIENCE, |rig| {
            !matches!(rig.state(1), State::Fault | State::Running | State::Offline)
        });
        let run = self.order(&[("run", 1.0), (self.reference, 25.0)]);
        assert!(run.is_ok(), "{}: {run}", self.family);
        self.rig.until_state(1, State::Running);
        let stop = self.order(&[("run", 0.0)]);
        assert!(stop.is_ok(), "{}: {stop}", self.family);
        self.rig.until("a motor that stands", super::rig::PATIENCE, |rig| {
            rig.state(1) != State::Running
        });
    }
}

#[test]
fn stops_stand_and_all_heals_for_every_family_of_the_language() {
    let built_in = Profiles::built_in();
    let families = built_in.iter().filter(|profile| profile.control_table().is_some());
    let mut count = 0;
    for profile in families {
        // The name is leaked on purpose: the world needs a static name.
        let family: &'static str = Box::leak(profile.name.clone().into_boxed_str());
        for seed in 0..4 {
            let mut world = World::new(family, seed);
            world.rig.run(Duration::from_secs(2));
            for _ in 0..ORDERS {
                world.any_order();
            }
            world.heals(seed);
        }
        count += 1;
    }
    assert_eq!(count, 20);
}
