//! The common part of commands for one drive: finds the drive and its gateway.
//!
//! A running gateway owns the line, so a command sends its request to the gateway, at its local socket or by
//! `--url`. Only if no gateway runs does the command start the gateway's own bus in this process and send the
//! request there. Both ways use the same routes, so the answers are equal.

mod conversation;
mod direct;
mod parameters;

use std::sync::Arc;

use self::conversation::Conversation;
pub(super) use self::direct::Needs;
use super::client::{Client, ClientError, Door, Gateway, GatewayRequest, NotFound, Reply, encoded};
use super::failure::Failure;
use super::report;
use drivegate_core::process_image::DriveSpec;
use drivegate_gateway::config::{BusSettings, Settings};
use drivegate_http::local::SocketPath;
use drivegate_http::messages::{Expected, ExpectedDrive};
use drivegate_model::document::{candidates, nearest};
use drivegate_model::drive::{PointIndex, Profile};

// The options that select the drive of a command.
#[derive(Debug, clap::Args)]
pub(super) struct OneDrive {
    #[command(flatten)]
    gateway: Gateway,
    /// Name of the drive.
    #[arg(value_name = "DRIVE")]
    pub(super) name: String,
}

impl OneDrive {
    /// Finds the drive and its gateway.
    pub(super) fn target(&self) -> Result<Target, Failure> {
        target(&self.gateway, &self.name)
    }
}

/// The drive that a command is about, and the gateway to ask.
#[derive(Debug)]
pub(super) struct Target {
    pub(super) drive: String,
    client: Client,
    gateway: Gateway,
    /// The drive in the configuration; `None` with `--url`: the gateway knows the drive, and there is no line here.
    configured: Option<Box<Configured>>,
}

/// The drive according to the configuration.
#[derive(Debug, Clone)]
struct Configured {
    settings: Settings,
    bus: BusSettings,
    spec: DriveSpec,
}

/// The way that a request took.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum RequestRoute {
    /// Through the running gateway.
    Gateway,
    /// Directly on the line.
    Direct,
}

/// Finds the drive in the configuration, unless the gateway is given by its address.
pub(super) fn target(gateway: &Gateway, drive: &str) -> Result<Target, Failure> {
    let drive_name = drive.to_string();
    if let Some(client) = gateway.network() {
        return Ok(Target {
            drive: drive_name,
            client,
            gateway: gateway.clone(),
            configured: None,
        });
    }
    let config = gateway.config();
    let settings = super::settings(config)?;
    let found = settings.buses.iter().find_map(|bus| {
        let spec = bus.drives.iter().find(|spec| spec.name == drive)?;
        Some((bus.clone(), spec.clone()))
    });
    let Some((bus, spec)) = found else {
        let drives = || settings.buses.iter().flat_map(|bus| &bus.drives);
        let names = || drives().map(|spec| spec.name.as_str());
        let file = config.display();
        return Err(Failure::Misused(match nearest(drive, names()) {
            Some(near) => format!("there is no drive `{drive}`; {file}; did you mean `{near}`?"),
            None => {
                let names = names().collect::<Vec<_>>().join(", ");
                format!("there is no drive `{drive}`; {file}; known drives: {names}")
            }
        }));
    };
    let expected = ExpectedDrive::new(&settings.gateway, &bus.spec, &spec);
    Ok(Target {
        drive: drive_name,
        client: Client::for_socket(&settings.socket, Expected::Drive(expected)),
        gateway: gateway.clone(),
        configured: Some(Box::new(Configured { settings, bus, spec })),
    })
}

impl Target {
    /// The profile of the drive; `None` if this command does not know it.
    pub(super) fn profile(&self) -> Option<&Arc<Profile>> {
        self.configured.as_ref().map(|configured| &configured.spec.profile)
    }

    /// Remedy if the drive does not reply to its gateway.
    pub(super) fn remedy_for_silence(&self) -> String {
        let bus = self.configured.as_ref().map(|configured| &configured.bus.spec.name);
        let diagnose = bus.map_or_else(|| "diagnose".to_string(), |bus| format!("diagnose {bus}"));
        let command = self.gateway.command(&diagnose);
        format!("check power, wiring and address; `{command}` shows what is wrong with the line")
    }

