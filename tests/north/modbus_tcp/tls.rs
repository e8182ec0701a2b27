//! Modbus/TCP Security: which clients are admitted, which may write, and how the others are refused. The
//! certificates come from the script in the documentation.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, LazyLock};
use std::time::{Duration, Instant, SystemTime};

use drivegate_core::order::SourceKind;
use drivegate_north::modbus_tcp::{Identity, Options, Role, Tls};
use drivegate_north::{ConnectionRefusal, ServerKind};
use rustls::version::{TLS12, TLS13};
use rustls::{ClientConfig, RootCertStore, SupportedProtocolVersion};
use rustls_pki_types::pem::PemObject;
use rustls_pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use tempfile::TempDir;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;

use super::rig::{Client, PATIENCE, Rig, frame, listener, options, registers, until, words};
use crate::support::process::{Running, free_port};
use crate::support::tools;

/// Runs the certificate script.
pub(super) fn make(dir: &Path, arguments: &[&str], days: &str) {
    let script = tools::root().join("docs/modbus-tls-ca.sh");
    let output = Command::new(script)
        .arg(dir)
        .args(arguments)
        .env("DAYS", days)
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

/// Replaces the certificate of a client by one whose role is of the wrong string type.
fn sign_with_printable_role(dir: &Path, name: &str) {
    let command = format!(
        "printf 'extendedKeyUsage=clientAuth\n1.3.6.1.4.1.50316.802.1=ASN1:PRINTABLESTRING:operator\n' >ext &&
         openssl req -new -key {name}.key -subj /CN={name} -out csr &&
         openssl x509 -req -in csr -CA ca.crt -CAkey ca.key -set_serial 7 -days 30 -extfile ext -out {name}.crt"
    );
    let output = Command::new("sh")
        .args(["-ec", &command])
        .current_dir(dir)
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

/// Two CAs; the first has issued certificates for a server and clients of all kinds.
pub(super) struct Works(TempDir, #[expect(dead_code, reason = "holds the pipe")] Child);

pub(super) static WORKS: LazyLock<Works> = LazyLock::new(|| {
    let dir = tempfile::tempdir().unwrap();
    let (own, other) = (dir.path().join("own"), dir.path().join("other"));
    for ca in [&own, &other] {
        make(ca, &["ca"], "30");
        make(ca, &["client", "hmi", "operator"], "30");
    }
    make(&own, &["server", "gateway"], "30");
    make(&own, &["server", "second"], "30");
    make(&own, &["client", "screen", "viewer"], "30");
    make(&own, &["client", "stranger", "cleaner"], "30");
    make(&own, &["client", "plain"], "30");
    make(&own, &["client", "late", "operator"], "-1");
    make(&own, &["client", "malformed", "operator"], "30");
    sign_with_printable_role(&own, "malformed");
    // Static values are never dropped, so a child process removes the folder when this process ends and its pipe closes.
    let mut sweeper = Command::new("sh");
    sweeper.args(["-c", "cat >/dev/null; rm -rf \"$0\""]).arg(dir.path());
    let sweeper = sweeper
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn();
    Works(dir, sweeper.unwrap())
});

impl Works {
    pub(super) fn file(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn identity(&self, server: &str) -> Identity {
        let [certificate, key] = ["crt", "key"].map(|kind| self.file(&format!("own/{server}.{kind}")));
        Identity::load(&certificate, &key, &self.file("own/ca.crt"), None, SystemTime::now())
            .unwrap()
            .0
    }

    fn tls(&self) -> Tls {
        Tls {
            listen: vec![SocketAddr::from(([127, 0, 0, 1], 0))],
            allow: vec!["127.0.0.0/8".parse().unwrap()],
            buses: None,
            identity: self.identity("gateway"),
            roles: BTreeMap::from([
                ("operator".to_string(), Role::Control),
                ("viewer".to_string(), Role::Monitor),
            ]),
        }
    }

    fn chain(&self, name: &str) -> Vec<CertificateDer<'static>> {
        let file = self.file(&format!("{name}.crt"));
        CertificateDer::pem_file_iter(file)
            .unwrap()
            .collect::<Result<_, _>>()
            .unwrap()
    }

    /// A client that presents the certificate `own/NAME`, or none.
    pub(super) fn client(&self, name: Option<&str>, version: &'static SupportedProtocolVersion) -> Arc<ClientConfig> {
        let mut roots = RootCertStore::empty();
        roots.add(self.chain("own/ca").remove(0)).unwrap();
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let builder = ClientConfig::builder_with_provider(provider)
            .with_protocol_versions(&[version])
            .unwrap()
            .with_root_certificates(roots);
        Arc::new(match name {
            None => builder.with_no_client_auth(),
            Some(name) => {
                let key = PrivateKeyDer::from_pem_file(self.file(&format!("{name}.key"))).unwrap();
                builder.with_client_auth_cert(self.chain(name), key).unwrap()
            }
        })
    }
}

pub(super) fn tls_options() -> Options {
    // No client without TLS may write, so a write can only be granted by a role.
    let mut plain = listener();
    plain.write = Vec::new();
    Options {
        listeners: vec![plain],
        tls: Some(WORKS.tls()),
        ..options()
    }
}

pub(super) struct TlsClient(tokio_rustls::client::TlsStream<TcpStream>);

impl TlsClient {
    /// A client after its handshake; with TLS 1.3 its certificate is not proven yet at that time.
    pub(super) async fn connect(address: SocketAddr, config: Arc<ClientConfig>) -> std::io::Result<TlsClient> {
        let stream = TcpStream::connect(address).await?;
        let name = ServerName::try_from("127.0.0.1").unwrap();
        Ok(TlsClient(TlsConnector::from(config).connect(name, stream).await?))
    }

    pub(super) async fn ask(&mut self, unit: u8, pdu: &[u8]) -> std::io::Result<Vec<u8>> {
        let exchange = async {
            self.0.write_all(&frame(7, unit, pdu)).await?;
            let mut header = [0; 7];
            self.0.read_exact(&mut header).await?;
            let mut pdu = vec![0; usize::from(u16::from_be_bytes([header[4], header[5]])) - 1];
            self.0.read_exact(&mut pdu).await?;
            Ok(pdu)
        };
        tokio::time::timeout(PATIENCE, exchange).await.expect("no answer")
    }

    /// Waits until the server closes the connection in order.
    pub(super) async fn is_ended(&mut self) {
        let end = tokio::time::timeout(PATIENCE, self.0.read(&mut [0]))
            .await
            .expect("it stays open");
        assert_eq!(end.expect("a notice of the end"), 0);
    }

    fn server_certificate(&self) -> CertificateDer<'static> {
        self.0.get_ref().1.peer_certificates().unwrap()[0].clone()
    }
}

pub(super) fn refused(rig: &Rig) -> u64 {
    refused_for(rig, ConnectionRefusal::Tls)
}

fn refused_for(rig: &Rig, reason: ConnectionRefusal) -> u64 {
    rig.stats
        .refused
        .of(ServerKind::ModbusTcp)
        .find(|(why, _)| *why == reason)
        .unwrap()
        .1
}

/// Makes the server's clock jump ahead; afterwards the clock continues normally.
async fn later(seconds: f32) {
    tokio::time::pause();
    tokio::time::advance(Duration::from_secs_f32(seconds)).await;
    tokio::time::resume();
}

#[tokio::test]
async fn roles_decide_who_writes() {
    let rig = Rig::with(tls_options()).await;
    let address = rig.server.tls_addresses()[0];
    let write = words(6, &[0x8101, 5000]);
    for version in [&TLS12, &TLS13] {
        for (name, may_write) in [
            ("own/hmi", true),
            ("own/screen", false),
            ("own/stranger", false),
            ("own/plain", false),
        ] {
            let mut client = TlsClient::connect(address, WORKS.client(Some(name), version))
                .await
                .unwrap();
            assert_eq!(
                client.ask(1, &words(3, &[2102, 1])).await.unwrap(),
                registers(3, &[5000]),
                "{name}"
            );
            let answer = client.ask(1, &write).await.unwrap();
            assert_eq!(answer, if may_write { write.clone() } else { vec![0x86, 1] }, "{name}");
        }
    }
    let plant = rig.plant.load_full();
    assert_eq!(
        plant
            .command_log
            .results()
            .get(&(SourceKind::ModbusTcp, "acknowledged")),
        Some(&2)
    );
    plant.report_refusals(Instant::now() + Duration::from_secs(1));
    let reported = plant.events.recent();
    assert_eq!(reported.iter().filter_map(|event| event.count).sum::<u64>(), 6);
    // The event names the certificate and the address.
    assert!(
        reported[0].text.contains("from modbus_tcp screen at 127.0.0.1:"),
        "{}",
        reported[0].text
    );
    // The other listener does not care about certificates.
    let mut plain = rig.client().await;
    assert_eq!(plain.ask(1, &words(3, &[2102, 1])).await, registers(3, &[5000]));
    assert_eq!(refused(&rig), 0);
    rig.end().await;
}

#[tokio::test]
async fn who_is_not_known_is_refused() {
    let rig = Rig::with(tls_options()).await;
    let address = rig.server.tls_addresses()[0];
    let mut count = 0;
    for version in [&TLS12, &TLS13] {
        for name in [
            None,
            Some("own/late"),
            Some("other/hmi"),
            Some("own/gateway"),
            Some("own/malformed"),
        ] {
            let answer = match TlsClient::connect(address, WORKS.client(name, version)).await {
                Ok(mut client) => client.ask(1, &words(3, &[2102, 1])).await,
                Err(why) => Err(why),
            };
            assert!(answer.is_err(), "{name:?} was answered {answer:?}");
            count += 1;
            until("it is counted", || refused(&rig) == count).await;
        }
    }
    // Bytes of Modbus without TLS, other bytes, and none at all.
    for bytes in [
        frame(1, 1, &words(3, &[2102, 1])),
        b"GET / HTTP/1.1\r\n\r\n".to_vec(),
        vec![0x16, 3, 1, 0, 1, 0],
    ] {
        let mut client = Client::connect(address).await;
        client.send(&bytes).await;
        client.stream.shutdown().await.unwrap();
        let mut rest = Vec::new();
        let _ = tokio::time::timeout(PATIENCE, client.stream.read_to_end(&mut rest))
            .await
            .unwrap();
        assert!(rest.first().is_none_or(|alert| *alert == 0x15), "{rest:?}");
        count += 1;
        until("it is counted", || refused(&rig) == count).await;
    }
    // A silent client occupies a place but blocks no other client.
    let silent = Client::connect(address).await;
    let mut client = TlsClient::connect(address, WORKS.client(Some("own/hmi"), &TLS13))
        .await
        .unwrap();
    assert_eq!(
        client.ask(1, &words(3, &[2102, 1])).await.unwrap(),
        registers(3, &[5000])
    );
    assert_eq!(
        rig.stats.modbus_tcp.connections(),
        1,
        "only who is known counts as connected"
    );
    drop(silent);
    rig.end().await;
}

/// The whole handshake may take ten seconds, even while the client keeps sending.
#[tokio::test]
async fn who_never_ends_the_handshake_is_closed() {
    let rig = Rig::with(tls_options()).await;
    let address = rig.server.tls_addresses()[0];
    // The head of a handshake record of 512 bytes, of which only these bytes are ever sent.
    for (round, begun) in [&[][..], &[0x16, 3, 1, 2, 0, 1, 0, 1, 0xFC]].into_iter().enumerate() {
        let round = round as u64;
        let mut slow = Client::connect(address).await;
        for bytes in begun.chunks(3) {
            slow.send(bytes).await;
            later(1.5).await;
        }
        later(7.0 - 1.5 * begun.len().div_ceil(3) as f32).await;
        assert_eq!(refused(&rig), round);
        later(3.1).await;
        assert!(slow.is_closed().await);
        until("it is counted", || refused(&rig) == round + 1).await;
    }
    rig.end().await;
}

/// Handshakes have separate places, and a slow one yields to a newer one: not even from one address can silent
/// clients keep out a client with a certificate.
#[tokio::test]
async fn handshakes_keep_nobody_out() {
    let rig = Rig::with(Options {
        max_connections: 2,
        ..tls_options()
    })
    .await;
    let address = rig.server.tls_addresses()[0];
    let config = WORKS.client(Some("own/hmi"), &TLS13);
    let write = words(6, &[0x8101, 5000]);
    let mut silent = Vec::new();
    for n in 0..200 {
        silent.push(Client::connect(address).await);
        if n % 20 == 0 {
            let mut client = TlsClient::connect(address, config.clone()).await.unwrap();
            assert_eq!(client.ask(1, &write).await.unwrap(), write, "with {n} others");
        }
    }
    assert!(refused_for(&rig, ConnectionRefusal::Displaced) > 100);
    // Readers cannot take the place of clients that may write.
    let reader = || TlsClient::connect(address, WORKS.client(Some("own/screen"), &TLS13));
    let mut readers = [reader().await.unwrap(), reader().await.unwrap()];
    // The server may complete the second handshake only after the first reader has its reply, and then give the
    // second reader the place of the first. When the second was answered or closed, that is decided.
    let mut answered = [0; 2];
    for answered in &mut answered {
        for reader in &mut readers {
            *answered += usize::from(reader.ask(1, &words(3, &[2102, 1])).await.is_ok());
        }
    }
    assert_eq!(answered[1], 1, "one of two places is reserved");
    let mut operator = TlsClient::connect(address, config).await.unwrap();
    assert_eq!(operator.ask(1, &write).await.unwrap(), write);
    rig.end().await;
}

#[tokio::test]
async fn pipelining_and_listeners_are_the_same_with_tls() {
    let mut options = tls_options();
    let tls = options.tls.as_mut().unwrap();
    tls.buses = Some(vec!["line2".to_string()]);
    let rig = Rig::with(options).await;
    let config = WORKS.client(Some("own/hmi"), &TLS13);
    let mut client = TlsClient::connect(rig.server.tls_addresses()[0], config).await.unwrap();
    let batch: Vec<u8> = (0..1000u16).flat_map(|t| frame(t, 4, &words(4, &[5, 1]))).collect();
    client.0.write_all(&batch).await.unwrap();
    for t in 0..1000u16 {
        let mut answer = [0; 11];
        client.0.read_exact(&mut answer).await.unwrap();
        assert_eq!(answer[..2], t.to_be_bytes());
    }
    assert_eq!(client.ask(1, &words(3, &[2102, 1])).await.unwrap(), [0x83, 0x0A]);
    rig.end().await;
}

#[tokio::test]
async fn certificates_are_renewed_under_way() {
    let mut rig = Rig::with(tls_options()).await;
    let address = rig.server.tls_addresses()[0];
    let config = WORKS.client(Some("own/hmi"), &TLS13);
    let mut before = TlsClient::connect(address, config.clone()).await.unwrap();
    let mut renewed = tls_options();
    renewed.tls.as_mut().unwrap().identity = WORKS.identity("second");
    rig.reload(renewed).await.unwrap();
    let mut after = TlsClient::connect(address, config).await.unwrap();
    assert_eq!(before.server_certificate(), WORKS.chain("own/gateway")[0]);
    assert_eq!(after.server_certificate(), WORKS.chain("own/second")[0]);
    for client in [&mut before, &mut after] {
        assert_eq!(
            client.ask(1, &words(3, &[2102, 1])).await.unwrap(),
            registers(3, &[5000])
        );
    }
    rig.end().await;
}

/// openssl sends a request and prints the answer: a TLS client independent of rustls.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn openssl_as_a_client() {
    let rig = Rig::with(tls_options()).await;
    let address = rig.server.tls_addresses()[0];
    for (version, name, answered) in [
        ("-tls1_2", "hmi", true),
        ("-tls1_3", "hmi", true),
        ("-tls1_2", "late", false),
        ("-tls1_1", "hmi", false),
    ] {
        let output = tokio::task::spawn_blocking(move || {
            let mut child = Command::new(tools::tool("openssl"));
            child.args([
                "s_client",
                "-quiet",
                version,
                "-connect",
                &address.to_string(),
                "-verify_return_error",
            ]);
            child.arg("-CAfile").arg(WORKS.file("own/ca.crt"));
            child.arg("-cert").arg(WORKS.file(&format!("own/{name}.crt")));
            child.arg("-key").arg(WORKS.file(&format!("own/{name}.key")));
            let mut child = child
                .stdin(Stdio::piped())
                .stdout(Stdio::piped())
                .stderr(Stdio::null())
                .spawn()
                .unwrap();
            // The input stays open until the answer has arrived, because openssl ends with its input.
            let mut input = child.stdin.take().unwrap();
            let _ = std::io::Write::write_all(&mut input, &frame(9, 1, &words(3, &[2102, 1])));
            let mut answer = vec![0; 11];
            let read = std::io::Read::read_exact(child.stdout.as_mut().unwrap(), &mut answer);
            drop(input);
            let _ = child.kill();
            let _ = child.wait();
            read.map(|()| answer)
        });
        let answer = tokio::time::timeout(PATIENCE, output).await.unwrap().unwrap();
        let wanted = frame(9, 1, &registers(3, &[5000]));
        assert_eq!(answer.ok(), answered.then_some(wanted), "{version} {name}");
    }
    rig.end().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn pymodbus_with_tls() {
    let rig = Rig::with(tls_options()).await;
    let mut command = Command::new(tools::python());
    command.arg(tools::root().join("tests/peers/pymodbus_client.py"));
    command.arg(rig.server.tls_addresses()[0].port().to_string());
    command.args(["own/ca.crt", "own/hmi.crt", "own/hmi.key"].map(|name| WORKS.file(name)));
    let output = tokio::task::spawn_blocking(move || command.output().unwrap())
        .await
        .unwrap();
    let text = [output.stdout, output.stderr].concat();
    assert_eq!(String::from_utf8_lossy(&text).trim(), "ok");
    rig.end().await;
}

/// SIGHUP with new certificates in the same files: connected clients stay, new ones get the new certificate. A
/// broken file changes nothing.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_daemon_takes_new_certificates() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let install = |name: &str| {
        for kind in ["crt", "key"] {
            std::fs::copy(WORKS.file(&format!("own/{name}.{kind}")), at(&format!("server.{kind}"))).unwrap();
        }
    };
    install("gateway");
    std::fs::copy(WORKS.file("own/ca.crt"), at("ca.crt")).unwrap();
    let port = SocketAddr::from(([127, 0, 0, 1], free_port()));
    let text = format!(
        "[gateway]\nname = \"g\"\n[modbus_tcp.tls]\nlisten = [\"{port}\"]\ncertificate = \"server.crt\"\n\
         key = \"server.key\"\nclient_ca = \"ca.crt\"\nroles = {{ operator = \"control\" }}\n[log]\nformat = \"json\"\n"
    );
    let file = at("drivegate.toml");
    std::fs::write(&file, text).unwrap();
    let daemon = Running::drivegate(&["run", "--config", file.to_str().unwrap()]);
    daemon.until_printed("drivegate is running");
    let config = || WORKS.client(Some("own/hmi"), &TLS13);
    let identify = [43, 14, 4, 0];
    let mut before = TlsClient::connect(port, config()).await.unwrap();
    let answer = before.ask(255, &identify).await.unwrap();
    assert_eq!(before.server_certificate(), WORKS.chain("own/gateway")[0]);

    std::fs::write(at("server.key"), "no key").unwrap();
    daemon.signal("HUP");
    daemon.until_printed("keeping the current configuration");
    assert!(
        daemon.output().contains("server.key contains no private key"),
        "{}",
        daemon.output()
    );
    let after = TlsClient::connect(port, config()).await.unwrap();
    assert_eq!(after.server_certificate(), WORKS.chain("own/gateway")[0]);

    install("second");
    daemon.signal("HUP");
    daemon.until_printed("new certificates");
    let mut after = TlsClient::connect(port, config()).await.unwrap();
    assert_eq!(after.server_certificate(), WORKS.chain("own/second")[0]);
    for client in [&mut before, &mut after] {
        assert_eq!(client.ask(255, &identify).await.unwrap(), answer);
    }
}
