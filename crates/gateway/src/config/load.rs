//! Loads settings from the text of a file: every section is read, then their combination is checked.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use super::gateway::{self, Gateway};
use super::keys::ROOT;
use super::params::ParamsSettings;
use super::settings::{BusSettings, ENVIRONMENT, Settings, StateFiles, Unusable};
use super::together::{Clients, judge};
use super::{
    authority, bacnet, bus, drill, http, interlocks, log, modbus_tcp, mqtt, params, recordings, stale, unused_profiles,
};
use drivegate_bus::proof;
use drivegate_core::process_image::Access;
use drivegate_http::local::SocketPath;
use drivegate_model::document::{self, Document, Finding, Problem, Reader};
use drivegate_model::drive::Profile;
use drivegate_north::slot as slot_server;

/// The outcome of loading a configuration file.
#[derive(Debug)]
pub struct Loaded {
    /// The settings; absent if the configuration has any error.
    pub settings: Option<Settings>,
    /// The errors in the configuration.
    pub errors: Vec<Problem>,
    /// The warnings: valid, but probably not as intended.
    pub warnings: Vec<Problem>,
}

impl Settings {
    /// Reads the file `path`, applies the variables `DRIVEGATE__SECTION__KEY` of `env`, and checks everything.
    pub fn load(path: impl AsRef<Path>, env: impl Iterator<Item = (String, String)>) -> Loaded {
        let path = path.as_ref();
        match document::read_file(path) {
            Ok(source) => Settings::parse(path, &source, env),
            Err(mut problem) => Loaded {
                settings: None,
                errors: {
                    if path == Path::new(DEFAULT_FILE) && !path.exists() {
                        problem.finding.remedy = NO_FILE.to_string();
                    }
                    vec![problem]
                },
                warnings: Vec::new(),
            },
        }
    }

    /// Like [`Settings::load`], for who is going to command the drives: the commands of the user's profiles are proved, too.
    pub fn load_proved(path: impl AsRef<Path>, env: impl Iterator<Item = (String, String)>) -> Loaded {
        let mut loaded = Settings::load(path, env);
        loaded.errors.extend(loaded.settings.iter().flat_map(unsafe_commands));
        loaded.settings = loaded.settings.filter(|_| loaded.errors.is_empty());
        loaded
    }

    /// Like [`Settings::load`], with `source` as the text of the file.
    pub fn parse(path: impl AsRef<Path>, source: &str, env: impl Iterator<Item = (String, String)>) -> Loaded {
        parse(path.as_ref(), source, env).0
    }
}

/// Default path of the configuration.
pub const DEFAULT_FILE: &str = "/etc/drivegate/drivegate.toml";
/// Remedy if no configuration exists yet.
const NO_FILE: &str = "name the file with --config; `drivegate try` finds drives and writes a configuration";

impl Settings {
    /// The local socket of the gateway that runs with the file `path`, also if the file is invalid since it started.
    pub fn socket_of(path: &Path, env: impl Iterator<Item = (String, String)>) -> SocketPath {
        let source = document::read_file(path).unwrap_or_default();
        let mut document = Document::parse(path.display().to_string(), &source);
        document.ensure_section(ROOT.gateway.name);
        document.overlay(ENVIRONMENT, env);
        let base = path.parent().unwrap_or(Path::new(""));
        let gateway = ROOT.gateway.table(&document.reader());
        gateway.map_or(SocketPath::Default, |gateway| gateway::read_socket(&gateway, base))
    }
}

/// The environment variables that override the configuration. Invalid UTF-8 in them becomes U+FFFD, which
/// [`Settings::load`] refuses.
pub fn environment() -> impl Iterator<Item = (String, String)> {
    std::env::vars_os().filter_map(|(name, value)| {
        let name = name.into_string().ok().filter(|name| name.starts_with(ENVIRONMENT))?;
        Some((name, value.to_string_lossy().into_owned()))
    })
}

