//! Which hosts the server answers for, and which clients: hosts, tokens, TLS, and their change by a reload.

use std::net::SocketAddr;
use std::path::Path;
use std::process::Command;
use std::time::SystemTime;

use drivegate_http::{Options, Scope, Token, Tokens};
use drivegate_north::tls::ServerIdentity;

use tokio::net::TcpStream;
use tokio::time::timeout;

use super::client::{EventStream, PATIENCE, Reply, get, raw, request};
use super::plant::{self, Server};
use crate::support::process::{Running, free_port, until};
use crate::support::tools::{python, root, run, run_well, tool};

fn local() -> Options {
    Options::listening_on(SocketAddr::from(([127, 0, 0, 1], 0)))
}

async fn of_host(server: &Server, headers: &str) -> Reply {
    raw(
        server.address,
        &format!("GET /api/v1/buses HTTP/1.1\r\n{headers}Connection: close\r\n\r\n"),
    )
    .await
}

#[tokio::test]
async fn requests_for_other_hosts_are_refused() {
    let options = Options {
        hosts: vec!["Gateway.example.com".to_string(), "192.0.2.7".to_string()],
        ..local()
    };
    let server = Server::with(plant::mixed(), options).await;
    let own = String::from_utf8(Command::new("uname").arg("-n").output().unwrap().stdout).unwrap();
    for host in [
        "localhost",
        "LOCALHOST.:80",
        "127.0.0.1:9488",
        "127.0.0.2",
        "[::1]:9488",
        "[::ffff:127.0.0.1]",
        "gateway.EXAMPLE.com:443",
        "gateway.example.com.",
        "192.0.2.7:80",
        own.trim(),
    ] {
        let reply = of_host(&server, &format!("Host: {host}\r\n")).await;
        assert_eq!(reply.status, 200, "{host}: {}", reply.body);
    }
    for host in [
        "evil.example",
        "192.0.2.8",
        "localhost.evil.example",
        "[fe80::1]:80",
        "com",
        "0.0.0.0",
    ] {
        let reply = of_host(&server, &format!("Host: {host}\r\n")).await;
        assert_eq!(reply.status, 421, "{host}: {}", reply.body);
        assert!(reply.json()["error"].as_str().unwrap().contains("`hosts` of [http]"));
        for path in ["/", "/metrics", "/readyz", "/nowhere"] {
            let text = format!("GET {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n");
            assert_eq!(raw(server.address, &text).await.status, 421, "{host} {path}");
        }
    }
    for headers in [
        "",
        "Host:\r\n",
        "Host: \r\n",
        "Host: localhost\r\nHost: localhost\r\n",
        "Host: localhost\r\nhOST: evil.example\r\n",
        "Host: a b\r\n",
        "Host: user@localhost\r\n",
        "Host: localhost:http\r\n",
        "Host: localhost:99999\r\n",
        "Host: [::1\r\n",
        "Host: ::1\r\n",
        "Host: localhost/\r\n",
        "Host: localh\u{F6}st\r\n",
        "Host: localhost,evil\r\n",
    ] {
        let reply = of_host(&server, headers).await;
        assert_eq!(reply.status, 400, "{headers:?}: {}", reply.body);
    }
    // The first line may name the host too, as in a request to a proxy.
    for (target, status) in [("http://localhost/healthz", 200), ("http://evil.example/healthz", 421)] {
        let text = format!("GET {target} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n");
        assert_eq!(raw(server.address, &text).await.status, status, "{target}");
    }
    let old = "GET /healthz HTTP/1.0\r\n\r\n";
    assert_eq!(raw(server.address, old).await.status, 400);
}

/// Tokens of these scopes, and the secrets.
fn tokens<const N: usize>(scopes: [&[Scope]; N]) -> (Tokens, [String; N]) {
    let made = scopes.map(|scopes| scopes.to_vec());
    let mut number = 0;
    let made = made.map(|scopes| {
        number += 1;
        Token::generate(&format!("t{number}"), scopes).unwrap()
    });
    let text: String = made.iter().map(|(token, _)| format!("{token}\n")).collect();
    (Tokens::parse(&text).unwrap(), made.map(|(_, secret)| secret))
}

