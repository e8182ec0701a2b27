//! Features for cloud brokers and for plants with restricted access: WebSocket, a proxy, a token that another
//! program renews, a limit of messages.

use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use drivegate_mqtt::Password;

use super::bench::*;

#[test]
fn a_broker_behind_websocket_has_values_and_commands() {
    let web = free_port();
    let broker = Broker::with(&format!(
        "allow_anonymous true\nlistener {web} 127.0.0.1\nprotocol websockets\nallow_anonymous true\n"
    ));
    let mut options = options(web);
    options.brokers[0].path = Some("/mqtt".to_string());
    let watcher = Watcher::new(&broker, "drivegate/#");
    let _gateway = Gateway::start(options, plant(&["p1"]));
    watcher.wait("online over WebSocket", |seen| {
        seen.topic == "drivegate/hall/status" && seen.payload == "online"
    });
    watcher.wait("a value", |seen| seen.topic.ends_with("/point/actual_speed"));
    let topic = "drivegate/hall/drive/p1/set";
    broker.publish(topic, "{\"id\": 7, \"run\": false}", &[]);
    watcher.wait("the result", |seen| {
        seen.topic.ends_with("/result") && seen.json()["id"] == 7
    });
}

/// An HTTP proxy that only knows CONNECT, and the requests that it received.
fn proxy() -> (u16, Arc<Mutex<Vec<String>>>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    let asked: Arc<Mutex<Vec<String>>> = Arc::default();
    let seen = asked.clone();
    std::thread::spawn(move || {
        for client in listener.incoming().map_while(Result::ok) {
            let seen = seen.clone();
            std::thread::spawn(move || serve_connect(client, &seen));
        }
    });
    (port, asked)
}

fn serve_connect(mut client: TcpStream, asked: &Mutex<Vec<String>>) {
    let mut head = Vec::new();
    let mut byte = [0];
    while !head.ends_with(b"\r\n\r\n") && client.read(&mut byte).is_ok_and(|count| count == 1) {
        head.extend(byte);
    }
    let head = String::from_utf8_lossy(&head).into_owned();
    let target = head.split_whitespace().nth(1).unwrap_or_default().to_string();
    asked.lock().unwrap().push(target.clone());
    // The name can only be resolved by the proxy.
    let Ok(mut server) = TcpStream::connect(target.replace("broker.plant.invalid", "127.0.0.1")) else {
        return;
    };
    client
        .write_all(b"HTTP/1.1 200 Connection established\r\n\r\n")
        .unwrap();
    let (mut up, mut down) = (client.try_clone().unwrap(), server.try_clone().unwrap());
    let upward = std::thread::spawn(move || {
        let _ = std::io::copy(&mut up, &mut server);
        let _ = server.shutdown(Shutdown::Both);
    });
    let _ = std::io::copy(&mut down, &mut client);
    let _ = client.shutdown(Shutdown::Both);
    upward.join().unwrap();
}

#[test]
fn behind_a_proxy_the_proxy_alone_resolves_the_broker() {
    let broker = Broker::start();
    let (port, asked) = proxy();
    let mut options = options(broker.port);
    options.brokers[0].host = "broker.plant.invalid".to_string();
    options.proxy = Some(("127.0.0.1".to_string(), port));
    let watcher = Watcher::new(&broker, "drivegate/#");
    let _gateway = Gateway::start(options, plant(&["p1"]));
    watcher.wait("online through the proxy", |seen| {
        seen.topic == "drivegate/hall/status" && seen.payload == "online"
    });
    let asked = asked.lock().unwrap().clone();
    assert_eq!(asked, [format!("broker.plant.invalid:{}", broker.port)]);
}

