//! Reloads of the configuration: one at a time, each answered to its requester.

use std::path::Path;

use crate::loading::{Loads, NotLoaded};
use crate::log::LogHandle;
use drivegate_gateway::config::Loaded;
use drivegate_gateway::daemon::Daemon;
use drivegate_http::local::ReloadOrder;
use drivegate_http::messages::ReloadOutcome;
use drivegate_model::document::Problem;

use super::watch::Watch;

/// The reloads of a running gateway.
#[derive(Debug)]
pub(super) struct Reloads<'p> {
    path: &'p Path,
    loads: Loads,
    /// Requests that wait for the reload in progress, and for the one after it.
    waiting: [Vec<ReloadOrder>; 2],
}

impl Reloads<'_> {
    /// Reloads of a gateway that runs with the configuration in `path`.
    pub(super) fn new(path: &Path) -> Reloads<'_> {
        Reloads {
            path,
            loads: Loads::default(),
            waiting: Default::default(),
        }
    }

    /// Begins to read the configuration, after the present load if one is in progress.
    pub(super) fn begin(&mut self, order: Option<ReloadOrder>, watch: &mut Watch<'_>) {
        if let Some(order) = &order {
            tracing::info!(target: "drivegate::cli::run", who = order.who, "a local client requests a reload");
        }
        let [current, next] = &mut self.waiting;
        if self.loads.is_loading() {
            next.extend(order);
        } else {
            current.extend(order);
            watch.reloading();
        }
        if let Err(why) = self.loads.begin(self.path) {
            self.ended(refused(&why), watch);
        }
    }

    /// The configuration as soon as it was read; waits for ever if none is being read. Cancel safe.
    pub(super) async fn loaded(&mut self) -> Result<Loaded, NotLoaded> {
        self.loads.loaded().await
    }

    /// Handles the end of the reload that was in progress.
    pub(super) fn ended(&mut self, outcome: ReloadOutcome, watch: &mut Watch<'_>) {
        watch.reloaded(&outcome);
        let [current, next] = &mut self.waiting;
        for order in current.drain(..) {
            // The client that requested the reload may have disconnected.
            let _ = order.answer.send(outcome.clone());
        }
        std::mem::swap(current, next);
        if self.loads.is_wanted_again() {
            self.begin(None, watch);
        }
    }
}

/// Applies the configuration that was read; an invalid one is rejected and changes nothing.
pub(super) async fn apply(
    daemon: &mut Daemon,
    loaded: Result<Loaded, NotLoaded>,
    path: &Path,
    log: &LogHandle,
) -> ReloadOutcome {
    let loaded = match loaded {
        Ok(loaded) => loaded,
        Err(why) => return refused(&why),
    };
    let logged = |problems: &[Problem]| -> Vec<String> { problems.iter().map(ToString::to_string).collect() };
    let mut outcome = ReloadOutcome {
        errors: logged(&loaded.errors),
        warnings: logged(&loaded.warnings),
        changes: Vec::new(),
    };
    outcome
        .errors
        .iter()
        .for_each(|problem| tracing::error!(target: "drivegate::cli::run", "{problem}"));
    outcome
        .warnings
        .iter()
        .for_each(|problem| tracing::warn!(target: "drivegate::cli::run", "{problem}"));
    let Some(settings) = loaded.settings else {
        tracing::error!(target: "drivegate::cli::run", "reload rejected; keeping the current configuration");
        return outcome;
    };
    let level = settings.log.level.clone();
    match daemon.reload(settings).await {
        Ok(changes) => {
            log.set_level(&level);
            tracing::info!(target: "drivegate::cli::run", config = %path.display(), "configuration reloaded");
            outcome.changes = changes;
            outcome
        }
        Err(why) => refused(&why),
    }
}

fn refused(why: &dyn std::fmt::Display) -> ReloadOutcome {
    tracing::error!(target: "drivegate::cli::run", "reload rejected: {why}; keeping the current configuration");
    ReloadOutcome {
        errors: vec![why.to_string()],
        ..ReloadOutcome::default()
    }
}