fn not_text(name: &str) -> Problem {
    Problem::of_file(name, "", Finding::new("the variable is not UTF-8 text", "set it again"))
}

/// The outcome, and every key the loader knows.
pub(super) fn parse(path: &Path, source: &str, env: impl Iterator<Item = (String, String)>) -> (Loaded, Vec<String>) {
    let mut document = Document::parse(path.display().to_string(), source);
    for section in [ROOT.gateway.name, ROOT.recordings.name, ROOT.log.name] {
        document.ensure_section(section);
    }
    let (variables, broken): (Vec<_>, Vec<_>) = env
        .filter(|(name, _)| name.starts_with(ENVIRONMENT))
        .partition(|(_, value)| !value.contains(char::REPLACEMENT_CHARACTER));
    document.overlay(ENVIRONMENT, variables);
    let base = path.parent().unwrap_or(Path::new(""));
    let mut of_profiles = OfProfiles {
        named: unused_profiles::named_by_drives(document.root()),
        ..OfProfiles::default()
    };
    let settings = read(&document.reader(), base, &mut of_profiles);
    let known = document.known_keys().into_iter().collect();
    let is_toml = document.is_toml();
    let (mut errors, mut warnings) = document.into_findings();
    warnings.extend(
        settings
            .iter()
            .flat_map(|settings| settings.profiles.warnings())
            .cloned(),
    );
    warnings.extend(of_profiles.warnings);
    if is_toml {
        errors.extend(of_profiles.errors);
        errors.extend(broken.iter().map(|(name, _)| not_text(name)));
    }
    let loaded = Loaded {
        settings: settings.filter(|_| errors.is_empty()),
        errors,
        warnings,
    };
    (loaded, known)
}

/// The profiles that drives use, and the problems in the files of profiles.
#[derive(Default)]
struct OfProfiles {
    named: BTreeSet<String>,
    errors: Vec<Problem>,
    warnings: Vec<Problem>,
}

