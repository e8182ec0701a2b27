//! `drivegate run`: the daemon, started by systemd, in a container or by a user.

mod reloads;
mod serving;
mod watch;

use std::io;
use std::path::Path;
use std::process::ExitCode;
use std::time::Duration;

use futures_util::FutureExt;
use sd_notify::NotifyState;
use tokio::runtime::{Builder, Runtime};
use tokio::signal::unix::{Signal, SignalKind, signal};

use super::failure::Outcome;
use super::loading::Loading;
use super::log::LogHandle;
use super::{EXIT_CONFIG, VERSION, report};
use drivegate_gateway::config::{Loaded, Settings};
use drivegate_gateway::daemon::Daemon;
use drivegate_http::local::Control;
use drivegate_north::reading::watched_runtime;

/// Time for files that are being written when the gateway has stopped.
const LAST_WRITES: Duration = Duration::from_secs(1);

/// Runs the gateway until SIGTERM or Ctrl-C; SIGHUP reloads the configuration
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  drivegate run --config /etc/drivegate/drivegate.toml")]
pub(super) struct Args {
    #[command(flatten)]
    config: super::NamedConfig,
}

/// Runs the daemon until SIGTERM or SIGINT.
pub(super) fn run(args: &Args) -> Outcome {
    Ok(run_from(args.config.path()).map_err(super::cannot_start)?)
}

fn run_from(path: &Path) -> io::Result<ExitCode> {
    // The signal handlers are installed before the first thread and before any file is read: a signal in the first
    // milliseconds must not kill the process, and an unreadable file must not delay a stop.
    let starting = Builder::new_current_thread().enable_all().build()?;
    let mut early = Signals::within(&starting)?;
    let Some(loaded) = starting.block_on(load(path, &mut early))? else {
        return Ok(ExitCode::SUCCESS);
    };
    let Some(settings) = loaded.settings else {
        report::problems(&loaded);
        return Ok(ExitCode::from(EXIT_CONFIG));
    };
    let log = super::log::start(&settings.log);
    tracing::info!(target: "drivegate::cli::run", version = VERSION.as_str(), config = %path.display(), "drivegate is \
                                                                                                         starting");
    loaded
        .warnings
        .iter()
        .for_each(|problem| tracing::warn!(target: "drivegate::cli::run", "{problem}"));
    let runtime = watched_runtime()?;
    let mut signals = Signals::within(&runtime)?;
    // Signals that arrived before the new handlers were installed are still in the early ones.
    while let Some(signal) = early.next().now_or_never() {
        early.wanted.add(signal);
    }
    signals.wanted = early.wanted;
    let code = runtime.block_on(serve(settings, path, &log, signals));
    // Writes in progress may finish; threads that wait for a disk end with the process.
    runtime.shutdown_timeout(LAST_WRITES);
    Ok(code)
}

/// Loads the configuration; `None` if the gateway must stop before the configuration is loaded.
async fn load(path: &Path, signals: &mut Signals) -> io::Result<Option<Loaded>> {
    let mut loading = Loading::begin(path, None)?;
    loop {
        tokio::select! {
            loaded = loading.finished() => return loaded.map(Some).map_err(io::Error::other),
            signal = signals.next() => signals.wanted.add(signal),
        }
        if signals.wanted.stop {
            return Ok(None);
        }
    }
}

async fn serve(settings: Settings, path: &Path, log: &LogHandle, signals: Signals) -> ExitCode {
    let (gateway, buses) = (settings.gateway.clone(), settings.buses.len());
    let (control, orders) = Control::new(path);
    let daemon = match Daemon::start_with(settings, Some(control)).await {
        Ok(daemon) => daemon,
        Err(error) => return report::failed(&error.to_string()),
    };
    tracing::info!(target: "drivegate::cli::run", gateway, buses, "drivegate is running");
    notify(&[NotifyState::Ready]);
    let daemon = serving::until_stopped(daemon, orders, path, log, signals).await;
    notify(&[NotifyState::Stopping]);
    daemon.stop().await;
    tracing::info!(target: "drivegate::cli::run", "drivegate has stopped");
    ExitCode::SUCCESS
}

/// Notifies systemd if it started this process.
fn notify(states: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(states) {
        tracing::debug!(target: "drivegate::cli::run", "cannot notify systemd: {error}");
    }
}

/// The requests of signals.
#[derive(Debug, Default)]
struct Wanted {
    stop: bool,
    reload: bool,
}

impl Wanted {
    fn add(&mut self, signal: SignalKind) {
        if signal == SignalKind::hangup() {
            self.reload = true;
        } else {
            self.stop = true;
        }
    }
}

/// The signals that stop the gateway or reload its configuration.
#[derive(Debug)]
struct Signals {
    terminate: Signal,
    interrupt: Signal,
    hang_up: Signal,
    wanted: Wanted,
}

impl Signals {
    fn within(runtime: &Runtime) -> io::Result<Signals> {
        let _inside = runtime.enter();
        Ok(Signals {
            terminate: signal(SignalKind::terminate())?,
            interrupt: signal(SignalKind::interrupt())?,
            hang_up: signal(SignalKind::hangup())?,
            wanted: Wanted::default(),
        })
    }

    /// Waits for the next signal; cancel safe.
    async fn next(&mut self) -> SignalKind {
        tokio::select! {
            _ = self.terminate.recv() => SignalKind::terminate(),
            _ = self.interrupt.recv() => SignalKind::interrupt(),
            _ = self.hang_up.recv() => SignalKind::hangup(),
        }
    }
}
