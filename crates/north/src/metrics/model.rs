//! Metrics of the common drive model.

use super::drive::DriveFigures;
use super::series::{Row, rows};
use drivegate_model::drive::ModelPoint;

/// Gauges of the common model: point, metric, help.
macro_rules! gauges {
    ($($point:ident $metric:literal $help:literal)*) => {
        /// Points of the model that have a metric of their own.
        pub(super) const MODEL: &[ModelPoint] = &[$(ModelPoint::$point),*];

        pub(super) fn families<'a>() -> Vec<Row<DriveFigures<'a>>> {
            rows! { DriveFigures<'a>; $(Gauge $metric $help => |drive, series| series.add_some(drive.model(ModelPoint::$point));)* }
        }
    };
}

gauges! {
    Ready "drivegate_drive_ready" "Whether the drive is ready to run."
    Running "drivegate_drive_running" "Whether the drive runs."
    Reversed "drivegate_drive_reversed" "Whether the drive turns in reverse."
    Fault "drivegate_drive_fault" "Whether the drive has a fault."
    Warning "drivegate_drive_warning" "Whether the drive has a warning."
    AtReference "drivegate_drive_at_reference" "Whether the output has reached the reference."
    ActualSpeed "drivegate_drive_actual_speed_percent" "Speed in percent of the speed range."
    SpeedReference "drivegate_drive_speed_reference_percent"
        "Speed reference as read from the drive, in percent of the speed range."
    OutputFrequency "drivegate_drive_output_frequency_hertz" "Output frequency."
    MotorSpeed "drivegate_drive_motor_speed_rpm" "Motor speed in revolutions per minute."
    MotorCurrent "drivegate_drive_motor_current_amperes" "Motor current."
    MotorTorque "drivegate_drive_motor_torque_percent" "Motor torque in percent of nominal."
    MotorPower "drivegate_drive_motor_power_percent" "Motor power in percent of nominal."
    MotorVoltage "drivegate_drive_motor_voltage_volts" "Motor voltage."
    DcLinkVoltage "drivegate_drive_dc_link_voltage_volts" "DC link voltage."
    HeatsinkTemperature "drivegate_drive_heatsink_temperature_celsius" "Heatsink temperature."
    Energy "drivegate_drive_energy_kilowatthours" "Energy counter of the drive."
    OperatingHours "drivegate_drive_operating_hours" "Operating hours of the drive."
    FaultCode "drivegate_drive_fault_code" "Active fault code of the drive family, 0 without a fault."
}

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
    fn every_model_point_has_a_metric_or_an_exception() {
        for point in ModelPoint::ALL {
            let own = MODEL.iter().filter(|own| *own == point).count();
            assert_eq!(own, usize::from(!WITHOUT.contains(point)), "{}", point.name());
        }
    }
}
