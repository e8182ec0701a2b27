//! `drivegate backup`: everything needed to set a gateway up again, in one file.

use std::collections::BTreeSet;
use std::fs::{self, File, OpenOptions};
use std::io::{self, BufWriter, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use super::archive::{Content, FORMAT, Hashed, LeftOut, Manifest, Member, Root, write};
use super::failure::Outcome;
use super::restore::UNPACKED;
use super::{ConfigFile, report};
use drivegate_core::history::store;
use drivegate_gateway::config::{FileKind, NamedFile, Settings, environment, named_files};

/// Endings of files in the state directory that a backup does not need: locks, and partially written files.
const TRANSIENT: [&str; 2] = ["lock", "partial"];

/// Writes configuration, profiles and state into one file, from which `restore` sets the gateway up again.
///
/// The gateway may be running. Certificates, keys, passwords and tokens are only listed in the backup, unless
/// --with-keys is given: keep such a file as secret as the keys. Recordings are listed, not copied.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  drivegate backup pump-house.tar --config /etc/drivegate/drivegate.toml")]
pub(super) struct Args {
    /// The file to write, a tar archive; it must not exist.
    #[arg(value_name = "FILE")]
    file: PathBuf,
    #[command(flatten)]
    config: ConfigFile,
    /// Include certificates, keys, passwords and tokens.
    #[arg(long)]
    with_keys: bool,
}

pub(super) fn run(args: &Args) -> Outcome {
    let path = &args.config.path;
    let settings = super::settings(path)?;
    let made = collect(path, &settings, args.with_keys).and_then(|sources| {
        let manifest = manifest(path, &settings, &sources);
        save(&args.file, &manifest, &sources).map(|()| manifest)
    });
    let manifest = made.map_err(|why| format!("{why}; {}; no backup was made", args.file.display()))?;
    Ok(report::print(&summary(&args.file, &manifest)))
}

/// The files of a backup, and what the backup leaves out.
#[derive(Debug, Default)]
struct Sources {
    files: Vec<(PathBuf, Member)>,
    names: BTreeSet<String>,
    left_out: Vec<LeftOut>,
}

impl Sources {
    fn leave_out(&mut self, path: &Path, why: &str) {
        self.left_out.push(LeftOut {
            path: path.to_path_buf(),
            why: why.to_string(),
        });
    }

    /// Adds the file at `dir`/`below`.
    fn add(&mut self, root: Root, dir: &Path, below: &Path) -> io::Result<()> {
        let path = dir.join(below);
        let Some(name) = root.member(below) else {
            self.leave_out(&path, "its name is not UTF-8, or leads out of its directory");
            return Ok(());
        };
        // A certificate and its key may be one file.
        if !self.names.insert(name.clone()) {
            return Ok(());
        }
        let shown = |error: io::Error| io::Error::new(error.kind(), format!("cannot read {}: {error}", path.display()));
        let file = File::open(&path).map_err(shown)?;
        let metadata = file.metadata()?;
        // A file that grows, such as the audit, is archived with its present length.
        let mut hashed = Hashed::new(io::Read::take(file, metadata.len()));
        io::copy(&mut hashed, &mut io::sink()).map_err(shown)?;
        let (bytes, sha256) = hashed.finish();
        let mode = metadata.mode() & 0o777;
        let member = Member {
            name,
            bytes,
            mode,
            sha256,
        };
        self.files.push((path, member));
        Ok(())
    }
}

fn collect(config: &Path, settings: &Settings, with_keys: bool) -> io::Result<Sources> {
    let base = config.parent().unwrap_or(Path::new(""));
    let mut sources = Sources::default();
    let named = named_files(config, environment());
    for NamedFile { path, kind, .. } in &named {
        let belongs = matches!(kind, FileKind::Configuration | FileKind::Profile);
        match path.strip_prefix(base) {
            _ if !belongs && !with_keys => sources.leave_out(path, "a certificate, key, password or token"),
            Ok(below) => sources.add(Root::Config, base, below)?,
            Err(_) => sources.leave_out(path, "it is outside the directory of the configuration"),
        }
    }
    // The state directory may also be the directory of the configuration, so files handled above are skipped.
    let mut decided: Vec<PathBuf> = named.iter().map(|file| real(&file.path)).collect();
    decided.push(real(&settings.recordings.dir));
    state(&settings.state_dir, Path::new(""), &decided, &mut sources)?;
    let audit = settings.audit.iter().flat_map(|audit| audit.files());
    let buffer = settings
        .mqtt
        .iter()
        .filter_map(|mqtt| Some(mqtt.buffer.as_ref()?.dir.clone()));
    elsewhere(&settings.state_dir, audit.chain(buffer), &mut sources);
    Ok(sources)
}

/// Names the files that the gateway keeps outside its state directory.
fn elsewhere(state_dir: &Path, kept: impl Iterator<Item = PathBuf>, sources: &mut Sources) {
    let state_dir = real(state_dir);
    for path in kept.filter(|path| path.exists() && !real(path).starts_with(&state_dir)) {
        sources.leave_out(&path, "it is outside the state directory");
    }
}

fn real(path: &Path) -> PathBuf {
    path.canonicalize()
        .or_else(|_| std::path::absolute(path))
        .unwrap_or_else(|_| path.to_path_buf())
}

/// Adds the files in `dir`/`below` and its subdirectories, except those that are `decided` already.
fn state(dir: &Path, below: &Path, decided: &[PathBuf], sources: &mut Sources) -> io::Result<()> {
    let here = dir.join(below);
    let shown = |error: io::Error| io::Error::new(error.kind(), format!("cannot read {}: {error}", here.display()));
    let mut found = match fs::read_dir(&here) {
        Ok(files) => files.collect::<io::Result<Vec<_>>>().map_err(shown)?,
        Err(error) if error.kind() == io::ErrorKind::NotFound => Vec::new(),
        Err(error) => return Err(shown(error)),
    };
    found.sort_by_key(fs::DirEntry::file_name);
    for entry in found {
        let (path, below) = (entry.path(), below.join(entry.file_name()));
        let kind = entry.file_type().map_err(shown)?;
        if is_transient(&path) || decided.contains(&real(&path)) {
            continue;
        }
        if kind.is_dir() {
            state(dir, &below, decided, sources)?;
        } else if !kind.is_file() {
            sources.leave_out(&path, "it is not a regular file");
        } else if path.extension().is_some_and(|ending| ending == "tar") {
            // Archives are left out, because each backup would contain all earlier ones.
            sources.leave_out(&path, "it is an archive");
        } else if let Err(error) = sources.add(Root::State, dir, &below)
            && error.kind() != io::ErrorKind::NotFound
        {
            // The gateway may have removed the file meanwhile; any other error is returned.
            return Err(error);
        }
    }
    Ok(())
}

/// Whether a file is temporary: a lock, a file being written, or one that a restore is unpacking.
fn is_transient(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    name.starts_with(UNPACKED)
        || path
            .extension()
            .is_some_and(|ending| TRANSIENT.iter().any(|one| ending == *one))
}

fn manifest(config: &Path, settings: &Settings, sources: &Sources) -> Manifest {
    let base = config.parent().unwrap_or(Path::new(""));
    let below = settings
        .profile_dirs
        .iter()
        .filter_map(|dir| dir.strip_prefix(base).ok());
    let below = below.filter(|dir| !dir.as_os_str().is_empty());
    let (recordings, _) = store::list(&settings.recordings.dir).unwrap_or_default();
    Manifest {
        drivegate_backup: FORMAT,
        version: super::VERSION.clone(),
        time: humantime::format_rfc3339_seconds(SystemTime::now()).to_string(),
        gateway: settings.gateway.clone(),
        config: config.to_path_buf(),
        state_dir: settings.state_dir.clone(),
        members: sources.files.iter().map(|(_, member)| member.clone()).collect(),
        directories: below.filter_map(|dir| Root::Config.member(dir)).collect(),
        left_out: sources.left_out.clone(),
        recordings: recordings
            .iter()
            .filter_map(|entry| serde_json::to_value(entry).ok())
            .collect(),
    }
}

/// Writes the archive under a temporary name and renames it, so that only complete archives exist.
fn save(file: &Path, manifest: &Manifest, sources: &Sources) -> io::Result<()> {
    if fs::symlink_metadata(file).is_ok() {
        return Err(io::Error::other("the file exists already: name another, or remove it"));
    }
    let mut name = file.file_name().unwrap_or_default().to_os_string();
    name.push(".partial");
    let aside = file.with_file_name(name);
    // Removes the partial file of a backup that was killed.
    let _ = fs::remove_file(&aside);
    let written = OpenOptions::new()
        .write(true)
        .create_new(true)
        .mode(0o600)
        .open(&aside)
        .and_then(|open| {
            let contents = sources.files.iter().map(|(path, member)| {
                let gone = |error| io::Error::other(format!("{}: {error}; try again", path.display()));
                let (member, reader) = (member.clone(), File::open(path).map_err(gone)?);
                Ok(Content { member, reader })
            });
            let mut to = BufWriter::new(&open);
            write(&mut to, manifest, contents)?;
            to.flush()?;
            open.sync_all()?;
            fs::rename(&aside, file)
        });
    written.inspect_err(|error| {
        if error.kind() != io::ErrorKind::AlreadyExists {
            let _ = fs::remove_file(&aside);
        }
    })
}

fn summary(file: &Path, manifest: &Manifest) -> String {
    let bytes: u64 = manifest.members.iter().map(|member| member.bytes).sum();
    let mut text = format!(
        "{}: {} files, {bytes} bytes; {} recordings listed\n",
        file.display(),
        manifest.members.len(),
        manifest.recordings.len()
    );
    for LeftOut { path, why } in &manifest.left_out {
        text += &format!("not in it: {} ({why})\n", path.display());
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_of_the_state_is_in_it_or_named() {
        let folder = tempfile::tempdir().unwrap();
        let dir = folder.path().join("state");
        for path in [
            "audit.jsonl",
            "mqtt-events.lock",
            "counters.partial",
            "params/fan-1/20260302T074012Z.params",
            "params/fan-1/restore.journal",
            "params/fan-1/restore.partial",
            "recordings/r1.dgrec",
            ".restore-77/drivegate.toml",
            "tls/gateway.key",
            "yesterday.tar",
        ] {
            let path = dir.join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, "x").unwrap();
        }
        std::os::unix::fs::symlink("/etc", dir.join("params/pump-1")).unwrap();
        let decided = ["recordings", "tls/gateway.key"].map(|path| real(&dir.join(path)));
        let mut sources = Sources::default();
        state(&dir, Path::new(""), &decided, &mut sources).unwrap();
        let names: Vec<&str> = sources.files.iter().map(|(_, member)| member.name.as_str()).collect();
        let expected = [
            "state/audit.jsonl",
            "state/params/fan-1/20260302T074012Z.params",
            "state/params/fan-1/restore.journal",
        ];
        assert_eq!(names, expected);
        let left_out = |path: &str, why: &str| LeftOut {
            path: dir.join(path),
            why: why.to_string(),
        };
        let expected = [
            left_out("params/pump-1", "it is not a regular file"),
            left_out("yesterday.tar", "it is an archive"),
        ];
        assert_eq!(sources.left_out, expected);
        let mut nothing = Sources::default();
        state(&folder.path().join("none"), Path::new(""), &[], &mut nothing).unwrap();
        assert!(nothing.files.is_empty());
    }

    #[test]
    fn what_is_kept_outside_of_the_state_directory_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let at = |path: &str| folder.path().join(path);
        for dir in ["state/buffer", "elsewhere"] {
            fs::create_dir_all(at(dir)).unwrap();
        }
        fs::write(at("audit.jsonl"), "x").unwrap();
        fs::write(at("state/audit.jsonl"), "x").unwrap();
        // Paths through this link name files of the state directory in another way.
        std::os::unix::fs::symlink(at("state"), at("link")).unwrap();
        let kept = [
            "audit.jsonl",
            "audit.jsonl.1",
            "elsewhere",
            "state/buffer",
            "link/audit.jsonl",
        ];
        let mut sources = Sources::default();
        elsewhere(&at("state"), kept.into_iter().map(at), &mut sources);
        let named: Vec<PathBuf> = sources.left_out.into_iter().map(|one| one.path).collect();
        assert_eq!(named, ["audit.jsonl", "elsewhere"].map(at));
    }

    #[test]
    fn a_file_is_in_it_once_and_one_that_leads_out_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let base = folder.path().join("etc");
        fs::create_dir(&base).unwrap();
        fs::write(base.join("a.pem"), "x").unwrap();
        fs::write(folder.path().join("b"), "x").unwrap();
        let mut sources = Sources::default();
        for below in ["a.pem", "./a.pem", "../b"] {
            sources.add(Root::Config, &base, Path::new(below)).unwrap();
        }
        assert_eq!((sources.files.len(), sources.left_out.len()), (1, 1));
    }
}
