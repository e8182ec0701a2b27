//! The lock that makes a drive accept only stops, with its reason.

use std::sync::Arc;

use arc_swap::ArcSwapOption;

/// Set while the parameters of a drive are being restored, or if a restore was not completed. A drive keeps this
/// hold in every new process image after a reload.
#[derive(Debug, Default)]
pub struct RestoreLock(ArcSwapOption<String>);

impl RestoreLock {
    /// Lets the drive accept only stops from now on, for this reason; with `None` all commands again.
    pub fn set(&self, why: Option<String>) {
        self.0.store(why.map(Arc::new));
    }

    /// Why the drive accepts only stops, and what ends that; `None` if it accepts all commands.
    pub fn reason(&self) -> Option<Arc<String>> {
        self.0.load_full()
    }
}