fn read(reader: &Reader<'_>, base: &Path, of_profiles: &mut OfProfiles) -> Option<Settings> {
    let gateway = ROOT.gateway.table(reader).map(|table| gateway::read(&table, base));
    let mut gateway = gateway.unwrap_or_default();
    let problems = std::mem::take(&mut gateway.errors);
    let faulty = unused_profiles::faulty(&problems);
    (of_profiles.errors, of_profiles.warnings) =
        unused_profiles::divide(problems, &faulty, &of_profiles.named, &gateway.profiles);
    let faulty = unused_profiles::meant(faulty);
    let Gateway {
        name,
        socket,
        state_dir,
        profile_dirs,
        profiles,
        stale_after,
        ..
    } = gateway;
    let tables = ROOT.bus.tables(reader);
    let buses: Vec<bus::Found> = tables
        .iter()
        .map(|table| bus::read(table, base, &profiles, &faulty))
        .collect();
    let names: Vec<&str> = buses
        .iter()
        .filter_map(|bus| bus.name.as_ref())
        .map(|(name, _)| name.as_str())
        .collect();
    let modbus_tcp = ROOT.modbus_tcp.table(reader);
    let modbus_tcp = modbus_tcp.map(|table| modbus_tcp::read(&table, base, &names));
    let mqtt = ROOT
        .mqtt
        .table(reader)
        .map(|table| mqtt::read(&table, base, name.as_deref(), &state_dir));
    let http = ROOT.http.table(reader).map(|table| http::read_http(&table, base));
    let bacnet = ROOT.bacnet.table(reader);
    let bacnet = bacnet.map(|table| bacnet::read(&table, base, &state_dir, &names));
    let buffer = mqtt.as_ref().and_then(|mqtt| mqtt.as_ref()?.buffer.as_ref());
    let buffer = buffer.map(|buffer| buffer.dir.as_path());
    let authority = ROOT.authority.table(reader);
    let authority = authority.map(|table| (authority::read(&table), table));
    let drill = ROOT.drill.table(reader).map(|table| drill::read(&table));
    let audit = ROOT.audit.table(reader);
    let audit = audit.map(|table| log::read_audit(&table, &state_dir, buffer));
    let recordings = ROOT.recordings.table(reader);
    let recordings = recordings.map(|table| recordings::read(&table, &state_dir));
    let params = ROOT.params.table(reader);
    let params = params.map(|table| params::read(&table, base, &state_dir, &profiles));
    let log = ROOT.log.table(reader).map(|table| log::read(&table));
    reader.finish();

    let clients = Clients {
        modbus_tcp: modbus_tcp.as_ref(),
        mqtt: mqtt.as_ref(),
        http: http.as_ref(),
        bacnet: bacnet.as_ref(),
    };
    let former = modbus_tcp.as_ref().and_then(|section| section.stale_after.clone());
    let stale_after = stale::of_sections(reader.document(), stale_after, former);
    judge(reader, &buses, &clients);
    stale::warn_of_cycles(reader.document(), &buses, &stale_after);
    if let Some((
        authority::Authority {
            rules: Ok(Some(rules)), ..
        },
        table,
    )) = &authority
    {
        authority::warn_of_nobody(table, rules, &authority::Sides::of(&clients, &buses));
    }
    let authority = options_of(authority, |(authority, _)| authority.rules.ok())
        .ok()?
        .flatten();
    let mut mqtt = mqtt;
    if let (Some(Some(options)), Some(rules)) = (&mut mqtt, &authority) {
        let levels = rules.principals.iter().filter_map(|principal| principal.mqtt.clone());
        options.principals = Some(levels.collect());
    }

    let slots = buses.iter().flat_map(|bus| &bus.slots).map(|slot| slot.slot.clone());
    let slots: Vec<slot_server::Slot> = slots.collect::<Option<_>>()?;
    let mut settings: Vec<BusSettings> = buses.into_iter().map(|bus| bus.settings).collect::<Option<_>>()?;
    interlocks::note_staggers(&mut settings);
    Some(Settings {
        gateway: name?,
        socket,
        params: params.unwrap_or_else(|| ParamsSettings::below(&state_dir)),
        state_dir,
        state_files: StateFiles::Owned,
        recordings: recordings?,
        profile_dirs,
        profiles,
        stale_after: stale::settings(&stale_after)?,
        buses: settings,
        slots: (!slots.is_empty()).then_some(slot_server::Options { slots }),
        modbus_tcp: options_of(modbus_tcp, |m| m.options).ok()?,
        mqtt: options_of(mqtt, |mqtt| mqtt).ok()?,
        http: options_of(http, |http| http.options).ok()?,
        bacnet: options_of(bacnet, |bacnet| bacnet.options).ok()?,
        authority,
        drill: options_of(drill, |drill| drill).ok()?,
        audit,
        log: log?,
    })
}

/// The options of a section. An invalid section makes all options invalid; without a section there are no options.
fn options_of<S, T>(section: Option<S>, of: impl FnOnce(S) -> Option<T>) -> Result<Option<T>, Unusable> {
    section.map(|section| of(section).ok_or(Unusable)).transpose()
}

/// The user profiles in use with a command that does something it must not do; built-in profiles are proved by tests.
fn unsafe_commands(settings: &Settings) -> Vec<Problem> {
    let drives = settings.buses.iter().flat_map(|bus| &bus.drives);
    let commanded = drives.filter(|drive| drive.access == Access::Control && !drive.profile.built_in);
    let own: BTreeMap<&str, &Profile> = commanded
        .map(|drive| (drive.profile.name.as_str(), &*drive.profile))
        .collect();
    let problem = |profile: &Profile| {
        let counterexample = proof::prove(profile).err()?;
        let finding = Finding::new(
            counterexample.line(),
            "correct [control] of the profile; `drivegate profiles check FILE` prints state, command and frames",
        );
        Some(Problem::of_file(
            format!("profile {}", profile.name),
            "control",
            finding,
        ))
    };
    own.into_values().filter_map(problem).collect()
}
