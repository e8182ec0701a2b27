//! The identity of a client and its rank. Pure.

use std::net::IpAddr;
use std::sync::Arc;
use std::time::Duration;

use ipnet::IpNet;

use crate::order::{Origin, Proof};

/// How commands of non-holders are treated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mode {
    /// Violations are counted, reported and executed.
    Advisory,
    /// Violations are refused, except stops.
    Exclusive,
}

/// A client with one name for all north sides.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Principal {
    /// Name of the principal.
    pub name: Arc<str>,
    /// Position of the rank; 0 is the highest.
    pub rank: usize,
    /// Whether the client writes its command word continuously: a word that repeats its last stop is then not a new
    /// stop. Stops over HTTP and the local socket are always new ones.
    pub cyclic: bool,
    /// Addresses over Modbus TCP and TCP slots.
    pub modbus_tcp: Vec<IpNet>,
    /// Name in the client's certificate.
    pub certificate: Option<String>,
    /// User name over HTTP.
    pub http_user: Option<String>,
    /// Level `WHO` of the MQTT topics `as/WHO`.
    pub mqtt: Option<String>,
    /// Whether the principal is the Sparkplug host.
    pub sparkplug: bool,
    /// Addresses from which the principal sends over BACnet.
    pub bacnet: Vec<IpNet>,
    /// User id at the local socket.
    pub socket: Option<u32>,
}

impl Principal {
    /// A principal without any proof, which no connection matches.
    pub fn new(name: impl Into<Arc<str>>, rank: usize) -> Principal {
        Principal {
            name: name.into(),
            rank,
            cyclic: false,
            modbus_tcp: Vec::new(),
            certificate: None,
            http_user: None,
            mqtt: None,
            sparkplug: false,
            bacnet: Vec::new(),
            socket: None,
        }
    }
}

/// The identity under which a client commands.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Claim {
    /// Name of the principal: two claims of one name are one principal.
    pub name: Arc<str>,
    /// Position of the rank; 0 is the highest.
    pub rank: usize,
    /// See [`Principal::cyclic`]; never set where the interface excludes repetitions.
    pub cyclic: bool,
    /// Whether the client uses an interface on which programs write cyclically, so that a stop may be a repetition.
    pub may_repeat: bool,
    /// Whether commands break the hold of a lower rank by themselves: in BACnet the priority is the act.
    pub breaks: bool,
}

impl Claim {
    /// The claim of a client that is not a principal.
    pub(super) fn nobody() -> Claim {
        Claim {
            name: "nobody".into(),
            rank: usize::MAX,
            cyclic: false,
            may_repeat: false,
            breaks: false,
        }
    }

    /// Whether both claims are of one principal.
    pub fn is(&self, other: &Claim) -> bool {
        self.name == other.name
    }

    /// Whether this claim has a lower rank than the other.
    pub fn is_below(&self, other: &Claim) -> bool {
        self.rank > other.rank
    }

    /// A claim whose stops are all new ones.
    fn never_repeating(self) -> Claim {
        Claim {
            cyclic: false,
            may_repeat: false,
            ..self
        }
    }
}

/// `[authority]` of the configuration, if on.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Rules {
    /// How commands of non-holders are treated.
    pub mode: Mode,
    /// Names of the ranks, the highest first; never empty.
    pub ranks: Vec<Arc<str>>,
    /// How long a hold lasts without renewal, and a reservation.
    pub lease: Duration,
    /// Whether a stop is written when a drive with its run command set is switched to local control.
    pub stop_at_local: bool,
    /// The configured principals.
    pub principals: Vec<Principal>,
}

impl Rules {
    /// The principal that sent a command; `None` if unknown.
    pub(crate) fn claim_of(&self, origin: &Origin) -> Option<Claim> {
        let claim = self.claim(origin.proof())?;
        Some(if origin.insists() {
            claim.never_repeating()
        } else {
            claim
        })
    }

    /// The principal of a client; `None` if unknown.
    pub fn claim(&self, proof: &Proof) -> Option<Claim> {
        let named = |is: &dyn Fn(&Principal) -> bool| self.principals.iter().find(|p| is(p)).map(claim_of);
        let matches = |field: &Option<String>, name: &str| field.as_deref() == Some(name);
        match proof {
            Proof::Nothing => None,
            Proof::Certificate(name, address) => {
                named(&|p| matches(&p.certificate, name)).or_else(|| self.by_address(*address, |p| &p.modbus_tcp))
            }
            Proof::Address(address) => self.by_address(*address, |p| &p.modbus_tcp),
            Proof::User(user) => named(&|p| matches(&p.http_user, user)).map(Claim::never_repeating),
            Proof::Topic(who) => named(&|p| matches(&p.mqtt, who)),
            Proof::Sparkplug => named(&|p| p.sparkplug),
            Proof::Uid(uid) => {
                let known = named(&|p| p.socket == Some(*uid)).unwrap_or_else(|| first(format!("socket:{uid}")));
                Some(known.never_repeating())
            }
            Proof::Pty(path) => Some(first(format!("slot:{path}"))),
            Proof::Bacnet(address, priority) => {
                let claim = self.by_address(*address, |p| &p.bacnet)?;
                let rank = claim.rank.max(self.rank_of_priority(*priority));
                Some(Claim {
                    rank,
                    breaks: true,
                    ..claim
                })
            }
        }
    }

    /// The principal with the longest prefix at an address.
    fn by_address(&self, address: IpAddr, networks: impl Fn(&Principal) -> &Vec<IpNet>) -> Option<Claim> {
        let address = address.to_canonical();
        let longest = |p: &Principal| {
            let of = networks(p).iter().filter(|network| network.contains(&address));
            of.map(IpNet::prefix_len).max()
        };
        let known = self.principals.iter().filter_map(|p| Some((longest(p)?, p)));
        known.max_by_key(|(length, _)| *length).map(|(_, p)| claim_of(p))
    }

    /// The rank that a priority of BACnet counts as, at most.
    fn rank_of_priority(&self, priority: u8) -> usize {
        let rank = match priority {
            0..=2 => 0,
            3..=8 => 1,
            9..=14 => 2,
            _ => 3,
        };
        rank.min(self.ranks.len().saturating_sub(1))
    }

    /// The name of the rank with this index.
    pub fn rank(&self, rank: usize) -> Arc<str> {
        self.ranks.get(rank).cloned().unwrap_or_else(|| "?".into())
    }

    /// Whether the principal is still configured.
    pub fn is_configured(&self, claim: &Claim) -> bool {
        // Names of principals have no colon.
        claim.name.contains(':') || self.principals.iter().any(|p| p.name == claim.name)
    }
}

fn claim_of(principal: &Principal) -> Claim {
    Claim {
        name: principal.name.clone(),
        rank: principal.rank,
        cyclic: principal.cyclic,
        may_repeat: true,
        breaks: false,
    }
}

/// Anyone who may open a socket or a pseudo-terminal without being named: the mode of the file is the authority.
fn first(name: String) -> Claim {
    Claim {
        name: name.into(),
        rank: 0,
        cyclic: false,
        may_repeat: false,
        breaks: false,
    }
}
