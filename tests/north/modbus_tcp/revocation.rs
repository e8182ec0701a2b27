//! Client certificates that are no longer accepted: revoked, of a CA that was replaced, of a role that was changed,
//! expired. Certificates and lists are made by openssl; the clients of the daemon are Python's.

use std::path::Path;
use std::process::Command;
use std::time::{Duration, SystemTime};

use drivegate_north::Reconfigure as _;
use drivegate_north::modbus_tcp::{Identity, Options, Role};
use rustls::version::{TLS12, TLS13};

use super::rig::{Rig, registers, until, words};
use super::tls::{TlsClient, WORKS, make, refused, tls_options};
use crate::support::process::Running;
use crate::support::tools;

/// Whether the client gets an answer of pump-1, and so is served.
async fn is_served(client: &mut TlsClient) -> bool {
    match client.ask(1, &words(3, &[2102, 1])).await {
        Ok(answer) => answer == registers(3, &[5000]),
        Err(_) => false,
    }
}

/// A directory for one CA with these files of [`WORKS`].
fn copy(names: &[&str]) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    for name in names {
        std::fs::copy(WORKS.file(&format!("own/{name}")), dir.path().join(name)).unwrap();
    }
    dir
}

fn sh(dir: &Path, command: &str) {
    let output = Command::new("sh")
        .args(["-ec", command])
        .current_dir(dir)
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

/// The usual options with other clients: those of `ca`, except those that `crl` revokes.
fn admitting(ca: &Path, crl: Option<&Path>) -> Options {
    let [certificate, key] = ["own/gateway.crt", "own/gateway.key"].map(|name| WORKS.file(name));
    let mut options = tls_options();
    options.tls.as_mut().unwrap().identity = Identity::load(&certificate, &key, ca, crl, SystemTime::now())
        .unwrap()
        .0;
    options
}

#[tokio::test]
async fn a_revoked_client_is_disconnected_and_refused() {
    let ca = copy(&["ca.crt", "ca.key", "hmi.crt"]);
    make(ca.path(), &["revoke", "hmi"], "30");
    let mut rig = Rig::with(tls_options()).await;
    let address = rig.server.tls_addresses()[0];
    for version in [&TLS12, &TLS13] {
        rig.reload(tls_options()).await.unwrap();
        let connect = |name| TlsClient::connect(address, WORKS.client(Some(name), version));
        let (mut hmi, mut screen) = (connect("own/hmi").await.unwrap(), connect("own/screen").await.unwrap());
        assert!(is_served(&mut hmi).await && is_served(&mut screen).await);
        let before = refused(&rig);
        rig.reload(admitting(&ca.path().join("ca.crt"), Some(&ca.path().join("ca.crl"))))
            .await
            .unwrap();
        hmi.is_ended().await;
        assert!(is_served(&mut screen).await, "another client stays");
        let again = match connect("own/hmi").await {
            Ok(mut client) => is_served(&mut client).await,
            Err(_) => false,
        };
        assert!(!again);
        until("it is counted", || refused(&rig) == before + 1).await;
    }
    rig.end().await;
}

/// A list that should have been replaced months ago still revokes its entries, and still admits the others.
#[tokio::test]
async fn an_old_list_stays_in_force() {
    let ca = copy(&["ca.crt", "ca.key", "hmi.crt"]);
    make(ca.path(), &["revoke", "hmi"], "30");
    sh(
        ca.path(),
        "printf '[ca]\ndefault_ca=a\n[a]\ndatabase=ca.index\ndefault_md=sha256\ncrl_extensions=e\n[e]\n\
         authorityKeyIdentifier=keyid\n' >conf && openssl ca -gencrl -config conf -cert ca.crt -keyfile ca.key \
         -crl_lastupdate 20260101000000Z -crl_nextupdate 20260102000000Z -out ca.crl",
    );
    let rig = Rig::with(admitting(&ca.path().join("ca.crt"), Some(&ca.path().join("ca.crl")))).await;
    let address = rig.server.tls_addresses()[0];
    let mut screen = TlsClient::connect(address, WORKS.client(Some("own/screen"), &TLS13))
        .await
        .unwrap();
    assert!(is_served(&mut screen).await);
    let mut hmi = TlsClient::connect(address, WORKS.client(Some("own/hmi"), &TLS13))
        .await
        .unwrap();
    assert!(!is_served(&mut hmi).await);
    rig.end().await;
}

#[tokio::test]
async fn a_replaced_ca_disconnects_its_clients() {
    let mut rig = Rig::with(tls_options()).await;
    let address = rig.server.tls_addresses()[0];
    let connect = |name| TlsClient::connect(address, WORKS.client(Some(name), &TLS13));
    let mut hmi = connect("own/hmi").await.unwrap();
    assert!(is_served(&mut hmi).await);
    rig.reload(admitting(&WORKS.file("other/ca.crt"), None)).await.unwrap();
    hmi.is_ended().await;
    let mut other = connect("other/hmi").await.unwrap();
    assert!(is_served(&mut other).await);
    rig.end().await;
}

#[tokio::test]
async fn other_rights_of_a_role_disconnect_its_clients() {
    let mut rig = Rig::with(tls_options()).await;
    let address = rig.server.tls_addresses()[0];
    let connect = |name| TlsClient::connect(address, WORKS.client(Some(name), &TLS13));
    let (mut hmi, mut screen) = (connect("own/hmi").await.unwrap(), connect("own/screen").await.unwrap());
    let write = words(6, &[0x8101, 5000]);
    assert_eq!(hmi.ask(1, &write).await.unwrap(), write);
    assert!(is_served(&mut screen).await);
    let mut options = tls_options();
    let roles = &mut options.tls.as_mut().unwrap().roles;
    roles.insert("operator".to_string(), Role::Monitor);
    roles.insert("cleaner".to_string(), Role::Monitor);
    let change = rig.server.prepare(options).await.unwrap();
    assert_eq!(hmi.ask(1, &write).await.unwrap(), write, "nothing has changed yet");
    rig.server.commit(change);
    hmi.is_ended().await;
    assert!(is_served(&mut screen).await, "its rights are the same");
    let mut hmi = connect("own/hmi").await.unwrap();
    assert_eq!(hmi.ask(1, &write).await.unwrap(), [0x86, 1], "it may only read now");
    rig.end().await;
}

/// Signs a certificate for hmi's key that expires in `seconds` seconds.
fn sign_for(dir: &Path, seconds: u64) {
    let end = humantime::format_rfc3339_seconds(SystemTime::now() + Duration::from_secs(seconds)).to_string();
    let end: String = end
        .chars()
        .filter(char::is_ascii_alphanumeric)
        .filter(|c| *c != 'T')
        .collect();
    sh(
        dir,
        &format!(
            "printf '[ca]\ndefault_ca=a\n[a]\ndatabase=index\nunique_subject=no\ndefault_md=sha256\nnew_certs_dir=.\n\
             policy=p\nrand_serial=yes\n[p]\ncommonName=supplied\n' >conf && : >index &&
             printf 'extendedKeyUsage=clientAuth\n' >ext && openssl req -new -key hmi.key -subj /CN=hmi -out csr &&
             openssl ca -batch -notext -config conf -cert ca.crt -keyfile ca.key -in csr -out hmi.crt -enddate {end} \
             -extfile ext"
        ),
    );
}

#[tokio::test]
async fn a_connection_ends_with_its_certificate() {
    let dir = copy(&["ca.crt", "ca.key", "hmi.key"]);
    let rig = Rig::with(tls_options()).await;
    let address = rig.server.tls_addresses()[0];
    let mut screen = TlsClient::connect(address, WORKS.client(Some("own/screen"), &TLS13))
        .await
        .unwrap();
    // A slow machine needs longer to connect.
    let mut seconds = 2;
    let mut brief = loop {
        sign_for(dir.path(), seconds);
        let name = dir.path().join("hmi").display().to_string();
        let mut client = TlsClient::connect(address, WORKS.client(Some(&name), &TLS13))
            .await
            .unwrap();
        if is_served(&mut client).await {
            break client;
        }
        seconds *= 2;
    };
    brief.is_ended().await;
    assert!(is_served(&mut screen).await);
    rig.end().await;
}

/// openssl makes no certificate with two extensions of one kind, so a certificate with another extension is changed and
/// signed again.
fn sign_with_two_roles(dir: &Path) {
    sh(
        dir,
        "printf 'extendedKeyUsage=clientAuth\n1.3.6.1.4.1.50316.802.1=ASN1:UTF8String:viewer\n\
         1.3.6.1.4.1.50316.802.2=ASN1:UTF8String:operator\n' >ext && openssl req -new -key hmi.key -subj /CN=hmi -out csr &&
         openssl x509 -req -in csr -CA ca.crt -CAkey ca.key -set_serial 7 -days 30 -extfile ext -outform DER -out hmi.der",
    );
    let der = std::fs::read(dir.join("hmi.der")).unwrap();
    // SEQUENCE { TBSCertificate, algorithm of 12 bytes, BIT STRING }, the first two with lengths of two bytes.
    let length = 4 + usize::from(u16::from_be_bytes([der[6], der[7]]));
    let (mut signed, algorithm) = (der[4..4 + length].to_vec(), &der[4 + length..16 + length]);
    let other = [0x06, 0x0B, 0x2B, 6, 1, 4, 1, 0x83, 0x89, 0x0C, 0x86, 0x22, 2];
    let place = signed
        .windows(other.len())
        .position(|bytes| bytes == other)
        .expect("the second extension");
    signed[place + other.len() - 1] = 1;
    std::fs::write(dir.join("signed"), &signed).unwrap();
    sh(dir, "openssl dgst -sha256 -sign ca.key -out signature signed");
    let signature = std::fs::read(dir.join("signature")).unwrap();
    let signature = [&[3, signature.len() as u8 + 1, 0][..], &signature].concat();
    let whole = [&signed, algorithm, &signature].concat();
    let length = (whole.len() as u16).to_be_bytes();
    std::fs::write(dir.join("hmi.der"), [&[0x30, 0x82], &length[..], &whole].concat()).unwrap();
    sh(
        dir,
        "openssl x509 -inform DER -in hmi.der -out hmi.crt && openssl verify -CAfile ca.crt hmi.crt",
    );
}

fn sign_with_trailing_byte(dir: &Path) {
    sh(
        dir,
        "printf 'extendedKeyUsage=clientAuth\n1.3.6.1.4.1.50316.802.1=DER:0c:08:6f:70:65:72:61:74:6f:72:00\n' >ext &&
         openssl req -new -key hmi.key -subj /CN=hmi -out csr &&
         openssl x509 -req -in csr -CA ca.crt -CAkey ca.key -set_serial 8 -days 30 -extfile ext -out hmi.crt",
    );
}

#[tokio::test]
async fn an_ambiguous_role_is_refused() {
    let dir = copy(&["ca.crt", "ca.key", "hmi.key"]);
    let rig = Rig::with(tls_options()).await;
    let address = rig.server.tls_addresses()[0];
    let name = dir.path().join("hmi").display().to_string();
    for (count, sign) in [(1, sign_with_two_roles as fn(&Path)), (2, sign_with_trailing_byte)] {
        sign(dir.path());
        let mut client = TlsClient::connect(address, WORKS.client(Some(&name), &TLS13))
            .await
            .unwrap();
        assert!(!is_served(&mut client).await);
        until("it is counted", || refused(&rig) == count).await;
    }
    rig.end().await;
}

/// SIGHUP with a new list in the file. An invalid list changes nothing.
#[test]
fn the_daemon_takes_a_new_list() {
    let dir = copy(&[
        "ca.crt",
        "ca.key",
        "gateway.crt",
        "gateway.key",
        "hmi.crt",
        "hmi.key",
        "screen.crt",
        "screen.key",
    ]);
    let at = |name: &str| dir.path().join(name).display().to_string();
    make(dir.path(), &["crl"], "30");
    let port = crate::support::process::free_port();
    let text = format!(
        "[gateway]\nname = \"g\"\nsocket = \"\"\n[modbus_tcp.tls]\nlisten = [\"127.0.0.1:{port}\"]\n\
         certificate = \"gateway.crt\"\nkey = \"gateway.key\"\nclient_ca = \"ca.crt\"\nclient_crl = \"ca.crl\"\n\
         roles = {{ operator = \"control\" }}\n[log]\nformat = \"json\"\n"
    );
    std::fs::write(at("drivegate.toml"), text).unwrap();
    let daemon = Running::drivegate(&["run", "--config", &at("drivegate.toml")]);
    daemon.until_printed("drivegate is running");
    let client = |name: &str| {
        let script = tools::root().join("tests/peers/tls_client.py");
        let (port, files) = (
            port.to_string(),
            [at("ca.crt"), at(&format!("{name}.crt")), at(&format!("{name}.key"))],
        );
        let [ca, certificate, key] = &files;
        Running::start(
            &tools::python(),
            &[&script.display().to_string(), &port, ca, certificate, key],
        )
    };
    let (hmi, mut screen) = (client("hmi"), client("screen"));
    hmi.until_printed("answered");
    screen.until_printed("answered");

    let good = std::fs::read(at("ca.crl")).unwrap();
    std::fs::write(at("ca.crl"), &good[..good.len() / 2]).unwrap();
    daemon.signal("HUP");
    daemon.until_printed("keeping the current configuration");
    std::fs::write(at("ca.crl"), &good).unwrap();

    make(dir.path(), &["revoke", "hmi"], "30");
    daemon.signal("HUP");
    hmi.until_printed("ended");
    daemon.until_printed("its certificate is no longer accepted");
    client("hmi").until_printed("refused");
    assert!(
        screen.runs() && !screen.output().contains("ended"),
        "{}",
        screen.output()
    );
}
