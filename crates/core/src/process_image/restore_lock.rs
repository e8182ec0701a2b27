//! Why a drive accepts only stops.

use std::sync::Arc;

use arc_swap::ArcSwapOption;

/// Set while the parameters of a drive are being restored, or were left half restored. One drive has the same hold under
/// whatever image a reload gives it.
#[derive(Debug, Default)]
pub struct Hold(ArcSwapOption<String>);

impl Hold {
    /// From now on the drive takes no commands but stops, for the reason given; or all again.
    pub fn set(&self, why: Option<String>) {
        self.0.store(why.map(Arc::new));
    }

    /// Why it accepts only stops, and what ends that; none if it accepts all commands.
    pub fn why(&self) -> Option<Arc<String>> {
        self.0.load_full()
    }
}
