//! The one room with `unsafe`: ioctls that no safe crate offers, and taking over an open descriptor.
#![allow(unsafe_code)]

use std::os::fd::{AsFd, FromRawFd, IntoRawFd, OwnedFd};

use rustix::io;
use rustix::ioctl::{Getter, Opcode, Setter, ioctl};

/// `TIOCSRS485` of `linux/serial.h`.
const TIOCSRS485: Opcode = 0x542F;
/// `TIOCGSERIAL` and `TIOCSSERIAL` of `linux/serial.h`.
const TIOCGSERIAL: Opcode = 0x541E;
const TIOCSSERIAL: Opcode = 0x541F;

const SER_RS485_ENABLED: u32 = 1 << 0;
const SER_RS485_RTS_ON_SEND: u32 = 1 << 1;
const SER_RS485_RTS_AFTER_SEND: u32 = 1 << 2;
const ASYNC_LOW_LATENCY: i32 = 1 << 13;

/// `struct serial_rs485`.
#[repr(C)]
#[derive(Clone, Copy, Default)]
struct SerialRs485 {
    flags: u32,
    delay_rts_before_send: u32,
    delay_rts_after_send: u32,
    padding: [u32; 5],
}

/// `struct serial_struct`.
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

/// Lets the kernel switch the direction: RTS high while sending, or low when `inverted`.
///
/// # Errors
/// ENOTTY where the driver cannot.
pub(super) fn enable_rs485(port: impl AsFd, inverted: bool) -> io::Result<()> {
    let rts = if inverted {
        SER_RS485_RTS_AFTER_SEND
    } else {
        SER_RS485_RTS_ON_SEND
    };
    let config = SerialRs485 {
        flags: SER_RS485_ENABLED | rts,
        ..SerialRs485::default()
    };
    // SAFETY: the request reads one `struct serial_rs485`, whose layout is that of `linux/serial.h`.
    unsafe { ioctl(port, Setter::<TIOCSRS485, SerialRs485>::new(config)) }
}

/// Asks the driver to hand bytes on at once (FTDI holds them for 16 ms by default).
///
/// # Errors
/// ENOTTY where the driver cannot, EPERM where the user may not.
pub(super) fn low_latency(port: impl AsFd) -> io::Result<()> {
    // SAFETY: the requests write and read one `struct serial_struct`, whose layout is that of `linux/serial.h`.
    unsafe {
        let mut settings = ioctl(port.as_fd(), Getter::<TIOCGSERIAL, SerialStruct>::new())?;
        settings.flags |= ASYNC_LOW_LATENCY;
        ioctl(port.as_fd(), Setter::<TIOCSSERIAL, SerialStruct>::new(settings))
    }
}

/// Takes the descriptor out of its owner.
pub(super) fn own(port: impl IntoRawFd) -> OwnedFd {
    // SAFETY: `into_raw_fd` gives up ownership of an open descriptor, which is taken over here and nowhere else.
    unsafe { OwnedFd::from_raw_fd(port.into_raw_fd()) }
}