    /// The command that shows the restore of this drive.
    fn restore_command(&self) -> String {
        self.gateway.command(&format!("params restore --look {}", self.drive))
    }

    /// Path of `what` about this drive in the API.
    pub(super) fn path(&self, what: &str) -> String {
        format!("/api/v1/drives/{}/{what}", encoded(&self.drive))
    }

    /// Sends the request to the running gateway.
    ///
    /// # Errors
    /// If there is no reply; contains the reason as a message.
    pub(super) fn ask_gateway(&self, asked: &GatewayRequest) -> Result<Reply, String> {
        super::runtime()?
            .block_on(self.client.ask(asked))
            .map_err(|error| match (error, &self.configured) {
                (ClientError::NotFound(missed), Some(configured)) => {
                    let why = configured.not_found_text(&missed, self.client.doors());
                    format!("{why}; the local socket; {}", missed.remedy())
                }
                (error, _) => error.to_string(),
            })
    }

    /// Sends the request to the running gateway or, if there is none, to a gateway's parts in this process, after
    /// the bus has read the values that the request `needs`.
    ///
    /// # Errors
    /// If there is no reply; contains the reason as a message.
    pub(super) fn ask(&self, asked: &GatewayRequest, needs: Needs<'_>) -> Result<(Reply, RequestRoute), String> {
        super::without_waiting_for_threads(async {
            let (conversation, reply) = Conversation::begin(self, asked, needs).await?;
            let way = conversation.way();
            conversation.end().await;
            Ok((reply, way))
        })
    }
}

/// Index of the point of that name.
///
/// # Errors
/// If the profile has no such point; contains the message.
pub(super) fn point(profile: &Profile, name: &str) -> Result<PointIndex, String> {
    profile.point_index(name).ok_or_else(|| {
        let remedy = match candidates(name, profile.points.iter().map(|p| p.name.as_str())).as_slice() {
            [] => format!("`drivegate profiles show {}` lists them", profile.name),
            near => format!("did you mean `{}`?", near.join("`, `")),
        };
        format!(
            "profile `{}` has no point `{name}`; command line; {remedy}",
            profile.name
        )
    })
}

impl Configured {
    /// Why no gateway was found, to be reported if the port cannot be opened either.
    ///
    /// # Errors
    /// If a gateway may be running although its socket cannot be opened: the line must not be used then.
    fn not_found(&self, missed: &NotFound, doors: &[Door]) -> Result<String, String> {
        // A serial port is locked by its owner, but a device server would allow two masters on the line.
        if !missed.closed.is_empty() && self.bus.spec.port.contains("://") {
            return Err(format!(
                "{}; bus `{}`; use sudo, or join the group of the socket",
                missed.closed.join(", "),
                self.bus.spec.name
            ));
        }
        if !missed.others.is_empty() {
            let others = missed.others.join(", ");
            report::note(&format!("{others}; the command opens the port itself"));
        }
        Ok(self.not_found_text(missed, doors))
    }

    fn not_found_text(&self, missed: &NotFound, doors: &[Door]) -> String {
        let reasons: Vec<&str> = missed.closed.iter().chain(&missed.others).map(String::as_str).collect();
        match &self.settings.socket {
            _ if !reasons.is_empty() => reasons.join(", "),
            SocketPath::Off => "`socket` of [gateway] is off, so a running gateway cannot be asked".to_string(),
            SocketPath::At(path) => format!("no gateway listens at {}", path.display()),
            SocketPath::Default => {
                let sockets = doors.iter().filter_map(|door| match door {
                    Door::Socket(path) => path.parent(),
                    _ => None,
                });
                let mut directories: Vec<String> = sockets.map(|dir| dir.display().to_string()).collect();
                directories.dedup();
                format!("no gateway listens in {}", directories.join(" or "))
            }
        }
    }
}
