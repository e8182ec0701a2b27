//! `drivegate demo`: the whole product with no hardware and nothing to install.

mod login;
mod welcome;
mod written;

use std::io::ErrorKind;
use std::net::{Ipv4Addr, SocketAddr, TcpListener, UdpSocket};
use std::path::PathBuf;
use std::process::ExitCode;

use tokio_util::sync::CancellationToken;

use self::login::Login;
use self::written::Written;
use super::failure::Outcome;
use super::report;
use super::simulate::Speed;
use drivegate_gateway::config::{LogFormat, LogSettings, Settings};
use drivegate_gateway::daemon::Daemon;
use drivegate_model::drive::profile::Profiles;
use drivegate_proto::{LineFormat, Protocol};
use drivegate_sim::broker::Broker;
use drivegate_sim::endpoint::EndpointOptions;
use drivegate_sim::half_duplex::{LineRules, Wire};
use drivegate_sim::simulated_drive::{DriveOptions, ModelOptions};
use drivegate_sim::wire::{SimulatedBus, SimulatedBusOptions};

/// Shows the whole product with simulated drives: no hardware, nothing to install
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Example:\n  drivegate demo\n  drivegate demo --speed max\n  drivegate demo --write-config /tmp/demo"
)]
pub(super) struct Args {
    /// True wire times, or as fast as the programs are
    #[arg(long, value_enum, default_value_t = Speed::Real)]
    pub speed: Speed,
    /// Leave a configuration and the ports of the lines in this directory, for the other commands
    #[arg(long, value_name = "DIR")]
    pub write_config: Option<PathBuf>,
    /// Log level: off, error, warn, info, debug, trace, also for each target
    #[arg(long, default_value = "error", value_name = "LEVEL", value_parser = drivegate_gateway::config::parse_level)]
    pub log: String,
}

