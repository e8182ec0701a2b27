//! JSON Schema of the configuration, for editors.
//!
//! Words, bounds and defaults come from the constants that the loader uses, and a test holds the keys
//! against the keys that the loader asks for.

mod bus;
mod forms;
mod north;

use serde_json::Value;

use self::forms::{list, name, pattern, table, tables, text, with_default, words};
use super::log;

/// The schema, draft 2020-12.
pub fn schema() -> Value {
    let mut root = table(
        "Configuration of drivegate. Variables DRIVEGATE__SECTION__KEY override any key of it; relative paths \
         are seen from the directory of the file.",
        &["gateway"],
        [
            ("gateway", gateway()),
            (
                "bus",
                tables("Serial lines (or serial device servers) with their drives.", bus::bus()),
            ),
            ("modbus_tcp", north::modbus_tcp()),
            ("mqtt", north::mqtt()),
            ("http", north::http()),
            ("log", log()),
        ],
    );
    if let Value::Object(root) = &mut root {
        root.insert("$schema".into(), "https://json-schema.org/draft/2020-12/schema".into());
        root.insert("title".into(), "drivegate".into());
    }
    root
}

fn gateway() -> Value {
    table(
        "The gateway itself.",
        &["name"],
        [
            ("name", name("Name of the gateway: MQTT topics, metric label.", "-")),
            (
                "socket",
                text(
                    "Path of the local socket through which read and write reach the running gateway; \"\": none. Default: \
                     drivegate.sock in the runtime directory.",
                ),
            ),
            (
                "profile_dirs",
                list(
                    "Directories of your own profiles (*.toml); one with the name of a built-in profile replaces it.",
                    text("A directory."),
                ),
            ),
        ],
    )
}

fn log() -> Value {
    let levels = log::LEVELS.join("|");
    let level = format!(r"^\s*([A-Za-z0-9_:-]+=)?({levels})\s*(,\s*([A-Za-z0-9_:-]+=)?({levels})\s*)*$");
    table(
        "What is logged.",
        &[],
        [
            (
                "level",
                with_default(
                    pattern("Level, also for each target: info,drivegate::bus=debug.", &level),
                    log::DEFAULT_LEVEL,
                ),
            ),
            (
                "format",
                with_default(
                    words(
                        "auto: the journal's under systemd, coloured text on a terminal, else JSON lines.",
                        log::FORMATS.iter().map(|(w, _)| *w),
                    ),
                    "auto",
                ),
            ),
        ],
    )
}
