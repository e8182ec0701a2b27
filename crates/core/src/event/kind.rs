//! What events are about, and the names of the kinds.

use serde::{Deserialize, Serialize};

/// The kind of an event.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EventKind {
    /// A drive replies (again).
    Online,
    /// A drive no longer replies.
    Offline,
    /// A fault appeared, or its code changed.
    Fault,
    /// The fault cleared.
    FaultEnd,
    /// A motor started.
    Started,
    /// A motor stopped.
    Stopped,
    /// A warning appeared.
    Warning,
    /// The warning cleared.
    WarningEnd,
    /// A drive came under control from the fieldbus, or left it.
    ControlPlace,
    /// A drive has restarted.
    Restarted,
    /// A drive reports a different device type than its profile expects.
    UnlikeProfile,
    /// Process data does not match the profile: a selector in the drive was changed.
    SelectionDiffers,
    /// A lease expired, and its action begins.
    Supervision,
    /// The action of a lease, or the stop of a shutdown, failed.
    SupervisionFailed,
    /// A controlled drive has neither a lease nor a response of its own to a silent master.
    Unsupervised,
    /// A command was refused.
    RefusedCommand,
    /// An acknowledged command showed no effect in time.
    NotConfirmed,
    /// The port of a bus was opened.
    BusUp,
    /// The port of a bus was lost or cannot be opened.
    BusDown,
    /// A recording was made, or lost.
    Recording,
    /// A new configuration was not applied; the previous one stays.
    ReloadRefused,
    /// The other master of a line commands a drive.
    ForeignCommand,
    /// Parameters changed that the gateway did not write.
    ParametersChanged,
    /// A restore of parameters was interrupted, or its journal belongs to no drive that is configured.
    RestoreUnfinished,
    /// A verdict about a line appeared, became more certain, or cleared.
    Diagnosis,
    /// A start was refused as too frequent or too early.
    Guarded,
    /// A start was refused, or a motor stopped, since an interlock does not hold.
    Interlock,
    /// A client took hold of a drive.
    Held,
    /// The hold of a client ended.
    Released,
    /// A client took a drive from its holder.
    HoldBroken,
    /// A drill has ended.
    Drill,
    /// The process, or one of its threads, did not run for longer than a second.
    Paused,
    /// A BACnet client lost its right to write, and with it the values that it had in a slot.
    SlotVoid,
}

impl EventKind {
    pub const ALL: [EventKind; 33] = [
        EventKind::Online,
        EventKind::Offline,
        EventKind::Fault,
        EventKind::FaultEnd,
        EventKind::Started,
        EventKind::Stopped,
        EventKind::Warning,
        EventKind::WarningEnd,
        EventKind::ControlPlace,
        EventKind::Restarted,
        EventKind::UnlikeProfile,
        EventKind::SelectionDiffers,
        EventKind::Supervision,
        EventKind::SupervisionFailed,
        EventKind::Unsupervised,
        EventKind::RefusedCommand,
        EventKind::NotConfirmed,
        EventKind::BusUp,
        EventKind::BusDown,
        EventKind::Recording,
        EventKind::ReloadRefused,
        EventKind::ForeignCommand,
        EventKind::ParametersChanged,
        EventKind::RestoreUnfinished,
        EventKind::Diagnosis,
        EventKind::Guarded,
        EventKind::Interlock,
        EventKind::Held,
        EventKind::Released,
        EventKind::HoldBroken,
        EventKind::Drill,
        EventKind::Paused,
        EventKind::SlotVoid,
    ];

    /// Whether the event needs attention: the log has it as a warning.
    pub(crate) fn is_trouble(self) -> bool {
        match self {
            EventKind::Offline
            | EventKind::Fault
            | EventKind::Warning
            | EventKind::UnlikeProfile
            | EventKind::SelectionDiffers
            | EventKind::Supervision
            | EventKind::SupervisionFailed
            | EventKind::Unsupervised
            | EventKind::NotConfirmed
            | EventKind::BusDown
            | EventKind::Diagnosis
            | EventKind::RestoreUnfinished
            | EventKind::Interlock
            | EventKind::Paused
            | EventKind::SlotVoid
            | EventKind::ReloadRefused => true,
            EventKind::Online
            | EventKind::FaultEnd
            | EventKind::Started
            | EventKind::Stopped
            | EventKind::WarningEnd
            | EventKind::ControlPlace
            | EventKind::Restarted
            | EventKind::RefusedCommand
            | EventKind::BusUp
            | EventKind::Recording
            | EventKind::ForeignCommand
            | EventKind::Guarded
            | EventKind::Held
            | EventKind::Released
            | EventKind::HoldBroken
            | EventKind::Drill
            | EventKind::ParametersChanged => false,
        }
    }

    /// The name in payloads.
    pub fn name(self) -> &'static str {
        match self {
            EventKind::Online => "online",
            EventKind::Offline => "offline",
            EventKind::Fault => "fault",
            EventKind::FaultEnd => "fault_end",
            EventKind::Started => "started",
            EventKind::Stopped => "stopped",
            EventKind::Warning => "warning",
            EventKind::WarningEnd => "warning_end",
            EventKind::ControlPlace => "control_place",
            EventKind::Restarted => "restarted",
            EventKind::UnlikeProfile => "unlike_profile",
            EventKind::SelectionDiffers => "selection_differs",
            EventKind::Supervision => "supervision",
            EventKind::SupervisionFailed => "supervision_failed",
            EventKind::Unsupervised => "unsupervised",
            EventKind::RefusedCommand => "refused_command",
            EventKind::NotConfirmed => "not_confirmed",
            EventKind::BusUp => "bus_up",
            EventKind::BusDown => "bus_down",
            EventKind::Recording => "recording",
            EventKind::ReloadRefused => "reload_refused",
            EventKind::ForeignCommand => "foreign_command",
            EventKind::ParametersChanged => "parameters_changed",
            EventKind::RestoreUnfinished => "restore_unfinished",
            EventKind::Diagnosis => "diagnosis",
            EventKind::Guarded => "guarded",
            EventKind::Interlock => "interlock",
            EventKind::Held => "held",
            EventKind::Released => "released",
            EventKind::HoldBroken => "hold_broken",
            EventKind::Drill => "drill",
            EventKind::Paused => "paused",
            EventKind::SlotVoid => "slot_void",
        }
    }
}
