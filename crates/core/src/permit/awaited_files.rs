//! Files of earlier runs that can forbid starts, as long as the disk has not returned them.

use std::path::PathBuf;
use std::sync::Arc;

use arc_swap::ArcSwapOption;

/// A file that is read once, at the start of the gateway. Until then it is unknown which starts it forbids.
#[derive(Debug, Default)]
pub struct AwaitedFile(ArcSwapOption<PathBuf>);

impl AwaitedFile {
    /// Notes that this file is about to be read.
    pub fn begin(&self, path: PathBuf) {
        self.0.store(Some(Arc::new(path)));
    }

    /// Notes that the file was read, or forbids nothing any more.
    pub fn end(&self) {
        self.0.store(None);
    }

    /// Path of the file while it is not read.
    pub fn path(&self) -> Option<Arc<PathBuf>> {
        self.0.load_full()
    }
}

/// The files of the gateway that can forbid starts, apart from those of guards and restores.
#[derive(Debug, Default)]
pub struct AwaitedFiles {
    /// Reservations that stops left.
    pub reservations: AwaitedFile,
    /// Slots in which BACnet clients hold `run` inactive.
    pub slots: AwaitedFile,
}
