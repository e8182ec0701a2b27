//! The configuration: a TOML file and environment variables become [`Settings`].
//!
//! One run reports every error with file, line and key. Only the file itself, and the profiles and secrets it
//! names, are opened. Relative paths are relative to the directory of the file.

mod authority;
mod bacnet;
mod bus;
mod capped;
mod drill;
mod drive;
mod files;
mod gateway;
mod http;
mod interlocks;
mod key;
mod keys;
mod line;
mod load;
mod log;
pub mod memory;
mod modbus_tcp;
mod mqtt;
pub mod named_files;
mod params;
mod port;
mod raw_writes;
mod recordings;
mod settings;
mod shutdown;
mod slot;
mod stale;
mod start_guard;
mod supervision;
mod together;
mod unique;
mod unused_profiles;
mod values;

pub use drive::{addresses, unknown_profile};
pub use keys::{LogFormat, default_format, parse_level, schema};
pub use load::{DEFAULT_FILE, Loaded, environment};
pub use log::LogSettings;
pub use named_files::{FileKind, NamedFile, named_files};
pub use params::ParamsSettings;
pub use port::check as check_port;
pub use settings::{BusSettings, Settings, StateFiles, WithoutGateway};
pub use stale::StaleAfter;

#[cfg(test)]
mod tests;
