//! `drivegate user`: the users who may command over HTTP.

use std::io::{self, BufRead, IsTerminal, Read, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use rustix::termios::{LocalModes, OptionalActions, Termios, tcgetattr, tcsetattr};

use super::credentials_file::{CredentialsFile, with_line, without};
use super::{EXIT_FAILED, report};
use crate::north::http::{MAX_PASSWORD, User, Users};

/// Adds, lists and removes the users who may command over HTTP
///
/// The file is `users_file` of [http]; a running gateway reads it at a reload. It holds only an Argon2id hash of each
/// password.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    drivegate user add --file /etc/drivegate/users alice\n  \
    drivegate user list --file /etc/drivegate/users\n  \
    drivegate user remove --file /etc/drivegate/users alice")]
pub(super) struct Args {
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, clap::Subcommand)]
enum Action {
    /// Adds a user, or gives one another password. Asks for it on a terminal, else reads it from standard input.
    #[command(after_help = "Examples:\n  drivegate user add --file /etc/drivegate/users alice\n  \
        drivegate user add --file /etc/drivegate/users alice <password.txt")]
    Add {
        #[command(flatten)]
        file: UsersFile,
        /// Its name, for the login and the audit.
        name: String,
    },
    /// Prints the names.
    #[command(after_help = "Example:\n  drivegate user list --file /etc/drivegate/users")]
    List {
        #[command(flatten)]
        file: UsersFile,
    },
    /// Removes a user from the file. Its sessions end when the gateway reloads.
    #[command(after_help = "Example:\n  drivegate user remove --file /etc/drivegate/users alice")]
    Remove {
        #[command(flatten)]
        file: UsersFile,
        /// Its name.
        name: String,
    },
}

#[derive(Debug, clap::Args)]
struct UsersFile {
    /// The users file.
    #[arg(long = "file", value_name = "FILE")]
    path: PathBuf,
}

pub(super) fn run(args: &Args) -> ExitCode {
    let done = match &args.action {
        Action::Add { file, name } => add(&file.path, name),
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
        what: "users",
        path,
        mode: 0o600,
    }
}

fn add(path: &Path, name: &str) -> Result<String, String> {
    let shown = path.display();
    if path.exists() {
        // Before a password is asked for.
        users(path, &file(path).read()?)?;
    }
    let password = password()?;
    let user = User::new(name, &password).map_err(|error| format!("{error}; {shown}; choose another"))?;
    let line = user.to_string();
    let mut is_known = false;
    file(path).change(|text| {
        is_known = has(&users(path, text)?, name);
        let replaced = |old: &str| match old.split_whitespace().next() == Some(name) {
            true => format!("{line}\n"),
            false => format!("{old}\n"),
        };
        let text = match is_known {
            false => with_line(text, &line),
            true => text.lines().map(replaced).collect(),
        };
        Users::parse(&text).map_err(|(_, error)| format!("{error}; {shown}; remove one"))?;
        Ok(text)
    })?;
    Ok(match is_known {
        true => format!("{name} has another password; reload the gateway\n"),
        false => format!("{name} was added; reload the gateway\n"),
    })
}

fn list(path: &Path) -> Result<String, String> {
    let names = users(path, &file(path).read()?)?;
    let lines = names.list().iter().map(|user| format!("{}\n", user.name));
    Ok(lines.collect())
}

fn remove(path: &Path, name: &str) -> Result<String, String> {
    file(path).change(|text| {
        if has(&users(path, text)?, name) {
            return Ok(without(text, name));
        }
        Err(format!(
            "there is no user `{name}`; {}; `drivegate user list` shows them",
            path.display()
        ))
    })?;
    Ok(format!("{name} was removed; reload the gateway\n"))
}

fn has(users: &Users, name: &str) -> bool {
    users.list().iter().any(|user| user.name == name)
}

fn users(path: &Path, text: &str) -> Result<Users, String> {
    Users::parse(text).map_err(|(line, error)| format!("{error}; {}:{line}; remove the line", path.display()))
}

/// The password: typed twice without echo on a terminal, else the first line of standard input.
fn password() -> Result<String, String> {
    let failed = |error: io::Error| format!("cannot read the password: {error}; standard input; type it or pipe it in");
    if !io::stdin().is_terminal() {
        return piped().map_err(failed);
    }
    let first = typed("Password: ").map_err(failed)?;
    let again = typed("Again: ").map_err(failed)?;
    match first == again {
        true => Ok(first),
        false => Err("the passwords differ; standard input; try again".to_string()),
    }
}

/// The first line, of which a password has at most so many bytes.
fn piped() -> io::Result<String> {
    let mut line = String::new();
    let most = u64::try_from(MAX_PASSWORD + 2).unwrap_or(u64::MAX);
    io::stdin().lock().take(most).read_line(&mut line)?;
    Ok(line.trim_end_matches(['\r', '\n']).to_string())
}

fn typed(prompt: &str) -> io::Result<String> {
    eprint!("{prompt}");
    io::stderr().flush()?;
    let hidden = Hidden::new()?;
    let line = piped();
    drop(hidden);
    eprintln!();
    line
}

/// The terminal does not show what is typed until this is dropped.
struct Hidden(Termios);

impl Hidden {
    fn new() -> io::Result<Hidden> {
        let before = tcgetattr(io::stdin())?;
        let mut silent = before.clone();
        silent.local_modes.remove(LocalModes::ECHO);
        tcsetattr(io::stdin(), OptionalActions::Flush, &silent)?;
        Ok(Hidden(before))
    }
}

impl Drop for Hidden {
    fn drop(&mut self) {
        // Nothing else can be done about a terminal that has gone.
        let _ = tcsetattr(io::stdin(), OptionalActions::Flush, &self.0);
    }
}
