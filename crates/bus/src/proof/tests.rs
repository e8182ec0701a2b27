use super::*;
use crate::document::Problem;
use crate::drive::profile::Profiles;

mod mutated;

#[test]
fn every_family_that_ships_is_proved() {
    for profile in Profiles::built_in().iter() {
        match prove(profile) {
            Ok(proof) => {
                let commanded = profile.model_index(ModelPoint::Run).is_some();
                println!("{}: {} cases, {} requests", profile.name, proof.commands, proof.frames);
                assert_eq!(proof.commands > 100, commanded, "{}", profile.name);
            }
            Err(counterexample) => panic!("{}: {counterexample}", profile.name),
        }
    }
}

/// The text of a profile with that `[control]`.
fn with(control: &str) -> String {
    format!(
        "name = \"p\"\nprotocols = [\"modbus-rtu\"]\n\
         [[range]]\ntable = \"holding\"\nfirst = 0\nlast = 9\nread = 5\nwrite = 2\n\
         [[point]]\nname = \"status_word\"\nat = \"holding 3\"\nclass = \"fast\"\nhidden = true\n\
         [[point]]\nname = \"speed_reference\"\nat = \"holding 1\"\nclass = \"slow\"\nwrite = true\n\
         [control]\nat = \"holding 0\"\n{control}\n\
         [[state]]\nis = \"running\"\npoint = \"status_word\"\nmask = 0x0004\nvalue = 0x0004\n"
    )
}

/// The errors found when the profile is read, or by the proof.
fn refused(text: &str) -> Option<String> {
    let lines = |problems: Vec<Problem>| problems.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n");
    match Profile::parse("p.toml", text, false) {
        Err(problems) => Some(lines(problems)),
        Ok(profile) => prove(&profile).err().map(|counterexample| counterexample.to_string()),
    }
}

/// The wrong profiles that a user is likely to write.
#[test]
fn wrong_profiles_are_refused_with_what_is_wrong() {
    let bit = "run = { bit = 0 }\nstop = { bit = 0, is = 0 }";
    let cia = "stop = { bit = 3, is = 0 }\nreverse = { bit = 11 }\nfault_reset = { mask = 0x8F, value = 0x80 }\n\
               run = { steps = [{ write = 6, until = { point = \"status_word\", mask = 0x6F, is = 0x21 } }, \
               { write = 7, until = { point = \"status_word\", mask = 0x6F, is = 0x23 } }, { write = 0xF }] }";
    for (name, control, expected) in [
        (
            "forward and reverse bits, stopped by one of them (Yaskawa)",
            "own_word = \"shadow\"\nrun = { forward_bit = 0, reverse_bit = 1 }\nstop = { bit = 0, is = 0 }".to_string(),
            "a word can be a run command and a stop at once",
        ),
        (
            "a word without its constant bits (ABB)",
            "always = { set = [10] }\nrun = { mask = 0xFFFF, value = 0x007F }\nstop = { bit = 0, is = 0 }".to_string(),
            "contradicts `always`",
        ),
        (
            "a reset that carries the run command",
            "run = { bit = 0 }\nstop = { bit = 0, is = 0 }\nfault_reset = { mask = 0x81, value = 0x81 }".to_string(),
            "the motor starts without a run command",
        ),
        (
            "a stop by a bit that a start sets nowhere (Delta)",
            "own_word = \"shadow\"\nrun = { forward = 0x12, reverse = 0x22, once = true }\nstop = { bit = 4, is = 0 }"
                .to_string(),
            "a word can be a run command and a stop at once",
        ),
        (
            "a sequence whose first word runs already",
            cia.replace("write = 6,", "write = 15,"),
            "run",
        ),
        (
            "a parameter at the control word",
            format!("{bit}\n[parameters]\nlist = [\"P1, 0, Command, , 1\"]"),
            "parameter P1 writes into the control word",
        ),
        (
            "a reference at the place of the direction",
            format!("{bit}\nreverse = {{ point = \"speed_reference\", bit = 0 }}"),
            "point `speed_reference` writes into the control word",
        ),
    ] {
        let found = refused(&with(&control));
        let found = found.unwrap_or_else(|| panic!("{name}: taken"));
        assert!(found.contains(expected), "{name}: {found}");
    }
    assert_eq!(refused(&with(cia)), None);
}

/// A counterexample names what a person needs: state, command, words in hex.
#[test]
fn a_counterexample_names_state_command_and_words() {
    let control = "run = { bit = 0 }\nstop = { bit = 0, is = 0 }\nfault_reset = { mask = 5, value = 5 }";
    let found = refused(&with(control)).unwrap();
    for expected in ["drive    ", "command  fault_reset = true", "holding 0 = 0x0005"] {
        assert!(found.contains(expected), "{found}");
    }
}
