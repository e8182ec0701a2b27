//! Certificates of a broker that are accepted, and messages about the others. All are made by openssl; those that the gateway
//! or `mosquitto_pub` accepts are tried with `mosquitto_pub`, too.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;

use drivegate_testkit::rows;
use rustls::crypto::ring;
use rustls::server::{ClientHello, ResolvesServerCert, ServerConfig};
use rustls::sign::CertifiedKey;
use rustls::version::{TLS12, TLS13};
use rustls_pki_types::pem::PemObject;
use rustls_pki_types::{CertificateDer, PrivateKeyDer};
use tempfile::TempDir;
use tokio::runtime::Runtime;
use tokio_rustls::TlsAcceptor;

use super::bench::*;

/// Two CAs, and servers of all kinds for 127.0.0.1: `NAME.crt`, `NAME.key`.
const MAKE: &str = r#"
    set -e
    key() { openssl genpkey -algorithm EC -pkeyopt ec_paramgen_curve:${2:-P-256} -out $1.key; }
    request() { openssl req -new -key $1.key -subj "/CN=${2:-127.0.0.1}" -out $1.csr; }
    by_itself() { openssl req -new -x509 -key $1.key -days 2 -out $1.crt -subj "/CN=${2:-127.0.0.1}" "${@:3}"; }
    by_ca() { openssl x509 -req -in $1.csr -CA $2.crt -CAkey $2.key -CAcreateserial -days 2 -out $1.crt "${@:3}"; }
    here='subjectAltName=IP:127.0.0.1'
    key ca; by_itself ca works-ca
    key ca521 P-521; by_itself ca521 large-ca

    key ordinary; by_itself ordinary broker -addext $here
    key leaf; by_itself leaf broker -addext $here -addext basicConstraints=critical,CA:FALSE
    key named; by_itself named 127.0.0.1
    key old; request old; openssl x509 -req -in old.csr -signkey old.key -days 2 -out old.crt
    key elsewhere; by_itself elsewhere broker -addext subjectAltName=DNS:broker.local,IP:10.0.0.5
    key late; request late; openssl x509 -req -in late.csr -signkey late.key -days -1 -out late.crt
    key client; by_itself client 127.0.0.1 -addext $here -addext extendedKeyUsage=clientAuth
    key large P-521; by_itself large broker -addext $here

    echo "$here" >server.ext
    echo "extendedKeyUsage=serverAuth" >nameless.ext
    printf "$here\nbasicConstraints=critical,CA:TRUE\n" >authority.ext
    key signed; request signed; by_ca signed ca -extfile server.ext
    key signed521; request signed521; by_ca signed521 ca521 -sha256 -extfile server.ext
    key nameless; request nameless; by_ca nameless ca -extfile nameless.ext
    key first; request first; by_ca first ca
    key authority; request authority; by_ca authority ca -extfile authority.ext
"#;

fn make(dir: &Path) {
    let output = Command::new("bash").args(["-c", MAKE]).current_dir(dir).output();
    let output = output.expect("bash starts");
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "certificates cannot be made: {said}");
    for name in ["old", "first"] {
        let file = dir.join(format!("{name}.crt"));
        let shown = Command::new("openssl")
            .args(["x509", "-noout", "-text", "-in"])
            .arg(file)
            .output();
        let text = shown.unwrap().stdout;
        assert!(String::from_utf8_lossy(&text).contains("Version: 1 "), "{name}");
    }
}

struct Site(TempDir);

impl Site {
    fn new() -> Site {
        let dir = TempDir::new().unwrap();
        make(dir.path());
        Site(dir)
    }

