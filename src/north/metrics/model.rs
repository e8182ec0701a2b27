//! Metrics of the common drive model.

use crate::drive::ModelPoint;

/// Gauges of the common model: point, metric, help.
pub(super) const MODEL: [(ModelPoint, &str, &str); 19] = [
    (
        ModelPoint::Ready,
        "drivegate_drive_ready",
        "Whether the drive is ready to run.",
    ),
    (
        ModelPoint::Running,
        "drivegate_drive_running",
        "Whether the drive runs.",
    ),
    (
        ModelPoint::Reversed,
        "drivegate_drive_reversed",
        "Whether the drive turns in reverse.",
    ),
    (
        ModelPoint::Fault,
        "drivegate_drive_fault",
        "Whether the drive has a fault.",
    ),
    (
        ModelPoint::Warning,
        "drivegate_drive_warning",
        "Whether the drive has a warning.",
    ),
    (
        ModelPoint::AtReference,
        "drivegate_drive_at_reference",
        "Whether the output has reached the reference.",
    ),
    (
        ModelPoint::ActualSpeed,
        "drivegate_drive_actual_speed_percent",
        "Speed in percent of the speed range.",
    ),
    (
        ModelPoint::SpeedReference,
        "drivegate_drive_speed_reference_percent",
        "Speed reference as the drive has it, in percent of the speed range.",
    ),
    (
        ModelPoint::OutputFrequency,
        "drivegate_drive_output_frequency_hertz",
        "Output frequency.",
    ),
    (
        ModelPoint::MotorSpeed,
        "drivegate_drive_motor_speed_rpm",
        "Motor speed in revolutions per minute.",
    ),
    (
        ModelPoint::MotorCurrent,
        "drivegate_drive_motor_current_amperes",
        "Motor current.",
    ),
    (
        ModelPoint::MotorTorque,
        "drivegate_drive_motor_torque_percent",
        "Motor torque in percent of nominal.",
    ),
    (
        ModelPoint::MotorPower,
        "drivegate_drive_motor_power_percent",
        "Motor power in percent of nominal.",
    ),
    (
        ModelPoint::MotorVoltage,
        "drivegate_drive_motor_voltage_volts",
        "Motor voltage.",
    ),
    (
        ModelPoint::DcLinkVoltage,
        "drivegate_drive_dc_link_voltage_volts",
        "DC link voltage.",
    ),
    (
        ModelPoint::HeatsinkTemperature,
        "drivegate_drive_heatsink_temperature_celsius",
        "Heatsink temperature.",
    ),
    (
        ModelPoint::Energy,
        "drivegate_drive_energy_kilowatthours",
        "Energy counter of the drive.",
    ),
    (
        ModelPoint::OperatingHours,
        "drivegate_drive_operating_hours",
        "Operating hours of the drive.",
    ),
    (
        ModelPoint::FaultCode,
        "drivegate_drive_fault_code",
        "Active fault code of the drive family, 0 without a fault.",
    ),
];

#[cfg(test)]
mod tests {
    use super::*;

    /// Points of the model that have no metric of their own.
    const WITHOUT: [ModelPoint; 6] = [
        ModelPoint::ZeroSpeed,
        ModelPoint::Remote,
        ModelPoint::Run,
        ModelPoint::Reverse,
        ModelPoint::FaultReset,
        ModelPoint::FrequencyReference,
    ];

    #[test]
    fn every_model_point_has_its_place() {
        for point in ModelPoint::ALL {
            let own = MODEL.iter().filter(|(p, ..)| p == point).count();
            assert_eq!(own, usize::from(!WITHOUT.contains(point)), "{}", point.name());
        }
    }
}
