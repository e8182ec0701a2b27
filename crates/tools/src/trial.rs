//! `drivegate try`: from an adapter to values on a page, without a file. Only reads.

mod dialog;
mod make;
mod serving;
mod starting;

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use tokio::signal::unix::{SignalKind, signal};
use tokio_util::sync::CancellationToken;

use self::dialog::{Keyboard, check_new, choose_port};
use super::failure::{Failure, Outcome, negative};
use super::scan::{self, Extent, Options, Search, parse_port, verdict};
use super::{EXIT_FAILED, report};

/// Time for which the command listens to the line before it sends anything.
const LISTEN: Duration = Duration::from_secs(1);

/// Finds the drives on a line, shows their values on a page, offers to write a configuration; only reads.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  drivegate try
  drivegate try --port /dev/ttyUSB0
  drivegate try --port tcp://192.168.1.7:4001 --protocol modbus-rtu --baud 19200
  drivegate try --port /dev/ttyUSB0 --profile weg-cfw
  drivegate try --port /dev/ttyUSB0 --addresses 1-31 --write drivegate.toml

Addresses 1 to 10 are tried first with all settings, then the rest. The status page is on the loopback only, and nothing is
ever written to a drive. Ctrl-C ends it.")]
pub(super) struct Args {
    /// Serial device, or tcp://, rfc2217://, modbus-tcp:// or udp:// with host:port [default: asks which adapter].
    #[arg(long, value_name = "PORT", value_parser = parse_port)]
    port: Option<String>,
    #[command(flatten)]
    options: Options,
    /// Write the configuration to this new file, without asking.
    #[arg(long, value_name = "FILE")]
    write: Option<PathBuf>,
}

/// Whether a signal has requested the end.
#[derive(Debug, Clone, Default)]
struct Stop {
    flag: Arc<AtomicBool>,
    token: CancellationToken,
}

impl Stop {
    /// Set by Ctrl-C, SIGTERM, and when the terminal is closed.
    fn on_signals() -> Result<Stop, String> {
        let stop = Stop::default();
        let runtime = super::runtime()?;
        let mut signals = Vec::new();
        for kind in [SignalKind::interrupt(), SignalKind::terminate(), SignalKind::hangup()] {
            let _inside = runtime.enter();
            let handler = signal(kind).map_err(|why| format!("cannot handle signals: {why}; the system; try again"))?;
            signals.push(handler);
        }
        let asked = stop.clone();
        std::thread::spawn(move || {
            runtime.block_on(async {
                let each = signals.iter_mut().map(|signal| Box::pin(signal.recv()));
                futures_util::future::select_all(each).await;
            });
            asked.flag.store(true, Ordering::Relaxed);
            asked.token.cancel();
        });
        Ok(stop)
    }

    fn is_wanted(&self) -> bool {
        self.flag.load(Ordering::Relaxed)
    }
}

pub(super) fn run(args: &Args) -> Outcome {
    attempt(args, &Stop::on_signals()?)
}

/// The failure for an end before anything was found.
fn stopped() -> Failure {
    report::note("stopped; nothing was written");
    Failure::Reported(EXIT_FAILED)
}

fn attempt(args: &Args, stop: &Stop) -> Outcome {
    let keyboard = Keyboard::open();
    if let Some(file) = &args.write {
        check_new(file).map_err(Failure::Misused)?;
    }
    let port = match &args.port {
        Some(port) => port.clone(),
        None => choose_port(stop, &keyboard)?.ok_or_else(stopped)?,
    };
    let (settings, profiles) = scan::prepare(&args.options, &port)?;
    report::note(&format!(
        "looking for drives on {port}; nothing is written to them; Ctrl-C to stop"
    ));
    let enough = Arc::new(AtomicBool::new(false));
    let search = Search::new(&port, &args.options, profiles, stop.flag.clone());
    let mut search = search.with_values(enough.clone());
    let outcome = match settings.first() {
        Some(first) => search.listen(*first, LISTEN),
        None => Ok(()),
    };
    let outcome = outcome.and_then(|()| match verdict::somebody_speaks(&search.heard, &port, LISTEN) {
        Some(message) => Err(message),
        None if stop.is_wanted() => Ok(()),
        None => keyboard.during(&enough, || search.run(&settings, Extent::OneSetting)),
    });
    outcome?;
    if stop.is_wanted() {
        return Err(stopped());
    }
    if search.found.is_empty() {
        scan::nobody_answers(&search, &port, &settings);
        return negative();
    }
    if dialog::is_terminal() {
        make::name_the_unknown(&mut search, stop, &keyboard);
    }
    let text = scan::configuration(&port, &args.options, &search);
    if search.found.iter().all(|found| found.profiles.is_empty()) {
        report::print(&text);
        return Err(make::nobody_is_known(&search).into());
    }
    let before_commands = verdict::before_commands(&search.found, &search.profiles);
    serving::serve(args, stop, &keyboard, &text, &before_commands)
}
