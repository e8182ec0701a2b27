//! `drivegate health`: whether a running gateway is ready, as an exit code.

use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use super::client::{Gateway, Url, get_text};
use super::local_client::{NotAsked, ask_gateway};
use super::{DEFAULT_CONFIG, EXIT_FAILED, report};
use crate::config::{Settings, environment};
use crate::north::local::protocol::{HealthOutcome, Outcome, Request};

/// Says whether the running gateway is ready, for containers and scripts.
///
/// Exit code 0 if every bus is open, each drive was tried and every server listens, as `/readyz` says; else 1 with
/// the reasons. Asks through the local socket; with `socket = ""` or --url, through HTTP.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  drivegate health --config /etc/drivegate/drivegate.toml\n  \
    drivegate health --url http://127.0.0.1:9488"
)]
pub(super) struct Args {
    /// Configuration file of the gateway.
    #[arg(long, value_name = "FILE", default_value = DEFAULT_CONFIG)]
    config: PathBuf,
    /// The gateway's HTTP server instead.
    #[arg(long, value_name = "URL", conflicts_with = "config")]
    url: Option<Url>,
    /// PEM file of the CA that signed the gateway's certificate, for https:// [default: those of the system].
    #[arg(long, value_name = "FILE", requires = "url")]
    ca: Option<PathBuf>,
}

pub(super) fn run(args: &Args) -> ExitCode {
    super::block_on(async {
        let outcome = match &args.url {
            Some(url) => over_http(url.clone(), args.ca.clone()).await,
            None => of_config(&args.config).await,
        };
        match outcome {
            Ok(health) if health.ready => report::print("ready\n"),
            Ok(health) => {
                health.reasons.iter().for_each(|reason| report::error(reason));
                ExitCode::from(EXIT_FAILED)
            }
            Err(why) => {
                report::error(&why);
                ExitCode::from(EXIT_FAILED)
            }
        }
    })
}

async fn of_config(config: &Path) -> Result<HealthOutcome, String> {
    match ask_gateway(config, Request::Health).await {
        Ok(Outcome::Health(health)) => Ok(health),
        Ok(outcome) => Err(outcome.not_asked_for()),
        Err(NotAsked::Because(why)) => Err(why),
        Err(NotAsked::Off) => over_http(http_of(config)?, None).await,
    }
}

/// Where the HTTP server of a configuration listens.
fn http_of(config: &Path) -> Result<Url, String> {
    let shown = config.display();
    let settings = Settings::load(config, environment()).settings;
    let settings = settings.ok_or_else(|| format!("the configuration is invalid; {shown}; see `drivegate check`"))?;
    let http = settings.http.ok_or_else(|| {
        format!(
            "neither the local socket nor [http] is configured, so the gateway cannot be asked; {shown}; \
            configure one"
        )
    })?;
    if http.identity.is_some() {
        return Err(format!(
            "the HTTP server has TLS, and the name in its certificate is not known here; {shown}; pass --url and --ca"
        ));
    }
    format!("http://{}", from_here(http.listen)).parse()
}

/// The address as a client on this machine has to name it.
fn from_here(listen: SocketAddr) -> SocketAddr {
    let address = match listen {
        SocketAddr::V4(at) if at.ip().is_unspecified() => Ipv4Addr::LOCALHOST.into(),
        SocketAddr::V6(at) if at.ip().is_unspecified() => Ipv6Addr::LOCALHOST.into(),
        other => other.ip(),
    };
    SocketAddr::new(address, listen.port())
}

async fn over_http(url: Url, ca: Option<PathBuf>) -> Result<HealthOutcome, String> {
    let gateway = Gateway::at(url, ca);
    let (ready, text) = get_text(&gateway, "/readyz").await.map_err(|error| error.to_string())?;
    // The first line says that it is not ready.
    let reasons = text.lines().skip(1).map(str::to_string).collect();
    Ok(HealthOutcome { ready, reasons })
}
