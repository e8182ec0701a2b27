//! When bytes read from sockets arrived: whether the reading threads ran, and when each reader last found nothing to read.

mod dated;
mod reader;
mod watch;

pub use dated::{Dated, Frames, Source, is_readable};
pub use reader::{FrameEnd, Reader};
pub use watch::{Watch, watched_runtime};
