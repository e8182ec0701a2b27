//! The ways in which a command fails.

use std::process::ExitCode;

use super::{EXIT_CONFIG, EXIT_FAILED, EXIT_USAGE, report};
use drivegate_http::messages::ErrorReply;
use drivegate_model::document::Problem;

/// How a command ends: an exit code, or why it failed.
pub(super) type Outcome = Result<ExitCode, Failure>;

/// Why a command failed.
#[derive(Debug)]
pub(super) enum Failure {
    /// The work failed: contains the error, its place and the remedy.
    Failed(String),
    /// The command line is wrong: the error and the remedy.
    Misused(String),
    /// A configuration or a profile has these problems.
    Invalid(Vec<Problem>),
    /// The error was already reported; contains the exit code.
    Reported(u8),
}

impl<T: Into<String>> From<T> for Failure {
    fn from(message: T) -> Failure {
        Failure::Failed(message.into())
    }
}

impl Failure {
    /// Prints the failure to stderr.
    pub(super) fn report(self) -> ExitCode {
        match self {
            Failure::Failed(message) => report::failed(&message),
            Failure::Misused(message) => {
                report::error(&message);
                ExitCode::from(EXIT_USAGE)
            }
            Failure::Invalid(problems) => {
                report::errors(&problems);
                ExitCode::from(EXIT_CONFIG)
            }
            Failure::Reported(code) => ExitCode::from(code),
        }
    }
}

/// With `json`, a refusal is also printed as a document on stdout, besides its message on stderr.
pub(super) fn documented(json: bool, outcome: Outcome) -> Outcome {
    if let (true, Err(Failure::Failed(why) | Failure::Misused(why))) = (json, &outcome) {
        report::json(&ErrorReply::new(why));
    }
    outcome
}

/// The outcome of a command that did its work and reported a finding.
pub(super) fn negative() -> Outcome {
    Ok(ExitCode::from(EXIT_FAILED))
}
