//! The files that a configuration names, even if they cannot be read or the configuration is invalid: for the check
//! of permissions and for backups.

use std::path::{Path, PathBuf};

use super::key::Key;
use super::keys::{BACNET, GATEWAY, HTTP, MODBUS_TCP, MQTT, ROOT, TLS};
use super::settings::ENVIRONMENT;
use super::values;
use drivegate_model::document::{self, Document, Reader};

/// The kind of a file named in a configuration.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FileKind {
    /// The configuration file itself.
    Configuration,
    /// A profile of the user.
    Profile,
    /// Certificates or revocation lists, which are not secret.
    Certificate,
    /// A private key, passwords or tokens.
    Secret,
}

/// A file that the configuration names.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NamedFile {
    /// Dotted path of the key; empty for the configuration itself.
    pub key: String,
    /// Path of the file.
    pub path: PathBuf,
    /// Kind of the file.
    pub kind: FileKind,
}

/// The files of the configuration in `path`, with the variables of `env`, in the order of the sections.
pub fn named_files(path: &Path, env: impl Iterator<Item = (String, String)>) -> Vec<NamedFile> {
    let source = document::read_file(path).unwrap_or_default();
    let mut document = Document::parse(path.display().to_string(), &source);
    document.overlay(ENVIRONMENT, env);
    let mut found = Found {
        base: path.parent().unwrap_or(Path::new("")).to_path_buf(),
        files: vec![NamedFile {
            key: String::new(),
            path: path.to_path_buf(),
            kind: FileKind::Configuration,
        }],
    };
    let reader = document.reader();
    if let Some(gateway) = ROOT.gateway.table(&reader) {
        found.profiles(&gateway);
    }
    if let Some(modbus_tcp) = ROOT.modbus_tcp.table(&reader)
        && let Some(tls) = MODBUS_TCP.tls.table(&modbus_tcp)
    {
        for key in [&TLS.certificate, &TLS.client_ca, &TLS.client_crl] {
            found.add(&tls, key, FileKind::Certificate);
        }
        found.add(&tls, &TLS.key, FileKind::Secret);
    }
    if let Some(mqtt) = ROOT.mqtt.table(&reader) {
        for key in [&MQTT.ca, &MQTT.certificate] {
            found.add(&mqtt, key, FileKind::Certificate);
        }
        for key in [&MQTT.key, &MQTT.password_file] {
            found.add(&mqtt, key, FileKind::Secret);
        }
    }
    if let Some(http) = ROOT.http.table(&reader) {
        found.add(&http, &HTTP.certificate, FileKind::Certificate);
        for key in [&HTTP.key, &HTTP.tokens_file, &HTTP.users_file] {
            found.add(&http, key, FileKind::Secret);
        }
    }
    if let Some(bacnet) = ROOT.bacnet.table(&reader) {
        found.add(&bacnet, &BACNET.dcc_password_file, FileKind::Secret);
    }
    found.files
}

struct Found {
    base: PathBuf,
    files: Vec<NamedFile>,
}

impl Found {
    fn add(&mut self, table: &Reader<'_>, key: &Key<PathBuf>, kind: FileKind) {
        if let Some(path) = key.written(table) {
            self.files.push(NamedFile {
                key: key.place(table).key,
                path: values::resolved(&self.base, path),
                kind,
            });
        }
    }

    fn profiles(&mut self, gateway: &Reader<'_>) {
        let key = GATEWAY.profile_dirs.place(gateway).key;
        for dir in GATEWAY.profile_dirs.get(gateway) {
            let dir = values::resolved(&self.base, dir);
            let listed = std::fs::read_dir(&dir).into_iter().flatten().flatten();
            let is_profile = |path: &PathBuf| path.extension().is_some_and(|ending| ending == "toml");
            let mut profiles: Vec<PathBuf> = listed.map(|file| file.path()).filter(is_profile).collect();
            profiles.sort();
            self.files.extend(profiles.into_iter().map(|path| NamedFile {
                key: key.clone(),
                path,
                kind: FileKind::Profile,
            }));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_file_is_found_also_of_an_invalid_configuration() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("drivegate.toml");
        std::fs::create_dir(folder.path().join("profiles")).unwrap();
        std::fs::write(folder.path().join("profiles/own.toml"), "").unwrap();
        let text = "[gateway]\nnme = \"x\"\nprofile_dirs = [\"profiles\"]\n[modbus_tcp.tls]\ncertificate = \"a.crt\"\nkey = \"a.key\"\n\
            client_ca = \"ca.crt\"\n[mqtt]\npassword_file = \"/run/password\"\nca = \"b.crt\"\n[http]\ntokens_file = \"tokens\"\nusers_file = \"users\"\n";
        std::fs::write(&file, text).unwrap();
        let env = [("DRIVEGATE__HTTP__KEY".to_string(), "h.key".to_string())];
        let found = named_files(&file, env.into_iter());
        let short = |file: &NamedFile| {
            let path = file.path.strip_prefix(folder.path()).unwrap_or(&file.path);
            (file.key.clone(), path.display().to_string(), file.kind)
        };
        let expected = [
            ("", "drivegate.toml", FileKind::Configuration),
            ("gateway.profile_dirs", "profiles/own.toml", FileKind::Profile),
            ("modbus_tcp.tls.certificate", "a.crt", FileKind::Certificate),
            ("modbus_tcp.tls.client_ca", "ca.crt", FileKind::Certificate),
            ("modbus_tcp.tls.key", "a.key", FileKind::Secret),
            ("mqtt.ca", "b.crt", FileKind::Certificate),
            ("mqtt.password_file", "/run/password", FileKind::Secret),
            ("http.key", "h.key", FileKind::Secret),
            ("http.tokens_file", "tokens", FileKind::Secret),
            ("http.users_file", "users", FileKind::Secret),
        ];
        let expected = expected.map(|(key, path, kind)| (key.to_string(), path.to_string(), kind));
        assert_eq!(found.iter().map(short).collect::<Vec<_>>(), expected);
    }
}
