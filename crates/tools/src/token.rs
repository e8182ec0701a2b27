//! `drivegate token`: the access tokens of the HTTP server.

use super::credentials_file::{CredentialsFile, Filed};
use super::failure::Outcome;
use super::report;
use drivegate_http::{Scope, Token};

/// Adds, lists and removes access tokens of the HTTP server
///
/// The file is `tokens_file` of [http]; a running gateway reads it at a reload. It contains only the SHA-256 of each
/// token.
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
        /// What it permits: read (status page, JSON), metrics, control (nothing: only users command). Repeatable.
        #[arg(long = "scope", value_name = "SCOPE", required = true)]
        scopes: Vec<Scope>,
        /// Name of the token, for the file and the log.
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
        /// Name of the token.
        name: String,
    },
}

type TokenFile = CredentialsFile<Token>;

impl Filed for Token {
    const FILE: &'static str = "token";
    const MODE: u32 = 0o640;
}

pub(super) fn run(args: &Args) -> Outcome {
    let text = match &args.action {
        Action::Add { file, scopes, name } => add(file, name, scopes),
        Action::List { file } => list(file),
        Action::Remove { file, name } => file.remove(name).map(|()| String::new()),
    };
    Ok(report::print(&text?))
}

fn add(file: &TokenFile, name: &str, scopes: &[Scope]) -> Result<String, String> {
    let (token, secret) = Token::generate(name, scopes.to_vec())
        .map_err(|error| format!("{error}; {}; choose another name", file.path.display()))?;
    let remedy = (!file.path.exists()).then(|| file.remedy());
    file.put(&token, false)?;
    // Standard output has nothing but the token, which it often writes to a file.
    eprint!("{}", remedy.unwrap_or_default());
    Ok(format!("{secret}\n"))
}

fn list(file: &TokenFile) -> Result<String, String> {
    let mut table = report::table(["name", "scopes"]);
    for token in file.list()?.list() {
        let scopes: Vec<&str> = token.scopes.iter().map(|scope| scope.name()).collect();
        table.add_row([token.name.clone(), scopes.join(", ")]);
    }
    Ok(report::lines(&table))
}
