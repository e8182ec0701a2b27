//! Status word and general status word of the family: which drive shows which signal in which bit.

use super::super::model::Model;
use super::{AT_REFERENCE_BAND, ControlPlace, NxDrive};

/// A state that a status bit can show.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Signal {
    Ready,
    Running,
    Reverse,
    Fault,
    Warning,
    AtReference,
    ZeroSpeed,
    FluxReady,
    /// Torque control's speed limit is not active: always so here.
    NoSpeedLimit,
    EncoderReverse,
    /// Undervoltage fast stop is not active: always so here.
    NoUndervoltageStop,
    Bypass,
    FireMode,
    Interlocked,
    NotInterlocked,
    Place(ControlPlace),
    /// The hand-off-auto switch is at auto.
    Auto,
    /// The hand-off-auto switch is not at off.
    HoaOn,
}

/// Which status bits a drive has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StatusBits {
    /// All bits of the Vacon NX: 0x0541 when idle and healthy (reference/drives.md 3.6, 3.7).
    Full,
    /// Only the status bits that all drives of the family share, as in the worked frames of reference/drives.md.
    Common,
    /// Eaton SVX: the shared bits, and nothing in the general status word; 0x0001 when idle and healthy.
    Svx,
    /// Eaton HVX: bypass, fire mode and "not interlocked" too, and the bits of the general status word that its N2 map
    /// names (reference/drives.md 3.7, 9.16); 0x0101 when idle and healthy.
    Hvx,
}

/// Signals of a status word by bit.
type Layout = &'static [(u8, Signal)];

const COMMON: Layout = &[
    (0, Signal::Ready),
    (1, Signal::Running),
    (2, Signal::Reverse),
    (3, Signal::Fault),
    (4, Signal::Warning),
    (5, Signal::AtReference),
];

const VACON: Layout = &[
    (6, Signal::ZeroSpeed),
    (7, Signal::FluxReady),
    (8, Signal::NoSpeedLimit),
    (9, Signal::EncoderReverse),
    (10, Signal::NoUndervoltageStop),
];

const HVX: Layout = &[(6, Signal::Bypass), (7, Signal::FireMode), (8, Signal::NotInterlocked)];

const VACON_GENERAL: Layout = &[
    (13, Signal::Place(ControlPlace::Fieldbus)),
    (14, Signal::Place(ControlPlace::Panel)),
    (15, Signal::Place(ControlPlace::Terminals)),
];

const HVX_GENERAL: Layout = &[
    (0, Signal::Interlocked),
    (1, Signal::Bypass),
    (2, Signal::FireMode),
    (3, Signal::Auto),
    (4, Signal::HoaOn),
];

impl StatusBits {
    /// Bits of the status word in addition to the shared ones, and bits of the general status word.
    fn layouts(self) -> (Layout, Layout) {
        match self {
            StatusBits::Full => (VACON, VACON_GENERAL),
            StatusBits::Common => (&[], VACON_GENERAL),
            StatusBits::Svx => (&[], &[]),
            StatusBits::Hvx => (HVX, HVX_GENERAL),
        }
    }
}

impl NxDrive {
    /// ID 2101.
    pub(super) fn status(&self) -> u16 {
        self.word(COMMON) | self.word(self.options.status.layouts().0)
    }

    /// ID 2102.
    pub(super) fn general_status(&self) -> u16 {
        self.word(self.options.status.layouts().1)
    }

    fn word(&self, layout: Layout) -> u16 {
        layout
            .iter()
            .filter(|(_, signal)| self.shows(*signal))
            .fold(0, |word, (bit, _)| word | (1 << bit))
    }

    fn shows(&self, signal: Signal) -> bool {
        let (motor, fault) = (&self.body.motor, self.body.latch.fault());
        match signal {
            Signal::Ready => self.ready(),
            Signal::Running => self.body.shows_running(),
            Signal::Reverse => self.body.turns_reverse(self.target()),
            Signal::Fault => fault != 0,
            Signal::Warning => self.warning || (self.lost_master && self.settings.fieldbus_fault == 1),
            Signal::AtReference => self.body.running && (motor.output - self.target()).abs() < AT_REFERENCE_BAND,
            Signal::ZeroSpeed => motor.shaft == 0.0,
            Signal::FluxReady => motor.fed,
            Signal::NoSpeedLimit | Signal::NoUndervoltageStop => true,
            Signal::EncoderReverse => motor.shaft < 0.0,
            Signal::Bypass => self.bypassed(),
            Signal::FireMode => self.fire_mode(),
            Signal::Interlocked => self.interlock,
            Signal::NotInterlocked => !self.interlock,
            Signal::Place(place) => self.settings.place == place,
            Signal::Auto => self.settings.place == ControlPlace::Fieldbus,
            Signal::HoaOn => !self.switched_off,
        }
    }
}