    fn file(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// A broker with the certificate of `name`.
    fn broker(&self, name: &str, more: &str) -> Broker {
        let [certificate, key] = ["crt", "key"].map(|kind| self.file(&format!("{name}.{kind}")).display().to_string());
        Broker::with(&format!(
            "allow_anonymous true\ncertfile {certificate}\nkeyfile {key}\n{more}"
        ))
    }

    /// A gateway that trusts the certificate of `ca`.
    fn gateway(&self, port: u16, ca: &str) -> Gateway {
        let mut options = options(port);
        options.tls = true;
        options.ca = Some(self.file(&format!("{ca}.crt")));
        Gateway::start(options, plant(&["p1"]))
    }

    /// Whether `mosquitto_pub` publishes with these trusted certificates.
    fn others_accept(&self, broker: &Broker, ca: &str) -> bool {
        let ca = self.file(&format!("{ca}.crt")).display().to_string();
        let arguments = ["-q", "1", "-t", "x", "-m", "x", "--cafile", &ca];
        broker.run("mosquitto_pub", &arguments).status.success()
    }
}

#[test]
fn a_certificate_that_is_itself_named_is_accepted() {
    let site = Site::new();
    for (server, more) in [
        ("ordinary", ""),
        ("leaf", ""),
        ("named", ""),
        ("old", ""),
        ("old", "tls_version tlsv1.2\n"),
        ("ordinary", "tls_version tlsv1.2\n"),
    ] {
        let broker = site.broker(server, more);
        assert!(site.others_accept(&broker, server), "{server}");
        let gateway = site.gateway(broker.port, server);
        wait_for("the connection", || gateway.connected().then_some(()));
        gateway.stop();
    }
    let broker = site.broker("signed", "");
    let gateway = site.gateway(broker.port, "ca");
    wait_for("the connection", || gateway.connected().then_some(()));
    gateway.stop();
}

/// Certificate of the broker, trusted certificate, result of `mosquitto_pub`, message of the gateway.
const REFUSED: &str = "\
first     | ca        | accept | X.509 version 1, which has no names and usages; have it reissued as version 3
nameless  | ca        | accept | does not name the host `127.0.0.1` (it has no subjectAltName); have it reissued with subjectAltName = IP:127.0.0.1
authority | ca        | accept | a CA certificate (basicConstraints CA:TRUE)
large     | large     | accept | such as P-521
signed521 | ca521     | accept | has a key of P-521, which the gateway does not support
late      | late      | refuse | its certificate expired on 20
elsewhere | elsewhere | refuse | is for `broker.local`, `10.0.0.5`, not for `127.0.0.1`; connect by a name in it
client    | client    | refuse | is not valid for use by a server; have it reissued with extendedKeyUsage = serverAuth
ordinary  | ca        | refuse | its certificate `broker` is signed by itself, and not among the certificates of mqtt.ca
signed    | leaf      | refuse | its certificate `127.0.0.1` is signed by `works-ca`, which is not among the certificates of mqtt.ca";

#[test]
fn a_refused_certificate_is_told_with_cause_and_remedy() {
    let site = Site::new();
    for [server, ca, others, said] in rows(REFUSED) {
        let broker = site.broker(server, "");
        assert_eq!(site.others_accept(&broker, ca), others == "accept", "{server}");
        let gateway = site.gateway(broker.port, ca);
        wait_log(broker.port, said);
        assert!(!gateway.connected(), "{server}");
        gateway.stop();
    }
    let plain = Broker::start();
    let gateway = site.gateway(plain.port, "ca");
    wait_log(plain.port, "the broker closed the connection during the TLS handshake");
    gateway.stop();
}

/// A server that presents a certificate, but signs with a key that does not belong to it.
#[derive(Debug)]
struct Impostor(Arc<CertifiedKey>);

impl ResolvesServerCert for Impostor {
    fn resolve(&self, _: ClientHello<'_>) -> Option<Arc<CertifiedKey>> {
        Some(self.0.clone())
    }
}

#[test]
fn a_server_without_the_key_of_the_named_certificate_is_refused() {
    let site = Site::new();
    let runtime = Runtime::new().unwrap();
    for server in ["ordinary", "named", "old"] {
        for version in [&TLS12, &TLS13] {
            let key = PrivateKeyDer::from_pem_file(site.file("signed.key")).unwrap();
            let key = ring::sign::any_supported_type(&key).unwrap();
            let shown = CertificateDer::from_pem_file(site.file(&format!("{server}.crt"))).unwrap();
            let impostor = Impostor(Arc::new(CertifiedKey::new(vec![shown], key)));
            let config = ServerConfig::builder_with_provider(Arc::new(ring::default_provider()))
                .with_protocol_versions(&[version])
                .unwrap()
                .with_no_client_auth()
                .with_cert_resolver(Arc::new(impostor));
            let acceptor = TlsAcceptor::from(Arc::new(config));
            let listener = runtime.block_on(tokio::net::TcpListener::bind("127.0.0.1:0")).unwrap();
            let port = listener.local_addr().unwrap().port();
            let serving = runtime.spawn(async move {
                while let Ok((stream, _)) = listener.accept().await {
                    let _ = acceptor.accept(stream).await;
                }
            });
            let gateway = site.gateway(port, server);
            wait_log(port, "was not signed with the key");
            gateway.stop();
            serving.abort();
        }
    }
}
