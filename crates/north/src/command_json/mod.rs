//! Commands as JSON, for MQTT and HTTP: parsing requests, recognising repetitions, results.

mod hold;
mod memory;
mod request;
mod result;
mod stop_all;

pub use self::hold::{HoldFields, HoldReply};
pub use self::memory::REMEMBERED;
pub use self::memory::{Repetition, SharedMemory, Taken};
pub use self::request::MAX_ID;
pub use self::request::{Id, MAX_PAYLOAD, ParsedCommand, check_size, excerpt, find_id, order, refuse_unknown, resolve};
pub use self::result::CommandResult;
pub use self::stop_all::StopBody;
pub use self::stop_all::{nothing_to_stop, refuse_stop_all, stop_all};
