//! Every key of the configuration, once, by section. The doc comment of a key is its meaning, in the schema and in
//! `docs/configuration.md` too; after its type come its form and what holds when it is absent. A section of the loader reads by
//! its keys; the keys know no loader.

#[macro_use]
mod table;

mod authority;
mod bacnet;
mod bus;
mod drill;
mod drive;
mod forms;
mod http;
mod log;
mod modbus_tcp;
mod mqtt;
mod params;
mod recordings;
mod root;

pub(super) use self::authority::*;
pub(super) use self::bacnet::*;
pub use self::bus::default_format;
pub(super) use self::bus::{BUS, SLOT};
pub(super) use self::drill::*;
pub(super) use self::drive::*;
pub(super) use self::http::*;
pub(super) use self::log::{AUDIT, LOG};
pub use self::log::{LogFormat, parse_level};
pub(super) use self::modbus_tcp::*;
pub(super) use self::mqtt::*;
pub(super) use self::params::*;
pub(super) use self::recordings::*;
pub use self::root::schema;
pub(super) use self::root::{GATEWAY, ROOT};

/// Each table by the name of its type, with its rows in the documentation.
#[cfg(test)]
pub(super) fn documentation() -> std::collections::BTreeMap<&'static str, Vec<[String; 4]>> {
    let sections = [
        authority::documentation,
        bacnet::documentation,
        bus::documentation,
        drill::documentation,
        drive::documentation,
        http::documentation,
        log::documentation,
        modbus_tcp::documentation,
        mqtt::documentation,
        params::documentation,
        recordings::documentation,
        root::documentation,
    ];
    sections.into_iter().flat_map(|section| section()).collect()
}
