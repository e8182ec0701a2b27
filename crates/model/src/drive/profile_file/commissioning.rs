//! `[commissioning]`: lines for the engineer at the cabinet.

use super::super::commissioning::{Commissioning, Step};
use crate::document::Reader;

/// Maximum number of lines of a step, and of characters of a line: they are also shown with verdicts.
const MOST_LINES: usize = 16;
const MOST_CHARACTERS: usize = 240;

pub(super) fn read(reader: &Reader<'_>) -> Commissioning {
    let Some(table) = reader.table("commissioning") else {
        return Commissioning::default();
    };
    let lines = |step: Step| -> Vec<String> {
        let lines: Vec<String> = table.or(step.name(), Vec::new());
        check(&table, step, &lines);
        lines
    };
    let commissioning = Commissioning {
        connect: lines(Step::Connect),
        terminate: lines(Step::Terminate),
        settings: lines(Step::Settings),
        control_place: lines(Step::ControlPlace),
        timeout: lines(Step::Timeout),
        lamps: lines(Step::Lamps),
        test: lines(Step::Test),
    };
    table.finish();
    commissioning
}

fn check(table: &Reader<'_>, step: Step, lines: &[String]) {
    let key = step.name();
    if lines.len() > MOST_LINES {
        table.problem(
            key,
            format!("{} lines", lines.len()),
            format!("write at most {MOST_LINES}"),
        );
    }
    for line in lines {
        let characters = line.chars().count();
        if line.trim().is_empty() || characters > MOST_CHARACTERS || line.contains(char::is_control) {
            let start: String = line.chars().take(20).filter(|c| !c.is_control()).collect();
            table.problem(
                key,
                format!("`{start}…` has {characters} characters, or a line break"),
                format!("write each line as one text of 1 to {MOST_CHARACTERS} characters"),
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drive::profile::Profile;

    fn read(lines: &str) -> Result<Profile, String> {
        let source = format!("name = \"p\"\nbase = \"vacon-cx\"\n[commissioning]\n{lines}\n");
        Profile::parse("p", &source, false).map_err(|found| found.iter().map(|p| format!("{p}\n")).collect())
    }

    #[test]
    fn a_list_replaces_that_of_the_base_and_keeps_the_others() {
        let ours = read("lamps = [\"look at the red one\"]").unwrap();
        assert_eq!(ours.commissioning.lines(Step::Lamps), ["look at the red one"]);
        assert!(!ours.commissioning.lines(Step::Connect).is_empty());
    }

    #[test]
    fn mistakes_have_their_line() {
        let long = "x".repeat(MOST_CHARACTERS + 1);
        let many = vec!["\"a\""; MOST_LINES + 1].join(", ");
        for (lines, wanted) in [
            (
                "lamp = [\"a\"]",
                "unknown key `lamp`; p:4, commissioning.lamp; did you mean `lamps`?",
            ),
            ("test = [\"\"]", "p:4, commissioning.test; write each line as one text"),
            ("test = [\"a\\nb\"]", "has 3 characters, or a line break"),
            (&format!("test = [\"{long}\"]"), "has 241 characters"),
            (
                &format!("test = [{many}]"),
                "17 lines; p:4, commissioning.test; write at most 16",
            ),
            ("test = \"a\"", "p:4, commissioning.test"),
        ] {
            let found = read(lines).unwrap_err();
            assert!(found.contains(wanted), "{lines}: {found}");
        }
    }
}
