//! Selects the drives to check: a few in one call, so that commands do not wait for a thousand drives.

use std::time::Duration;

/// Maximum time between two checks of a drive that was not updated, for values that change by themselves, such as its age.
pub(super) const LOOK: Duration = Duration::from_millis(250);
/// Number of drives looked at in one call.
pub(super) const DRIVES: usize = 32;

/// The drives that are due, of `count`, and whether these are all. The next call continues with the first of the others.
pub(super) fn due(cursor: &mut usize, count: usize, is_due: impl Fn(usize) -> bool) -> (Vec<usize>, bool) {
    let first = *cursor;
    let mut due = (0..count)
        .map(|step| (first + step) % count)
        .filter(|place| is_due(*place));
    let places = due.by_ref().take(DRIVES).collect();
    match due.next() {
        Some(rest) => {
            *cursor = rest;
            (places, false)
        }
        None => (places, true),
    }
}
