//! The status page: one document, its styles and its scripts, all served by this server.
//!
//! The scripts show the JSON interface with live values. `page.js` opens the views: `overview.js`, `drive.js`,
//! `lines.js`, `events.js`, `recording.js`. `texts.js` chooses the language. The English texts are in the scripts;
//! the texts of another language are in a file such as `de.js`, which `texts.js` and this module name. Without
//! scripts, the page has the tables rendered here and reloads every few seconds; their columns are in `COLUMNS`.

use std::fmt::{self, Write as _};
use std::time::Instant;

use drivegate_core::plant::Plant;
use drivegate_core::process_image::Reading;
use drivegate_model::drive::{ModelPoint, Quality, State};

const DOCUMENT: &str = include_str!("index.html");

/// A file that the document names, or one of its scripts.
#[derive(Debug)]
pub(crate) struct Asset {
    /// An asset has the path `/assets/NAME`.
    pub(crate) name: &'static str,
    pub(crate) content_type: &'static str,
    pub(crate) body: &'static str,
}

macro_rules! assets {
    ($($content_type:literal: $($name:literal),+;)+) => {
        &[$($(Asset { name: $name, content_type: $content_type, body: include_str!($name) }),+),+]
    };
}

/// All files of the status page.
pub(crate) const ASSETS: &[Asset] = assets! {
    "image/svg+xml": "icon.svg";
    "text/css; charset=utf-8": "operate.css", "style.css", "views.css";
    "text/javascript; charset=utf-8":
        "causes.js", "common.js", "controls.js", "de.js", "drive.js", "events.js", "gateway.js", "lines.js", "mqtt.js", "operate.js",
        "overview.js", "page.js", "plot.js", "questions.js", "recording.js", "session.js", "stop_all.js", "stops.js", "strips.js", "texts.js",
        "trend.js";
};

/// Part of the document's head for operating; its script must come before the script of the page.
const OPERATE_HEAD: &str = "<link rel=\"stylesheet\" href=\"assets/operate.css\">\n\
    <script src=\"assets/operate.js\" type=\"module\"></script>";

/// Allows only files of this server: no inline code, no forms.
pub(crate) const SECURITY_POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; \
    img-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'";

/// Columns of the table of drives without scripts.
const COLUMNS: [(ModelPoint, &str); 4] = [
    (ModelPoint::ActualSpeed, "Speed"),
    (ModelPoint::OutputFrequency, "Frequency"),
    (ModelPoint::MotorCurrent, "Current"),
    (ModelPoint::MotorTorque, "Torque"),
];

/// The document with the state of the plant at `now`; `operating` adds the part for commands.
pub(crate) fn render(plant: &Plant, operating: bool, now: Instant) -> String {
    let mut tables = String::new();
    // Writing to a string cannot fail.
    let _ = buses(&mut tables, plant).and_then(|()| drives(&mut tables, plant, now));
    document(plant, operating, &tables)
}

/// The document without any value, for someone who has to log in first.
pub(crate) fn render_login(plant: &Plant) -> String {
    document(plant, true, "<p>Log in to see the drives; this requires scripts.</p>")
}

fn document(plant: &Plant, operating: bool, tables: &str) -> String {
    let (head, mode) = if operating {
        (OPERATE_HEAD, "commands after login")
    } else {
        ("", "read-only")
    };
    DOCUMENT
        .replace("{{operate}}", head)
        .replace("{{mode}}", mode)
        .replace("{{version}}", env!("CARGO_PKG_VERSION"))
        .replace("{{gateway}}", &Escaped(&plant.gateway).to_string())
        .replace("{{tables}}", tables)
}

fn buses(out: &mut String, plant: &Plant) -> fmt::Result {
    out.write_str("<table><caption>Buses</caption><thead><tr><th>Bus<th>State<th>Drives<th>Load</tr></thead><tbody>")?;
    for bus in &plant.buses {
        let image = &bus.image;
        let health = image.health();
        let state = match (&health.reason, health.up) {
            (_, true) => "up".to_string(),
            (Some(reason), false) => format!("down: {reason}"),
            (None, false) => "down".to_string(),
        };
        let load = health
            .load
            .map_or("–".to_string(), |load| format!("{:.0} %", load * 100.0));
        write!(
            out,
            "<tr><td>{}<td>{}<td>{} of {} online<td>{load}</tr>",
            Escaped(&image.spec.name),
            Escaped(&state),
            image.online(),
            image.drives.len(),
        )?;
    }
    out.write_str("</tbody></table>")
}

