//! RS-485 direction switching by the kernel: the settings requested from the driver, and those that it accepted. A
//! driver omits parts that it cannot do, often without an error (`uart_sanitize_serial_rs485` of `serial_core.c`),
//! and returns the accepted settings.

use std::io;
use std::time::Duration;

use super::options::{LineOptions, Rs485};
use super::sys::{ENABLED, RTS_AFTER_SEND, RTS_ON_SEND, RX_DURING_TX, SerialRs485, TERMINATE_BUS};

/// Lets `driver` switch the direction (it replaces its argument by the accepted settings); returns the settings
/// that it did not accept.
///
/// # Errors
/// If the driver reports an error, such as ENOTTY; `Unsupported` if it accepts the request but leaves the mode off.
pub(super) fn enable(
    options: &LineOptions,
    driver: impl FnOnce(&mut SerialRs485) -> io::Result<()>,
) -> io::Result<Vec<String>> {
    let asked = requested_settings(options);
    let mut took = asked;
    driver(&mut took)?;
    if took.flags & ENABLED == 0 {
        return Err(io::Error::new(io::ErrorKind::Unsupported, "it leaves the mode off"));
    }
    Ok(differences(&asked, &took))
}

fn requested_settings(options: &LineOptions) -> SerialRs485 {
    let inverted = options.rs485 == Rs485::KernelInverted;
    let chosen = [
        (!inverted, RTS_ON_SEND),
        (inverted, RTS_AFTER_SEND),
        (options.rx_during_tx, RX_DURING_TX),
        (options.termination, TERMINATE_BUS),
    ];
    let flags = chosen
        .iter()
        .filter(|(on, _)| *on)
        .fold(ENABLED, |all, (_, flag)| all | flag);
    let milliseconds = |delay: Duration| u32::try_from(delay.as_millis()).unwrap_or(u32::MAX);
    SerialRs485 {
        flags,
        delay_rts_before_send: milliseconds(options.rts_before_send),
        delay_rts_after_send: milliseconds(options.rts_after_send),
        ..SerialRs485::default()
    }
}

fn differences(asked: &SerialRs485, took: &SerialRs485) -> Vec<String> {
    let mut found = Vec::new();
    let changed = |flag| (asked.flags ^ took.flags) & flag != 0;
    let has = |flag| took.flags & flag != 0;
    if has(RTS_ON_SEND) == has(RTS_AFTER_SEND) {
        found.push("RTS has the same level while sending and receiving, so the direction is not switched".to_string());
    } else if changed(RTS_ON_SEND) {
        let (level, key) = if has(RTS_ON_SEND) {
            ("high", "kernel")
        } else {
            ("low", "kernel-inverted")
        };
        found.push(format!("RTS is {level} while sending, which is rs485 = \"{key}\""));
    }
    for (name, asked, took) in [
        (
            "rts_before_send",
            asked.delay_rts_before_send,
            took.delay_rts_before_send,
        ),
        ("rts_after_send", asked.delay_rts_after_send, took.delay_rts_after_send),
    ] {
        if asked != took {
            found.push(format!("{name} is {took} ms, not {asked} ms"));
        }
    }
    if changed(RX_DURING_TX) {
        found.push(if has(RX_DURING_TX) {
            "it receives what it sends (rx_during_tx)".to_string()
        } else {
            "it receives nothing while it sends (rx_during_tx)".to_string()
        });
    }
    if changed(TERMINATE_BUS) {
        found.push(if has(TERMINATE_BUS) {
            "the terminating resistor stays on (termination)".to_string()
        } else {
            "it has no terminating resistor to switch on (termination): fit one".to_string()
        });
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    fn options() -> LineOptions {
        LineOptions {
            rs485: Rs485::Kernel,
            rts_before_send: Duration::from_millis(1),
            rts_after_send: Duration::from_millis(2),
            rx_during_tx: true,
            termination: true,
            ..LineOptions::default()
        }
    }

    /// The message about a driver that changes the request like that.
    fn said(options: &LineOptions, change: impl FnOnce(&mut SerialRs485)) -> Vec<String> {
        enable(options, |request| {
            change(request);
            Ok(())
        })
        .unwrap()
    }

    #[test]
    fn all_that_is_configured_is_asked_for() {
        let mut asked = None;
        let warnings = said(&options(), |request| asked = Some(*request));
        assert_eq!(warnings, Vec::<String>::new());
        let asked = asked.unwrap();
        // Bits of `struct serial_rs485` in `linux/serial.h`: enabled, RTS on send, receive while sending, terminate.
        assert_eq!(asked.flags, 0b11_0011);
        assert_eq!((asked.delay_rts_before_send, asked.delay_rts_after_send), (1, 2));
        let inverted = LineOptions {
            rs485: Rs485::KernelInverted,
            ..LineOptions::default()
        };
        let mut flags = 0;
        said(&inverted, |request| flags = request.flags);
        assert_eq!(flags, 0b101, "enabled, RTS after send");
    }

    #[test]
    fn a_polarity_that_the_driver_drops_is_told() {
        let inverted = LineOptions {
            rs485: Rs485::KernelInverted,
            ..LineOptions::default()
        };
        let high = said(&inverted, |request| request.flags = ENABLED | RTS_ON_SEND);
        assert_eq!(high, ["RTS is high while sending, which is rs485 = \"kernel\""]);
        let low = said(&options(), |request| request.flags ^= RTS_ON_SEND | RTS_AFTER_SEND);
        assert_eq!(low, ["RTS is low while sending, which is rs485 = \"kernel-inverted\""]);
        for same in [0, RTS_ON_SEND | RTS_AFTER_SEND] {
            let neither = said(&inverted, |request| request.flags = ENABLED | same);
            assert!(neither[0].contains("the direction is not switched"), "{neither:?}");
        }
    }

    #[test]
    fn a_driver_without_delays_echo_and_resistor() {
        let left_out = said(&options(), |request| {
            request.flags = ENABLED | RTS_ON_SEND;
            request.delay_rts_before_send = 0;
            request.delay_rts_after_send = 0;
        });
        assert_eq!(
            left_out,
            [
                "rts_before_send is 0 ms, not 1 ms",
                "rts_after_send is 0 ms, not 2 ms",
                "it receives nothing while it sends (rx_during_tx)",
                "it has no terminating resistor to switch on (termination): fit one",
            ]
        );
        let plain = LineOptions {
            rs485: Rs485::Kernel,
            ..LineOptions::default()
        };
        let forced = said(&plain, |request| request.flags |= RX_DURING_TX | TERMINATE_BUS);
        assert_eq!(forced.len(), 2, "{forced:?}");
    }

    #[test]
    fn a_driver_that_cannot_or_does_not() {
        let refused = enable(&options(), |_| Err(io::Error::from_raw_os_error(25)));
        assert_eq!(refused.unwrap_err().raw_os_error(), Some(25));
        let off = enable(&options(), |request| {
            request.flags = 0;
            Ok(())
        });
        assert_eq!(off.unwrap_err().kind(), io::ErrorKind::Unsupported);
    }
}
