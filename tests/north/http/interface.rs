//! Status page, health, readiness and JSON; methods, unknown paths and invalid requests.

use std::io::ErrorKind;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use arc_swap::ArcSwap;
use drivegate_core::process_image::Link;
use drivegate_http::Options;
use drivegate_north::Server as _;
use drivegate_proto::Exception;
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::time::timeout;
use tokio_util::sync::CancellationToken;

use super::client::{get, raw, request};
use super::plant::{self, HOLDING, STALE_AFTER, Server};

const PLACES: [&str; 18] = [
    "/",
    "/assets/style.css",
    "/assets/page.js",
    "/assets/icon.svg",
    "/metrics",
    "/docs/",
    "/docs/http.md",
    "/healthz",
    "/readyz",
    "/api/v1/drives",
    "/api/v1/drives/pump-1",
    "/api/v1/buses",
    "/api/v1/buses/line1/diagnosis",
    "/api/v1/mqtt",
    "/api/v1/audit",
    "/api/v1/recordings",
    "/api/v1/events",
    "/api/v1/trace",
];

#[tokio::test]
async fn health_is_ok() {
    let server = Server::of(plant::mixed()).await;
    let reply = get(server.address, "/healthz").await;
    assert_eq!((reply.status, reply.body.as_str()), (200, "ok\n"));
}

#[tokio::test]
async fn only_get_and_head() {
    let server = Server::of(plant::mixed()).await;
    for place in PLACES.iter().chain(&["/nowhere"]) {
        for method in ["POST", "PUT", "PATCH", "DELETE", "OPTIONS", "TRACE", "BREW"] {
            let reply = request(server.address, method, place, "Content-Length: 0\r\n").await;
            assert_eq!(reply.status, 405, "{method} {place}");
            assert_eq!(reply.header("allow"), Some("GET, HEAD"), "{method} {place}");
        }
    }
}

#[tokio::test]
async fn head_has_no_body() {
    let server = Server::of(plant::mixed()).await;
    for place in PLACES {
        let reply = request(server.address, "HEAD", place, "").await;
        let expected = if place == "/readyz" { 503 } else { 200 };
        assert_eq!((reply.status, reply.body.as_str()), (expected, ""), "{place}");
        assert!(reply.header("content-type").is_some(), "{place}");
    }
}

#[tokio::test]
async fn headers_keep_replies_fresh_and_harmless() {
    let server = Server::of(plant::mixed()).await;
    for place in ["/", "/metrics", "/api/v1/drives", "/assets/page.js", "/nowhere"] {
        let reply = get(server.address, place).await;
        assert_eq!(reply.header("cache-control"), Some("no-store"), "{place}");
        assert_eq!(reply.header("x-content-type-options"), Some("nosniff"), "{place}");
        assert_eq!(reply.header("access-control-allow-origin"), None, "{place}");
    }
    let page = get(server.address, "/").await;
    let policy = page.header("content-security-policy").expect("a policy");
    assert!(
        policy.starts_with("default-src 'none'; script-src 'self';") && !policy.contains("unsafe"),
        "{policy}"
    );
}

#[tokio::test]
async fn unknown_places_are_told() {
    let server = Server::of(plant::mixed()).await;
    for place in ["/nowhere", "/metrics/", "/assets/../metrics", "/assets/x"] {
        assert_eq!(get(server.address, place).await.status, 404, "{place}");
    }
    let reply = get(server.address, "/api/v1/nothing").await;
    assert_eq!(reply.status, 404);
    assert_eq!(reply.json(), json!({"error": "there is nothing at /api/v1/nothing"}));
    for place in ["/api/v1/drives/saw", "/api/v1/drives/%2e%2e", "/api/v1/drives/%00"] {
        let reply = get(server.address, place).await;
        assert_eq!(reply.status, 404, "{place}");
        assert_eq!(reply.json()["known"], json!(["pump-1", "fan-2", "mixer-3", "saw-4"]));
    }
    let reply = get(server.address, "/api/v1/drives/%ff").await;
    assert_eq!(reply.status, 400, "no text at all");
}

