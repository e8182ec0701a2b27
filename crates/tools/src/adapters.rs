//! The serial adapters of this machine, with their persistent names.

use std::fs;
use std::path::{Path, PathBuf};

/// A serial port.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Adapter {
    /// Name of the adapter in a configuration: the persistent one, where there is one.
    pub(super) port: String,
    /// The device behind a persistent name.
    pub(super) device: Option<String>,
}

/// The serial ports of this machine: those with persistent names first, then others with real hardware.
pub(super) fn adapters() -> Vec<Adapter> {
    listed(Path::new("/dev"), Path::new("/sys/class/tty"))
}

fn listed(dev: &Path, tty: &Path) -> Vec<Adapter> {
    let mut found: Vec<Adapter> = persistent_names(dev)
        .into_iter()
        .map(|(link, device)| Adapter {
            port: link.display().to_string(),
            device: Some(device.display().to_string()),
        })
        .collect();
    let named = |device: &Path| {
        let device = device.display().to_string();
        found.iter().any(|adapter| adapter.device.as_ref() == Some(&device))
    };
    let others: Vec<Adapter> = names(tty)
        .into_iter()
        .filter(|name| has_hardware(&tty.join(name)))
        .map(|name| dev.join(name))
        .filter(|device| device.exists() && !named(device))
        .map(|device| Adapter {
            port: device.display().to_string(),
            device: None,
        })
        .collect();
    found.extend(others);
    found
}

/// The persistent name of a serial device; without one, the path unchanged.
pub(super) fn persistent_name(port: &str) -> String {
    persistent_in(Path::new("/dev"), port)
}

fn persistent_in(dev: &Path, port: &str) -> String {
    let path = Path::new(port);
    let is_plain = path.parent() == Some(dev)
        && path
            .file_name()
            .is_some_and(|name| name.as_encoded_bytes().starts_with(b"tty"));
    let links = if is_plain { persistent_names(dev) } else { Vec::new() };
    let link = links.into_iter().find(|(_, device)| device == path);
    link.map_or_else(|| port.to_string(), |(link, _)| link.display().to_string())
}

/// Links in `serial/by-id`, each with the device that it points to.
fn persistent_names(dev: &Path) -> Vec<(PathBuf, PathBuf)> {
    let directory = dev.join("serial/by-id");
    let links = names(&directory).into_iter().map(|name| directory.join(name));
    links
        .filter_map(|link| Some((link.clone(), fs::canonicalize(&link).ok()?)))
        .collect()
}

/// Whether a driver found hardware for the port: most of the many UART ports of a PC have no hardware.
fn has_hardware(port: &Path) -> bool {
    let kind = fs::read_to_string(port.join("type")).unwrap_or_default();
    port.join("device").exists() && kind.trim() != "0"
}

/// Sorted names in a directory; empty if the directory cannot be read.
fn names(directory: &Path) -> Vec<String> {
    let entries = fs::read_dir(directory).into_iter().flatten().flatten();
    let mut names: Vec<String> = entries
        .filter_map(|entry| entry.file_name().into_string().ok())
        .collect();
    names.sort();
    names
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    #[test]
    fn persistent_names_come_first() {
        let root = tempfile::tempdir().unwrap();
        let dev = fs::canonicalize(root.path()).unwrap().join("dev");
        let tty = root.path().join("tty");
        fs::create_dir_all(dev.join("serial/by-id")).unwrap();
        for (name, kind, has_device) in [
            ("ttyUSB0", None, true),
            ("ttyUSB1", None, true),
            ("ttyS0", Some("4"), true),
            ("ttyS1", Some("0"), true),
            ("tty1", None, false),
        ] {
            fs::write(dev.join(name), "").unwrap();
            fs::create_dir_all(tty.join(name)).unwrap();
            if has_device {
                fs::create_dir(tty.join(name).join("device")).unwrap();
            }
            if let Some(kind) = kind {
                fs::write(tty.join(name).join("type"), format!("{kind}\n")).unwrap();
            }
        }
        let link = dev.join("serial/by-id/usb-FTDI_1");
        symlink("../../ttyUSB1", &link).unwrap();
        let port = |path: PathBuf| path.display().to_string();
        let ports: Vec<String> = listed(&dev, &tty).into_iter().map(|adapter| adapter.port).collect();
        assert_eq!(
            ports,
            [port(link.clone()), port(dev.join("ttyS0")), port(dev.join("ttyUSB0"))]
        );
        assert_eq!(listed(&dev, &tty)[0].device, Some(port(dev.join("ttyUSB1"))));
        assert!(listed(&root.path().join("none"), &root.path().join("none")).is_empty());
        assert_eq!(persistent_in(&dev, &port(dev.join("ttyUSB1"))), port(link));
        for other in [
            port(dev.join("ttyUSB0")),
            "tcp://a:1".to_string(),
            "/tmp/line1".to_string(),
        ] {
            assert_eq!(persistent_in(&dev, &other), other);
        }
    }
}
