//! `drivegate recordings`: lists, shows and exports recordings.

mod show;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use super::client::{Client, Gateway, GatewayRequest, encoded};
use super::failure::{Failure, Outcome};
use super::report;
use drivegate_core::history::{Entry, Recording, export, pcapng, recording, store};
use drivegate_model::document::nearest;

/// Lists, shows and exports recordings.
///
/// Reads the gateway's files; no gateway needs to run. With --url the gateway there is asked. A recording is given by its
/// id, or by the path of its file.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  drivegate recordings
  drivegate recordings list --url http://gateway:9488
  drivegate recordings show 20260302T074012.118Z-pump-1
  drivegate recordings export 20260302T074012.118Z-pump-1 --csv > trip.csv
  drivegate recordings export 20260302T074012.118Z-pump-1 --pcap --output trip.pcapng")]
pub(super) struct Args {
    #[command(flatten)]
    gateway: Gateway,
    /// Directory with recordings, instead of that of the configuration.
    #[arg(long, value_name = "DIR", global = true, conflicts_with = "url")]
    dir: Option<PathBuf>,
    #[command(subcommand)]
    action: Option<Action>,
}

#[derive(Debug, clap::Subcommand)]
enum Action {
    /// Lists the recordings, oldest first.
    #[command(after_help = "Example:\n  drivegate recordings list --json")]
    List {
        /// JSON instead of a table.
        #[arg(long)]
        json: bool,
    },
    /// Shows a recording.
    #[command(after_help = "Example:\n  drivegate recordings show 20260302T074012.118Z-pump-1")]
    Show {
        /// Id, or path of the file.
        id: String,
    },
    /// Exports a recording to another format.
    #[command(after_help = "Example:\n  drivegate recordings export 20260302T074012.118Z-pump-1 --csv > trip.csv")]
    Export(Export),
}

#[derive(Debug, clap::Args)]
#[command(group = clap::ArgGroup::new("form").required(true).args(["csv", "json", "pcap"]))]
struct Export {
    /// Id, or path of the file.
    id: String,
    /// The samples: one line each, one column per point.
    #[arg(long)]
    csv: bool,
    /// Everything as one JSON object.
    #[arg(long)]
    json: bool,
    /// The frames of the line as pcapng, each with a comment.
    #[arg(long)]
    pcap: bool,
    /// File to write [default: standard output].
    #[arg(long, short, value_name = "FILE")]
    output: Option<PathBuf>,
}

pub(super) fn run(args: &Args) -> Outcome {
    match &args.action {
        None => list(args, false),
        Some(Action::List { json }) => list(args, *json),
        Some(Action::Show { id }) => Ok(report::print(&show::text(&open(args, id)?))),
        Some(Action::Export(form)) => export(form, &open(args, &form.id)?),
    }
}

/// Words of the command that lists the recordings.
const LIST: &str = "recordings list";

/// The command that lists the recordings of this directory.
fn listing(args: &Args) -> String {
    let command = args.gateway.command(LIST);
    match &args.dir {
        Some(dir) => format!("{command} --dir {}", dir.display()),
        None => command,
    }
}

/// The directory of the recordings.
fn directory(args: &Args) -> Result<PathBuf, Failure> {
    if let Some(dir) = &args.dir {
        return Ok(dir.clone());
    }
    Ok(super::settings(args.gateway.config())?.recordings.dir)
}

fn entries(dir: &Path) -> Result<Vec<Entry>, Failure> {
    let unreadable = |error| format!("cannot read the recordings: {error}; {}; use sudo", dir.display());
    let (entries, faults) = store::list(dir).map_err(unreadable)?;
    for fault in faults {
        report::note(&fault.to_string());
    }
    Ok(entries)
}

fn list(args: &Args, json: bool) -> Outcome {
    let (entries, place) = match args.gateway.network() {
        Some(client) => (listed_by(&client)?, "at the gateway".to_string()),
        None => {
            let dir = directory(args)?;
            (entries(&dir)?, format!("in {}", dir.display()))
        }
    };
    if json {
        return Ok(report::json(&entries));
    }
    if entries.is_empty() {
        report::note(&format!("no recordings {place}"));
        return Ok(ExitCode::SUCCESS);
    }
    let mut table = report::table(["id", "trigger", "kB", "summary"]);
    for entry in entries {
        table.add_row([
            entry.id,
            entry.trigger.name().to_string(),
            entry.bytes.div_ceil(1000).to_string(),
            entry.summary,
        ]);
    }
    Ok(report::print(&report::lines(&table)))
}

/// The recordings listed by a gateway.
fn listed_by(client: &Client) -> Result<Vec<Entry>, Failure> {
    let asked = GatewayRequest::get("/api/v1/recordings");
    Ok(client.ask_now(&asked)?.accepted(&asked)?)
}

/// A recording fetched from a gateway.
fn fetched(client: &Client, gateway: &Gateway, id: &str) -> Result<Recording, Failure> {
    let path = format!("/api/v1/recordings/{}?format={}", encoded(id), recording::ENDING);
    let asked = GatewayRequest::get(path).if_refused(format!("choose one from `{}`", gateway.command(LIST)));
    let reply = client.ask_now(&asked)?;
    if !reply.status.is_success() {
        return Err(reply.refusal(&asked).into());
    }
    let parsed = Recording::parse(reply.bytes());
    Ok(parsed.map_err(|error| reply.strange(format!("unexpected reply ({error})")))?)
}

fn open(args: &Args, id: &str) -> Result<Recording, Failure> {
    let is_file = id.contains('/') || Path::new(id).is_file();
    if let Some(client) = args.gateway.network().filter(|_| !is_file) {
        return fetched(&client, &args.gateway, id);
    }
    let path = if is_file {
        PathBuf::from(id)
    } else {
        let dir = directory(args)?;
        let path = store::path_of(&dir, id);
        if !path.is_file() {
            return Err(unknown(args, &dir, id)?.into());
        }
        path
    };
    let unreadable = |error| format!("{error}; choose a recording from `{}`", listing(args));
    Ok(store::read(&path).map_err(unreadable)?)
}

fn unknown(args: &Args, dir: &Path, id: &str) -> Result<String, Failure> {
    let entries = entries(dir)?;
    let remedy = match nearest(id, entries.iter().map(|entry| entry.id.as_str())) {
        Some(near) => format!("did you mean `{near}`?"),
        None => format!("`{}` lists them", listing(args)),
    };
    Ok(format!("there is no recording `{id}`; {}; {remedy}", dir.display()))
}

fn export(form: &Export, recording: &Recording) -> Outcome {
    let bytes = match form {
        Export { csv: true, .. } => export::csv(recording).into_bytes(),
        Export { pcap: true, .. } => pcapng::pcapng(recording),
        _ => (export::json(recording) + "\n").into_bytes(),
    };
    match &form.output {
        None => Ok(report::print_bytes(&bytes)),
        Some(path) => {
            let written = fs::write(path, &bytes);
            written.map_err(|error| {
                format!(
                    "cannot write the export: {error}; {}; name another file",
                    path.display()
                )
            })?;
            Ok(ExitCode::SUCCESS)
        }
    }
}
