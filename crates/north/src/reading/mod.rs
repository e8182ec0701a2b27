//! When bytes read from sockets arrived: whether the reading threads ran, and when each reader last found nothing to read.

mod dated;
mod reader;
mod watch;

pub(crate) use dated::{Dated, Source, is_readable};
pub(crate) use reader::Reader;
pub use watch::{Watch, watched_runtime};
