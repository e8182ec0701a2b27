//! `drivegate restore`: sets a gateway up again from a backup. All files are unpacked separately, and the
//! configuration is checked, before anything is put in place.

mod staging;

pub(super) use self::staging::UNPACKED;

use std::fs::File;
use std::path::{Path, PathBuf};

use self::staging::Staging;
use super::archive::{self, Manifest, Root};
use super::client::{Client, GatewayRequest};
use super::failure::{Failure, Outcome};
use super::{ConfigFile, EXIT_CONFIG, report};
use drivegate_gateway::config::{Loaded, Settings, environment};

/// Sets a gateway up again from a file that `backup` wrote.
///
/// The gateway must not be running. The configuration is checked before anything is put in place; certificates and keys
/// that the backup lacks must be in place by then.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  drivegate restore pump-house.tar --config /etc/drivegate/drivegate.toml\n  \
    drivegate restore pump-house.tar --force\n\n\
    Exit codes: 0 done, 1 nothing or not everything was done, 78 the configuration in the backup is invalid here."
)]
pub(super) struct Args {
    /// The backup.
    #[arg(value_name = "FILE")]
    file: PathBuf,
    #[command(flatten)]
    config: ConfigFile,
    /// State directory of the gateway.
    #[arg(long, value_name = "DIR", default_value = "/var/lib/drivegate")]
    state_dir: PathBuf,
    /// Replace files that exist.
    #[arg(long)]
    force: bool,
}

pub(super) fn run(args: &Args) -> Outcome {
    match restore(args) {
        Ok(text) => Ok(report::print(&text)),
        Err(Failure::Failed(why)) => Err(format!("{why}; {}", args.file.display()).into()),
        Err(failure) => Err(failure),
    }
}

fn restore(args: &Args) -> Result<String, Failure> {
    let config = &args.config.path;
    let name = config.file_name().ok_or("--config names no file")?;
    let runtime = super::runtime()?;
    if runtime.block_on(is_running(config)) {
        return Err("the gateway is running: stop it first (systemctl stop drivegate)".into());
    }
    let file = File::open(&args.file).map_err(|error| format!("cannot read the backup: {error}"))?;
    let base = match config.parent() {
        Some(dir) if !dir.as_os_str().is_empty() => dir,
        _ => Path::new("."),
    };
    let mut staging = Staging::new(base, &args.state_dir)?;
    let mut is_first = true;
    let manifest = archive::read(file, |member, root, path, content| {
        // The first member is the configuration, whatever its name was.
        let path = if std::mem::take(&mut is_first) {
            Path::new(name)
        } else {
            path
        };
        staging.unpack(root, path, member.mode, content)
    })?;
    for directory in &manifest.directories {
        let (_, path) = archive::place(directory)?;
        staging.make_directory(&path)?;
    }
    let loaded = check(&staging, name, &manifest, base)?;
    let Some(settings) = &loaded.settings else {
        // The configuration is checked as if it were already in its place.
        let [aside, base] = [staging.of(Root::Config), base].map(|dir| dir.display().to_string());
        let errors = loaded
            .errors
            .iter()
            .map(|error| error.to_string().replace(&aside, &base));
        errors.for_each(|error| report::error(&error));
        report::note("nothing was restored");
        return Err(Failure::Reported(EXIT_CONFIG));
    };
    // A relative one is below the directory of the configuration, wherever that is.
    let state_dir = match settings.state_dir.strip_prefix(staging.of(Root::Config)) {
        Ok(below) => base.join(below),
        Err(_) => settings.state_dir.clone(),
    };
    let has_state = manifest.members.iter().any(|member| member.name.starts_with("state/"));
    if has_state && absolute(&state_dir) != absolute(&args.state_dir) {
        let why = format!(
            "the configuration in the backup has the state directory {0}; if that is right, add --state-dir {0}",
            state_dir.display()
        );
        return Err(why.into());
    }
    let exist = staging.existing();
    if !args.force && !exist.is_empty() {
        let shown: Vec<String> = exist.iter().map(|path| path.display().to_string()).collect();
        let shown = shown.join(", ");
        return Err(format!("these files exist already: {shown}; --force replaces them").into());
    }
    let placed = staging.place()?;
    Ok(summary(&manifest, &placed))
}

/// Whether the gateway of the configuration answers.
async fn is_running(config: &Path) -> bool {
    match Client::of_configuration(config) {
        Ok(client) => client.ask(&GatewayRequest::view("/readyz")).await.is_ok(),
        Err(_) => false,
    }
}

fn absolute(path: &Path) -> PathBuf {
    std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf())
}

/// Checks the unpacked configuration together with the existing certificates and keys, which the backup does not contain.
fn check(staging: &Staging, name: &std::ffi::OsStr, manifest: &Manifest, base: &Path) -> Result<Loaded, String> {
    let old_base = manifest.config.parent().unwrap_or(Path::new(""));
    for left_out in &manifest.left_out {
        if let Ok(below) = left_out.path.strip_prefix(old_base) {
            staging.borrow(below, &base.join(below))?;
        }
    }
    Ok(Settings::load_proved(
        staging.of(Root::Config).join(name),
        environment(),
    ))
}

fn summary(manifest: &Manifest, placed: &[PathBuf]) -> String {
    let mut text = format!(
        "restored gateway `{}` as of {}, made by version {}\n",
        manifest.gateway, manifest.time, manifest.version
    );
    for path in placed {
        text += &format!("{}\n", path.display());
    }
    text + "start it with: systemctl start drivegate\n"
}
