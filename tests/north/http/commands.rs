//! Commands over HTTP: which users may give them, their results, and attacks that must fail.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use drivegate_core::order::{Authority, Order, Origin, Outcome, SourceKind};
use drivegate_core::plant::OrderRequest;
use drivegate_core::process_image::{Access, LeaseAction, Supervision};
use drivegate_http::{Options, Scope, Token, Tokens, User, Users};
use drivegate_model::drive::Value;
use drivegate_testkit::{image, monitored};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpSocket, TcpStream};
use tokio::time::timeout;

use super::client::{EventStream, PATIENCE, Reply, get, post, raw, request};
use super::plant::{self, Server};
use crate::north::modbus_tcp::rig::FakeBus;
use crate::support::tools::{run, tool};

const PASSWORD: &str = "correct horse";
const PUMP: &str = "/api/v1/drives/pump-1/commands";
const HEARTBEAT: &str = "/api/v1/drives/pump-1/heartbeat";
const STOP: &str = "{\"run\": false}";
/// Basic authentication of `alice:correct horse`.
const BASIC: &str = "Authorization: Basic YWxpY2U6Y29ycmVjdCBob3JzZQ==\r\n";

/// A server with commands: `pump-1` may be commanded and has a lease, `fan-2` is monitored. A bus acknowledges.
struct Rig {
    server: Server,
    bus: FakeBus,
}

fn users(names: &[&str]) -> Users {
    let lines = names
        .iter()
        .map(|name| User::new(name, PASSWORD).unwrap().to_string() + "\n");
    Users::parse(&lines.collect::<String>()).unwrap()
}

fn options(users: Option<Users>) -> Options {
    Options {
        users,
        ..Options::listening_on(SocketAddr::from(([127, 0, 0, 1], 0)))
    }
}

impl Rig {
    async fn new() -> Rig {
        Rig::with(options(Some(users(&["alice", "bob"])))).await
    }

    async fn with(options: Options) -> Rig {
        let pump = drivegate_core::process_image::DriveSpec {
            access: Access::Control,
            supervision: Some(Supervision {
                timeout: Duration::from_secs(5),
                action: LeaseAction::Stop,
                adopt: false,
            }),
            ..monitored("pump-1", "line1", 1, &plant::nx())
        };
        let drives = vec![image(pump), plant::drive("line1", "fan-2", 2, &plant::nx())];
        for drive in &drives {
            plant::answer(drive, Instant::now(), plant::nx_running);
        }
        let bus = plant::bus("line1", drives);
        plant::open(&bus);
        let fake = FakeBus::start(bus.queue.clone());
        Rig {
            server: Server::with(plant::plant(vec![bus]), options).await,
            bus: fake,
        }
    }

    fn address(&self) -> SocketAddr {
        self.server.address
    }

    /// Headers of a session of that user.
    async fn log_in(&self, user: &str) -> String {
        session_of(&self.try_login(user, PASSWORD, "").await)
    }

    async fn try_login(&self, user: &str, password: &str, headers: &str) -> Reply {
        let body = format!("{{\"user\": \"{user}\", \"password\": \"{password}\"}}");
        let headers = format!("Content-Type: application/json\r\n{headers}");
        post(self.address(), "/api/v1/login", &headers, &body).await
    }

    async fn command(&self, headers: &str, body: &str) -> Reply {
        post(self.address(), PUMP, headers, body).await
    }
}

/// The cookie that a reply sets and whose name begins with `name`.
fn cookie(reply: &Reply, name: &str) -> String {
    let set = |line: &str| {
        let (key, value) = line.split_once(": ")?;
        (key.eq_ignore_ascii_case("set-cookie") && value.starts_with(name)).then(|| value.to_string())
    };
    reply
        .head
        .lines()
        .find_map(set)
        .unwrap_or_else(|| panic!("no {name} in {}", reply.head))
}