#[tokio::test]
async fn a_token_opens_what_its_scopes_say() {
    use Scope::{Control, Metrics, Read};
    let (tokens, [reader, scraper, both, commander]) = tokens([&[Read], &[Metrics], &[Read, Metrics], &[Control]]);
    let server = Server::with(
        plant::mixed(),
        Options {
            tokens: Some(tokens),
            ..local()
        },
    )
    .await;
    let with = async |path: &str, token: &str| {
        request(
            server.address,
            "GET",
            path,
            &format!("Authorization: Bearer {token}\r\n"),
        )
        .await
    };
    for path in ["/healthz", "/readyz"] {
        assert_ne!(get(server.address, path).await.status, 401, "{path}");
    }
    let read = [
        "/",
        "/assets/page.js",
        "/api/v1/drives",
        "/api/v1/audit",
        "/api/v1/buses/line1/diagnosis",
        "/api/v1/recordings",
        "/api/v1/recordings/x",
        "/api/v1/events",
        "/api/v1/trace",
        "/nowhere",
    ];
    for path in read.iter().chain(&["/metrics"]) {
        let reply = get(server.address, path).await;
        assert_eq!(reply.status, 401, "{path}");
        assert_eq!(
            reply.header("www-authenticate"),
            Some("Bearer realm=\"drivegate\""),
            "{path}"
        );
        assert!(!reply.body.contains("pump-1"), "{path}: {}", reply.body);
    }
    for (token, on_read, on_metrics) in [
        (&reader, 200, 403),
        (&scraper, 403, 200),
        (&both, 200, 200),
        (&commander, 403, 403),
    ] {
        assert_eq!(with("/api/v1/drives", token).await.status, on_read);
        let reply = with("/metrics", token).await;
        assert_eq!(reply.status, on_metrics);
        if on_metrics == 403 {
            assert!(
                reply
                    .header("www-authenticate")
                    .unwrap()
                    .ends_with("error=\"insufficient_scope\"")
            );
        }
    }
    let upper = reader.to_uppercase();
    for wrong in [&reader[1..], &upper, "", "x", &format!("{reader} {reader}")] {
        let reply = with("/api/v1/drives", wrong).await;
        assert_eq!(reply.status, 401, "{wrong}");
        assert!(!reply.head.contains(reader.as_str()));
    }
    for header in [
        format!("Authorization: Basic {reader}\r\n"),
        format!("Authorization: {reader}\r\n"),
        format!("Authorization: Bearer {reader}\r\nAuthorization: Bearer {reader}\r\n"),
        format!("X-Token: {reader}\r\n"),
    ] {
        assert_eq!(
            request(server.address, "GET", "/api/v1/drives", &header).await.status,
            401,
            "{header}"
        );
    }
    let header = format!("authorization: bearer  {reader}\r\n");
    assert_eq!(
        request(server.address, "GET", "/api/v1/drives", &header).await.status,
        200
    );
    let query = format!("/api/v1/drives?token={reader}");
    assert_eq!(get(server.address, &query).await.status, 401, "a URL ends up in logs");
    // The host is checked first: a page of a stranger learns nothing about tokens.
    let text =
        format!("GET / HTTP/1.1\r\nHost: evil.example\r\nAuthorization: Bearer {reader}\r\nConnection: close\r\n\r\n");
    assert_eq!(raw(server.address, &text).await.status, 421);
}

