//! `drivegate simulate`: simulated drives on a pseudo-terminal, a real port or a TCP port, with wire timing and faults.

mod watch;

use super::addresses::{Addresses, parse_addresses};
use super::failure::{Failure, Outcome};
use super::{EXIT_CONFIG, report};
use drivegate_core::process_image::DriveSpec;
use drivegate_gateway::config::{self, BusSettings, Settings, default_format};
use drivegate_line::split_dial_in;
use drivegate_model::document::{self, Problem, nearest};
use drivegate_model::drive::model::Kind;
use drivegate_model::drive::profile::{Profile, Profiles};
use drivegate_model::drive::{Point, PointIndex};
use drivegate_proto::{LineFormat, Protocol};
use drivegate_sim::by_profile::Given;
use drivegate_sim::cx::AddressOffset;
use drivegate_sim::endpoint::EndpointOptions;
use drivegate_sim::faults::{FaultPlan, Rates, names};
use drivegate_sim::half_duplex::{Delivery, LineRules, Wire};
use drivegate_sim::simulated_drive::{DriveOptions, ModelOptions};
use drivegate_sim::wire::{SimulatedBus, SimulatedBusOptions};
use std::net::{SocketAddr, ToSocketAddrs};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

/// Simulates drives on a pseudo-terminal, a real port or a TCP port, with wire timing and faults
#[derive(Debug, clap::Args)]
#[command(after_help = format!("Examples:
  drivegate simulate --addresses 1-10 --link /tmp/line1 --baud 38400
  \
                                drivegate simulate --addresses 1,2 --link /tmp/line1 --fault \
                                drop=0.01,late:150ms=0.01 --seed 7
  drivegate simulate --profile teco-7300pa \
                                --addresses 1-3 --link /tmp/line2
  drivegate simulate --profile our-meter.toml --set \
                                voltage_l1=231.5 --link /tmp/line3
  drivegate simulate --config \
                                drivegate.toml

Faults: {}.

A simulated drive obeys the bus. Writing a fault \
                                code to a holding register that no real drive has trips it; PDU address by the key \
                                `simulator` of the profile: {}; others 9998. The signal USR1 trips all drives of the \
                                process; USR2 gives them to their panels, or back to the bus.", names(), trip_registers()))]
