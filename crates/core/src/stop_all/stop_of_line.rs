//! A broadcast that stops all drives of a line.

use std::time::Duration;

use crate::process_image::{Access, BusSpec, DriveSpec};
use drivegate_proto::{Protocol, RequestPdu};

/// Time that drives need to carry out a broadcast before the next request (MODBUS over Serial Line 1.02, 2.4.1).
pub const BROADCAST_PAUSE: Duration = Duration::from_millis(100);

/// The write that stops every drive of a line when it is broadcast: only if all of them are to be stopped, and the
/// write means a stop to each of them. It gets no reply, so every drive gets a separate stop afterwards.
pub fn stop_of_line<'d>(bus: &BusSpec, drives: impl IntoIterator<Item = &'d DriveSpec>) -> Option<RequestPdu> {
    // With these protocols, address 0 is an ordinary device.
    if bus.protocol == Protocol::N2 || bus.is_modbus_tcp() {
        return None;
    }
    let mut stops = drives
        .into_iter()
        .map(|drive| (drive.access == Access::Control).then(|| drive.profile.broadcast_stop())?);
    let first = stops.next()??;
    // A single drive is stopped just as fast by its own stop, without a broadcast.
    let mut others = stops.peekable();
    others.peek()?;
    others.all(|stop| stop.as_ref() == Some(&first)).then_some(first)
}

#[cfg(test)]
mod tests {
    use super::*;
    use drivegate_model::drive::profile::Profiles;
    use drivegate_proto::LineFormat;

    fn drives(profiles: &[&str], access: Access) -> Vec<DriveSpec> {
        let known = Profiles::built_in();
        let spec = |(address, profile): (usize, &&str)| DriveSpec {
            access,
            ..DriveSpec::new("d", "b", address as u8 + 1, known.get(profile).unwrap().clone())
        };
        profiles.iter().enumerate().map(spec).collect()
    }

    #[test]
    fn only_where_it_means_the_same_to_every_drive() {
        let bus = |protocol, port: &str| BusSpec {
            name: "b".to_string(),
            port: port.to_string(),
            protocol,
            format: LineFormat::NETWORK,
            cycle: Duration::ZERO,
            slow_cycle: Duration::ZERO,
        };
        let line = bus(Protocol::ModbusRtu, "/dev/ttyUSB0");
        let rtu = |profiles: &[&str]| stop_of_line(&line, &drives(profiles, Access::Control));
        let clear = |address| Some(RequestPdu::WriteRegister { address, value: 0 });
        assert_eq!(rtu(&["vacon-nx", "vacon-nx"]), clear(2000));
        assert_eq!(
            rtu(&["vacon-nx", "eaton-svx", "eaton-hvx"]),
            clear(2000),
            "the same board"
        );
        let coil = RequestPdu::WriteCoil { address: 0, on: false };
        assert_eq!(rtu(&["vacon-cx", "vacon-cx"]), Some(coil));
        let ascii = stop_of_line(
            &bus(Protocol::ModbusAscii, "/dev/ttyUSB0"),
            &drives(&["teco-7300pa", "teco-7300pa"], Access::Control),
        );
        assert_eq!(ascii, clear(1));
        assert_eq!(rtu(&["vacon-nx", "vacon-cx"]), None, "another register");
        assert_eq!(rtu(&["vacon-nx"]), None, "its own stop is as fast");
        let monitored = drives(&["vacon-nx", "vacon-nx"], Access::Monitor);
        assert_eq!(stop_of_line(&line, &monitored), None);
        let mut one_monitored = drives(&["vacon-nx", "vacon-nx"], Access::Control);
        one_monitored[1].access = Access::Monitor;
        assert_eq!(stop_of_line(&line, &one_monitored), None);
        let n2 = drives(&["vacon-nx-n2", "vacon-nx-n2"], Access::Control);
        assert_eq!(stop_of_line(&bus(Protocol::N2, "/dev/ttyUSB0"), &n2), None);
        let network = bus(Protocol::ModbusRtu, "modbus-tcp://10.0.0.7:502");
        let all = drives(&["vacon-nx", "vacon-nx"], Access::Control);
        assert_eq!(stop_of_line(&network, &all), None, "there is no broadcast");
    }
}