#[tokio::test]
async fn ready_once_all_buses_are_open_and_all_drives_were_tried() {
    let nx = plant::nx();
    let drives = vec![
        plant::drive("line1", "pump-1", 1, &nx),
        plant::drive("line1", "fan-2", 2, &nx),
    ];
    let bus = plant::bus("line1", drives.clone());
    let server = Server::of(plant::plant(vec![bus.clone()])).await;
    let unready = async || {
        let reply = get(server.address, "/readyz").await;
        assert_eq!(reply.status, 503);
        reply.body
    };
    assert_eq!(
        unready().await,
        "not ready\nbus line1: its port has not been opened yet\n\
         drive pump-1 on bus line1: not polled yet\ndrive fan-2 on bus line1: not polled yet\n"
    );
    bus.image
        .update_health(|health| health.reason = Some("cannot open /dev/x".to_string()));
    assert!(unready().await.contains("bus line1: cannot open /dev/x\n"));
    plant::open(&bus);
    plant::answer(&drives[0], Instant::now(), plant::nx_running);
    assert_eq!(unready().await, "not ready\ndrive fan-2 on bus line1: not polled yet\n");
    plant::silence(&drives[1]);
    let reply = get(server.address, "/readyz").await;
    assert_eq!(
        (reply.status, reply.body.as_str()),
        (200, "ready\n"),
        "a drive that does not answer was tried"
    );
    bus.image.update_health(|health| health.up = false);
    assert!(unready().await.contains("bus line1"));
}

/// The reply without figures that depend on the time of day.
fn timeless(mut reply: Value) -> Value {
    for key in ["since", "age_ms", "time"] {
        if let Some(object) = reply
            .as_object_mut()
            .filter(|o| o.get(key).is_some_and(|v| !v.is_null()))
        {
            object.insert(key.to_string(), json!("…"));
        }
    }
    reply
}

#[tokio::test]
async fn a_good_drive() {
    let server = Server::of(plant::mixed()).await;
    let mut reply = get(server.address, "/api/v1/drives/pump-1").await.json();
    let points = reply.as_object_mut().unwrap().remove("points").unwrap();
    assert_eq!(
        timeless(reply),
        json!({
            "name": "pump-1", "bus": "line1", "address": 1, "unit": 1, "profile": "vacon-nx", "access": "monitor",
            "state": "running", "quality": "good", "online": true, "since": "…", "age_ms": "…", "fault_text": "", "blocked_by": [], "why": [],
            "refreshing": false, "turnaround_ms": 1.9, "transactions": {"ok": 1, "exception": 0, "timeout": 0, "corrupt": 0},
            "starts": 0, "running_seconds": 0.0, "energy_kwh": null,
        })
    );
    let names: Vec<&String> = points.as_object().unwrap().keys().collect();
    assert_eq!(
        names.len(),
        drivegate_core::process_image::public_points(&plant::nx()).len()
    );
    assert!(
        !names.contains(&&"process_data_in_1".to_string()),
        "what is never read is left out"
    );
    for (name, value, unit) in [
        ("output_frequency", json!(25.0), "Hz"),
        ("motor_current", json!(4.2), "A"),
        ("running", json!(true), ""),
        ("fault_code", json!(0), ""),
        ("frequency_reference", json!(25.0), "Hz"),
        ("heatsink_temperature", json!(41.0), "°C"),
        ("motor_temperature", json!(37.0), "%"),
    ] {
        let expected = json!({"value": value, "quality": "good", "unit": unit, "age_ms": "…", "time": "…"});
        assert_eq!(timeless(points[name].clone()), expected, "{name}");
    }
    let read = &points["output_frequency"];
    assert!(read["age_ms"].as_u64().unwrap() < STALE_AFTER.as_millis() as u64);
    let time = humantime::parse_rfc3339(read["time"].as_str().unwrap()).expect("RFC 3339");
    assert!(time.elapsed().unwrap() < STALE_AFTER);
}

