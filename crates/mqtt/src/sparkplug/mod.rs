//! Sparkplug B 3.0: the gateway as an edge node, its drives as devices (`docs/sparkplug.md`).
//!
//! ```text
//! process image ──▶ model ──▶ ┌─────────┐      client       ┌────────┐
//!                             │ session │ ──▶ (a connection │ broker │
//! STATE, NCMD ──────────────▶ └─────────┘     of its own)──▶└────────┘
//!                 commands ◀──────────────────────────── DCMD ◀───┘
//! ```
//!
//! `topics`, `wire`, `metric`, `host`, `history` and `session` are pure: the session receives the drives' values and
//! the broker's messages, and returns the next message. `model` makes metrics of drives and buses, `orders` makes
//! commands of commands. `bd_seq` keeps the number of the session on disk. `client` owns them and the
//! connection, which is apart from that of the MQTT topics, because its last will is the death of the node.

mod bd_seq;
mod client;
mod history;
mod host;
mod metric;
mod model;
mod orders;
mod session;
mod topics;
mod wire;

use std::path::PathBuf;

pub(super) use self::client::run;
pub(super) use self::orders::NodeOrdersLeft;

/// Configuration of the edge node; broker and credentials are those of the MQTT client.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Id of the Sparkplug group.
    pub group: String,
    /// Id of the edge node.
    pub node: String,
    /// Id of the host that must be online before anything is published; empty for no such host.
    pub primary_host: String,
    /// Whether metrics have aliases.
    pub alias: bool,
    /// Values of an outage are published afterwards.
    pub history: bool,
    /// Directory of the file with the number of the session.
    pub state_dir: PathBuf,
}
