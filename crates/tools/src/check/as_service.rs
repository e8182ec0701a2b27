//! Checks whether the user of the systemd service can read the files of a configuration: by their permission bits,
//! those of the directories on the way, and the groups of the unit.

use std::collections::BTreeSet;
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::process::Command;

use super::privileged;
use drivegate_gateway::config::{NamedFile, environment, named_files};
use drivegate_model::document::{Finding, Problem};

const UNIT: &str = "drivegate.service";
/// Group of the shipped unit, used where systemd cannot be queried.
const SHIPPED_GROUP: &str = "dialout";
/// Directory that systemd makes for the service while the service runs.
const CREDENTIALS: &str = "/run/credentials/";
const READ: u32 = 0o4;
const SEARCH: u32 = 0o1;

/// Directories that a unit hides with `ProtectHome=` and with `PrivateTmp=`.
const HOMES: [&str; 3] = ["/home", "/root", "/run/user"];
const TEMPORARY: [&str; 2] = ["/tmp", "/var/tmp"];

/// User and groups of the service that reads the files.
#[derive(Debug, PartialEq, Eq)]
struct Service {
    /// The user; `None` for a dynamic user that exists only while the service runs and owns nothing.
    user: Option<u32>,
    groups: BTreeSet<u32>,
    /// Directories whose files the service does not see.
    hidden: Vec<&'static str>,
    /// Whether it may listen on ports below 1024.
    listens_anywhere: bool,
    /// User and groups in words.
    shown: String,
}

/// Owner and permissions of a file or directory.
#[derive(Debug, Clone, Copy)]
struct Node {
    mode: u32,
    user: u32,
    group: u32,
}

impl Service {
    /// The properties of the service's unit, as the system reports them.
    fn of_unit() -> Service {
        let asked = "User,DynamicUser,Group,SupplementaryGroups,LoadState,ProtectHome,PrivateTmp,AmbientCapabilities,CapabilityBoundingSet";
        let output = Command::new("systemctl")
            .args(["show", UNIT, &format!("--property={asked}")])
            .output();
        let text = output.map(|output| String::from_utf8_lossy(&output.stdout).into_owned());
        let text = text.unwrap_or_default();
        let read = |path| fs::read_to_string(path).unwrap_or_default();
        Service::parse(&text, &read("/etc/passwd"), &read("/etc/group"))
    }

    /// Parses the output of `systemctl show`; if no unit is loaded, the shipped unit is assumed.
    fn parse(unit: &str, passwd: &str, group: &str) -> Service {
        let value = |key: &str| {
            let mut lines = unit.lines().filter_map(|line| line.split_once('='));
            lines.find(|(name, _)| *name == key).map_or("", |(_, value)| value)
        };
        let loaded = value("LoadState") == "loaded";
        let name = value("User");
        let user = match value("DynamicUser") {
            "yes" => None,
            _ if !loaded => None,
            _ if name.is_empty() => Some(0),
            _ => id(passwd, name),
        };
        let names = format!("{} {}", value("Group"), value("SupplementaryGroups"));
        let mut names: Vec<&str> = names.split_whitespace().collect();
        if !loaded {
            names = vec![SHIPPED_GROUP];
        }
        let who = match user {
            None => "a user of its own".to_string(),
            Some(_) if name.is_empty() => "root".to_string(),
            Some(_) => format!("user `{name}`"),
        };
        let groups = match names.as_slice() {
            [] => "no group".to_string(),
            names => format!("the groups {}", names.join(", ")),
        };
        // The answer of systemd already includes the settings that `DynamicUser=` implies.
        let hides = |key: &str, ways: &[&str]| !loaded || ways.contains(&value(key));
        let homes = hides("ProtectHome", &["yes", "tmpfs"]).then_some(HOMES.as_slice());
        let temporary = hides("PrivateTmp", &["yes", "disconnected"]).then_some(TEMPORARY.as_slice());
        let hidden = homes.into_iter().chain(temporary).flatten().copied().collect();
        // The user's own group, which the file of groups does not list for the user.
        let own = passwd.lines().map(|line| line.split(':').collect::<Vec<_>>());
        let own = own.filter(|fields| user.is_some() && fields.first() == Some(&name));
        let own = own.filter_map(|fields| fields.get(3)?.parse().ok());
        Service {
            user,
            groups: names.iter().filter_map(|name| id(group, name)).chain(own).collect(),
            hidden,
            listens_anywhere: may_listen(user, value("AmbientCapabilities"), value("CapabilityBoundingSet")),
            shown: format!("{who} with {groups}"),
        }
    }

