//! The half-duplex wire.

/// Who switches the direction of an RS-485 line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rs485 {
    /// The adapter itself.
    Off,
    /// The kernel, RTS high while sending.
    Kernel,
    /// The kernel, RTS low while sending.
    KernelInverted,
}
