use super::*;
use crate::drive::profile::Profiles;

#[test]
fn every_family_that_ships_is_proved() {
    for profile in Profiles::built_in().iter() {
        let began = Instant::now();
        match prove(profile) {
            Ok(proof) => {
                println!(
                    "{}: {} commands, {} frames, {:?}",
                    profile.name,
                    proof.commands,
                    proof.frames,
                    began.elapsed()
                );
                assert_eq!(
                    proof.commands > 100,
                    profile.control_language().is_some(),
                    "{}",
                    profile.name
                );
            }
            Err(counterexample) => panic!("{}: {counterexample}", profile.name),
        }
    }
}
