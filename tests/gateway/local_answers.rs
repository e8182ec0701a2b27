//! An order received over the local socket is answered, whatever happens to the socket meanwhile.

use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::time::Duration;

use crate::support::process::{PATIENCE, Running, local};
use crate::support::site::{HTTP, LINE1, Site, controlled};

/// A gateway with a socket, and a drive whose simulator is stalled, so that an order to it takes some seconds.
fn site() -> (Site, Running, Running) {
    let site = Site::new();
    let socket = format!("[gateway]\nsocket = \"{}\"\n", site.path("socket"));
    let line = LINE1.replace("[gateway]\n", &socket);
    site.configure(&[&line, &controlled("pump-1", 1, ""), HTTP]);
    let simulator = site.simulate(&["--addresses", "1", "--baud", "38400"]);
    let gateway = site.run_ready();
    site.until_state("pump-1", "ready");
    simulator.stand();
    (site, simulator, gateway)
}

/// Gives an order over the socket without waiting for the answer.
fn order(site: &Site, body: &str) -> UnixStream {
    let mut stream = local(site.path("socket"));
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    let request = format!(
        "POST /api/v1/drives/pump-1/commands HTTP/1.1\r\nHost: gateway\r\nContent-Length: {}\r\n\r\n{body}",
        body.len()
    );
    stream.write_all(request.as_bytes()).unwrap();
    std::thread::sleep(Duration::from_millis(300));
    stream
}

/// All bytes that the server sends until it closes the connection.
fn answer(mut stream: UnixStream) -> String {
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    answer
}

#[test]
fn a_reload_that_moves_the_socket_loses_no_answer() {
    let (site, _simulator, gateway) = site();
    let waiting = order(&site, "{\"speed_reference\": 20}");
    site.change("/socket\"", "/other\"");
    gateway.signal("HUP");
    gateway.until_printed("configuration reloaded");
    let answer = answer(waiting);
    // The new socket may be open to other users, so a request that was not sent yet is refused. A poll that is
    // waiting for the drive when the order arrives may use its whole time limit: the order then expires.
    let is_told = ["HTTP/1.1 504", "HTTP/1.1 403", "HTTP/1.1 503"]
        .iter()
        .any(|begin| answer.starts_with(begin));
    assert!(is_told, "{answer:?}");
    assert!(UnixStream::connect(site.path("other")).is_ok());
}

#[test]
fn the_end_of_the_gateway_loses_no_answer() {
    let (site, simulator, mut gateway) = site();
    let waiting = [
        order(&site, "{\"speed_reference\": 20}"),
        order(&site, "{\"run\": false}"),
        order(&site, "{\"run\": false}"),
    ];
    gateway.signal("TERM");
    simulator.signal("CONT");
    for (number, waiting) in waiting.into_iter().enumerate() {
        let answer = answer(waiting);
        assert!(answer.starts_with("HTTP/1.1 "), "{number}: {answer:?}");
    }
    assert!(gateway.ended().success());
}
