//! When what is read from sockets came: whether the threads that read ran, and when each reader found nothing left.

mod dated;
mod reader;
mod watch;

pub(crate) use dated::{Dated, Source, is_readable};
pub(crate) use reader::Reader;
pub use watch::{Watch, watched_runtime};
