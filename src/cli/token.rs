//! `drivegate token`: the access tokens of the HTTP server.

use std::io::Write;
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

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
        /// What it permits: read (status page, JSON), metrics, control (commands; not in this version). Repeatable.
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

fn add(path: &Path, name: &str, scopes: &[Scope]) -> Result<String, String> {
    let text = match path.exists() {
        true => read(path)?,
        false => String::new(),
    };
    let shown = path.display();
    let (token, secret) =
        Token::generate(name, scopes.to_vec()).map_err(|error| format!("{error}; {shown}; choose another name"))?;
    let separator = if text.is_empty() || text.ends_with('\n') {
        ""
    } else {
        "\n"
    };
    let text = format!("{text}{separator}{token}\n");
    Tokens::parse(&text).map_err(|(_, error)| format!("{error}; {shown}; choose another name"))?;
    write(path, &text)?;
    Ok(format!("{secret}\n"))
}

fn list(path: &Path) -> Result<String, String> {
    let tokens = tokens(path, &read(path)?)?;
    let mut table = report::table(["name", "scopes"]);
    for token in tokens.list() {
        let scopes: Vec<&str> = token.scopes.iter().map(|scope| scope.name()).collect();
        table.add_row([token.name.clone(), scopes.join(", ")]);
    }
    Ok(report::lines(&table))
}

fn remove(path: &Path, name: &str) -> Result<String, String> {
    let text = read(path)?;
    if !tokens(path, &text)?.list().iter().any(|token| token.name == name) {
        return Err(format!(
            "there is no token `{name}`; {}; `drivegate token list` shows them",
            path.display()
        ));
    }
    let others = text.lines().filter(|line| line.split_whitespace().next() != Some(name));
    let text: String = others.map(|line| format!("{line}\n")).collect();
    write(path, &text)?;
    Ok(String::new())
}

fn read(path: &Path) -> Result<String, String> {
    let shown = path.display();
    std::fs::read_to_string(path)
        .map_err(|error| format!("cannot read the token file: {error}; {shown}; check the path"))
}

fn tokens(path: &Path, text: &str) -> Result<Tokens, String> {
    Tokens::parse(text).map_err(|(line, error)| format!("{error}; {}:{line}; remove the line", path.display()))
}

/// Replaces the file as a whole, so that a gateway that reloads meanwhile reads the old one or the new one. Its
/// permissions stay; those of a new file are 0640.
fn write(path: &Path, text: &str) -> Result<(), String> {
    let shown = path.display();
    let failed = |error: std::io::Error| format!("cannot write the token file: {error}; {shown}; check the directory");
    let mut name = path.as_os_str().to_owned();
    name.push(".new");
    let new = PathBuf::from(name);
    let mode = std::fs::metadata(path).map_or(0o640, |metadata| metadata.permissions().mode() & 0o777);
    let mut options = std::fs::OpenOptions::new();
    let written = options
        .write(true)
        .create_new(true)
        .mode(mode)
        .open(&new)
        .and_then(|mut file| {
            file.write_all(text.as_bytes())?;
            file.sync_all()
        })
        .and_then(|()| std::fs::rename(&new, path));
    if written.is_err() && new.exists() {
        let _ = std::fs::remove_file(&new);
    }
    written.map_err(failed)
}