    /// Whether the service has this permission; capabilities of root do not count, because the unit has none.
    fn may(&self, node: Node, wanted: u32) -> bool {
        let shift = match () {
            () if self.user == Some(node.user) => 6,
            () if self.groups.contains(&node.group) => 3,
            () => 0,
        };
        node.mode >> shift & wanted == wanted
    }
}

/// Whether a unit may listen on privileged ports: root with what its bounding set leaves, others with an ambient capability.
fn may_listen(user: Option<u32>, ambient: &str, bounding: &str) -> bool {
    let has = |set: &str| set.split_whitespace().any(|name| name == privileged::NAME);
    has(bounding) && (user == Some(0) || has(ambient))
}

/// Whether the service may listen on privileged ports.
pub(super) fn may_listen_on_privileged_ports() -> bool {
    Service::of_unit().listens_anywhere
}

/// The number of a user or group, by its name or as it is written.
fn id(table: &str, name: &str) -> Option<u32> {
    let mut lines = table.lines().map(|line| line.split(':'));
    let found = lines.find_map(|mut fields| (fields.next() == Some(name)).then(|| fields.nth(1)?.parse().ok())?);
    found.or_else(|| name.parse().ok())
}

/// Files that the service could not read: the configuration `path` and the files it names.
pub(super) fn problems(path: &Path) -> Vec<Problem> {
    let service = Service::of_unit();
    let files = named_files(path, environment());
    let lasting = files.iter().filter(|file| !file.path.starts_with(CREDENTIALS));
    lasting.filter_map(|file| problem(path, file, &service)).collect()
}

/// The commands by which the service gets this permission of a file or directory, `g+r` or `g+x`, through a group.
pub(crate) fn group_remedy(path: &Path, bits: &str) -> String {
    let shown = path.display();
    format!("give it a group of the service: chgrp GROUP {shown} && chmod {bits} {shown}")
}

