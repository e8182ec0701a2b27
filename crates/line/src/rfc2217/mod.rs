//! A serial port behind a device server that is set up over the network by telnet with its COM port option (RFC
//! 2217); and the server side of this option, for programs that open a port of this gateway. Codec and negotiation
//! are pure; the owner of the connection passes bytes in and out.

mod com_port;
mod server;
mod telnet;

pub(super) use com_port::{Session, Settings, State};
pub use server::ServedPort;
pub use telnet::escape;
pub(super) use telnet::is_greeting;
