//! The archive of `backup` and `restore`: a tar file whose first member, `manifest.json`, names all the others. A member is
//! `config/…`, below the directory of the configuration, or `state/…`, below the state directory; nothing else is accepted.

use std::collections::BTreeSet;
use std::io::{self, Read, Write};
use std::path::{Component, Path, PathBuf};

use ring::digest::{Context, SHA256};
use serde::{Deserialize, Serialize};
use tar::{Archive, Builder, EntryType, Header};

use drivegate_core::hex;

/// Version of the form; one that is greater cannot be read.
pub(super) const FORMAT: u32 = 1;
const MANIFEST: &str = "manifest.json";
/// Largest manifest, bytes.
const MOST_MANIFEST: u64 = 64 << 20;
/// Maximum number of files in an archive.
const MOST_MEMBERS: usize = 100_000;
/// Maximum number of bytes of all files together.
const MOST_BYTES: u64 = 8 << 30;

/// The manifest of an archive.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Manifest {
    /// [`FORMAT`].
    pub(super) drivegate_backup: u32,
    /// Version of the program that made the archive.
    pub(super) version: String,
    /// When the archive was made, RFC 3339.
    pub(super) time: String,
    /// Name of the gateway.
    pub(super) gateway: String,
    /// Path of the configuration when the archive was made.
    pub(super) config: PathBuf,
    /// State directory when the archive was made.
    pub(super) state_dir: PathBuf,
    /// The archive members in order; the first one is the configuration.
    pub(super) members: Vec<Member>,
    /// Directories of profiles, `config/…`, which may be empty.
    pub(super) directories: Vec<String>,
    /// Files that belong to the gateway and are not in the archive.
    pub(super) left_out: Vec<LeftOut>,
    /// The recordings that existed at the backup; the archive itself does not contain them.
    pub(super) recordings: Vec<serde_json::Value>,
}

/// A file in an archive.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Member {
    /// `config/…` or `state/…`.
    pub(super) name: String,
    /// Size of the file.
    pub(super) bytes: u64,
    /// Permission bits of the file.
    pub(super) mode: u32,
    /// SHA-256 of the content, in hexadecimal.
    pub(super) sha256: String,
}

/// A file that is not in the archive.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct LeftOut {
    /// Path of the file that was left out.
    pub(super) path: PathBuf,
    /// Why the file was left out of the backup.
    pub(super) why: String,
}

/// The directory to which a member belongs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Root {
    /// Files below the directory of the configuration.
    Config,
    /// Files below the state directory.
    State,
}

impl Root {
    fn name(self) -> &'static str {
        match self {
            Root::Config => "config",
            Root::State => "state",
        }
    }

    /// Name of the archive member for the file at `path` below the directory; `None` if the path has no valid name.
    pub(super) fn member(self, path: &Path) -> Option<String> {
        let parts = path.components().filter(|part| *part != Component::CurDir);
        let path: PathBuf = parts.collect();
        let name = format!("{}/{}", self.name(), path.to_str()?);
        place(&name).is_ok().then_some(name)
    }
}

/// The directory and path to which the member `name` belongs.
///
/// # Errors
/// If the name leads to another directory.
pub(super) fn place(name: &str) -> Result<(Root, PathBuf), String> {
    let bad = || Err(format!("the member {name:?} has no name that a backup uses"));
    let (root, rest) = match name.split_once('/') {
        Some(("config", rest)) => (Root::Config, rest),
        Some(("state", rest)) => (Root::State, rest),
        _ => return bad(),
    };
    let path = PathBuf::from(rest);
    let normal = |part: Component<'_>| matches!(part, Component::Normal(_));
    // The components joined again must equal the name: no `//`, no `.` and no slash at the end.
    let same = path.components().collect::<PathBuf>().as_os_str() == rest;
    if rest.is_empty() || rest.contains('\0') || !same || !path.components().all(normal) {
        return bad();
    }
    Ok((root, path))
}

/// The content of a file that is being archived, whose size and hash are known.
pub(super) struct Content<R> {
    pub(super) member: Member,
    pub(super) reader: R,
}

/// Writes an archive: first the manifest, then each member as the manifest lists it.
///
/// # Errors
/// If the archive cannot be written, a file no longer matches its entry in the manifest, or [`read`] would refuse
/// the archive.
pub(super) fn write<R: Read>(
    to: impl Write,
    manifest: &Manifest,
    contents: impl Iterator<Item = io::Result<Content<R>>>,
) -> io::Result<()> {
    let mut builder = Builder::new(to);
    let json = serde_json::to_vec_pretty(manifest)?;
    parse(&json).map_err(io::Error::other)?;
    builder.append(&header(MANIFEST, json.len() as u64, 0o600)?, json.as_slice())?;
    for content in contents {
        let Content { member, reader } = content?;
        let mut hashed = Hashed::new(reader.take(member.bytes));
        builder.append(&header(&member.name, member.bytes, member.mode)?, &mut hashed)?;
        if hashed.finish() != (member.bytes, member.sha256.clone()) {
            let what = format!("{} changed while it was copied; try again", member.name);
            return Err(io::Error::other(what));
        }
    }
    builder.into_inner()?.flush()
}