pub(super) struct Args {
    /// Simulate every bus of a gateway configuration, each under its own `port`
    #[arg(long, value_name = "FILE", conflicts_with_all = ["profile", "addresses", "link", "port", "listen", "protocol", "baud", "format"])]
    pub config: Option<PathBuf>,
    /// Profile of the drives: its name, or a file *.toml
    #[arg(long, value_name = "PROFILE", default_value = "vacon-nx")]
    pub profile: String,
    /// Include the profiles (*.toml) of this directory; may be repeated
    #[arg(long, value_name = "DIR", conflicts_with = "config")]
    pub profile_dir: Vec<PathBuf>,
    /// Value of a point, for profiles without their own simulator, such as voltage_l1=231.5; may be repeated
    #[arg(long, value_name = "POINT=VALUE", conflicts_with = "config")]
    pub set: Vec<String>,
    /// Their addresses, such as 1-10 or 1,2,7
    #[arg(long, value_name = "LIST", default_value = "1", value_parser = parse_addresses)]
    pub addresses: Addresses,
    /// Symbolic link to the pseudo-terminal; removed at the end
    #[arg(long, value_name = "PATH", conflicts_with_all = ["port", "listen"])]
    pub link: Option<PathBuf>,
    /// Real serial port to simulate the drives on
    #[arg(long, value_name = "DEVICE", conflicts_with = "listen")]
    pub port: Option<PathBuf>,
    /// Serve the line raw over TCP, as a serial device server does
    #[arg(long, value_name = "HOST:PORT", value_parser = parse_listen)]
    pub listen: Option<SocketAddr>,
    /// Serve the drives by Modbus TCP, as drives with Ethernet on board do
    #[arg(long, value_name = "HOST:PORT", value_parser = parse_listen, conflicts_with_all = ["link", "port", "listen"])]
    pub modbus_tcp: Option<SocketAddr>,
    /// Serve the line with one frame in each datagram
    #[arg(long, value_name = "HOST:PORT", value_parser = parse_listen,
          conflicts_with_all = ["link", "port", "listen", "modbus_tcp"])]
    pub udp: Option<SocketAddr>,
    /// Dial in at a gateway, as a modem does
    #[arg(long, value_name = "HOST:PORT", value_parser = parse_listen,
          conflicts_with_all = ["link", "port", "listen", "modbus_tcp", "udp"])]
    pub dial: Option<SocketAddr>,
    /// Text that is said first where the line dials in
    #[arg(long, value_name = "TEXT", requires = "dial", default_value = "")]
    pub id: String,
    /// modbus-rtu, modbus-ascii or n2 [default: the first of the profile]
    #[arg(long, value_name = "PROTOCOL", value_parser = parse_protocol)]
    pub protocol: Option<Protocol>,
    /// Bits a second [default: 38400, or the next lower rate that the drives support]
    #[arg(long, value_name = "BAUD", value_parser = clap::value_parser!(u32).range(300..=4_000_000))]
    pub baud: Option<u32>,
    /// Data bits, parity and stop bits [default: the usual one of the profile]
    #[arg(long, value_name = "FORMAT")]
    pub format: Option<String>,
    /// Time between the end of a request and the reply [default: that of the drive's manual, else 0.5ms]
    #[arg(long, value_name = "TIME", value_parser = report::duration)]
    pub turnaround: Option<Duration>,
    /// Faults and their probabilities, such as drop=0.01,corrupt=0.02
    #[arg(long, value_name = "LIST", default_value = "")]
    pub fault: Rates,
    /// Seed of the faults and of the autopilot
    #[arg(long, value_name = "NUMBER", default_value_t = 1)]
    pub seed: u64,
    /// Let the drives start, stop and fault on their own until a master writes to them
    #[arg(long)]
    pub autopilot: bool,
    /// Also answer Modbus RTU requests that are not preceded by 3.5 characters of silence
    #[arg(long)]
    pub lenient: bool,
    /// Send a status byte before the values read over N2, as some devices do
    #[arg(long)]
    pub n2_leading_byte: bool,
    /// Add an offset to the addresses of each Vacon CX, as boards that count from 1 do: holding=1,discrete-input=1
    #[arg(long, value_name = "LIST")]
    pub cx_address_offset: Option<AddressOffset>,
    /// Let each TECO 7300PA answer a request with a wrong check code with error 00H, as in its error table, instead of not at all
    #[arg(long)]
    pub teco_answer_check_error: bool,
    /// Characters delivered to the master at a time: 0 the whole reply, 14 like a UART's FIFO, 1 one by one
    #[arg(long, value_name = "CHARACTERS", default_value_t = 0)]
    pub chunk: u8,
    /// True wire times, or as fast as the programs are
    #[arg(long, value_enum, default_value_t = Speed::Real)]
    pub speed: Speed,
}

/// Default baud rate if the drives support it.
const USUAL_BAUD: u32 = 38_400;

/// `nx, svx, hvx 1998; cx 9999; ...`
fn trip_registers() -> String {
    let mut registers: Vec<(u16, Vec<&str>)> = Vec::new();
    for name in ModelOptions::NAMES {
        let Some(address) = ModelOptions::by_name(name).map(|model| model.trip_address()) else {
            continue;
        };
        match registers.iter_mut().find(|(known, _)| *known == address) {
            Some((_, names)) => names.push(name),
            None => registers.push((address, vec![name])),
        }
    }
    let text = |(address, names): &(u16, Vec<&str>)| format!("{} {address}", names.join(", "));
    registers.iter().map(text).collect::<Vec<String>>().join("; ")
}

fn parse_protocol(text: &str) -> Result<Protocol, String> {
    let known: Vec<&str> = Protocol::ALL.iter().map(|protocol| protocol.name()).collect();
    Protocol::from_name(text).ok_or_else(|| format!("unknown protocol `{text}`; write {}", known.join(", ")))
}

