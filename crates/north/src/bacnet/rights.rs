//! Which hosts may write according to the present `[bacnet]`: a reload takes effect at once, also for requests in
//! progress and for values in slots.

use std::net::Ipv4Addr;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use arc_swap::ArcSwapOption;
use drivegate_bacnet::Address;

use super::Options;
use drivegate_core::order::{Grants, Right};

/// The rights of all hosts. When the server shuts down, no host may write any more.
#[derive(Debug, Clone)]
pub(super) struct HostRights(Arc<ArcSwapOption<Options>>);

impl HostRights {
    pub(super) fn new(options: &Options) -> HostRights {
        HostRights(Arc::new(ArcSwapOption::from_pointee(options.clone())))
    }

    /// Puts these options into effect; with `None` no client may write.
    pub(super) fn set(&self, options: Option<&Options>) {
        self.0.store(options.cloned().map(Arc::new));
    }

    /// The options in effect; `None` once the server serves no clients any more.
    pub(super) fn options(&self) -> Option<Arc<Options>> {
        self.0.load_full()
    }

    /// The right of a client.
    pub(super) fn of(&self, client: &Address) -> Right {
        Right::of(Arc::new(HostRight {
            options: self.0.clone(),
            host: client.ip(),
        }))
    }

    /// The right of a client, given by its name in the audit; a name that is not an address has no right.
    pub(super) fn of_name(&self, who: &str) -> Right {
        match who.parse::<Address>() {
            Ok(client) => self.of(&client),
            Err(()) => Right::of(Arc::new(AtomicBool::new(false))),
        }
    }
}

#[derive(Debug)]
struct HostRight {
    options: Arc<ArcSwapOption<Options>>,
    host: Ipv4Addr,
}

impl Grants for HostRight {
    fn may_write(&self, bus: &str) -> bool {
        let options = self.options.load();
        options
            .as_ref()
            .is_some_and(|options| options.may_write(self.host) && options.serves(bus))
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::options;
    use super::*;

    #[test]
    fn each_part_of_a_right_can_go() {
        let before = Options {
            write: vec!["127.0.0.5/32".parse().unwrap()],
            buses: Some(vec!["line1".to_string()]),
            ..options()
        };
        let rights = HostRights::new(&before);
        let client = "127.0.0.5:47808".parse().unwrap();
        let right = rights.of(&client);
        let of_name = |who: &str| rights.of_name(who).allows("line1");
        assert!(right.allows("line1") && !right.allows("line2"));
        assert!(of_name("127.0.0.5:47808") && !of_name("127.0.0.6:47808") && !of_name("pump"));
        let without = [
            (
                "commands",
                Options {
                    commands: false,
                    ..before.clone()
                },
            ),
            (
                "write",
                Options {
                    write: Vec::new(),
                    ..before.clone()
                },
            ),
            (
                "allow",
                Options {
                    allow: vec!["127.0.0.6/32".parse().unwrap()],
                    ..before.clone()
                },
            ),
            (
                "buses",
                Options {
                    buses: Some(vec!["line2".to_string()]),
                    ..before.clone()
                },
            ),
        ];
        for (part, options) in without {
            rights.set(Some(&options));
            assert!(!right.allows("line1"), "{part}");
            rights.set(Some(&before));
            assert!(right.allows("line1"));
        }
        rights.set(None);
        assert!(!right.allows("line1"));
    }
}
