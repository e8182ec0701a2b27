//! Revocation lists, and who can read secrets.

use std::fs::{Permissions, set_permissions};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use super::listeners::{certificate, certificates};
use super::{FULL, load};

/// Commands never overwrite files of the gateway in its state directory or that of the buffer, under any name.
#[test]
fn the_audit_has_a_file_of_its_own() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    std::fs::create_dir_all(path("state/params/pump-1")).unwrap();
    std::fs::write(path("state/events.jsonl"), "").unwrap();
    std::os::unix::fs::symlink(path("state/events.jsonl"), path("elsewhere")).unwrap();
    let said_of = |file: &str| {
        let text = format!(
            "[gateway]\nname = \"g\"\nstate_dir = \"{}\"\n[mqtt]\nurl = \"mqtt://127.0.0.1\"\n\
             buffer = {{ dir = \"{}\" }}\n[audit]\nfile = \"{file}\"\n",
            path("state"),
            path("buffer")
        );
        let (loaded, _) = load(&text);
        loaded.errors.iter().map(ToString::to_string).collect::<Vec<_>>()
    };
    for (file, name) in [
        ("events.jsonl".to_string(), "events.jsonl"),
        ("./counters.json".to_string(), "counters.json"),
        ("params/../events.jsonl.1".to_string(), "events.jsonl.1"),
        ("params/pump-1/audit.jsonl".to_string(), "params"),
        ("mqtt-history-1.log".to_string(), "mqtt-history-1.log"),
        (path("buffer/mqtt-events-1.log"), "mqtt-events-1.log"),
        (path("state/sparkplug-bdseq"), "sparkplug-bdseq"),
        (path("elsewhere"), "events.jsonl"),
    ] {
        let expected = format!(
            "the gateway uses `{name}` for something else; /etc/drivegate/t.toml:8, audit.file; give the audit file another name, such as \
             \"audit.jsonl\""
        );
        assert_eq!(said_of(&file), [expected], "{file}");
    }
    for file in [
        "audit.jsonl".to_string(),
        "commands/events.jsonl".to_string(),
        path("events.jsonl"),
    ] {
        assert_eq!(said_of(&file), [""; 0], "{file}");
    }
}

/// The configuration of openssl for revocation lists.
const BOOK: &str = "[ca]\ndefault_ca=a\n[a]\ndatabase=index\ndefault_md=sha256\n";
/// Extensions that make the lists version 2.
const EXTENSIONS: &str = "crl_extensions=e\n[e]\nauthorityKeyIdentifier=keyid\n";

/// An empty list of the CA in [`certificates`], with these options of openssl, in `dir`.
fn revocations(dir: &Path, name: &str, book: &str, options: &str) -> PathBuf {
    std::fs::write(dir.join("book"), book).unwrap();
    std::fs::write(dir.join("index"), "").unwrap();
    let ca = certificates().display();
    let command = format!("ca -gencrl -config book -cert {ca}/ca.crt -keyfile {ca}/ca.key {options} -out {name}");
    openssl(dir, &command);
    dir.join(name)
}

