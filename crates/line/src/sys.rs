//! The only module with `unsafe`: ioctls that no safe crate offers, and taking ownership of an open descriptor.
#![allow(unsafe_code)]

use std::os::fd::{AsFd, FromRawFd, IntoRawFd, OwnedFd};

use rustix::io;
use rustix::ioctl::{Getter, Opcode, Setter, Updater, ioctl};

use super::options::Level;

/// `TIOCSRS485` of `linux/serial.h`.
const TIOCSRS485: Opcode = 0x542F;
/// `TIOCGSERIAL` and `TIOCSSERIAL` of `linux/serial.h`.
const TIOCGSERIAL: Opcode = 0x541E;
const TIOCSSERIAL: Opcode = 0x541F;

/// `TIOCMBIS` and `TIOCMBIC`: set and clear control lines.
const TIOCMBIS: Opcode = 0x5416;
const TIOCMBIC: Opcode = 0x5417;

/// `SER_RS485_ENABLED` and the further bits of the flags.
pub(super) const ENABLED: u32 = 1 << 0;
pub(super) const RTS_ON_SEND: u32 = 1 << 1;
pub(super) const RTS_AFTER_SEND: u32 = 1 << 2;
pub(super) const RX_DURING_TX: u32 = 1 << 4;
pub(super) const TERMINATE_BUS: u32 = 1 << 5;
/// Bits of the control lines: `TIOCM_DTR` and `TIOCM_RTS`.
const LINE_DTR: i32 = 0x002;
const LINE_RTS: i32 = 0x004;
const ASYNC_LOW_LATENCY: i32 = 1 << 13;

/// `struct serial_rs485`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct SerialRs485 {
    pub(super) flags: u32,
    /// Delay before sending, in milliseconds.
    pub(super) delay_rts_before_send: u32,
    /// Delay after sending, in milliseconds.
    pub(super) delay_rts_after_send: u32,
    pub(super) padding: [u32; 5],
}

/// The kernel's `struct serial_struct`.
#[repr(C)]
#[derive(Clone, Copy)]
struct SerialStruct {
    kind: i32,
    line: i32,
    port: u32,
    irq: i32,
    flags: i32,
    xmit_fifo_size: i32,
    custom_divisor: i32,
    baud_base: i32,
    close_delay: u16,
    io_type: u8,
    reserved: u8,
    hub6: i32,
    closing_wait: u16,
    closing_wait2: u16,
    iomem_base: usize,
    iomem_reg_shift: u16,
    port_high: u32,
    iomap_base: usize,
}

/// Sets how the driver switches the direction; `config` becomes the driver's actual settings.
///
/// # Errors
/// `ENOTTY` if the driver does not support RS-485 settings.
pub(super) fn set_rs485(port: impl AsFd, config: &mut SerialRs485) -> std::io::Result<()> {
    // SAFETY: the request reads and writes one `struct serial_rs485`, whose layout is that of `linux/serial.h`.
    unsafe { ioctl(port, Updater::<TIOCSRS485, SerialRs485>::new(config)) }?;
    Ok(())
}

/// Sets RTS and DTR where a level is chosen.
///
/// # Errors
/// `ENOTTY` or `EINVAL` if the driver cannot set the lines.
pub(super) fn set_levels(port: impl AsFd, rts: Level, dtr: Level) -> std::io::Result<()> {
    let lines = |wanted| {
        let of = |level, line| if level == wanted { line } else { 0 };
        of(rts, LINE_RTS) | of(dtr, LINE_DTR)
    };
    // SAFETY: the requests read one `int`.
    unsafe {
        if lines(Level::On) != 0 {
            ioctl(port.as_fd(), Setter::<TIOCMBIS, i32>::new(lines(Level::On)))?;
        }
        if lines(Level::Off) != 0 {
            ioctl(port.as_fd(), Setter::<TIOCMBIC, i32>::new(lines(Level::Off)))?;
        }
    }
    Ok(())
}

/// Asks the driver to pass bytes on at once (FTDI delays them by 16 ms by default).
///
/// # Errors
/// `ENOTTY` if the driver has no such setting, `EPERM` if the user may not change it.
pub(super) fn low_latency(port: impl AsFd) -> io::Result<()> {
    // SAFETY: the requests write and read one `struct serial_struct`, whose layout is that of `linux/serial.h`.
    unsafe {
        let mut settings = ioctl(port.as_fd(), Getter::<TIOCGSERIAL, SerialStruct>::new())?;
        settings.flags |= ASYNC_LOW_LATENCY;
        ioctl(port.as_fd(), Setter::<TIOCSSERIAL, SerialStruct>::new(settings))
    }
}

/// Takes ownership of the descriptor of a port.
pub(super) fn own(port: impl IntoRawFd) -> OwnedFd {
    // SAFETY: `into_raw_fd` gives up ownership of an open descriptor, which is taken over here and nowhere else.
    unsafe { OwnedFd::from_raw_fd(port.into_raw_fd()) }
}
