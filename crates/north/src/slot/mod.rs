//! The tool slot: a program that uses the drives' own protocol sees the line as if no one else used it, over TCP,
//! over a COM port by RFC 2217 or over a pseudo-terminal.
//!
//! `request` interprets the request in a frame, `framing` splits bytes into requests, `terms` decides which
//! requests a slot permits, `dialogue` combines them; all of them are pure. `connection` and `pty` do the I/O.

mod connection;
mod dialogue;
mod framing;
mod listener;
mod loopback;
mod pty;
mod request;
mod rights;
mod terms;

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use arc_swap::ArcSwap;
use ipnet::IpNet;
use tokio::runtime::Handle;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use self::listener::{Served, SlotListener};
use self::terms::{Terms, WritePaces};
use super::connection_limit::Limits;
use super::listener::{ListenerSpec, Listeners, NewSockets};
use super::refusals::Refusals;
use super::{NorthState, ServerError, ServerKind};
use crate::tcp_server::{TcpServer, TcpService};
use drivegate_core::plant::SharedPlant;
use drivegate_proto::{LineFormat, Protocol};

pub use self::loopback::Loopback;

/// Maximum number of tools that one address of a slot serves at a time, in turns.
pub const MAX_TOOLS: usize = 4;

/// The rights of the tools of a slot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub enum SlotAccess {
    #[default]
    Read,
    /// Tools may also write, like a Modbus TCP client with the right to write.
    Write,
    /// Tools may also send requests that cannot be checked: broadcasts, functions that are not decoded, addresses
    /// without a configured drive.
    Raw,
}

impl SlotAccess {
    /// Meaning of the access level as text.
    pub fn meaning(self) -> &'static str {
        match self {
            SlotAccess::Read => "tools may only read",
            SlotAccess::Write => "tools may write what Modbus TCP clients may",
            SlotAccess::Raw => "tools may write, broadcast and send what cannot be checked",
        }
    }
}

/// A slot of a bus.
#[derive(Debug, Clone, PartialEq)]
pub struct Slot {
    /// Name of the bus.
    pub bus: String,
    /// Protocol of the slot's line.
    pub protocol: Protocol,
    /// Character format of the line.
    pub format: LineFormat,
    /// Address on which the slot accepts frames in the form that they have on the line.
    pub listen: Option<SocketAddr>,
    /// Address where a COM port is served by RFC 2217.
    pub rfc2217: Option<SocketAddr>,
    /// Link to a pseudo-terminal.
    pub pty: Option<PathBuf>,
    /// Rights of the slot's tools.
    pub access: SlotAccess,
    /// Networks that may connect.
    pub allow: Vec<IpNet>,
    /// Time without a request after which a connection is closed; `None` means never.
    pub idle_timeout: Option<Duration>,
}

impl Slot {
    /// The addresses that the slot listens on, and whether each serves a COM port.
    fn addresses(&self) -> impl Iterator<Item = (SocketAddr, bool)> {
        let raw = self.listen.map(|address| (address, false));
        raw.into_iter().chain(self.rfc2217.map(|address| (address, true)))
    }

    /// Whether tools that are connected notice nothing of a change to `other`.
    fn serves_like(&self, other: &Slot) -> bool {
        let alike = Slot {
            listen: self.listen,
            rfc2217: self.rfc2217,
            pty: self.pty.clone(),
            allow: self.allow.clone(),
            idle_timeout: self.idle_timeout,
            ..other.clone()
        };
        alike == *self
    }
}

/// All slots of the gateway.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Options {
    /// The slots in the order of the file.
    pub slots: Vec<Slot>,
}

impl Options {
    /// Files that the slots can have open at one time.
    pub fn files(&self) -> usize {
        let files =
            |slot: &Slot| slot.addresses().count() * (1 + limits().files()) + 2 * usize::from(slot.pty.is_some());
        self.slots.iter().map(files).sum()
    }
}

fn limits() -> Limits {
    Limits::new(MAX_TOOLS, MAX_TOOLS)
}

/// The running tool slot servers.
pub type Server = TcpServer<Slots, Options>;