fn openssl(dir: &Path, arguments: &str) {
    let output = Command::new("openssl")
        .args(arguments.split(' '))
        .current_dir(dir)
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

/// Messages about this file as `client_crl`.
fn said_of(file: &Path) -> String {
    let usual = certificates().join("ca.crl").display().to_string();
    let (loaded, _) = load(&FULL.replace(&usual, &file.display().to_string()));
    let problems = loaded.errors.iter().chain(&loaded.warnings);
    let found = problems.filter(|problem| problem.key == "modbus_tcp.tls.client_crl");
    found.map(ToString::to_string).collect::<Vec<_>>().join("\n")
}

#[test]
fn revocations_are_checked_before_they_refuse_everybody() {
    let (usual, dir) = (certificates().join("ca.crl"), tempfile::tempdir().unwrap());
    let dir = dir.path();
    assert_eq!(said_of(&usual), "");
    // DER is the form in which CAs publish the list.
    openssl(dir, &format!("crl -outform DER -in {} -out der.crl", usual.display()));
    assert_eq!(said_of(&dir.join("der.crl")), "");
    let bytes = std::fs::read(dir.join("der.crl")).unwrap();
    std::fs::write(dir.join("cut.crl"), &bytes[..bytes.len() - 1]).unwrap();
    // Revocation lists of a CA with an equal name, and of one with another name.
    certificate(&dir.join("same"), &["ca"], "30");
    certificate(&dir.join("same"), &["crl"], "30");
    let renamed = "req -x509 -newkey rsa:2048 -nodes -keyout other/ca.key -out other/ca.crt -days 30 -subj /CN=other";
    std::fs::create_dir(dir.join("other")).unwrap();
    openssl(dir, renamed);
    certificate(&dir.join("other"), &["crl"], "30");
    let old = "-crl_lastupdate 20260101000000Z -crl_nextupdate 20260102000000Z";
    for (file, wanted) in [
        (dir.join("no.crl"), "cannot read "),
        (
            certificates().join("gateway.crt"),
            "gateway.crt contains no CRL, but a certificate; ",
        ),
        (dir.join("cut.crl"), "contains no usable CRL: "),
        (revocations(dir, "v1.crl", BOOK, "-crldays 30"), "CRLs of version 2"),
        (dir.join("same/ca.crl"), "is not signed by the CA in client_ca"),
        (dir.join("other/ca.crl"), "contains no CRL of CA `drivegate test CA`"),
        (
            revocations(dir, "old.crl", &format!("{BOOK}{EXTENSIONS}"), old),
            "should have been replaced by 2026-01-02T00:00:00Z and stays in force",
        ),
    ] {
        let found = said_of(&file);
        assert!(
            found.contains(wanted) && found.lines().count() == 1,
            "{wanted}\nis not\n{found}"
        );
    }
}

#[test]
fn secrets_that_everybody_can_read() {
    let dir = tempfile::tempdir().unwrap();
    let secret = dir.path().join("secret");
    std::fs::write(&secret, "open sesame").unwrap();
    let source = format!(
        "[gateway]\nname = \"g\"\n[mqtt]\nusername = \"me\"\npassword_file = \"{}\"\n",
        secret.display()
    );
    for (mode, warned) in [
        (0o600, false),
        (0o640, false),
        (0o660, false),
        (0o604, true),
        (0o602, true),
        (0o644, true),
    ] {
        set_permissions(&secret, Permissions::from_mode(mode)).unwrap();
        let (loaded, _) = load(&source);
        let found: Vec<String> = loaded.warnings.iter().map(ToString::to_string).collect();
        let wanted = format!(
            "{shown} holds a secret, and every user of this machine may read or write it (mode {mode:04o}); \
             /etc/drivegate/t.toml:5, mqtt.password_file; chmod o-rw {shown}",
            shown = secret.display()
        );
        assert_eq!(found.contains(&wanted), warned, "{mode:o}: {found:#?}");
    }
    // Other data that can be read on the way to the broker causes a warning as well.
    for (url, warned) in [
        ("mqtt://localhost", 0),
        ("mqtt://127.0.0.2", 0),
        ("mqtt://[::1]:1884", 0),
        ("mqtts://broker", 0),
        ("mqtt://broker", 1),
        ("mqtt://192.168.1.5", 1),
    ] {
        let (loaded, _) = load(&source.replace("[mqtt]\n", &format!("[mqtt]\nurl = \"{url}\"\n")));
        let found = loaded
            .warnings
            .iter()
            .filter(|w| w.finding.what.contains("password is sent to"));
        assert_eq!(found.count(), warned, "{url}");
    }
    // A password is in the configuration itself.
    let file = dir.path().join("t.toml");
    let text = "[gateway]\nname = \"g\"\n[mqtt]\nusername = \"me\"\npassword = \"x\"\n";
    std::fs::write(&file, text).unwrap();
    for (mode, warned) in [(0o640, 0), (0o644, 1)] {
        set_permissions(&file, Permissions::from_mode(mode)).unwrap();
        let loaded = super::Settings::load(&file, std::iter::empty());
        let found = loaded
            .warnings
            .iter()
            .filter(|w| w.key == "mqtt.password" && w.line == Some(5));
        assert_eq!(found.count(), warned, "{mode:o}");
    }
}

#[test]
fn users_are_read_and_pointed_out() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("users");
    let alice = drivegate_http::User::new("alice", "correct horse").unwrap();
    let said = |text: &str, mode, commands: bool| {
        std::fs::write(&file, text).unwrap();
        set_permissions(&file, Permissions::from_mode(mode)).unwrap();
        let path = file.display();
        let (loaded, _) = load(&format!(
            "[gateway]\nname = \"g\"\n[http]\nusers_file = \"{path}\"\ncommands = {commands}\n"
        ));
        let problems = loaded.errors.iter().chain(&loaded.warnings);
        let found = problems.filter(|problem| problem.key.starts_with("http."));
        found.map(ToString::to_string).collect::<Vec<_>>().join("\n")
    };
    assert_eq!(said(&alice.to_string(), 0o600, true), "");
    assert!(said(&alice.to_string(), 0o644, true).contains("holds a secret"));
    assert!(said("", 0o600, true).contains("contains no user, so nobody can log in"));
    assert!(said(&alice.to_string(), 0o600, false).contains("not used while `commands` is off"));
    let bad = said(&format!("{alice}\nbob password\n"), 0o600, true);
    assert!(bad.contains("users:2: the hash is not one of Argon2id"), "{bad}");
}
