//! The printable report of a drill: one page of HTML without anything from elsewhere. Pure.

use std::fmt::Write as _;

use super::{seconds, state_text};
use drivegate_core::drill::{DrillReport, DrillStep, Kind};

const STYLE: &str = "body{font:11pt sans-serif;max-width:48em;margin:2em auto}table{border-collapse:collapse;width:100%}\
    th,td{border:1px solid #999;padding:.3em .5em;text-align:left;vertical-align:top}.result{font-size:1.5em}\
    .sign td{height:3em}@media print{body{margin:0}}";

/// The report of a drill as a page.
pub(super) fn of(drill: &DrillReport) -> String {
    let mut page = format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><title>Drill {id}</title><style>{STYLE}</style></head><body>\n\
        <h1>Drill of drive {drive}</h1>\n<p class=\"result\">Result: <strong>{state}</strong>: {text}</p>\n<table>\n",
        id = escaped(&drill.id),
        drive = escaped(&drill.drive),
        state = state_text(drill.state),
        text = escaped(&drill.text),
    );
    let not = "unknown".to_string();
    let rows = [
        ("Drill", drill.id.clone()),
        (
            "Drive",
            format!(
                "{}, bus {}, port {}, address {}",
                drill.drive, drill.bus, drill.port, drill.address
            ),
        ),
        ("Profile", drill.profile.clone()),
        ("By", drill.who.clone()),
        ("Armed", drill.armed_at.clone()),
        (
            "Started",
            drill.started_at.clone().unwrap_or_else(|| "not started".to_string()),
        ),
        ("Ended", drill.ended_at.clone().unwrap_or_else(|| not.clone())),
        (
            "Speed",
            format!("{} % of its range, at most {} %", drill.speed, drill.max_speed),
        ),
        (
            "Time allowed",
            format!("{} s from the cause to standstill", seconds(drill.limit_ms)),
        ),
        ("Last stop", drill.last_stop.clone().unwrap_or(not)),
    ];
    for (head, value) in rows {
        // A string takes all that is written.
        let _ = writeln!(page, "<tr><th>{head}</th><td>{}</td></tr>", escaped(&value));
    }
    page += "</table>\n<h2>Tests</h2>\n<table>\n<tr><th>Stopped by</th><th>Result</th><th>Cause</th><th>Time to \
             standstill</th><th>Observed</th></tr>\n";
    for kind in Kind::ALL {
        let step = drill.steps.iter().find(|step| step.kind == kind);
        page += &row(kind, step);
    }
    page += "</table>\n<p>A drill shows that this motor stopped in this way, at this speed and load, at that time. It \
             is not a safety function and does not replace testing one.</p>\n<table \
             class=\"sign\"><tr><td>Name</td><td>Date</td><td>Signature</td></tr></table>\n</body></html>\n";
    page
}

fn row(kind: Kind, step: Option<&DrillStep>) -> String {
    let way = match kind {
        Kind::Order => "a stop command",
        Kind::Client => "a client that goes silent (supervision)",
        Kind::Gateway => "a gateway that goes silent (the drive's own timeout)",
    };
    let Some(step) = step else {
        return format!("<tr><td>{way}</td><td>not tested</td><td></td><td></td><td></td></tr>\n");
    };
    let took = step.took_ms.map_or_else(String::new, |took| {
        let at_most = if step.upper_bound { "at most " } else { "" };
        format!("{at_most}{:.2} s", seconds(took))
    });
    format!(
        "<tr><td>{way}</td><td>{}</td><td>{}</td><td>{took}</td><td>{}</td></tr>\n",
        state_text(step.state),
        escaped(step.cause_at.as_deref().unwrap_or_default()),
        escaped(&step.seen)
    )
}

fn escaped(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => escaped += "&amp;",
            '<' => escaped += "&lt;",
            '>' => escaped += "&gt;",
            '"' => escaped += "&quot;",
            '\'' => escaped += "&#39;",
            c => escaped.push(c),
        }
    }
    escaped
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_text_and_what_was_not_tried_is_said() {
        let json = r#"{"id": "1-<b>", "drive": "<script>alert(1)</script>", "bus": "b", "port": "/dev/x", "address": 1,
            "profile": "vacon-nx", "who": "http \"alice\" & co", "state": "passed", "text": "it stood", "speed": 10.0,
            "max_speed": 20.0, "limit_ms": 10000, "armed_at": "t",
            "steps": [{"kind": "gateway", "state": "passed", "took_ms": 8000, "upper_bound": true, "seen": "it stood"}]}"#;
        let page = of(&serde_json::from_str(json).unwrap());
        assert!(
            !page.contains("<script") && page.contains("&lt;script&gt;alert(1)"),
            "{page}"
        );
        assert!(page.contains("http &quot;alice&quot; &amp; co"), "{page}");
        assert!(page.contains("at most 8.00 s"), "{page}");
        assert_eq!(page.matches("not tested").count(), 2, "{page}");
        assert!(
            !page.contains("http://") && !page.contains("https://"),
            "nothing is loaded"
        );
    }
}