fn drives(out: &mut String, plant: &Plant, now: Instant) -> fmt::Result {
    out.write_str("<table><caption>Drives</caption><thead><tr><th>Drive<th>State")?;
    for (_, title) in COLUMNS {
        write!(out, "<th>{title}")?;
    }
    out.write_str("<th>Quality</tr></thead><tbody>")?;
    for drive in plant.drives() {
        let reading = drive.reading(now);
        let fault = reading.fault_text();
        let gap = if fault.is_empty() { "" } else { ": " };
        write!(
            out,
            "<tr><td>{}<td>{}{gap}{}",
            Escaped(&reading.spec.name),
            reading.state().map_or("unknown", State::name).replace('_', " "),
            Escaped(&fault)
        )?;
        for (point, _) in COLUMNS {
            cell(out, &reading, point)?;
        }
        match reading.age() {
            Some(age) => write!(out, "<td>{}, {} ms old</tr>", reading.overall().name(), age.as_millis())?,
            None => out.write_str("<td>never read</tr>")?,
        }
    }
    out.write_str("</tbody></table>")
}

/// A value that is not good is marked or omitted.
fn cell(out: &mut String, reading: &Reading<'_>, point: ModelPoint) -> fmt::Result {
    let sample = reading.model(point);
    match (sample.value, sample.quality) {
        (Some(value), Quality::Good) => write!(out, "<td>{value} {}", point.unit()),
        (Some(value), Quality::Stale) => write!(out, "<td><s>{value} {}</s> stale", point.unit()),
        _ => out.write_str("<td>–"),
    }
}

/// Text that is escaped for use between tags or in a quoted attribute.
struct Escaped<'t>(&'t str);

impl fmt::Display for Escaped<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for c in self.0.chars() {
            match c {
                '&' => f.write_str("&amp;")?,
                '<' => f.write_str("&lt;")?,
                '>' => f.write_str("&gt;")?,
                '"' => f.write_str("&quot;")?,
                '\'' => f.write_str("&#39;")?,
                other => f.write_char(other)?,
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use drivegate_core::event::EventKind;
    use drivegate_core::history::TriggerKind;
    use drivegate_model::drive::profile::Profiles;

    /// Size limit of the page with all its files, bytes.
    const MOST_BYTES: usize = 224 * 1024;

    #[test]
    fn text_cannot_become_markup() {
        assert_eq!(
            Escaped("<b a=\"'\">&").to_string(),
            "&lt;b a=&quot;&#39;&quot;&gt;&amp;"
        );
    }

    #[test]
    fn nothing_comes_from_elsewhere_and_no_code_is_inline() {
        for text in ASSETS.iter().map(|asset| asset.body).chain([DOCUMENT]) {
            let own = text.replace("http://www.w3.org/2000/svg", "");
            for foreign in [
                "http://",
                "https://",
                "@import",
                "eval(",
                "innerHTML",
                "insertAdjacentHTML",
            ] {
                assert!(
                    !own.contains(foreign),
                    "{foreign}: texts of drives must not become markup"
                );
            }
        }
        for inline in ["<style", " style=", " onclick=", "<script>", "javascript:"] {
            assert!(!DOCUMENT.contains(inline), "{inline}");
        }
    }

    /// A phone loads the page over a slow line, too.
    #[test]
    fn the_page_keeps_within_its_bytes() {
        let served: usize = ASSETS.iter().map(|asset| asset.body.len()).sum();
        assert!(served + DOCUMENT.len() <= MOST_BYTES, "{served} bytes");
    }

    /// A cause without a text here would reach an operator in words for programs.
    #[test]
    fn every_cause_has_words_for_an_operator() {
        let script = include_str!("causes.js");
        let documented = include_str!("../../../../docs/troubleshooting.md");
        let (_, table) = documented.split_once("| cause | evidence |").expect("the causes");
        let rows = table.lines().skip(2).take_while(|line| line.starts_with('|'));
        let named = rows
            .filter_map(|row| row.split('|').nth(1))
            .flat_map(|cell| cell.split('`').skip(1).step_by(2));
        let profiles = Profiles::built_in();
        let points = profiles.iter().flat_map(|profile| profile.points.iter());
        let blocks = points
            .filter_map(|point| point.blocks.as_ref())
            .map(|blocks| blocks.cause.as_str());
        let causes: BTreeSet<&str> = named.chain(blocks).collect();
        assert!(causes.len() > 25, "{causes:?}");
        for cause in causes.into_iter().filter(|cause| *cause != "fault") {
            assert!(script.contains(&format!("\n  {cause}: [")), "causes.js lacks {cause}");
        }
    }

    /// Searching for another kind would be refused.
    #[test]
    fn the_kinds_of_events_are_those_that_there_are() {
        let script = ASSETS
            .iter()
            .find(|asset| asset.name == "events.js")
            .map(|asset| asset.body);
        let (_, list) = script
            .and_then(|text| text.split_once("const KINDS = ["))
            .unwrap_or_default();
        let (list, _) = list.split_once(']').unwrap_or_default();
        let listed: BTreeSet<&str> = list.split('"').skip(1).step_by(2).collect();
        assert_eq!(listed, EventKind::ALL.iter().map(|kind| kind.name()).collect());
    }

    /// The text between quotation marks at the beginning.
    fn quoted(text: &str) -> Option<&str> {
        let inner = text.strip_prefix('"')?;
        inner.split_once('"').map(|(text, _)| text)
    }

    /// The English texts of the page: the arguments of `t`, and the marked texts of the document.
    fn said() -> BTreeSet<&'static str> {
        let mut said: BTreeSet<&str> = ["read-only", "commands after login"].into();
        for script in ASSETS.iter().filter(|asset| asset.name.ends_with(".js")) {
            for (at, _) in script.body.match_indices("t(\"") {
                let before = script.body[..at].chars().next_back();
                if !before.is_some_and(|c| c.is_alphanumeric() || c == '.' || c == '_') {
                    said.extend(quoted(&script.body[at + 2..]));
                }
            }
        }
        let marked = DOCUMENT
            .split("data-text>")
            .skip(1)
            .filter_map(|rest| rest.split('<').next());
        let labels = DOCUMENT.split("aria-label=").filter(|rest| rest.contains("data-label"));
        said.extend(
            marked
                .chain(labels.filter_map(quoted))
                .filter(|text| !text.contains("{{")),
        );
        said
    }

