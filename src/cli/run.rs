//! `drivegate run`: the daemon under systemd, in a container or by hand.

use std::io;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use futures_util::FutureExt;
use sd_notify::NotifyState;
use tokio::runtime::{Builder, Runtime};
use tokio::signal::unix::{Signal, SignalKind, signal};

use super::log::LogHandle;
use super::reload::{Loading, NotLoaded, Reloads};
use super::{EXIT_CONFIG, EXIT_FAILED, report};
use crate::config::{Loaded, Settings};
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
    run_from(&args.config).unwrap_or_else(|why| {
        report::error(&format!(
            "cannot start: {why}; the runtime; free memory, threads or file descriptors"
        ));
        ExitCode::from(EXIT_FAILED)
    })
}

fn run_from(path: &Path) -> io::Result<ExitCode> {
    // The handlers come before the first thread and before any file is read: a signal in the first milliseconds must not
    // kill, and a file that cannot be read must not hold up a stop.
    let starting = Builder::new_current_thread().enable_all().build()?;
    let mut early = Signals::within(&starting)?;
    let Some(loaded) = starting.block_on(load(path, &mut early))? else {
        return Ok(ExitCode::SUCCESS);
    };
    report::problems(&loaded);
    let Some(settings) = loaded.settings else {
        return Ok(ExitCode::from(EXIT_CONFIG));
    };
    let log = super::log::start(&settings.log);
    let runtime = Builder::new_multi_thread().enable_all().build()?;
    let mut signals = Signals::within(&runtime)?;
    // What these ones came too late for.
    while let Some(signal) = early.next().now_or_never() {
        early.wanted.add(signal);
    }
    signals.wanted = early.wanted;
    Ok(runtime.block_on(serve(settings, path, &log, signals)))
}

/// Loads the configuration; `None` if the gateway is to stop before that is done.
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
    let daemon = match Daemon::start(settings).await {
        Ok(daemon) => daemon,
        Err(error) => {
            report::error(&error.to_string());
            return ExitCode::from(EXIT_FAILED);
        }
    };
    tracing::info!(gateway, buses, config = %path.display(), version = env!("CARGO_PKG_VERSION"), "drivegate runs");
    notify(&[NotifyState::Ready]);
    let daemon = until_stopped(daemon, path, log, signals).await;
    notify(&[NotifyState::Stopping]);
    daemon.stop().await;
    tracing::info!("drivegate has stopped");
    ExitCode::SUCCESS
}

/// Serves signals and the watchdog until the daemon is to stop. Files of a reload are read elsewhere.
async fn until_stopped(mut daemon: Daemon, path: &Path, log: &LogHandle, mut signals: Signals) -> Daemon {
    let mut reloads = Reloads::default();
    let watchdog = sd_notify::watchdog_enabled();
    let mut feed = tokio::time::interval(
        watchdog
            .map_or(Duration::from_secs(5), |t| t / 2)
            .max(Duration::from_millis(500)),
    );
    loop {
        if signals.wanted.stop {
            return daemon;
        }
        if std::mem::take(&mut signals.wanted.reload) {
            begin_reload(&mut reloads, path);
        }
        tokio::select! {
            signal = signals.next() => signals.wanted.add(signal),
            loaded = reloads.loaded() => {
                finish_reload(&mut daemon, loaded, path, log).await;
                if reloads.is_wanted_again() {
                    begin_reload(&mut reloads, path);
                }
            }
            _ = feed.tick() => {
                log.report_lost();
                if daemon.is_moving() && watchdog.is_some() {
                    notify(&[NotifyState::Watchdog]);
                }
            }
        }
    }
}

fn begin_reload(reloads: &mut Reloads, path: &Path) {
    let mut states = vec![NotifyState::Reloading];
    states.extend(NotifyState::monotonic_usec_now());
    notify(&states);
    if let Err(why) = reloads.begin(path) {
        reject(&why);
        notify(&[NotifyState::Ready]);
    }
}

/// Applies the configuration that was read; an invalid one is rejected and changes nothing.
async fn finish_reload(daemon: &mut Daemon, loaded: Result<Loaded, NotLoaded>, path: &Path, log: &LogHandle) {
    match loaded {
        Ok(loaded) => {
            for problem in &loaded.errors {
                tracing::error!("{problem}");
            }
            for problem in &loaded.warnings {
                tracing::warn!("{problem}");
            }
            match loaded.settings {
                None => tracing::error!("reload rejected; keeping the current configuration"),
                Some(settings) => {
                    let level = settings.log.level.clone();
                    match daemon.reload(settings).await {
                        Ok(()) => {
                            log.set_level(&level);
                            tracing::info!(config = %path.display(), "configuration reloaded");
                        }
                        Err(why) => reject(&why),
                    }
                }
            }
        }
        Err(why) => reject(&why),
    }
    notify(&[NotifyState::Ready]);
}

fn reject(why: &dyn std::fmt::Display) {
    tracing::error!("reload rejected: {why}; keeping the current configuration");
}

fn notify(states: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(states) {
        tracing::debug!("cannot notify systemd: {error}");
    }
}

/// What signals have asked for.
#[derive(Debug, Default)]
struct Wanted {
    stop: bool,
    reload: bool,
}

impl Wanted {
    fn add(&mut self, signal: SignalKind) {
        match signal == SignalKind::hangup() {
            true => self.reload = true,
            false => self.stop = true,
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

    /// The next signal; cancel safe.
    async fn next(&mut self) -> SignalKind {
        tokio::select! {
            _ = self.terminate.recv() => SignalKind::terminate(),
            _ = self.interrupt.recv() => SignalKind::interrupt(),
            _ = self.hang_up.recv() => SignalKind::hangup(),
        }
    }
}
