//! The gateway at work: signals, commands of local clients, reloads, and the watchdog.

use std::path::Path;

use tokio::sync::mpsc::Receiver;

use super::Signals;
use super::reloads::{Reloads, apply};
use super::watch::Watch;
use crate::log::LogHandle;
use drivegate_gateway::daemon::Daemon;
use drivegate_http::local::ReloadOrder;

/// Serves until the daemon is to stop.
pub(super) async fn until_stopped(
    mut daemon: Daemon,
    mut orders: Receiver<ReloadOrder>,
    path: &Path,
    log: &LogHandle,
    mut signals: Signals,
) -> Daemon {
    let mut reloads = Reloads::new(path);
    let mut watch = Watch::new(&daemon, log);
    loop {
        if signals.wanted.stop {
            return daemon;
        }
        if std::mem::take(&mut signals.wanted.reload) {
            reloads.begin(None, &mut watch);
        }
        tokio::select! {
            signal = signals.next() => signals.wanted.add(signal),
            Some(order) = orders.recv() => reloads.begin(Some(order), &mut watch),
            loaded = reloads.loaded() => {
                let outcome = {
                    let patience = daemon.stats().patience.clone();
                    let applying = apply(&mut daemon, loaded, path, log);
                    tokio::pin!(applying);
                    loop {
                        tokio::select! {
                            outcome = &mut applying => break outcome,
                            signal = signals.next() => {
                                signals.wanted.add(signal);
                                if signals.wanted.stop {
                                    patience.end();
                                }
                            }
                            () = watch.tick() => {}
                        }
                    }
                };
                reloads.ended(outcome, &mut watch);
            }
            () = watch.tick() => {}
        }
    }
}
