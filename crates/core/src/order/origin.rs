//! The origin of a command: client, rights and role.

use std::net::IpAddr;
use std::sync::Arc;

use super::Right;

/// The kind of client or interface that a command comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum SourceKind {
    /// Modbus TCP client.
    ModbusTcp,
    /// MQTT topic.
    Mqtt,
    /// A command of a Sparkplug host.
    Sparkplug,
    /// HTTP: the status page, or a program.
    Http,
    /// The lease of a drive that expired.
    Supervision,
    /// The gateway's stop when it ends.
    Shutdown,
    /// `drivegate write` through the socket of the gateway.
    LocalSocket,
    /// `drivegate write` without a running gateway.
    CommandLine,
    /// The other master of a line on which the gateway only listens.
    OtherMaster,
    /// The gateway's own periodic reads.
    Schedule,
    /// A tool at a slot of the bus.
    Slot,
    /// A command of a BACnet client.
    Bacnet,
    /// A stop because an interlock no longer holds.
    Interlock,
}

impl SourceKind {
    /// All kinds of sources.
    pub const ALL: [SourceKind; 13] = [
        SourceKind::ModbusTcp,
        SourceKind::Mqtt,
        SourceKind::Sparkplug,
        SourceKind::Http,
        SourceKind::Supervision,
        SourceKind::Shutdown,
        SourceKind::LocalSocket,
        SourceKind::CommandLine,
        SourceKind::OtherMaster,
        SourceKind::Schedule,
        SourceKind::Slot,
        SourceKind::Bacnet,
        SourceKind::Interlock,
    ];

    /// The label of metrics and audit lines.
    pub fn name(self) -> &'static str {
        match self {
            SourceKind::ModbusTcp => "modbus_tcp",
            SourceKind::Mqtt => "mqtt",
            SourceKind::Sparkplug => "sparkplug",
            SourceKind::Http => "http",
            SourceKind::Supervision => "supervision",
            SourceKind::Shutdown => "shutdown",
            SourceKind::LocalSocket => "local_socket",
            SourceKind::CommandLine => "command_line",
            SourceKind::OtherMaster => "other_master",
            SourceKind::Schedule => "schedule",
            SourceKind::Slot => "slot",
            SourceKind::Bacnet => "bacnet",
            SourceKind::Interlock => "interlock",
        }
    }

    /// Whether `min_run` may delay a stop from this kind of source; stops by people are never delayed.
    pub fn stops_may_be_delayed(self) -> bool {
        matches!(
            self,
            SourceKind::ModbusTcp | SourceKind::Mqtt | SourceKind::Sparkplug | SourceKind::Bacnet | SourceKind::Slot
        )
    }

    /// Whether a client is the source; the gateway itself is not a client.
    pub fn is_client(self) -> bool {
        !matches!(
            self,
            SourceKind::Supervision | SourceKind::Shutdown | SourceKind::Schedule | SourceKind::Interlock
        )
    }
}

/// The authority of a client; the drive may allow less.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Authority {
    /// The client may read and write.
    Write,
    /// The client may only read; every write is refused.
    ReadOnly,
}

/// What a client's connection proves about its identity.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Proof {
    /// The connection proves no identity.
    #[default]
    Nothing,
    /// The address of a Modbus TCP client, or of a tool at a TCP slot.
    Address(IpAddr),
    /// The name in the client's certificate, and its address.
    Certificate(Arc<str>, IpAddr),
    /// A user of HTTP.
    User(Arc<str>),
    /// A user id at the local socket.
    Uid(u32),
    /// WHO in the MQTT topic `as/WHO`, which the broker's access rules secure.
    Topic(Arc<str>),
    /// The client is a Sparkplug host.
    Sparkplug,
    /// The address of a BACnet client, and the priority of its write.
    Bacnet(IpAddr, u8),
    /// A program at the pseudo-terminal of that path.
    Pty(Arc<str>),
}