/// A simulated line of the demo.
struct DemoLine {
    name: &'static str,
    protocol: Protocol,
    baud: u32,
    format: &'static str,
    /// `cycle` and `slow_cycle`.
    cadence: [&'static str; 2],
    /// Drives with their profiles; their addresses begin at 1.
    drives: &'static [(&'static str, &'static str)],
}

/// The lines of the demo, which cover every protocol and every verified family.
const LINES: [DemoLine; 5] = [
    DemoLine {
        name: "line1",
        protocol: Protocol::ModbusRtu,
        baud: 38_400,
        format: "8N1",
        cadence: ["30ms", "1s"],
        drives: &[("pump-1", "vacon-nx"), ("pump-2", "vacon-nx")],
    },
    DemoLine {
        name: "line2",
        protocol: Protocol::ModbusRtu,
        baud: 38_400,
        format: "8N1",
        cadence: ["15ms", "1s"],
        drives: &[("fan-1", "vacon-nx")],
    },
    DemoLine {
        name: "line3",
        protocol: Protocol::ModbusRtu,
        baud: 19_200,
        // The character format of a Vacon CX, which the other drives accept.
        format: "8N2",
        cadence: ["250ms", "2s"],
        drives: &[
            ("blower-1", "eaton-svx"),
            ("blower-2", "eaton-hvx"),
            ("mixer-1", "vacon-cx"),
        ],
    },
    DemoLine {
        name: "line4",
        protocol: Protocol::ModbusAscii,
        baud: 19_200,
        format: "7N2",
        cadence: ["150ms", "2s"],
        drives: &[("conveyor-1", "teco-7300pa")],
    },
    DemoLine {
        name: "line5",
        protocol: Protocol::N2,
        baud: 9600,
        format: "8N1",
        cadence: ["1500ms", "10s"],
        drives: &[
            ("ahu-1", "vacon-nx-n2"),
            ("ahu-2", "eaton-hvx-n2"),
            ("ahu-3", "teco-7300pa-n2"),
        ],
    },
];

/// The drive with a start guard.
const GUARDED: &str = "pump-2";

/// Preferred port of MQTT.
const MQTT: u16 = 1883;
const MODBUS_TCP: u16 = 1502;
const HTTP: u16 = 9488;
const BACNET: u16 = 47_808;

/// Runs the demo until Ctrl-C.
pub(super) fn run(args: &Args) -> Outcome {
    let _log = super::log::start(&LogSettings {
        level: args.log.clone(),
        format: LogFormat::Auto,
    });
    super::block_on(async {
        demo(args).await?;
        Ok(ExitCode::SUCCESS)
    })
}

async fn demo(args: &Args) -> Result<(), String> {
    let written = args.write_config.as_deref().map(Written::prepare).transpose()?;
    let lines =
        start_lines(args.speed, written.as_ref()).map_err(|e| format!("cannot create a simulated line: {e}"))?;
    let directory = written
        .as_ref()
        .map_or_else(temporary, |written| written.dir().to_path_buf());
    let place = DemoPlace {
        ports: lines.iter().map(|line| line.address()).collect(),
        login: Login::new(&directory)?,
        written,
    };
    let cancel = CancellationToken::new();
    let mut started = start(&place, &cancel).await;
    // Another program may take a port between its check and its use.
    for _ in 0..4 {
        if started.is_err() {
            started = start(&place, &cancel).await;
        }
    }
    let (daemon, broker, sides) = started?;
    for (what, address, wanted) in sides.each() {
        if address.port() != wanted {
            println!("Port {wanted} is in use; {what} listens on {} instead.", address.port());
        }
    }
    if let Some(written) = &place.written {
        written.write(&configuration(&place, &sides))?;
    }
    println!("{}", welcome::text(&place, &sides));
    // Without a handler, Ctrl-C ends the process anyway.
    let _ = tokio::signal::ctrl_c().await;
    println!("\nStopping the demo.");
    daemon.stop().await;
    cancel.cancel();
    broker.stop().await;
    lines.into_iter().for_each(SimulatedBus::stop);
    if place.written.is_none() {
        let _ = std::fs::remove_dir_all(place.state_dir());
    }
    Ok(())
}

/// The temporary directory of a demo that leaves no files.
fn temporary() -> PathBuf {
    std::env::temp_dir().join(format!("drivegate-demo-{}", std::process::id()))
}

/// Places of the demo on this machine.
struct DemoPlace {
    /// Ports of the lines.
    ports: Vec<String>,
    /// The login of the page.
    login: Login,
    /// The directory of `--write-config`.
    written: Option<Written>,
}

impl DemoPlace {
    /// The directory of this demo's recordings.
    fn state_dir(&self) -> PathBuf {
        match &self.written {
            Some(written) => written.state_dir(),
            None => temporary(),
        }
    }