/// The simulated drive of a profile.
///
/// # Errors
/// If the profile cannot be simulated: contains the reason.
fn model_of(profile: &Arc<Profile>) -> Result<ModelOptions, String> {
    ModelOptions::of_profile(profile).ok_or_else(|| match &profile.simulator {
        Some(name) if ModelOptions::by_name(name).is_none() && !profile.protocols.contains(&Protocol::N2) => format!(
            "the profile `{}` has the unknown simulator `{name}`; omit the key `simulator`",
            profile.name
        ),
        _ => format!(
            "drives of the profile `{}` cannot be simulated, because they speak Metasys N2 and no family is simulated like them; \
             choose another",
            profile.name
        ),
    })
}

/// Parses `POINT=VALUE`; the value has the form of the point.
fn given(text: &str, profile: &Profile) -> Result<(PointIndex, Given), String> {
    let (name, value) = text
        .split_once('=')
        .ok_or_else(|| format!("`{text}` has no value; in --set; write POINT=VALUE, such as voltage_l1=231.5"))?;
    let found = profile
        .points
        .position(|point| point.name == name && point.raw().is_some());
    let found = found.and_then(|index| profile.points.get(index).map(|point| (index, point)));
    let (index, point) = found.ok_or_else(|| {
        let own = |point: &&Point| point.raw().is_some();
        let names = profile.points.iter().filter(own).map(|point| point.name.as_str());
        let near = nearest(name, names).map(|near| format!("; did you mean `{near}`?"));
        format!(
            "the profile `{}` has no point `{name}` with a register of its own; in --set{}",
            profile.name,
            near.unwrap_or_default()
        )
    })?;
    let number = match value {
        _ if point.kind() == Kind::Text => return Ok((index, Given::Text(value.to_string()))),
        "true" => Some(1.0),
        "false" => Some(0.0),
        text => point
            .code_of(text)
            .map(|code| code as f64)
            .or_else(|| text.parse().ok()),
    };
    match number.filter(|number: &f64| number.is_finite()) {
        Some(number) => Ok((index, Given::Number(number))),
        None => Err(format!(
            "`{value}` is not a value of `{name}`; in --set; write a number, true or false"
        )),
    }
}

/// How fast the simulated lines are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub(super) enum Speed {
    /// Every character takes as long as on a real line.
    Real,
    /// No time on the wire.
    Max,
}

/// The endpoint that replaces a bus's `port`: a link in place of the device, or a listener.
///
/// # Errors
/// If the address does not belong to this machine, or is `rfc2217://`, which is not simulated.
fn endpoint_for(port: &str) -> Result<EndpointOptions, String> {
    let Some((scheme, address)) = port.split_once("://") else {
        return Ok(EndpointOptions::Pty {
            link: Some(PathBuf::from(port)),
        });
    };
    let (place, text) = split_dial_in(address);
    let socket = socket_address(place)
        .ok_or_else(|| format!("`{port}` is not an address to listen on; write it as {scheme}://127.0.0.1:4001"))?;
    match scheme {
        "tcp" => Ok(EndpointOptions::Tcp { listen: socket }),
        "modbus-tcp" => Ok(EndpointOptions::ModbusTcp { listen: socket }),
        "udp" => Ok(EndpointOptions::Udp { listen: socket }),
        "tcp-listen" => Ok(EndpointOptions::Dial {
            server: socket,
            text: text.to_string(),
        }),
        _ => Err(format!(
            "`{port}` cannot be simulated; write it as tcp://127.0.0.1:4001, or as a path"
        )),
    }
}

fn socket_address(text: &str) -> Option<SocketAddr> {
    text.to_socket_addrs().ok().and_then(|mut found| found.next())
}

fn parse_listen(text: &str) -> Result<SocketAddr, String> {
    socket_address(text)
        .ok_or_else(|| format!("`{text}` is not an address to listen on; write host:port, such as 127.0.0.1:4001"))
}

/// The simulated lines of a configuration file, each in place of the port of its bus.
fn configured(file: &Path) -> Result<Vec<SimulatedBusOptions>, Failure> {
    let loaded = Settings::load(file, config::environment());
    report::problems(&loaded);
    let settings = loaded.settings.ok_or(Failure::Reported(EXIT_CONFIG))?;
    let lines: Result<Vec<SimulatedBusOptions>, String> = settings.buses.iter().map(line_of).collect();
    lines.map_err(|message| {
        report::error(&message);
        Failure::Reported(EXIT_CONFIG)
    })
}