fn session_of(login: &Reply) -> String {
    assert_eq!(login.status, 200, "{}", login.body);
    let cookie = cookie(login, "drivegate-pump-house=");
    let cookie = cookie.split(';').next().unwrap();
    let token = login.json()["csrf"].as_str().unwrap().to_string();
    format!("Cookie: {cookie}\r\nX-CSRF-Token: {token}\r\n")
}

#[tokio::test]
async fn without_users_nothing_of_it_is_there() {
    let rig = Rig::with(options(None)).await;
    for path in [
        "/api/v1/session",
        "/api/v1/login",
        PUMP,
        HEARTBEAT,
        "/assets/operate.js",
        "/assets/operate.css",
    ] {
        assert_eq!(get(rig.address(), path).await.status, 404, "{path}");
    }
    for path in ["/api/v1/login", "/api/v1/logout", PUMP, HEARTBEAT, "/"] {
        let reply = post(rig.address(), path, BASIC, STOP).await;
        assert_eq!(
            (reply.status, reply.header("allow")),
            (405, Some("GET, HEAD")),
            "{path}"
        );
        assert_eq!(
            reply.body,
            r#"{"error":"this interface is read-only: use GET or HEAD"}"#
        );
    }
    let page = get(rig.address(), "/").await.body;
    assert!(page.contains("read-only") && !page.contains("operate"), "{page}");
    assert_eq!(rig.bus.orders(), []);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_user_logs_in_commands_and_logs_out() {
    let rig = Rig::new().await;
    let page = get(rig.address(), "/").await.body;
    assert!(
        page.contains("assets/operate.js") && !page.contains("read-only"),
        "{page}"
    );
    assert_eq!(get(rig.address(), "/assets/operate.js").await.status, 200);
    let nobody = get(rig.address(), "/api/v1/session").await.json();
    assert!(nobody["user"].is_null());
    let login = rig.try_login("alice", PASSWORD, "").await;
    let flags = cookie(&login, "drivegate-pump-house=");
    assert!(flags.ends_with("; Path=/; HttpOnly; SameSite=Strict"), "{flags}");
    let alice = session_of(&login);
    let session = request(rig.address(), "GET", "/api/v1/session", &alice).await.json();
    assert_eq!(session["user"], "alice");
    assert!(session["expires_in"].as_u64().unwrap() > 1000);
    let started = rig
        .command(&alice, "{\"id\": 7, \"run\": true, \"speed_reference\": 50}")
        .await;
    assert_eq!(started.status, 200, "{}", started.body);
    let result = started.json();
    assert_eq!(
        (&result["id"], &result["drive"], &result["ok"]),
        (&7.into(), &"pump-1".into(), &true.into())
    );
    assert_eq!(result["result"], "acknowledged", "nothing confirms it on this bus");
    assert_eq!(rig.bus.orders().len(), 1);
    let audit = get(rig.address(), "/api/v1/audit").await.json();
    let record = audit.as_array().unwrap().last().unwrap();
    assert_eq!(
        (&record["source"], &record["client"]),
        (&"http".into(), &"alice 127.0.0.1".into())
    );
    let about = request(rig.address(), "GET", PUMP, &alice).await.json();
    assert_eq!(
        (&about["lease_ms"], &about["commanded_last"]),
        (&5000.into(), &true.into())
    );

    let out = post(rig.address(), "/api/v1/logout", &alice, "").await;
    assert_eq!(out.status, 204);
    assert!(cookie(&out, "drivegate-pump-house=").contains("Max-Age=0"));
    for path in [PUMP, HEARTBEAT] {
        let reply = post(rig.address(), path, &alice, STOP).await;
        assert_eq!(reply.status, 401, "{path}");
        assert_eq!(
            reply.header("www-authenticate"),
            Some("Session realm=\"drivegate\""),
            "no login by the browser"
        );
    }
    assert_eq!(rig.bus.orders(), []);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn results_have_their_status() {
    let rig = Rig::new().await;
    let alice = rig.log_in("alice").await;
    for (path, body, status, code) in [
        (PUMP, "{\"speed_reference\": 500}", 422, "bad_value"),
        (PUMP, "{\"run\": true, \"run\": false}", 422, "bad_value"),
        (PUMP, "run", 422, "bad_value"),
        (PUMP, "{}", 422, "bad_value"),
        (PUMP, "{\"ready\": true}", 422, "not_writable"),
        ("/api/v1/drives/fan-2/commands", STOP, 403, "not_allowed"),
        ("/api/v1/drives/pump-9/commands", STOP, 404, "unknown_drive"),
    ] {
        let reply = post(rig.address(), path, &alice, body).await;
        assert_eq!(reply.status, status, "{path} {body}: {}", reply.body);
        assert_eq!(reply.json()["error"]["code"], code, "{path} {body}");
    }
    assert_eq!(rig.bus.orders(), [], "nothing of it reached the bus");
    for (outcome, status, code) in [
        (Outcome::TimedOut, 504, "timeout"),
        (Outcome::Garbled, 502, "garbled"),
        (Outcome::Offline, 503, "offline"),
        (Outcome::Replaced, 409, "replaced"),
        (Outcome::Expired, 503, "expired"),
    ] {
        rig.bus.answers(move |_| Some(outcome.clone()));
        let reply = rig.command(&alice, STOP).await;
        assert_eq!((reply.status, &reply.json()["result"]), (status, &code.into()));
    }
    let not_served = post(rig.address(), "/api/v1/drives", &alice, STOP).await;
    assert_eq!(
        (not_served.status, not_served.body.as_str()),
        (405, r#"{"error":"this is read-only: use GET or HEAD"}"#)
    );
}

/// curl is an independent client; the body is that of the MQTT set topics.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_program_commands_with_its_password() {
    let rig = Rig::new().await;
    let url = format!("http://{}{PUMP}", rig.address());
    let curl = async |user: &str| {
        let arguments = [
            "-sS",
            "--max-time",
            "120",
            "-u",
            user,
            "-d",
            "{\"run\": false, \"id\": \"a\"}",
            &url,
        ];
        let arguments = arguments.map(str::to_string);
        let ran = tokio::task::spawn_blocking(move || run(&tool("curl"), &arguments.each_ref().map(String::as_str)));
        String::from_utf8(ran.await.unwrap().stdout).unwrap()
    };
    for _ in 0..3 {
        let done = curl("alice:correct horse").await;
        assert!(done.contains("\"ok\":true") && done.contains("\"id\":\"a\""), "{done}");
    }
    assert_eq!(rig.bus.orders().len(), 3, "a stop is always executed");
    assert!(curl("alice:wrong horse").await.contains("wrong user or password"));
    assert!(curl("carol:correct horse").await.contains("wrong user or password"));
    for header in [
        "",
        "Authorization: Bearer x\r\n",
        "Authorization: Basic !\r\n",
        "Authorization: Basic YQ==\r\n",
    ] {
        assert_eq!(rig.command(header, STOP).await.status, 401, "{header}");
    }
    assert_eq!(rig.bus.orders(), []);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn pages_of_others_command_nothing() {
    let rig = Rig::new().await;
    let login = rig.try_login("alice", PASSWORD, "").await;
    let alice = session_of(&login);
    let cookie = alice.lines().next().unwrap();
    let other_token = rig.log_in("bob").await.lines().nth(1).unwrap().to_string();
    for (headers, status) in [
        (format!("{alice}Origin: http://evil.example\r\n"), 403),
        (format!("{alice}Origin: http://localhost.evil.example\r\n"), 403),
        (format!("{alice}Origin: http://localhost:8080\r\n"), 403),
        (format!("{alice}Origin: null\r\n"), 403),
        (
            format!("{alice}Origin: http://localhost\r\nOrigin: http://evil.example\r\n"),
            403,
        ),
        (format!("{alice}Sec-Fetch-Site: cross-site\r\n"), 403),
        (format!("{alice}Sec-Fetch-Site: same-site\r\n"), 403),
        (format!("{cookie}\r\n"), 403),
        (format!("{cookie}\r\nX-CSRF-Token: \r\n"), 403),
        (format!("{cookie}\r\nX-CSRF-Token: {}\r\n", "0".repeat(64)), 403),
        (format!("{cookie}\r\n{other_token}\r\n"), 403),
        (format!("{cookie}; drivegate-pump-house=x\r\n"), 401),
        (format!("{BASIC}Origin: http://evil.example\r\n"), 403),
    ] {
        for path in [PUMP, HEARTBEAT] {
            let reply = post(rig.address(), path, &headers, STOP).await;
            assert_eq!(reply.status, status, "{path} {headers}: {}", reply.body);
        }
    }
    let out = post(rig.address(), "/api/v1/logout", &format!("{cookie}\r\n"), "").await;
    assert_eq!(out.status, 403, "nobody is logged out by a page of others");
    // Content types that a form of another page can send.
    for kind in [
        "text/plain",
        "application/x-www-form-urlencoded",
        "multipart/form-data; boundary=x",
    ] {
        let body = format!("{{\"user\": \"alice\", \"password\": \"{PASSWORD}\"}}");
        let reply = post(
            rig.address(),
            "/api/v1/login",
            &format!("Content-Type: {kind}\r\n"),
            &body,
        )
        .await;
        assert_eq!(reply.status, 400, "{kind}");
    }
    assert_eq!(
        rig.try_login("alice", PASSWORD, "Origin: http://evil.example\r\n")
            .await
            .status,
        403
    );
    // A request with a foreign host name, and a preflight for it: the host is checked before everything else.
    let rebound = format!(
        "POST {PUMP} HTTP/1.1\r\nHost: evil.example\r\nConnection: close\r\n{alice}Content-Length: 14\r\n\r\n{STOP}"
    );
    assert_eq!(raw(rig.address(), &rebound).await.status, 421);
    let preflight = request(rig.address(), "OPTIONS", PUMP, "Origin: http://evil.example\r\n").await;
    assert_eq!(preflight.status, 405);
    assert!(!preflight.head.to_ascii_lowercase().contains("access-control"));
    assert_eq!(rig.bus.orders(), [], "nothing was executed");
    let own = format!("{alice}Origin: http://localhost\r\nSec-Fetch-Site: same-origin\r\n");
    assert_eq!(rig.command(&own, STOP).await.status, 200);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn requests_in_one_segment_keep_their_order() {
    let rig = Rig::new().await;
    let alice = rig.log_in("alice").await;
    let bodies: Vec<String> = (1..=20)
        .map(|i| match i % 5 {
            0 => STOP.to_string(),
            _ => format!("{{\"speed_reference\": {i}}}"),
        })
        .collect();
    let mut text = String::new();
    for (place, body) in bodies.iter().enumerate() {
        let close = if place + 1 == bodies.len() {
            "Connection: close\r\n"
        } else {
            ""
        };
        let length = body.len();
        text +=
            &format!("POST {PUMP} HTTP/1.1\r\nHost: localhost\r\n{close}{alice}Content-Length: {length}\r\n\r\n{body}");
    }
    let mut stream = TcpStream::connect(rig.address()).await.unwrap();
    stream.write_all(text.as_bytes()).await.unwrap();
    let mut replies = String::new();
    timeout(PATIENCE, stream.read_to_string(&mut replies))
        .await
        .unwrap()
        .unwrap();
    assert_eq!(replies.matches("HTTP/1.1 200 OK").count(), bodies.len(), "{replies}");
    let seen: Vec<String> = rig.bus.orders().iter().map(shown).collect();
    let wanted: Vec<String> = bodies
        .iter()
        .map(|body| {
            if body.contains("run") {
                "stop".to_string()
            } else {
                body.trim_matches(['{', '}']).split(": ").nth(1).unwrap().to_string()
            }
        })
        .collect();
    assert_eq!(seen, wanted);
}

/// A stop, or the reference that an order sets.
fn shown(order: &Order) -> String {
    match order {
        Order::Points(points) if points[0].1 == Value::Bool(false) => "stop".to_string(),
        Order::Points(points) => points[0].1.to_string(),
        other => format!("{other:?}"),
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_repeated_command_is_executed_once_and_has_one_result() {
    let rig = Rig::new().await;
    let alice = rig.log_in("alice").await;
    rig.bus.pause(true);
    let body = "{\"id\": \"once\", \"speed_reference\": 40, \"expires_ms\": 60000}";
    let (address, headers) = (rig.address(), alice.clone());
    let twice = tokio::spawn(async move {
        let first = post(address, PUMP, &headers, body);
        let second = post(address, PUMP, &headers, body);
        tokio::join!(first, second)
    });
    // Both requests wait for the one command in the queue; a client that gives up does not affect it.
    let mut gone = TcpStream::connect(rig.address()).await.unwrap();
    let text = format!(
        "POST {PUMP} HTTP/1.1\r\nHost: localhost\r\n{alice}Content-Length: {}\r\n\r\n{body}",
        body.len()
    );
    gone.write_all(text.as_bytes()).await.unwrap();
    drop(gone);
    while rig.bus.waiting() == 0 {
        tokio::task::yield_now().await;
    }
    rig.bus.pause(false);
    let (first, second) = timeout(PATIENCE, twice).await.unwrap().unwrap();
    assert_eq!(
        (first.status, second.status),
        (200, 200),
        "{} {}",
        first.body,
        second.body
    );
    assert_eq!(first.body, second.body);
    assert_eq!(rig.command(&alice, body).await.body, first.body, "later, too");
    assert_eq!(rig.bus.orders().len(), 1);
    // Another user may use an equal id; after a stop, a repetition is not executed.
    let bob = rig.log_in("bob").await;
    assert_eq!(rig.command(&bob, body).await.status, 200);
    assert_eq!(rig.command(&bob, STOP).await.status, 200);
    let outdated = rig.command(&alice, body).await;
    assert_eq!(outdated.status, 403);
    assert!(
        outdated.body.contains("the drive has been stopped since"),
        "{}",
        outdated.body
    );
    assert_eq!(rig.bus.orders().len(), 2);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn only_who_commanded_last_renews_the_lease() {
    let rig = Rig::new().await;
    let (alice, bob) = (rig.log_in("alice").await, rig.log_in("bob").await);
    let again = rig.log_in("alice").await;
    let image = rig.server.image("pump-1");
    let renew = async |headers: &str| {
        let reply = post(rig.address(), HEARTBEAT, headers, "").await;
        (reply.status, image.take_heartbeat().is_some())
    };
    assert_eq!(renew(&alice).await, (409, false), "it commanded nothing");
    assert_eq!(rig.command(&alice, "{\"speed_reference\": 10}").await.status, 200);
    assert_eq!(renew(&alice).await, (204, true));
    assert_eq!(renew(&bob).await, (409, false));
    assert_eq!(renew(&again).await, (409, false), "another login of the same user");
    // A refused command does not change the commander.
    assert_eq!(rig.command(&bob, "{\"speed_reference\": 500}").await.status, 422);
    assert_eq!(renew(&alice).await, (204, true));
    assert_eq!(rig.command(&bob, STOP).await.status, 200);
    assert_eq!(renew(&alice).await, (409, false));
    assert_eq!(renew(&bob).await, (204, true));
    // The lease cannot be renewed after a command of another kind of client, either.
    let drive = rig.server.plant().drive("pump-1").unwrap();
    let run = drive.image.spec.profile.point_index("run").unwrap();
    let order = Order::Points(vec![(run, Value::Bool(false))]);
    let origin = Origin::new(SourceKind::ModbusTcp, "192.0.2.1:1");
    let mut placed = drive.place(OrderRequest::new(order, origin, Authority::Write), Instant::now());
    timeout(PATIENCE, placed.answered()).await.unwrap();
    assert_eq!(renew(&bob).await, (409, false));
    assert_eq!(rig.command(BASIC, STOP).await.status, 200);
    assert_eq!(renew(BASIC).await, (204, true));
    assert_eq!(renew(&alice).await, (409, false));
    let other = post(rig.address(), "/api/v1/drives/fan-2/heartbeat", &alice, "").await;
    assert_eq!(other.status, 409);
    assert_eq!(
        post(rig.address(), "/api/v1/drives/x/heartbeat", &alice, "")
            .await
            .status,
        404
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn guessing_is_slowed_and_locks_nobody_out() {
    let rig = Rig::new().await;
    let login = rig.try_login("alice", PASSWORD, "").await;
    let alice = session_of(&login);
    let known = cookie(&login, "drivegate-pump-house-known=");
    let known = format!("Cookie: {}\r\n", known.split(';').next().unwrap());
    let mut statuses = Vec::new();
    for attempt in 0..40 {
        let user = if attempt % 2 == 0 { "alice" } else { "nobody" };
        let reply = rig.try_login(user, "wrong horse!", "").await;
        if reply.status == 401 {
            assert_eq!(reply.json()["error"], "wrong user or password", "the same for both");
        } else {
            assert!(reply.header("retry-after").is_some());
        }
        statuses.push(reply.status);
    }
    assert!(
        statuses.iter().filter(|status| **status == 401).count() >= 4,
        "{statuses:?}"
    );
    assert!(statuses.contains(&429), "{statuses:?}");
    assert_eq!(rig.command(&alice, STOP).await.status, 200, "who is logged in commands");
    assert_eq!(
        rig.try_login("alice", PASSWORD, &known).await.status,
        200,
        "a known browser gets in"
    );
    assert_eq!(
        rig.try_login("bob", PASSWORD, &known).await.status,
        429,
        "as the user that it is known for"
    );
    assert_eq!(rig.bus.orders().len(), 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_flood_of_logins_holds_up_no_stop() {
    let rig = Rig::new().await;
    let alice = rig.log_in("alice").await;
    let address = rig.address();
    let flood: Vec<_> = (0..1000)
        .map(|i| {
            tokio::spawn(async move {
                let socket = TcpSocket::new_v4().unwrap();
                socket.bind(SocketAddr::from(([127, 0, 1, (i % 50) as u8], 0))).unwrap();
                let Ok(mut stream) = socket.connect(address).await else {
                    return;
                };
                let body = format!("{{\"user\": \"alice\", \"password\": \"guess number {i}\"}}");
                let head = format!(
                    "POST /api/v1/login HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\
                     Content-Type: application/json\r\nContent-Length: {}\r\n\r\n{body}",
                    body.len()
                );
                // The connection may be displaced, so an error is ignored.
                let _ = stream.write_all(head.as_bytes()).await;
                let _ = timeout(PATIENCE, stream.read_to_end(&mut Vec::new())).await;
            })
        })
        .collect();
    for number in 0..30 {
        let reply = rig.command(&alice, STOP).await;
        assert_eq!(reply.status, 200, "stop {number}: {}", reply.body);
    }
    for one in flood {
        one.await.unwrap();
    }
    assert_eq!(rig.bus.orders().len(), 30);
}

/// Streams from the operator's own address, and from another one, use all places.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_gets_in_where_nothing_else_does() {
    let rig = Rig::with(Options {
        max_connections: 8,
        ..options(Some(users(&["alice"])))
    })
    .await;
    let alice = rig.log_in("alice").await;
    let mut streams = Vec::new();
    for _ in 0..4 {
        streams.push(
            EventStream::open(rig.address(), "/api/v1/events", "")
                .await
                .opened()
                .await,
        );
    }
    assert_eq!(
        get(rig.address(), "/api/v1/drives").await.status,
        503,
        "the address is full"
    );
    assert_eq!(rig.command("", STOP).await.status, 401);
    assert_eq!(rig.command(&alice, STOP).await.status, 200);
    assert_eq!(rig.command(BASIC, STOP).await.status, 200);
    assert_eq!(rig.bus.orders().len(), 2);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn long_and_slow_bodies_hold_nobody_up() {
    let rig = Rig::with(Options {
        max_connections: 8,
        ..options(Some(users(&["alice"])))
    })
    .await;
    let alice = rig.log_in("alice").await;
    let long = format!("{{\"speed_reference\": 1, \"pad\": \"{}\"}}", "x".repeat(70_000));
    assert_eq!(rig.command(&alice, &long).await.status, 413);
    let long = format!("{{\"user\": \"{}\", \"password\": \"x\"}}", "x".repeat(5000));
    let refused = post(
        rig.address(),
        "/api/v1/login",
        "Content-Type: application/json\r\n",
        &long,
    )
    .await;
    assert_eq!(refused.status, 413);
    // Bodies of commands and of logins that never end, from one address.
    let mut slow = Vec::new();
    for (path, headers) in [
        (PUMP, alice.as_str()),
        ("/api/v1/login", "Content-Type: application/json\r\n"),
    ]
    .repeat(6)
    {
        let mut stream = TcpStream::connect(rig.address()).await.unwrap();
        let head = format!("POST {path} HTTP/1.1\r\nHost: localhost\r\n{headers}Content-Length: 100\r\n\r\n{{");
        // The older ones are displaced by the younger ones.
        let _ = stream.write_all(head.as_bytes()).await;
        slow.push(stream);
    }
    assert_eq!(rig.command(&alice, STOP).await.status, 200);
    let mut last = slow.pop().unwrap();
    let mut reply = String::new();
    let _ = timeout(PATIENCE, last.read_to_string(&mut reply))
        .await
        .expect("it is ended");
    assert!(reply.is_empty() || reply.starts_with("HTTP/1.1 408"), "{reply}");
    assert_eq!(rig.bus.orders().len(), 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_removed_user_is_out_with_the_reload() {
    let both = users(&["alice", "bob"]);
    let mut rig = Rig::with(options(Some(both.clone()))).await;
    let (alice, bob) = (rig.log_in("alice").await, rig.log_in("bob").await);
    assert_eq!(rig.command(BASIC, STOP).await.status, 200);
    // A reload of other settings ends no session, even if it ends all connections.
    let hosts = vec!["gateway.example".to_string()];
    let changed = Options {
        hosts: hosts.clone(),
        ..options(Some(both.clone()))
    };
    rig.server.reload(changed).await;
    assert_eq!(rig.command(&alice, STOP).await.status, 200);
    let left = Users::parse(&both.list()[1].to_string()).unwrap();
    let with = |users| Options {
        hosts: hosts.clone(),
        ..options(users)
    };
    rig.server.reload(with(Some(left))).await;
    assert_eq!(rig.command(&alice, STOP).await.status, 401);
    assert_eq!(
        rig.command(BASIC, STOP).await.status,
        401,
        "nor is its password remembered"
    );
    assert_eq!(rig.command(&bob, STOP).await.status, 200);
    // A new password ends the sessions, and so does disabling and enabling commands.
    let other = User::new("bob", "battery staple").unwrap().to_string();
    rig.server.reload(with(Some(Users::parse(&other).unwrap()))).await;
    assert_eq!(rig.command(&bob, STOP).await.status, 401);
    let bob = session_of(&rig.try_login("bob", "battery staple", "").await);
    rig.server.reload(with(None)).await;
    assert_eq!(rig.command(&bob, STOP).await.status, 405);
    rig.server.reload(with(Some(Users::parse(&other).unwrap()))).await;
    assert_eq!(rig.command(&bob, STOP).await.status, 401);
    assert_eq!(rig.bus.orders().len(), 3);
}

/// A command that is in progress during a reload is executed and answered.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_reload_in_between_loses_no_command() {
    let all = users(&["alice"]);
    let mut rig = Rig::with(options(Some(all.clone()))).await;
    let alice = rig.log_in("alice").await;
    rig.bus.pause(true);
    let (address, headers) = (rig.address(), alice.clone());
    let under_way = tokio::spawn(async move { post(address, PUMP, &headers, STOP).await });
    while rig.bus.waiting() == 0 {
        tokio::task::yield_now().await;
    }
    rig.server.reload(options(Some(all))).await;
    rig.bus.pause(false);
    assert_eq!(timeout(PATIENCE, under_way).await.unwrap().unwrap().status, 200);
    assert_eq!(rig.command(&alice, STOP).await.status, 200, "and the session goes on");
}

/// A reload that ends the connection leaves it until the command is answered, however long that takes.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_reload_of_hosts_or_of_the_address_loses_no_reply() {
    let all = users(&["alice"]);
    let other_hosts = |options: &mut Options| options.hosts = vec!["gateway.example".to_string()];
    let other_address = |options: &mut Options| options.listen = SocketAddr::from(([127, 0, 0, 2], 0));
    let changes: [fn(&mut Options); 2] = [other_hosts, other_address];
    for change in changes {
        let mut rig = Rig::with(options(Some(all.clone()))).await;
        let alice = rig.log_in("alice").await;
        rig.bus.pause(true);
        let address = rig.address();
        let under_way = tokio::spawn(async move { post(address, PUMP, &alice, STOP).await });
        while rig.bus.waiting() == 0 {
            tokio::task::yield_now().await;
        }
        let mut changed = options(Some(all.clone()));
        change(&mut changed);
        rig.server.reload(changed).await;
        // Longer than a connection without a command is left.
        tokio::time::sleep(Duration::from_secs(1)).await;
        rig.bus.pause(false);
        assert_eq!(timeout(PATIENCE, under_way).await.unwrap().unwrap().status, 200);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn users_read_where_tokens_are_required() {
    let (token, secret) = Token::generate("scraper", vec![Scope::Metrics]).unwrap();
    let rig = Rig::with(Options {
        tokens: Some(Tokens::parse(&token.to_string()).unwrap()),
        ..options(Some(users(&["alice"])))
    })
    .await;
    let page = get(rig.address(), "/").await;
    assert_eq!(page.status, 200);
    assert!(
        page.body.contains("Log in") && !page.body.contains("pump-1"),
        "{}",
        page.body
    );
    assert_eq!(get(rig.address(), "/api/v1/drives").await.status, 401);
    assert_eq!(get(rig.address(), "/assets/page.js").await.status, 200);
    let alice = rig.log_in("alice").await;
    for (path, status) in [("/api/v1/drives", 200), ("/", 200), ("/metrics", 401)] {
        assert_eq!(
            request(rig.address(), "GET", path, &alice).await.status,
            status,
            "{path}"
        );
    }
    assert_eq!(request(rig.address(), "GET", "/api/v1/drives", BASIC).await.status, 200);
    let bearer = format!("Authorization: Bearer {secret}\r\n");
    assert_eq!(
        request(rig.address(), "GET", "/api/v1/drives", &bearer).await.status,
        403
    );
    assert_eq!(rig.command(&bearer, STOP).await.status, 401, "a token commands nothing");
    assert_eq!(rig.command(&alice, STOP).await.status, 200);
}
