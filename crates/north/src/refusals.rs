//! Counts and logs refused connections. Refusals repeat, so each kind of log line is throttled.

use std::fmt::Display;
use std::net::IpAddr;
use std::sync::Arc;
use std::time::Instant;

use super::connection_limit::{ConnectionLimit, ConnectionPermit, LimitReached, Newcomer, NoPlace};
use super::log_throttle::LogThrottle;
use super::{ConnectionRefusal, NorthState, ServerKind};
use drivegate_core::order::Authority;

/// Counts the refused connections of one server.
#[derive(Debug)]
pub struct Refusals {
    server: ServerKind,
    stats: Arc<NorthState>,
    logs: [LogThrottle; ConnectionRefusal::ALL.len()],
}

impl Refusals {
    pub fn new(server: ServerKind, stats: Arc<NorthState>) -> Refusals {
        Refusals {
            server,
            stats,
            logs: Default::default(),
        }
    }

    /// Asks for a place under `limit` for a connection that `judge` allows. Every connection that is refused or
    /// displaced is counted and logged, with the remedy for the limit that was reached.
    pub fn acquire(
        &self,
        limit: &Arc<ConnectionLimit>,
        newcomer: Newcomer<'_>,
        remedy: fn(LimitReached) -> String,
        judge: impl FnOnce() -> Option<Authority>,
    ) -> Option<ConnectionPermit> {
        let client = newcomer.address;
        match limit.acquire(newcomer, Instant::now(), judge) {
            Ok((permit, displaced)) => {
                if let Some(displaced) = displaced {
                    let text = format!("a connection of {displaced} was closed to make room for it");
                    self.report(ConnectionRefusal::Displaced, client, &text);
                }
                Some(permit)
            }
            Err(NoPlace::NotAllowed) => {
                let text = "client refused: its address is not in `allow`";
                self.report(ConnectionRefusal::NotAllowed, client, &text);
                None
            }
            Err(NoPlace::Limit(reached)) => {
                let (why, text) = match reached {
                    LimitReached::Total(limit) => (ConnectionRefusal::Full, format!("{limit} connections are open")),
                    LimitReached::Address(limit) => (
                        ConnectionRefusal::AddressFull,
                        format!("{limit} connections are open from its address"),
                    ),
                };
                let remedy = remedy(reached);
                self.report(why, client, &format_args!("client refused: {text}; {remedy}"));
                None
            }
        }
    }

    /// Counts a refused connection and logs it.
    pub fn report(&self, why: ConnectionRefusal, client: IpAddr, text: &dyn Display) {
        self.stats.refused.add(self.server, why);
        let log = self.logs.get(why as usize);
        if let Some(suppressed) = log.and_then(|log| log.permit(Instant::now())) {
            let server = self.server.title();
            tracing::warn!(target: "drivegate::north::refusals", %client, suppressed, "{server}: {text}");
        }
    }
}