fn line_of(bus: &BusSettings) -> Result<SimulatedBusOptions, String> {
    let drive = |spec: &DriveSpec| {
        let model = model_of(&spec.profile).map_err(|why| format!("{why}; drive `{}`", spec.name))?;
        Ok(DriveOptions::new(spec.address, model))
    };
    let drives = bus.drives.iter().map(drive).collect::<Result<_, String>>()?;
    let mut line = SimulatedBusOptions::new(
        &bus.spec.name,
        LineRules::of(bus.spec.protocol, bus.spec.format),
        drives,
    );
    line.endpoint = endpoint_for(&bus.spec.port)?;
    Ok(line)
}

/// Simulates until Ctrl-C or SIGTERM.
pub(super) fn run(args: &Args) -> Outcome {
    let lines = match &args.config {
        Some(file) => configured(file)?,
        None => vec![args.line().map_err(Failure::Misused)?],
    };
    let start = |line: SimulatedBusOptions| {
        let name = line.name.clone();
        SimulatedBus::start(args.applied_to(line)).map_err(|error| match &args.config {
            Some(file) => {
                let file = file.display();
                format!("cannot simulate bus `{name}` at its `port` in {file}: {error}")
            }
            None => format!("cannot simulate: {error}"),
        })
    };
    let lines = lines
        .into_iter()
        .map(start)
        .collect::<Result<Vec<SimulatedBus>, String>>()?;
    watch::serve(&lines).map_err(|error| format!("cannot simulate: {error}"))?;
    Ok(ExitCode::SUCCESS)
}

impl Args {
    /// The line given on the command line.
    fn line(&self) -> Result<SimulatedBusOptions, String> {
        let mut profiles = Profiles::built_in();
        let problems: Vec<Problem> = self.profile_dir.iter().flat_map(|dir| profiles.load(dir)).collect();
        let profile = self.profile_of(&profiles, problems)?;
        let mut model = model_of(&profile).map_err(|why| format!("{why}; in --profile"))?;
        match &mut model {
            ModelOptions::Profile(of) => {
                let given = self.set.iter().map(|text| given(text, &profile));
                of.values = given.collect::<Result<_, String>>()?;
            }
            _ if !self.set.is_empty() => {
                return Err(format!(
                    "the values of `{}` come from its simulated motor; in --set; omit it",
                    self.profile
                ));
            }
            _ => {}
        }
        if self.cx_address_offset.is_some() && !matches!(model, ModelOptions::Cx(_)) {
            return Err(format!(
                "drives of the profile `{}` have no address offset; in --cx-address-offset; omit it, or choose \
                 vacon-cx in --profile",
                self.profile
            ));
        }
        let protocol = self.protocol_of(&profile, &profiles)?;
        if let Some(address) = self
            .addresses
            .0
            .iter()
            .find(|address| !profile.addresses.contains::<u8>(address))
        {
            let (first, last) = profile.addresses.clone().into_inner();
            return Err(format!(
                "`{}` has no address {address}; in --addresses; its drives have {first} to {last}",
                self.profile
            ));
        }
        let usual = profile.bauds.iter().copied().filter(|baud| *baud <= USUAL_BAUD).max();
        let baud = self.baud.or(usual).unwrap_or(USUAL_BAUD);
        let usual = profile.formats.first().map_or(default_format(protocol), String::as_str);
        let format = self.format.as_deref().unwrap_or(usual);
        let format = match self.modbus_tcp {
            Some(_) => LineFormat::NETWORK,
            None => LineFormat::new(baud, format).map_err(|error| format!("{error}; in --format"))?,
        };
        let drives = self.addresses.0.iter();
        let drives = drives.map(|&address| DriveOptions::new(address, model.clone()));
        let mut line = SimulatedBusOptions::new("line", LineRules::of(protocol, format), drives.collect());
        line.endpoint = self.endpoint();
        Ok(line)
    }

