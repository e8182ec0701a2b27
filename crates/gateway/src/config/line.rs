//! The keys of `[[bus]]` that set up the port.

use super::keys::BUS;
use drivegate_line::{Level, LineOptions, Rs485};
use drivegate_model::document::{Reader, format_duration};

/// Reads the options of a line; reports those that are invalid or have no effect.
pub(super) fn read(reader: &Reader<'_>, port: Option<&str>) -> LineOptions {
    let options = LineOptions {
        rs485: BUS.rs485.get(reader),
        rts_before_send: BUS.rts_before_send.get(reader),
        rts_after_send: BUS.rts_after_send.get(reader),
        rx_during_tx: BUS.rx_during_tx.get(reader),
        termination: BUS.termination.get(reader),
        rts: BUS.rts.get(reader),
        dtr: BUS.dtr.get(reader),
        spin: BUS.spin.get(reader),
        receives_only: false,
    };
    let scheme = port.and_then(|port| port.split_once("://")).map(|(scheme, _)| scheme);
    if scheme.is_some() && options.rs485 != Rs485::Off {
        reader.warning(
            BUS.rs485.name,
            format!(
                "a device server ({}://) switches the direction itself",
                scheme.unwrap_or_default()
            ),
            "write \"off\" or leave the key out",
        );
    } else if options.rs485 == Rs485::Off {
        for key in [
            BUS.rts_before_send.name,
            BUS.rts_after_send.name,
            BUS.rx_during_tx.name,
            BUS.termination.name,
        ] {
            if reader.has(key) {
                reader.warning(
                    key,
                    format!("`{key}` has no effect while the kernel does not switch the direction"),
                    "write rs485 = \"kernel\", or leave the key out",
                );
            }
        }
    } else if options.rts != Level::Driver {
        reader.problem(
            BUS.rts.name,
            "with rs485 = \"kernel\" RTS switches the direction, so it has no fixed level",
            "leave `rts` out, or write rs485 = \"off\"",
        );
    }
    for (key, delay) in [
        (BUS.rts_before_send.name, options.rts_before_send),
        (BUS.rts_after_send.name, options.rts_after_send),
    ] {
        if delay.subsec_micros() % 1000 != 0 {
            reader.problem(
                key,
                format!("the kernel accepts whole milliseconds, not {}", format_duration(delay)),
                "write for example \"1ms\"",
            );
        }
    }
    for (key, level) in [(BUS.rts.name, options.rts), (BUS.dtr.name, options.dtr)] {
        if scheme == Some("tcp") && level != Level::Driver {
            reader.warning(
                key,
                format!("a raw device server (tcp://) has no `{key}` that can be set from here"),
                "write rfc2217:// if the server can do that, or leave the key out",
            );
        }
    }
    options
}
