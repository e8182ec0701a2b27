//! The clients of Mosquitto at a broker of this machine.

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Output, Stdio};

use super::tools::tool;

/// A client of that protocol version, such as `mosquitto_sub`.
pub(crate) fn client_of(version: &str, name: &str, port: u16) -> Command {
    let mut command = Command::new(tool(name));
    command.args(["-V", version, "-h", "127.0.0.1", "-p", &port.to_string()]);
    command
}

/// A client of MQTT 5.
pub(crate) fn client(name: &str, port: u16) -> Command {
    client_of("5", name, port)
}

/// Output of `mosquitto_sub` for the next message of a topic; empty if none arrives within 10 s.
pub(crate) fn next_message(port: u16, topic: &str, more: &[&str]) -> Output {
    let mut command = client("mosquitto_sub", port);
    command.args(["-t", topic, "-C", "1", "-W", "10"]).args(more);
    command.output().unwrap()
}

/// The next message of a topic, which is JSON.
pub(crate) fn next_json(port: u16, topic: &str) -> Option<serde_json::Value> {
    serde_json::from_slice(&next_message(port, topic, &[]).stdout).ok()
}

/// A client that prints messages, each on a line; killed (SIGKILL) when dropped.
pub(crate) struct Subscriber(Child);

impl Subscriber {
    /// Starts the client; `on_line` receives each printed line.
    pub(crate) fn start(command: &mut Command, mut on_line: impl FnMut(String) + Send + 'static) -> Subscriber {
        let child = command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn();
        let mut child = child.unwrap();
        let lines = BufReader::new(child.stdout.take().unwrap()).lines();
        std::thread::spawn(move || lines.map_while(Result::ok).for_each(&mut on_line));
        Subscriber(child)
    }
}

impl Drop for Subscriber {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
