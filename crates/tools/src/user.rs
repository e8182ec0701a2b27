//! `drivegate user`: the users who may command over HTTP.

use std::io::{self, BufRead, IsTerminal, Read, Write};
use std::path::Path;

use rustix::termios::{LocalModes, OptionalActions, Termios, tcgetattr, tcsetattr};

use super::credentials_file::{CredentialsFile, Filed};
use super::failure::Outcome;
use super::report;
use drivegate_http::{MAX_PASSWORD, User};

/// Adds, lists and removes the users who may command over HTTP
///
/// The file is `users_file` of [http]; a running gateway reads it at a reload. It contains only an Argon2id hash of
/// each password.
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
    /// Adds a user, or changes a user's password. Asks for it on a terminal, else reads it from standard input.
    #[command(after_help = "Examples:\n  drivegate user add --file /etc/drivegate/users alice\n  \
        drivegate user add --file /etc/drivegate/users alice <password.txt")]
    Add {
        #[command(flatten)]
        file: UsersFile,
        /// Name of the user, for the login and the audit.
        name: String,
    },
    /// Prints the user names.
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
        /// Name of the user.
        name: String,
    },
}

type UsersFile = CredentialsFile<User>;

impl Filed for User {
    const FILE: &'static str = "users";
    const MODE: u32 = 0o640;
}

pub(super) fn run(args: &Args) -> Outcome {
    let text = match &args.action {
        Action::Add { file, name } => add(file, name),
        Action::List { file } => list(file),
        Action::Remove { file, name } => {
            let removed = file.remove(name);
            removed.map(|()| format!("{name} was removed; reload the gateway\n"))
        }
    };
    Ok(report::print(&text?))
}

fn add(file: &UsersFile, name: &str) -> Result<String, String> {
    let remedy = if file.path.exists() {
        // The file is checked before the password prompt.
        file.list()?;
        String::new()
    } else {
        file.remedy()
    };
    let user =
        User::new(name, &password()?).map_err(|error| format!("{error}; {}; choose another", file.path.display()))?;
    Ok(if file.put(&user, true)? {
        format!("{name} has a new password; reload the gateway\n")
    } else {
        format!("{name} was added; reload the gateway\n{remedy}{}", lines(&file.path))
    })
}

/// The lines of the configuration that let users of that file command.
fn lines(file: &Path) -> String {
    let file = std::path::absolute(file).unwrap_or_else(|_| file.to_path_buf());
    format!(
        "its configuration needs, with TLS (`drivegate certificate new`) or `listen` on the loopback:\n\
         [http]\ncommands = true\nusers_file = {:?}\n",
        file.display().to_string()
    )
}

fn list(file: &UsersFile) -> Result<String, String> {
    let users = file.list()?;
    Ok(users.list().iter().map(|user| format!("{}\n", user.name)).collect())
}

/// The password: typed twice without echo on a terminal, else the first line of standard input.
fn password() -> Result<String, String> {
    let failed = |error: io::Error| format!("cannot read the password: {error}; standard input; type it or pipe it in");
    if !io::stdin().is_terminal() {
        return piped().map_err(failed);
    }
    let first = typed("Password: ").map_err(failed)?;
    let again = typed("Again: ").map_err(failed)?;
    if first == again {
        Ok(first)
    } else {
        Err("the passwords differ; standard input; try again".to_string())
    }
}

/// The first line; a password has at most this number of bytes.
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
        // If the terminal no longer exists, nothing else can be done.
        let _ = tcsetattr(io::stdin(), OptionalActions::Flush, &self.0);
    }
}
