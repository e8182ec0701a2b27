//! Checks whether this gateway, with its configuration, is the one that the client expects.

use std::path::Path;

use axum::http::{HeaderMap, StatusCode};
use percent_encoding::percent_decode;

use super::messages::{EXPECT, Expected, ExpectedDrive, port_of};
use super::reached::Reached;
use crate::local::absolute;
use drivegate_core::plant::Plant;

/// Why a request is meant for another gateway, with the status of the reply.
type Unmet = (StatusCode, String);

/// Checks that this gateway is the one named by the header [`EXPECT`], if the header is present.
///
/// # Errors
/// If the client expects another gateway or another configuration.
pub(super) fn check(headers: &HeaderMap, plant: &Plant, reached: &Reached) -> Result<(), Unmet> {
    let Some(header) = headers.get(EXPECT) else {
        return Ok(());
    };
    let text: Vec<u8> = percent_decode(header.as_bytes()).collect();
    let expected = serde_json::from_slice(&text).map_err(|error| {
        (
            StatusCode::BAD_REQUEST,
            format!("the header {EXPECT} is invalid: {error}"),
        )
    })?;
    match expected {
        Expected::Configuration(file) => has_configuration(&file, reached),
        Expected::Drive(drive) => has_drive(&drive, plant),
    }
}

fn has_configuration(wanted: &Path, reached: &Reached) -> Result<(), Unmet> {
    let local = reached.local.as_ref();
    let other = match local.and_then(|local| local.control.as_ref()) {
        Some(control) if absolute(control.config()) == wanted => return Ok(()),
        Some(control) => format!("the gateway runs with {}", control.config().display()),
        None => "the gateway runs without a configuration file, or this is not its local socket".to_string(),
    };
    Err((StatusCode::MISDIRECTED_REQUEST, other))
}

/// The owner of the file's port is its gateway, or was before the file was edited; any other gateway is unrelated.
fn has_drive(expected: &ExpectedDrive, plant: &Plant) -> Result<(), Unmet> {
    let name = &expected.drive;
    let names_differ = (plant.gateway != expected.gateway).then(|| {
        format!(
            "the gateway is `{}`, the file has `{}`",
            plant.gateway, expected.gateway
        )
    });
    if !plant.buses.iter().any(|bus| port_of(&bus.image.spec) == expected.port) {
        let why = names_differ.unwrap_or_else(|| format!("the gateway has no bus on {}", expected.port));
        return Err((StatusCode::MISDIRECTED_REQUEST, why));
    }
    let other = |why: String| Err((StatusCode::PRECONDITION_FAILED, why));
    if let Some(why) = names_differ {
        return other(why);
    }
    let Some(drive) = plant.drive(name) else {
        return other(format!("the gateway has no drive `{name}`"));
    };
    let runs = ExpectedDrive::new(&plant.gateway, &drive.bus.image.spec, &drive.image.spec);
    let pairs = [
        ("port", runs.port, &expected.port),
        ("address", runs.address.to_string(), &expected.address.to_string()),
        ("profile", runs.profile, &expected.profile),
    ];
    match pairs.into_iter().find(|(_, runs, wanted)| runs != *wanted) {
        Some((what, runs, wanted)) => other(format!(
            "the gateway has `{name}` with {what} `{runs}`, the file with `{wanted}`"
        )),
        None => Ok(()),
    }
}
