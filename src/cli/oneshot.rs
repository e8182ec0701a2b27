//! What `read` and `write` share: the drive they are about, and the way to it.
//!
//! A running gateway owns the line, so a command asks it; only where none runs does the command open the port itself,
//! with the gateway's own bus.

pub(super) mod alone;
pub(super) mod reason;
pub(super) mod remote;

use std::net::SocketAddr;
use std::path::Path;
use std::process::ExitCode;

use super::{EXIT_CONFIG, EXIT_USAGE, report};
use crate::cache::DriveSpec;
use crate::config::{BusSettings, Settings, environment};
use crate::document::nearest;
use crate::drive::{Point, Sample, Value};

/// The drive that a command is about.
#[derive(Debug)]
pub(super) struct Target {
    pub(super) settings: Settings,
    pub(super) bus: BusSettings,
    pub(super) spec: DriveSpec,
}

/// Reads the configuration and finds the drive in it; what is wrong was told when there is none.
pub(super) fn target(config: &Path, drive: &str) -> Result<Target, ExitCode> {
    let loaded = Settings::load(config, environment());
    report::errors(&loaded.errors);
    let settings = loaded.settings.ok_or(ExitCode::from(EXIT_CONFIG))?;
    let found = settings.buses.iter().find_map(|bus| {
        let spec = bus.drives.iter().find(|spec| spec.name == drive)?;
        Some((bus.clone(), spec.clone()))
    });
    let Some((bus, spec)) = found else {
        let names = || {
            settings
                .buses
                .iter()
                .flat_map(|bus| &bus.drives)
                .map(|spec| spec.name.as_str())
        };
        let file = config.display();
        let message = match nearest(drive, names()) {
            Some(near) => format!("there is no drive `{drive}`; {file}; did you mean `{near}`?"),
            None => format!(
                "there is no drive `{drive}`; {file}; there are {}",
                names().collect::<Vec<_>>().join(", ")
            ),
        };
        report::error(&message);
        return Err(ExitCode::from(EXIT_USAGE));
    };
    Ok(Target { settings, bus, spec })
}

impl Target {
    /// Where the configured gateway listens for the drive's bus, without TLS.
    pub(super) fn listens(&self) -> Vec<SocketAddr> {
        let bus = &self.bus.spec.name;
        let listeners = self.settings.modbus_tcp.iter().flat_map(|options| &options.listeners);
        let shows = |buses: &Option<Vec<String>>| buses.as_ref().is_none_or(|buses| buses.contains(bus));
        let mut showing: Vec<_> = listeners.filter(|listener| shows(&listener.buses)).collect();
        // One that takes writes first.
        showing.sort_by_key(|listener| listener.write.is_empty());
        showing
            .into_iter()
            .flat_map(|listener| listener.listen.clone())
            .collect()
    }

    /// Index of the point of that name.
    ///
    /// # Errors
    /// What to tell when there is none.
    pub(super) fn point(&self, name: &str) -> Result<usize, String> {
        let profile = &self.spec.profile;
        profile.point_index(name).ok_or_else(|| {
            let near = nearest(name, profile.points.iter().map(|p| p.name.as_str()));
            let remedy = near.map_or_else(
                || format!("`drivegate profiles show {}` lists them", profile.name),
                |near| format!("did you mean `{near}`?"),
            );
            format!(
                "profile `{}` has no point `{name}`; command line; {remedy}",
                profile.name
            )
        })
    }
}

/// A value for people: an enumeration with its meaning.
pub(super) fn shown(point: &Point, value: Value) -> String {
    match point.text_of(value) {
        Some(text) => format!("{value} ({text})"),
        None => value.to_string(),
    }
}

/// A point as a command shows it.
#[derive(Debug, Clone, serde::Serialize)]
pub(super) struct Row {
    pub(super) point: String,
    pub(super) value: serde_json::Value,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) text: Option<String>,
    pub(super) unit: String,
    pub(super) quality: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) why: Option<String>,
}

impl Row {
    /// The point with what is known of it; `why` tells of a value that is not good.
    pub(super) fn new(point: &Point, sample: &Sample, why: Option<String>) -> Row {
        let value = sample.good();
        Row {
            point: point.name.clone(),
            value: crate::cache::value_or_null(value),
            text: value.and_then(|v| point.text_of(v).map(ToString::to_string)),
            unit: point.unit.clone(),
            quality: sample.quality.name().to_string(),
            why: why.filter(|_| value.is_none()),
        }
    }

    /// Whether it has a value.
    pub(super) fn is_good(&self) -> bool {
        !self.value.is_null()
    }
}