fn problem(config: &Path, file: &NamedFile, service: &Service) -> Option<Problem> {
    // A missing file is reported by the code that reads it.
    let whole = file.path.canonicalize().ok()?;
    let shown = |finding| Some(Problem::of_file(config.display().to_string(), &file.key, finding));
    if let Some(dir) = service.hidden.iter().find(|dir| whole.starts_with(dir)) {
        return shown(Finding::new(
            format!(
                "the service could not see {}: its unit hides {dir}",
                file.path.display()
            ),
            "keep the file in /etc/drivegate",
        ));
    }
    let steps: Vec<&Path> = whole.ancestors().collect();
    let refusing = steps.into_iter().rev().find_map(|step| {
        let meta = fs::metadata(step).ok()?;
        let wanted = if meta.is_dir() { SEARCH } else { READ };
        let node = Node {
            mode: meta.mode(),
            user: meta.uid(),
            group: meta.gid(),
        };
        (!service.may(node, wanted)).then(|| (step.to_path_buf(), meta))
    });
    let (step, meta) = refusing?;
    let (refusing, mode) = (step.display(), meta.mode() & 0o7777);
    let bits = if meta.is_dir() { "g+x" } else { "g+r" };
    shown(Finding::new(
        format!(
            "the service could not read {}: {refusing} has mode {mode:04o}, user {} and group {}, and the service runs as {}",
            file.path.display(),
            meta.uid(),
            meta.gid(),
            service.shown
        ),
        group_remedy(&step, bits),
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use drivegate_gateway::config::FileKind;

    const PASSWD: &str = "root:x:0:0::/root:/bin/sh\ngateway:x:990:991::/:/bin/false\n";
    const GROUP: &str = "root:x:0:\ndialout:x:20:\nkeys:x:900:a,b\ngateway:x:991:\n";

    #[test]
    fn the_unit_says_who_reads() {
        let dynamic = "User=drivegate\nDynamicUser=yes\nGroup=\nSupplementaryGroups=dialout keys\nLoadState=loaded\n";
        let service = Service::parse(dynamic, PASSWD, GROUP);
        assert_eq!((service.user, service.groups), (None, [20, 900].into()));
        assert_eq!(service.shown, "a user of its own with the groups dialout, keys");
        let named = "User=gateway\nDynamicUser=no\nGroup=\nSupplementaryGroups=900\nLoadState=loaded\n";
        let service = Service::parse(named, PASSWD, GROUP);
        assert_eq!((service.user, service.groups), (Some(990), [900, 991].into()));
        let root = Service::parse("User=\nDynamicUser=no\nLoadState=loaded\n", PASSWD, GROUP);
        assert_eq!((root.user, root.shown.as_str()), (Some(0), "root with no group"));
        for none in ["", "User=\nDynamicUser=no\nLoadState=not-found\n"] {
            let service = Service::parse(none, PASSWD, GROUP);
            assert_eq!((service.user, service.groups), (None, [20].into()));
            assert_eq!(service.hidden, ["/home", "/root", "/run/user", "/tmp", "/var/tmp"]);
        }
        for (unit, hidden) in [
            ("ProtectHome=yes\nPrivateTmp=no", &HOMES[..]),
            ("ProtectHome=read-only\nPrivateTmp=yes", &TEMPORARY),
            ("ProtectHome=no\nPrivateTmp=no", &[]),
        ] {
            let service = Service::parse(&format!("{unit}\nLoadState=loaded\n"), PASSWD, GROUP);
            assert_eq!(service.hidden, hidden, "{unit}");
        }
    }

    #[test]
    fn the_unit_says_whether_port_502_is_possible() {
        let may = |unit: &str| Service::parse(&format!("{unit}LoadState=loaded\n"), PASSWD, GROUP).listens_anywhere;
        let user = "User=gateway\nDynamicUser=no\n";
        let bounding = "CapabilityBoundingSet=cap_chown cap_net_bind_service\n";
        assert!(may(&format!(
            "{user}{bounding}AmbientCapabilities=cap_net_bind_service\n"
        )));
        assert!(!may(&format!("{user}{bounding}AmbientCapabilities=\n")));
        assert!(may(&format!("User=\nDynamicUser=no\n{bounding}")));
        assert!(!may("User=\nDynamicUser=no\nCapabilityBoundingSet=\n"));
        assert!(
            !Service::parse("", PASSWD, GROUP).listens_anywhere,
            "the shipped unit has no capability"
        );
    }

    #[test]
    fn owner_group_and_others_count_in_this_order() {
        let service = Service {
            user: Some(990),
            groups: [20].into(),
            hidden: Vec::new(),
            listens_anywhere: false,
            shown: String::new(),
        };
        let may = |mode, user, group| service.may(Node { mode, user, group }, READ);
        for (mode, user, group, expected) in [
            (0o100_400, 990, 0, true),
            (0o100_044, 990, 20, false),
            (0o100_640, 0, 20, true),
            (0o100_604, 0, 20, false),
            (0o100_604, 0, 0, true),
            (0o100_640, 0, 0, false),
        ] {
            assert_eq!(may(mode, user, group), expected, "{mode:o} {user} {group}");
        }
    }

    #[test]
    fn the_file_or_directory_in_the_way_is_named() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let dir = folder.path().join("keys");
        fs::create_dir(&dir).unwrap();
        let (config, path) = (folder.path().join("drivegate.toml"), dir.join("gateway.key"));
        fs::write(&path, "x").unwrap();
        let set = |path: &Path, mode| fs::set_permissions(path, fs::Permissions::from_mode(mode)).unwrap();
        let found = |hidden: Vec<&'static str>, is_owner: bool| {
            let service = Service {
                user: is_owner.then(|| fs::metadata(&path).unwrap().uid()),
                groups: BTreeSet::new(),
                hidden,
                listens_anywhere: false,
                shown: "a user of its own with no group".to_string(),
            };
            let kind = FileKind::Secret;
            let file = NamedFile {
                path: path.clone(),
                kind,
                key: "http.tls.key".to_string(),
            };
            problem(&config, &file, &service).map(|problem| problem.to_string())
        };
        set(folder.path(), 0o755);
        set(&dir, 0o755);
        set(&path, 0o644);
        assert_eq!(found(Vec::new(), false), None);
        set(&path, 0o640);
        let key = found(Vec::new(), false).unwrap();
        assert!(
            key.contains("gateway.key has mode 0640") && key.contains("chmod g+r"),
            "{key}"
        );
        set(&path, 0o644);
        set(&dir, 0o700);
        let directory = found(Vec::new(), false).unwrap();
        assert!(
            directory.contains("keys has mode 0700") && directory.contains("chmod g+x"),
            "{directory}"
        );
        assert_eq!(found(Vec::new(), true), None);
        assert_eq!(found(vec!["/none"], true), None);
        let unseen = found(vec!["/"], true).unwrap();
        assert!(unseen.contains("its unit hides /"), "{unseen}");
    }
}
