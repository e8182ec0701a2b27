//! When the name of the BBMD is looked up: its address may change, so that is repeated while no BBMD answers there.

use std::net::{SocketAddr, SocketAddrV4};
use std::time::{Duration, Instant};

use drivegate_bacnet::Registration;
use futures_util::FutureExt as _;
use tokio::task::JoinHandle;

/// Time between two look-ups of a BBMD that is not found or does not answer.
const AGAIN: Duration = Duration::from_secs(30);

/// The look-ups of one name.
#[derive(Debug, Default)]
pub(super) struct Lookups {
    last: Option<Instant>,
    running: Option<JoinHandle<Option<SocketAddrV4>>>,
}

impl Lookups {
    /// Begins a look-up if one is due by the state of the registration.
    pub(super) fn begin(
        &mut self,
        registration: Registration,
        now: Instant,
        look_up: impl FnOnce() -> JoinHandle<Option<SocketAddrV4>>,
    ) {
        let waits = matches!(registration, Registration::None | Registration::Unanswered);
        let due = self.last.is_none_or(|at| now.saturating_duration_since(at) >= AGAIN);
        if waits && due && self.running.is_none() {
            self.last = Some(now);
            self.running = Some(look_up());
        }
    }

    /// The result of a look-up that has ended since the last call: the address, if the name was found.
    pub(super) fn ended(&mut self) -> Option<Option<SocketAddrV4>> {
        let lookup = self.running.take_if(|lookup| lookup.is_finished())?;
        Some(lookup.now_or_never().and_then(Result::ok).flatten())
    }
}

/// The first IPv4 address of a host.
pub(super) async fn look_up(host: String, port: u16) -> Option<SocketAddrV4> {
    let mut found = tokio::net::lookup_host((host.as_str(), port)).await.ok()?;
    found.find_map(|address| match address {
        SocketAddr::V4(address) => Some(address),
        SocketAddr::V6(_) => None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_name_is_looked_up_until_a_bbmd_answers_at_its_address() {
        use Registration::{None, Refused, Registered, Unanswered};
        let address = "10.0.0.1:47808".parse().unwrap();
        let (start, mut lookups) = (Instant::now(), Lookups::default());
        // Columns: seconds, state of the registration, whether a look-up begins.
        let table = [
            (0, None, true),
            (29, None, false),
            (30, None, true),
            (59, Unanswered, false),
            (60, Unanswered, true),
            (200, Registered, false),
            (201, Refused(0x30), false),
            (202, Unanswered, true),
        ];
        for (second, registration, begins) in table {
            let now = start + Duration::from_secs(second);
            let mut begun = false;
            lookups.begin(registration, now, || {
                begun = true;
                tokio::spawn(async move { Some(address) })
            });
            assert_eq!(begun, begins, "{second} s, {registration:?}");
            if begins {
                let much_later = now + 10 * AGAIN;
                lookups.begin(registration, much_later, || {
                    panic!("a second one, while the first one has no result")
                });
            }
            while lookups.running.as_ref().is_some_and(|lookup| !lookup.is_finished()) {
                tokio::task::yield_now().await;
            }
            assert_eq!(lookups.ended(), begins.then_some(Some(address)));
        }
    }
}
