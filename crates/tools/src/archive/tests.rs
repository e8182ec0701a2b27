//! Hostile archives are refused, and a valid one is restored unchanged.

use super::*;

fn member(name: &str, content: &[u8]) -> Member {
    let mut hashed = Hashed::new(content);
    io::copy(&mut hashed, &mut io::sink()).unwrap();
    let (bytes, sha256) = hashed.finish();
    Member {
        name: name.to_string(),
        bytes,
        mode: 0o640,
        sha256,
    }
}

fn manifest(members: Vec<Member>) -> Manifest {
    Manifest {
        drivegate_backup: FORMAT,
        version: "0.1.0".to_string(),
        time: "2026-01-01T00:00:00Z".to_string(),
        gateway: "g".to_string(),
        config: "/etc/drivegate/drivegate.toml".into(),
        state_dir: "/var/lib/drivegate".into(),
        members,
        directories: vec!["config/profiles".to_string()],
        left_out: Vec::new(),
        recordings: Vec::new(),
    }
}

const CONFIG: (&str, &[u8]) = ("config/drivegate.toml", b"[gateway]\n");

/// An archive with this manifest and these members, which need not match.
fn archive(manifest: &Manifest, members: &[(&str, &[u8], EntryType)]) -> Vec<u8> {
    let mut builder = Builder::new(Vec::new());
    let json = serde_json::to_vec(manifest).unwrap();
    builder
        .append(&header(MANIFEST, json.len() as u64, 0o600).unwrap(), json.as_slice())
        .unwrap();
    for (name, content, kind) in members {
        let mut header = header("x", content.len() as u64, 0o640).unwrap();
        // The name is set directly, past the checks of the library.
        header.as_old_mut().name[..name.len()].copy_from_slice(name.as_bytes());
        header.set_entry_type(*kind);
        header.set_cksum();
        builder.append(&header, *content).unwrap();
    }
    builder.into_inner().unwrap()
}

type Taken = Vec<(Root, PathBuf, Vec<u8>)>;

fn taken(bytes: &[u8]) -> Result<Taken, String> {
    let mut taken = Vec::new();
    read(bytes, |_, root, path, content| {
        let mut all = Vec::new();
        content.read_to_end(&mut all)?;
        taken.push((root, path.to_path_buf(), all));
        Ok(())
    })?;
    Ok(taken)
}

#[test]
fn what_is_written_is_read() {
    let files = [
        CONFIG,
        ("config/profiles/own.toml", b"x"),
        ("state/audit.jsonl", &[7; 100_000]),
    ];
    let manifest = manifest(files.iter().map(|(name, content)| member(name, content)).collect());
    let contents = files.iter().zip(&manifest.members).map(|((_, reader), member)| {
        let member = member.clone();
        Ok(Content {
            member,
            reader: *reader,
        })
    });
    let mut bytes = Vec::new();
    write(&mut bytes, &manifest, contents).unwrap();
    let found = taken(&bytes).unwrap();
    assert_eq!(found[1], (Root::Config, "profiles/own.toml".into(), b"x".to_vec()));
    assert_eq!(found[2].2, [7; 100_000]);
    for cut in [100, 512, 1500, bytes.len() - 1024 - 512] {
        assert!(taken(&bytes[..cut]).is_err(), "cut at {cut}");
    }
    // The file changes while it is read.
    let other = || {
        std::iter::once(Ok(Content {
            member: manifest.members[0].clone(),
            reader: &b"[gatewax]\n"[..],
        }))
    };
    assert!(write(io::sink(), &manifest, other()).is_err());
}

#[test]
fn names_that_lead_elsewhere_are_refused() {
    for name in [
        "config/../../etc/passwd",
        "/etc/passwd",
        "config//etc/passwd",
        "config/./a",
        "config/",
        "config",
        "state/a/",
        "state/..",
        "other/a",
        "",
        "config/a\0b",
        "../config/a",
    ] {
        assert!(place(name).is_err(), "{name:?}");
        let bytes = archive(&manifest(vec![member(CONFIG.0, CONFIG.1), member(name, b"x")]), &[]);
        assert!(taken(&bytes).is_err(), "{name:?}");
    }
    assert_eq!(place("state/a/..b"), Ok((Root::State, "a/..b".into())));
}

#[test]
fn what_a_backup_never_has_is_refused() {
    use EntryType::{Directory, Fifo, GNULongName, Link, Regular, Symlink, XHeader};
    let sound = manifest(vec![member(CONFIG.0, CONFIG.1)]);
    let refused = |manifest: &Manifest, members: &[(&str, &[u8], EntryType)], why: &str| {
        let error = taken(&archive(manifest, members)).unwrap_err();
        assert!(error.contains(why), "{error}: {why}");
    };
    for kind in [Symlink, Link, Directory, Fifo, GNULongName, XHeader] {
        refused(&sound, &[(CONFIG.0, CONFIG.1, kind)], "is not a file");
    }
    refused(
        &sound,
        &[("config/other", CONFIG.1, Regular)],
        "not the one the manifest names",
    );
    refused(&sound, &[(CONFIG.0, b"[gatewax]\n", Regular)], "damaged");
    refused(&sound, &[(CONFIG.0, b"[gateway]", Regular)], "the manifest says 10");
    refused(&sound, &[], "the archive is truncated");
    let config = (CONFIG.0, CONFIG.1, Regular);
    refused(
        &sound,
        &[config, ("state/more", b"x", Regular)],
        "not the one the manifest names",
    );
    refused(
        &manifest(vec![member(CONFIG.0, b""), member(CONFIG.0, b"")]),
        &[],
        "twice",
    );
    refused(&manifest(vec![member("state/a", b"")]), &[], "no configuration");
    refused(&manifest(Vec::new()), &[], "no configuration");
    let mut huge = sound.clone();
    huge.members[0].bytes = u64::MAX;
    refused(&huge, &[], "more than any backup");
    for name in ["state/a", "/etc", "config/../a"] {
        let mut hostile = sound.clone();
        hostile.directories.push(name.to_string());
        assert!(taken(&archive(&hostile, &[config])).is_err(), "{name}");
    }
    let later = Manifest {
        drivegate_backup: FORMAT + 1,
        ..sound
    };
    refused(&later, &[config], "it has format 2, but this version reads 1");
    for bytes in [&b""[..], b"{}", &[0; 1024], &[b'x'; 5000]] {
        assert!(taken(bytes).is_err());
    }
}
