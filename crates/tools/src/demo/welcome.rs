//! The text that the demo prints: its lines, and commands that can be copied whole. Pure, but for the path of the
//! program.

use super::login::Login;
use super::{DemoLine, DemoPlace, GUARDED, LINES, Sides};

/// The text. Every line that begins with exactly two blanks is a command, or a comment of the shell.
pub(super) fn text(place: &DemoPlace, sides: &Sides) -> String {
    let program = std::env::current_exe().map_or_else(|_| "drivegate".to_string(), |path| path.display().to_string());
    let configured = match &place.written {
        Some(written) => with_configuration(&program, &quoted(&written.config().display().to_string())),
        None => {
            "\nread, write, check and map need a configuration: start the demo with --write-config DIR.\n".to_string()
        }
    };
    format!(
        "\
drivegate {} demo: simulated drives of the verified families and every protocol, true wire timing, no hardware.
{}
The drives start, stop, ramp and occasionally fault on their own until you command them.
mbpoll and the mosquitto clients are separate programs: apt install mbpoll mosquitto-clients

{}{}{}{configured}
Ctrl-C ends the demo.",
        drivegate_core::version::VERSION,
        lines(&place.ports),
        reading_hints(&quoted(&program), sides),
        page(place, sides),
        command(sides),
    )
}

/// Instructions for a start from the page in a few steps.
fn page(place: &DemoPlace, sides: &Sides) -> String {
    let (http, bacnet, password) = (sides.http, sides.bacnet, &place.login.password);
    format!(
        "
Start a motor from the page
  # 1. Open http://{http}/#/drive/pump-1 and log in: user {}, password {password} (another at each start).
  # 2. Press STOP if it runs by itself. Press Start, and confirm.
  # 3. Press STOP. {GUARDED} may start again 10 s after a stop only; who takes a drive is shown to the others.
  # BACnet/IP: device 100 and a device for each drive behind it, at {bacnet}.
",
        Login::USER
    )
}

/// The word, quoted for the shell where necessary.
fn quoted(word: &str) -> String {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "/._-+:".contains(c);
    if word.chars().all(is_plain) {
        word.to_string()
    } else {
        format!("'{}'", word.replace('\'', "'\\''"))
    }
}

fn lines(ports: &[String]) -> String {
    let mut unit = 0;
    let mut one = |(line, port): (&DemoLine, &String)| {
        let drives = line.drives.iter().map(|(name, profile)| {
            unit += 1;
            format!("{name} ({profile}, unit {unit})")
        });
        let drives: Vec<String> = drives.collect();
        let (name, protocol) = (line.name, line.protocol.name());
        format!(
            " {name}: {protocol} {} {} on {port}\n        {}",
            line.baud,
            line.format,
            drives.join(", ")
        )
    };
    let lines: Vec<String> = LINES.iter().zip(ports).map(&mut one).collect();
    lines.join("\n")
}

fn reading_hints(program: &str, sides: &Sides) -> String {
    let (http, modbus, mqtt) = (sides.http, sides.modbus.port(), sides.mqtt.port());
    format!(
        "\
Look
  # The status page: open http://{http}/ in a browser. In the terminal:
  {program} watch --url http://{http}
  curl -s http://{http}/metrics | grep output_frequency
  curl -s http://{http}/api/v1/drives/pump-1
  # What happened before each fault:
  curl -s http://{http}/api/v1/recordings
  mosquitto_sub -h 127.0.0.1 -p {mqtt} -v -t 'drivegate/#'
  # Common model of pump-1 (unit 1):
  mbpoll -m tcp -p {modbus} -a 1 -0 -r 32768 -c 19 -1 127.0.0.1
  # Its own registers, IDs 2101 to 2111:
  mbpoll -m tcp -p {modbus} -a 1 -0 -r 2100 -c 11 -1 127.0.0.1
  # The common model of conveyor-1, a TECO on Modbus ASCII, and of ahu-1, a Vacon NX on Metasys N2:
  mbpoll -m tcp -p {modbus} -a 7 -0 -r 32768 -c 19 -1 127.0.0.1
  mbpoll -m tcp -p {modbus} -a 8 -0 -r 32768 -c 19 -1 127.0.0.1
"
    )
}

fn command(sides: &Sides) -> String {
    let (modbus, mqtt) = (sides.modbus.port(), sides.mqtt.port());
    format!(
        "
Command pump-1
  mosquitto_pub -h 127.0.0.1 -p {mqtt} -q 1 -t drivegate/demo/drive/pump-1/set -m '{{\"run\": true, \"speed_reference\": 50}}'
  # Speed reference 60.00 %, run; then stop and reset a fault; then stop:
  mbpoll -m tcp -p {modbus} -a 1 -0 -r 33025 127.0.0.1 6000
  mbpoll -m tcp -p {modbus} -a 1 -0 -r 33024 127.0.0.1 1
  mbpoll -m tcp -p {modbus} -a 1 -0 -r 33024 127.0.0.1 4
  mbpoll -m tcp -p {modbus} -a 1 -0 -r 33024 127.0.0.1 0
"
    )
}

fn with_configuration(program: &str, config: &str) -> String {
    let program = quoted(program);
    format!(
        "
With the configuration of this demo
  {program} check {config}
  {program} map --config {config}
  {program} read --config {config} pump-2 state output_frequency motor_current
  {program} write --config {config} pump-2 speed_reference=40 run=true
  {program} write --config {config} pump-2 run=false
"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_of_the_shell() {
        assert_eq!(quoted("/usr/bin/drivegate"), "/usr/bin/drivegate");
        assert_eq!(quoted("/tmp/my demo/x"), "'/tmp/my demo/x'");
        assert_eq!(quoted("it's"), "'it'\\''s'");
    }
}