#[test]
fn no_second_has_more_messages_than_the_limit_and_none_of_qos_1_is_lost() {
    let broker = Broker::start();
    let watcher = Watcher::new(&broker, "drivegate/#");
    let mut options = options(broker.port);
    options.publish_limit = 20;
    let _gateway = Gateway::start(options, plant(&["p1"]));
    watcher.wait("online", |seen| {
        seen.topic == "drivegate/hall/status" && seen.payload == "online"
    });
    let topic = "drivegate/hall/drive/p1/set";
    let orders: Vec<String> = (0..40)
        .map(|id| format!("{{\"id\": {id}, \"speed_reference\": {id}}}"))
        .collect();
    let orders: Vec<&str> = orders.iter().map(String::as_str).collect();
    let before = watcher.all().len();
    let began = std::time::Instant::now();
    broker.publish_all(topic, &orders);
    wait_for("a result of each", || {
        let all = watcher.all();
        let results = all.iter().filter(|seen| seen.topic.ends_with("/result")).count();
        (results >= 40).then_some(())
    });
    let own = |seen: &&Seen| !seen.topic.ends_with("/set");
    let count = watcher.all()[before..].iter().filter(own).count();
    let took = began.elapsed();
    let most = 20 * (took.as_secs() as usize + 2);
    assert!(count <= most, "{count} messages in {took:?}");
    assert!(took >= Duration::from_secs(1), "{took:?}");
}

/// Sets this password for the user `hall`.
fn users(broker: &Broker, password: &str) {
    let file = broker.dir.path().join("users");
    let mut command = std::process::Command::new("mosquitto_passwd");
    command.args(["-b", "-c", file.to_str().unwrap(), "hall", password]);
    assert!(command.status().unwrap().success());
}

#[test]
fn a_token_that_was_renewed_is_used_at_the_next_connection() {
    let mut broker = Broker::prepared(tempfile::TempDir::new().unwrap(), "password_file {dir}/users\n");
    users(&broker, "first");
    let token = broker.dir.path().join("token");
    std::fs::write(&token, "first\n").unwrap();
    let mut options = options(broker.port);
    options.username = Some("hall".to_string());
    options.password = Some(Password::File(token.clone()));
    let login = |password: &'static str| ["-u", "hall", "-P", password];
    broker.up();
    let _gateway = Gateway::start(options, plant(&["p1"]));
    let online = |broker: &Broker, password: &'static str| {
        let arguments = [
            &["-t", "drivegate/hall/status", "-W", "1", "-C", "1"][..],
            &login(password),
        ]
        .concat();
        wait_for("online", || {
            let output = broker.run("mosquitto_sub", &arguments);
            (output.stdout == b"online\n").then_some(())
        });
    };
    online(&broker, "first");
    // The token ends with the connections that used it; another program has renewed it meanwhile.
    broker.kill();
    users(&broker, "second");
    broker.up();
    std::thread::sleep(Duration::from_millis(500));
    std::fs::write(&token, "second\n").unwrap();
    online(&broker, "second");
}

/// One packet of a client: its first byte and its body; `None` at the end of the connection.
fn packet(client: &mut TcpStream) -> Option<(u8, Vec<u8>, Vec<u8>)> {
    let mut raw = vec![0];
    client.read_exact(&mut raw).ok()?;
    let (mut length, mut shift) = (0, 0);
    loop {
        let mut byte = [0];
        client.read_exact(&mut byte).ok()?;
        raw.push(byte[0]);
        length |= usize::from(byte[0] & 0x7F) << shift;
        shift += 7;
        if byte[0] & 0x80 == 0 {
            break;
        }
    }
    let mut body = vec![0; length];
    client.read_exact(&mut body).ok()?;
    raw.extend(&body);
    Some((raw[0], body, raw))
}

