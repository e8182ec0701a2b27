//! What all servers share, and three of them: Modbus TCP, BACnet/IP and the tool slots. Servers read the process image and
//! queue commands; they never name the bus. MQTT and HTTP have crates of their own, which this one does not know.

mod arrivals;
pub mod bacnet;
pub mod command_json;
pub mod connection_limit;
mod kept;
mod link_status;
pub mod listener;
pub mod log_throttle;
pub mod metrics;
pub mod modbus_tcp;
pub mod parameter_jobs;
pub mod patience;
pub mod readiness;
pub mod reading;
pub mod refusals;
pub mod register_map;
mod server;
pub mod slot;
mod state;
pub mod state_file;
mod stats;
pub mod tcp_server;
pub mod tls;

use std::io;
use std::net::SocketAddr;
use std::path::PathBuf;

pub use link_status::{LinkState, LinkStatus};
pub use listener::ListenerStates;
pub use server::{Reconfigure, Server};
pub use state::NorthState;
pub use stats::{
    BacnetStats, ConnectionRefusal, ModbusTcpStats, MqttKind, MqttStats, RefusalStats, ReloadStats, ServerKind,
    SlotOutcome, SlotStats,
};
pub use tcp_server::TcpServer;

/// Why a server cannot start.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// The server cannot listen on an address.
    #[error("cannot listen for {protocol} on {address}: {cause}; {} in `listen` of {section}", remedy(.cause))]
    Listen {
        /// `Modbus TCP` or `HTTP`.
        protocol: &'static str,
        address: SocketAddr,
        /// Section of the configuration, in brackets.
        section: String,
        /// The system's error.
        cause: io::Error,
    },
    /// The system does not provide a thread.
    #[error("cannot start the Modbus TCP thread: {0}; free memory, threads or file descriptors")]
    Thread(io::Error),
    /// The local socket cannot be opened.
    #[error("cannot listen on {}: {cause}", .path.display())]
    Local {
        /// The first path that the socket could have.
        path: PathBuf,
        /// The system's error.
        cause: io::Error,
    },
    /// The certificates of a server, named first, cannot be used.
    #[error("TLS of {0}: {1}")]
    Tls(&'static str, tls::TlsFault),
}

fn remedy(cause: &io::Error) -> &'static str {
    match cause.kind() {
        io::ErrorKind::AddrInUse => "another program uses it; stop that program or choose another port",
        io::ErrorKind::PermissionDenied => {
            "ports below 1024 require CAP_NET_BIND_SERVICE: set CapabilityBoundingSet and AmbientCapabilities of the unit to it \
             (systemctl edit drivegate), or choose another port"
        }
        io::ErrorKind::AddrNotAvailable => "this machine does not have that address; choose one that it has",
        _ => "choose another address",
    }
}
