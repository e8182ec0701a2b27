//! Tests of listeners and certificates.

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::LazyLock;
use std::time::Duration;

use super::{FORM, FULL, load, settings};

/// Directory of a CA and a server certificate, made by the script of the documentation.
pub(super) fn certificates() -> &'static Path {
    static DIR: LazyLock<(tempfile::TempDir, Child)> = LazyLock::new(|| {
        let dir = tempfile::tempdir().unwrap();
        // Static values are never dropped, so a child process removes the folder when this process ends and its
        // pipe closes.
        let mut sweeper = Command::new("sh");
        sweeper.args(["-c", "cat >/dev/null; rm -rf \"$0\""]).arg(dir.path());
        let sweeper = sweeper
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn();
        for arguments in [&["ca"][..], &["server", "gateway"], &["server", "other"]] {
            // A day less than the thirty from which a warning is given, at any second.
            certificate(dir.path(), arguments, "29");
        }
        certificate(dir.path(), &["server", "expired"], "-1");
        certificate(dir.path(), &["crl"], "30");
        std::fs::write(dir.path().join("tokens"), "").unwrap();
        (dir, sweeper.unwrap())
    });
    DIR.0.path()
}

/// Runs the certificate script of the documentation.
pub(super) fn certificate(dir: &Path, arguments: &[&str], days: &str) {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/modbus-tls-ca.sh");
    let output = Command::new(script)
        .arg(dir)
        .args(arguments)
        .env("DAYS", days)
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn units_are_unique_where_modbus_tcp_serves_them() {
    let mut source = "[gateway]\nname = \"g\"\n".to_string();
    for bus in 1..=32 {
        source += &format!("[[bus]]\nname = \"b{bus}\"\nport = \"/dev/tty{bus}\"\n");
        for address in 1..=31 {
            source +=
                &format!("[[bus.drive]]\nname = \"d{bus}-{address}\"\naddress = {address}\nprofile = \"vacon-nx\"\n");
        }
    }
    assert_eq!(
        settings(&source).buses.iter().map(|b| b.drives.len()).sum::<usize>(),
        992
    );
    let (served, _) = load(&(source + "[modbus_tcp]\n"));
    assert_eq!(served.errors.len(), 961);
    assert!(
        served.errors[0].finding.what.contains("unit 1 already belongs to"),
        "{:?}",
        served.errors[0]
    );
}

/// Two lines with equal addresses, and this content of `[modbus_tcp]`.
fn two_lines(modbus_tcp: &str) -> String {
    let mut source = "[gateway]\nname = \"g\"\n".to_string();
    for bus in ["line1", "line2"] {
        source += &format!("[[bus]]\nname = \"{bus}\"\nport = \"/dev/{bus}\"\n");
        for address in [1, 2] {
            source +=
                &format!("[[bus.drive]]\nname = \"{bus}-{address}\"\naddress = {address}\nprofile = \"vacon-nx\"\n");
        }
    }
    source + modbus_tcp
}

#[test]
fn a_listener_for_each_line() {
    let split = two_lines(
        "[modbus_tcp]\nallow = [\"10.0.0.0/8\"]\nwrite = [\"10.0.0.1\"]\n\
         [[modbus_tcp.listener]]\nlisten = [\"127.0.0.1:1503\"]\nbuses = [\"line1\"]\n\
         [[modbus_tcp.listener]]\nlisten = [\"127.0.0.1:1504\"]\nbuses = [\"line2\"]\nwrite = []\nallow = [\"10.2.0.0/16\"]\n",
    );
    let options = settings(&split).modbus_tcp.unwrap();
    assert_eq!(
        options.listeners.len(),
        2,
        "the short form is not there unless it is written"
    );
    let [one, two] = [&options.listeners[0], &options.listeners[1]];
    assert_eq!(one.view.buses.as_deref(), Some(&["line1".to_string()][..]));
    assert_eq!(
        (one.allow[0].to_string(), one.write[0].to_string()),
        ("10.0.0.0/8".into(), "10.0.0.1/32".into())
    );
    assert_eq!((two.allow[0].to_string(), two.write.len()), ("10.2.0.0/16".into(), 0));
    assert_eq!(options.idle_timeout, Some(Duration::from_secs(3600)));
    let off = settings(&split.replace("[modbus_tcp]", "[modbus_tcp]\nidle_timeout = \"off\""))
        .modbus_tcp
        .unwrap();
    assert_eq!(off.idle_timeout, None);
    // In one listener the drives of both buses would share their unit ids.
    let (both, _) = load(&split.replace("buses = [\"line2\"]", "buses = [\"line1\", \"line2\"]"));
    assert_eq!(both.errors.len(), 2, "{:?}", both.errors);
    assert!(
        both.errors[0]
            .finding
            .what
            .contains("unit 1 already belongs to drive `line1-1`"),
        "{:?}",
        both.errors[0]
    );
    // A drive that is shown by two listeners is reported once.
    let (all, _) = load(&(split + "[modbus_tcp.tls]\ncertificate = \"a\"\n"));
    assert_eq!(
        all.errors
            .iter()
            .filter(|e| e.finding.what.contains("already belongs to drive"))
            .count(),
        2
    );
}

#[test]
fn errors_of_listeners() {
    let (loaded, _) = load(&two_lines(
        "[modbus_tcp]\nlisten = [\"127.0.0.1:1502\"]\nmax_connections_per_address = 0\nidle_timeout = \"0s\"\n\
         [[modbus_tcp.listener]]\nbuses = [\"lime1\", \"hall\"]\n\
         [[modbus_tcp.listener]]\nlisten = [\"127.0.0.1:1502\"]\nbuses = []\n",
    ));
    let found: Vec<String> = loaded.errors.iter().map(ToString::to_string).collect();
    for wanted in [
        "there is no bus `lime1`; /etc/drivegate/t.toml:30, modbus_tcp.listener[0].buses; did you mean `line1`?",
        "there is no bus `hall`; /etc/drivegate/t.toml:30, modbus_tcp.listener[0].buses; write one of line1, line2",
        "`listen` is missing; /etc/drivegate/t.toml:29, modbus_tcp.listener[0].listen; write addresses with ports, such as [\"127.0.0.1:1502\"]",
        "the list is empty; /etc/drivegate/t.toml:33, modbus_tcp.listener[1].buses; name a bus, or leave the key out for all",
        "127.0.0.1:1502 collides with 127.0.0.1:1502 of modbus_tcp.listen (line 26); /etc/drivegate/t.toml:32, \
         modbus_tcp.listener[1].listen; give each server its own port",
        "0 is out of range; /etc/drivegate/t.toml:27, modbus_tcp.max_connections_per_address; write 1 to 10000",
        "0s is out of range; /etc/drivegate/t.toml:28, modbus_tcp.idle_timeout; write \"1s\" to \"168h\"",
    ] {
        assert!(
            found.iter().any(|t| t == wanted),
            "{wanted}\nis missing in\n{}",
            found.join("\n")
        );
    }
}

#[test]
fn errors_of_certificates_name_file_and_key() {
    let dir = certificates();
    let shown = dir.display();
    let of = |from: &str, to: &str| {
        let (loaded, _) = load(&FULL.replacen(&format!("{shown}/{from}\""), &format!("{to}\""), 1));
        assert!(loaded.settings.is_none());
        loaded
            .errors
            .iter()
            .map(ToString::to_string)
            .collect::<Vec<_>>()
            .join("\n")
    };
    let file = |name: &str| dir.join(name).display().to_string();
    for (from, to, wanted) in [
        (
            "gateway.crt",
            file("nowhere.crt"),
            "nowhere.crt: No such file or directory (os error 2); /etc/drivegate/t.toml:19, \
          modbus_tcp.tls.certificate; check the path and its permissions",
        ),
        (
            "gateway.crt",
            file("gateway.key"),
            "gateway.key contains no certificate, but a private key; /etc/drivegate/t.toml:19, modbus_tcp.tls.certificate; specify the certificate: are certificate and key swapped?",
        ),
        (
            "gateway.crt",
            file("other.crt"),
            "the key does not match the certificate; /etc/drivegate/t.toml:20, \
          modbus_tcp.tls.key; specify the key of the certificate",
        ),
        (
            "gateway.key",
            file("gateway.crt"),
            "gateway.crt contains no private key",
        ),
        ("ca.crt", file(""), "modbus_tcp.tls.client_ca; "),
    ] {
        let found = of(from, &to);
        assert!(found.contains(wanted), "{wanted}\nis not in\n{found}");
        assert_eq!(found.lines().count(), 1, "{found}");
    }
}

/// The drives must be polled after a restart too, whatever became of a certificate.
#[test]
fn an_expired_certificate_is_a_warning() {
    let dir = certificates().display();
    let source = FULL
        .replace(&format!("{dir}/gateway.crt"), &format!("{dir}/expired.crt"))
        .replace(&format!("{dir}/gateway.key"), &format!("{dir}/expired.key"));
    let (loaded, _) = load(&source);
    assert_eq!(loaded.errors, []);
    let expired: Vec<&str> = loaded
        .warnings
        .iter()
        .filter(|warning| warning.finding.what.contains("expired.crt expired on "))
        .map(|warning| warning.key.as_str())
        .collect();
    assert_eq!(expired, ["modbus_tcp.tls.certificate", "http.certificate"]);
}

#[test]
fn new_certificates_in_the_same_files_are_seen() {
    let dir = tempfile::tempdir().unwrap();
    certificate(dir.path(), &["ca"], "30");
    certificate(dir.path(), &["crl"], "30");
    std::fs::write(dir.path().join("tokens"), "").unwrap();
    let source = FORM.replace("DIR", &dir.path().display().to_string());
    let renewed = || {
        let _ = std::fs::remove_file(dir.path().join("gateway.key"));
        let _ = std::fs::remove_file(dir.path().join("gateway.crt"));
        certificate(dir.path(), &["server", "gateway"], "400");
        settings(&source).modbus_tcp.unwrap()
    };
    let (one, two) = (renewed(), renewed());
    assert_ne!(one, two);
    let mut with_old_certificates = two.clone();
    with_old_certificates.tls = one.tls.clone();
    assert_eq!(with_old_certificates, one, "nothing else differs");
    let debug = format!("{one:?}");
    let key = std::fs::read_to_string(dir.path().join("gateway.key")).unwrap();
    assert!(
        debug.contains("elided") && !debug.contains(key.lines().nth(1).unwrap()),
        "{debug}"
    );
    // A certificate that expires within thirty days gives a warning.
    let (loaded, _) = load(&FULL);
    assert!(
        loaded.warnings.iter().any(|w| w.finding.what.contains("expires on")),
        "{:?}",
        loaded.warnings
    );
}

#[test]
fn shares_that_are_probably_too_small() {
    let warnings = |modbus_tcp: &str| {
        let (loaded, _) = load(&format!("[gateway]\nname = \"g\"\n[modbus_tcp]\n{modbus_tcp}\n"));
        let shares = loaded.warnings.iter().map(|warning| warning.finding.what.clone());
        shares.filter(|what| what.contains("share")).collect::<Vec<_>>()
    };
    for quiet in [
        "",
        "allow = [\"10.0.0.5\"]",
        "allow = [\"192.168.0.0/16\", \"fd00::/8\"]\nmax_connections = 1000",
        "allow = [\"10.0.0.5\", \"10.0.0.6\"]\nmax_connections = 32",
        "allow = [\"203.0.113.7\"]\nmax_connections = 16",
        "allow = [\"0.0.0.0/0\"]\nmax_connections_per_address = 64",
    ] {
        assert_eq!(warnings(quiet), Vec::<String>::new(), "{quiet}");
    }
    for (modbus_tcp, wanted) in [
        (
            "max_connections = 100",
            "at most 32 connections are possible, 16 for each address in `allow`",
        ),
        (
            "allow = [\"10.0.0.5\"]\nmax_connections = 17",
            "at most 16 connections are possible",
        ),
        (
            "allow = [\"10.0.0.0/8\", \"0.0.0.0/0\"]",
            "clients in 0.0.0.0/0 can come through a NAT",
        ),
        (
            "allow = [\"2001:db8::/32\"]",
            "share its address and the 16 connections",
        ),
    ] {
        let found = warnings(modbus_tcp);
        assert!(found.len() == 1 && found[0].contains(wanted), "{modbus_tcp}: {found:?}");
    }
}
