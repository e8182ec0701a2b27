//! A serial port behind a device server that is set up over the network: telnet with its COM port option (RFC 2217).
//! Codec and negotiation are pure; whoever owns the connection passes bytes in and out.

mod com_port;
mod telnet;

pub(super) use com_port::{Session, Settings, State};
pub(super) use telnet::{escape, is_greeting};
