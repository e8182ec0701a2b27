//! `[recordings]`: the settings of the recorder.

use std::path::Path;

use super::keys::RECORDINGS;
use drivegate_core::files::names::RECORDINGS as RECORDINGS_DIR;
use drivegate_core::history::RecorderOptions;
use drivegate_model::document::Reader;

pub(super) fn read(reader: &Reader<'_>, state_dir: &Path) -> RecorderOptions {
    let options = RecorderOptions {
        dir: state_dir.join(RECORDINGS_DIR),
        before: RECORDINGS.before.get(reader),
        after: RECORDINGS.after.get(reader),
        max_bytes: RECORDINGS.max_bytes.get(reader),
        max_count: RECORDINGS.max_count.get(reader),
        warnings: RECORDINGS.warnings.get(reader),
    };
    reader.finish();
    options
}
