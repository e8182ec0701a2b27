//! `drivegate schema`: JSON Schema of the configuration.

use super::failure::Outcome;
use super::report;
use drivegate_gateway::config::schema;

/// Prints the JSON Schema (draft 2020-12) of the configuration, for editors and tools.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  drivegate schema > drivegate.schema.json\n\n\
    An editor with a TOML language server uses it when the first line of the configuration is\n  \
    #:schema ./drivegate.schema.json")]
pub(super) struct Args {}

pub(super) fn run(_: &Args) -> Outcome {
    Ok(report::print(&format!("{:#}\n", schema())))
}