/// The violated limit of AWS IoT Core, or `None`: a retained message, a topic with more than seven slashes, a ninth filter.
fn beyond_limits(first: u8, body: &[u8]) -> Option<String> {
    let text = |at: usize| -> Option<(String, usize)> {
        let length = usize::from(u16::from_be_bytes([*body.get(at)?, *body.get(at + 1)?]));
        let bytes = body.get(at + 2..at + 2 + length)?;
        Some((String::from_utf8_lossy(bytes).into_owned(), at + 2 + length))
    };
    let slashes = |topic: &str| topic.matches('/').count() > 7;
    match first >> 4 {
        3 if first & 1 == 1 => Some(format!("retained: {}", text(0)?.0)),
        3 if slashes(&text(0)?.0) => Some(format!("slashes: {}", text(0)?.0)),
        8 => {
            // The properties of the gateway's subscriptions are shorter than 128 bytes.
            let mut at = 3 + usize::from(*body.get(2)?);
            let mut filters = Vec::new();
            while let Some((filter, end)) = text(at) {
                filters.push(filter);
                at = end + 1;
            }
            let bad = filters.len() > 8 || filters.iter().any(|filter| slashes(filter));
            bad.then(|| format!("filters: {filters:?}"))
        }
        _ => None,
    }
}

/// A proxy in front of the broker. As AWS IoT Core does, it closes a connection without a reason if it does not
/// accept a packet. Returns its port and the packets that it did not accept.
fn limited(broker: u16) -> (u16, Arc<Mutex<Vec<String>>>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    let closed: Arc<Mutex<Vec<String>>> = Arc::default();
    let seen = closed.clone();
    std::thread::spawn(move || {
        for mut client in listener.incoming().map_while(Result::ok) {
            let (seen, mut server) = (seen.clone(), TcpStream::connect(("127.0.0.1", broker)).unwrap());
            let (mut from_server, mut to_client) = (server.try_clone().unwrap(), client.try_clone().unwrap());
            std::thread::spawn(move || {
                let _ = std::io::copy(&mut from_server, &mut to_client);
                let _ = to_client.shutdown(Shutdown::Both);
            });
            std::thread::spawn(move || {
                while let Some((first, body, raw)) = packet(&mut client) {
                    if let Some(why) = beyond_limits(first, &body) {
                        seen.lock().unwrap().push(why);
                        break;
                    }
                    if server.write_all(&raw).is_err() {
                        break;
                    }
                }
                let _ = (client.shutdown(Shutdown::Both), server.shutdown(Shutdown::Both));
            });
        }
    });
    (port, closed)
}

/// The recipe of docs/mqtt.md for such a broker; without `retain = false`, the log names the message that made the
/// broker close the connection.
#[test]
fn a_broker_that_closes_at_a_ninth_filter_or_a_retained_message_is_served() {
    let broker = Broker::start();
    let watcher = Watcher::new(&broker, "drivegate/#");
    let (port, closed) = limited(broker.port);
    let mut options = options(port);
    options.retain = false;
    options.publish_limit = 100;
    let gateway = Gateway::start(options.clone(), plant(&["p1", "p2", "p3"]));
    watcher.wait("online", |seen| {
        seen.topic == "drivegate/hall/status" && seen.payload == "online"
    });
    let topic = "drivegate/hall/drive/p3/set/speed_reference";
    broker.publish(topic, "12", &[]);
    watcher.wait("the result", |seen| seen.topic == "drivegate/hall/drive/p3/result");
    watcher.wait("a value", |seen| seen.topic.ends_with("p3/point/actual_speed"));
    drop(gateway);
    assert_eq!(*closed.lock().unwrap(), [""; 0]);
    options.retain = true;
    let gateway = Gateway::start(options, plant(&["p1"]));
    wait_log(
        port,
        "the broker closed the connection without a reason; the last packet sent before was PUBLISH to ",
    );
    assert!(closed.lock().unwrap()[0].starts_with("retained: "));
    wait_for("the reason for the status page", || {
        let link = gateway.stats.mqtt.plain.get()?;
        assert_eq!(link.broker, format!("127.0.0.1:{port}"));
        let (_, why) = link.error?;
        why.contains("the last packet sent before was PUBLISH to ")
            .then_some(())
    });
}