#[tokio::test]
async fn a_removed_token_ends_its_streams() {
    let (first, [one, two]) = tokens([&[Scope::Read], &[Scope::Read]]);
    let options = |tokens: Tokens| Options {
        tokens: Some(tokens),
        ..local()
    };
    let left = Tokens::parse(&first.list()[1].to_string()).unwrap();
    let mut server = Server::with(plant::mixed(), options(first)).await;
    let header = |secret: &str| format!("Authorization: Bearer {secret}\r\n");
    let stream = EventStream::open(server.address, "/api/v1/trace", &header(&one)).await;
    let mut stream = stream.opened().await;
    server.reload(options(left)).await;
    // The comments that keep the stream alive end together with it.
    let end = timeout(PATIENCE, stream.next()).await.expect("the stream ends");
    assert_eq!(end, None);
    for (secret, status) in [(one, 401), (two, 200)] {
        let reply = request(server.address, "GET", "/api/v1/drives", &header(&secret)).await;
        assert_eq!(reply.status, status);
    }
}

fn certificates(dir: &Path, arguments: &[&str]) {
    let script = root().join("docs/modbus-tls-ca.sh").display().to_string();
    let dir = dir.display().to_string();
    run_well(Path::new("sh"), &[&[script.as_str(), &dir], arguments].concat());
}

fn identity(dir: &Path, name: &str) -> ServerIdentity {
    let [certificate, key] = ["crt", "key"].map(|kind| dir.join(format!("{name}.{kind}")));
    ServerIdentity::load(&certificate, &key, SystemTime::now()).unwrap().0
}

/// curl is a client that has nothing of rustls.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn https_with_a_certificate_that_is_renewed() {
    let dir = tempfile::tempdir().unwrap();
    certificates(dir.path(), &["ca"]);
    certificates(dir.path(), &["server", "first"]);
    certificates(dir.path(), &["server", "second"]);
    let listen = SocketAddr::from(([127, 0, 0, 1], free_port()));
    let options = |name| Options {
        identity: Some(identity(dir.path(), name)),
        max_connections: 8,
        ..Options::listening_on(listen)
    };
    let mut server = Server::with(plant::mixed(), options("first")).await;
    let (ca, port) = (dir.path().join("ca.crt").display().to_string(), server.address.port());
    let url = format!("https://localhost:{port}/api/v1/buses");
    let curl = async |arguments: &[&str]| {
        let arguments: Vec<String> = arguments.iter().map(ToString::to_string).collect();
        let curl = tool("curl");
        tokio::task::spawn_blocking(move || {
            let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
            run(&curl, &[&["-sS", "-v", "--max-time", "60"], &arguments[..]].concat())
        })
        .await
        .unwrap()
    };
    let answered = |output: &std::process::Output| String::from_utf8_lossy(&output.stdout).contains("line1");
    for version in ["--tlsv1.2", "--tlsv1.3"] {
        assert!(answered(&curl(&["--cacert", &ca, version, &url]).await), "{version}");
    }
    assert!(!answered(&curl(&[&url]).await), "an unknown CA");
    let plain = url.replace("https", "http");
    assert!(!answered(&curl(&[&plain]).await), "without TLS");
    let mut silent = Vec::new();
    for _ in 0..20 {
        silent.push(TcpStream::connect(listen).await.unwrap());
    }
    assert!(
        answered(&curl(&["--cacert", &ca, &url]).await),
        "silent handshakes make room"
    );
    server.reload(options("second")).await;
    let second = curl(&["--cacert", &ca, &url]).await;
    assert!(answered(&second));
    assert!(
        String::from_utf8_lossy(&second.stderr).contains("CN=second"),
        "{second:?}"
    );
    server.reload(Options::listening_on(listen)).await;
    assert!(answered(&curl(&[&plain]).await), "TLS is turned off");
    assert!(!answered(&curl(&["--cacert", &ca, &url]).await));
}