#[tokio::test]
async fn values_that_are_not_good_say_so() {
    let server = Server::of(plant::mixed()).await;
    let stale = get(server.address, "/api/v1/drives/fan-2").await.json();
    assert_eq!(
        (&stale["state"], &stale["quality"]),
        (&json!("offline"), &json!("stale"))
    );
    assert_eq!(stale["points"]["output_frequency"]["quality"], json!("stale"));
    assert_eq!(stale["points"]["output_frequency"]["value"], json!(25.0));

    let never = get(server.address, "/api/v1/drives/mixer-3").await.json();
    assert_eq!((&never["state"], &never["quality"]), (&json!("offline"), &json!("bad")));
    assert_eq!((&never["age_ms"], never.get("since")), (&Value::Null, None));
    let nothing = json!({"value": null, "quality": "bad", "unit": "Hz", "age_ms": null, "time": null});
    assert_eq!(never["points"]["output_frequency"], nothing);

    let image = server.image("pump-1");
    image.update(|snapshot| snapshot.refuse(HOLDING, 2103, 1, Exception::ADDRESS));
    let refused = get(server.address, "/api/v1/drives/pump-1").await.json();
    assert_eq!(
        refused["points"]["output_frequency"], nothing,
        "the last value is not shown"
    );
    assert_eq!(refused["points"]["motor_speed"]["quality"], json!("good"));

    plant::answer(&image, Instant::now() - 2 * STALE_AFTER, plant::nx_running);
    let old = get(server.address, "/api/v1/drives/pump-1").await.json();
    assert_eq!(
        (&old["state"], &old["quality"], &old["online"]),
        (&json!("offline"), &json!("stale"), &json!(true))
    );

    let fault = get(server.address, "/api/v1/drives/saw-4").await.json();
    assert_eq!(
        (&fault["state"], &fault["fault_text"]),
        (&json!("fault"), &json!("saturation trip"))
    );
    assert_eq!(fault["points"]["fault_code"]["value"], json!(7));
    assert_eq!(
        (&fault["blocked_by"][0], &fault["why"][0]["cause"]),
        (&json!("fault"), &json!("fault"))
    );
    assert_eq!(
        fault["why"][0]["evidence"],
        json!("fault 7: saturation trip, text not verified")
    );
    assert_eq!(never["blocked_by"], json!(["offline"]));
}

#[tokio::test]
async fn a_state_that_is_not_known_is_no_state() {
    let server = Server::of(plant::plant(vec![plant::bus("line1", vec![plant::secretive()])])).await;
    let drive = get(server.address, "/api/v1/drives/fan-1").await.json();
    assert_eq!(
        (&drive["state"], &drive["quality"], &drive["online"]),
        (&Value::Null, &json!("bad"), &json!(true))
    );
    assert_eq!(drive["points"]["ready"]["value"], json!(true));
    let page = get(server.address, "/").await.body;
    assert!(page.contains("<td>fan-1<td>unknown<td>"), "{page}");
    assert!(page.contains("<td>bad, "), "{page}");
}

#[tokio::test]
async fn the_list_of_drives_is_in_the_order_of_the_file() {
    let server = Server::of(plant::mixed()).await;
    let list = get(server.address, "/api/v1/drives").await.json();
    let names: Vec<&str> = list
        .as_array()
        .unwrap()
        .iter()
        .map(|d| d["name"].as_str().unwrap())
        .collect();
    assert_eq!(names, ["pump-1", "fan-2", "mixer-3", "saw-4"]);
    assert_eq!(list[3]["bus"], json!("line2"));
    assert_eq!(list[3]["points"]["fault"]["value"], json!(true));
}

#[tokio::test]
async fn buses() {
    let server = Server::of(plant::mixed()).await;
    let bus = &server.plant().buses[1];
    bus.image.update_health(|health| {
        health.up = false;
        health.reason = Some("the adapter is gone".to_string());
    });
    let list = get(server.address, "/api/v1/buses").await.json();
    let class = |aim: f64, cycle: f64, rounds: u64| json!({"aim_ms": aim, "cycle_ms": cycle, "rounds": rounds});
    assert_eq!(
        timeless(list[0].clone()),
        json!({
            "name": "line1", "port": "/dev/ttyUSB-line1", "protocol": "modbus-rtu", "baud": 38400, "format": "8N1",
            "state": "up", "tried": true, "since": "…", "drives": 3, "online": 1, "load_ratio": 0.4375,
            "fast": class(10.0, 12.5, 800), "slow": class(1000.0, 1000.0, 10), "transactions": 3, "errors": 1,
            "outcomes": {"ok": 2, "exception": 0, "timeout": 1, "corrupt": 0}, "foreign_frames": 0, "opened": 1, "reconnects": 0,
            "queue_depth": 0,
        })
    );
    assert_eq!(
        (&list[1]["state"], &list[1]["reason"]),
        (&json!("down"), &json!("the adapter is gone"))
    );
}

#[tokio::test]
async fn what_is_wrong_with_a_line() {
    let server = Server::of(plant::mixed()).await;
    let of = async |bus: &str| get(server.address, &format!("/api/v1/buses/{bus}/diagnosis")).await;
    let before = of("line1").await.json();
    assert_eq!(
        before,
        json!({"bus": "line1", "time": null, "verdicts": [], "wrong_address": 0, "drives": []})
    );
    plant::diagnose(&server.plant().buses[0]);
    let told = of("line1").await.json();
    assert_eq!(told["time"], json!("1970-01-01T00:00:00.000Z"));
    let verdict = &told["verdicts"][0];
    for (field, value) in [
        ("verdict", "one_drive"),
        ("drive", "pump-1"),
        ("certainty", "likely"),
        ("evidence", "7 of 90 exchanges failed"),
        ("since", "2026-03-02T06:11:09.480Z"),
    ] {
        assert_eq!(verdict[field], json!(value));
    }
    assert_eq!(told["drives"].as_array().unwrap().len(), 3);
    let unknown = of("line9").await;
    assert_eq!(unknown.status, 404);
    assert_eq!(
        unknown.json(),
        json!({"error": "there is no bus `line9`", "known": ["line1", "line2"]})
    );
}

