//! `drivegate run`: the daemon under systemd, in a container or by hand.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use sd_notify::NotifyState;
use tokio::signal::unix::{SignalKind, signal};

use super::log::LogHandle;
use super::{EXIT_CONFIG, EXIT_FAILED, report};
use crate::config::{self, Settings};
use crate::daemon::Daemon;

/// Runs the gateway until SIGTERM or Ctrl-C; SIGHUP reloads the configuration
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  drivegate run --config /etc/drivegate/drivegate.toml")]
pub(super) struct Args {
    /// Configuration file
    #[arg(long, value_name = "FILE", default_value = super::DEFAULT_CONFIG)]
    pub config: PathBuf,
}

/// Runs the daemon until SIGTERM or SIGINT.
pub(super) fn run(args: &Args) -> ExitCode {
    let loaded = Settings::load(&args.config, config::environment());
    report::problems(&loaded);
    let Some(settings) = loaded.settings else {
        return ExitCode::from(EXIT_CONFIG);
    };
    let log = super::log::start(&settings.log);
    super::block_on(serve(settings, &args.config, &log))
}

async fn serve(settings: Settings, path: &Path, log: &LogHandle) -> ExitCode {
    let (gateway, buses) = (settings.gateway.clone(), settings.buses.len());
    let daemon = match Daemon::start(settings).await {
        Ok(daemon) => daemon,
        Err(error) => {
            report::error(&error.to_string());
            return ExitCode::from(EXIT_FAILED);
        }
    };
    tracing::info!(gateway, buses, config = %path.display(), version = env!("CARGO_PKG_VERSION"), "drivegate runs");
    notify(&[NotifyState::Ready]);
    match until_stopped(daemon, path, log).await {
        Ok(daemon) => {
            notify(&[NotifyState::Stopping]);
            daemon.stop().await;
            tracing::info!("drivegate has stopped");
            ExitCode::SUCCESS
        }
        Err(error) => {
            report::error(&error.to_string());
            ExitCode::from(EXIT_FAILED)
        }
    }
}

/// Serves signals and the watchdog until the daemon is to stop.
async fn until_stopped(mut daemon: Daemon, path: &Path, log: &LogHandle) -> std::io::Result<Daemon> {
    let mut terminate = signal(SignalKind::terminate())?;
    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut hang_up = signal(SignalKind::hangup())?;
    let watchdog = sd_notify::watchdog_enabled();
    let mut feed = tokio::time::interval(
        watchdog
            .map_or(Duration::from_secs(5), |t| t / 2)
            .max(Duration::from_millis(500)),
    );
    loop {
        tokio::select! {
            _ = terminate.recv() => break,
            _ = interrupt.recv() => break,
            _ = hang_up.recv() => reload(&mut daemon, path, log).await,
            _ = feed.tick() => {
                log.report_lost();
                if daemon.is_moving() && watchdog.is_some() {
                    notify(&[NotifyState::Watchdog]);
                }
            }
        }
    }
    Ok(daemon)
}

/// Reloads the configuration; an invalid one is rejected and changes nothing.
async fn reload(daemon: &mut Daemon, path: &Path, log: &LogHandle) {
    let mut states = vec![NotifyState::Reloading];
    states.extend(NotifyState::monotonic_usec_now());
    notify(&states);
    let loaded = Settings::load(path, config::environment());
    for problem in &loaded.errors {
        tracing::error!("{problem}");
    }
    for problem in &loaded.warnings {
        tracing::warn!("{problem}");
    }
    match loaded.settings {
        None => tracing::error!("reload rejected; keeping the current configuration"),
        Some(settings) => {
            log.set_level(&settings.log.level);
            match daemon.reload(settings).await {
                Ok(()) => tracing::info!(config = %path.display(), "configuration reloaded"),
                Err(error) => tracing::error!("reload rejected: {error}; keeping the current configuration"),
            }
        }
    }
    notify(&[NotifyState::Ready]);
}

fn notify(states: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(states) {
        tracing::debug!("cannot notify systemd: {error}");
    }
}