/// The daemon with hosts, tokens and TLS, a reload, and the commands that show its state.
#[test]
fn a_gateway_with_tokens_and_tls() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name).display().to_string();
    certificates(dir.path(), &["ca"]);
    certificates(dir.path(), &["server", "gateway"]);
    let drivegate = |arguments: &[&str]| run(Path::new(env!("CARGO_BIN_EXE_drivegate")), arguments);
    let token = |name: &str, scope: &str| {
        let added = drivegate(&["token", "add", "--file", &at("tokens"), "--scope", scope, name]);
        assert!(added.status.success(), "{}", String::from_utf8_lossy(&added.stderr));
        String::from_utf8(added.stdout).unwrap()
    };
    std::fs::write(at("operator.token"), token("operator", "read")).unwrap();
    std::fs::write(at("prometheus.token"), token("prometheus", "metrics")).unwrap();
    let twice = drivegate(&["token", "add", "--file", &at("tokens"), "--scope", "read", "operator"]);
    assert_eq!(twice.status.code(), Some(1));
    let port = free_port();
    let text = format!(
        "[gateway]\nname = \"g\"\nsocket = \"\"\n[[bus]]\nname = \"line1\"\nport = \"nowhere\"\n[http]\n\
         listen = \"127.0.0.1:{port}\"\ntokens_file = \"tokens\"\ncertificate = \"gateway.crt\"\nkey = \"gateway.key\"\n"
    );
    std::fs::write(at("drivegate.toml"), text).unwrap();
    let daemon = Running::drivegate(&["run", "--config", &at("drivegate.toml")]);
    daemon.until_printed("drivegate is running");
    let url = format!("https://localhost:{port}");
    let watch = |more: &[&str]| {
        let output = drivegate(&[&["watch", "--once", "--url", &url], more].concat());
        (
            output.status.success(),
            String::from_utf8([output.stdout, output.stderr].concat()).unwrap(),
        )
    };
    let (ca, operator, prometheus) = (at("ca.crt"), at("operator.token"), at("prometheus.token"));
    let (good, table) = watch(&["--ca", &ca, "--token-file", &operator]);
    assert!(good && table.contains("line1"), "{table}");
    for (more, wanted) in [
        (&["--token-file", &operator][..], "no TLS connection"),
        (&["--ca", &ca], "pass a token with scope `read` with --token-file"),
        (
            &["--ca", &ca, "--token-file", &prometheus],
            "the token lacks the scope `read`",
        ),
        (&["--ca", &ca, "--token-file", &at("none")], "cannot read the token"),
    ] {
        let (good, said) = watch(more);
        assert!(!good && said.contains(wanted), "{wanted}\nis not in\n{said}");
    }
    // Python's http.client: another TLS, another HTTP.
    let script = "import http.client, ssl, sys; ca, port, file = sys.argv[1:]; \
        c = http.client.HTTPSConnection('localhost', int(port), context=ssl.create_default_context(cafile=ca)); \
        c.request('GET', '/metrics', headers={'Authorization': 'Bearer ' + open(file).read().strip()}); \
        r = c.getresponse(); print(r.status, b'drivegate_bus_up' in r.read())";
    let scrape = |file: &str| run_well(&python(), &["-c", script, &ca, &port.to_string(), file]);
    assert_eq!(scrape(&prometheus), "200 True\n");
    assert_eq!(scrape(&operator), "403 False\n");

    // The list of tokens shows no secret.
    let listed = drivegate(&["token", "list", "--file", &at("tokens")]);
    let listed = String::from_utf8(listed.stdout).unwrap();
    assert!(
        listed.contains("operator") && listed.contains("metrics") && !listed.contains("sha256"),
        "{listed}"
    );
    assert!(
        drivegate(&["token", "remove", "--file", &at("tokens"), "prometheus"])
            .status
            .success()
    );
    assert_eq!(
        drivegate(&["token", "remove", "--file", &at("tokens"), "prometheus"])
            .status
            .code(),
        Some(1)
    );
    daemon.signal("HUP");
    until("the token is refused", || {
        (scrape(&prometheus) == "401 False\n").then_some(())
    });
    assert!(watch(&["--ca", &ca, "--token-file", &operator]).0);
}