    fn endpoint(&self) -> EndpointOptions {
        let served = self.listen.map(|listen| EndpointOptions::Tcp { listen });
        let modbus_tcp = self.modbus_tcp.map(|listen| EndpointOptions::ModbusTcp { listen });
        let udp = self.udp.map(|listen| EndpointOptions::Udp { listen });
        let dialled = self.dial.map(|server| EndpointOptions::Dial {
            server,
            text: self.id.clone(),
        });
        let port = self.port.clone().map(|path| EndpointOptions::Port { path });
        let chosen = port.or(served).or(modbus_tcp).or(udp).or(dialled);
        chosen.unwrap_or_else(|| EndpointOptions::Pty {
            link: self.link.clone(),
        })
    }

    /// The profile with this name, or in this file.
    fn profile_of(&self, known: &Profiles, problems: Vec<Problem>) -> Result<Arc<Profile>, String> {
        let all = |problems: Vec<Problem>| {
            let lines: Vec<String> = problems.iter().map(ToString::to_string).collect();
            lines.join("\n")
        };
        if !problems.is_empty() {
            return Err(all(problems));
        }
        if let Some(profile) = known.get(&self.profile) {
            return Ok(Arc::clone(profile));
        }
        if self.profile.ends_with(".toml") {
            let text = document::read_file(Path::new(&self.profile)).map_err(|problem| problem.to_string())?;
            let profile = Profile::parse_over(&self.profile, &text, false, known).map_err(all)?;
            return Ok(Arc::new(profile));
        }
        let near = nearest(&self.profile, known.names()).map(|name| format!("; did you mean `{name}`?"));
        let names: Vec<&str> = known.names().collect();
        let names = format!("; write a file *.toml, or one of {}", names.join(", "));
        Err(format!(
            "unknown profile `{}`; in --profile{}",
            self.profile,
            near.unwrap_or(names)
        ))
    }

    /// Protocol of the drives: as requested, or the first of the profile.
    fn protocol_of(&self, profile: &Profile, profiles: &Profiles) -> Result<Protocol, String> {
        let spoken: Vec<&str> = profile.protocols.iter().map(|protocol| protocol.name()).collect();
        match (self.protocol, profile.protocols.first()) {
            (Some(wanted), _) if !profile.protocols.contains(&wanted) => {
                let mut others = profiles.names().filter_map(|name| profiles.get(name));
                let other = others
                    .find(|other| other.simulator == profile.simulator && other.protocols.contains(&wanted))
                    .map(|other| format!("; for {} choose the profile `{}`", wanted.name(), other.name));
                Err(format!(
                    "drives of the profile `{}` speak {}; in --protocol{}",
                    profile.name,
                    spoken.join(", "),
                    other.unwrap_or_default()
                ))
            }
            (Some(wanted), _) => Ok(wanted),
            (None, first) => Ok(first.copied().unwrap_or(Protocol::ModbusRtu)),
        }
    }

    /// Applies the options that concern every line.
    fn applied_to(&self, mut line: SimulatedBusOptions) -> SimulatedBusOptions {
        line.faults = FaultPlan::new(self.fault.clone(), self.seed);
        // An explicit time applies to all drives.
        let turnaround = match self.speed {
            Speed::Max => Some(Duration::ZERO),
            Speed::Real => self.turnaround,
        };
        if let Some(turnaround) = turnaround {
            line.rules.turnaround = turnaround;
            for drive in &mut line.drives {
                drive.model.take_turnaround_of_line();
            }
        }
        line.rules.strict = !self.lenient;
        line.boards.leading_byte = self.n2_leading_byte;
        line.rules.delivery = if self.chunk == 0 {
            Delivery::Whole
        } else {
            Delivery::Chunks(self.chunk)
        };
        if self.speed == Speed::Max {
            line.rules.wire = Wire::Instant;
        }
        for drive in &mut line.drives {
            match (&mut drive.model, self.cx_address_offset) {
                (ModelOptions::Cx(cx), Some(offset)) => cx.offset = offset,
                (ModelOptions::Teco(teco), _) => teco.answer_check_error = self.teco_answer_check_error,
                _ => {}
            }
            drive.model.set_trip_register(true);
            if self.autopilot {
                drive.autopilot = Some(self.seed.wrapping_mul(1000).wrapping_add(u64::from(drive.address)));
            }
        }
        line
    }
}

#[cfg(test)]
mod tests;
