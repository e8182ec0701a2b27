//! Commands as JSON, for MQTT and HTTP: parsing requests, recognising repetitions, results.

mod hold;
mod memory;
mod request;
mod result;
mod stop_all;

pub(super) use self::hold::{HoldFields, HoldReply};
#[cfg(test)]
pub(super) use self::memory::REMEMBERED;
pub(super) use self::memory::{Repetition, SharedMemory, Taken};
#[cfg(test)]
pub(super) use self::request::MAX_ID;
pub(super) use self::request::{
    Id, MAX_PAYLOAD, ParsedCommand, check_size, excerpt, find_id, order, refuse_unknown, resolve,
};
pub(super) use self::result::CommandResult;
pub use self::stop_all::StopBody;
pub(super) use self::stop_all::{nothing_to_stop, refuse_stop_all, stop_all};
