//! `stale_after`: the age from which process data is stale, whatever interface shows it.

use std::time::Duration;

use super::bus;
use super::key::Key;
use super::keys::GATEWAY;
use drivegate_model::document::{Document, Place, Reader};

/// The version that will refuse the former place, `[modbus_tcp]`.
const REFUSED_FROM: &str = "0.2";

/// The age from which process data is stale.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StaleAfter {
    /// The configured age, or the default.
    pub limit: Duration,
    /// Whether the age was configured, so that it also applies to slow lines.
    pub written: bool,
}

impl StaleAfter {
    /// The lowest limit for a bus with this achievable cycle: unless configured, data of a slow bus becomes stale only
    /// after three rounds.
    pub fn floor(&self, cycle: Duration) -> Duration {
        if self.written { Duration::ZERO } else { 3 * cycle }
    }
}

/// The configured age and its place.
pub(super) type Written = Option<(Duration, Place)>;

/// The age of a section, if the section has it.
pub(super) fn written(key: &Key<Duration>, reader: &Reader<'_>) -> Written {
    Some((key.written(reader)?, key.place(reader)))
}

/// The age of `[gateway]`, or else of its former place `[modbus_tcp]`.
pub(super) fn of_sections(document: &Document, gateway: Written, modbus_tcp: Written) -> Written {
    match (&gateway, &modbus_tcp) {
        (_, None) => {}
        (Some(_), Some((_, former))) => {
            document.problem(former, "`stale_after` is already in [gateway]", "remove it here");
        }
        (None, Some((_, former))) => document.warning(
            former,
            "`stale_after` of [modbus_tcp] is called `stale_after` of [gateway] now",
            format!("move it to [gateway]; version {REFUSED_FROM} refuses it here"),
        ),
    }
    gateway.or(modbus_tcp)
}

/// The settings that `written` stands for.
pub(super) fn settings(written: &Written) -> Option<StaleAfter> {
    Some(StaleAfter {
        limit: match written {
            Some((limit, _)) => *limit,
            None => GATEWAY.stale_after.read_default()?,
        },
        written: written.is_some(),
    })
}

/// Warns if a configured age is shorter than the cycle of a bus.
pub(super) fn warn_of_cycles(document: &Document, buses: &[bus::Found], written: &Written) {
    let Some((limit, place)) = written.as_ref().filter(|_| document.is_sound()) else {
        return;
    };
    let settings = buses.iter().filter_map(|found| found.settings.as_ref());
    for (name, cycle) in settings.filter_map(|bus| Some((&bus.spec.name, bus.predict().fast_cycle?))) {
        if cycle > *limit {
            let [cycle, limit] = [cycle, *limit].map(|time| time.as_secs_f64() * 1e3);
            document.warning(
                place,
                format!("process data of bus `{name}` is read every {cycle:.0} ms and stale after {limit:.0} ms"),
                "raise stale_after, leave it out, or reduce the load of the bus",
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::REFUSED_FROM;

    #[test]
    fn the_former_place_is_accepted_no_longer_than_promised() {
        let number = |text: &str| -> (u32, u32) {
            let mut parts = text.split('.').map(|part| part.parse().unwrap());
            (parts.next().unwrap(), parts.next().unwrap())
        };
        let (this, refusing) = (number(env!("CARGO_PKG_VERSION")), number(REFUSED_FROM));
        assert!(this < refusing, "remove stale_after from MODBUS_TCP");
    }
}
