use super::*;
use drivegate_model::document::Problem;
use drivegate_model::drive::profile::Profiles;

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
         [[range]]\ntable = \"coil\"\nfirst = 0\nlast = 9\nread = 5\nwrite = 1\n\
         [[point]]\nname = \"status_word\"\nat = \"holding 3\"\nclass = \"fast\"\nhidden = true\n\
         [[point]]\nname = \"speed_reference\"\nat = \"holding 1\"\nclass = \"slow\"\nwrite = true\n\
         [[point]]\nname = \"own_word\"\nat = \"holding 0\"\nclass = \"fast\"\nhidden = true\n\
         [[point]]\nname = \"reset_command\"\nat = \"holding 4\"\nclass = \"never\"\nwrite = true\nhidden = true\n\
         [[point]]\nname = \"reset_coil\"\nat = \"coil 3\"\nclass = \"never\"\nwrite = true\nhidden = true\n\
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
            "a parameter at the register of the reset",
            format!(
                "{bit}\nfault_reset = {{ point = \"reset_command\", bit = 0 }}\n[parameters]\nlist = [\"P1, 4, Reset, , 1\"]"
            ),
            "parameter P1 writes into the control word",
        ),
        (
            "a status that is the control word",
            format!("{bit}\n[[state]]\nis = \"fault\"\npoint = \"own_word\"\nmask = 8\nvalue = 8"),
            "`fault` is read from the control word, which reads as it was written",
        ),
        (
            "a step that waits for the control word",
            cia.replace(
                "point = \"status_word\", mask = 0x6F, is = 0x23",
                "point = \"own_word\", mask = 7, is = 7",
            ),
            "`until of a step` is read from the control word",
        ),
        (
            "two states with one predicate",
            format!("{bit}\n[[state]]\nis = \"fault\"\npoint = \"status_word\"\nmask = 4\nvalue = 4"),
            "`running` is the same state as `fault`",
        ),
        (
            "a direction that alone takes the stop away (Yaskawa)",
            "run = { bit = 0 }\nstop = { mask = 3, value = 0 }\nreverse = { bit = 1 }".to_string(),
            "a direction alone takes the word of a stop away",
        ),
        (
            "a form on a coil with another bit",
            format!("{bit}\nfault_reset = {{ point = \"reset_coil\", bit = 3 }}"),
            "a coil has no other",
        ),
        (
            "a reset of one word",
            format!("{bit}\nfault_reset = {{ steps = [{{ write = 8 }}] }}"),
            "write two steps",
        ),
        (
            "a reset whose second word resets, too",
            format!("{bit}\nfault_reset = {{ steps = [{{ write = 8 }}, {{ write = 12 }}] }}"),
            "the second word does not end the first",
        ),
        (
            "a reset that carries the run command, in words",
            format!("{bit}\nfault_reset = {{ steps = [{{ write = 9 }}, {{ write = 1 }}] }}"),
            "the motor starts without a run command",
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
    let reference = "name = \"speed_reference\"\nat = \"holding 1\"\n";
    let negative = with(bit).replace(reference, &format!("{reference}type = \"i16\"\nscale = -0.01\n"));
    let found = refused(&negative).unwrap();
    assert!(found.contains("would be a negative count"), "{found}");
    assert_eq!(refused(&with(cia)), None);
}

/// Profiles that are only suspicious are accepted with a warning.
#[test]
fn doubtful_profiles_are_taken_with_a_warning() {
    let bit = "run = { bit = 0 }\nstop = { bit = 0, is = 0 }";
    let running = "[[state]]\nis = \"running\"\npoint = \"status_word\"\nmask = 0x0004\nvalue = 0x0004\n";
    let sound = with(bit);
    let coil = "at = \"coil 0\"\nrun = { bit = 0, is = 0 }\nstop = { bit = 0 }";
    let status = "name = \"status_word\"\nat = \"holding 3\"\n";
    let reference = "name = \"speed_reference\"\nat = \"holding 1\"\n";
    for (text, expected) in [
        (sound.clone(), None),
        (sound.replace(running, ""), Some("no point or state is `running`")),
        (
            sound.replace(status, &format!("{status}invalid = [0xFFFF]\n")),
            Some("0xffff of `status_word` shows `running`"),
        ),
        (
            sound.replace(status, &format!("{status}invalid = [0]\n")),
            Some("0x0000 of `status_word` shows a drive that stands"),
        ),
        (sound.replace(status, &format!("{status}invalid = [0xFFF8]\n")), None),
        (
            sound.replace(reference, &format!("{reference}scale = 0.01\noffset = -100.0\n")),
            Some("means -100 %: a drive that is started before a reference was written turns in reverse"),
        ),
        (
            sound.replace(&format!("at = \"holding 0\"\n{bit}"), coil),
            Some("0 in coil 0 is a run command"),
        ),
    ] {
        let profile = Profile::parse("p.toml", &text, false).unwrap_or_else(|why| panic!("{expected:?}: {why:?}"));
        let found: Vec<String> = profile.warnings.iter().map(ToString::to_string).collect();
        match expected {
            Some(expected) => assert!(found.len() == 1 && found[0].contains(expected), "{expected}: {found:?}"),
            None => assert!(found.is_empty(), "{found:?}"),
        }
    }
    for profile in Profiles::built_in().iter() {
        // Warnings of built-in profiles are not kept, so the text of the profile is parsed again.
        let again = Profile::parse("again.toml", &profile.text, false).unwrap();
        assert!(again.warnings.is_empty(), "{}: {:?}", profile.name, again.warnings);
    }
}

/// A reset that is written as words is reported as the pulse of its bits.
#[test]
fn a_reset_in_words_is_a_pulse() {
    let reset = |form: &str| {
        let control =
            format!("always = {{ set = [10] }}\nrun = {{ bit = 0 }}\nstop = {{ mask = 0x0301, value = 0 }}\n{form}");
        let profile = Profile::parse("p.toml", &with(&control), false).unwrap();
        assert_eq!(prove(&profile).err(), None);
        profile.control.unwrap().fault_reset.unwrap()
    };
    let words = "steps = [{ write = 0x047E }, { write = 0x04FE, time = \"100ms\" }, { write = 0x047E }]";
    let of_three = reset(&format!("fault_reset = {{ {words} }}"));
    let of_two = reset("fault_reset = { steps = [{ write = 0x04FE, time = \"100ms\" }, { write = 0x047E }] }");
    let by_mask = reset("fault_reset = { mask = 0x0381, value = 0x0080, hold = \"100ms\" }");
    assert_eq!((of_three, of_two), (by_mask, by_mask));
}

/// A counterexample contains what a person needs: state, command, words in hex.
#[test]
fn a_counterexample_names_state_command_and_words() {
    let control = "run = { bit = 0 }\nstop = { bit = 0, is = 0 }\nfault_reset = { mask = 5, value = 5 }";
    let found = refused(&with(control)).unwrap();
    for expected in ["drive    ", "command  fault_reset = true", "holding 0 = 0x0005"] {
        assert!(found.contains(expected), "{found}");
    }
}
