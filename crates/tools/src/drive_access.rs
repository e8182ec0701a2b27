//! What `read` and `write` share: the drive they are about, and the way to it.
//!
//! A running gateway owns the line, so a command asks it through its local socket; only where none runs does the command
//! open the port itself, with the gateway's own bus. Either way the same function answers, so the answers are the same.

mod direct;
mod gateway;
mod parameters;

use std::path::Path;
use std::process::ExitCode;

use self::direct::Direct;
use super::{EXIT_CONFIG, EXIT_USAGE, report};
use crate::config::{BusSettings, LogFormat, LogSettings, Settings, environment};
use crate::document::{candidates, nearest};
use crate::north::local::protocol::{Expected, Outcome, Request};
use crate::process_image::DriveSpec;

/// The drive that a command is about.
#[derive(Debug, Clone)]
pub(super) struct Target {
    pub(super) settings: Settings,
    pub(super) bus: BusSettings,
    pub(super) spec: DriveSpec,
}

/// Which way a request went.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Way {
    /// Through the running gateway.
    Gateway,
    /// On the line itself.
    Direct,
}

/// Reads the configuration and finds the drive in it; an exit code when there is none, which was reported.
pub(super) fn target(config: &Path, drive: &str) -> Result<Target, ExitCode> {
    let loaded = Settings::load(config, environment());
    report::errors(&loaded.errors);
    let settings = loaded.settings.ok_or(ExitCode::from(EXIT_CONFIG))?;
    let found = settings.buses.iter().find_map(|bus| {
        let spec = bus.drives.iter().find(|spec| spec.name == drive)?;
        Some((bus.clone(), spec.clone()))
    });
    let Some((bus, spec)) = found else {
        let drives = || settings.buses.iter().flat_map(|bus| &bus.drives);
        let names = || drives().map(|spec| spec.name.as_str());
        let file = config.display();
        report::error(&match nearest(drive, names()) {
            Some(near) => format!("there is no drive `{drive}`; {file}; did you mean `{near}`?"),
            None => {
                let names = names().collect::<Vec<_>>().join(", ");
                format!("there is no drive `{drive}`; {file}; known drives: {names}")
            }
        });
        return Err(ExitCode::from(EXIT_USAGE));
    };
    Ok(Target { settings, bus, spec })
}

impl Target {
    /// Index of the point of that name.
    ///
    /// # Errors
    /// The message when there is none.
    pub(super) fn point(&self, name: &str) -> Result<usize, String> {
        let profile = &self.spec.profile;
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

    /// What a gateway must run with to be the one of this configuration.
    pub(super) fn expected(&self) -> Expected {
        Expected::new(&self.settings.gateway, &self.bus.spec, &self.spec)
    }

    /// Sends the request to the running gateway.
    ///
    /// # Errors
    /// Why there is no outcome, as a message.
    pub(super) fn ask_gateway(&self, request: &Request) -> Result<Outcome, String> {
        let asked = super::runtime()?.block_on(gateway::ask(self, request))?;
        asked.map_err(|not_found| format!("{}; the local socket; start the gateway", not_found.0))
    }

    /// Sends the request to the running gateway or, where there is none, carries it out on the line.
    ///
    /// # Errors
    /// Why there is no outcome, as a message.
    pub(super) fn ask(&self, request: &Request) -> Result<(Outcome, Way), String> {
        super::runtime()?.block_on(async {
            let not_found = match gateway::ask(self, request).await? {
                Ok(outcome) => return Ok((outcome, Way::Gateway)),
                Err(not_found) => not_found,
            };
            log_audit_only();
            let direct = Direct::start(self, &not_found).await?;
            let outcome = direct.ask(request).await;
            direct.stop().await;
            Ok((outcome, Way::Direct))
        })
    }
}

/// The command reports what happens itself; of the log only the audit is left.
fn log_audit_only() {
    super::log::start_in_order(&LogSettings {
        level: "off,audit=info".to_string(),
        format: LogFormat::Auto,
    });
}
