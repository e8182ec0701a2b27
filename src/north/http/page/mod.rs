//! The status page: one document with its style and its script, all served by this server.
//!
//! The script shows the JSON interface live. Without scripts the page has the tables rendered here and reloads every
//! few seconds. A column has its heading in `index.html` and its cells in `page.js`; those without scripts are in
//! `COLUMNS`.

use std::fmt::{self, Write as _};
use std::time::Instant;

use crate::drive::{ModelPoint, Quality, State};
use crate::plant::Plant;
use crate::process_image::Reading;

const DOCUMENT: &str = include_str!("index.html");

/// Style sheet.
pub(in crate::north::http) const STYLE: &str = include_str!("style.css");

/// Script.
pub(in crate::north::http) const SCRIPT: &str = include_str!("page.js");

/// Style sheet of the operating part.
pub(in crate::north::http) const OPERATE_STYLE: &str = include_str!("operate.css");

/// Script of the operating part.
pub(in crate::north::http) const OPERATE_SCRIPT: &str = include_str!("operate.js");

/// What the document has in its head for the operating part; its script comes before the page's.
const OPERATE_HEAD: &str = "<link rel=\"stylesheet\" href=\"assets/operate.css\">\n\
    <script src=\"assets/operate.js\" defer></script>";

/// Icon.
pub(in crate::north::http) const ICON: &str = include_str!("icon.svg");

/// Only this server's own files, no inline code, no forms.
pub(in crate::north::http) const SECURITY_POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; \
    img-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'";

/// Columns of the table of drives without scripts.
const COLUMNS: [(ModelPoint, &str); 4] = [
    (ModelPoint::ActualSpeed, "Speed"),
    (ModelPoint::OutputFrequency, "Frequency"),
    (ModelPoint::MotorCurrent, "Current"),
    (ModelPoint::MotorTorque, "Torque"),
];

/// The document with the state of the plant at `now`; `operating` says whether it has the part that commands.
pub(in crate::north::http) fn render(plant: &Plant, operating: bool, now: Instant) -> String {
    let mut tables = String::new();
    // Writing to a string cannot fail.
    let _ = buses(&mut tables, plant).and_then(|()| drives(&mut tables, plant, now));
    document(plant, operating, &tables)
}

/// The document without any value, for somebody who has to log in first.
pub(in crate::north::http) fn render_login(plant: &Plant) -> String {
    document(plant, true, "<p>Log in to see the drives; that needs scripts.</p>")
}

fn document(plant: &Plant, operating: bool, tables: &str) -> String {
    let (head, mode) = match operating {
        true => (OPERATE_HEAD, "commands after login"),
        false => ("", "read only"),
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
    use super::*;

    #[test]
    fn text_cannot_become_markup() {
        assert_eq!(
            Escaped("<b a=\"'\">&").to_string(),
            "&lt;b a=&quot;&#39;&quot;&gt;&amp;"
        );
    }

    #[test]
    fn nothing_comes_from_elsewhere_and_no_code_is_inline() {
        for text in [DOCUMENT, STYLE, SCRIPT, OPERATE_STYLE, OPERATE_SCRIPT] {
            for foreign in ["http://", "https://", "@import", "eval("] {
                let own = text.replace("http://www.w3.org/2000/svg", "");
                assert!(!own.contains(foreign), "{foreign}");
            }
        }
        for inline in ["<style", " style=", " onclick=", "<script>", "javascript:"] {
            assert!(!DOCUMENT.contains(inline), "{inline}");
        }
        for script in [SCRIPT, OPERATE_SCRIPT] {
            assert!(!script.contains("innerHTML"), "texts of drives must not become markup");
        }
    }
}
