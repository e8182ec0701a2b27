//! The devices of a configuration at rest, as lines as text and programs. Pure.

use drivegate_bacnet::{Access, Kind, Object};

use super::objects::{self, Flat, ListedDevice};
use super::{Options, units};
use drivegate_core::process_image::{BusSpec, DriveSpec};

/// An object in the printed list.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Line {
    /// Instance of the device that has this object.
    pub device: u32,
    pub device_name: String,
    /// The object as it is usually written, such as `AI 2`.
    pub object: String,
    pub name: String,
    /// The kind of the object's values.
    pub kind: String,
    /// The unit; empty without one.
    pub unit: String,
    /// How clients can write the object.
    pub access: &'static str,
}

/// The column names of the list.
pub const COLUMNS: [&str; 7] = ["device", "device_name", "object", "name", "type", "unit", "access"];

impl Line {
    /// The texts of the cells, in the order of [`COLUMNS`].
    pub fn cells(&self) -> [String; 7] {
        [
            self.device.to_string(),
            self.device_name.clone(),
            self.object.clone(),
            self.name.clone(),
            self.kind.clone(),
            self.unit.clone(),
            self.access.to_string(),
        ]
    }
}

/// The devices that a configuration shows, that of the gateway first.
pub fn devices<'s>(
    gateway: &str,
    options: &Options,
    buses: impl Iterator<Item = (&'s BusSpec, &'s [DriveSpec])> + Clone,
) -> Vec<ListedDevice> {
    let own = (gateway, options.device);
    let served = buses.clone().filter(|(bus, _)| options.serves(&bus.name));
    let drives = served
        .flat_map(|(_, drives)| drives)
        .map(|spec| (spec.name.clone(), spec.unit, objects::of_drive(spec, own)));
    let gateway_device = objects::of_gateway(own, buses.map(|(bus, _)| bus));
    if options.network.is_some() {
        return [gateway_device]
            .into_iter()
            .chain(drives.map(|(.., shown)| shown))
            .collect();
    }
    let mut drives: Vec<(String, u8, ListedDevice)> = drives.collect();
    drives.sort_by_key(|(_, unit, _)| *unit);
    let Flat { device, places } = objects::flat(own, gateway_device, drives.into_iter());
    let meanings = places.into_iter().map(|(_, meaning)| meaning).collect();
    vec![ListedDevice { device, meanings }]
}

/// All objects of these devices.
pub fn lines(devices: &[ListedDevice]) -> Vec<Line> {
    let of_device = |shown: &ListedDevice| {
        let device = shown.device.clone();
        let objects: Vec<Line> = device
            .objects()
            .iter()
            .map(|object| line(device.instance, &device.name, object))
            .collect();
        objects
    };
    devices.iter().flat_map(of_device).collect()
}

fn line(device: u32, device_name: &str, object: &Object) -> Line {
    let (kind, unit) = match &object.kind {
        Kind::Analog { units, .. } => ("number".to_string(), units::name(*units)),
        Kind::Binary {
            texts: [inactive, active],
        } => (format!("{inactive}, {active}"), ""),
        Kind::MultiState { texts } => (texts.join(", "), ""),
        Kind::Text => ("text".to_string(), ""),
    };
    Line {
        device,
        device_name: device_name.to_string(),
        object: object.id.to_string(),
        name: object.name.to_string(),
        kind,
        unit: unit.to_string(),
        access: match object.access {
            Access::Read => "read",
            Access::Write => "write",
            Access::Command => "command",
        },
    }
}