    /// The local socket; without a configuration file, no client could find the socket.
    fn socket(&self) -> String {
        let socket = self.written.as_ref().map(Written::socket);
        socket.map_or_else(String::new, |socket| socket.display().to_string())
    }
}

/// Addresses of the north sides.
struct Sides {
    mqtt: SocketAddr,
    modbus: SocketAddr,
    http: SocketAddr,
    bacnet: SocketAddr,
}

impl Sides {
    /// Name, address and preferred port of each server.
    fn each(&self) -> [(&'static str, SocketAddr, u16); 4] {
        [
            ("MQTT broker", self.mqtt, MQTT),
            ("Modbus TCP", self.modbus, MODBUS_TCP),
            ("HTTP", self.http, HTTP),
            ("BACnet/IP", self.bacnet, BACNET),
        ]
    }
}

async fn start(place: &DemoPlace, cancel: &CancellationToken) -> Result<(Daemon, Broker, Sides), String> {
    let (mqtt, broker) = start_broker(cancel).await?;
    let [mut modbus, mut http, mut bacnet] = [MODBUS_TCP, HTTP, BACNET];
    loop {
        let sides = Sides {
            mqtt,
            modbus: free_port("Modbus TCP", modbus)?,
            http: free_port("HTTP", http)?,
            bacnet: free_of("BACnet/IP", bacnet, |address| UdpSocket::bind(address).is_ok())?,
        };
        let loaded = Settings::parse("demo.toml", &configuration(place, &sides), std::iter::empty());
        report::errors(&loaded.errors);
        let settings = loaded.settings.ok_or("the configuration of the demo is not valid")?;
        let failed = match Daemon::start(settings).await {
            Ok(daemon) => return Ok((daemon, broker, sides)),
            Err(error) => error,
        };
        // Another program may have taken a port since it was found free.
        match failed.address_in_use() {
            Some(taken) if taken == sides.modbus => modbus = taken.port().saturating_add(1),
            Some(taken) if taken == sides.http => http = taken.port().saturating_add(1),
            Some(taken) if taken == sides.bacnet => bacnet = taken.port().saturating_add(1),
            _ => return Err(failed.to_string()),
        }
    }
}

/// Starts the broker at the first free port.
async fn start_broker(cancel: &CancellationToken) -> Result<(SocketAddr, Broker), String> {
    let mut port = MQTT;
    loop {
        let address = free_port("the MQTT broker", port)?;
        match Broker::start(address, cancel.child_token()).await {
            Ok(broker) => return Ok((address, broker)),
            Err(error) if error.kind() == ErrorKind::AddrInUse => port = address.port().saturating_add(1),
            Err(error) => return Err(format!("cannot start the MQTT broker on {address}: {error}")),
        }
    }
}

fn start_lines(speed: Speed, written: Option<&Written>) -> std::io::Result<Vec<SimulatedBus>> {
    let profiles = Profiles::built_in();
    let model = |profile: &str| -> std::io::Result<ModelOptions> {
        let simulator = profiles.get(profile).and_then(|profile| profile.simulator.clone());
        let model = simulator.as_deref().and_then(ModelOptions::by_name);
        model.ok_or_else(|| std::io::Error::other(format!("drives of the profile `{profile}` cannot be simulated")))
    };
    let start = |line: &DemoLine| {
        let format = LineFormat::new(line.baud, line.format).map_err(|e| std::io::Error::other(e.to_string()))?;
        let mut rules = LineRules::of(line.protocol, format);
        if speed == Speed::Max {
            rules.wire = Wire::Instant;
        }
        let drives: std::io::Result<Vec<DriveOptions>> = (1..)
            .zip(line.drives)
            .map(|(address, (_, profile))| {
                // Different seeds, so that the drives do not move in step.
                let seed = u64::from(line.baud) + u64::from(address);
                Ok(DriveOptions {
                    autopilot: Some(seed),
                    ..DriveOptions::new(address, model(profile)?)
                })
            })
            .collect();
        let options = SimulatedBusOptions::new(line.name, rules, drives?);
        SimulatedBus::start(SimulatedBusOptions {
            endpoint: EndpointOptions::Pty {
                link: written.map(|written| written.port(line.name)),
            },
            ..options
        })
    };
    LINES.iter().map(start).collect()
}

/// The preferred port on loopback, or the next free one.
pub(super) fn free_port(what: &str, wanted: u16) -> Result<SocketAddr, String> {
    free_of(what, wanted, |address| TcpListener::bind(address).is_ok())
}

/// The first free port on loopback, from `wanted` upward.
fn free_of(what: &str, wanted: u16, is_free: impl Fn(SocketAddr) -> bool) -> Result<SocketAddr, String> {
    for port in wanted..wanted.saturating_add(100) {
        let address = SocketAddr::from((Ipv4Addr::LOCALHOST, port));
        if is_free(address) {
            return Ok(address);
        }
    }
    Err(format!(
        "no free port for {what} from {wanted} to {}; stop another program",
        wanted.saturating_add(99)
    ))
}

fn configuration(place: &DemoPlace, sides: &Sides) -> String {
    let Sides {
        mqtt,
        modbus,
        http,
        bacnet,
    } = sides;
    let mut text = format!(
        "[gateway]\nname = \"demo\"\nsocket = {:?}\nstate_dir = {:?}\n",
        place.socket(),
        place.state_dir().display().to_string()
    );
    let mut unit = 0;
    for (line, port) in LINES.iter().zip(&place.ports) {
        let DemoLine { name, baud, format, .. } = line;
        let ([cycle, slow_cycle], protocol) = (line.cadence, line.protocol.name());
        text += &format!("\n[[bus]]\nname = \"{name}\"\nport = {port:?}\nprotocol = \"{protocol}\"\nbaud = {baud}\n");
        text += &format!("format = \"{format}\"\ncycle = \"{cycle}\"\nslow_cycle = \"{slow_cycle}\"\n");
        // The drives are programs: on a busy machine they answer late, but they do answer.
        text += "response_timeout = \"1s\"\nretries = 3\n";
        if line.protocol == Protocol::ModbusRtu {
            text += "silence = \"chars\"\n";
        }
        for (address, (drive, profile)) in (1..).zip(line.drives) {
            unit += 1;
            text += &format!("\n[[bus.drive]]\nname = \"{drive}\"\naddress = {address}\nprofile = \"{profile}\"\n");
            text += &format!("unit = {unit}\naccess = \"control\"\n");
            text += "supervision = { timeout = \"10min\", action = \"stop\" }\n";
            if *drive == GUARDED {
                text += "guard = { min_off = \"10s\" }\n";
            }
            if *profile == "vacon-nx" {
                text += "turnaround = \"0.5ms\"\n";
            }
        }
    }
    text += &format!("\n[modbus_tcp]\nlisten = [\"{modbus}\"]\nwrite = [\"127.0.0.0/8\"]\n");
    text += &format!("\n[mqtt]\nurl = \"mqtt://{mqtt}\"\nclient_id = \"drivegate-demo\"\ncommands = true\n");
    text += &format!("\n[bacnet]\nlisten = \"{bacnet}\"\ncommands = true\nwrite = [\"127.0.0.0/8\"]\n");
    let users = place.login.file.display().to_string();
    text += &format!("\n[http]\nlisten = \"{http}\"\ncommands = true\nusers_file = {users:?}\n");
    let user = Login::USER;
    // In advisory mode holders are shown, and no client is refused.
    text += "\n[authority]\nmode = \"advisory\"\n";
    text + &format!("\n[[authority.principal]]\nname = \"{user}\"\nrank = \"operator\"\nhttp_user = \"{user}\"\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The demo's configuration, which newcomers read first, gives no warning, and its timeouts suit a busy machine.
    #[test]
    fn the_configuration_of_the_demo_has_no_warnings() {
        let folder = tempfile::tempdir().expect("a directory");
        let place = DemoPlace {
            ports: LINES.iter().map(|line| format!("/dev/{}", line.name)).collect(),
            login: Login::new(folder.path()).expect("a login"),
            written: None,
        };
        let [mqtt, modbus, http, bacnet] =
            [MQTT, MODBUS_TCP, HTTP, BACNET].map(|port| SocketAddr::from((Ipv4Addr::LOCALHOST, port)));
        let sides = Sides {
            mqtt,
            modbus,
            http,
            bacnet,
        };
        let text = configuration(&place, &sides);
        let loaded = Settings::parse("demo.toml", &text, std::iter::empty());
        assert!(loaded.errors.is_empty(), "{:?}", loaded.errors);
        assert!(loaded.warnings.is_empty(), "{:?}", loaded.warnings);
        for bus in loaded.settings.expect("settings").buses {
            assert!(bus.options.response_timeout >= std::time::Duration::from_secs(1));
        }
    }
}
