//! Reads `[params]`: when parameters are read, and the names of parameters.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use super::keys::PARAMS;
use super::values;
use drivegate_core::files::names;
use drivegate_core::parameters::Names;
use drivegate_core::process_image::Machine;
use drivegate_model::document::{self, Reader};
use drivegate_model::drive::profile::Profiles;

/// How parameters are read and kept.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ParamsSettings {
    /// Directory of the readings.
    pub dir: PathBuf,
    /// Interval at which all parameters are read; `None`: only on request.
    pub every: Option<Duration>,
    /// Names of parameters that replace the names in the profiles, by profile.
    pub names: BTreeMap<String, Arc<Names>>,
    /// Configured drives that this process does not serve, with their names; empty in a gateway.
    pub others: Vec<(Machine, String)>,
}

impl ParamsSettings {
    /// Settings that only state where readings are stored: in a subdirectory of `state_dir`.
    pub(super) fn below(state_dir: &Path) -> ParamsSettings {
        ParamsSettings {
            dir: state_dir.join(names::PARAMS),
            ..ParamsSettings::default()
        }
    }
}

pub(super) fn read(reader: &Reader<'_>, base: &Path, state_dir: &Path, profiles: &Profiles) -> ParamsSettings {
    let mut settings = ParamsSettings::below(state_dir);
    settings.every = PARAMS.every.read(reader);
    for file in PARAMS.names.get(reader) {
        let path = values::resolved(base, file);
        match read_names(&path, profiles) {
            Ok((profile, names)) => drop(settings.names.insert(profile, Arc::new(names))),
            Err(what) => reader.problem(PARAMS.names.name, what, "correct the list, or leave it out"),
        }
    }
    reader.finish();
    settings
}

/// Reads a list of names; returns the profile of the list and the names.
fn read_names(path: &Path, profiles: &Profiles) -> Result<(String, Names), String> {
    let shown = path.display();
    let profile = path
        .file_stem()
        .map(|stem| stem.to_string_lossy().into_owned())
        .unwrap_or_default();
    if profiles.get(&profile).is_none() {
        let known: Vec<&str> = profiles.names().collect();
        let known = known.join(", ");
        return Err(format!("{shown} is not named after a profile; known profiles: {known}"));
    }
    let text = document::read_file(path).map_err(|problem| problem.to_string())?;
    let names = Names::parse(&text).map_err(|why| format!("{shown}: {why}"))?;
    Ok((profile, names))
}
