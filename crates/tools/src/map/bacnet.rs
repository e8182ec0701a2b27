//! The BACnet objects of a configuration, and its EDE tables.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use super::export::quoted;
use crate::failure::{Failure, Outcome};
use crate::report;
use drivegate_core::files;
use drivegate_gateway::config::Settings;
use drivegate_north::bacnet::ede::{self, Ede};
use drivegate_north::bacnet::listing::{self, COLUMNS, Line};
use drivegate_north::bacnet::objects::ListedDevice;

/// The devices that the configuration shows; none without `[bacnet]`.
pub(crate) fn devices(settings: &Settings) -> Option<Vec<ListedDevice>> {
    let buses = settings.buses.iter().map(|bus| (&bus.spec, bus.drives.as_slice()));
    let options = settings.bacnet.as_ref()?;
    Some(listing::devices(&settings.gateway, options, buses))
}

/// Prints the objects, and writes the tables if they were requested.
pub(super) fn run(settings: &Settings, csv: bool, ede: Option<&Path>) -> Outcome {
    let Some(devices) = devices(settings) else {
        let why = "no BACnet objects; --bacnet; add [bacnet] to the configuration";
        return Err(Failure::Misused(why.to_string()));
    };
    if let Some(path) = ede {
        write(path, &ede::tables(&settings.gateway, &devices))?;
    }
    let lines = listing::lines(&devices);
    Ok(report::print(&if csv { as_csv(&lines) } else { as_text(&lines) }))
}

fn as_csv(lines: &[Line]) -> String {
    let mut text = COLUMNS.join(",") + "\n";
    for line in lines {
        let cells: Vec<String> = line.cells().iter().map(|cell| quoted(cell)).collect();
        // Writing to a String cannot fail.
        let _ = writeln!(text, "{}", cells.join(","));
    }
    text
}

fn as_text(lines: &[Line]) -> String {
    let mut table = report::table(COLUMNS);
    lines.iter().for_each(|line| table.add_row(line.cells()));
    report::lines(&table)
}

/// Writes the three tables; existing files are replaced.
fn write(path: &Path, tables: &Ede) -> Result<(), String> {
    let beside = |what: &str| -> PathBuf {
        let stem = path.file_stem().unwrap_or_default().to_string_lossy();
        path.with_file_name(format!("{stem}-{what}.csv"))
    };
    let files = [
        (path.to_path_buf(), &tables.objects),
        (beside("state-texts"), &tables.state_texts),
        (beside("units"), &tables.units),
    ];
    for (path, text) in files {
        let written = files::replace(&path, text.as_bytes());
        written.map_err(|error| format!("cannot write {}: {error}; --ede; choose another place", path.display()))?;
    }
    Ok(())
}
