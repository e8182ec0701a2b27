//! `fault_reset` of `[control]`: bits that are set and cleared again, or the words of that.

use std::time::Duration;

use super::super::control::{Reset, Setting, Step, Until};
use super::control::{Around, read_setting, read_steps, read_time};
use crate::document::Reader;

/// Reads `fault_reset`: either a form, or a list of words.
pub(super) fn read(table: &Reader<'_>, around: &Around<'_>, stop: Option<Setting>) -> Option<Reset> {
    let form = table.table("fault_reset")?;
    if form.has("steps") {
        let (steps, verified) = (read_steps(&form, around), form.or("verified", true));
        form.finish();
        let reset = reset_of_steps(&form, &steps?, stop, 2 * around.update_period)?;
        return Some(Reset { verified, ..reset });
    }
    let setting = read_setting(&form, around);
    let pulse = read_time(&form, "hold").unwrap_or(2 * around.update_period);
    let verified = form.or("verified", true);
    form.finish();
    Some(Reset {
        setting: setting?,
        pulse,
        verified,
    })
}

/// A reset given as words: the word that resets for a time, the word after it, and at most the latter before them.
/// The bits of a stop have their values from the word that resets.
fn reset_of_steps(form: &Reader<'_>, steps: &[Step], stop: Option<Setting>, pulse: Duration) -> Option<Reset> {
    let refuse = |what: &str, remedy: &str| {
        form.problem("steps", what, remedy);
        None
    };
    let (set, clear) = match steps {
        [set, clear] => (set, clear),
        [before, set, clear] if before.write == clear.write => (set, clear),
        _ => {
            return refuse(
                "a reset is the word that resets and the one behind it",
                "write two steps, or the second of them before both, too",
            );
        }
    };
    let pulse = match set.until {
        Until::Time(time) => time,
        Until::Written => pulse,
        Until::State(_) => return refuse("a reset waits for no state", "write `time` in the step that resets"),
    };
    let bits = (set.write.value ^ clear.write.value) & set.write.mask & clear.write.mask;
    if set.write.place != clear.write.place || bits == 0 || set.write.value & bits != bits {
        return refuse(
            "the second word does not end the first",
            "write the first word again, without the bits that reset",
        );
    }
    let stop = stop.filter(|stop| stop.place == set.write.place);
    let mask = bits | stop.map_or(0, |stop| stop.mask) & set.write.mask;
    let setting = Setting {
        mask,
        value: set.write.value & mask,
        ..set.write
    };
    Some(Reset {
        setting,
        pulse,
        verified: true,
    })
}