#[tokio::test]
async fn the_figures_of_mqtt_are_served_without_a_client() {
    let server = Server::of(plant::mixed()).await;
    let reply = get(server.address, "/api/v1/mqtt").await.json();
    assert_eq!(reply, json!({"links": [], "waiting": 2, "published": 17, "lost": 0}));
}

/// The foot of the page links the documentation, which comes from the program itself.
#[tokio::test]
async fn the_documentation_is_one_link_away() {
    let server = Server::of(plant::mixed()).await;
    let page = get(server.address, "/").await.body;
    assert!(page.contains("<a href=\"docs/\""), "{page}");
    let list = get(server.address, "/docs/").await;
    assert_eq!(list.status, 200);
    let names: Vec<&str> = list
        .body
        .split("href=\"")
        .skip(1)
        .filter_map(|rest| rest.split('"').next())
        .collect();
    assert!(names.len() > 20, "{}", list.body);
    for name in names {
        let document = get(server.address, &format!("/docs/{name}")).await;
        assert_eq!(
            document.header("content-type"),
            Some("text/plain; charset=utf-8"),
            "{name}"
        );
        assert!(document.status == 200 && document.body.starts_with("# "), "{name}");
    }
    assert_eq!(get(server.address, "/docs/nowhere.md").await.status, 404);
}

#[tokio::test]
async fn a_reload_shows_at_once() {
    let server = Server::of(plant::mixed()).await;
    let bus = plant::bus("hall", vec![plant::drive("hall", "press", 9, &plant::nx())]);
    server.shared.store(Arc::new(plant::plant(vec![bus])));
    let list = get(server.address, "/api/v1/drives").await.json();
    assert_eq!((list.as_array().unwrap().len(), &list[0]["name"]), (1, &json!("press")));
    assert_eq!(get(server.address, "/api/v1/drives/pump-1").await.status, 404);
}

#[tokio::test]
async fn an_empty_plant_is_served() {
    let server = Server::of(plant::plant(Vec::new())).await;
    assert_eq!(get(server.address, "/readyz").await.status, 200);
    assert_eq!(get(server.address, "/api/v1/drives").await.json(), json!([]));
    assert_eq!(get(server.address, "/").await.status, 200);
    assert_eq!(get(server.address, "/metrics").await.status, 200);
}

#[tokio::test]
async fn the_page_without_scripts_has_tables() {
    let server = Server::of(plant::mixed()).await;
    let bus = &server.plant().buses[1];
    bus.image.update_health(|health| {
        health.up = false;
        health.reason = Some("<b>\"gone\"</b>".to_string());
    });
    let page = get(server.address, "/").await;
    assert_eq!(page.header("content-type"), Some("text/html; charset=utf-8"));
    for wanted in [
        "<title>pump-house · drivegate</title>",
        "<td>pump-1<td>running<td>50 %<td>25 Hz<td>4.2 A<td>31.8 %<td>good, ",
        "<td>fan-2<td>offline<td><s>50 %</s> stale<td><s>25 Hz</s> stale",
        "<td>mixer-3<td>offline<td>–<td>–<td>–<td>–<td>never read",
        "<td>saw-4<td>fault: saturation trip",
        "<td>line1<td>up<td>1 of 3 online<td>44 %",
        "<td>line2<td>down: &lt;b&gt;&quot;gone&quot;&lt;/b&gt;",
    ] {
        assert!(page.body.contains(wanted), "{wanted}\nis missing in\n{}", page.body);
    }
    assert!(!page.body.contains("{{"), "{}", page.body);
    for (place, kind) in [
        ("/assets/style.css", "text/css"),
        ("/assets/page.js", "text/javascript"),
        ("/assets/overview.js", "text/javascript"),
        ("/assets/icon.svg", "image/svg+xml"),
    ] {
        let reply = get(server.address, place).await;
        assert!(
            reply.status == 200 && reply.header("content-type").unwrap().starts_with(kind),
            "{place}"
        );
    }
}

