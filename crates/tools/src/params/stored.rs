//! `drivegate params list` and `params show`: readings that are stored, by this configuration or by a gateway.

use std::path::Path;
use std::process::ExitCode;

use super::super::client::{Client, Gateway, GatewayRequest, encoded};
use super::super::failure::{Failure, Outcome};
use super::super::{printable, report, settings};
use super::{built_in, names, read_written};
use drivegate_core::parameters::{ParameterFile, Store};
use drivegate_http::messages::StoredReading;
use drivegate_model::drive::parameters::RawValue;

/// The parameter store of the configuration.
fn store(config: &Path) -> Result<Store, Failure> {
    Ok(Store::new(settings(config)?.params.dir))
}

pub(super) fn list(gateway: &Gateway, drive: Option<&str>, json: bool) -> Outcome {
    let (readings, place) = match gateway.network() {
        Some(client) => (listed_by(&client, drive)?, "the gateway".to_string()),
        None => listed_here(gateway.config(), drive)?,
    };
    if json {
        return Ok(report::json(&readings));
    }
    let mut table = report::table(["drive", "time", "family", "application", "missing", "file"]);
    let mut rows = 0;
    for reading in readings {
        if let Some(why) = reading.error {
            report::warning(&printable::line(&why));
            continue;
        }
        rows += 1;
        let missing = reading.missing.unwrap_or_default().to_string();
        let [time, family, application] =
            [reading.time, reading.family, reading.application].map(|cell| printable::line(&cell.unwrap_or_default()));
        table.add_row([
            printable::line(&reading.drive),
            time,
            family,
            application,
            missing,
            printable::line(&reading.file),
        ]);
    }
    if rows == 0 {
        report::note(&format!("no readings are kept in {place}"));
        return Ok(ExitCode::SUCCESS);
    }
    Ok(report::print(&report::lines(&table)))
}

/// The readings listed by a gateway.
fn listed_by(client: &Client, drive: Option<&str>) -> Result<Vec<StoredReading>, Failure> {
    let query = drive.map(|drive| format!("?drive={}", encoded(drive)));
    let asked = GatewayRequest::get(format!("/api/v1/params{}", query.unwrap_or_default()));
    Ok(client.ask_now(&asked)?.accepted(&asked)?)
}

/// The readings of the drives in the configuration, and the directory of the readings.
fn listed_here(config: &Path, drive: Option<&str>) -> Result<(Vec<StoredReading>, String), Failure> {
    let store = store(config)?;
    let dir = store.dir().display().to_string();
    let kept = store.list().map_err(|error| {
        format!("cannot read the readings: {error}; {dir}; make it a directory that you may read, or use sudo")
    })?;
    let wanted = kept.iter().filter(|kept| drive.is_none_or(|drive| kept.drive == drive));
    let readings = wanted.map(|kept| StoredReading::of(kept, kept.path.display().to_string()));
    Ok((readings.collect(), dir))
}

/// The last reading of a drive that a gateway has.
fn last_of(client: &Client, gateway: &Gateway, drive: &str) -> Result<ParameterFile, Failure> {
    let path = format!("/api/v1/drives/{}/params?format=file", encoded(drive));
    let asked = GatewayRequest::get(path).if_refused(format!(
        "read it with `{}`",
        gateway.command(&format!("params read {drive}"))
    ));
    let reply = client.ask_now(&asked)?;
    if !reply.status.is_success() {
        return Err(reply.refusal(&asked).into());
    }
    let parsed = ParameterFile::parse(&reply.text());
    Ok(parsed.map_err(|why| reply.strange(format!("unexpected reply ({why})")))?)
}

pub(super) fn show(gateway: &Gateway, of: &str, names: Option<&Path>) -> Outcome {
    let names = self::names(names)?;
    let file = match (Path::new(of).is_file(), gateway.network()) {
        (true, _) => read_written(Path::new(of))?,
        (false, Some(client)) => last_of(&client, gateway, of)?,
        (false, None) => {
            let store = store(gateway.config())?;
            let last = store.latest(of).map_err(|why| format!("{why}; correct or remove it"))?;
            last.ok_or_else(|| {
                format!(
                    "no reading of `{of}` is stored; {}; read it with `{}`",
                    store.dir().display(),
                    gateway.command(&format!("params read {of}"))
                )
            })?
        }
    };
    let file = match names {
        Some(names) => {
            let profile = built_in(&file.family)?;
            file.named(&profile, &names)
        }
        None => file,
    };
    let mut table = report::table(["parameter", "raw", "value and name"]);
    for (id, entry) in &file.values {
        let (raw, text) = match &entry.value {
            Ok(RawValue::Word(word)) => (word.to_string(), entry.note.clone()),
            Ok(RawValue::Float(bits)) => (f32::from_bits(*bits).to_string(), entry.note.clone()),
            Err(why) => (
                "?".to_string(),
                format!("{} (not read: {why})", entry.note).trim_start().to_string(),
            ),
        };
        table.add_row([id.to_string(), raw, text]);
    }
    let counters = match file.counters.as_str() {
        "" => String::new(),
        counters => format!("counted by the drive: {counters}\n"),
    };
    let head = format!(
        "{} ({}), read {}; identification: {}; {}\n{counters}",
        file.drive,
        file.family,
        file.time,
        file.identification,
        file.application()
    );
    Ok(report::print(&(head + &report::lines(&table))))
}
