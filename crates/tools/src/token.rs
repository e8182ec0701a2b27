//! `drivegate token`: the access tokens of the HTTP server.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use super::credentials_file::{CredentialsFile, with_line, without};
use super::{EXIT_FAILED, report};
use crate::north::http::{Scope, Token, Tokens};

/// Adds, lists and removes access tokens of the HTTP server
///
/// The file is `tokens_file` of [http]; a running gateway reads it at a reload. It holds only the SHA-256 of each token.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    drivegate token add --file /etc/drivegate/tokens --scope metrics prometheus >prometheus.token\n  \
    drivegate token list --file /etc/drivegate/tokens\n  \
    drivegate token remove --file /etc/drivegate/tokens prometheus")]
pub(super) struct Args {
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, clap::Subcommand)]
enum Action {
    /// Adds a token to the file and prints it; it cannot be shown again.
    #[command(
        after_help = "Example:\n  drivegate token add --file /etc/drivegate/tokens --scope read panel >panel.token"
    )]
    Add {
        #[command(flatten)]
        file: TokenFile,
        /// What it permits: read (status page, JSON), metrics, control (nothing: commands are given by users). Repeatable.
        #[arg(long = "scope", value_name = "SCOPE", required = true)]
        scopes: Vec<Scope>,
        /// Its name, for the file and the log.
        name: String,
    },
    /// Prints names and scopes.
    #[command(after_help = "Example:\n  drivegate token list --file /etc/drivegate/tokens")]
    List {
        #[command(flatten)]
        file: TokenFile,
    },
    /// Removes a token from the file.
    #[command(after_help = "Example:\n  drivegate token remove --file /etc/drivegate/tokens panel")]
    Remove {
        #[command(flatten)]
        file: TokenFile,
        /// Its name.
        name: String,
    },
}

#[derive(Debug, clap::Args)]
struct TokenFile {
    /// The token file.
    #[arg(long = "file", value_name = "FILE")]
    path: PathBuf,
}

pub(super) fn run(args: &Args) -> ExitCode {
    let done = match &args.action {
        Action::Add { file, scopes, name } => add(&file.path, name, scopes),
        Action::List { file } => list(&file.path),
        Action::Remove { file, name } => remove(&file.path, name),
    };
    match done {
        Ok(text) => report::print(&text),
        Err(message) => {
            report::error(&message);
            ExitCode::from(EXIT_FAILED)
        }
    }
}

fn file(path: &Path) -> CredentialsFile<'_> {
    CredentialsFile {
        what: "token",
        path,
        mode: 0o640,
    }
}

fn add(path: &Path, name: &str, scopes: &[Scope]) -> Result<String, String> {
    let shown = path.display();
    let (token, secret) =
        Token::generate(name, scopes.to_vec()).map_err(|error| format!("{error}; {shown}; choose another name"))?;
    file(path).change(|text| {
        let text = with_line(text, &token.to_string());
        Tokens::parse(&text).map_err(|(_, error)| format!("{error}; {shown}; choose another name"))?;
        Ok(text)
    })?;
    Ok(format!("{secret}\n"))
}

fn list(path: &Path) -> Result<String, String> {
    let tokens = tokens(path, &file(path).read()?)?;
    let mut table = report::table(["name", "scopes"]);
    for token in tokens.list() {
        let scopes: Vec<&str> = token.scopes.iter().map(|scope| scope.name()).collect();
        table.add_row([token.name.clone(), scopes.join(", ")]);
    }
    Ok(report::lines(&table))
}

fn remove(path: &Path, name: &str) -> Result<String, String> {
    file(path).change(|text| {
        if tokens(path, text)?.list().iter().any(|token| token.name == name) {
            return Ok(without(text, name));
        }
        Err(format!(
            "there is no token `{name}`; {}; `drivegate token list` shows them",
            path.display()
        ))
    })?;
    Ok(String::new())
}

fn tokens(path: &Path, text: &str) -> Result<Tokens, String> {
    Tokens::parse(text).map_err(|(line, error)| format!("{error}; {}:{line}; remove the line", path.display()))
}
