//! The page of the documentation lists what the code implements.

use super::*;

#[test]
fn the_page_has_every_verdict() {
    let page = include_str!("../../../../docs/troubleshooting.md");
    let (_, page) = page.split_once("\n### Verdicts\n").unwrap();
    let rows: Vec<&str> = page.lines().filter(|line| line.starts_with("| `")).collect();
    for (place, cause) in Cause::ALL.into_iter().enumerate() {
        let row = format!("| `{}` | {} |", cause.name(), cause.meaning());
        assert!(rows[place].starts_with(&row), "docs/troubleshooting.md lacks {row}");
        assert_eq!(serde_json::to_value(cause).unwrap(), cause.name());
    }
    for certainty in [Certainty::Fits, Certainty::Likely, Certainty::Certain] {
        assert!(page.contains(&format!("`{}`: ", certainty.name())), "{certainty:?}");
        assert_eq!(serde_json::to_value(certainty).unwrap(), certainty.name());
    }
    let counted = serde_json::to_value(Counted::default()).unwrap();
    for field in counted.as_object().unwrap().keys() {
        assert!(
            page.contains(&format!("`{field}`")),
            "docs/troubleshooting.md lacks {field}"
        );
    }
    let memory = format!("{} bytes for each drive", figures::BYTES_PER_DRIVE);
    assert!(page.contains(&memory), "docs/troubleshooting.md lacks {memory}");
}