fn header(name: &str, bytes: u64, mode: u32) -> io::Result<Header> {
    let mut header = Header::new_ustar();
    header.set_path(name)?;
    header.set_entry_type(EntryType::Regular);
    header.set_size(bytes);
    header.set_mode(mode & 0o777);
    header.set_mtime(0);
    header.set_cksum();
    Ok(header)
}

/// Reads an archive, which may be hostile: `take` gets each member with its content, and must read it to the end.
/// Members missing in the manifest, other kinds than files, names that point elsewhere and wrong contents are
/// errors.
///
/// # Errors
/// If the archive is damaged or not a backup; contains the defect. `take` has already received the members before it.
pub(super) fn read(
    from: impl Read,
    mut take: impl FnMut(&Member, Root, &Path, &mut dyn Read) -> io::Result<()>,
) -> Result<Manifest, String> {
    let broken = |error: io::Error| format!("it is not an archive, or damaged: {error}");
    let mut archive = Archive::new(from);
    // The raw entries are read, so that extensions of the format, such as endless names, appear as members and are refused.
    let mut entries = archive.entries().map_err(broken)?.raw(true);
    let first = entries.next().ok_or("it is empty")?.map_err(broken)?;
    if first.path_bytes().as_ref() != MANIFEST.as_bytes() || first.size() > MOST_MANIFEST {
        return Err("it is not a backup of drivegate: it does not start with a manifest".to_string());
    }
    let mut json = Vec::new();
    first.take(MOST_MANIFEST).read_to_end(&mut json).map_err(broken)?;
    let manifest = parse(&json)?;
    let mut expected = manifest.members.iter();
    for entry in entries {
        let mut entry = entry.map_err(broken)?;
        let name = String::from_utf8_lossy(&entry.path_bytes()).into_owned();
        let kind = entry.header().entry_type();
        if kind != EntryType::Regular {
            return Err(format!("the member {name:?} is not a file but {kind:?}"));
        }
        let member = expected.next().filter(|member| member.name == name);
        let member = member.ok_or_else(|| format!("the member {name:?} is not the one the manifest names here"))?;
        if entry.size() != member.bytes {
            let size = entry.size();
            return Err(format!("{name} has {size} bytes, the manifest says {}", member.bytes));
        }
        let (root, path) = place(&name)?;
        let mut hashed = Hashed::new(&mut entry);
        take(member, root, &path, &mut hashed).map_err(|error| format!("{name}: {error}"))?;
        if hashed.finish() != (member.bytes, member.sha256.clone()) {
            return Err(format!("{name} is damaged: its content differs from the manifest"));
        }
    }
    match expected.next() {
        Some(missing) => Err(format!("{} is missing: the archive is truncated", missing.name)),
        None => Ok(manifest),
    }
}

/// Parses a manifest and checks that it is plausible for a backup.
fn parse(json: &[u8]) -> Result<Manifest, String> {
    #[derive(Deserialize)]
    struct Version {
        drivegate_backup: u32,
    }
    if json.len() as u64 > MOST_MANIFEST {
        return Err(format!(
            "its manifest has {} bytes, more than any backup has",
            json.len()
        ));
    }
    let no_manifest = |error: serde_json::Error| format!("its manifest is damaged: {error}");
    let Version {
        drivegate_backup: format,
    } = serde_json::from_slice(json).map_err(no_manifest)?;
    if format > FORMAT {
        return Err(format!(
            "it has format {format}, but this version reads {FORMAT}: restore it with the version that made it, or a \
             later one"
        ));
    }
    let manifest: Manifest = serde_json::from_slice(json).map_err(no_manifest)?;
    let mut names = BTreeSet::new();
    let mut bytes = 0u64;
    for member in &manifest.members {
        place(&member.name)?;
        bytes = bytes.saturating_add(member.bytes);
        if !names.insert(&member.name) {
            return Err(format!("it contains {} twice", member.name));
        }
    }
    for directory in &manifest.directories {
        if place(directory)?.0 != Root::Config {
            return Err(format!("{directory} is not a directory of profiles"));
        }
    }
    if manifest.directories.len() > MOST_MEMBERS || manifest.members.len() > MOST_MEMBERS || bytes > MOST_BYTES {
        let count = manifest.members.len();
        return Err(format!(
            "it claims {count} files of {bytes} bytes, more than any backup has"
        ));
    }
    match manifest.members.first() {
        Some(first) if place(&first.name)?.0 == Root::Config => Ok(manifest),
        _ => Err("it has no configuration".to_string()),
    }
}

/// Counts and hashes the bytes read.
pub(super) struct Hashed<R> {
    reader: R,
    bytes: u64,
    hash: Context,
}

impl<R> Hashed<R> {
    pub(super) fn new(reader: R) -> Hashed<R> {
        Hashed {
            reader,
            bytes: 0,
            hash: Context::new(&SHA256),
        }
    }

    /// Number of bytes that were read, and their hash.
    pub(super) fn finish(self) -> (u64, String) {
        (self.bytes, hex::encode(self.hash.finish().as_ref()))
    }
}

impl<R: Read> Read for Hashed<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let count = self.reader.read(buffer)?;
        let read = buffer.get(..count).unwrap_or_default();
        self.hash.update(read);
        self.bytes += count as u64;
        Ok(count)
    }
}

#[cfg(test)]
mod tests;
