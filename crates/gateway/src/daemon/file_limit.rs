//! Open files: the process may open as many as the configuration can need, or serves fewer connections, so that ports and
//! files can always be opened.

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

use crate::config::Settings;
use drivegate_north::{bacnet, modbus_tcp, slot};

/// Files that the process itself has open: logs, runtimes, queues, the configuration, MQTT with its buffer, local clients.
const OWN_FILES: usize = 64;
/// Connections that each server gets in any case, unless fewer are configured.
const LEAST_CONNECTIONS: usize = 4;
/// Open files of a bus: its port, its queue, its timer, and twice that while a reload replaces it.
const BUS_FILES: usize = 8;

/// Raises the limit of open files as far as `settings` require and the system permits. If that is not enough, the settings
/// allow fewer connections.
pub(super) fn fit(mut settings: Settings) -> Settings {
    let wanted = FileDemand::of(&settings);
    let limit = raise(wanted.files());
    if limit >= wanted.files() {
        return settings;
    }
    let (before, fitted) = (wanted.connections(), wanted.within(limit));
    tracing::warn!(
        target: "drivegate::daemon::file_limit", "the configuration can require {} open files, but the limit is {limit}; at most {} instead of {before} connections \
         are served: raise LimitNOFILE of the service or lower `max_connections` of [modbus_tcp]",
        wanted.files(),
        fitted.connections(),
    );
    settings.modbus_tcp = fitted.modbus_tcp;
    settings.http = fitted.http;
    settings
}

/// Raises the soft limit to `wanted` or to the hard limit. Returns the resulting limit.
fn raise(wanted: usize) -> usize {
    let number = |limit: Option<u64>| limit.map_or(usize::MAX, |limit| usize::try_from(limit).unwrap_or(usize::MAX));
    let limit = getrlimit(Resource::Nofile);
    let (current, most) = (number(limit.current), number(limit.maximum));
    if current >= wanted {
        return current;
    }
    let raised = wanted.min(most);
    let request = Rlimit {
        current: Some(raised as u64),
        maximum: limit.maximum,
    };
    match setrlimit(Resource::Nofile, request) {
        Ok(()) => raised,
        Err(_) => current,
    }
}

/// Everything that needs open files.
#[derive(Debug, Clone)]
struct FileDemand {
    buses: usize,
    /// Connections of the tool slots and BACnet.
    slots: usize,
    modbus_tcp: Option<modbus_tcp::Options>,
    http: Option<drivegate_http::Options>,
}

impl FileDemand {
    fn of(settings: &Settings) -> FileDemand {
        FileDemand {
            buses: settings.buses.len(),
            slots: settings.slots.as_ref().map_or(0, slot::Options::files)
                + settings.bacnet.as_ref().map_or(0, bacnet::Options::files),
            modbus_tcp: settings.modbus_tcp.clone(),
            http: settings.http.clone(),
        }
    }

    fn files(&self) -> usize {
        let modbus_tcp = self.modbus_tcp.as_ref().map_or(0, modbus_tcp::Options::files);
        let http = self.http.as_ref().map_or(0, drivegate_http::Options::files);
        OWN_FILES + BUS_FILES * self.buses + self.slots + modbus_tcp + http
    }

    fn connections(&self) -> usize {
        let modbus_tcp = self.modbus_tcp.as_ref().map_or(0, |options| options.max_connections);
        modbus_tcp + self.http.as_ref().map_or(0, |options| options.max_connections)
    }

    /// Reduces the connections until `limit` files are enough; each server keeps [`LEAST_CONNECTIONS`].
    fn within(&self, limit: usize) -> FileDemand {
        let (mut fewest, mut most) = (0, 1000);
        while fewest + 1 < most {
            let middle = (fewest + most) / 2;
            if self.scaled(middle).files() <= limit {
                fewest = middle;
            } else {
                most = middle;
            }
        }
        self.scaled(fewest)
    }

    /// All servers with this fraction of their connections, in thousandths.
    fn scaled(&self, thousandths: usize) -> FileDemand {
        let scale = |connections: usize| (connections * thousandths / 1000).max(LEAST_CONNECTIONS.min(connections));
        let mut scaled = self.clone();
        if let Some(options) = &mut scaled.modbus_tcp {
            options.max_connections = scale(options.max_connections);
        }
        if let Some(options) = &mut scaled.http {
            options.max_connections = scale(options.max_connections);
        }
        scaled
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn wanted(buses: usize, modbus_tcp: usize, http: usize) -> FileDemand {
        FileDemand {
            buses,
            slots: 0,
            modbus_tcp: Some(modbus_tcp::Options {
                listeners: Vec::new(),
                tls: None,
                max_connections: modbus_tcp,
                max_connections_per_address: 16,
                idle_timeout: None,
                uncached: modbus_tcp::Uncached::Forward,
            }),
            http: Some(drivegate_http::Options {
                max_connections: http,
                ..drivegate_http::Options::listening_on(([127, 0, 0, 1], 9488).into())
            }),
        }
    }

    proptest! {
        #[test]
        fn as_many_connections_as_there_are_files(
            buses in 0..32_usize, modbus_tcp in 1..10_000_usize, http in 1..200_usize, limit in 0..12_000_usize,
        ) {
            let wanted = wanted(buses, modbus_tcp, http);
            let fitted = wanted.within(limit);
            let least = wanted.scaled(0);
            prop_assert!(fitted.files() <= limit.max(least.files()));
            prop_assert!(fitted.connections() >= least.connections());
            // Hardly any file is left unused, unless all connections have theirs.
            let rest = limit.saturating_sub(fitted.files());
            let unused = rest > 2 * ((modbus_tcp + http) / 1000 + 2);
            prop_assert!(!unused || fitted.connections() * 1000 + 3000 >= 999 * wanted.connections());
        }
    }
}
