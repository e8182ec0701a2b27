//! The options of a line apart from its port and its character format.

use std::time::Duration;

/// Which part switches the direction of an RS-485 line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Rs485 {
    /// The adapter itself switches the direction.
    #[default]
    Off,
    /// The kernel, RTS high while sending.
    Kernel,
    /// The kernel, RTS low while sending.
    KernelInverted,
}

/// A control line of the port that is kept at one level, for adapters that it powers or enables.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Level {
    /// The level that the driver sets when the port is opened: Linux asserts RTS and DTR.
    #[default]
    Driver,
    /// The signal is asserted.
    On,
    /// The signal is not asserted.
    Off,
}

/// Whether the end of a short wait is met by watching the clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Spin {
    /// Spin on a machine with more than one processor.
    #[default]
    Auto,
    /// Spin in every case.
    On,
    /// Never: waits end when the kernel wakes the thread, some ten to a hundred microseconds late.
    Off,
}

impl Spin {
    /// Whether to spin on a machine with this number of processors. With a single one, the drive's reply is
    /// processed by the same processor that would spin.
    pub(super) fn holds(self, processors: usize) -> bool {
        match self {
            Spin::Auto => processors > 1,
            Spin::On => true,
            Spin::Off => false,
        }
    }
}

/// Settings of the port and of the waits. The settings of RS-485 by the kernel count only with [`Rs485::Kernel`] and
/// [`Rs485::KernelInverted`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LineOptions {
    /// Which part switches the direction of an RS-485 line.
    pub rs485: Rs485,
    /// Time between switching to sending and the first bit, whole milliseconds up to [`MOST_RTS_DELAY`].
    pub rts_before_send: Duration,
    /// Time between the last bit and switching back, likewise.
    pub rts_after_send: Duration,
    /// Whether the port receives what it sends.
    pub rx_during_tx: bool,
    /// Whether the driver switches the terminating resistor on.
    pub termination: bool,
    /// Level of RTS; not possible if the kernel switches RTS for RS-485.
    pub rts: Level,
    pub dtr: Level,
    /// How precisely waits must end.
    pub spin: Spin,
    /// Whether nothing is ever sent: a port without RTS is then accepted, as RTS need not be lowered.
    pub receives_only: bool,
}

/// Longest delay that Linux accepts (`RS485_MAX_RTS_DELAY` of `serial_core.c`).
pub const MOST_RTS_DELAY: Duration = Duration::from_millis(100);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_single_processor_does_not_spin_unless_told_to() {
        assert_eq!([1, 2, 4].map(|count| Spin::Auto.holds(count)), [false, true, true]);
        assert!(Spin::On.holds(1));
        assert!(!Spin::Off.holds(4));
    }
}
