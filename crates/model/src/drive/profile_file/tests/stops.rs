//! `also_stop` of `[control]`: words by which a drive stops by other means.

use super::*;
use crate::drive::ModelPoint;
use crate::drive::control::ControlItem;
use drivegate_proto::Table;

/// The text of a profile with this `[control]`.
fn source(control: &str) -> String {
    format!(
        "{HEAD}[[point]]\nname = \"status_word\"\nat = \"holding 3\"\nclass = \"fast\"\nhidden = true\n\
         [[point]]\nname = \"other\"\nat = \"holding 4\"\nwrite = true\n\
         [control]\nat = \"holding 0\"\n{control}\n"
    )
}

fn control(lines: &str) -> Profile {
    Profile::parse("p.toml", &source(lines), false).unwrap()
}

const AT: ControlItem = ControlItem {
    table: Table::Holding,
    address: 0,
};

/// A sequence as for Siemens: the bits without which a word is ignored are part of the masks.
const SEQUENCE: &str = "always = { set = [1, 2, 3, 10], clear = [8] }\nstop = { mask = 0x0401, value = 0x0400 }\n\
    run = { steps = [{ write = 0x040E }, { write = 0x040F }] }\nreverse = { bit = 11 }\n\
    also_stop = [{ mask = 0x0402, value = 0x0400 }, { bit = 2, is = 0 }]";

#[test]
fn words_of_other_stops_are_stops_and_what_follows_is_made_from_the_word_of_a_stop() {
    let profile = control(SEQUENCE);
    let control = profile.control.as_ref().unwrap();
    for (word, stops, goes_on_from) in [
        (0x040F, false, 0x040F),
        (0x0C0F, false, 0x0C0F),
        (0x040E, true, 0x040E),
        (0x040D, true, 0x040E),
        (0x0C0D, true, 0x0C0E),
        (0x000D, false, 0x000D),
        (0x000B, true, 0x040E),
        (0x0C8B, true, 0x0C8E),
    ] {
        assert_eq!(profile.is_stop(Table::Holding, 0, word), stops, "{word:#06x}");
        assert!(!profile.is_stop(Table::Holding, 1, word), "{word:#06x} elsewhere");
        assert_eq!(control.standing(word), goes_on_from, "{word:#06x}");
        assert_eq!(
            control.admits(AT, word),
            stops || word & !0x0800 == 0x040F,
            "{word:#06x}"
        );
        let runs = profile.runs_by(Table::Holding, 0, word);
        assert_eq!(runs == Some(false), stops, "{word:#06x}");
    }
}

/// A run bit together with a bit that stops the drive is not a run command, in reads either.
#[test]
fn a_run_bit_beside_another_stop_reads_as_no_run_command() {
    let profile = control(
        "always = { clear = [1, 3] }\nrun = { bit = 0 }\nstop = { bit = 0, is = 0 }\nalso_stop = [{ bit = 3 }, { bit = 1 }]",
    );
    let Source::Derived(derived) = &profile.model_point(ModelPoint::Run).unwrap().source else {
        panic!("`run` follows from [control]");
    };
    for (word, runs) in [(1, true), (5, true), (9, false), (3, false), (0, false), (8, false)] {
        let read = derived.value([Value::Integer(word)], None);
        assert_eq!(read, Some(Value::Bool(runs)), "{word}");
    }
}

#[test]
fn wrong_words_of_other_stops_are_reported() {
    let bits = "always = { set = [10], clear = [1] }\nrun = { bit = 0 }\nstop = { mask = 0x0401, value = 0x0400 }\n\
                reverse = { bit = 5 }";
    let sequence = SEQUENCE.split("also_stop").next().unwrap();
    for (control, stops, expected) in [
        (
            bits,
            "{ mask = 0, value = 0 }",
            "0x0000 is not within the mask 0x0000; p.toml:",
        ),
        (bits, "{ mask = 2, value = 1 }", "0x0001 is not within the mask 0x0002"),
        (bits, "{ mask = 2 }", "`value` is missing"),
        (bits, "{}", "the form names no bits"),
        (bits, "{ bit = 16 }", "there is no bit 16 in a word"),
        (
            bits,
            "{ bit = 1, mask = 2, value = 2 }",
            "a form has `bit` or `mask`, not both",
        ),
        (bits, "{ bit = 1, hold = \"1s\" }", "unknown key `hold`"),
        (
            bits,
            "{ bit = 0 }",
            "0x0001 in 0x0001: a run command with the bits of `always` can have that, too",
        ),
        (
            bits,
            "{ bit = 10 }",
            "0x0400 in 0x0400: a run command with the bits of `always` can have that, too",
        ),
        (bits, "{ bit = 7 }", "0x0080 in 0x0080: a run command"),
        (bits, "{ bit = 5 }", "0x0020 in 0x0020: a run command"),
        (
            bits,
            "{ mask = 0x0405, value = 0x0404 }",
            "0x0404 in 0x0405 is a stop by `stop` already",
        ),
        (
            bits,
            "{ bit = 1, point = \"other\" }",
            "is not in the register to which `stop` is written",
        ),
        (
            bits,
            "{ bit = 1, once = true }",
            "is not in the register to which `stop` is written",
        ),
        (sequence, "{ bit = 11 }", "0x0800 in 0x0800: a run command"),
        (sequence, "{ bit = 2 }", "0x0004 in 0x0004: a run command"),
    ] {
        let found = mistakes("p.toml", &source(&format!("{control}\nalso_stop = [{stops}]")));
        assert!(
            found.contains(expected) && found.contains("also_stop"),
            "{stops}: {found}"
        );
    }
    let found = mistakes("p.toml", &source(&format!("{bits}\nalso_stop = 3")));
    assert!(
        found.contains("`also_stop` is an integer, not a list of tables"),
        "{found}"
    );
    let many = vec!["{ bit = 1 }"; 17].join(", ");
    let found = mistakes("p.toml", &source(&format!("{bits}\nalso_stop = [{many}]")));
    assert!(
        found.contains("17 forms; p.toml:") && found.contains("write 16 at most"),
        "{found}"
    );
}

#[test]
fn a_coil_or_a_stop_elsewhere_has_no_other_stops() {
    let elsewhere = "run = { bit = 0 }\nstop = { point = \"other\", bit = 0 }\nalways = { clear = [3] }\n\
                     also_stop = [{ bit = 3 }]";
    let found = mistakes("p.toml", &source(elsewhere));
    assert!(
        found.contains("is not in the register to which `stop` is written"),
        "{found}"
    );
}