    /// A text missing in a language would appear in English among the others.
    #[test]
    fn every_language_has_every_text() {
        let languages: Vec<_> = ASSETS
            .iter()
            .filter(|asset| asset.name.len() == "de.js".len())
            .collect();
        assert!(!languages.is_empty());
        let holes = |text: &str| -> BTreeSet<String> {
            let rests = text.split('{').skip(1);
            rests
                .filter_map(|rest| rest.split_once('}'))
                .map(|(name, _)| name.to_string())
                .collect()
        };
        for language in languages {
            let (_, texts) = language.body.split_once("const texts = {").expect("texts");
            let (texts, rest) = texts.split_once("\n};").expect("their end");
            let lines = texts.lines().filter_map(|line| line.trim().split_once("\": \""));
            let translated: Vec<(&str, &str)> = lines
                .map(|(key, text)| (key.trim_matches('"'), text.trim_end_matches("\",")))
                .collect();
            let keys: BTreeSet<&str> = translated.iter().map(|(key, _)| *key).collect();
            assert_eq!(keys, said(), "{}", language.name);
            for (key, text) in translated {
                assert_eq!(holes(key), holes(text), "{}: {key}", language.name);
            }
            let names = EventKind::ALL.iter().map(|kind| kind.name());
            let names = names.chain(ModelPoint::ALL.iter().map(|point| point.name()));
            let names = names.chain(TriggerKind::ALL.iter().map(|kind| kind.name()));
            let states = [
                State::Offline,
                State::NotReady,
                State::Ready,
                State::Running,
                State::Fault,
            ];
            for name in names.chain(states.map(State::name)) {
                let has = [" ", "\n  "]
                    .iter()
                    .any(|before| rest.contains(&format!("{before}{name}: \"")));
                assert!(has, "{} lacks {name}", language.name);
            }
        }
    }

    #[test]
    fn every_file_that_is_named_is_served() {
        let served = |name: &str| ASSETS.iter().any(|asset| asset.name == name);
        for named in DOCUMENT.split("\"assets/").skip(1) {
            let name = named.split('"').next().unwrap_or_default();
            assert!(served(name), "index.html names {name}");
        }
        for asset in ASSETS.iter().filter(|asset| asset.name.ends_with(".js")) {
            for imported in asset.body.split("from \"./").skip(1) {
                let name = imported.split('"').next().unwrap_or_default();
                assert!(served(name), "{} imports {name}", asset.name);
            }
        }
    }
}
