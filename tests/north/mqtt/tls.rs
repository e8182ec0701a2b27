//! TLS, client certificates, users and rights.

use std::path::Path;
use std::process::Command;

use drivegate_core::event::EventKind;
use drivegate_mqtt::{Password, Secret};
use tempfile::TempDir;

use super::bench::*;

/// A CA, a server certificate for 127.0.0.1 and a client certificate, made with openssl.
fn certificates(dir: &Path) {
    let script = r#"
        set -e
        key() { openssl req -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -keyout $1.key -out $1.csr -subj /CN=$1; }
        for ca in ca other; do
            openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 2 -keyout $ca.key -out $ca.crt -subj /CN=$ca
        done
        echo 'subjectAltName = IP:127.0.0.1' > server.ext
        echo 'extendedKeyUsage = clientAuth' > client.ext
        for name in server client; do
            key $name
            openssl x509 -req -in $name.csr -CA ca.crt -CAkey ca.key -CAcreateserial -days 2 -extfile $name.ext -out $name.crt
        done
    "#;
    let output = Command::new("sh").arg("-c").arg(script).current_dir(dir).output();
    let output = output.expect("sh starts");
    assert!(
        output.status.success(),
        "certificates cannot be made; install openssl: {}",
        String::from_utf8_lossy(&output.stderr)
    );
}

const TLS: &str = "allow_anonymous true\ncafile {dir}/ca.crt\ncertfile {dir}/server.crt\nkeyfile {dir}/server.key\n\
    require_certificate true\n";

#[test]
fn mutual_tls() {
    let dir = TempDir::new().unwrap();
    certificates(dir.path());
    let mut broker = Broker::prepared(dir, TLS);
    broker.up();
    let file = |name: &str| broker.dir.path().join(name);
    let path = |name: &str| file(name).display().to_string();
    let (ca, certificate, key) = (path("ca.crt"), path("client.crt"), path("client.key"));
    let login = ["--cafile", ca.as_str(), "--cert", &certificate, "--key", &key];
    let watcher = Watcher::with(&broker, "drivegate/#", &login);
    let mut good = options(broker.port);
    good.tls = true;
    good.ca = Some(file("ca.crt"));
    good.identity = Some((file("client.crt"), file("client.key")));

    let mut foreign_ca = good.clone();
    foreign_ca.ca = Some(file("other.crt"));
    let mut no_tls = good.clone();
    no_tls.tls = false;
    let mut no_certificate = good.clone();
    no_certificate.identity = None;
    let mut missing_file = good.clone();
    missing_file.ca = Some(file("nowhere.crt"));
    let mut system_roots = good.clone();
    system_roots.ca = None;
    for (bad, why) in [
        (
            foreign_ca,
            "is signed by `ca`, which is not among the certificates of mqtt.ca",
        ),
        (no_tls, "mqtts:// for a port with TLS, usually 8883"),
        (
            no_certificate,
            "it requires a client certificate (alert CertificateRequired); set mqtt.certificate and mqtt.key",
        ),
        (missing_file, "nowhere.crt: No such file or directory"),
        (system_roots, "is signed by `ca`, which is not among"),
    ] {
        let gateway = Gateway::start(bad, plant(&["p1"]));
        gateway.publish_event("p1", EventKind::Fault, "not delivered");
        wait_log(broker.port, why);
        assert!(!gateway.connected());
        gateway.stop();
    }
    assert!(watcher.all().is_empty(), "{:?}", watcher.all());

    let gateway = Gateway::start(good, plant(&["p1"]));
    watcher.wait_payload("drivegate/hall/status", "online");
    broker.publish("drivegate/hall/drive/p1/set/run", "1", &login);
    watcher.wait("the result", |m| m.topic == "drivegate/hall/drive/p1/result");
    gateway.stop();
    watcher.wait_payload("drivegate/hall/status", "offline");
}

#[test]
fn users_passwords_and_rights() {
    let dir = TempDir::new().unwrap();
    let passwords = dir.path().join("passwords");
    std::fs::write(&passwords, "").unwrap();
    for (user, password) in [("hall", "s3cret"), ("all", "all")] {
        let arguments = ["-b", passwords.to_str().unwrap(), user, password];
        let made = Command::new("mosquitto_passwd").args(arguments).status();
        assert!(made.expect("mosquitto_passwd of the package mosquitto").success());
    }
    // The gateway may neither publish its events nor subscribe to the set topics of single points.
    let acl = "user all\ntopic readwrite #\nuser hall\ntopic write drivegate/hall/status\n\
        topic write drivegate/hall/drive/p1/state\ntopic write drivegate/hall/drive/+/result\n\
        topic read drivegate/hall/drive/+/set\n";
    std::fs::write(dir.path().join("acl"), acl).unwrap();
    let mut broker = Broker::prepared(
        dir,
        "allow_anonymous false\npassword_file {dir}/passwords\nacl_file {dir}/acl\n",
    );
    broker.up();
    let login = ["-u", "all", "-P", "all"];
    let watcher = Watcher::with(&broker, "drivegate/#", &login);
    let mut wrong = options(broker.port);
    wrong.username = Some("hall".to_string());
    wrong.password = Some(Password::Fixed(Secret("guess".to_string())));
    let gateway = Gateway::start(wrong.clone(), plant(&["p1"]));
    gateway.publish_event("p1", EventKind::Fault, "kept");
    wait_log(broker.port, "(NotAuthorized); check mqtt.username");
    wait_for("the event to be buffered", || (gateway.buffered() == 1).then_some(()));
    assert!(!gateway.connected());
    gateway.stop();
    let mut right = wrong;
    right.password = Some(Password::Fixed(Secret("s3cret".to_string())));
    let gateway = Gateway::start(right, plant(&["p1"]));
    watcher.wait_payload("drivegate/hall/status", "online");
    watcher.wait("the state", |m| m.topic == "drivegate/hall/drive/p1/state");
    // A message that the broker refuses permanently is dropped; the rest continues.
    gateway.publish_event("p1", EventKind::Fault, "not allowed");
    broker.publish("drivegate/hall/drive/p1/set", r#"{"run": true}"#, &login);
    watcher.wait("the result", |m| m.topic == "drivegate/hall/drive/p1/result");
    wait_for("nothing to wait", || (gateway.buffered() == 0).then_some(()));
    assert!(gateway.connected());
    assert!(
        watcher
            .all()
            .iter()
            .all(|m| !m.topic.ends_with("/event") && !m.topic.contains("/point/"))
    );
    gateway.stop();
}
