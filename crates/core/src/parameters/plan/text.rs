//! A plan as text, as shown by a dry run.

use std::fmt::{self, Display};

use super::super::file::Id;
use super::Plan;
use drivegate_model::drive::parameters::RawValue;

/// Parameters that a list names; more are counted.
const NAMED: usize = 12;

/// The line of a change with the values on the bus after those in a unit.
pub(super) fn with_counts(line: String, from: RawValue, to: RawValue) -> String {
    let (RawValue::Word(from), RawValue::Word(to)) = (from, to) else {
        return line;
    };
    let counts = format!("{from} → {to}");
    if line.ends_with(&format!(": {counts}")) {
        line
    } else {
        format!("{line} ({counts})")
    }
}

/// Text of a list: `5, 7, 9 and 3 more`.
pub(super) fn list(ids: &[Id]) -> String {
    let named: Vec<&str> = ids.iter().take(NAMED).map(Id::name).collect();
    match ids.len().saturating_sub(NAMED) {
        0 => named.join(", "),
        more => format!("{} and {more} more", named.join(", ")),
    }
}

/// The steps, one line each; ends with a line feed.
impl Display for Plan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.writes.len() {
            0 => writeln!(f, "nothing to restore")?,
            1 => writeln!(f, "1 parameter to write:")?,
            count => writeln!(f, "{count} parameters to write, in this order:")?,
        }
        for write in &self.writes {
            writeln!(f, "  {}", write.line)?;
        }
        if let Some((address, value)) = self.handling.save {
            writeln!(
                f,
                "then {value} to register {address:04X}H, so that the drive keeps them at power-off"
            )?;
        }
        if !self.left_out.is_empty() {
            writeln!(f, "left out, although they differ; --only ID restores one:")?;
        }
        for (_, why) in &self.left_out {
            writeln!(f, "  {why}")?;
        }
        for note in &self.notes {
            writeln!(f, "note: {note}")?;
        }
        if let Some(need) = &self.handling.needs {
            writeln!(f, "first {}: otherwise the drive refuses some of them", need.remedy)?;
        }
        Ok(())
    }
}