#[tokio::test]
async fn bad_requests_harm_nobody() {
    let server = Server::of(plant::mixed()).await;
    assert_eq!(raw(server.address, "rubbish\r\n\r\n").await.status, 400);
    assert_eq!(raw(server.address, "GET / HTTP/9.9\r\n\r\n").await.status, 400);
    let long = "x".repeat(64 * 1024);
    assert!([400, 414, 431].contains(&raw(server.address, &format!("GET /{long}")).await.status));
    assert_eq!(
        raw(server.address, &format!("GET / HTTP/1.1\r\nX: {long}"))
            .await
            .status,
        431
    );
    let many: String = (0..1000).map(|i| format!("h{i}: x\r\n")).collect();
    assert_eq!(request(server.address, "GET", "/", &many).await.status, 431);
    // A request that never ends, and a body that never arrives.
    let mut half = TcpStream::connect(server.address).await.unwrap();
    half.write_all(b"GET /healthz HT").await.unwrap();
    let body = "GET /healthz HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\nContent-Length: 1000000\r\n\r\n";
    assert_eq!(raw(server.address, body).await.status, 200);
    assert_eq!(get(server.address, "/healthz").await.status, 200);
}

/// The paused clock of the runtime advances at once while no other work is to be done.
#[tokio::test(start_paused = true)]
async fn a_client_that_does_not_finish_its_request_loses_its_place() {
    let server = Server::of(plant::mixed()).await;
    let whole = "GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n";
    for sent in ["", "GET /healthz HTTP/1.1\r\nHost:", whole] {
        let begun = tokio::time::Instant::now();
        let mut stream = TcpStream::connect(server.address).await.unwrap();
        stream.write_all(sent.as_bytes()).await.unwrap();
        let mut reply = Vec::new();
        stream.read_to_end(&mut reply).await.unwrap();
        assert_eq!(reply.starts_with(b"HTTP/1.1 200"), sent == whole, "{sent}");
        let waited = begun.elapsed().as_secs();
        assert!((29..=31).contains(&waited), "{sent}: {waited} s");
    }
}

#[tokio::test]
async fn pipelined_requests_keep_their_order() {
    let server = Server::of(plant::mixed()).await;
    let two = "GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\nGET /nowhere HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n";
    let reply = raw(server.address, two).await;
    assert_eq!(reply.status, 200);
    assert!(reply.body.starts_with("ok\nHTTP/1.1 404"), "{}", reply.body);
}

#[tokio::test]
async fn an_address_in_use_is_told() {
    let server = Server::of(plant::mixed()).await;
    let shared = Arc::new(ArcSwap::from_pointee(plant::mixed()));
    let options = Options::listening_on(server.address);
    let error = drivegate_http::Http::start(options, shared, plant::stats(), CancellationToken::new())
        .await
        .unwrap_err();
    let text = error.to_string();
    assert!(
        text.contains(&format!("HTTP on {}: Address already in use", server.address)) && text.ends_with("of [http]"),
        "{text}"
    );
}

#[tokio::test]
async fn it_stops_whatever_clients_do() {
    let server = Server::of(plant::mixed()).await;
    let idle = TcpStream::connect(server.address).await.unwrap();
    let mut half = TcpStream::connect(server.address).await.unwrap();
    half.write_all(b"GET /api/v1/dri").await.unwrap();
    let mut stream = super::client::EventStream::open(server.address, "/api/v1/events", "")
        .await
        .opened()
        .await;
    let trace = super::client::EventStream::open(server.address, "/api/v1/trace?bus=line1", "")
        .await
        .opened()
        .await;
    let address: SocketAddr = server.address;
    server.cancel.cancel();
    // A silent client would keep its place for 30 s.
    timeout(Duration::from_secs(20), server.http.stopped())
        .await
        .expect("nobody is waited for");
    assert_eq!(stream.next().await, None, "the stream has ended");
    assert_eq!(
        TcpStream::connect(address).await.unwrap_err().kind(),
        ErrorKind::ConnectionRefused
    );
    drop((idle, half, trace));
}

#[tokio::test]
async fn a_drive_comes_back() {
    let server = Server::of(plant::mixed()).await;
    let image = server.image("fan-2");
    assert!(matches!(image.snapshot().link, Link::Offline(_)));
    plant::answer(&image, Instant::now(), plant::nx_running);
    let drive = get(server.address, "/api/v1/drives/fan-2").await.json();
    assert_eq!(
        (&drive["state"], &drive["quality"]),
        (&json!("running"), &json!("good"))
    );
}
