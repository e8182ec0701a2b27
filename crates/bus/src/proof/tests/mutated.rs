//! Profiles with one fault inserted by the test: nearly all must be refused.

use super::*;

/// A change of a `[control]` section; `None` if the section has nothing to change.
type Fault = fn(&mut Control) -> Option<()>;

fn run_of(control: &mut Control) -> Option<&mut Setting> {
    match &mut control.run {
        Run::One(setting) => Some(setting),
        Run::Pair { forward, .. } => Some(forward),
        Run::Steps(steps) => steps.last_mut().map(|step| &mut step.write),
    }
}

/// The reset, if it is written to the same register as the run command.
fn reset_of(control: &mut Control) -> Option<(Setting, &mut Setting)> {
    let run = *run_of(control)?;
    let reset = control.fault_reset.as_mut()?;
    (reset.setting.place == run.place).then_some((run, &mut reset.setting))
}

const FAULTS: [(&str, Fault); 16] = [
    ("a stop with its bits the other way", |control| {
        control.stop.value ^= control.stop.mask;
        Some(())
    }),
    ("a stop that is the run command", |control| {
        control.stop = *run_of(control)?;
        Some(())
    }),
    ("a stop of one bit that no run command has", |control| {
        let runs = control.runs().iter().fold(0, |bits, run| bits | run.mask & run.value);
        let free = (0..16).map(|bit| 1u16 << bit).find(|bit| runs & bit == 0)?;
        (control.stop.mask, control.stop.value) = (free, 0);
        Some(())
    }),
    ("another stop that is the run command", |control| {
        let run = *run_of(control)?;
        control.also_stop.push(run);
        Some(())
    }),
    ("another stop of one bit that no run command has", |control| {
        let always = control.always;
        let taken = control
            .runs()
            .iter()
            .fold(always.set | always.clear, |bits, run| bits | run.mask);
        let free = (0..16).map(|bit| 1u16 << bit).find(|bit| taken & bit == 0)?;
        let stop = Setting {
            place: None,
            mask: free,
            value: free,
            once: false,
        };
        control.also_stop.push(stop);
        Some(())
    }),
    ("a reset that runs, too", |control| {
        let (run, reset) = reset_of(control)?;
        reset.value = reset.value & !run.mask | run.value;
        reset.mask |= run.mask;
        Some(())
    }),
    ("a reset that is the run command", |control| {
        let (run, reset) = reset_of(control)?;
        *reset = run;
        Some(())
    }),
    ("a direction that is the run command", |control| {
        control.reverse.filter(|reverse| reverse.place.is_none())?;
        control.reverse = Some(*run_of(control)?);
        Some(())
    }),
    ("a direction that is the stop", |control| {
        control.reverse.filter(|reverse| reverse.place.is_none())?;
        control.reverse = Some(control.stop);
        Some(())
    }),
    ("constant bits that clear the run command", |control| {
        control.always.clear |= run_of(control)?.value;
        control.always.set &= !control.always.clear;
        Some(())
    }),
    ("constant bits that set the run command", |control| {
        let run = *run_of(control)?;
        control.always.set |= run.value;
        control.always.clear &= !control.always.set;
        run.place.is_none().then_some(())
    }),
    ("a first word of the sequence that runs", |control| {
        let Run::Steps(steps) = &mut control.run else {
            return None;
        };
        let last = steps.last()?.write;
        steps.first_mut()?.write = last;
        Some(())
    }),
    ("a sequence that ends with a stop", |control| {
        let stop = control.stop;
        let last = run_of(control)?;
        last.value = last.value & !stop.mask | stop.value;
        Some(())
    }),
    ("two directions with one word", |control| {
        let Run::Pair { forward, reverse } = &mut control.run else {
            return None;
        };
        *reverse = *forward;
        Some(())
    }),
    ("a reverse that says both", |control| {
        let Run::Pair { forward, reverse } = &mut control.run else {
            return None;
        };
        reverse.value |= forward.value;
        (forward.mask.count_ones() < 16).then_some(())
    }),
    ("a stop at another register than the run command", |control| {
        let place = ControlItem {
            table: Table::Holding,
            address: 9999,
        };
        (control.stop.place, control.stop.mask, control.stop.value) = (Some(place), 1, 1);
        control.runs().iter().all(|run| run.once).then_some(())
    }),
];

/// Whether the profile is refused: by the checks of a file, or by the proof.
fn is_refused(profile: &Profile) -> bool {
    let control = profile.control.as_ref();
    control.is_some_and(|control| !control.contradictions().is_empty()) || prove(profile).is_err()
}

#[test]
fn profiles_with_a_fault_are_refused() {
    let (mut all, mut taken) = (0, Vec::new());
    for profile in Profiles::built_in().iter() {
        for (name, fault) in &FAULTS {
            let mut wrong = Profile::clone(profile);
            let Some(control) = wrong.control.as_mut() else {
                continue;
            };
            let before = control.clone();
            if fault(control).is_none() || *control == before {
                continue;
            }
            all += 1;
            if !is_refused(&wrong) {
                taken.push(format!("{}: {name}", profile.name));
            }
        }
    }
    println!("{all} faults, taken: {taken:#?}");
    assert!(all >= 100, "{all}");
    assert!(taken.len() * 20 <= all, "{} of {all}: {taken:#?}", taken.len());
}