/// The role in which a client acts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Acting {
    /// The client acts for itself.
    #[default]
    Usual,
    /// Each stop of this client counts as a new one, even if the client repeats its command word continuously.
    Insisting,
    /// The drill that the client armed gives the order.
    Drill,
}

/// The origin of a command: for the audit, and as a client among others.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Origin {
    /// Kind of the source.
    pub kind: SourceKind,
    /// Address, topic or certificate name, as the audit shows it.
    pub who: String,
    client: Arc<str>,
    login: Option<Arc<str>>,
    proof: Proof,
    acting: Acting,
    right: Right,
}

impl Origin {
    /// Name of the origin when a lease expires.
    pub const LEASE: &str = "supervision";
    /// Name of the client for a stop that is repeated because an earlier write may still be on its way.
    pub const REPEATED_STOP: &str = "repeated stop";
    /// The client name for the stop of a drive that was switched to local control with its run command set.
    pub const LOCAL: &str = "local control place";

    /// An origin that is a separate client.
    pub fn new(kind: SourceKind, who: impl Into<String>) -> Origin {
        let who = who.into();
        let client = format!("{} {who}", kind.name()).into();
        Origin::of(client, kind, who)
    }

    /// An origin that counts as `client` wherever clients share a resource: turns and places in the queue, records
    /// of the audit. More connections or topics give a client no advantage, as long as all name the same `client`.
    pub fn of(client: Arc<str>, kind: SourceKind, who: impl Into<String>) -> Origin {
        let who = who.into();
        Origin {
            kind,
            who,
            client,
            login: None,
            proof: Proof::Nothing,
            acting: Acting::Usual,
            right: Right::lasting(),
        }
    }

    /// Sets the facts that the connection of the client proves.
    pub fn proven(mut self, proof: Proof) -> Origin {
        self.proof = proof;
        self
    }

    /// The origin of a drill that this client armed, shown under that name in the audit and in events.
    #[must_use]
    pub fn of_drill(mut self, who: String) -> Origin {
        (self.who, self.acting) = (who, Acting::Drill);
        self
    }

    /// Marks each stop of the client as a new one, even if it repeats its command word continuously.
    pub(crate) fn insisting(mut self) -> Origin {
        self.acting = Acting::Insisting;
        self
    }

    /// Whether a stop is never taken for a repetition.
    pub(crate) fn insists(&self) -> bool {
        self.acting == Acting::Insisting
    }

    /// Whether a drill gives the order.
    pub fn is_drill(&self) -> bool {
        self.acting == Acting::Drill
    }

    /// Sets the right to write.
    pub fn with_right(mut self, right: Right) -> Origin {
        self.right = right;
        self
    }

    /// Gives a right that no reload removes, for an action that has started and must be completed.
    pub fn lasting(self) -> Origin {
        self.with_right(Right::lasting())
    }

    /// The origin for a record of the past, without the right: a right keeps what grants it in memory, and with that
    /// the plant.
    #[must_use]
    pub(crate) fn recorded(&self) -> Origin {
        self.clone().lasting()
    }

    /// The right of the client to write.
    pub fn right(&self) -> &Right {
        &self.right
    }

    /// What the client's connection proves about its identity.
    pub fn proof(&self) -> &Proof {
        &self.proof
    }

    /// Adds the login of the client, by which it may renew the lease of the drive until another client commands the drive.
    pub fn with_login(mut self, login: Arc<str>) -> Origin {
        self.login = Some(login);
        self
    }

    /// The login, if the client has one.
    pub fn login(&self) -> Option<&Arc<str>> {
        self.login.as_ref()
    }

    /// Whether the origin is the lease of a drive and not another stop of the gateway itself.
    pub fn is_lease(&self) -> bool {
        self.kind == SourceKind::Supervision && self.who == Origin::LEASE
    }

    /// The client, under any connection or topic.
    pub fn client(&self) -> &Arc<str> {
        &self.client
    }
}