/// The service for the tools of the listeners and pseudo-terminals.
#[derive(Debug)]
pub struct Slots {
    ptys: Vec<RunningPty>,
    /// The slots of the present configuration.
    current: Arc<ArcSwap<Options>>,
    plant: SharedPlant,
    stats: Arc<NorthState>,
    paces: Arc<WritePaces>,
    refusals: Arc<Refusals>,
    /// Number of listeners opened so far.
    opened: usize,
    tasks: TaskTracker,
    cancel: CancellationToken,
}

#[derive(Debug)]
struct RunningPty {
    slot: Slot,
    cancel: CancellationToken,
}

impl Slots {
    fn commit_ptys(&mut self, all: &[Arc<Terms>]) {
        let wanted = |slot: &Slot| all.iter().any(|terms| terms.slot == *slot);
        self.ptys.retain(|pty| {
            let stays = wanted(&pty.slot);
            if !stays {
                pty.cancel.cancel();
            }
            stays
        });
        for terms in all {
            let Some(path) = terms.slot.pty.clone() else { continue };
            if self.ptys.iter().any(|pty| pty.slot == terms.slot) {
                continue;
            }
            let cancel = self.cancel.child_token();
            self.tasks
                .spawn(pty::serve(path, terms.clone(), cancel.clone(), self.cancel.clone()));
            self.ptys.push(RunningPty {
                slot: terms.slot.clone(),
                cancel,
            });
        }
    }
}

impl TcpService<Options> for Slots {
    const NAME: &'static str = "the tool slots";
    const KIND: ServerKind = ServerKind::Slot;
    type Handler = SlotListener;
    type Prepared = ();

    fn new(
        _: &Options,
        plant: SharedPlant,
        stats: Arc<NorthState>,
        cancel: CancellationToken,
        tasks: &TaskTracker,
    ) -> Result<Slots, ServerError> {
        Ok(Slots {
            ptys: Vec::new(),
            current: Arc::default(),
            plant,
            paces: Arc::default(),
            refusals: Arc::new(Refusals::new(ServerKind::Slot, stats.clone())),
            stats,
            opened: 0,
            tasks: tasks.clone(),
            cancel,
        })
    }

    fn listener_specs(options: &Options) -> Vec<ListenerSpec> {
        let specs = options.slots.iter().flat_map(|slot| {
            slot.addresses().map(move |(address, _)| ListenerSpec {
                address,
                tls: false,
                section: format!("[[bus.slot]] of bus `{}`", slot.bus),
            })
        });
        specs.collect()
    }

    fn prepare(&self, _: &Options) -> Result<(), ServerError> {
        Ok(())
    }

    /// Tools of a slot that serves as before stay connected.
    fn commit(&mut self, options: Options, (): (), sockets: NewSockets, listeners: &mut Listeners<SlotListener>) {
        self.current.store(Arc::new(options.clone()));
        let terms = |slot: &Slot| {
            Arc::new(Terms {
                slot: slot.clone(),
                current: self.current.clone(),
                plant: self.plant.clone(),
                stats: self.stats.clone(),
                paces: self.paces.clone(),
            })
        };
        let all: Vec<Arc<Terms>> = options.slots.iter().map(terms).collect();
        // The order is that of the listeners.
        let mut served = all.iter().flat_map(|terms| {
            let addresses = terms.slot.addresses();
            addresses.map(|(_, telnet)| Served {
                terms: terms.clone(),
                telnet,
            })
        });
        let (opened, refusals, stopping) = (&mut self.opened, &self.refusals, &self.cancel);
        let mut first = None;
        listeners.commit(sockets, |_, open, cancel| {
            let served = served.next().or_else(|| first.clone());
            first = first.take().or_else(|| served.clone());
            let listener = match (open, served) {
                (Some(listener), Some(served)) => {
                    listener.update(served);
                    listener.clone()
                }
                (Some(listener), None) => listener.clone(),
                (None, served) => {
                    *opened += 1;
                    Arc::new(SlotListener::new(
                        *opened,
                        served,
                        refusals.clone(),
                        cancel.clone(),
                        stopping.clone(),
                    ))
                }
            };
            (listener, Handle::current())
        });
        self.commit_ptys(&all);
    }

    fn retire(&mut self) {
        self.current.store(Arc::default());
        self.ptys.drain(..).for_each(|pty| pty.cancel.cancel());
    }
}
