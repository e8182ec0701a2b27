//! What brokers of the clouds and plants with a single way out need: WebSocket, a proxy, a token that another program
//! renews, a limit of messages.

use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use drivegate::north::mqtt::Password;

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

/// An HTTP proxy that knows CONNECT alone: what it was asked for.
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
    // The name means something here only.
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
    broker.publish_all(topic, &orders);
    let began = std::time::Instant::now();
    wait_for("a result of each", || {
        let all = watcher.all();
        let results = all.iter().filter(|seen| seen.topic.ends_with("/result")).count();
        (results >= 40).then_some(())
    });
    let took = began.elapsed();
    let own = |seen: &&Seen| !seen.topic.ends_with("/set");
    let count = watcher.all()[before..].iter().filter(own).count();
    let most = 20 * (took.as_secs() as usize + 2);
    assert!(count <= most, "{count} messages in {took:?}");
    assert!(took >= Duration::from_secs(1), "{took:?}");
}

/// Gives the user `hall` that password.
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
